"""The closed loop over a job's layers: print, stop, scan, repair, scan again, go on.

It knows ports only: any `Printer`, any `Scanner`. At a stop the nozzle is retracted, lifted and
parked; what is printed there starts and ends parked; then everything is restored and the job goes
on with its next line. Nothing is sent that the checker has not passed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from amrepair.align import align
from amrepair.errors import AlignmentError, LoopError
from amrepair.frames import Transform
from amrepair.repair import MIN_REPAIR_MM3, RepairPlan, Site, Stopwatch, plan_repair
from amrepair.scans import Scan, Scanner, ScanRequest
from amrepair.template.port import Template
from gcode.check import CheckedProgram, check
from gcode.errors import GcodeError
from gcode.hosts.port import Printer, PrintReport
from gcode.moves import FinishMoves, ModalState, Move, Retract, Toolpath, Travel
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job
from gcode.writer import write

MAX_ITERATIONS = 3
PARK_LIFT_MM = 10.0
# A repair that leaves more than this share of what it found has met something else than noise.
STUCK_RATIO = 0.8
# Of what was missing at a stop, this share may be left, and as much may stand out.
LEFT_RATIO = 0.08
# Names of the outermost bead: PrusaSlicer and SuperSlicer, OrcaSlicer and Bambu, Cura.
OUTER_WALLS = frozenset({"external perimeter", "overhang perimeter", "outer wall", "wall-outer"})
WALL_STEP_MM = 0.8


@dataclass(frozen=True, slots=True)
class Stop:
    """A moment at which the job rests and is looked at.

    Attributes
    ----------
    layer_index
        The layer just finished; None for the finished part, before the end script.
    line
        The first program line that is not yet sent.
    z_mm
        Height printed so far, build frame.
    """

    layer_index: int | None
    line: int
    z_mm: float

    @property
    def label(self) -> str:
        """`layer-044` or `final`."""
        return "final" if self.layer_index is None else f"layer-{self.layer_index:03d}"


@dataclass(frozen=True, slots=True)
class Look:
    """One scan at a stop, what was planned from it, and whether it was printed."""

    number: int
    stop: Stop
    scan: Scan
    plan: RepairPlan
    printed: bool
    declined: bool = False


@dataclass(frozen=True, slots=True)
class LoopReport:
    """What became of a run.

    Attributes
    ----------
    looks
        Every scan in order, with its plan.
    job_prints, repair_prints
        What the link says of each part of the job and of each repair.
    """

    looks: tuple[Look, ...]
    job_prints: tuple[PrintReport, ...]
    repair_prints: tuple[PrintReport, ...]

    def at_stop(self, stop: Stop) -> tuple[Look, ...]:
        """The looks of one stop."""
        return tuple(look for look in self.looks if look.stop == stop)

    @property
    def stops(self) -> tuple[Stop, ...]:
        """Stops in order."""
        return tuple(dict.fromkeys(look.stop for look in self.looks))

    @property
    def first_looks(self) -> tuple[Look, ...]:
        """The first look of every stop."""
        return tuple(self.at_stop(stop)[0] for stop in self.stops)

    @property
    def last_looks(self) -> tuple[Look, ...]:
        """The last look of every stop."""
        return tuple(self.at_stop(stop)[-1] for stop in self.stops)

    @property
    def within_tolerance(self) -> bool:
        """Whether every stop was left within tolerance (`left_well`)."""
        found_mm3, well = 0.0, True
        for stop in self.stops:
            looks = self.at_stop(stop)
            found_mm3 += looks[0].plan.deficit.missing_mm3
            well = well and left_well(looks, found_mm3)
        return well


def left_well(looks: Sequence[Look], found_mm3: float) -> bool:
    """Whether a stop was left within tolerance.

    Nothing that is worth a repair is left, beyond a share of what was found; and no more than
    that share stands out: a repair's own rims are not a new defect.

    Parameters
    ----------
    looks
        Those of the stop.
    found_mm3
        Volume found missing in the job so far: a later look sees earlier repairs, too.
    """
    last = looks[-1].plan
    if last.within_tolerance:
        return True
    allowed_mm3 = LEFT_RATIO * found_mm3
    missing_mm3 = sum(region.volume_mm3 for region in last.to_fill)
    excess_mm3 = sum(region.volume_mm3 for region in last.too_much)
    before_mm3 = sum(region.volume_mm3 for region in looks[0].plan.too_much)
    unmended_mm3 = min(before_mm3, excess_mm3)  # excess that was there before the repair
    return (
        missing_mm3 <= allowed_mm3
        and excess_mm3 - unmended_mm3 <= allowed_mm3
        and unmended_mm3 <= max(allowed_mm3, MIN_REPAIR_MM3)
    )


def plan_stops(job: Job, layers: Sequence[int], *, final: bool = True) -> tuple[Stop, ...]:
    """Stops after the given layers, rising, and one for the finished part.

    Raises
    ------
    LoopError
        If the job has no such layer.
    """
    stops = []
    for index in sorted(set(layers)):
        if not 0 <= index < len(job.layers):
            raise LoopError(
                f"there is no layer {index} to stop after; the job has layers 0 to "
                f"{len(job.layers) - 1}"
            )
        layer = job.layers[index]
        if index < len(job.layers) - 1 or not final:
            stops.append(Stop(index, layer.end_line, layer.z_mm))
    if final:
        stops.append(Stop(None, job.footer_start_line, job.layers[-1].z_mm))
    return tuple(stops)


def run_loop(
    job: Job,
    checked: CheckedProgram,
    printer: Printer,
    scanner: Scanner,
    site_at: Callable[[Stop], Site],
    *,
    stops: Sequence[Stop],
    max_iterations: int = MAX_ITERATIONS,
    approve: Callable[[RepairPlan], bool] = lambda plan: True,
    record: Callable[[Look], None] = lambda look: None,
    rng: np.random.Generator | None = None,
    watch: Stopwatch | None = None,
    progress: Progress = silent,
) -> LoopReport:
    """Print a job, repairing it at its stops.

    Parameters
    ----------
    job, checked
        The job as read, and the proof that it passed the checker.
    printer
        Connected. Whatever goes wrong, its heaters are told to switch off before this returns.
    site_at
        What is expected at a stop, and where it stands (`build_from_template` is required).
    approve
        Asked before every repair is sent.
    record
        Called with every look as soon as its outcome is known.

    Raises
    ------
    AmrepairError, GcodeError
        Whatever stopped the run; heaters are told to switch off first.

    Examples
    --------
    A printer that is a file, and a scanner that is one: what would be sent lies in `sent.gcode`.

    >>> from pathlib import Path
    >>> import gcode
    >>> from amrepair import Site, open_template, run_loop
    >>> from amrepair.loop import locate_part, plan_stops
    >>> from amrepair.scans import FileScanner
    >>> setup, template = gcode.load_setup(), open_template(Path("part.safetensors"))
    >>> job = gcode.read_job(Path("job.gcode").read_text(), dialect="prusa")
    >>> placed = locate_part(job, template, layer_height_mm=0.2)
    >>> printer = gcode.connect("file:sent.gcode", dialect="prusa")
    >>> printer.connect()
    >>> report = run_loop(
    ...     job,
    ...     gcode.check_program(job.program, setup),
    ...     printer,
    ...     FileScanner(Path("scan.ply")),
    ...     lambda stop: Site.of_part(template, setup, build_from_template=placed),
    ...     stops=plan_stops(job, []),
    ... )
    >>> printer.close()
    >>> [look.printed for look in report.looks]  # the scan did not change: it tries once
    [True, False]
    """
    watch = watch or Stopwatch()
    total = checked.program.text.count("\n")
    looks: list[Look] = []
    job_prints: list[PrintReport] = []
    repair_prints: list[PrintReport] = []
    sent = 0
    try:
        for stop in stops:
            with watch("print"):
                job_prints.append(_print_job(printer, checked, sent, stop.line, total, progress))
            sent = stop.line
            state = job.state_after(stop.line)
            site = site_at(stop)
            with watch("print"):
                parked = _park(printer, site.setup, state)
            for iteration in range(max_iterations + 1):
                with watch("scan"):
                    progress(f"scan {stop.label}", 0.0, 1.0)
                    scan = scanner.scan(ScanRequest(stop.label, stop.layer_index, stop.z_mm))
                    progress(f"scan {stop.label}", 1.0, 1.0)
                plan = plan_repair(
                    scan,
                    site,
                    title=f"repair of {stop.label}, pass {iteration + 1}",
                    guess=_guess(site, scanner),
                    interruption=parked,
                    strict=False,
                    rng=rng,
                    watch=watch,
                    progress=progress,
                )
                before = looks[-1] if looks and looks[-1].stop == stop else None
                wanted = plan.checked is not None and iteration < max_iterations
                here = [look for look in looks if look.stop == stop]
                wanted = wanted and not _stuck(before, plan) and not _done(here, plan)
                granted = wanted and approve(plan)
                look = Look(
                    len(looks) + 1,
                    stop,
                    scan,
                    plan,
                    printed=granted,
                    declined=wanted and not granted,
                )
                looks.append(look)
                record(look)
                if not granted or plan.checked is None:
                    break
                with watch("repair"):
                    repair_prints.append(printer.print(plan.checked, progress=progress))
                    printer.finish_moves()
            with watch("print"):
                _return(printer, site.setup, state, parked)
        with watch("print"):
            job_prints.append(_print_job(printer, checked, sent, total, total, progress))
    except BaseException:
        with contextlib.suppress(GcodeError, OSError):
            printer.heaters_off()
        raise
    return LoopReport(tuple(looks), tuple(job_prints), tuple(repair_prints))


def _print_job(
    printer: Printer,
    checked: CheckedProgram,
    first: int,
    end: int,
    of_lines: int,
    progress: Progress,
) -> PrintReport:
    """Send lines [first, end) of the job and wait until the nozzle rests."""

    def whole_job(stage: str, done: float, total: float) -> None:
        """The link tells of this part; people want to know of the job."""
        progress("print", float(first) + done, float(of_lines))

    report = printer.print(checked, lines=range(first, end), progress=whole_job)
    if not report.ok:
        raise LoopError(
            f"the job was stopped at line {report.next_line + 1} of {of_lines}; heaters are off"
        )
    printer.finish_moves()
    return report


def _guess(site: Site, scanner: Scanner) -> Transform:
    """Pose of the scan in the template, as far as calibration knows it."""
    if site.build_from_template is None:
        raise LoopError("the loop needs to know where the part stands on the bed")
    return site.build_from_template.inverse() @ scanner.build_from_scanner


def _stuck(before: Look | None, plan: RepairPlan) -> bool:
    """Whether the last repair at this stop changed next to nothing."""
    if before is None or not before.printed:
        return False
    return plan.deficit.missing_mm3 > STUCK_RATIO * before.plan.deficit.missing_mm3


def _done(looks: Sequence[Look], plan: RepairPlan) -> bool:
    """Whether what is left is a small share of what was found: more passes would only add rims."""
    if not looks:
        return False
    left_mm3 = sum(region.volume_mm3 for region in plan.to_fill)
    return left_mm3 <= LEFT_RATIO * looks[0].plan.deficit.missing_mm3


def _park(printer: Printer, setup: PrintSetup, state: ModalState) -> ModalState:
    """Retract, lift, go aside, rest; returns the machine's state there."""
    machine = setup.printer
    x, y, z = (float(v) for v in state.position_mm)
    park_z = min(max(machine.park_mm[2], z + PARK_LIFT_MM), machine.max_z_mm)
    place = (machine.park_mm[0], machine.park_mm[1], park_z)
    moves: list[Move] = []
    if machine.retraction_mm > 0:
        moves.append(Retract(machine.retraction_mm, machine.retraction_speed_mm_s))
    moves += [
        Travel(np.array([[x, y, park_z]]), machine.z_speed_mm_s),
        Travel(np.array([place]), machine.travel_speed_mm_s),
        FinishMoves(),
    ]
    _send(printer, setup, moves, state, "park for a scan", restore=False)
    return replace(
        state, position_mm=place, e_mm=0.0, absolute_xyz=True, absolute_e=False, units_mm=True
    )


