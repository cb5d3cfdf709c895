"""Solids from mesh files, for slicing: read, checked, never guessed.

STL, OBJ and PLY in mm, 3MF in the unit that it tells, in the build frame. Vertices are joined as
far as single precision parts them; faces that all look inwards are turned and bodies that overlap
are united, which is said; what is still no closed solid is refused in one sentence. Nothing is
filled.
"""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from gcode.errors import InputError
from gcode.meshes import ClosedMesh, bodies_apart, closed_mesh, mesh_of
from gcode.meshes_kernels import index_of_corners, paired, put_in_table
from gcode.solids_kernels import first_of_each
from gcode.surfaces.sizes import PARSER_ERRORS, in_words
from gcode.threemf import read_3mf
from gcode.whole import why_no_file

_log = logging.getLogger(__name__)

TURNED = "turned outside out: its triangles faced inwards"
SOLID_SUFFIXES = (".stl", ".obj", ".3mf", ".ply")
WELD_RATIO = 1e-6  # of the extent: STL holds single precision
EQUAL_DIGITS = 8  # of mm
STL_HEAD = 84
STL_PIECE = 1 << 15  # triangles that are read at a time
STL_TEXT_BYTES = 256  # spaces before a text file's first word
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("of_colour", "<u2")])
LARGEST_MM = 1e6  # a kilometre: what is welded is counted in hundred-millionths of a millimetre


class NotClosedError(InputError):
    """A mesh that bounds no volume."""


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
        raise InputError(f"{path}: {why_no_file(path)}.")
    if path.suffix.lower() not in SOLID_SUFFIXES:
        raise InputError(f"{path}: a solid is one of {', '.join(SOLID_SUFFIXES)}.")
    try:
        vertices, faces = read_triangles(path)
    except PARSER_ERRORS as error:
        raise InputError(
            f"{path}: the mesh cannot be read ({in_words(error)}); export it again."
        ) from error
    if len(faces) == 0:
        raise InputError(f"{path}: the mesh has no triangles; export it again.")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent <= 0:
        raise InputError(f"{path}: the mesh has no extent; export it again.")
    solid = first_closed(vertices, faces)[0]
    if solid is None:
        raise NotClosedError(
            f"{path}: the mesh is no closed surface (NotManifold), nor when vertices within "
            f"{WELD_RATIO * extent:.2g} mm are joined; repair it first."
        )
    solid, is_turned = outside_out(solid)
    if is_turned:
        _log.warning("%s: %s", path.name, TURNED)
    solid, overlap_mm3 = unite_overlaps(solid)
    if overlap_mm3 > 0:
        _log.warning("%s: bodies overlapped by %.3g mm³ and were united", path.name, overlap_mm3)
    if solid.volume() <= 1e-9 * extent**3:
        raise InputError(f"{path}: the mesh encloses {solid.volume():.3g} mm³, which is no solid.")
    return solid


def read_closed(path: Path) -> ClosedMesh:
    """The same solid as `read_solid`'s as a mesh alone, which is what slicing needs.

    A file of one closed body, or of several that lie apart, is read without a `Manifold`: for
    700,000 triangles in a quarter of the time and a tenth of the memory.

    Raises
    ------
    InputError
        As `read_solid`.
    """
    mesh = None
    if path.is_file():
        with contextlib.suppress(*PARSER_ERRORS):  # told by `read_solid`, in one sentence
            mesh = _as_it_is(path)
    return closed_mesh(read_solid(path)) if mesh is None else mesh


def _as_it_is(path: Path) -> ClosedMesh | None:
    """A file's mesh where it is closed as it is, and no more need be asked."""
    if path.suffix.lower() == ".stl":
        shared = _shared_corners(path)
    else:
        shared = read_triangles(path) if path.suffix.lower() in SOLID_SUFFIXES else None
    if shared is None or len(shared[1]) == 0 or not np.isfinite(shared[0]).all():
        return None
    if float(np.abs(shared[0]).max()) > LARGEST_MM:
        return None
    mesh = bodies_apart(*shared)
    if mesh is None:
        return None
    extent = float(np.ptp(mesh.vertices_mm, axis=0).max())
    return mesh if mesh.volume() > 1e-9 * extent**3 else None


