"""Scan files in: point clouds, height maps and meshes become a `Scan`.

It reads, and refuses with one sentence what it cannot read; it does not clean, scale or guess
frames. Points that are not finite are refused, not dropped (organised PCD and NaN cells of
height maps apart: there NaN is the format's word for "nothing seen").
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile
import trimesh
from jaxtyping import Float, Int

from amrepair.errors import InputError
from amrepair.scans.pcd import read_pcd
from amrepair.scans.ply import read_header, read_vertices, sensors_of, write_ply
from amrepair.scans.scan import Scan
from amrepair.scans.text import read_table

# What a structured-light scanner of the desktop class states; used where the file says nothing.
DEFAULT_SIGMA_MM = 0.04
MESH_SPACING_MM = 0.2
MAX_MESH_SAMPLES = 2_000_000
# A height map has no sensor; straight down from this far is straight down to a micrometre.
FAR_ABOVE_MM = 10_000.0
POINT_SUFFIXES = frozenset({".ply", ".pcd", ".xyz", ".txt", ".csv", ".asc", ".npy", ".npz"})
MESH_SUFFIXES = frozenset({".stl", ".obj", ".3mf"})
HEIGHT_SUFFIXES = frozenset({".tif", ".tiff"})

__all__ = ["read_height_map", "read_scan", "write_ply"]


def read_scan(
    path: Path,
    *,
    frame: str,
    sigma_mm: float | None = None,
    sensor_at: Sequence[float] | Float[np.ndarray, "k 3"] | None = None,
    cell_mm: float | None = None,
    origin_mm: tuple[float, float] | None = None,
) -> Scan:
    """Read a scan from a file.

    Parameters
    ----------
    path
        .ply, .pcd, .xyz/.txt/.csv/.asc, .npy/.npz, .tif/.tiff (height map), .stl/.obj/.3mf.
    frame
        The frame that the coordinates are in.
    sigma_mm
        Noise of one point; None takes the file's word, else 0.04 mm.
    sensor_at
        (3,) or (k, 3) origin of the rays, in `frame`; with several, the file must name the
        sensor of each point.
    cell_mm, origin_mm
        Placement of height maps that do not carry it.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty or of an unknown kind.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import read_scan
    >>> scan = read_scan(Path("scan.ply"), frame="build")
    >>> scan.points_mm.shape[1], scan.sigma_mm
    (3, 0.03)
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if not path.is_file():
        what = "is a folder; name a file in it" if path.is_dir() else "there is no such file"
        raise InputError(f"{path}: {what}")
    if suffix in HEIGHT_SUFFIXES or (suffix == ".npy" and _is_map(path)):
        scan = read_height_map(path, frame=frame, cell_mm=cell_mm, origin_mm=origin_mm)
    elif suffix == ".npz":
        scan = _read_npz(path, frame, cell_mm, origin_mm)
    elif suffix == ".ply":
        scan = _read_ply(path, frame)
    elif suffix == ".pcd":
        scan = _read_pcd(path, frame)
    elif suffix in POINT_SUFFIXES:
        scan = _read_table(path, frame)
    elif suffix in MESH_SUFFIXES:
        scan = _read_mesh(path, frame)
    else:
        known = sorted(POINT_SUFFIXES | MESH_SUFFIXES | HEIGHT_SUFFIXES)
        raise InputError(f"{path}: a scan is one of {', '.join(known)}, not '{suffix}'")
    return _with_word(scan, sigma_mm, sensor_at)


def _with_word(
    scan: Scan, sigma_mm: float | None, sensor_at: Sequence[float] | np.ndarray | None
) -> Scan:
    """The user's word on noise and sensors goes before the file's."""
    sensors, index = scan.sensors_mm, scan.sensor_index
    if sensor_at is not None:
        sensors = np.asarray(sensor_at, dtype=np.float64).reshape(-1, 3)
        if index is None or int(index.max()) >= len(sensors):
            if len(sensors) > 1:
                # a wrong ray crosses the part and calls it empty: the nearest is only a guess
                raise InputError(
                    f"{scan.source}: {len(sensors)} sensor positions are given, but the file does "
                    "not say which of them saw each point; give one, or a PLY with a 'sensor' "
                    "property"
                )
            index = np.zeros(len(scan.points_mm), np.int64)
    return Scan(
        points_mm=scan.points_mm,
        sigma_mm=scan.sigma_mm if sigma_mm is None else sigma_mm,
        frame=scan.frame,
        normals=scan.normals,
        sensors_mm=sensors,
        sensor_index=index,
        source=scan.source,
    )


