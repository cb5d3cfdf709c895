"""Repair: from one scan to a checked program that fills what is missing, read top to bottom.

`plan_repair` is the whole offline algorithm. It moves nothing and writes no file: the loop sends
what it makes, the command line writes it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.align import align
from amrepair.align.registration import Registration
from amrepair.align.standing import refuse_impossible
from amrepair.deficit import Deficit, as_built_heights, compute_deficit, worth
from amrepair.errors import AlignmentError
from amrepair.frames import Transform, unit_vectors
from amrepair.observe.rays import range_images
from amrepair.regions import AnomalyMap, Label, Region, detect
from amrepair.regions.calibration import Calibration, of_touches
from amrepair.regions.options import RegionOptions
from amrepair.regions.sites import RoundedUp
from amrepair.regions.skipped import PlannedBeads
from amrepair.scans import PROBE, Scan
from amrepair.template.laid import LaidBeads
from amrepair.template.port import Template, is_off_bed
from gcode.check import CheckedProgram, check
from gcode.errors import CheckRefusedError
from gcode.estimate import Estimate, estimate
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write

MIN_REPAIR_MM3, MIN_SKIPPED_MM3 = worth.MIN_REPAIR_MM3, worth.MIN_SKIPPED_MM3
# Nothing can take so little away; a seam or two are as much.
MIN_EXCESS_MM3 = 2.0
# Material standing out less than two layers is ploughed by the layers after it, or is a bump.
EXCESS_LAYERS = 2.0
# A planned template ends below; so near to its end its distances are not to be trusted.
PLANNED_EDGE_MM = 1.0
AS_BUILT_CELL_MM = 0.25
# Deeper inside than this, beyond a calibration's error, infill is open (or something is missing:
# that tells nothing of the pose, either).
OPEN_INFILL_MM = 0.5
# No sensor sees to the bottom of a deep cell of infill, and the nozzle has just been over it.
OPEN_CELL_MARGIN_MM = 0.0
# What lies beside the part: so far off it, and no higher than it was to be by this much.
OFF_THE_PART_MM, OVER_BESIDE_MM, ON_BED_MM = 0.3, 0.3, 0.2
# A part stands upright where its Z is the bed's to 0.05 mm over 100 mm.
LEVEL = 1e-7
# Two poses whose repairs share less than this are two different repairs.
SAME_REPAIR_RATIO = 0.8
# `detect`, or what asks another process for the same
Detector = Callable[..., AnomalyMap]


class Stopwatch:
    """Seconds by stage; stages of the same name add up."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is done inside."""
        start_s = self._clock()
        try:
            yield
        finally:
            spent_s = self._clock() - start_s
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent_s


@dataclass(frozen=True, slots=True)
class Site:
    """What is expected where: all that a scan is held against.

    Attributes
    ----------
    template
        The expected geometry at this moment (a layer's cut, or the finished part); the scan is
        aligned to it.
    planned
        Where the inside is planned to be open: the job's own beads, in the template's frame, by
        which the last millimetres are judged instead.
    setup
        Printer, material, process.
    grid
        Layers of the job: repair layers lie on them.
    build_from_template
        Where the part stands on the bed; None where the scan is in the build frame and the
        alignment itself says so.
    printed_z_mm
        Height printed so far, build frame; None for a finished part.
    allowance_mm
        What the process may leave (half a layer for a CAD template, 0 for planned beads).
    process_sigma_mm
        By how much sound parts of the process depart as a whole: a quarter of a layer.
    calibration
        What sound parts look like to this scanner; None: as the scan itself tells.
    on_fixture
        Somebody said that a finished part's foot is above the bed.
    beads
        What the job has laid so far, template frame: lines that were skipped are looked for.
    lines
        The same, all of it, build frame: a patch is laid along them.
    surface
        Points of what is expected and their normals, as `detect` asks for them: made beforehand.
    beside
        How high skirt, brim and supports stand beside the part, build frame, where the template
        does not have them; −inf where nothing does. They are none of the part, nor too much.
    laid
        The job's beads so far, build frame: what its own path puts beyond what is expected
        (heights that are rounded up, plastic that has no room) is not too much.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> site.setup.printer.id, site.grid.layer_height_mm
    ('prusa_mk3s', 0.2)
    """

    template: Template
    setup: PrintSetup
    grid: LayerGrid
    build_from_template: Transform | None = None
    printed_z_mm: float | None = None
    allowance_mm: float = 0.1
    process_sigma_mm: float = 0.05
    calibration: Calibration | None = None
    planned: Template | None = None
    on_fixture: bool = False
    beads: PlannedBeads | None = None
    lines: JobLines | None = None
    surface: tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]] | None = None
    beside: HeightField | None = None
    laid: LaidBeads | None = None
    detector: Detector = detect

    @classmethod
    def of_part(
        cls, template: Template, setup: PrintSetup, *, build_from_template: Transform | None = None
    ) -> Site:
        """A finished part on the layers of the process profile."""
        return cls(template, setup, LayerGrid.from_setup(setup), build_from_template)


