"""Files that commands read and write: whole, or none."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from amrepair.errors import InputError
from gcode.cli import console
from gcode.cli.console import write_whole

if TYPE_CHECKING:
    import numpy as np

    from amrepair.scans import Scan


def sort_inputs(paths: list[Path]) -> tuple[list[Path], list[Path]]:
    """Meshes and scans among a template's inputs; a PLY without faces is a scan."""
    from gcode.clouds import is_ply_mesh
    from gcode.solids import SOLID_SUFFIXES

    meshes: list[Path] = []
    scans: list[Path] = []
    for path in paths:
        suffix = path.suffix.lower()
        is_mesh = is_ply_mesh(path) if suffix == ".ply" else suffix in SOLID_SUFFIXES
        (meshes if is_mesh else scans).append(path)
    return meshes, scans


def read_early(
    scan: Path, frame: str, sensors_mm: np.ndarray | None, unit: str | None, bars: console.Bars
) -> Scan:
    """A scan, read before whatever judges it is loaded: a broken file is refused at once.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    with console.starting():
        from amrepair.scans import read_scan

    with bars.shown(), bars.stage("read scan"):
        return read_scan(scan, frame=frame, sensor_at=sensors_mm, unit=unit)


def refuse_traps(paths: list[Path]) -> None:
    """Refuse 3MF files that are none, or that grow beyond measure, before anything is loaded.

    Raises
    ------
    InputError
        As reading them would.
    """
    from gcode.threemf import refuse_trap

    for path in paths:
        if path.suffix.lower() == ".3mf" and path.is_file():
            try:
                refuse_trap(path)
            except (ValueError, OSError) as error:
                raise InputError(
                    f"the mesh {path} cannot be read as 3MF ({error}); export it again"
                ) from error


def write_mesh(mesh: Any, path: Path) -> None:
    """Write a `trimesh.Trimesh`; the ending chooses the format.

    Raises
    ------
    InputError
        If the ending is none of a mesh.
    """
    from gcode.solids import SOLID_SUFFIXES

    if path.suffix.lower() not in SOLID_SUFFIXES:
        raise InputError(f"{path}: a mesh is written as one of {', '.join(SOLID_SUFFIXES)}")
    write_whole(path, mesh.export)