def _return(printer: Printer, setup: PrintSetup, state: ModalState, parked: ModalState) -> None:
    """Back to where the job rests, everything as it was."""
    machine = setup.printer
    x, y, z = (float(v) for v in state.position_mm)
    park_z = float(parked.position_mm[2])
    moves: list[Move] = [
        Travel(np.array([[x, y, park_z]]), machine.travel_speed_mm_s),
        Travel(np.array([[x, y, z]]), machine.z_speed_mm_s),
    ]
    if machine.retraction_mm > 0:
        moves.append(Retract(-machine.retraction_mm, machine.retraction_speed_mm_s))
    # the way back starts from the park; the modes are put back once the nozzle has arrived
    _send(printer, setup, moves, parked, "back to the job", restore=False)
    arrived = replace(parked, position_mm=state.position_mm)
    _send(printer, setup, [], state, "go on with the job", restore=True, initial=arrived)


def _send(
    printer: Printer,
    setup: PrintSetup,
    moves: Sequence[Move],
    state: ModalState,
    title: str,
    *,
    restore: bool,
    initial: ModalState | None = None,
) -> None:
    """Write, check and print a short program of the loop's own."""
    program = write(Toolpath(tuple(moves)), setup, title=title, resume=state, restore=restore)
    printer.print(check(program, setup, initial=initial or state))
    printer.finish_moves()