@dataclass(frozen=True, slots=True)
class RepairPlan:
    """One scan's verdict, and the program that follows from it.

    Attributes
    ----------
    checked
        The program that fills what is missing; None where there is nothing that a bead can fill.
    build_from_scan
        Where the scan lies on the bed.
    scan
        What was judged, in the template's frame.
    refused
        Why the checker refused the program, where it did and the caller wanted to go on.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, plan_repair, read_scan
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> plan = plan_repair(read_scan(Path("scan.ply"), frame="build"), site, title="repair")
    >>> plan.within_tolerance, len(plan.to_fill), plan.too_much
    (False, 1, ())
    >>> round(plan.unreachable_mm3 / plan.deficit.missing_mm3, 1)  # a strip beside the cliff
    0.2
    """

    registration: Registration
    anomaly: AnomalyMap
    deficit: Deficit
    patch: PatchPlan | None
    checked: CheckedProgram | None
    estimate: Estimate | None
    build_from_scan: Transform
    layer_height_mm: float
    scan: Scan
    refused: str = ""

    @property
    def to_fill(self) -> tuple[Region, ...]:
        """Missing regions that are worth a repair: alone, or with those beside them."""
        missing = [region for region in self.deficit.regions if region.label is Label.MISSING]
        keep = worth.worth_mending(
            [r.box_mm for r in missing],
            [r.volume_mm3 for r in missing],
            [r.skipped for r in missing],
        )
        return tuple(region for region, kept in zip(missing, keep, strict=True) if kept)

    @property
    def too_much(self) -> tuple[Region, ...]:
        """Regions in excess that stand out."""
        least_mm = EXCESS_LAYERS * self.layer_height_mm
        return tuple(
            region
            for region in self.deficit.regions
            if region.label is Label.EXCESS
            and region.volume_mm3 >= MIN_EXCESS_MM3
            and region.depth_mm >= least_mm
        )

    @property
    def within_tolerance(self) -> bool:
        """No region is left that is worth a repair, or that stands out."""
        return not self.to_fill and not self.too_much

    @property
    def unreachable_mm3(self) -> float:
        """Missing volume that the nozzle cannot get to."""
        return float(sum(u.volume_mm3 for u in self.patch.unreachable)) if self.patch else 0.0


