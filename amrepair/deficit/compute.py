"""The deficit: template minus as-built, with a tolerance, as solids in the build frame.

Template minus scan leaves a thin connected shell of noise. So the distance field of the template
is eroded by τ, the as-built part is subtracted, and what is left is grown back and clipped to
template minus as-built. What is thinner than τ counts only where detection's
averages say so. Empty space counts only where a ray crossed it or scanned surface bounds it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Values
from amrepair.deficit.boxes import Sought
from amrepair.deficit.heights import as_built_heights, standing_heights, with_what_stands_out
from amrepair.deficit.options import USUAL_DEFICIT, DeficitOptions
from amrepair.deficit.solids import pieces_of
from amrepair.deficit.walls import with_rims, with_sharp_walls
from amrepair.field.as_built import Evidence, with_stubs
from amrepair.field.groups import area_per_point
from amrepair.frames import Transform, box_of, boxes_meet, in_box, nearest_box
from amrepair.regions import AnomalyMap, Label, Region, detect
from amrepair.regions.options import SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.regions.regions import classify
from amrepair.regions.skipped import skipped
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.meshes import box_of_solid
from gcode.progress import Progress, silent
from gcode.surfaces import HeightField


class Standing:
    """Heights that are made when they are first asked for: a clean layer needs none.

    What makes them is let go of once it has.
    """

    def __init__(self, make: Callable[[], HeightField]) -> None:
        self._make: Callable[[], HeightField] | None = make
        self._made: HeightField | None = None

    def __call__(self) -> HeightField:
        """The heights."""
        if self._made is None:
            assert self._make is not None
            self._made, self._make = self._make(), None
        return self._made


@dataclass(frozen=True, slots=True)
class AsBuilt:
    """How what stands on the bed is made, where the caller knows more than one scan and solids.

    Attributes
    ----------
    seen
        Makes the scan's heights, which wait for no solid.
    standing
        Makes of them and of what is missing (build frame) what stands there (`standing_in_job`).
    """

    seen: Callable[[], HeightField]
    standing: Callable[[HeightField, manifold3d.Manifold], HeightField]


@dataclass(frozen=True, slots=True)
class Deficit:
    """What is missing and what is too much, build frame.

    Attributes
    ----------
    missing, excess
        Watertight `manifold3d.Manifold`s, possibly empty.
    regions
        One per defect, boxes in the build frame, missing first, largest first. Those below what
        one bead can fix are in the list (`below_bead`) and in the solids.
    tolerance_mm
        τ: the erosion that was used.
    unseen_area_mm2
        Template surface that nothing is known of.
    stands
        Makes `as_built`, when that is first asked for.
    gone
        Stretches of planned lines that are not there, template frame.
    options
        That it was made with.
    """

    missing: manifold3d.Manifold
    excess: manifold3d.Manifold
    regions: tuple[Region, ...]
    tolerance_mm: float
    unseen_area_mm2: float
    stands: Standing
    gone: PlannedBeads | None = None
    options: DeficitOptions = USUAL_DEFICIT

    @property
    def as_built(self) -> HeightField:
        """What stands on the bed; unseen cells are solid as `as_built_heights` says."""
        return self.stands()

    @property
    def missing_mm3(self) -> float:
        """Volume missing."""
        return float(self.missing.volume())

    @property
    def excess_mm3(self) -> float:
        """Volume in excess."""
        return float(self.excess.volume())


def compute_deficit(
    scan: Scan,
    template: Template,
    anomaly: AnomalyMap | None = None,
    *,
    build_from_template: Transform,
    printed_z_mm: float | None = None,
    as_built: AsBuilt | None = None,
    beads: PlannedBeads | None = None,
    options: DeficitOptions = USUAL_DEFICIT,
    progress: Progress = silent,
) -> Deficit:
    """Solids of what is missing and in excess.

    Parameters
    ----------
    scan
        In the template's frame.
    anomaly
        What `detect` said about this scan; None runs it with its defaults.
    build_from_template
        Where the part stands on the bed.
    printed_z_mm
        Height printed so far, build frame; None is the template's own top.
    as_built
        What makes what stands on the bed; None has it made of scan and solids.
    beads
        What the job has laid there, template frame: lines of it that rays went through are missing,
        however near to the template's surface they lie.

    Raises
    ------
    DeficitError
        If a defect's surface cannot be made a valid solid.
    """
    if anomaly is None or anomaly.evidence is None or anomaly.surfel_label is None:
        anomaly = detect(scan, template)
    template = anomaly.expected(template)
    evidence, lines = _evidence_of(scan, template, anomaly, beads, options.skipped)
    deviation_mm = anomaly.deviation_mm
    see = as_built.seen if as_built is not None else partial(
        as_built_heights, scan, template, evidence.spacing_mm, images=evidence.images,
        build_from_template=build_from_template, printed_z_mm=printed_z_mm,
        options=options.heights,
    )  # fmt: skip
    sought = [
        Sought(template, evidence, anomaly, label, gone, options)
        for label, gone in ((Label.MISSING, lines), (Label.EXCESS, None))
    ]
    with ThreadPoolExecutor(1) as beside:  # heights of the scan wait for no solid
        many = _roughly_missing(anomaly, evidence) > options.early_mm3
        early = beside.submit(see) if many else None
        solids = [pieces_of(each, progress) for each in sought]
    regions = [
        _region(piece, each, build_from_template)
        for each, pieces in zip(sought, solids, strict=True)
        for piece in pieces
    ]
    missing, excess = (_in_build_frame(pieces, build_from_template) for pieces in solids)

    def stands() -> HeightField:
        seen = see() if early is None else early.result()
        if as_built is not None:
            return as_built.standing(seen, missing)
        parts = missing, excess
        return _standing(
            seen, scan, template, build_from_template, *parts, evidence, deviation_mm, options
        )

    return Deficit(
        missing=missing,
        excess=excess,
        regions=tuple(sorted(regions, key=lambda r: (int(r.label), -r.volume_mm3))),
        tolerance_mm=anomaly.threshold_mm,
        unseen_area_mm2=_unseen_area(anomaly),
        stands=Standing(stands),
        gone=lines,
        options=options,
    )


def _evidence_of(
    scan: Scan,
    template: Template,
    anomaly: AnomalyMap,
    beads: PlannedBeads | None,
    options: SkippedOptions,
) -> tuple[Evidence, PlannedBeads | None]:
    """What is known of space, also around lines of the job that are gone; and those lines."""
    evidence = anomaly.evidence
    assert evidence is not None
    if beads is None or not len(beads.width_mm):
        return evidence, None
    over_mm = anomaly.told_over_mm(float(beads.height_mm.max()))
    lines = skipped(beads, scan, evidence, template, options, over_mm=over_mm)
    if not len(lines.width_mm):
        return evidence, None
    labelled = np.asarray(anomaly.surfel_label) != int(Label.OK)
    about = with_stubs(evidence, lines.samples_mm(options.sample_step_mm), labelled)
    return about, lines


def _in_build_frame(
    pieces: Sequence[manifold3d.Manifold], build_from_template: Transform
) -> manifold3d.Manifold:
    """Pieces, template frame, as one solid that stands on the bed; possibly empty."""
    whole = manifold3d.Manifold.batch_boolean(list(pieces), manifold3d.OpType.Add)
    return build_from_template.solid(whole)


def _standing(
    seen: HeightField,
    scan: Scan,
    template: Template,
    build_from_template: Transform,
    missing: manifold3d.Manifold,
    excess: manifold3d.Manifold,
    evidence: Evidence,
    deviation_mm: Values,
    options: DeficitOptions,
) -> HeightField:
    """What stands on the bed: the scan's heights, with the solids' walls and the points' own."""
    expected = build_from_template.solid(template.solid())
    solid, lost_mm, designed_mm = standing_heights(seen, expected, missing, excess, options.heights)
    points_mm, spacing_mm = build_from_template.apply(scan.points_mm), evidence.spacing_mm
    sharp = with_sharp_walls(
        solid, lost_mm > 0, points_mm, scan.sigma_mm, options.walls, deviation_mm=deviation_mm
    )
    known = with_what_stands_out(sharp, points_mm, scan.sigma_mm, spacing_mm, options.heights)
    return with_rims(known, lost_mm, designed_mm, spacing_mm, options.walls)


