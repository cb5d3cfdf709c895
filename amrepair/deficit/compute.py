"""The deficit: template minus as-built part, with a tolerance, as solids in the build frame.

Simply subtracting the scanned part from the template would leave a thin shell of noise all around.
So the template is eroded by the tolerance τ, the as-built part is subtracted from that, and what is
left is grown back and clipped to template minus as-built. Missing material thinner than τ counts
only where detection found it significant. Space counts as empty only where a ray crossed it or
scanned surface bounds it.
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
from amrepair.deficit.options import DEFAULT_DEFICIT, DeficitOptions
from amrepair.deficit.solids import pieces_of
from amrepair.deficit.walls import as_low_as_seen, with_rims, with_sharp_walls
from amrepair.field.as_built import Evidence, with_stubs
from amrepair.field.groups import touching_mm
from amrepair.frames import Transform, box_of, boxes_meet, in_box, nearest_box
from amrepair.regions import AnomalyMap, DefectType, Label, Region, detect
from amrepair.regions.options import SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.regions.regions import classify
from amrepair.regions.skipped import skipped
from amrepair.scans import Scan
from amrepair.template.port import Template
from amrepair.template.surface import triangle_areas_normals
from gcode.meshes import box_of_solid, mesh_of
from gcode.progress import Progress, silent
from gcode.surfaces import HeightField

# Of a wall's piece both sides are the template's surface, but for its ends; of a film half is.
SURFACE_OF_WALL = 0.75


class Standing:
    """The heights of what stands on the bed, computed when first asked for.

    A layer without defects never asks for them. Once they are made, what they were made from is
    released.
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
    """How to compute what stands on the bed, where the caller knows more than scan and solids.

    Attributes
    ----------
    seen
        Makes the heights that the scan shows.
    standing
        Makes what stands there from those heights and the missing solid, build frame
        (`standing_in_job`).
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
        One for each piece, with boxes in the build frame; missing before excess, the largest
        first. Pieces too small for a bead are listed too (`below_bead`), and are in the solids.
    tolerance_mm
        τ, by which the template was eroded.
    unseen_area_mm2
        Area of the template's surface that no sensor saw.
    stands
        Makes `as_built` when that is first asked for.
    gone
        Stretches of the job's lines that are missing, template frame.
    options
        The options that were used.
    """

    missing: manifold3d.Manifold
    excess: manifold3d.Manifold
    regions: tuple[Region, ...]
    tolerance_mm: float
    unseen_area_mm2: float
    stands: Standing
    gone: PlannedBeads | None = None
    options: DeficitOptions = DEFAULT_DEFICIT

    @property
    def as_built(self) -> HeightField:
        """The heights of what stands on the bed; unseen columns count as solid (`heights`)."""
        return self.stands()

    @property
    def missing_mm3(self) -> float:
        """The missing volume."""
        return float(self.missing.volume())

    @property
    def excess_mm3(self) -> float:
        """The volume of what is too much."""
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
    options: DeficitOptions = DEFAULT_DEFICIT,
    progress: Progress = silent,
) -> Deficit:
    """Make solids of what is missing and of what is too much.

    Parameters
    ----------
    scan
        In the template's frame.
    anomaly
        The result of `detect` for this scan; None runs `detect` with its defaults.
    build_from_template
        Where the part stands on the bed.
    printed_z_mm
        The height printed so far, build frame; None takes the template's own top.
    as_built
        How to compute what stands on the bed; None computes it from the scan and the solids.
    beads
        The job's topmost lines, template frame. Lines that rays went through are missing, however
        near to the template's surface they lie.

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
    """The evidence, completed around lines of the job that are missing; and those lines."""
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
    """Join pieces, template frame, to one solid in the build frame; possibly empty."""
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
    """The heights of what stands: the scan's, with sharper walls from solids and points."""
    expected = build_from_template.solid(template.solid())
    solid, lost_mm, designed_mm = standing_heights(seen, expected, missing, excess, options.heights)
    points_mm, spacing_mm = build_from_template.apply(scan.points_mm), evidence.spacing_mm
    sharp = with_sharp_walls(
        solid, lost_mm > 0, points_mm, scan.sigma_mm, options.walls, deviation_mm=deviation_mm
    )
    known = with_what_stands_out(sharp, points_mm, scan.sigma_mm, spacing_mm, options.heights)
    whole = with_rims(known, lost_mm, designed_mm, spacing_mm, options.walls)
    return as_low_as_seen(
        whole, lost_mm > 0, points_mm, scan.sigma_mm, spacing_mm, deviation_mm, options.walls
    )


