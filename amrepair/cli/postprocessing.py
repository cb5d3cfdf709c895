"""`amrepair postprocess`: looks marked in a job, run by the slicer itself."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.options import JsonOption
from gcode.whole import put_in_place

if TYPE_CHECKING:
    from amrepair.postprocess import Marked

EVERY = 20  # layers, where nothing else is asked for: 4 mm


@console.command(
    "postprocess",
    "amrepair postprocess job.gcode",
    "amrepair postprocess --every 0 --adaptive --at-z 12.5 job.gcode",
    "amrepair postprocess --for marlin --command 'M600' job.gcode",
)
def postprocess(
    file: Annotated[Path, typer.Argument(help="The job, changed in place; the slicer adds it.")],
    every: Annotated[
        int | None,
        typer.Option(
            min=0,
            help=f"Look after every so many layers; 0: none so. {EVERY} where neither this, "
            "--adaptive nor --at-z is given.",
        ),
    ] = None,
    adaptive: Annotated[
        bool,
        typer.Option("--adaptive", help="Look before each layer that covers much that lay open."),
    ] = False,
    covers_mm2: Annotated[
        float,
        typer.Option("--covers-mm2", min=0.1, help="How much that is, mm² (with --adaptive)."),
    ] = 25.0,
    at_z: Annotated[
        list[float] | None,
        typer.Option("--at-z", metavar="Z", help="Look when the job has reached this height, mm."),
    ] = None,
    final: Annotated[
        bool, typer.Option("--final/--no-final", help="Look when all is printed.")
    ] = True,
    target: Annotated[
        str | None,
        typer.Option(
            "--for",
            help="Who reads the marks: klipper, prusa, marlin, reprap or octoprint; as the slicer "
            "tells where left out.",
        ),
    ] = None,
    command: Annotated[
        str | None,
        typer.Option(help="Instead of that one's own words, such as 'M600'; {layer} and {z}."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Mark in a job where looks belong: between layers, off the perimeter, never in a spiral.

    Name it in the slicer's post-processing scripts. All that was in the job stays as it is.
    """
    with console.starting():
        from amrepair.postprocess import TARGETS, LooksAsked, mark, target_of
        from amrepair.postprocess.mark import decoded

    if target is not None and target not in TARGETS:
        raise InputError(f"--for is {target!r}; it is one of {', '.join(TARGETS)}")
    if every is None:
        every = 0 if adaptive or at_z else EVERY
    try:
        data = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file} cannot be read ({error.strerror})") from error
    text = decoded(data, str(file))
    reader = target if target is not None else target_of(text, file.name, os.environ)
    asked = LooksAsked(every, tuple(at_z or ()), adaptive, covers_mm2, final, command)
    bars = console.Bars()
    with bars.shown():
        with bars.stage("mark"):
            marked = mark(text, file.name, reader, asked)
        if marked.places:
            with bars.stage("write"):
                _replace(file, marked.text.encode("utf-8", "surrogateescape"))
    if as_json:
        console.show_json(
            {
                "file": str(file),
                "for": reader,
                "marked_before": marked.marked_before,
                "looks": [
                    {"layer": p.layer, "z_mm": p.z_mm, "line": p.line + 1} for p in marked.places
                ],
                "on_walls": marked.on_walls,
                "moved": marked.moved,
                "spiral_layers": marked.spiral,
            }
        )
        return
    console.errors.print(f"amrepair: {_in_words(file, marked, reader)}.")


def _in_words(file: Path, marked: Marked, reader: str) -> str:
    if marked.marked_before:
        return f"{file.name} has looks in it already and was left as it is"
    count = len(marked.places)
    said = f"{file.name}: {count} look{'' if count == 1 else 's'} for {reader}"
    if marked.places:
        at = [f"{place.z_mm:g}" for place in marked.places]
        shown = at if len(at) <= 6 else [*at[:5], "…", at[-1]]
        said += f", at {', '.join(shown)} mm"
    if marked.spiral:
        said += f"; none in {marked.spiral} layers of spiral vase"
    if marked.moved:
        said += f"; {marked.moved} a few layers later, off the perimeter"
    if marked.on_walls:
        said += f"; {marked.on_walls} on an outer wall: the job leaves it nowhere else"
    return said


def _replace(file: Path, data: bytes) -> None:
    """Put new bytes in a file's place, whole or not at all, with the same rights."""
    try:
        with put_in_place(file, durable=True) as draft:
            draft.write_bytes(data)
            shutil.copymode(file, draft)
    except OSError as error:
        raise InputError(
            f"{file} cannot be written ({error.strerror}); it is as it was before"
        ) from error
