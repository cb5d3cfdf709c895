"""A simulated run: slice a part, print it on an emulated printer, break it, let the loop repair it.

Everything between the G-code and the nozzle is real: the serial adapter, a pseudo-terminal, the
protocol, the emulated firmware. Only plastic and light are simulated (`world`, `scanner`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import manifold3d
import numpy as np

from amrepair.arrays import Box, Points
from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.loop import (
    Approval,
    Look,
    LoopOptions,
    LoopReport,
    Records,
    Stop,
    Tape,
    plan_stops,
    run_loop,
)
from amrepair.loop.options import UNASKED
from amrepair.loop.probing import Felt, PortFeeler, ProbeScanner
from amrepair.loop.sites import sites
from amrepair.policy import DEFAULT_POLICY, PolicyOptions
from amrepair.repair import Stopwatch
from amrepair.scans import PROBE, Scanner
from amrepair.simulate.defects import Defect, PlacedDefect, place
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.options import DEFAULT_TRUTH
from amrepair.simulate.parameters import DEFAULT_SCANNER, WorldParameters, load_world
from amrepair.simulate.scanner import SimulatedScanner
from amrepair.simulate.stage import DefectTruth, FeltStage, Stage
from amrepair.simulate.world import World
from amrepair.template.port import Template
from gcode.check import CheckedProgram, check
from gcode.firmware import EmulatedPrinterProcess, MotionBatch
from gcode.hosts import Printer, connect
from gcode.profiles import PrintSetup
from gcode.progress import Progress, silent
from gcode.reader import Job, job_for
from gcode.slicing.job import PartPlan, plan_part
from gcode.writer import write


@dataclass(frozen=True, slots=True)
class PreparedRun:
    """All that is settled before the nozzle moves.

    Attributes
    ----------
    part
        The solid in the build frame.
    defects
        What will go wrong, and where.
    stops
        When the job rests to be scanned.
    left_out
        Why what else was to go wrong does not.
    """

    setup: PrintSetup
    template: Template
    build_from_template: Transform
    part: manifold3d.Manifold
    plan: PartPlan
    job: Job
    checked: CheckedProgram
    defects: tuple[PlacedDefect, ...]
    stops: tuple[Stop, ...]
    seed: int
    left_out: tuple[str, ...] = ()

    @property
    def by_beads(self) -> bool:
        """Whether layers are judged by the job's beads: their inside is planned to be open."""
        return self.setup.process.infill_ratio < DEFAULT_TRUTH.solid_ratio


@dataclass(frozen=True, slots=True)
class SimulatedRun:
    """The result of a simulated run.

    Attributes
    ----------
    truth
        By defect, as the world knows it.
    printer_clock_s
        Time that passed for the printer.
    print_wall_s
        Time that the wall's clock spent on the same.
    temperatures
        (n, 3) printer clock s, hotend °C, bed °C as they were at every stop.
    felt
        What each look cost, where the printer's own probe touched.
    """

    prepared: PreparedRun
    report: LoopReport
    truth: tuple[DefectTruth, ...]
    printer_clock_s: float
    print_wall_s: float
    temperatures: Points
    felt: tuple[Felt, ...] = ()

    @property
    def repaired_ratio(self) -> float | None:
        """Volume newly filled where it was missing over volume missing; None without a defect."""
        missing = sum(t.missing_mm3 for t in self.truth)
        return sum(t.filled_mm3 for t in self.truth) / missing if missing > 0 else None


def place_on_bed(bounds_mm: Box, setup: PrintSetup) -> Transform:
    """Pose of a part that stands in the middle of the bed as its file has it.

    Raises
    ------
    InputError
        If it is larger than the printer.
    """
    low, high = bounds_mm
    size = high - low
    printer = setup.printer
    room = np.array([*printer.bed_size_mm, printer.max_z_mm])
    if (size > room).any():
        raise InputError(
            f"the part is {size[0]:.1f}×{size[1]:.1f}×{size[2]:.1f} mm, larger than the "
            f"{room[0]:g}×{room[1]:g}×{room[2]:g} mm of printer '{printer.id}'; "
            "use --scale fit, or a factor below 1"
        )
    middle = 0.5 * (low + high)
    shift = np.array([*(printer.bed_middle_mm - middle[:2]), -low[2]])
    return Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=shift
    )


def scale_to_fit(bounds_mm: Box, setup: PrintSetup) -> float:
    """Factor that makes a part fit the printer with a margin; never above 1."""
    size = bounds_mm[1] - bounds_mm[0]
    room = np.array([*setup.printer.bed_size_mm, setup.printer.max_z_mm])
    return float(min(1.0, (DEFAULT_TRUTH.fit_share * room / size).min()))


