"""`amrepair repair`: from a scan file to a checked program."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from amrepair.cli.files import read_early
from amrepair.cli.inspect import KnownOption
from amrepair.cli.options import (
    CalibrationOption,
    SeedOption,
    SensorOption,
    UnitOption,
    calibration_named,
    numbers,
    part_pose,
    sensors,
)
from amrepair.errors import AlignmentError, AmrepairError, InputError
from gcode.cli import console
from gcode.cli.options import (
    JsonOption,
    ProcessOption,
    grid_of,
    job_of,
    program_text,
    refuse_standing,
)
from gcode.cli.owning import (
    NOBODY_NAMED,
    ChosenSetup,
    JobMaterialOption,
    JobPrinterOption,
    chosen_setup,
)
from gcode.errors import GcodeError
from gcode.profiles import DEFAULT_PROCESS

if TYPE_CHECKING:
    from amrepair.frames import Transform
    from amrepair.loop.afterwards import Afterwards
    from amrepair.reorientation import Reorientation
    from amrepair.repair import RepairPlan, Site, Stopwatch
    from amrepair.template.port import Template
    from gcode.profiles import PrintSetup
    from gcode.reader import Job

FRAMES = ("build", "unknown")
OF_JOB = "job"  # as --part-pose
# Less than this share out of reach is not worth turning the part over.
WORTH_TURNING_RATIO = 0.05
# A foot higher or lower than this is worth a word: no calibration and no squashed layer does it.
SAME_AS_BED_MM = 0.15


@console.command(
    "repair",
    "amrepair repair scan.ply --template part.safetensors -o repair.gcode "
    "--standing standing.npz --report report.html",
    "amrepair repair scan.ply --template part.stl -o repair.gcode "
    "--scan-frame unknown --part-pose 100,80,0,90",
    "amrepair repair scan.ply --template part.stl -o repair.gcode "
    "--scan-frame unknown --job job.gcode --part-pose job",
    "amrepair repair scan.ply --template part.stl -o repair.gcode --printer ender_3 "
    "--material petg --job job.gcode",
)
def repair(
    scan: Annotated[Path, typer.Argument(help="Scan of the damaged part, mm.")],
    template: Annotated[
        Path,
        typer.Option(
            "--template",
            help="Template file, or the part's mesh; with --part-pose job a folder of them, one of "
            "each part that the job prints.",
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="Repair program to write.")],
    printer: JobPrinterOption = None,
    material: JobMaterialOption = None,
    process: ProcessOption = DEFAULT_PROCESS,
    scan_frame: Annotated[
        str,
        typer.Option(
            help="build: the scan's coordinates are the bed's; unknown: they are the scanner's, "
            "and --part-pose says where the part stands."
        ),
    ] = "build",
    pose: Annotated[
        str | None,
        typer.Option(
            "--part-pose",
            help="X,Y,Z,RZ: place of the part's own origin on the bed, mm, and its turn, degrees; "
            "or job: it stands still where --job prints it.",
        ),
    ] = None,
    damage_at: Annotated[
        str | None,
        typer.Option(
            help="X,Y: where on the bed the largest damage is, roughly; for a part that looks the "
            "same in several turns."
        ),
    ] = None,
    on_fixture: Annotated[
        bool,
        typer.Option(
            "--on-fixture", help="The part stands on something: its foot is above the bed."
        ),
    ] = False,
    part_is_known: KnownOption = False,
    sensor_at: SensorOption = None,
    scan_unit: UnitOption = None,
    calibration: CalibrationOption = None,
    job: Annotated[
        Path | None, typer.Option(help="The job's G-code: repair layers lie on its layers.")
    ] = None,
    standing: Annotated[
        Path | None,
        typer.Option(
            help="Height map (.npz) to write: what stands there, for --as-built of gcode check "
            "and gcode send."
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="HTML report to write.")] = None,
    turn: Annotated[
        list[str] | None,
        typer.Option(
            help="A way in which the part may be laid on the bed (x90, x180, x270, y90, y270, "
            "z90, z180, z270, any); say it once for each. Where something is out of reach, the "
            "best is suggested."
        ),
    ] = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Make the G-code that prints only what is missing on a finished part."""
    _refuse_contradicting_words(scan_frame, pose, job)
    _refuse_plate_without_job(template, pose)
    damage_at_mm = _damage_at(damage_at, scan_frame)
    text = program_text(job) if job is not None else None
    chosen = chosen_setup(text, job or "", printer, material, process)
    setup = chosen.setup
    _ = setup.printer.head  # refused before any work
    if scan_frame == "unknown" and pose is None:
        _refuse_without_pose(job, template, setup)
    bars = console.Bars()
    frame = "build" if scan_frame == "build" else "scanner"
    cloud = read_early(scan, frame, sensors(sensor_at), scan_unit, bars)
    with console.starting():
        import numpy as np

        from amrepair.loop.afterwards import afterwards
        from amrepair.reorientation import turns_named, turns_of
        from amrepair.repair import Stopwatch, plan_repair
        from amrepair.report import report_of_plan, write_report

    turns = turns_named(turn or [])
    refuse_standing(standing)
    for path in filter(None, (output, report)):
        console.writable(path)
    told_pose = part_pose(pose) if pose is not None and pose != OF_JOB else None
    known_errors = calibration_named(calibration)
    watch = Stopwatch()
    with bars.shown():
        with bars.stage("read"):
            read_job = job_of(job, setup) if job is not None else None
        where = _Where(frame, told_pose, job, read_job, by_job=pose == OF_JOB)
        field, site, guess = _site_of(template, where, setup, watch, bars)
        site = replace(
            site,
            on_fixture=on_fixture,
            part_is_known=part_is_known,
            damage_at_mm=damage_at_mm,
            calibration=known_errors,
        )
        with _told_of_supports(where.job_with_supports):
            plan = plan_repair(
                cloud,
                site,
                title=_title(scan, chosen),
                guess=guess,
                rng=np.random.default_rng(seed),
                watch=watch,
                progress=bars,
            )
        if plan.too_much and where.job_with_supports is not None:
            console.errors.print(f"{_lays_more(where.job_with_supports)}.")
        ranked: tuple[Reorientation, ...] = ()
        if turns and plan.unreachable_mm3 > WORTH_TURNING_RATIO * plan.deficit.missing_mm3:
            with watch("turns"):
                ranked = turns_of(plan, site, turns, progress=bars)
        late = None
        if read_job is not None:
            with watch("ways"):
                command = _that_goes_on(f"{job}", output, printer, material)
                at = site.build_from_template if template.is_dir() else None
                late = afterwards(plan, read_job, field, setup, command=command, printed_at=at)
    older = _save_program(plan, output)
    if standing is not None:
        console.write_whole(standing, plan.deficit.as_built.write)
    result = _result_of(plan, output, field, setup, late, seed, watch.rounded_s())
    result |= chosen.printer_json
    if turns:
        result["turns"] = [asdict(one) for one in ranked]
    unwritten: AmrepairError | None = None
    if report is not None:
        with bars.shown(), bars.stage("report"):
            data = report_of_plan(
                plan,
                result,
                title=f"Repair of {scan.name}",
                setup=setup,
                template=field,
                scan_name=scan.name,
                late=late,
            )
            try:
                write_report(data, report)
            except AmrepairError as error:  # the program is there, and is told of first
                unwritten = error
    try:
        _say(plan, result, output, ranked, late, chosen, older=older, as_json=as_json)
    finally:
        if unwritten is not None:
            raise unwritten


