"""Files that commands read and write: templates, meshes, whole files or none."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from amrepair.template import LearnedSdf, load_or_fit
from amrepair.template.mesh_file import SUFFIXES
from amrepair.template.port import Template
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
        return LearnedSdf.load(path)
    if suffix in SUFFIXES:
        return load_or_fit(path, progress=progress)
    raise InputError(
        f"the template {path} is neither a {TEMPLATE_SUFFIX} file nor a mesh "
        f"({', '.join(SUFFIXES)}); fit one with 'amrepair template fit'"
    )


def writable(path: Path) -> None:
    """Refuse an output that cannot be written, before any work is done.

    Raises
    ------
    InputError
        Naming it.
    """
    folder = path.parent
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"{path} cannot be written; name a file in a folder that is there")


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name, then put it in place."""
    writable(path)
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        write(temporary)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)


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
