"""`amrepair calibrate`: print a target, scan it, write where the scanner hangs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from amrepair.cli.options import SCAN_TIMEOUT_S, ScanTimeoutOption, SeedOption, UnitOption
from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.options import JsonOption, MaterialOption, PrinterOption, ProcessOption
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS


@console.command(
    "calibrate",
    "amrepair calibrate --port /dev/ttyACM0 --scanner watch:scans -o calibration.json",
    "amrepair calibrate --target-gcode target.gcode",
    "amrepair calibrate --scan target.ply -o calibration.json",
    "amrepair calibrate --scan layer.ply --job job.gcode --layer 0 --json",
    "amrepair calibrate --sound a.ply --sound b.ply --template part.stl --name bench",
)
def calibrate_command(
    sound: Annotated[
        list[Path] | None,
        typer.Option(
            help="Scan of a sound part: learn what this scanner and printer leave on one. May be "
            "repeated; wants --template and --name."
        ),
    ] = None,
    template: Annotated[
        Path | None, typer.Option(help="Template of the sound part, or its mesh.")
    ] = None,
    scan_unit: UnitOption = None,
    name: Annotated[
        str | None, typer.Option(help="Keep what was learned by this name, for --calibration.")
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write, for 'loop --calibration'.")
    ] = Path("calibration.json"),
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    port: Annotated[
        str | None, typer.Option(help="Print the target there: device path, or a server's.")
    ] = None,
    scanner: Annotated[
        str | None,
        typer.Option(
            help="watch:DIR: where the scan of the target will be dropped; or python:FILE, a "
            "scanner of your own."
        ),
    ] = None,
    scan: Annotated[
        Path | None, typer.Option(help="Scan of a target, or layer, that stands there already.")
    ] = None,
    job: Annotated[
        Path | None, typer.Option(help="The job whose layers stand there, instead of the target.")
    ] = None,
    layer: Annotated[
        int, typer.Option(min=0, help="Last layer that stands there, counted from 0.")
    ] = 0,
    target_gcode: Annotated[
        Path | None, typer.Option(help="Only write the target's G-code, to print it elsewhere.")
    ] = None,
    max_residual_mm: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=1.0,
            help="Refuse a calibration that is worse, mm. Left out: as 'doctor --options' says.",
        ),
    ] = None,
    scan_timeout_s: ScanTimeoutOption = SCAN_TIMEOUT_S,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find where the scanner hangs; or learn from sound parts what it leaves on them."""
    with console.starting():
        from amrepair.cli import error_calibration, pose_calibration
    if sound:
        posed = {"--scan": scan, "--job": job, "--port": port, "--scanner": scanner}
        if given := [word for word, value in posed.items() if value is not None]:
            raise InputError(
                f"{' and '.join(given)} find where the scanner hangs, and --sound learns what it "
                "leaves on sound parts; calibrate one after the other"
            )
        error_calibration.run(
            sound, template, name, scan_unit=scan_unit, seed=seed, as_json=as_json
        )
        return
    if template is not None or name is not None:
        raise InputError("--template and --name belong to --sound SCAN; name a sound part's scan")

    if target_gcode is not None:
        pose_calibration.write_target(target_gcode, (printer, material, process), as_json=as_json)
        return
    pose_calibration.run(
        output,
        (printer, material, process),
        pose_calibration.Source(port, scanner, scan, job, layer, scan_timeout_s, scan_unit),
        max_residual_mm=max_residual_mm,
        seed=seed,
        as_json=as_json,
    )