def _from_columns(
    columns: dict[str, Float[np.ndarray, " n"]],
    path: Path,
    frame: str,
    *,
    sigma_mm: float = DEFAULT_SIGMA_MM,
    sensors_mm: Float[np.ndarray, "k 3"] | None = None,
    normal_names: tuple[str, str, str] = ("nx", "ny", "nz"),
) -> Scan:
    """A scan from named columns."""
    points = np.stack([columns[axis] for axis in "xyz"], axis=1)
    normals = None
    if set(normal_names) <= set(columns):
        raw = np.stack([columns[name] for name in normal_names], axis=1)
        length = np.linalg.norm(raw, axis=1, keepdims=True)
        # a cloud with absent normals carries zeros or NaN: then it has none
        if len(raw) and np.isfinite(length).all() and (length > 1e-6).mean() > 0.99:
            normals = raw / np.maximum(length, 1e-12)
    index: Int[np.ndarray, " n"] | None = None
    if sensors_mm is not None:
        column = columns.get("sensor", np.zeros(len(points)))
        index = np.clip(column, 0, len(sensors_mm) - 1).astype(np.int64)
    return Scan(points, sigma_mm, frame, normals, sensors_mm, index, str(path))


def _read_ply(path: Path, frame: str) -> Scan:
    data = _bytes(path)
    header = read_header(data, path)
    if header.faces > 0:
        return _read_mesh(path, frame)
    sigma_mm = DEFAULT_SIGMA_MM
    for comment in header.comments:
        words = comment.split()
        if len(words) == 2 and words[0] == "sigma_mm":
            try:
                sigma_mm = float(words[1])
            except ValueError:
                continue
    columns = read_vertices(data, header, path)
    return _from_columns(columns, path, frame, sigma_mm=sigma_mm, sensors_mm=sensors_of(header))


def _read_pcd(path: Path, frame: str) -> Scan:
    columns, header = read_pcd(_bytes(path), path)
    xyz = np.stack([columns[axis] for axis in "xyz"], axis=1)
    seen = ~np.isnan(xyz).all(axis=1)
    columns = {name: values[seen] for name, values in columns.items()}
    view = np.array(header.viewpoint_mm)
    # 0 0 0 is what writers put who know nothing of a viewpoint
    sensors = view.reshape(1, 3) if np.abs(view).max() > 0 else None
    names = ("normal_x", "normal_y", "normal_z")
    return _from_columns(columns, path, frame, sensors_mm=sensors, normal_names=names)


def _read_table(path: Path, frame: str) -> Scan:
    """Text or .npy rows of x y z, or x y z nx ny nz; one line of names is allowed in text."""
    if path.suffix.lower() == ".npy":
        table = _load_npy(path)
    else:
        text = _bytes(path).decode("utf-8", "replace")
        lines = [line for line in text.splitlines() if line.strip() and line[0] not in "#/;"]
        if lines and not _is_row(lines[0]):
            lines = lines[1:]
        if not lines:
            raise InputError(f"{path}: the file holds no points; check the export")
        delimiter = next((d for d in (",", ";") if d in lines[0]), None)
        table = read_table(lines, path, "the points", delimiter=delimiter)
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path}: rows need at least x y z, the array has shape {table.shape}")
    names = ["x", "y", "z", "nx", "ny", "nz"] if table.shape[1] == 6 else ["x", "y", "z"]
    return _from_columns({n: table[:, i] for i, n in enumerate(names)}, path, frame)


def _is_row(line: str) -> bool:
    """Whether a line is numbers."""
    try:
        [float(word) for word in line.replace(",", " ").replace(";", " ").split()]
    except ValueError:
        return False
    return True


