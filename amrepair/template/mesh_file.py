"""Mesh files in, watertight meshes out: what was mended is said, what cannot be is refused.

It reads STL, OBJ, 3MF and PLY, keeps their units (the project takes them as mm) and never scales,
decimates or smooths. Mending stops at what leaves the shape in no doubt: welding, winding, small
holes, overlapping bodies.
"""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Faces, Vertices
from amrepair.errors import InputError, TemplateError
from amrepair.template.options import DEFAULT_MESH, MeshOptions
from gcode.meshes import mesh_of
from gcode.solids import (
    SOLID_SUFFIXES,
    TURNED,
    are_closed,
    as_manifold,
    first_closed,
    is_valid,
    outside_out,
    read_triangles,
    unite_overlaps,
)
from gcode.surfaces.sizes import PARSER_ERRORS, in_words

if TYPE_CHECKING:
    import trimesh


class OpenMeshError(TemplateError):
    """A mesh that was read and bounds no volume: it has holes, or is not manifold."""


_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EdgeCensus:
    """How the edges of a welded mesh pair up.

    Attributes
    ----------
    total, open, crowded
        All edges, those of one face, those of more than two.
    """

    total: int
    open: int
    crowded: int

    @property
    def open_ratio(self) -> float:
        """Share of open edges."""
        return self.open / max(self.total, 1)


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, hexadecimal."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def load_mesh(path: Path | str, options: MeshOptions = DEFAULT_MESH) -> trimesh.Trimesh:
    """Read a mesh and make it watertight where that leaves its shape in no doubt.

    Parameters
    ----------
    path
        STL, OBJ, 3MF or PLY; coordinates are taken as mm.

    Returns
    -------
    trimesh.Trimesh
        A closed mesh with outward winding. `metadata["notes"]` is a tuple of sentences that say
        what was mended; each is also logged.

    Raises
    ------
    TemplateError
        If the file is missing, unreadable, empty, holds values that are not finite, is of another
        unit, or is not a surface that bounds a volume and cannot be made one.
    """
    path = Path(path)
    mesh = read_mesh(path)
    if (across_mm := float(np.linalg.norm(mesh.extents))) < options.least_part_mm:
        raise TemplateError(
            f"the mesh {path.name} is {across_mm:.3g} mm across, and no part is smaller than "
            f"{options.least_part_mm:g} mm; coordinates are millimetres: was it exported in "
            "metres? Scale it by 1000"
        )
    closed, notes = close_mesh(mesh, source=path.name, options=options)
    for note in notes:
        _log.warning("%s: %s", path.name, note)
    closed.metadata["notes"] = notes
    closed.metadata["source"] = str(path)
    return closed


def read_mesh(path: Path) -> trimesh.Trimesh:
    """A mesh as its file has it, mm; closed or not.

    Raises
    ------
    TemplateError
        If the file is missing, of another kind, unreadable, or has no triangles.
    """
    import trimesh

    if not path.is_file():
        raise TemplateError(f"the mesh {path} does not exist or is not a file; check the path")
    if path.suffix.lower() not in SOLID_SUFFIXES:
        raise TemplateError(
            f"the mesh {path.name} ends in '{path.suffix}'; use one of {', '.join(SOLID_SUFFIXES)}"
        )
    try:
        vertices, faces = read_triangles(path)
    except PARSER_ERRORS as error:
        raise TemplateError(
            f"the mesh {path.name} cannot be read as {path.suffix[1:].upper()} "
            f"({in_words(error)}); export it again"
        ) from error
    if len(faces) == 0:
        raise TemplateError(f"the mesh {path.name} has no triangles; export it again")
    return trimesh.Trimesh(vertices, faces, process=False)


