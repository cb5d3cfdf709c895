"""`learn_from_scans`: a template from the part's mesh and what sound scans say on top of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from amrepair.align import align
from amrepair.arrays import Matrix
from amrepair.errors import AlignmentError
from amrepair.frames import moved
from amrepair.merge.fit import rows_of_scans, said_outvoted
from amrepair.scans import Scan
from amrepair.template import LearnedSdf, MeshSdf
from amrepair.template.fit import fit_fast
from amrepair.template.sound import SoundParts, learn
from gcode.progress import Progress, silent

if TYPE_CHECKING:
    import trimesh

LEAST_TOLD_MM2 = 2.0  # the least area that a person would look at


@dataclass(frozen=True, slots=True)
class SoundFit:
    """A template that knows what sound parts are like, and what went into it.

    Attributes
    ----------
    poses
        (4, 4) template from scan, None for scans that do not fit the mesh.
    left_out
        By number of a scan: why.
    """

    template: LearnedSdf
    sound: SoundParts
    poses: tuple[Matrix | None, ...]
    left_out: dict[int, str]

    def as_json(self, scans: Sequence[str]) -> dict[str, Any]:
        """What `template fit --json` prints of it."""
        laid = (k for k, pose in enumerate(self.poses) if pose is not None)
        outvoted = dict(zip(laid, self.sound.outvoted_mm2.tolist(), strict=True))
        known = self.sound.scans > 0
        return {
            "scans": rows_of_scans(scans, self.poses, self.left_out, outvoted),
            "offset_rms_mm": float(np.sqrt(np.mean(self.sound.offset_mm[known] ** 2))),
            "spread_median_mm": float(np.median(self.sound.spread_mm[known])),
            "learned_ratio": float(known.mean()),
        }


def learn_from_scans(
    scans: Sequence[Scan],
    mesh: trimesh.Trimesh,
    *,
    seed: int = 0,
    progress: Progress = silent,
) -> SoundFit:
    """Fit the mesh, lay sound scans in it, and learn what they leave.

    Parameters
    ----------
    scans
        Of sound parts, whole or single views, each in a frame of its own.
    mesh
        The part as drawn; it stands where no scan looked, and the template's frame is its own.

    Raises
    ------
    InputError
        If there is no scan.
    AlignmentError
        If half of the scans or more do not fit the mesh.
    """
    prior = fit_fast(MeshSdf.from_mesh(mesh), seed=seed, progress=progress)
    rng = np.random.default_rng(seed)
    poses: list[np.ndarray | None] = []
    left_out: dict[int, str] = {}
    for k, scan in enumerate(scans):
        progress("lay sound scans", float(k), float(len(scans)))
        try:
            poses.append(np.array(align(scan, prior, rng=rng).template_from_scan.matrix))
        except AlignmentError as error:
            poses.append(None)
            left_out[k] = f"does not fit the mesh ({error})"
    if scans and 2 * len(left_out) >= len(scans):
        raise AlignmentError(
            f"{len(left_out)} of {len(scans)} scans do not fit the mesh: "
            f"{next(iter(left_out.values()))}"
        )
    laid = [k for k, pose in enumerate(poses) if pose is not None]
    placed = [moved(scans[k].points_mm, pose) for k in laid if (pose := poses[k]) is not None]
    progress("learn from sound scans", 0.0, 1.0)
    learned, sound = learn(prior, placed)
    progress("learn from sound scans", 1.0, 1.0)
    notes = _notes(scans, laid, left_out, sound)
    learned = replace(learned, metadata={**learned.metadata, "notes": "; ".join(notes)})
    return SoundFit(learned, sound, tuple(poses), left_out)


def _notes(
    scans: Sequence[Scan], laid: Sequence[int], left_out: dict[int, str], sound: SoundParts
) -> tuple[str, ...]:
    known = sound.scans > 0
    offset_mm = np.abs(sound.offset_mm[known])
    notes = [
        f"learned from {len(laid)} of {len(scans)} scans, over {known.mean():.0%} of the surface: "
        f"sound parts lie {np.median(offset_mm):.3f} mm off the mesh in the median, "
        f"{np.quantile(offset_mm, 0.99):.3f} mm at the most (99 %)"
    ]
    notes += [f"{scans[k].source} {why}, and was left out" for k, why in left_out.items()]
    if len(laid) < 3:
        notes.append(
            "fewer than three scans cannot outvote a defect in one of them: give three sound "
            "scans at least"
        )
    for k, area_mm2, at_mm in zip(laid, sound.outvoted_mm2, sound.outvoted_at_mm, strict=True):
        if area_mm2 >= LEAST_TOLD_MM2:
            notes.append(said_outvoted(scans[k], area_mm2, at_mm))
    return tuple(notes)