def plan_repair(
    scan: Scan,
    site: Site,
    *,
    title: str,
    guess: Transform | None = None,
    interruption: ModalState | None = None,
    strict: bool = True,
    wanted: Callable[[Region], bool] = lambda region: True,
    rng: np.random.Generator | None = None,
    watch: Stopwatch | None = None,
    progress: Progress = silent,
) -> RepairPlan:
    """Align, detect, make the deficit, slice it, write and check it.

    Parameters
    ----------
    scan
        In whatever frame its sensor has; in that of the printer's probe no pose is looked for.
    guess
        A pose (template from the scan's frame) known beforehand; None searches from any pose.
    interruption
        The state of the machine in mid-job; None makes a whole program for a standing part.
    strict
        Raise where the checker refuses the program; else return a plan without one, that says so:
        a job must not die of a patch that is never sent.
    wanted
        Which of the missing regions the program is to fill.

    Raises
    ------
    AlignmentError
        If the scan cannot be aligned, equally good poses lead to different repairs, or a finished
        part would stand in the bed, in the air or beyond the printer.
    DeficitError
        If the deficit is no valid solid.
    gcode.errors.GcodeError
        If the deficit cannot be sliced or the checker refuses the program.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, plan_repair, read_scan
    >>> site = Site.of_part(open_template(Path("part.safetensors")), gcode.load_setup())
    >>> plan = plan_repair(read_scan(Path("scan.ply"), frame="build"), site, title="repair")
    >>> "G28 X Y" in plan.checked.program.text  # Z is never homed onto a part
    True
    """
    watch, known = watch or Stopwatch(), scan.frame == PROBE
    if known:
        site = replace(site, calibration=of_touches(scan.sigma_mm, site.process_sigma_mm))
    with watch("align"), ThreadPoolExecutor(1) as beside:
        # what rays saw needs no pose, nor it them; a part of the scan has images of its own
        seen = None if _is_cut(site) else beside.submit(range_images, scan)
        if known and guess is not None:
            registration = Registration.known(guess)
        else:
            outer = _outside_open_infill(scan, site, guess)
            registration = align(outer, site.template, guess=guess, rng=rng, progress=progress)
    placed = _build_from_template(site, scan, registration)
    if site.printed_z_mm is None:
        said = site.build_from_template is not None or guess is not None
        refuse_impossible(
            site.template, placed, site.setup.printer, said=said, raised=site.on_fixture
        )
    build_from_scan = placed @ registration.template_from_scan
    with watch("detect"):
        whole = scan.moved(registration.template_from_scan)
        expected = site.planned or site.template
        moved = _in_view(_of_the_part(whole, site), site)
        anomaly = site.detector(
            moved,
            expected,
            options=RegionOptions(
                allowance_mm=site.allowance_mm, process_sigma_mm=site.process_sigma_mm
            ),
            calibration=site.calibration,
            top_z_mm=_top_of_layer(site),
            images=None
            if seen is None
            else tuple(i.moved(registration.template_from_scan) for i in seen.result()),
            surface=site.surface,
            rounded_up=_told_to_go_beyond(site, expected, placed),
            pose_is_known=known,
            progress=progress,
        )
    with watch("deficit"):
        evidence = anomaly.evidence

        def stands() -> HeightField:
            # what stands there is all that was seen, the bottoms of open cells too
            assert evidence is not None
            return as_built_heights(
                whole,
                site.template,
                evidence.spacing_mm,
                build_from_template=placed,
                printed_z_mm=site.printed_z_mm,
                cell_mm=AS_BUILT_CELL_MM,
                unseen_margin_mm=OPEN_CELL_MARGIN_MM,
                images=evidence.images,
            )

        deficit = compute_deficit(
            moved,
            expected,
            anomaly,
            build_from_template=placed,
            printed_z_mm=site.printed_z_mm,
            as_built=None if site.planned is None else stands,
            beads=site.beads,
            progress=progress,
        )
        _refuse_ambiguity(scan, site, registration, deficit)
    layer_mm = site.setup.process.layer_height_mm
    fillable = _fillable(deficit, wanted)
    if fillable.is_empty():
        return RepairPlan(
            registration, anomaly, deficit, None, None, None, build_from_scan, layer_mm, moved
        )
    with watch("deficit"):
        as_built = deficit.as_built  # made where it is needed: a clean layer has no use for it
    with watch("slice"):
        patch = slice_patch(
            fillable,
            site.setup,
            as_built=as_built,
            grid=site.grid,
            standalone=interruption is None,
            start_mm=_start_of(interruption),
            hotend_c=None if interruption is None else interruption.hotend_c,
            lines=_lines_of(site, deficit, placed),
            progress=progress,
        )
    if not patch.toolpath.extrusions:
        return RepairPlan(
            registration, anomaly, deficit, patch, None, None, build_from_scan, layer_mm, moved
        )
    with watch("check"):
        program = write(patch.toolpath, site.setup, title=title, resume=interruption, restore=False)
        try:
            checked = check(program, site.setup, as_built=as_built, initial=interruption)
        except CheckRefusedError as error:
            if strict:
                raise
            return RepairPlan(
                registration, anomaly, deficit, patch, None, None, build_from_scan, layer_mm, moved,
                refused=str(error),
            )  # fmt: skip
        cost = estimate(program, site.setup.printer)
    return RepairPlan(
        registration, anomaly, deficit, patch, checked, cost, build_from_scan, layer_mm, moved
    )