@dataclass(frozen=True, slots=True)
class _Inset:
    """A template shrunk by `depth_mm` (`Template`, as far as an alignment asks it)."""

    whole: Template
    depth_mm: float

    @property
    def bounds_mm(self) -> Float[np.ndarray, "2 3"]:
        return self.whole.bounds_mm

    @property
    def bias_mm(self) -> float:
        return self.whole.bias_mm

    def distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return self.whole.distance(points_mm) + self.depth_mm

    def distance_and_gradient(
        self, points_mm: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        distance, gradient = self.whole.distance_and_gradient(points_mm)
        return distance + self.depth_mm, gradient

    def below_z(self, z_mm: float) -> Template:
        return self.whole.below_z(z_mm)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        points, normals = self.whole.surface_points(spacing_mm)
        return points - self.depth_mm * normals, normals

    def solid(self) -> object:
        return self.whole.solid()


def locate_part(job: Job, template: Template, *, layer_height_mm: float) -> Transform:
    """Where the part stands in a job: its template registered to the job's own beads.

    The centre lines of the outer walls lie half a bead inside the part, so they are registered to
    that level of its field (idea 12 of the design).

    Returns
    -------
    Transform
        build from template.

    Raises
    ------
    AlignmentError
        If the job's walls do not fit the template to half a layer: it is another part, another
        scale, or more than one copy.
    """
    beads = job.beads
    outer = [k for k, name in enumerate(beads.roles) if name.lower() in OUTER_WALLS]
    pick = (beads.layer >= 0) & (np.isin(beads.role, outer) if outer else True)
    start, end = beads.start_mm[pick], beads.end_mm[pick]
    height_mm = beads.height_mm[pick]
    # half of what a bead stands for: its own rounded width is a little more
    half_mm = float(np.median(0.5 * beads.section_mm2[pick] / np.maximum(height_mm, 1e-6)))
    lengths = np.linalg.norm(end - start, axis=1)
    count = np.maximum(1, np.ceil(lengths / WALL_STEP_MM).astype(np.int64))
    owner = np.repeat(np.arange(len(count)), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    points = start[owner] + (end - start)[owner] * ((step + 0.5) / count[owner])[:, None]
    points[:, 2] -= 0.5 * height_mm[owner]
    scan = Scan(points, 0.05, "build", source="the job's walls")
    found = align(scan, _Inset(template, half_mm))
    off_mm = float(
        np.median(np.abs(template.distance(found.template_from_scan.apply(points)) + half_mm))
    )
    if off_mm > 0.5 * layer_height_mm:
        raise AlignmentError(
            f"the job's walls lie {off_mm:.3f} mm off the template, the limit is half a layer "
            f"({0.5 * layer_height_mm:g} mm); is it this part, at this scale, in one copy?"
        )
    return _on_bed(found.template_from_scan.inverse(), template, layer_height_mm)


def _on_bed(placed: Transform, template: Template, layer_height_mm: float) -> Transform:
    """The pose with the part's lowest point on the bed: walls tell height the least."""
    surface, _ = template.surface_points(1.0)
    low_mm = float(placed.apply(surface)[:, 2].min())
    if abs(low_mm) > layer_height_mm:
        raise AlignmentError(
            f"the part found in the job stands {low_mm:.2f} mm off the bed, the limit is a layer "
            f"({layer_height_mm:g} mm); jobs with a raft cannot be repaired yet"
        )
    matrix = placed.matrix.copy()
    matrix[2, 3] -= low_mm
    return Transform(placed.target, placed.source, matrix)
