"""A library of templates: which of several parts a scan shows, found by aligning it to each.

The pose and the part are found together; the paper has one normal class for each model. What is
not clear is refused with the two that fit alike. It judges no defects.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from amrepair.align import Registration, align
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import diagonal
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.progress import Progress, silent

LIBRARY_SUFFIXES = (".safetensors", ".stl", ".obj", ".3mf", ".ply")
# Below this the two best parts fit nearly alike, and which it is would be a guess.
LEAST_CONFIDENCE = 0.2
# Views of the right part have up to 0.2, since half of it is unseen; of other parts 0.27 and more.
MOST_MISFIT = 0.25
LIBRARY_POINTS = 20_000
# Distances count up to this share of the part's diagonal: a lost piece is not another part.
LOST_PIECE_RATIO = 0.02
# Surface that the scan does not show says less than points that the part does not explain: a
# single view shows half of it.
UNSEEN_WEIGHT = 0.25


@dataclass(frozen=True, slots=True)
class Candidate:
    """A part of the library and how a scan fits it.

    Attributes
    ----------
    misfit_ratio
        0 (every point on the part, every part of it seen) to 1; 1 where nothing could be aligned.
    reason
        Why it could not be aligned, or nothing.
    """

    name: str
    misfit_ratio: float
    registration: Registration | None
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Recognition:
    """Which part it is.

    Attributes
    ----------
    confidence
        1 − misfit of the best / misfit of the next: 0 where both fit alike, near 1 where no other
        part comes close; 1 where there is no other.
    candidates
        All parts, best first.
    """

    name: str
    template: Template
    registration: Registration
    confidence: float
    candidates: tuple[Candidate, ...]


def template_files(folder: Path) -> list[Path]:
    """Templates and meshes in a folder, sorted by name; a template goes before its own mesh.

    Raises
    ------
    InputError
        If there are none.
    """
    found: dict[str, Path] = {}
    for suffix in LIBRARY_SUFFIXES:
        for path in sorted(folder.iterdir()):
            if path.suffix.lower() == suffix and not path.name.startswith("."):
                found.setdefault(path.stem, path)
    if not found:
        raise InputError(
            f"the folder {folder} holds no template ({', '.join(LIBRARY_SUFFIXES)}); fit some with "
            "'amrepair template fit'"
        )
    return [found[name] for name in sorted(found)]


def recognise(
    scan: Scan,
    library: Sequence[tuple[str, Callable[[], Template]]],
    *,
    method: str = "robust",
    seed: int = 0,
    progress: Progress = silent,
) -> Recognition:
    """Align a scan to every part and choose.

    Parameters
    ----------
    library
        Names, and how to open each part; at least one.

    Raises
    ------
    AlignmentError
        If no part fits, or two fit alike.
    """
    if not library:
        raise InputError("the library holds no part; give at least one template")
    rated: list[Candidate] = []
    opened: dict[str, Template] = {}
    for k, (name, open_part) in enumerate(library):
        progress("align", float(k), float(len(library)))
        opened[name] = open_part()

        def within(stage: str, done: float, total: float, before: float = float(k)) -> None:
            progress(stage, before + done / total, float(len(library)))

        rng = np.random.default_rng(seed)
        try:
            found = align(scan, opened[name], method=method, rng=rng, progress=within)
        except AlignmentError as error:
            rated.append(Candidate(name, 1.0, None, str(error)))
            continue
        rated.append(Candidate(name, misfit(scan, opened[name], found), found))
    progress("align", float(len(library)), float(len(library)))
    rated.sort(key=lambda c: c.misfit_ratio)
    best = rated[0]
    if best.registration is None:
        reasons = "; ".join(f"{c.name}: {c.reason}" for c in rated[:3])
        raise AlignmentError(
            f"the scan {scan.source} fits none of the {len(rated)} parts of the library ({reasons})"
        )
    least, part_ratio = best.misfit_ratio, 1.0 - best.registration.clutter_ratio
    if part_ratio < 1.0:
        least = misfit(scan, opened[best.name], best.registration, part_ratio=part_ratio)
    if least > MOST_MISFIT:
        raise AlignmentError(
            f"the scan {scan.source} fits none of the {len(rated)} parts of the library well: "
            f"nearest is {best.name}, with a misfit of {least:.2f} (at most "
            f"{MOST_MISFIT:g}); if it is that part, name its template"
        )
    confidence = 1.0
    if len(rated) > 1:
        confidence = 1.0 - best.misfit_ratio / max(rated[1].misfit_ratio, 1e-12)
        if confidence < LEAST_CONFIDENCE:
            raise AlignmentError(
                f"the scan {scan.source} fits {best.name} and {rated[1].name} alike (confidence "
                f"{confidence:.2f}, at least {LEAST_CONFIDENCE:g} is needed); name the template, "
                "or scan from more sides"
            )
    return Recognition(
        best.name, opened[best.name], best.registration, float(confidence), tuple(rated)
    )


def misfit(
    scan: Scan, template: Template, found: Registration, *, part_ratio: float = 1.0
) -> float:
    """0…1: capped distance of the points to the part, and of the part to the points.

    `part_ratio` is the share of the points that are counted, the nearest ones.
    """
    step = max(1, len(scan) // LIBRARY_POINTS)
    placed = found.template_from_scan.apply(scan.points_mm[::step])
    diagonal_mm = diagonal(template.bounds_mm)
    cap_mm = LOST_PIECE_RATIO * diagonal_mm
    distance = np.sort(np.minimum(np.abs(template.distance(placed)), cap_mm))
    off = float(distance[: max(1, round(part_ratio * len(distance)))].mean())
    surface = template.surface_points(diagonal_mm / 60.0)[0]
    gap = np.asarray(cKDTree(placed).query(surface, distance_upper_bound=2 * cap_mm)[0])
    unseen = float(np.minimum(gap, cap_mm).mean())
    return (off + UNSEEN_WEIGHT * unseen) / cap_mm / (1.0 + UNSEEN_WEIGHT)
