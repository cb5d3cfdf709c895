"""Solids from mesh files, for slicing: read, checked, never guessed.

STL, OBJ, 3MF and PLY, mm, in the build frame. What manifold3d does not take as a closed solid is
refused in one sentence; nothing is scaled, turned or filled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import manifold3d
import numpy as np
import trimesh

from gcode.errors import InputError

SUFFIXES = (".stl", ".obj", ".3mf", ".ply")
WELD_RATIO = 1e-6  # of the extent: STL holds single precision
_READ_ERRORS = (
    ValueError, KeyError, IndexError, TypeError, AttributeError, OSError, EOFError,
    NotImplementedError, RuntimeError,
)  # fmt: skip


def read_solid(path: Path) -> Any:
    """A `manifold3d.Manifold` from a mesh file.

    Raises
    ------
    InputError
        If the file is missing, empty, damaged, holds NaN, or bounds no volume.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> round(gcode.read_solid(Path("placed.stl")).volume())  # mm³
    4560
    """
    if not path.is_file():
        what = "is a folder; name a file in it" if path.is_dir() else "there is no such file"
        raise InputError(f"{path}: {what}.")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path}: a solid is one of {', '.join(SUFFIXES)}.")
    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except _READ_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: the mesh cannot be read ({reason}); export it again.") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: the mesh has no triangles; export it again.")
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise InputError(f"{path}: {bad} of {len(vertices)} vertices are not finite numbers (NaN).")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent <= 0:
        raise InputError(f"{path}: the mesh has no extent; export it again.")
    digits = int(np.floor(-np.log10(extent * WELD_RATIO)))
    mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=digits)
    mesh.update_faces(mesh.nondegenerate_faces())
    solid = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.uint64)
        )
    )
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        raise InputError(
            f"{path}: the mesh is no closed surface ({solid.status().name}); repair it first."
        )
    if solid.volume() <= 1e-9 * extent**3:
        raise InputError(
            f"{path}: the mesh encloses {solid.volume():.3g} mm³, which is no solid; is it inside "
            "out?"
        )
    return solid
