"""The commands of `gcode`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console, importing
from gcode.cli.judging import LeaveHeatersOption, refusal_json, tell_warnings, warnings_json
from gcode.cli.options import (
    JsonOption,
    MaterialOption,
    OwnMaterialOption,
    PrinterOption,
    ProcessOption,
    grid_of,
    plain_text,
    program_text,
)
from gcode.cli.resuming import resume_at_command
from gcode.cli.touching import touch_command
from gcode.errors import GcodeError, InputError, ReadError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS, list_profiles

if TYPE_CHECKING:
    from gcode.check import CheckReport
    from gcode.estimate import Estimate
    from gcode.hosts import Printer, PrintReport
    from gcode.moves import Program
    from gcode.profiles import PrinterProfile, PrintSetup
    from gcode.surfaces import HeightField

AS_BUILT_CELL_MM = 0.2
AROUND_MM = 30.0  # how far around a standing mesh the field goes: the head's own width

AsBuiltOption = Annotated[
    Path | None,
    typer.Option(help="What stands on the bed: a mesh, or a height map (.npz, .tif, .npy)."),
]
FileArgument = Annotated[Path, typer.Argument(help="G-code file.")]

app = typer.Typer(
    name="gcode",
    help="Slice solids, check and estimate programs, send them, emulate a printer.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
profiles_app = typer.Typer(help="Printer, material and process profiles.", no_args_is_help=True)
app.add_typer(profiles_app, name="profiles")
app.command(
    "resume-at",
    epilog=console.examples(
        "gcode resume-at job.gcode --layer 41 --printer prusa_mk3s -o rest.gcode",
        "gcode resume-at job.gcode --z-mm 8.4 -o rest.gcode",
    ),
)(resume_at_command)
app.command(
    "touch",
    epilog=console.examples(
        "gcode touch job.gcode --layer 41 --above-mm 4 --printer generic_marlin "
        "--port /dev/ttyACM0",
    ),
)(touch_command)
importing.add_to(profiles_app)


def _version(asked: bool) -> bool:
    import gcode

    if asked:
        console.out.print(f"gcode {gcode.__version__}")
        raise typer.Exit
    return asked


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options before a command."""


