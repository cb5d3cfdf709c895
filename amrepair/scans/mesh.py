"""Scanned meshes as points spread evenly over them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.scans.scan import Scan
from gcode.solids import read_triangles
from gcode.surfaces.sizes import PARSER_ERRORS, in_words

MESH_SPACING_MM = 0.2
MAX_MESH_SAMPLES = 2_000_000


def read_mesh(
    path: Path,
    frame: str,
    sigma_mm: float,
    *,
    mm_from_file: Float[np.ndarray, "3 3"],
) -> Scan:
    """A scanned mesh, open ones too, as points spread evenly over it with its normals.

    Parameters
    ----------
    mm_from_file
        The file's unit and axes.

    Raises
    ------
    InputError
        If the file is damaged, has no faces or vertices that are no places (the faces at them would
        be gaps), or swells beyond the limit.
    """
    try:
        vertices, faces = read_triangles(path)
        if len(faces) == 0:
            raise InputError(f"{path}: the mesh has no faces; export it again")
        import trimesh  # half a second, which a file that is refused need not wait

        mesh = trimesh.Trimesh(vertices @ mm_from_file.T, faces, process=False)
        area_mm2 = float(mesh.area)
        if not 0 < area_mm2 < np.inf:
            raise InputError(f"{path}: the mesh has an area of {area_mm2:g} mm²; export it again")
        count = int(np.clip(area_mm2 / MESH_SPACING_MM**2, 1, MAX_MESH_SAMPLES))
        points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
        normals = np.asarray(mesh.face_normals)[np.asarray(face)]
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: the mesh cannot be read ({in_words(e)}); export it again") from e
    return Scan(np.asarray(points, np.float64), sigma_mm, frame, normals, source=str(path))