def _outside_open_infill(scan: Scan, site: Site, guess: Transform | None) -> Scan:
    """Without the points that look into sparse infill: deep inside the part, as CAD has it.

    A layer or two above the bottom's skin they are not deep; then the beads tell them.
    """
    if site.planned is None or guess is None:
        return scan
    points_mm = guess.apply(scan.points_mm)
    inside_mm = site.template.distance(points_mm)
    keep = inside_mm > -OPEN_INFILL_MM
    shallow = np.flatnonzero(keep & (inside_mm < -site.grid.layer_height_mm))
    as_planned_mm = np.abs(site.planned.distance(points_mm[shallow]))
    keep[shallow] = as_planned_mm > 0.5 * np.abs(inside_mm[shallow])
    return scan.subset(keep)


def _is_cut(site: Site) -> bool:
    """Whether what is expected ends in mid-air, and not at the bed."""
    return site.planned is not None and is_off_bed(site.planned)


def _of_the_part(scan: Scan, site: Site) -> Scan:
    """Without what the job laid beside the part."""
    if site.beside is None or site.build_from_template is None:
        return scan
    placed = site.build_from_template
    height_mm = scan.points_mm @ placed.rotation[2] + placed.translation_mm[2]
    # what lies nearly on the bed is taken for it anyhow
    over_bed = (height_mm > ON_BED_MM) & (height_mm < site.beside.top_mm + OVER_BESIDE_MM)
    low = np.flatnonzero(over_bed)
    xy_mm = placed.apply(scan.points_mm[low])[:, :2]
    high_mm = site.beside.sample(xy_mm, outside_mm=-np.inf) + OVER_BESIDE_MM
    low = low[height_mm[low] < high_mm]
    if not len(low):
        return scan
    keep = np.ones(len(scan), dtype=bool)
    keep[low] = site.template.distance(scan.points_mm[low]) < OFF_THE_PART_MM
    return scan.subset(keep)


def _told_to_go_beyond(site: Site, expected: Template, placed: Transform) -> RoundedUp | None:
    """How far out the job itself goes, as `detect` asks it; with no more than it needs."""
    if site.laid is None:
        return None
    return partial(_laid_beyond, site.laid, expected, 0.5 * site.allowance_mm, placed)


def _laid_beyond(
    laid: LaidBeads,
    expected: Template,
    least_mm: float,
    placed: Transform,
    place_mm: Float[np.ndarray, "s 3"],
    deviation_mm: Float[np.ndarray, " s"],
) -> Float[np.ndarray, " s"]:
    """(s,) how far out of what is expected the job's own path may put each place."""
    beyond_mm = np.zeros(len(place_mm))
    some = np.flatnonzero(deviation_mm > least_mm)
    if len(some):
        normal = unit_vectors(expected.distance_and_gradient(place_mm[some])[1])
        offset_mm, tolerance_mm = laid.expected_offset_mm(
            placed.apply(place_mm[some]), placed.rotate(normal), deviation_mm[some]
        )
        beyond_mm[some] = offset_mm + tolerance_mm
    return np.maximum(beyond_mm, 0.0)


def _in_view(scan: Scan, site: Site) -> Scan:
    """What a planned template can judge: its own last millimetres; all of it otherwise."""
    if not _is_cut(site):
        return scan
    assert site.planned is not None
    low_mm = float(site.planned.bounds_mm[0, 2]) + PLANNED_EDGE_MM
    return scan.subset(scan.points_mm[:, 2] > low_mm)