def _title(scan: Path, chosen: ChosenSetup) -> str:
    """The first lines of the program: what it is, and by which profiles, where these have names."""
    from gcode.profiles.own_settings import profiles_line

    lines = [f"repair of {scan.name}"]
    lines += [profiles_line(chosen.ids)] if chosen.ids is not None else []
    if chosen.printer_from == "default":
        lines.append(NOBODY_NAMED)
    return "\n".join(lines)


def _refuse_contradicting_words(scan_frame: str, pose: str | None, job: Path | None) -> None:
    """Refuse what the words alone show to be wrong, before any file is read."""
    if scan_frame not in FRAMES:
        raise InputError(f"--scan-frame is {scan_frame!r}; it is one of {', '.join(FRAMES)}")
    if pose == OF_JOB and job is None:
        raise InputError("--part-pose job takes the place from the job; name it by --job JOB.gcode")


def _refuse_plate_without_job(template: Path, pose: str | None) -> None:
    """Refuse templates of which nobody says how they stand together."""
    if template.is_dir() and pose != OF_JOB:
        raise InputError(
            f"{template} is a folder: where its parts stand together on the bed their job tells "
            "(--job JOB.gcode --part-pose job); to repair one of them, name its own template"
        )


def _refuse_without_pose(job: Path | None, template: Path, setup: PrintSetup) -> NoReturn:
    """Refuse a scan in the scanner's frame of which nobody says where the part stands."""
    hint = pose_of_job(job, template, setup)
    raise InputError(
        "--scan-frame unknown needs --part-pose X,Y,Z,RZ: an aligned shape does not say where "
        f"the part stands on the bed; {hint}"
    )


