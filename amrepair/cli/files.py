"""Files that commands read and write: whole, or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from gcode.cli.console import write_whole


def sort_inputs(paths: list[Path]) -> tuple[list[Path], list[Path]]:
    """Meshes and scans among a template's inputs; a PLY without faces is a scan."""
    from gcode.solids import SUFFIXES

    meshes: list[Path] = []
    scans: list[Path] = []
    for path in paths:
        is_mesh = path.suffix.lower() in SUFFIXES and not is_cloud(path)
        (meshes if is_mesh else scans).append(path)
    return meshes, scans


def is_cloud(path: Path) -> bool:
    """Whether a file is a PLY whose header tells of no faces: a scan, not a mesh."""
    if path.suffix.lower() != ".ply" or not path.is_file():
        return False
    with path.open("rb") as stream:
        head = stream.read(4096).split(b"end_header")[0]
    words = [line.split() for line in head.splitlines() if line.startswith(b"element face")]
    return not any(len(word) == 3 and word[2] != b"0" for word in words)


def write_mesh(mesh: Any, path: Path) -> None:
    """Write a `trimesh.Trimesh`; the ending chooses the format.

    Raises
    ------
    InputError
        If the ending is none of a mesh.
    """
    from gcode.solids import SUFFIXES

    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a mesh is written as one of {', '.join(SUFFIXES)}")
    write_whole(path, mesh.export)