def _top_of_layer(site: Site) -> float | None:
    """Height of the layer just printed, template frame; None where none is, or it is tilted."""
    placed = site.build_from_template
    if placed is None or site.printed_z_mm is None or abs(placed.matrix[2, 2] - 1.0) > LEVEL:
        return None
    return site.printed_z_mm - float(placed.translation_mm[2])


def _build_from_template(site: Site, scan: Scan, registration: Registration) -> Transform:
    """Where the part stands: as told, or as seen by a scan that is in the build frame."""
    if site.build_from_template is not None:
        return site.build_from_template
    if scan.frame != "build":
        raise AlignmentError(
            f"the scan {scan.source} is in frame '{scan.frame}' and nobody said where the part "
            "stands on the bed; give its pose, since an aligned shape does not tell"
        )
    return registration.template_from_scan.inverse()


def _refuse_ambiguity(scan: Scan, site: Site, registration: Registration, deficit: Deficit) -> None:
    """Refuse a pose that fits no better than another which would repair something else."""
    if site.build_from_template is None or deficit.missing.is_empty():
        return  # the scan is in the build frame: every pose that fits puts the repair there
    for other in registration.symmetric_alternatives:
        # the same scanned hole, seen in the template through the other pose
        motion = (
            site.build_from_template
            @ other
            @ registration.template_from_scan.inverse()
            @ site.build_from_template.inverse()
        )
        turned = deficit.missing.transform(motion.matrix[:3])
        shared_mm3 = (turned ^ deficit.missing).volume()
        if shared_mm3 < SAME_REPAIR_RATIO * deficit.missing_mm3:
            raise AlignmentError(
                f"the scan {scan.source} fits its template in "
                f"{1 + len(registration.symmetric_alternatives)} poses equally well, and they "
                "would repair different places; scan in the build frame or give a better pose"
            )


def _fillable(deficit: Deficit, wanted: Callable[[Region], bool]) -> manifold3d.Manifold:
    """The missing pieces that are worth a repair, and wanted in it."""
    pieces = deficit.missing.decompose()
    boxes = [np.asarray(piece.bounding_box()).reshape(2, 3) for piece in pieces]
    regions = [region for region in deficit.regions if region.label is Label.MISSING]
    of_piece = [_region_of(piece, regions) if regions else None for piece in pieces]
    lines = [region is not None and region.skipped for region in of_piece]
    keep = worth.worth_mending(boxes, [piece.volume() for piece in pieces], lines)
    filled = [
        piece
        for piece, region, kept in zip(pieces, of_piece, keep, strict=True)
        if kept and (region is None or wanted(region))
    ]
    if not filled:
        return manifold3d.Manifold()
    return manifold3d.Manifold.batch_boolean(filled, manifold3d.OpType.Add)


def _lines_of(site: Site, deficit: Deficit, placed: Transform) -> JobLines | None:
    """The job's lines, and which stretches of them the deficit says are gone, build frame."""
    if site.lines is None or deficit.gone is None:
        return site.lines
    ends = [placed.apply(ends_mm) for ends_mm in (deficit.gone.start_mm, deficit.gone.end_mm)]
    return replace(site.lines, gone_mm=np.stack(ends, axis=1))


def _region_of(piece: manifold3d.Manifold, regions: list[Region]) -> Region:
    """The region that a piece is: the one whose box is nearest to its own."""
    box = np.asarray(piece.bounding_box()).reshape(2, 3)
    off_mm = [float(np.abs(np.asarray(region.box_mm) - box).max()) for region in regions]
    return regions[int(np.argmin(off_mm))]


def _start_of(interruption: ModalState | None) -> tuple[float, float, float] | None:
    if interruption is None:
        return None
    x, y, z = interruption.position_mm
    return (float(x), float(y), float(z))


def program_of(plan: RepairPlan) -> Program | None:
    """The text of a plan's program."""
    return plan.checked.program if plan.checked is not None else None