def measured_regions(anomaly: AnomalyMap, deficit: Deficit) -> tuple[Region, ...]:
    """The regions that `detect` found, with volumes and boxes measured on the solids.

    Area times depth on the scanned surface underestimates a volume: of a deep notch it gives 0.7.
    Depths remain the largest deviation, and a region of which no solid was made remains as it was.
    The largest region comes first; boxes are in the template frame.

    Parameters
    ----------
    deficit
        Of the same anomaly, computed with the template's frame as build frame.
    """
    pieces: dict[int, list[Region]] = {k: [] for k in range(-1, len(anomaly.regions))}
    assert anomaly.evidence is not None
    # pieces so near to each other are one defect
    beside_mm = np.outer((-1.0, 1.0), np.full(3, touching_mm(anomaly.evidence.surfels.cell_mm)))
    for piece in deficit.regions:
        near = [
            k
            for k, region in enumerate(anomaly.regions)
            if region.label is piece.label and boxes_meet(region.box_mm + beside_mm, piece.box_mm)
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
    """A rough volume of what is missing, mm³: area times depth of the labelled surfels."""
    s = evidence.surfels
    mine = np.asarray(anomaly.surfel_label) == int(Label.MISSING)
    return float(np.abs(s.deviation_mm[mine]).sum()) * s.cell_mm**2


def _region(piece: manifold3d.Manifold, sought: Sought, build_from_template: Transform) -> Region:
    """Measure one piece; its box is in the build frame."""
    label, template = sought.label, sought.template
    bounds = box_of_solid(piece)
    volume = float(piece.volume())
    area = float(piece.surface_area()) / 2
    depth = min(float(np.ptp(bounds, axis=0).min()), 2 * volume / max(area, 1e-9))
    kind = classify(label, depth, area, bounds, template)
    if kind is DefectType.UNDER_EXTRUSION and _has_both_sides(piece, template, depth):
        kind = classify(label, np.inf, area, bounds, template)
    return Region(
        label,
        kind,
        volume,
        area,
        depth,
        box_of_solid(build_from_template.solid(piece)),
        below_bead=volume < sought.options.bead_mm3,
        skipped=_is_skipped(bounds, sought.gone),
    )


def _has_both_sides(piece: manifold3d.Manifold, template: Template, thick_mm: float) -> bool:
    """Whether a piece goes right through a wall, as nothing does that was laid too thin.

    Nearly all of its surface is the template's then; of a film one side is.
    """
    vertices_mm, faces = mesh_of(piece)
    area, _ = triangle_areas_normals(vertices_mm, faces)
    on = np.abs(template.distance(vertices_mm[faces].mean(axis=1))) < thick_mm / 4
    return bool(area[on].sum() > SURFACE_OF_WALL * area.sum())


def _is_skipped(box_mm: Float[np.ndarray, "2 3"], gone: PlannedBeads | None) -> bool:
    """Whether the middle of a missing line lies in a piece's box, template frame."""
    if gone is None:
        return False
    middle = 0.5 * (gone.start_mm + gone.end_mm)
    middle[:, 2] -= 0.5 * gone.height_mm
    return bool(in_box(middle, *box_mm).any())


def _unseen_area(anomaly: AnomalyMap) -> float:
    """The area of the unseen template points, mm²."""
    return float((anomaly.template_label == int(Label.UNSEEN)).sum()) * anomaly.each_mm2
