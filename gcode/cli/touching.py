"""The command `gcode touch`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.options import (
    FirstLayerOption,
    JsonOption,
    MaterialOption,
    StandingHeightOption,
    program_text,
)
from gcode.errors import InputError
from gcode.profiles import DEFAULT_MATERIAL


def _hand_out(path: Path) -> None:
    """Write the macro that touches need on Klipper."""
    from gcode.resumption.klipper import TOUCH_MACRO

    console.write_text(path, TOUCH_MACRO)
    console.errors.print(f"Written: {path}; include it in printer.cfg.")


def _given(value: Any, name: str) -> Any:
    if value is None:
        raise InputError(f"{name} is missing; give it, or --klipper-macro FILE for the macro.")
    return value


@console.command(
    "touch",
    "gcode touch job.gcode --layer 41 --above-mm 4 --printer generic_marlin --port /dev/ttyACM0",
    "gcode touch --klipper-macro klipper_touch.cfg",
)
def touch_command(
    job: Annotated[
        Path | None, typer.Argument(help="The whole job's G-code, of any slicer.")
    ] = None,
    port: Annotated[str | None, typer.Option(help="Device path of the printer.")] = None,
    above_mm: Annotated[
        float | None,
        typer.Option(
            help="How high the nozzle stands above the part's top now, mm, by eye, within 1 mm: "
            "2 to 10. Turn Z by hand until it does."
        ),
    ] = None,
    z_mm: StandingHeightOption = None,
    layer: FirstLayerOption = None,
    printer: Annotated[
        str | None,
        typer.Option(
            help="Printer profile: an ID or a TOML file, with the probe that feels.",
            autocompletion=console.profile_ids("printers"),
        ),
    ] = None,
    material: MaterialOption = DEFAULT_MATERIAL,
    klipper_macro: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the macro AMREPAIR_TOUCH, which Klipper needs for touches, and end.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find Z anew on a standing part after a power loss: the cold nozzle feels for a flat.

    The nozzle itself must feel contact (a load cell, a strain gauge, a contact in the nozzle), as
    the printer's profile says under 'probe', and the firmware must have G38.2 (Marlin,
    RepRapFirmware) or, on Klipper, the macro of --klipper-macro. Z is never homed onto the part;
    'gcode resume-at' goes on.
    """
    if klipper_macro is not None:
        _hand_out(klipper_macro)
        return
    job, printer, port, above_mm = (
        _given(job, "JOB"), _given(printer, "--printer"), _given(port, "--port"),
        _given(above_mm, "--above-mm"),
    )  # fmt: skip
    with console.starting():
        from gcode.hosts.serial import SerialPrinter
        from gcode.hosts.touching import touch_z
        from gcode.moves import Program
        from gcode.profiles import load_setup
        from gcode.resumption.touch import plan_touch

    setup = load_setup(printer, material)
    bars = console.Bars()
    with bars.shown():
        program = Program(program_text(job), setup.printer.dialect)
        plan = plan_touch(program, setup, above_mm=above_mm, z_mm=z_mm, layer=layer, progress=bars)
        with SerialPrinter(port, dialect=setup.printer.dialect) as machine:
            found = touch_z(machine, plan, above_mm, progress=bars)
    if as_json:
        console.show_json(
            {
                "layer": plan.layer.index + 1,
                "top_mm": round(plan.layer.z_mm, 4),
                "places_mm": plan.places_mm.round(2).tolist(),
                "flat_mm": round(plan.flat_mm, 2),
                "first_shift_mm": round(found.first_shift_mm, 4),
                "shift_mm": round(found.shift_mm, 4),
                "apart_mm": round(found.apart_mm, 4),
                "uncertainty_mm": round(found.uncertainty_mm, 4),
            }
        )
        return
    console.out.print(
        f"Z is true to ±{found.uncertainty_mm:.3f} mm: the part's top was felt at "
        f"{plan.layer.z_mm:g} mm, twice, {found.apart_mm:.3f} mm apart; by eye it was "
        f"{found.first_shift_mm:+.2f} mm off. The motors are held; go on by: gcode resume-at "
        f"{job} --layer {plan.layer.index + 1}"
    )
