"""The command `gcode slice`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.options import (
    AsBuiltOption,
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    grid_of,
    standing_on_bed,
)
from gcode.errors import InputError
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

CENTRE, KEEP = "centre", "keep"


def add_to(app: typer.Typer) -> None:
    """Add the command."""
    app.command(
        "slice",
        epilog=console.examples(
            "gcode slice solid.stl -o job.gcode --printer ender_3 --material petg "
            "--process standard_0.20",
            "gcode slice placed.stl -o job.gcode --place keep",
            "gcode slice piece.stl -o patch.gcode --as-built standing.stl --job job.gcode",
        ),
    )(slice_solid)


def slice_solid(
    solid: Annotated[Path, typer.Argument(help="Solid, mm.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Program to write.")],
    printer: PrinterOption = DEFAULT_PRINTER,
    material: MaterialOption = DEFAULT_MATERIAL,
    process: ProcessOption = DEFAULT_PROCESS,
    as_built: AsBuiltOption = None,
    job: Annotated[
        Path | None, typer.Option(help="The job's G-code: layers lie on its layers.")
    ] = None,
    place: Annotated[
        str | None,
        typer.Option(
            help="centre: in the middle of the bed, foot down (where left out); keep: the file's "
            "coordinates are the bed's (where left out with --as-built)."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Slice a solid: a whole job, or with --as-built a patch on top of what stands there."""
    from gcode.check import check as check_program
    from gcode.estimate import estimate as estimate_program
    from gcode.profiles import load_setup
    from gcode.slicing.job import slice_part
    from gcode.slicing.placing import in_the_middle
    from gcode.solids import read_solid
    from gcode.writer import write

    place = _place(place, patch=as_built is not None)
    console.writable(output)
    setup = load_setup(printer, material, process)
    bars = console.Bars()
    lost: tuple[Any, ...] = ()
    with bars.shown():
        with bars.stage("read solid"):
            shape = read_solid(solid)
            moved_mm = (0.0, 0.0, 0.0)
            if place == CENTRE:
                shape, moved_mm = in_the_middle(shape, setup.printer)
        if as_built is None:
            field = None
            toolpath = slice_part(shape, setup, progress=bars)
        else:
            from gcode.slicing.patch import slice_patch

            field = standing_on_bed(as_built)
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
        "placed": place,
        "moved_mm": [round(v, 4) for v in moved_mm],
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
    else:
        _tell(result, _where(shape, moved_mm) if place == CENTRE else None)


def _tell(result: dict[str, Any], where: str | None) -> None:
    """What was sliced, where it stands, and what is not in it."""
    console.out.print(
        f"{result['gcode']}: {result['beads_mm3']} mm³ of {result['solid_mm3']} mm³ as beads, "
        f"{result['filament_mm'] / 1000:.2f} m of filament, "
        f"{result['print_time_s'] / 60:.1f} min; checked.",
        markup=False,
    )
    if where is not None:
        console.out.print(where, markup=False)
    for thing in result["left_out"]:
        console.out.print(f"left out: {thing['volume_mm3']:.3f} mm³: {thing['reason']}")


def _place(place: str | None, *, patch: bool) -> str:
    """How the part is placed; a patch stands where what it mends stands."""
    if place is None:
        return KEEP if patch else CENTRE
    if place not in {CENTRE, KEEP}:
        raise InputError(f"--place is {place!r}; it is {CENTRE} or {KEEP}.")
    if patch and place == CENTRE:
        raise InputError(
            "--place centre would move the piece away from what --as-built says stands there; "
            "leave one of the two out."
        )
    return place


def _where(shape: Any, moved_mm: tuple[float, float, float]) -> str:
    x0, y0, _, x1, y1, _ = shape.bounding_box()
    by = ", ".join(f"{axis} {v:+.3f}" for axis, v in zip("XYZ", moved_mm, strict=True))
    return (
        f"placed in the middle of the bed, foot down: X {x0:.2f} to {x1:.2f}, Y {y0:.2f} to "
        f"{y1:.2f} mm (the file's own place moved by {by} mm; --place keep leaves it)."
    )


def _reasons(lost: tuple[Any, ...]) -> str:
    return "; ".join(sorted({thing.reason for thing in lost})) or "it is too small"