def prepare_run(
    template: Template,
    setup: PrintSetup,
    defects: Sequence[Defect],
    *,
    title: str,
    where_room: bool = False,
    seed: int = 0,
    watch: Stopwatch | None = None,
    progress: Progress = silent,
) -> PreparedRun:
    """Slice, write, check and read the job; find places for the defects.

    Parameters
    ----------
    where_room
        Leave out a defect that the part has no room for, but not all of them.

    Raises
    ------
    InputError
        If the part is too large, or has no room for a defect.
    GcodeError
        If it cannot be sliced, or the checker refuses its job.
    """
    watch = watch or Stopwatch()
    build_from_template = place_on_bed(template.bounds_mm, setup)
    solid: Any = template.solid()
    part = solid.transform(build_from_template.matrix[:3])
    with watch("slice job"):
        plan = plan_part(part, setup, progress=progress)
        program = write(plan.toolpath, setup, title=title)
    with watch("check job"):
        progress("check job", 0.0, 1.0)
        checked = check(program, setup)
        job = job_for(program, setup.printer)
        progress("check job", 1.0, 1.0)
    rng = np.random.default_rng([seed, 1])
    tops_mm = np.array(plan.grid.tops_mm)
    placed: list[PlacedDefect] = []
    left_out: list[str] = []
    for defect in defects:
        try:
            placed.append(place(defect, part, tops_mm, rng, beads=job.beads))
        except InputError as error:
            left_out.append(str(error))
            if not where_room or len(left_out) == len(defects):
                raise
    layers = [d.last_layer for d in placed if d.last_layer is not None and len(d.layers)]
    if not any(d.layers or d.removed or d.added for d in placed):
        layers = [len(job.layers) // 2]  # nothing will be wrong: look once on the way all the same
    return PreparedRun(
        setup=setup,
        template=template,
        build_from_template=build_from_template,
        part=part,
        plan=plan,
        job=job,
        checked=checked,
        defects=tuple(d for d in placed if d.layers or d.removed or d.added),
        stops=plan_stops(job, layers),
        seed=seed,
        left_out=tuple(left_out),
    )


def set_stage(
    run: PreparedRun,
    take_motion: Callable[[], MotionBatch],
    *,
    world: WorldParameters | None = None,
    scanner: str = DEFAULT_SCANNER,
) -> Stage:
    """An empty world with its scanner, for a printer that tells its motion.

    Parameters
    ----------
    take_motion
        Hands over what the printer did since it was last asked; flow wanders here.
    world, scanner
        As for `simulate_run`.
    """
    box = run.part.bounding_box()
    centre = (0.5 * (box[0] + box[3]), 0.5 * (box[1] + box[4]))
    told = world or load_world()
    scanner = DEFAULT_SCANNER if scanner == PROBE else scanner  # it only touches
    standing = World.of(run.setup.printer, told, centre)
    rng = np.random.default_rng([run.seed, 2])
    flow_rng = np.random.default_rng([run.seed, 3])
    return Stage(
        standing,
        defects=run.defects,
        scanner=SimulatedScanner.seeded(
            standing, told, scanner, centre_mm=centre, high_mm=float(box[5]), rng=rng
        ),
        take_motion=lambda: noisy_flow(take_motion(), flow_rng, told.flow),
        layer_height_mm=run.setup.process.layer_height_mm,
        part=run.part,
        box_mm=(
            box[0] - DEFAULT_TRUTH.margin_mm,
            box[1] - DEFAULT_TRUTH.margin_mm,
            box[3] + DEFAULT_TRUTH.margin_mm,
            box[4] + DEFAULT_TRUTH.margin_mm,
        ),
    )


def simulate_run(
    run: PreparedRun,
    *,
    wire_log: Path | None = None,
    policy: PolicyOptions = DEFAULT_POLICY,
    approval: Approval = UNASKED,
    record: Callable[[Look], None] = lambda look: None,
    begun: Callable[[Transform, Printer], Tape] = lambda pose, printer: Tape(),
    world: WorldParameters | None = None,
    scanner: str = DEFAULT_SCANNER,
    watch: Stopwatch | None = None,
    progress: Progress = silent,
) -> SimulatedRun:
    """Print the job on an emulated printer and let the loop repair what goes wrong.

    Parameters
    ----------
    begun
        Called with the scanner's calibrated pose and the printer before anything is printed;
        returns the tape that the run is recorded on, which is closed at its end.
    world, scanner
        The world's parameters (None: the shipped ones), and which of its scanners looks; `probe`:
        the printer's own probe touches.

    Raises
    ------
    AmrepairError, GcodeError
        Whatever stops the loop.
    """
    watch = watch or Stopwatch()
    profile = run.setup.printer
    built = sites(run.job, run.template, run.build_from_template, run.setup, by_beads=run.by_beads)
    temperatures: list[tuple[float, float, float]] = []
    with EmulatedPrinterProcess(profile.dialect, printer=profile) as machine:
        stage = set_stage(run, machine.take_motion, world=world, scanner=scanner)
        printer = connect(
            machine.port, dialect=profile.dialect, baud=profile.baud, wire_log=wire_log
        )
        printer.connect()
        eye, costs = _looked_at(run, stage, scanner, machine, printer, progress)
        tape = begun(eye.build_from_scanner, printer)

        def recorded(look: Look) -> None:
            now = printer.temperatures()
            temperatures.append((machine.clock_s(), now.hotend_c, now.bed_c or 0.0))
            record(look)

        try:
            report = run_loop(
                run.job,
                run.checked,
                printer,
                eye,
                built,
                stops=run.stops,
                options=LoopOptions(policy=policy, seed=run.seed),
                approval=approval,
                records=Records(recorded, tape=tape, watch=watch),
                progress=progress,
            )
        finally:
            printer.close()
            tape.close()
        stage.finish()
        printer_clock_s = machine.clock_s()
    return SimulatedRun(
        prepared=run,
        report=report,
        truth=stage.truth,
        printer_clock_s=printer_clock_s,
        print_wall_s=watch.seconds.get("print", 0.0) + watch.seconds.get("repair", 0.0),
        temperatures=np.array(temperatures, dtype=np.float64).reshape(-1, 3),
        felt=tuple(costs),
    )


def _looked_at(
    run: PreparedRun,
    stage: Stage,
    scanner: str,
    machine: EmulatedPrinterProcess,
    printer: Printer,
    progress: Progress,
) -> tuple[Scanner, list[Felt]]:
    """What looks at a stage, and what its looks cost where the printer's own probe touches."""
    if scanner != PROBE:
        return stage, []
    feeler = PortFeeler(printer, run.setup)
    probe = ProbeScanner(feeler, run.job, run.setup, clock=machine.clock_s, progress=progress)
    return FeltStage(stage, probe, machine.stand), probe.felt