@dataclass(frozen=True, slots=True)
class _Where:
    """What the command's words say of where the part stands.

    Attributes
    ----------
    frame
        The scan's own: `build`, or `scanner`.
    placed
        The pose that was typed, build from template; None where none was.
    path, job
        The job that was named, and as it was read; None where none was.
    by_job
        The part stands where the job printed it, with all that was printed beside it.
    """

    frame: str
    placed: Transform | None
    path: Path | None
    job: Job | None
    by_job: bool

    @property
    def job_with_supports(self) -> Path | None:
        """The job, if it lays more than the part and nobody has said that this still stands."""
        from amrepair.loop.locate import BESIDE_THE_PART, of_roles

        if self.job is None or self.by_job:
            return None
        return self.path if of_roles(self.job.beads, BESIDE_THE_PART).any() else None


def _site_of(
    template: Path, where: _Where, setup: PrintSetup, watch: Stopwatch, bars: console.Bars
) -> tuple[Template, Site, Transform | None]:
    """The template as it stands on the bed, what the scan is held against, and a guess at the pose.

    The guess is template from scan; None where alignment has to find the pose by itself.
    """
    from amrepair.library import template_files
    from amrepair.loop.looks import plan_stops
    from amrepair.loop.sites import sites
    from amrepair.repair import Site
    from amrepair.template import open_template

    grid = grid_of(where.job, setup)
    with watch("template"):
        files = template_files(template) if template.is_dir() else [template]
        fields = [open_template(path, progress=bars) for path in files]
    field, placed = fields[0], where.placed
    if where.by_job and where.job is not None:
        with watch("locate"):
            if template.is_dir():
                field, placed = _plate_of(where.job, f"{where.path}", files, fields, setup)
            else:
                field, placed = where_the_job_prints_it(where.job, f"{where.path}", field, setup)
    guess = placed.inverse() if placed is not None and where.frame == "build" else None
    if where.by_job and where.job is not None and placed is not None:
        return field, sites(where.job, field, placed, setup)(plan_stops(where.job, ())[-1]), guess
    return field, Site(field, setup, grid, placed if where.frame == "scanner" else None), guess


def _save_program(plan: RepairPlan, output: Path) -> bool:
    """Write the repair's program; without one, remove an older file. Whether one was removed."""
    if plan.checked is not None:
        console.write_text(output, plan.checked.program.text)
        return False
    older = output.exists()
    if older:  # `repair && send` must not send what another scan asked for
        output.unlink()
    return older


