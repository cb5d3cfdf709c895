"""`amrepair batch`: many scans at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from inspect import Signature, signature
from typing import Annotated, Any, get_type_hints

import typer

from amrepair.cli.inspect import KnownOption, TemplateOption
from amrepair.cli.options import (
    CalibrationOption,
    SeedOption,
    SensorOption,
    UnitOption,
    calibration_named,
    numbers,
    sensors,
)
from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.options import JsonOption, MaterialOption, PrinterOption, ProcessOption
from gcode.process import one_thread
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

batch_app = typer.Typer(
    help="Align, judge or repair many scans; a batch that was killed goes on.",
    no_args_is_help=True,
)

SourceArgument = Annotated[
    str,
    typer.Argument(
        metavar="FOLDER|MANIFEST",
        help="Folder of scans, or a manifest (.csv, .jsonl) with path and, where known, time and "
        "label; may be s3://….",
    ),
]
OutOption = Annotated[
    str,
    typer.Option(
        "--out", "-o", help="Folder for results, table, overview; gone on with; may be s3://…."
    ),
]
ExecutorOption = Annotated[
    str, typer.Option(help="process (spawned workers), serial (none), or ray.")
]
WorkersOption = Annotated[
    int | None, typer.Option(min=1, help="Workers; left out: one a core, or the cluster's.")
]
AddressOption = Annotated[
    str | None, typer.Option(help="Ray cluster to use, such as auto or ray://head:10001.")
]
PoseOption = Annotated[
    str | None,
    typer.Option(
        help="X,Y,Z,RZ of each part's own origin on the bed, mm and degrees; left out: the scans "
        "are in the bed's frame.",
    ),
]
FixtureOption = Annotated[
    bool, typer.Option("--on-fixture", help="The parts stand on something above the bed.")
]

# `BatchOptions` (loaded when a command runs), and the name of the calibration that judges.
Judging = tuple[Any, str | None]


def _run(
    judging: Callable[..., Judging],
    *,
    source: SourceArgument,
    template: TemplateOption,
    out: OutOption,
    sensor_at: SensorOption = None,
    scan_unit: UnitOption = None,
    executor: ExecutorOption = "process",
    workers: WorkersOption = None,
    address: AddressOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Run it, tell of it; an exit code of 2 where not one scan has figures."""
    with console.starting():
        from amrepair.batch import run_batch

    options, calibration = judging(seed=seed, sensors_mm=_places(sensor_at), scan_unit=scan_unit)
    bars = console.Bars()
    try:
        with bars.shown():
            report = run_batch(
                source,
                options=options,
                template=template,
                out=out,
                executor=executor,
                workers=workers,
                address=address,
                calibration=calibration_named(calibration),
                progress=bars,
            )
    except KeyboardInterrupt:
        console.errors.print(f"What is judged is kept in {out}; the same command goes on with it.")
        raise
    for note in report.notes:
        console.errors.print(note)
    if as_json:
        files = [f"{out.rstrip('/')}/{name}" for name in report.files]
        console.show_json({**report.to_json(), "files": files})
    else:
        console.out.print(
            f"{len(report.rows)} scans: {report.computed} judged now, {report.known} known before, "
            f"{report.repeated} of the same bytes as another, {report.refused} without figures."
        )
        console.out.print(f"Overview: {out.rstrip('/')}/overview.html")
    if report.refused == len(report.rows):
        raise typer.Exit(InputError.exit_code)


def _command(name: str, *examples: str) -> Callable[[Callable[..., Judging]], Callable[..., None]]:
    """A command with the options that every batch has, and with those of its own.

    What is decorated has its own options by keyword, takes `seed`, `sensors_mm` and `scan_unit` as
    they are, and says what is to be done.
    """

    def add(own: Callable[..., Judging]) -> Callable[..., None]:
        said = signature(_run).parameters, signature(own).parameters
        shared, mine = ([p for p in each.values() if p.kind is p.KEYWORD_ONLY] for each in said)
        types = get_type_hints(_run, include_extras=True)
        types |= get_type_hints(own, include_extras=True)

        @wraps(own)
        def command(**given: Any) -> None:
            os.environ.update(one_thread())  # before anything that reads it is loaded
            words = {p.name: given.pop(p.name) for p in mine}
            _run(lambda **common: own(**words, **common), **given)

        required = [p for p in shared if p.default is p.empty]
        named = [*required, *mine, *(p for p in shared if p.default is not p.empty)]
        command.__signature__ = Signature(  # type: ignore[attr-defined]
            [p.replace(annotation=types[p.name]) for p in named]
        )
        batch_app.command(name, epilog=console.examples(*examples))(command)
        return command

    return add


@_command("align", "amrepair batch align scans --template part.stl --out out/batch")
def align(*, part_is_known: KnownOption = False, **common: Any) -> Judging:
    """Find where each scan lies in its template."""
    from amrepair.batch import BatchKind, BatchOptions

    return BatchOptions(BatchKind.ALIGN, part_is_known=part_is_known, **common), None


@_command(
    "detect",
    "amrepair batch detect scans --template part.stl --out out/batch",
    "amrepair batch detect monday.csv --template templates --out out/batch --workers 2 --json",
    "amrepair batch detect s3://lab/scans --template part.stl --out s3://lab/batch "
    "--executor ray --address auto",
)
def detect(
    *, part_is_known: KnownOption = False, calibration: CalibrationOption = None, **common: Any
) -> Judging:
    """Say of each scan what is missing and what is too much."""
    from amrepair.batch import BatchKind, BatchOptions

    return BatchOptions(BatchKind.DETECT, part_is_known=part_is_known, **common), calibration


@_command(
    "repair",
    "amrepair batch repair scans --template part.stl --out out/batch",
    "amrepair batch repair scans --template part.stl --out out/batch --printer ender_3 "
    "--part-pose 100,80,0,90",
)
def repair(
    *,
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    part_pose: PoseOption = None,
    on_fixture: FixtureOption = False,
    part_is_known: KnownOption = False,
    calibration: CalibrationOption = None,
    **common: Any,
) -> Judging:
    """Make for each scan the G-code that prints only what is missing."""
    from amrepair.batch import BatchKind, BatchOptions

    placed = None
    if part_pose is not None:
        x, y, z, turn_deg = (float(value) for value in numbers(part_pose, 4, "--part-pose"))
        placed = (x, y, z, turn_deg)
    options = BatchOptions(
        BatchKind.REPAIR, part_pose=placed, on_fixture=on_fixture, part_is_known=part_is_known,
        printer=printer, material=material, process=process, **common,
    )  # fmt: skip
    return options, calibration


def _places(sensor_at: list[str] | None) -> tuple[tuple[float, float, float], ...]:
    places = sensors(sensor_at)
    if placed := () if places is None else tuple(places.tolist()):
        return tuple((x, y, z) for x, y, z in placed)
    return ()
