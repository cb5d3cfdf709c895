"""Scanned meshes as points spread evenly over them."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from amrepair.errors import InputError
from amrepair.scans.scan import Scan
from gcode.surfaces.sizes import PARSER_ERRORS, UnpackLimit, in_words, length_of

MESH_SPACING_MM = 0.2
MAX_MESH_SAMPLES = 2_000_000
# Where a declaration of types stands: before the first element. 3MF forbids them (core, 2.3).
DECLARED_BYTES = 65536


def read_mesh(path: Path, frame: str, sigma_mm: float, *, unit_mm: float = 1.0) -> Scan:
    """A scanned mesh, open ones too, as points spread evenly over it with its normals.

    Raises
    ------
    InputError
        If the file is damaged, has no faces, or swells beyond the limit.
    """
    if path.suffix.lower() == ".3mf":
        _refuse_3mf(path)
    import trimesh  # half a second, which a file that is refused need not wait

    try:
        mesh = trimesh.load(path, force="mesh")
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            raise InputError(f"{path}: the mesh has no faces; export it again")
        if not np.isfinite(mesh.vertices).all():
            raise InputError(f"{path}: the mesh has vertices that are not finite numbers (NaN)")
        if unit_mm != 1.0:
            mesh.apply_scale(unit_mm)  # type: ignore[no-untyped-call]
        area_mm2 = float(mesh.area)
        if not 0 < area_mm2 < np.inf:
            raise InputError(f"{path}: the mesh has an area of {area_mm2:g} mm²; export it again")
        count = int(np.clip(area_mm2 / MESH_SPACING_MM**2, 1, MAX_MESH_SAMPLES))
        points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
        normals = np.asarray(mesh.face_normals)[np.asarray(face)]
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: the mesh cannot be read ({in_words(e)}); export it again") from e
    return Scan(np.asarray(points, np.float64), sigma_mm, frame, normals, source=str(path))


def _refuse_3mf(path: Path) -> None:
    """Refuse what is no archive, swells beyond the limit, or declares entities that may grow."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            UnpackLimit().refuse(path, sum(i.file_size for i in infos), length_of(path))
            for info in infos:
                if info.filename.lower().endswith((".model", ".rels", ".xml")):
                    with archive.open(info) as file:
                        head = file.read(DECLARED_BYTES)
                    if b"<!DOCTYPE" in head or b"<!ENTITY" in head:
                        raise InputError(
                            f"{path}: {info.filename} declares types or entities, which 3MF "
                            "forbids; export it again"
                        )
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: not a 3MF file ({in_words(e)}); export it again") from e