@app.command(
    "slice",
    epilog=console.examples(
        "gcode slice solid.stl -o job.gcode --printer ender_3 --material petg "
        "--process standard_0.20",
        "gcode slice piece.stl -o patch.gcode --as-built standing.stl --job job.gcode",
    ),
)
def slice_solid(
    solid: Annotated[Path, typer.Argument(help="Solid in the build frame, mm.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Program to write.")],
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    as_built: AsBuiltOption = None,
    job: Annotated[
        Path | None, typer.Option(help="The job's G-code: layers lie on its layers.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Slice a solid: a whole job, or with --as-built a patch on top of what stands there."""
    from gcode.check import check as check_program
    from gcode.estimate import estimate as estimate_program
    from gcode.profiles import load_setup
    from gcode.slicing.job import slice_part
    from gcode.solids import read_solid
    from gcode.writer import write

    console.writable(output)
    setup = load_setup(printer, material, process)
    bars = console.Bars()
    lost: tuple[Any, ...] = ()
    with bars.shown():
        with bars.stage("read solid"):
            shape = read_solid(solid)
        if as_built is None:
            field = None
            toolpath = slice_part(shape, setup, progress=bars)
        else:
            from gcode.slicing.patch import slice_patch

            field = _as_built(as_built)
            plan = slice_patch(
                shape,
                setup,
                as_built=field,
                grid=grid_of(job, setup),
                standalone=True,
                progress=bars,
            )
            toolpath, lost = plan.toolpath, (*plan.unreachable, *plan.unprintable)
        if not toolpath.extrusions:
            raise InputError(f"{solid}: nothing of it can be printed: {_reasons(lost)}.")
        with bars.stage("write"):
            program = write(toolpath, setup, title=f"{solid.name}")
        check_program(program, setup, as_built=field, progress=bars)
        cost = estimate_program(program, setup.printer, progress=bars)
    console.write_whole(output, lambda path: path.write_text(program.text, encoding="utf-8"))
    result = {
        "gcode": str(output),
        "solid_mm3": round(float(shape.volume()), 4),
        "beads_mm3": round(toolpath.volume_mm3, 4),
        "filament_mm": round(cost.filament_mm, 2),
        "print_time_s": round(cost.print_time_s, 1),
        "left_out": [
            {"volume_mm3": round(u.volume_mm3, 4), "box_mm": list(u.box_mm), "reason": u.reason}
            for u in lost
        ],
    }
    if as_json:
        console.show_json(result)
        return
    console.out.print(
        f"{output}: {result['beads_mm3']} mm³ of {result['solid_mm3']} mm³ as beads, "
        f"{cost.filament_mm / 1000:.2f} m of filament, {cost.print_time_s / 60:.1f} min; checked."
    )
    for thing in lost:
        console.out.print(f"left out: {thing.volume_mm3:.3f} mm³: {thing.reason}")


def _setup_of(printer: str, material: str | None) -> PrintSetup:
    """Profiles to judge by; of a filament that nobody named only the hotend's limit is known."""
    from gcode.profiles import load_setup

    setup = load_setup(printer, material or DEFAULT_MATERIAL)
    return setup if material is not None else setup.melting_all()


@app.command(
    "check",
    epilog=console.examples(
        "gcode check job.gcode --printer ender_3",
        "gcode check job.gcode --printer creality_k1_max --material petg",
        "gcode check repair.gcode --as-built standing.stl --json",
    ),
)
def check(
    file: FileArgument,
    printer: PrinterOption = DEFAULT_PRINTER,
    material: OwnMaterialOption = None,
    as_built: AsBuiltOption = None,
    leave_heaters: LeaveHeatersOption = False,
    as_json: JsonOption = False,
) -> None:
    """Judge a program: limits, temperatures, sections, and the tool head against --as-built.

    Programs of our own keep every figure of the profiles. In a job of yours only what can hurt is
    refused; flow, speed, acceleration and bead size beyond the profile's figures are told.
    """
    with console.starting():
        from gcode.check import judge, policy_of
        from gcode.moves import Program

    setup = _setup_of(printer, material)
    program = Program(program_text(file), setup.printer.dialect)
    field = _as_built(as_built) if as_built is not None else None
    bars = console.Bars()
    with bars.shown():
        verdict = judge(
            program, setup, as_built=field, policy=policy_of(program),
            leave_heaters=leave_heaters, progress=bars,
        )  # fmt: skip
    refusals = verdict.refusals
    if as_json:
        console.show_json(
            {
                "ok": not refusals,
                "printer": setup.printer.id,
                "sha256": program.sha256,
                "refusals": [refusal_json(refusal) for refusal in refusals],
                **warnings_json(verdict.report, "warnings"),
            }
        )
    elif refusals:
        for refusal in refusals[:20]:
            console.errors.print(str(refusal), markup=False)
        if len(refusals) > 20:
            console.errors.print(f"and {len(refusals) - 20} more")
    else:
        tell_warnings(file, verdict.report)
        console.out.print(
            f"{file}: nothing {'else ' if verdict.report.warnings else ''}speaks against it on "
            f"{setup.printer.name}."
        )
    if refusals:
        raise typer.Exit(2)


@app.command(
    "estimate",
    epilog=console.examples(
        "gcode estimate job.gcode",
        "gcode estimate job.gcode --printer voron_2_4 --json",
    ),
)
def estimate(
    file: FileArgument,
    printer: Annotated[
        str | None, typer.Option(help="Printer profile; a plain machine where left out.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Tell how long a program takes and what it uses; heating left out."""
    with console.starting():
        from gcode.estimate import estimate as estimate_program
        from gcode.moves import Program
        from gcode.profiles import load_printer

    bars = console.Bars()
    with bars.shown():
        machine = load_printer(printer) if printer is not None else None
        dialect = machine.dialect if machine is not None else "marlin"
        found = estimate_program(Program(program_text(file), dialect), machine, progress=bars)
    result = {
        "print_time_s": round(found.print_time_s, 1),
        "filament_mm": round(found.filament_mm, 2),
        "filament_mm3": round(found.filament_mm3, 2),
        "layers": found.layers,
        "bounds_mm": [round(v, 3) for v in found.bounds_mm],
    }
    if as_json:
        console.show_json(result)
        return
    console.out.print(
        f"{found.print_time_s / 60:.1f} min, {found.filament_mm / 1000:.3f} m of filament "
        f"({found.filament_mm3 / 1000:.2f} cm³), {found.layers} layers."
    )


@app.command(
    "send",
    epilog=console.examples(
        "gcode send repair.gcode --port /dev/ttyACM0",
        "gcode send job.gcode --port /dev/ttyUSB0 --printer ender_3 --wire-log wire.log "
        "--journal job.journal",
    ),
)
def send(
    file: FileArgument,
    port: Annotated[
        str,
        typer.Option(
            help="Device path, octoprint+http://HOST:PORT, moonraker+http://HOST:PORT, file:PATH; "
            "keys by OCTOPRINT_API_KEY, MOONRAKER_API_KEY."
        ),
    ],
    printer: PrinterOption = DEFAULT_PRINTER,
    material: OwnMaterialOption = None,
    as_built: AsBuiltOption = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the job that the journal knows, or say why not."),
    ] = False,
    pose_confirmed: Annotated[
        bool,
        typer.Option(
            "--pose-confirmed",
            help="A rescan has shown that the part still stands where it stood (with --resume).",
        ),
    ] = False,
    wire_log: Annotated[Path | None, typer.Option(help="Log of every byte, with times.")] = None,
    journal: Annotated[
        Path | None,
        typer.Option(help="Journal, written ahead of the wire; one a port where left out."),
    ] = None,
    window: Annotated[
        int,
        typer.Option(
            min=1, help="Lines under way at once; more than 1 for firmware that buffers them."
        ),
    ] = 1,
    leave_heaters: LeaveHeatersOption = False,
    as_json: JsonOption = False,
) -> None:
    """Check a program, then print it; whatever goes wrong, heaters are told to switch off.

    What is judged, and how strictly, is told by 'gcode check --help'.
    """
    from concurrent.futures import ThreadPoolExecutor

    from gcode.check import check as check_program
    from gcode.check import policy_of
    from gcode.cli.words import what_it_does
    from gcode.hosts import connect
    from gcode.hosts.journal import default_path
    from gcode.hosts.resume import resume as resume_job
    from gcode.hosts.serial import SerialPrinter
    from gcode.moves import Program

    setup = _setup_of(printer, material)
    field = _as_built(as_built) if as_built is not None else None
    program = Program(program_text(file), setup.printer.dialect)
    bars = console.Bars()
    with ThreadPoolExecutor(1) as beside, bars.shown():  # nobody waits for the estimate alone
        cost = beside.submit(_cost_of, program, setup.printer)
        checked = check_program(
            program, setup, as_built=field, policy=policy_of(program),
            leave_heaters=leave_heaters, progress=bars,
        )  # fmt: skip
    tell_warnings(file, checked.report)
    console.errors.print(
        f"{file} on {setup.printer.name}: {what_it_does(program, cost.result())}.", markup=False
    )
    machine = connect(
        port,
        dialect=setup.printer.dialect,
        baud=setup.printer.baud,
        window=window,
        wire_log=wire_log,
        journal=journal or default_path(port),
    )
    if resume and not isinstance(machine, SerialPrinter):
        raise InputError(f"{port} cannot be resumed on; only a printer's own port can.")
    if not resume:
        machine.connect()  # a printer that refuses us is not ours to abort
    try:
        with console.signals_end_it(), bars.shown():
            if resume and isinstance(machine, SerialPrinter):
                report = resume_job(
                    machine,
                    checked,
                    release_c=setup.material.bed_release_c,
                    pose_confirmed=pose_confirmed,
                    progress=bars,
                )
            else:
                report = machine.print(checked, progress=bars)
            machine.finish_moves()
    except BaseException:
        _abort(machine)
        raise
    finally:
        machine.close()
    _tell(report, checked.report, as_json=as_json)
    if not report.ok:
        raise typer.Exit(4)


@app.command(
    "emulate",
    epilog=console.examples(
        "gcode emulate",
        "gcode emulate --firmware klipper --printer voron_2_4 --link /tmp/printer --accelerated",
        "gcode emulate --faults faults.txt --link /tmp/printer",
    ),
)
def emulate(
    firmware: Annotated[str, typer.Option(help="marlin, prusa, klipper or reprap.")] = "marlin",
    printer: PrinterOption = DEFAULT_PRINTER,
    faults: Annotated[
        Path | None,
        typer.Option(help="Fault script, such as 'every 37 corrupt_in'; one fault a line."),
    ] = None,
    link: Annotated[Path | None, typer.Option(help="Name for the pseudo-terminal.")] = None,
    accelerated: Annotated[bool, typer.Option(help="Let the printer's clock jump.")] = False,
    motion: Annotated[
        Path | None,
        typer.Option(
            help="File that executed moves are appended to as they happen, nine float64 each: "
            "start and end, mm, filament, mm, speed, mm/s, the printer's clock, s; "
            "'amrepair loop --scanner simulated:FILE' looks at what they print."
        ),
    ] = None,
) -> None:
    """Emulate a printer: prints the pseudo-terminal's path and serves until interrupted."""
    from gcode.dialects import DIALECTS
    from gcode.firmware import serve_forever
    from gcode.firmware.faults import parse_faults
    from gcode.profiles import load_printer

    if firmware not in DIALECTS:
        raise InputError(f"--firmware is {firmware!r}; it is one of {', '.join(DIALECTS)}.")
    script = parse_faults(plain_text(faults)) if faults is not None else None
    machine = load_printer(printer)
    with tempfile.TemporaryDirectory(prefix="gcode-emulate-") as folder:
        serve_forever(
            machine,
            firmware=firmware,
            faults=script,
            link=link or Path(folder) / "ttyEMU0",
            accelerated=accelerated,
            motion=motion,
            on_port=typer.echo,
        )


@profiles_app.command(
    "list",
    epilog=console.examples(
        "gcode profiles list",
        "gcode profiles list --json",
    ),
)
def profiles_list(as_json: JsonOption = False) -> None:
    """List the shipped profiles."""
    found = {kind: list(list_profiles(kind)) for kind in ("printers", "materials", "processes")}
    if as_json:
        console.show_json(found)
        return
    for kind, names in found.items():
        console.out.print(f"{kind}: {', '.join(names)}")


@profiles_app.command(
    "show",
    epilog=console.examples(
        "gcode profiles show prusa_mk3s",
        "gcode profiles show mine.toml",
    ),
)
def profiles_show(
    profile: Annotated[str, typer.Argument(help="ID or TOML file.")],
    kind: Annotated[
        str, typer.Option(help="printers, materials or processes, where the file leaves it open.")
    ] = "",
) -> None:
    """Show a profile with everything it inherits, as JSON."""
    from gcode.profiles import kind_of, load_material, load_printer, load_process

    loaders: dict[str, Any] = {
        "printers": load_printer,
        "materials": load_material,
        "processes": load_process,
    }
    if kind and kind not in loaders:
        raise InputError(f"There is no kind '{kind}' of profiles; there are {', '.join(loaders)}.")
    console.show_json(loaders[kind or kind_of(profile)](profile).model_dump(mode="json"))


def _cost_of(program: Program, printer: PrinterProfile) -> Estimate | None:
    """What a program takes; None for homing, heating, a test of the mesh, sent all the same."""
    from gcode.estimate import estimate as estimate_program

    try:
        return estimate_program(program, printer)
    except ReadError:
        return None


def _abort(machine: Printer) -> None:
    """End the job; the failure that led here stays the one that is reported."""
    try:
        machine.abort()
    except GcodeError as error:
        console.errors.print(f"gcode: the printer could not be made safe: {error}", markup=False)


def _tell(report: PrintReport, judged: CheckReport, *, as_json: bool) -> None:
    """What became of a print, with the counters of its link."""
    result = {
        "ok": report.ok,
        "first_line": report.first_line,
        "next_line": report.next_line,
        "lines_acked": report.lines_acked,
        "resends": report.resends,
        "stalls": report.stalls,
        "spare_oks": report.spare_oks,
        "bytes_sent": report.bytes_sent,
        "round_trip_ms": {
            name: round(1000 * seconds, 3)
            for name, seconds in zip(("p50", "p95", "p99"), report.round_trip_s, strict=True)
        },
        "warnings": list(report.warnings),
        **warnings_json(judged),
        "seconds": round(report.seconds, 3),
    }
    if as_json:
        console.show_json(result)
    else:
        console.out.print(
            f"{report.lines_acked} lines acknowledged, {report.resends} resent, "
            f"{report.stalls} stalls, {report.seconds:.1f} s; round trip "
            f"{1000 * report.round_trip_s[0]:.2f} ms, 99 % within "
            f"{1000 * report.round_trip_s[2]:.2f} ms."
        )


def _as_built(path: Path) -> HeightField:
    """A height field from a height map, or from a mesh with room around it."""
    from gcode.solids import SUFFIXES, read_solid
    from gcode.surfaces import HeightField

    if path.suffix.lower() not in SUFFIXES:
        if not path.is_file():
            raise InputError(f"{path}: there is no such file.")
        return HeightField.read(path)
    solid = read_solid(path)
    return HeightField.from_manifold(solid, AS_BUILT_CELL_MM, margin_mm=AROUND_MM)


def _reasons(lost: tuple[Any, ...]) -> str:
    return "; ".join(sorted({thing.reason for thing in lost})) or "it is too small"


def main() -> None:
    """Entry point."""
    console.run(app, "gcode", (GcodeError,))