def measured_regions(anomaly: AnomalyMap, deficit: Deficit) -> tuple[Region, ...]:
    """What `detect` found, measured by solids; the largest first, boxes in the template frame.

    A surface alone tells little of how much is missing over it: of a deep notch 0.7. Depths stay
    the largest deviation; what no solid was made of stays as its surface has it.

    Parameters
    ----------
    deficit
        Of the same anomaly, with a build frame that is the template's.
    """
    pieces: dict[int, list[Region]] = {k: [] for k in range(-1, len(anomaly.regions))}
    for piece in deficit.regions:
        near = [
            k
            for k, region in enumerate(anomaly.regions)
            if region.label is piece.label and boxes_meet(region.box_mm, piece.box_mm)
        ]
        known = [anomaly.regions[k].box_mm for k in near]
        pieces[near[nearest_box(known, piece.box_mm)] if near else -1].append(piece)
    found = pieces[-1]
    for k, region in enumerate(anomaly.regions):
        own = pieces[k]
        if not own:
            found.append(region)
            continue
        found.append(
            replace(
                own[0],
                volume_mm3=sum(piece.volume_mm3 for piece in own),
                area_mm2=sum(piece.area_mm2 for piece in own),
                box_mm=box_of(np.concatenate([piece.box_mm for piece in own])),
                depth_mm=region.depth_mm,
                p_value=region.p_value,
            )
        )
    return tuple(sorted(found, key=lambda r: -r.volume_mm3))


def _roughly_missing(anomaly: AnomalyMap, evidence: Evidence) -> float:
    """Volume under the surfels that are labelled missing, mm³."""
    s = evidence.surfels
    mine = np.asarray(anomaly.surfel_label) == int(Label.MISSING)
    return float(np.abs(s.deviation_mm[mine]).sum()) * s.cell_mm**2


def _region(piece: manifold3d.Manifold, sought: Sought, build_from_template: Transform) -> Region:
    """Measures of one piece; its box in the build frame."""
    label, template = sought.label, sought.template
    bounds = box_of_solid(piece)
    volume = float(piece.volume())
    area = float(piece.surface_area()) / 2
    depth = min(float(np.ptp(bounds, axis=0).min()), 2 * volume / max(area, 1e-9))
    return Region(
        label,
        classify(label, depth, area, bounds, template),
        volume,
        area,
        depth,
        box_of_solid(build_from_template.solid(piece)),
        below_bead=volume < sought.options.bead_mm3,
        skipped=_is_skipped(bounds, sought.gone),
    )


def _is_skipped(box_mm: Float[np.ndarray, "2 3"], gone: PlannedBeads | None) -> bool:
    """Whether the middle of a line that is gone lies in a piece's box, template frame."""
    if gone is None:
        return False
    middle = 0.5 * (gone.start_mm + gone.end_mm)
    middle[:, 2] -= 0.5 * gone.height_mm
    return bool(in_box(middle, *box_mm).any())


def _unseen_area(anomaly: AnomalyMap) -> float:
    """Area of the unseen template points, from their mean spacing."""
    count = int((anomaly.template_label == int(Label.UNSEEN)).sum())
    return count * area_per_point(anomaly.template_points_mm)