def _shared_corners(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]] | None:
    """Vertices, equal ones once, and faces of a binary STL file; None where it is none.

    Read in pieces: corners by themselves take six times what the shared ones do.
    """
    count = _triangles_promised(path)
    if count is None:
        return None
    faces = np.empty((count, 3), np.int32)
    vertices = np.empty((min(STL_PIECE, count) * 3, 3))
    table = np.full(1 << 16, -1, np.int32)
    n = 0
    with path.open("rb") as file:
        file.seek(STL_HEAD)
        for start in range(0, count, STL_PIECE):
            piece = np.fromfile(file, STL_TRIANGLE, min(STL_PIECE, count - start))
            corners = np.ascontiguousarray(piece["corners"]).reshape(-1, 3)
            if not (np.abs(corners) <= LARGEST_MM).all():
                return None
            most = n + len(corners)
            if 2 * most > len(table):
                table = np.full(1 << (2 * most - 1).bit_length(), -1, np.int32)
                put_in_table(vertices, n, table, 10.0**EQUAL_DIGITS)
            if most > len(vertices):
                vertices = np.concatenate([vertices[:n], np.empty((most, 3))])
            n = index_of_corners(
                corners, vertices, n, table, 10.0**EQUAL_DIGITS, faces[start:].reshape(-1)
            )
    return vertices[:n].copy(), faces


def _triangles_promised(path: Path) -> int | None:
    """How many triangles a binary STL file has; None where its size says otherwise."""
    with path.open("rb") as file:
        head = file.read(STL_HEAD)
    count = int.from_bytes(head[80:84], "little")
    whole = STL_HEAD + STL_TRIANGLE.itemsize * count == path.stat().st_size
    return count if whole else None


