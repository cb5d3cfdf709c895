"""Options and inputs that commands share, ours and `amrepair`'s."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gcode.cli import console
from gcode.errors import InputError

if TYPE_CHECKING:
    from gcode.profiles import PrinterProfile, PrintSetup
    from gcode.reader import Job
    from gcode.slicing.layers import LayerGrid
    from gcode.surfaces import HeightField

AS_BUILT_CELL_MM = 0.2
PIXELS_IN_CELL = 1.5  # of a depth map, across: no cell is empty for want of pixels
BESIDE_MESH_MM = 30.0  # how far around a standing mesh the field goes: the head's own width

AsBuiltOption = Annotated[
    Path | None,
    typer.Option(
        help="What stands on the bed, in its frame: a mesh, a point cloud (.ply, .pcd, .xyz), or a "
        "height map (.npz, .tif, .npy)."
    ),
]
ProgramOutput = Annotated[Path, typer.Option("-o", "--output", help="Program to write.")]
StandingHeightOption = Annotated[
    float | None, typer.Option("--z-mm", help="Height of what stands there, mm.")
]
FirstLayerOption = Annotated[
    int | None, typer.Option(help="Instead: the first layer to be printed, counted from 0.")
]
FileArgument = Annotated[Path, typer.Argument(help="G-code file.")]

PrinterOption = Annotated[
    str,
    typer.Option(
        help="Printer profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("printers"),
    ),
]
MaterialOption = Annotated[
    str,
    typer.Option(
        help="Material profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("materials"),
    ),
]
OwnMaterialOption = Annotated[
    str | None,
    typer.Option(
        help="Material profile: an ID or a TOML file. Left out, the flow is judged by the hotend.",
        autocompletion=console.profile_ids("materials"),
    ),
]
ProcessOption = Annotated[
    str,
    typer.Option(
        help="Process profile: an ID or a TOML file.",
        autocompletion=console.profile_ids("processes"),
    ),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, nothing else there.")
]


def refuse_standing(path: Path | None) -> None:
    """Refuse a file that what stands there cannot be written to, before any work.

    Raises
    ------
    InputError
        If it is no .npz, or cannot be written.
    """
    if path is not None:
        if path.suffix != ".npz":
            raise InputError(f"{path}: what stands there is written as .npz; rename it.")
        console.writable(path)


def program_text(path: Path) -> str:
    """The text of a program's file.

    Raises
    ------
    InputError
        If it cannot be read, holds no G-code at all (anything passes a check of nothing), or was
        cut off.
    """
    from gcode.reader.ending import cut_off

    text = plain_text(path)
    if not any(line.partition(";")[0].strip() for line in text.splitlines()):
        raise InputError(f"{path} has no command in it; slice the part again.")
    if (cut := cut_off(text)) is not None:
        raise InputError(
            f"{path} was cut off at line {cut.line} ({cut.text!r}), as a copy that was not "
            f"finished: {cut.maker} ends every job with {cut.lacks}, and nothing ends the print; "
            f"copy it again, or, if it is meant to end there, put M104 S0 at its end."
        )
    return text


def plain_text(path: Path) -> str:
    """The text of a file.

    Raises
    ------
    InputError
        If it cannot be read, or is no text.
    """
    from gcode.reader import binary

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
    if binary.is_binary(data):
        return binary.text_of(data, str(path))
    text = data.decode("utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n")
    if "\0" in text:
        raise InputError(f"{path} is no text; give a program as plain or Prusa's binary G-code.")
    return text


def job_of(path: Path, setup: PrintSetup) -> Job:
    """A job's file, read for the printer that it is meant for.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    from gcode.reader import job_for

    return job_for(program_text(path), setup.printer)


def grid_of(job: Job | None, setup: PrintSetup) -> LayerGrid:
    """Layers of a job; without one, those of the process profile.

    Of objects that are printed one after another those of the highest; a layer that is laid no
    lower than the next is pressed down by it.
    """
    from gcode.slicing.layers import LayerGrid

    if job is None:
        return LayerGrid.from_setup(setup)
    highest = max(job.turns, key=lambda turn: job.layers[turn.end_layer - 1].z_mm)
    tops_mm: list[float] = []
    for layer in reversed(job.layers[highest.first_layer : highest.end_layer]):
        if not tops_mm or layer.z_mm < tops_mm[-1]:
            tops_mm.append(layer.z_mm)
    return LayerGrid.from_tops(tops_mm[::-1], layer_height_mm=setup.process.layer_height_mm)


def standing_on_bed(path: Path, printer: PrinterProfile | None = None) -> HeightField:
    """A height field of what stands on the bed.

    From a height map, a scan in the bed's frame, a photographed depth map with its camera (of
    which what lies around the printer's bed is left out), or a mesh with room around it.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    from gcode import clouds
    from gcode.solids import SOLID_SUFFIXES, NotClosedError, read_solid, read_triangles
    from gcode.surfaces import HeightField, depth_maps, scanned

    suffix = path.suffix.lower()
    if path.is_file() and depth_maps.is_depth_map(path):
        seen = depth_maps.read_on_bed(path, None if printer is None else printer.reach_box_mm)
        console.errors.print(seen.told)
        cell_mm = max(AS_BUILT_CELL_MM, PIXELS_IN_CELL * seen.spacing_mm)
        return scanned.from_points(seen.points_mm, cell_mm, what=str(path))
    if suffix in clouds.CLOUD_SUFFIXES and not clouds.is_ply_mesh(path):
        return scanned.from_points(clouds.read_points(path), AS_BUILT_CELL_MM, what=str(path))
    if suffix not in SOLID_SUFFIXES:
        if not path.is_file():
            raise InputError(f"{path}: there is no such file.")
        return HeightField.read(path)
    try:
        solid = read_solid(path)
    except NotClosedError:  # as scanners' meshes are
        vertices, faces = read_triangles(path)
        return scanned.from_open_mesh(vertices, faces, AS_BUILT_CELL_MM, what=str(path))
    return HeightField.from_manifold(solid, AS_BUILT_CELL_MM, margin_mm=BESIDE_MESH_MM)
