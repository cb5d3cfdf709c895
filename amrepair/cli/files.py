"""Files that commands read and write: whole, or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from amrepair.template import open_template
from amrepair.template.mesh_file import SUFFIXES
from gcode.cli.console import write_whole

__all__ = ["open_template", "write_mesh"]


def write_mesh(mesh: Any, path: Path) -> None:
    """Write a `trimesh.Trimesh`; the ending chooses the format.

    Raises
    ------
    InputError
        If the ending is none of a mesh.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a mesh is written as one of {', '.join(SUFFIXES)}")
    write_whole(path, mesh.export)