def read_triangles(path: Path) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Vertices and faces of a file, as they are in it; none where it holds no mesh.

    Raises
    ------
    ValueError
        Where a face has a corner that is no vertex, or a vertex is no place: not a number, or
        beyond all measure; and what else is in `PARSER_ERRORS`, where the file is damaged.
    """
    vertices, faces = _triangles_in(path)
    if len(faces):
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError("its faces are no triangles of points in space")
        low, high = int(faces.min()), int(faces.max())
        if not 0 <= low <= high < len(vertices):
            wrong = low if low < 0 else high
            raise ValueError(f"a face has corner {wrong}, and there are {len(vertices)} vertices")
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:  # the faces at them would be gaps that nobody is told of
        raise ValueError(
            f"{bad} of {len(vertices)} vertices are not finite numbers (NaN or infinity)"
        )
    largest = float(np.abs(vertices).max(initial=0.0))
    if largest > LARGEST_MM:
        raise ValueError(f"a vertex lies at {largest:.3g} mm, the limit is {LARGEST_MM:g} mm")
    return vertices, faces


def _triangles_in(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """What a reader makes of it."""
    if path.suffix.lower() == ".stl":
        corners = _binary_stl(path)
        if corners is not None:
            return corners, np.arange(len(corners)).reshape(-1, 3)
    if path.suffix.lower() == ".3mf":
        return read_3mf(path)
    import trimesh  # as long as half of what is to be read: only where it must be

    with np.errstate(all="ignore"):  # numbers beyond measure are refused by whoever asked
        mesh = trimesh.load(path, force="mesh", process=False)
    if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    return np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)


def _binary_stl(path: Path) -> Float[np.ndarray, "v 3"] | None:
    """Corners of a binary STL file's triangles; None where it is text.

    Raises
    ------
    ValueError
        Where it is no text, and shorter or longer than its header says.
    """
    data = path.read_bytes()
    count = int.from_bytes(data[80:84], "little")
    expected = STL_HEAD + STL_TRIANGLE.itemsize * count
    if len(data) != expected:
        if data[:STL_TEXT_BYTES].lstrip()[:5].lower() == b"solid" and b"facet" in data:
            return None
        if len(data) < STL_HEAD:
            raise ValueError(f"it has {len(data)} bytes, and a header alone has {STL_HEAD}")
        raise ValueError(
            f"its header promises {count} triangles, which are {expected} bytes; it has {len(data)}"
        )
    triangles = np.frombuffer(data, STL_TRIANGLE, offset=STL_HEAD)
    with np.errstate(invalid="ignore"):  # a signalling NaN, which is refused as every other is
        return np.ascontiguousarray(triangles["corners"].reshape(-1, 3), dtype=np.float64)


def as_manifold(vertices_mm: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Any:
    """A `manifold3d.Manifold` of these triangles; `is_valid` tells whether it is one.

    An empty one where they close no surface, which manifold3d 3.5.4 is not asked: of such meshes it
    refuses most, and ends the process on others.
    """
    import manifold3d

    if not are_closed(faces):
        return manifold3d.Manifold()
    # Arrays are copied: the binding takes no read-only ones, and trimesh's are read-only.
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            np.array(vertices_mm, dtype=np.float64, order="C"),
            np.array(faces, dtype=np.uint64, order="C"),
        )
    )


def are_closed(faces: Int[np.ndarray, "f 3"]) -> bool:
    """Whether every edge of the faces is run as often one way as the other.

    Faces that have a corner twice do not count.
    """
    a, b, c = faces.T
    whole = (a != b) & (b != c) & (c != a)
    some = faces if whole.all() else faces[whole]
    return bool(paired(np.ascontiguousarray(some, np.int32))[1] >= 0)


def is_valid(solid: Any) -> bool:
    """Whether manifold3d takes it as a closed, oriented, non-empty solid."""
    import manifold3d

    return bool(solid.status() == manifold3d.Error.NoError and not solid.is_empty())


def first_closed(
    vertices_mm: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Any, Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """The first closed solid among the file's own triangles, welded ever more; None if none is.

    With it come vertices and faces as they were welded last, for a later repair of the mesh.

    As they are: a file that shares vertices means it, and bodies that touch stay apart. Then equal
    vertices are one, as STL needs; then those that single precision may have parted.
    """
    extent = float(np.ptp(vertices_mm, axis=0).max())
    if len(vertices_mm) < 3 * len(faces):
        solid = as_manifold(vertices_mm, faces)
        if is_valid(solid):
            return solid, vertices_mm, faces
    for digits in (EQUAL_DIGITS, int(np.floor(-np.log10(extent * WELD_RATIO)))):
        vertices_mm, faces = weld(vertices_mm, faces, digits)
        solid = as_manifold(vertices_mm, faces)
        if is_valid(solid):
            return solid, vertices_mm, faces
    import trimesh

    # Slivers without area may hold a surface together, so they are removed last.
    faces = faces[trimesh.Trimesh(vertices_mm, faces, process=False).nondegenerate_faces()]
    solid = as_manifold(vertices_mm, faces)
    return solid if is_valid(solid) else None, vertices_mm, faces


def weld(
    vertices_mm: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], digits: int
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "f 3"]]:
    """Vertices that are equal when rounded to so many digits as one: the first of them.

    What `trimesh.Trimesh.merge_vertices` does, without sorting.
    """
    used = np.zeros(len(vertices_mm), dtype=bool)
    used[faces.ravel()] = True
    old = np.flatnonzero(used)
    rounded = np.round(vertices_mm[old] * 10.0**digits).astype(np.int64)
    first, same = first_of_each(rounded)
    new = np.full(len(vertices_mm), -1, np.int64)
    new[old] = same
    return np.ascontiguousarray(vertices_mm[old[first]]), new[faces]


def outside_out(solid: Any) -> tuple[Any, bool]:
    """A solid whose faces look outwards, and whether it had to be turned around."""
    if solid.volume() >= 0:
        return solid, False
    vertices_mm, faces = mesh_of(solid)
    return as_manifold(vertices_mm, faces[:, ::-1]), True


def unite_overlaps(solid: Any) -> tuple[Any, float]:
    """Unite bodies that overlap, whose common part would count twice; with its volume, mm³."""
    import manifold3d

    parts = solid.decompose()
    bodies = [part for part in parts if part.volume() > 0]
    if len(bodies) < 2 or len(bodies) < len(parts):
        return solid, 0.0  # which cavity belongs to which body is not ours to guess
    united = manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add)
    overlap_mm3 = float(sum(part.volume() for part in bodies) - united.volume())
    if not is_valid(united) or overlap_mm3 <= 1e-6 * united.volume():
        return solid, 0.0
    return united, overlap_mm3
