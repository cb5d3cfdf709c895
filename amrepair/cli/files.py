"""Files that commands read and write: templates, meshes, whole files or none."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from amrepair.template import load_or_fit, load_template
from amrepair.template.mesh_file import SUFFIXES
from amrepair.template.port import Template
from gcode.cli.console import write_whole
from gcode.progress import Progress, silent

TEMPLATE_SUFFIX = ".safetensors"


def open_template(path: Path, *, progress: Progress = silent) -> Template:
    """A fitted template, or a mesh that is fitted now (or taken from the cache).

    Raises
    ------
    InputError
        If it is neither.
    """
    suffix = path.suffix.lower()
    if suffix == TEMPLATE_SUFFIX:
        return load_template(path)
    if suffix in SUFFIXES:
        return load_or_fit(path, progress=progress)
    raise InputError(
        f"the template {path} is neither a {TEMPLATE_SUFFIX} file nor a mesh "
        f"({', '.join(SUFFIXES)}); fit one with 'amrepair template fit'"
    )


def sort_inputs(paths: list[Path]) -> tuple[list[Path], list[Path]]:
    """Meshes and scans among a template's inputs; a PLY without faces is a scan."""
    meshes: list[Path] = []
    scans: list[Path] = []
    for path in paths:
        suffix = path.suffix.lower()
        is_mesh = suffix in SUFFIXES and not (suffix == ".ply" and _is_cloud(path))
        (meshes if is_mesh else scans).append(path)
    return meshes, scans


def _is_cloud(path: Path) -> bool:
    """Whether a PLY's header tells of no faces."""
    if not path.is_file():
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
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a mesh is written as one of {', '.join(SUFFIXES)}")
    write_whole(path, mesh.export)
