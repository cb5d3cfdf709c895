"""`amrepair batch`: many scans at once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from amrepair.cli.inspect import KnownOption, TemplateOption
from amrepair.cli.options import (
    CalibrationOption,
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    SeedOption,
    SensorOption,
    calibration_named,
    numbers,
    sensors,
)
from amrepair.errors import InputError
from gcode.cli import console
from gcode.process import one_thread
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from amrepair.batch import BatchOptions, BatchReport

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
    str, typer.Option(help="Folder for results, table, overview; gone on with; may be s3://….")
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


def add_to(app: typer.Typer) -> None:
    """Add the group."""
    app.add_typer(batch_app, name="batch")


@batch_app.command(
    "align",
    epilog=console.examples(
        "amrepair batch align scans --template part.stl --out out/batch",
    ),
)
def align(
    source: SourceArgument,
    template: TemplateOption,
    out: OutOption,
    part_is_known: KnownOption = False,
    sensor_at: SensorOption = None,
    executor: ExecutorOption = "process",
    workers: WorkersOption = None,
    address: AddressOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find where each scan lies in its template."""
    os.environ.update(one_thread())
    with console.starting():
        from amrepair.batch import BatchOptions, Kind

    options = BatchOptions(
        Kind.ALIGN, seed=seed, part_is_known=part_is_known, sensors_mm=_places(sensor_at)
    )
    _run(source, options, template, out, (executor, workers, address), None, as_json=as_json)


@batch_app.command(
    "detect",
    epilog=console.examples(
        "amrepair batch detect scans --template part.stl --out out/batch",
        "amrepair batch detect monday.csv --template templates --out out/batch --workers 2 --json",
        "amrepair batch detect s3://lab/scans --template part.stl --out s3://lab/batch "
        "--executor ray --address auto",
    ),
)
def detect(
    source: SourceArgument,
    template: TemplateOption,
    out: OutOption,
    part_is_known: KnownOption = False,
    sensor_at: SensorOption = None,
    calibration: CalibrationOption = None,
    executor: ExecutorOption = "process",
    workers: WorkersOption = None,
    address: AddressOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Say of each scan what is missing and what is too much."""
    os.environ.update(one_thread())
    with console.starting():
        from amrepair.batch import BatchOptions, Kind

    options = BatchOptions(
        Kind.DETECT, seed=seed, part_is_known=part_is_known, sensors_mm=_places(sensor_at)
    )
    crew = (executor, workers, address)
    _run(source, options, template, out, crew, calibration, as_json=as_json)


@batch_app.command(
    "repair",
    epilog=console.examples(
        "amrepair batch repair scans --template part.stl --out out/batch",
        "amrepair batch repair scans --template part.stl --out out/batch --printer ender_3 "
        "--part-pose 100,80,0,90",
    ),
)
def repair(
    source: SourceArgument,
    template: TemplateOption,
    out: OutOption,
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    pose: Annotated[
        str | None,
        typer.Option(
            "--part-pose",
            help="X,Y,Z,RZ of each part's own origin on the bed, mm and degrees; left out: the "
            "scans are in the bed's frame.",
        ),
    ] = None,
    on_fixture: Annotated[
        bool, typer.Option("--on-fixture", help="The parts stand on something above the bed.")
    ] = False,
    sensor_at: SensorOption = None,
    calibration: CalibrationOption = None,
    executor: ExecutorOption = "process",
    workers: WorkersOption = None,
    address: AddressOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Make for each scan the G-code that prints only what is missing."""
    os.environ.update(one_thread())
    with console.starting():
        from amrepair.batch import BatchOptions, Kind

    placed = None
    if pose is not None:
        x, y, z, turn_deg = (float(value) for value in numbers(pose, 4, "--part-pose"))
        placed = (x, y, z, turn_deg)
    options = BatchOptions(
        Kind.REPAIR, seed=seed, sensors_mm=_places(sensor_at), part_pose=placed,
        on_fixture=on_fixture, printer=printer, material=material, process=process,
    )  # fmt: skip
    crew = (executor, workers, address)
    _run(source, options, template, out, crew, calibration, as_json=as_json)


def _places(sensor_at: list[str] | None) -> tuple[tuple[float, float, float], ...]:
    places = sensors(sensor_at)
    if placed := () if places is None else tuple(places.tolist()):
        return tuple((x, y, z) for x, y, z in placed)
    return ()


def _run(
    source: str,
    options: BatchOptions,
    template: Path,
    out: str,
    crew: tuple[str, int | None, str | None],
    calibration: str | None,
    *,
    as_json: bool,
) -> None:
    """Run it, tell of it; an exit code of 2 where not one scan has figures."""
    from amrepair.batch import run_batch

    executor, workers, address = crew
    bars = console.Bars()
    with console.signals_end_it(), bars.shown():
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
    for note in report.notes:
        console.errors.print(note, markup=False)
    if as_json:
        console.show_json(_result(report, out))
    else:
        console.out.print(
            f"{len(report.rows)} scans: {report.computed} judged now, {report.known} known before, "
            f"{report.repeated} of the same bytes as another, {report.refused} without figures.",
            markup=False,
        )
        console.out.print(f"Overview: {out.rstrip('/')}/overview.html", markup=False)
    if report.refused == len(report.rows):
        raise typer.Exit(InputError.exit_code)


def _result(report: BatchReport, out: str) -> dict[str, Any]:
    return {
        "scans": len(report.rows),
        "refused": report.refused,
        "computed": report.computed,
        "known_before": report.known,
        "repeated": report.repeated,
        "cost": {name: round(value, 3) for name, value in report.cost.items()},
        "notes": list(report.notes),
        "files": [f"{out.rstrip('/')}/{name}" for name in report.files],
    }