def _result_of(
    plan: RepairPlan,
    output: Path,
    template: Template,
    setup: PrintSetup,
    late: Afterwards | None,
    seed: int,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """The result that --json prints and that the report is made of."""
    from amrepair.report.collect import plan_result

    result = plan_result(
        plan,
        gcode=str(output) if plan.checked is not None else None,
        seed=seed,
        seconds=seconds,
        setup=setup,
        late=late,
    )
    return result | {
        "clutter_ratio": plan.registration.clutter_ratio,
        "foot_z_mm": round(_foot_z_mm(template, plan), 3),
    }


def _say(
    plan: RepairPlan,
    result: dict[str, Any],
    output: Path,
    ranked: tuple[Reorientation, ...],
    late: Afterwards | None,
    chosen: ChosenSetup,
    *,
    older: bool,
    as_json: bool,
) -> None:
    """Print the result, as JSON or in sentences, and exit with 3 where something is left."""
    from amrepair.report import plan_is_enough, summary_of_result
    from amrepair.report.text import left_out_lines

    within = plan_is_enough(plan, late)
    if as_json:
        console.show_json(result)
    else:
        for line in (
            *summary_of_result(result, within_tolerance=within),
            *_taken_for_granted(result),
            f"Printer: {chosen.printer_in_words}.",
            *(f"Left out, {line}." for line in left_out_lines(plan)),
            *_written(plan, output, within=within, older=older),
            *_suggestion(plan, ranked),
            *(f"By its job: {line}." for line in (late.told if late is not None else ())),
        ):
            console.out.print(line)
    if not within:
        raise typer.Exit(console.NOT_WITHIN_TOLERANCE)


@contextmanager
def _told_of_supports(job: Path | None) -> Iterator[None]:
    """Within it, a scan that fits nothing is told what a job lays beside the part, where it may."""
    try:
        yield
    except AlignmentError as error:
        if job is None:
            raise
        raise AlignmentError(f"{error}; {_lays_more(job)}") from error


def _lays_more(job: Path) -> str:
    """What may be beside the part, and how it is left aside."""
    return (
        f"{job} lays more than the part (skirt, brim, supports or a tower): if all of it still "
        "stands where it was printed, say --part-pose job, and it is left aside"
    )


def _damage_at(text: str | None, scan_frame: str) -> tuple[float, float] | None:
    """Where on the bed the largest damage was said to be, mm."""
    if text is None:
        return None
    if scan_frame == "build":
        raise InputError(
            "--damage-at tells the turns of a part apart whose scan is in the scanner's frame; a "
            "scan in the build frame tells them itself: leave it out, or say --scan-frame unknown"
        )
    x_mm, y_mm = numbers(text, 2, "--damage-at")
    return float(x_mm), float(y_mm)


def _written(plan: RepairPlan, output: Path, *, within: bool, older: bool) -> list[str]:
    """What became of the file that was to be written; `older`: one was there and is removed."""
    from gcode.cli.words import what_it_does

    lines = []
    if plan.checked is not None and plan.estimate is not None:
        lines.append(f"Repair: {output}: {what_it_does(plan.checked.program, plan.estimate)}.")
    elif not within:
        lines.append(f"{output} was not written: no bead can be laid.")
    if older:
        lines.append(f"The {output} that was there is removed: it was for another scan.")
    return lines


def _foot_z_mm(template: Template, plan: RepairPlan) -> float:
    """Height of the part's lowest point, build frame."""
    from amrepair.align.standing import box_on_bed

    placed = plan.build_from_template
    return float(box_on_bed(template, placed)[0, 2])


def _taken_for_granted(result: Mapping[str, Any]) -> list[str]:
    """What was left aside of the scan, and how high the part is taken to stand."""
    lines = []
    if (clutter := result["clutter_ratio"]) > 0.0:
        lines.append(
            f"{clutter:.0%} of the scan is not the part (scattered points, what it stands on, "
            "other pieces) and was left aside where it was aligned."
        )
    if abs(foot_mm := result["foot_z_mm"]) > SAME_AS_BED_MM:
        where = f"{foot_mm:.2f} mm above" if foot_mm > 0 else f"{-foot_mm:.2f} mm in"
        lines.append(
            f"The part's foot is taken to be {where} the bed; if it stands on no raft and no "
            "fixture, the pose or the scan's Z is off by as much, and so is every bead."
        )
    return lines


def pose_of_job(job: Path | None, template: Path, setup: PrintSetup) -> str:
    """What to type as the pose, where a job tells where it prints the part: a hint, no answer.

    The job cannot know whether the part was taken off meanwhile, so somebody has to say it.
    """
    from amrepair.loop.locate import is_upright
    from amrepair.template import open_template

    if job is None:
        return "with --job JOB.gcode this message tells where that job prints the part"
    bars = console.Bars()
    try:
        with bars.shown():
            copies = _copies(job_of(job, setup), open_template(template, progress=bars), setup)
    except (AmrepairError, GcodeError) as error:
        return f"{job} does not tell, either: {error}"
    if not is_upright(copies[0]):
        return (
            f"{job} prints it lying in another way than its own file has it: say --part-pose job "
            "if it lies there still"
        )
    words = [_typed(placed) for placed in copies]
    if len(words) > 1:
        return f"{job} prints {len(words)} of it, at --part-pose {' or '.join(words)}: say which"
    return f"{job} prints it at --part-pose {words[0]}: say so (or: job) if it stands there still"


def where_the_job_prints_it(
    job: Job, name: str, template: Template, setup: PrintSetup
) -> tuple[Template, Transform]:
    """The template as a job lays it on the bed, and where; the place is told for next time.

    Raises
    ------
    InputError
        If the job prints several of it.
    AlignmentError
        If the job prints another part.
    """
    from amrepair.loop.locate import is_upright, stood

    copies = _copies(job, template, setup)
    if len(copies) > 1:
        places = " or ".join(map(_typed, copies))
        raise InputError(
            f"{name} prints {len(copies)} of the part; say which by --part-pose {places}"
        )
    if is_upright(copies[0]):
        said = f"it stands at --part-pose {_typed(copies[0])}"
    else:
        said = "it lies in another way than its own file has it"
    console.errors.print(f"{name} prints the part: {said}.")
    return stood(template, copies)


def _plate_of(
    job: Job, name: str, files: Sequence[Path], fields: Sequence[Template], setup: PrintSetup
) -> tuple[Template, Transform]:
    """All that a job prints of several parts, as it stands on the bed; what it is is told."""
    from amrepair.loop.locate import locate_plate, stood_plate

    found = locate_plate(job, fields, layer_height_mm=setup.process.layer_height_mm)
    names = [files[one.which].name for one in found]
    each = ", ".join(f"{names.count(part)} of {part}" for part in dict.fromkeys(names))
    console.errors.print(f"{name} prints {each}: all of it is taken to stand where it was printed.")
    return stood_plate(fields, found)


def _copies(job: Job, template: Template, setup: PrintSetup) -> tuple[Transform, ...]:
    """Where a job prints the part."""
    from amrepair.loop.locate import locate_parts

    return locate_parts(job, template, layer_height_mm=setup.process.layer_height_mm)


def _that_goes_on(job: str, repair: Path, printer: str | None, material: str | None) -> str:
    """The command that makes the job that is left, as it is typed; its layer follows."""
    named = [("--printer", printer), ("--material", material)]
    words = ["gcode", "resume-at", job, "-o", f"{repair.with_name('rest.gcode')}"]
    words += [word for option, name in named if name is not None for word in (option, name)]
    return shlex.join(words)


def _typed(placed: Transform) -> str:
    """A pose as --part-pose takes it."""
    x, y, z = placed.translation_mm
    turn_deg = math.degrees(math.atan2(placed.matrix[1, 0], placed.matrix[0, 0]))
    return f"{x:.3f},{y:.3f},{z:.3f},{turn_deg:.2f}"


def _suggestion(plan: RepairPlan, ranked: tuple[Reorientation, ...]) -> list[str]:
    """The text that says which turns were tried and what each would reach."""
    if not ranked:
        return []
    best = ranked[0]
    now = 1.0 - plan.unreachable_mm3 / plan.deficit.missing_mm3
    if best.reachable_ratio <= now + WORTH_TURNING_RATIO:
        return [f"No allowed turn reaches clearly more than the {now:.0%} of now."]
    how = "" if best.stands else "; it does not lie there by itself and needs a fixture"
    return [
        f"Turned by {best.name} the nozzle would reach {best.reachable_ratio:.0%} of what is "
        f"missing ({now:.0%} as it stands){how}. Lay it so, scan it in the bed's frame, repair."
    ]