def _read_npz(
    path: Path, frame: str, cell_mm: float | None, origin_mm: tuple[float, float] | None
) -> Scan:
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = {name: np.asarray(archive[name]) for name in archive.files}
    except (OSError, ValueError, KeyError, EOFError) as e:
        raise InputError(f"{path}: the archive cannot be read ({e})") from e
    if "z_mm" in stored:
        return read_height_map(path, frame=frame, cell_mm=cell_mm, origin_mm=origin_mm)
    points = stored.get("points_mm", stored.get("points"))
    if points is None or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: the archive needs points_mm (n, 3), it has {sorted(stored)}")
    sensors, index = stored.get("sensors_mm"), stored.get("sensor_index")
    normals = stored.get("normals")
    return Scan(
        points.astype(np.float64),
        float(stored.get("sigma_mm", DEFAULT_SIGMA_MM)),
        frame,
        None if normals is None else normals.astype(np.float64),
        None if sensors is None or index is None else sensors.astype(np.float64),
        None if sensors is None or index is None else index.astype(np.int64),
        str(path),
    )


def read_height_map(
    path: Path,
    *,
    frame: str,
    cell_mm: float | None = None,
    origin_mm: tuple[float, float] | None = None,
) -> Scan:
    """A height map as points seen straight from above; NaN cells were not seen.

    Raises
    ------
    InputError
        If it cannot be read or does not say how large its cells are.
    """
    from gcode.errors import InputError as GcodeInputError
    from gcode.surfaces import HeightField

    try:
        heights = HeightField.read(path, cell_mm=cell_mm, origin_mm=origin_mm)
    except GcodeInputError as e:
        raise InputError(str(e)) from e
    except (tifffile.TiffFileError, struct.error, ValueError, IndexError) as e:
        raise InputError(f"{path}: the height map cannot be read ({e})") from e
    x, y = heights.centres_mm()
    grid_x, grid_y = np.meshgrid(x, y)
    seen = heights.seen
    points = np.stack([grid_x[seen], grid_y[seen], heights.z_mm[seen]], axis=1).astype(np.float64)
    if len(points) == 0:
        raise InputError(f"{path}: the height map has no seen cell")
    middle = points.mean(axis=0)
    sensor = np.array([[middle[0], middle[1], middle[2] + FAR_ABOVE_MM]])
    index = np.zeros(len(points), np.int64)
    return Scan(points, DEFAULT_SIGMA_MM, frame, None, sensor, index, str(path))


def _read_mesh(path: Path, frame: str) -> Scan:
    """A scanned mesh, open ones too, as points spread evenly over it with its normals."""
    try:
        mesh = trimesh.load(path, force="mesh")
    except (ValueError, OSError, KeyError, IndexError, AttributeError, TypeError) as e:
        raise InputError(f"{path}: the mesh cannot be read ({e}); export it again") from e
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{path}: the mesh has no faces; export it again")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{path}: the mesh has vertices that are not finite numbers (NaN)")
    area = float(mesh.area)
    if area <= 0:
        raise InputError(f"{path}: the mesh has no area; export it again")
    count = int(np.clip(area / MESH_SPACING_MM**2, 1, MAX_MESH_SAMPLES))
    points, face = trimesh.sample.sample_surface(mesh, count, seed=0)
    normals = np.asarray(mesh.face_normals)[np.asarray(face)]
    return Scan(np.asarray(points, np.float64), DEFAULT_SIGMA_MM, frame, normals, source=str(path))


def _is_map(path: Path) -> bool:
    """Whether an .npy file is a height map: two dimensions, and not three or six columns."""
    table = _load_npy(path)
    return table.ndim == 2 and table.shape[1] not in {3, 6}


def _load_npy(path: Path) -> Float[np.ndarray, ...]:
    try:
        return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)
    except (OSError, ValueError, EOFError, TypeError) as e:
        raise InputError(f"{path}: the array cannot be read ({e})") from e


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: the file cannot be read ({e.strerror})") from e