def edge_census(faces: Faces) -> EdgeCensus:
    """Count how often each undirected edge is used."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    keys = edges[:, 0] * (int(faces.max()) + 1) + edges[:, 1]
    counts = np.unique(keys, return_counts=True)[1]
    return EdgeCensus(
        total=len(counts), open=int((counts == 1).sum()), crowded=int((counts > 2).sum())
    )


def close_mesh(
    mesh: trimesh.Trimesh, *, source: str, options: MeshOptions = DEFAULT_MESH
) -> tuple[trimesh.Trimesh, tuple[str, ...]]:
    """Weld, orient and close a mesh; returns it with the sentences that say what was mended.

    Raises
    ------
    TemplateError
        If a value is not finite, or the mesh bounds no volume and cannot be made to.
    """
    import trimesh

    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    _refuse_bad_numbers(vertices, source)
    notes: list[str] = []
    extent_mm = float(np.ptp(vertices, axis=0).max())
    solid, vertices, faces = first_closed(vertices, np.asarray(mesh.faces))
    if solid is None:
        if len(faces) == 0:
            what = "only triangles without area"
            raise TemplateError(f"the mesh {source} has {what}; export it again")
        solid = _mend(trimesh.Trimesh(vertices, faces, process=False), source, notes, options)
    solid, is_turned = outside_out(solid)
    if is_turned:
        notes.append(TURNED)
    solid, overlap_mm3 = unite_overlaps(solid)
    if overlap_mm3 > 0:
        notes.append(f"bodies overlapped by {overlap_mm3:.3g} mm³ and were united")
    _refuse_flat(solid, extent_mm, source)
    closed_vertices, closed_faces = mesh_of(solid)
    return trimesh.Trimesh(closed_vertices, closed_faces, process=False), tuple(notes)


def _refuse_bad_numbers(vertices: Vertices, source: str) -> None:
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise TemplateError(
            f"the mesh {source} has {bad} of {len(vertices)} vertices that are not finite numbers "
            "(NaN or infinity); export it again"
        )
    if float(np.ptp(vertices, axis=0).max()) <= 0:
        raise TemplateError(f"the mesh {source} has no extent; export it again")


def _refuse_flat(solid: Any, extent_mm: float, source: str) -> None:
    volume = float(solid.volume())
    if volume <= 1e-9 * extent_mm**3:
        raise TemplateError(
            f"the mesh {source} encloses {volume:.3g} mm³, which is no solid; export a closed part"
        )


def _mend(mesh: trimesh.Trimesh, source: str, notes: list[str], options: MeshOptions) -> Any:
    """Drop doubled faces, fix the winding, fill small holes; refuse what is left open."""
    import trimesh

    before = edge_census(np.asarray(mesh.faces))
    if before.open_ratio > options.most_open_ratio:
        raise OpenMeshError(
            f"the mesh {source} is a soup of polygons: {before.open} of {before.total} edges are "
            f"open ({before.open_ratio:.0%}, the limit is {options.most_open_ratio:.0%}); "
            "export a closed solid"
        )
    mesh.update_faces(mesh.unique_faces())
    trimesh.repair.fix_winding(mesh)  # type: ignore[no-untyped-call]
    trimesh.repair.fill_holes(mesh)
    trimesh.repair.fix_normals(mesh, multibody=True)  # type: ignore[no-untyped-call]
    solid = as_manifold(mesh.vertices, mesh.faces)
    if not is_valid(solid):
        solid = _sewn(mesh, options)
    if not is_valid(solid):
        solid = as_manifold(mesh.vertices, _with_lids(np.asarray(mesh.faces), options))
    if not is_valid(solid):
        after = edge_census(np.asarray(mesh.faces))
        raise OpenMeshError(
            f"the mesh {source} is not a closed surface and cannot be mended: {after.open} open "
            f"and {after.crowded} edges of more than two faces are left (0 allowed); "
            "repair it in the program it came from, or let 'amrepair template fit' make a template "
            "of it by its winding number"
        )
    added = len(mesh.faces)
    notes.append(
        f"made watertight: {before.open} open and {before.crowded} crowded edges mended, "
        f"{added} triangles now"
    )
    return solid


def _with_lids(faces: Faces, options: MeshOptions) -> Int[np.ndarray, "g 3"]:
    """Faces with a fan of triangles over every small loop of open edges."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    both = {(int(a), int(b)) for a, b in edges}
    # A lid uses the open edges in the opposite direction.
    following: dict[int, list[int]] = {}
    for a, b in sorted(both):
        if (b, a) not in both:
            following.setdefault(b, []).append(a)
    lids: list[tuple[int, int, int]] = []
    while following:
        first = next(iter(following))
        loop = [first]
        while len(loop) <= options.most_lid_edges and loop[-1] in following:
            ends = following[loop[-1]]
            step = ends.pop()
            if not ends:
                del following[loop[-1]]
            if step == first:
                lids += [(first, loop[k], loop[k + 1]) for k in range(1, len(loop) - 1)]
                break
            loop.append(step)
        else:
            return faces  # too long, or it does not close: not ours to guess
    return np.concatenate([faces, np.array(lids, dtype=faces.dtype).reshape(-1, 3)])


def _sewn(mesh: trimesh.Trimesh, options: MeshOptions) -> Any:
    """Open edges that lie on each other within a hair's breadth, sewn together."""
    import manifold3d as m3

    extent_mm = float(np.ptp(np.asarray(mesh.vertices), axis=0).max())
    sewn = m3.Mesh64(
        np.array(mesh.vertices, dtype=np.float64, order="C"),
        np.array(mesh.faces, dtype=np.uint64, order="C"),
        tolerance=options.sew_ratio * extent_mm,
    )
    sewn.merge()
    same = np.arange(len(mesh.vertices))
    same[np.asarray(sewn.merge_from_vert, np.int64)] = np.asarray(sewn.merge_to_vert, np.int64)
    return m3.Manifold(sewn) if are_closed(same[np.asarray(mesh.faces)]) else m3.Manifold()


def require_mesh(mesh: Any, *, source: str) -> trimesh.Trimesh:
    """Check and close a mesh handed over in memory.

    Raises
    ------
    InputError
        If it is not a `trimesh.Trimesh`.
    TemplateError
        As `load_mesh`.
    """
    import trimesh

    if not isinstance(mesh, trimesh.Trimesh):
        raise InputError(f"{source} is a {type(mesh).__name__}; give a trimesh.Trimesh or a path")
    if "notes" in mesh.metadata:
        return mesh
    if len(mesh.faces) == 0:
        raise TemplateError(f"the mesh {source} has no triangles")
    closed, notes = close_mesh(mesh, source=source)
    closed.metadata["notes"] = notes
    return closed
