"""The command `gcode slice`."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gcode.cli import console
from gcode.cli.options import (
    AsBuiltOption,
    JsonOption,
    MaterialOption,
    PrinterOption,
    ProcessOption,
    ProgramOutput,
    grid_of,
    job_of,
    standing_on_bed,
)
from gcode.errors import InputError
from gcode.process import collector_held, gives_back
from gcode.profiles import DEFAULT_MATERIAL, DEFAULT_PRINTER, DEFAULT_PROCESS

if TYPE_CHECKING:
    from gcode.moves import Program, Toolpath
    from gcode.profiles import PrintSetup
    from gcode.surfaces import HeightField

CENTRE, KEEP = "centre", "keep"


@console.command(
    "slice",
    "gcode slice solid.stl -o job.gcode --printer ender_3 --material petg --process standard_0.20",
    "gcode slice placed.stl -o job.gcode --place keep",
    "gcode slice piece.stl -o patch.gcode --as-built standing.stl --job job.gcode",
)
def slice_solid(
    solid: Annotated[Path, typer.Argument(help="Solid, mm.")],
    output: ProgramOutput,
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
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes that plan a job's layers; left out: one a core."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Slice a solid: a whole job, or with --as-built a patch on top of what stands there."""
    from gcode.compiled import all_from_disk
    from gcode.profiles import load_setup

    place = _place(place, patch=as_built is not None)
    console.writable(output)
    profiles = printer, material, process
    setup = load_setup(*profiles)
    bars = console.Bars()
    with bars.shown(), collector_held():
        if as_built is None:
            made = _whole(solid, setup, profiles, place, workers, bars)
        else:
            made = _patch(solid, setup, profiles, place, (as_built, job), bars)
        from gcode.check import check as check_program
        from gcode.estimate import estimate as estimate_program

        program = made.program
        gives_back(check_program)(program, setup, as_built=made.field, progress=bars)
        cost = gives_back(estimate_program)(program, setup.printer, progress=bars)
    console.write_whole(output, lambda path: path.write_text(program.text, encoding="utf-8"))
    result = {
        "gcode": str(output),
        "placed": place,
        "moved_mm": [round(v, 4) for v in made.moved_mm],
        "solid_mm3": round(made.solid_mm3, 4),
        "beads_mm3": round(made.beads_mm3, 4),
        "filament_mm": round(cost.filament_mm, 2),
        "filament_g": round(cost.filament_mm3 * setup.material.density_g_cm3 / 1000, 2),
        "print_time_s": round(cost.print_time_s, 1),
        "first_pass": made.first_pass,
        "left_out": [
            {"volume_mm3": round(u.volume_mm3, 4), "box_mm": list(u.box_mm), "reason": u.reason}
            for u in made.left
        ],
    }
    if as_json:
        console.show_json(result)
    else:
        _tell(result, made.where)
    if all_from_disk():  # numba's circles hold whatever called a kernel when it was compiled
        console.leave_circles()


@dataclass(frozen=True)
class _Made:
    """A program, and of what it was made from no more than is told of it.

    `moved_mm` is where it was moved to, `where` says so; `field` is what stands there, `left` what
    is left out of it, `first_pass` how it begins on what is cold.
    """

    program: Program
    beads_mm3: float
    solid_mm3: float
    moved_mm: tuple[float, float, float]
    where: str | None
    field: HeightField | None = None
    left: tuple[Any, ...] = ()
    first_pass: str | None = None


@gives_back
def _whole(
    solid: Path,
    setup: PrintSetup,
    profiles: tuple[str, str, str],
    place: str,
    workers: int | None,
    bars: console.Bars,
) -> _Made:
    """A whole job."""
    from gcode.crew import forks
    from gcode.slicing.job import slice_part
    from gcode.solids import read_closed

    with bars.stage("read solid"):
        shape, moved_mm = _placed(gives_back(read_closed)(solid), setup, place)
    toolpath = gives_back(slice_part)(
        shape, setup, workers=workers or forks(), progress=bars, meanwhile=_load_what_judges
    )
    where = _where(shape, moved_mm) if place == CENTRE else None
    solid_mm3 = float(shape.volume())
    del shape  # half of what is held
    program = gives_back(_written)(toolpath, setup, _title(solid, profiles), (), bars)
    return _Made(program, toolpath.volume_mm3, solid_mm3, moved_mm, where)


def _patch(
    solid: Path,
    setup: PrintSetup,
    profiles: tuple[str, str, str],
    place: str,
    around: tuple[Path, Path | None],
    bars: console.Bars,
) -> _Made:
    """What is to be laid on what stands there: its file, and the job's."""
    from gcode.slicing.patch import slice_patch
    from gcode.solids import read_solid

    with bars.stage("read solid"):
        shape, moved_mm = _placed(read_solid(solid), setup, place)
    field = standing_on_bed(around[0], setup.printer)
    grid = grid_of(None if around[1] is None else job_of(around[1], setup), setup)
    plan = slice_patch(shape, setup, as_built=field, grid=grid, standalone=True, progress=bars)
    left = (*plan.unreachable, *plan.unprintable)
    program = _written(plan.toolpath, setup, _title(solid, profiles), left, bars)
    volumes = plan.toolpath.volume_mm3, float(shape.volume())
    return _Made(program, *volumes, moved_mm, None, field, left, plan.first_pass)


def _load_what_judges() -> None:
    """What a program is written and judged by, while others plan it."""
    for room in ("check", "estimate", "profiles.own_settings", "writer"):
        import_module(f"gcode.{room}")


def _title(solid: Path, profiles: tuple[str, str, str]) -> str:
    from gcode.profiles.own_settings import profiles_line

    return f"{solid.name}\n{profiles_line(profiles)}"


def _written(
    toolpath: Toolpath, setup: PrintSetup, title: str, left: tuple[Any, ...], bars: console.Bars
) -> Program:
    from gcode.writer import write

    if not toolpath.extrusions:
        name = title.partition("\n")[0]
        raise InputError(f"{name}: nothing of it can be printed: {_reasons(left)}.")
    with bars.stage("write"):
        return write(toolpath, setup, title=title)


def _placed(shape: Any, setup: PrintSetup, place: str) -> tuple[Any, tuple[float, float, float]]:
    from gcode.slicing.placing import in_the_middle

    if place == CENTRE:
        return in_the_middle(shape, setup.printer)
    return shape, (0.0, 0.0, 0.0)


def _tell(result: dict[str, Any], where: str | None) -> None:
    """What was sliced, where it stands, and what is not in it."""
    console.out.print(
        f"{result['gcode']}: {result['beads_mm3']} mm³ of {result['solid_mm3']} mm³ as beads, "
        f"{result['filament_mm'] / 1000:.2f} m of filament ({result['filament_g']} g), "
        f"{result['print_time_s'] / 60:.1f} min; checked."
    )
    if where is not None:
        console.out.print(where)
    if result["first_pass"] is not None:
        console.out.print(result["first_pass"].replace(" C", " °C"))
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
