"""Scan files in: point clouds, range images, height maps and meshes become a `Scan`.

It reads, and refuses with one sentence what it cannot read; it does not clean or guess frames.
Points that are not finite are refused, not dropped, but in range images: there NaN is the format's
word for "nothing seen", a gap. Lengths are millimetres, but where the format (PTX, glTF) or the
file (a PLY's `comment unit m`) or the user says otherwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from amrepair.arrays import Numbers, Points, Values
from amrepair.errors import InputError, refused_as_ours
from amrepair.scans.arrays import is_map, load_npy, read_archive, read_height_map
from amrepair.scans.depth_map import read_depth_map
from amrepair.scans.mesh import read_mesh
from amrepair.scans.ply import millimetres_of, mm_per, read_grid, sensors_of, write_ply
from amrepair.scans.ptx import read_ptx
from amrepair.scans.range_grid import NO_POINT, RangeGrid, edge_flags
from amrepair.scans.scan import DEFAULT_SIGMA_MM, Scan
from amrepair.scans.viewpoint import viewpoint_of
from gcode.clouds.pcd import PcdHeader, read_pcd
from gcode.clouds.ply import read_header, read_vertices
from gcode.clouds.text import read_rows
from gcode.surfaces.depth_maps import is_depth_map
from gcode.whole import why_no_file

POINT_SUFFIXES = frozenset(
    {".ply", ".pcd", ".ptx", ".pts", ".xyz", ".txt", ".csv", ".asc", ".npy", ".npz", ".png"}
)
MESH_SUFFIXES = frozenset({".stl", ".obj", ".3mf", ".off", ".glb"})
UNIT_LENGTH_WITHIN, UNIT_LENGTH_SHARE = 0.05, 0.9  # two digits; some programs have gaps of 0 0 0
# glTF 2.0, 3.4: lengths are metres, and Y is up.
GLTF_MM = 1000.0 * np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
HEIGHT_SUFFIXES = frozenset({".tif", ".tiff"})
UNIT_IN_FORMAT = frozenset({".ptx", ".png", ".npz", ".glb", ".3mf"})

__all__ = ["read_height_map", "read_scan", "write_ply"]


def read_scan(
    path: Path,
    *,
    frame: str,
    sigma_mm: float | None = None,
    sensor_at: Sequence[float] | Float[np.ndarray, "k 3"] | None = None,
    cell_mm: float | None = None,
    origin_mm: tuple[float, float] | None = None,
    unit: str | None = None,
) -> Scan:
    """Read a scan from a file.

    Range images (PLY with `range_grid`, organised PCD, PTX, depth maps, height maps) bring their
    grid and edge flags; their sensor is taken from the file, else from the grid (`viewpoint_of`).

    Parameters
    ----------
    path
        .ply, .pcd, .ptx, .pts/.xyz/.txt/.csv/.asc, .npy/.npz, .png/.tif/.tiff with a camera's
        .json beside it (depth map), .tif/.tiff without (height map), .stl/.obj/.3mf/.off/.glb.
    frame
        The frame that the coordinates are in.
    sigma_mm
        Noise of one point; None takes the file's word, else 0.04 mm.
    sensor_at
        (3,) or (k, 3) origin of the rays, in `frame`; with several, the file must name the
        sensor of each point.
    cell_mm, origin_mm
        Placement of height maps that do not carry it.
    unit
        Of the file's lengths (mm, cm, m, um, in), where it does not say it itself; None is mm.

    Raises
    ------
    InputError
        If the file is missing, damaged, empty or of an unknown kind, or the unit is unknown or
        contradicts the file's own.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import read_scan
    >>> scan = read_scan(Path("scan.ply"), frame="build")
    >>> scan.points_mm.shape[1], scan.sigma_mm
    (3, 0.03)
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: {why_no_file(path)}")
    given_mm = None if unit is None else mm_per(unit, f"{path}: the scan's unit is")
    # what overflows is refused as not finite
    with np.errstate(all="ignore"), refused_as_ours():
        scan = _read(path, frame, cell_mm, origin_mm, given_mm)
        scan = _with_word(scan, sigma_mm, sensor_at)
        return _with_edges(scan)


def _read(
    path: Path,
    frame: str,
    cell_mm: float | None,
    origin_mm: tuple[float, float] | None,
    given_mm: float | None,
) -> Scan:
    """By the ending of its name, as the file has it; `given_mm` is the unit that the user says."""
    suffix = path.suffix.lower()
    is_image = is_depth_map(path)
    is_height = suffix in HEIGHT_SUFFIXES or (suffix == ".npy" and is_map(path))
    if given_mm is not None and (is_image or is_height or suffix in UNIT_IN_FORMAT):
        raise InputError(
            f"{path}: a scan of this kind has its unit by its format; leave the scan's unit out"
        )
    unit_mm = given_mm or 1.0
    if is_image:
        return read_depth_map(path, frame=frame, sigma_mm=DEFAULT_SIGMA_MM)
    if is_height:
        return read_height_map(path, frame=frame, cell_mm=cell_mm, origin_mm=origin_mm)
    if suffix == ".npz":
        return _read_npz(path, frame, cell_mm, origin_mm)
    if suffix == ".ply":
        return _read_ply(path, frame, given_mm)
    if suffix == ".pcd":
        return _read_pcd(path, frame, unit_mm)
    if suffix == ".ptx":
        return read_ptx(_bytes(path), path, frame=frame, sigma_mm=DEFAULT_SIGMA_MM)
    if suffix in POINT_SUFFIXES:
        return _read_table(path, frame, unit_mm)
    if suffix in MESH_SUFFIXES:
        unit = GLTF_MM if suffix == ".glb" else unit_mm * np.eye(3)
        return read_mesh(path, frame, DEFAULT_SIGMA_MM, mm_from_file=unit)
    known = sorted(POINT_SUFFIXES | MESH_SUFFIXES | HEIGHT_SUFFIXES)
    raise InputError(f"{path}: a scan is one of {', '.join(known)}, not '{suffix}'")


def _with_word(
    scan: Scan, sigma_mm: float | None, sensor_at: Sequence[float] | np.ndarray | None
) -> Scan:
    """The user's word on noise and sensors goes before the file's."""
    sensors, index = scan.sensors_mm, scan.sensor_index
    if sensor_at is not None:
        sensors = np.asarray(sensor_at, dtype=np.float64).reshape(-1, 3)
        if index is None or int(index.max()) >= len(sensors):
            if len(sensors) > 1:
                # A wrong ray would cross the part and call it empty, so none is guessed.
                raise InputError(
                    f"{scan.source}: {len(sensors)} sensor positions are given, but the file does "
                    "not say which of them saw each point; give one, or a PLY with a 'sensor' "
                    "property"
                )
            index = np.zeros(len(scan.points_mm), np.int64)
    return replace(
        scan,
        sigma_mm=scan.sigma_mm if sigma_mm is None else sigma_mm,
        sensors_mm=sensors,
        sensor_index=index,
    )


def _with_edges(scan: Scan) -> Scan:
    """What a range image's grid tells: its sensor, where nobody named it, and its edges."""
    if scan.grids is None:
        return scan
    sensors, index, grids = scan.sensors_mm, scan.sensor_index, scan.grids
    if sensors is None and len(grids) == 1 and len(grids[0].points) == len(scan):
        seen = viewpoint_of(scan.points_mm, grids[0])
        if seen is not None:
            sensors, index = seen.sensors_mm, np.empty(len(scan), np.int64)
            index[grids[0].points] = seen.sensor_index
            grids = (RangeGrid(grids[0].index, seen.kind),)
    edge = edge_flags(scan.points_mm, grids, sensors, index) if scan.edge is None else scan.edge
    return replace(scan, sensors_mm=sensors, sensor_index=index, grids=grids, edge=edge)


def _from_columns(
    columns: dict[str, Values],
    path: Path,
    frame: str,
    *,
    sigma_mm: float = DEFAULT_SIGMA_MM,
    sensors_mm: Float[np.ndarray, "k 3"] | None = None,
    normal_names: tuple[str, str, str] = ("nx", "ny", "nz"),
    grid: RangeGrid | None = None,
    unit_mm: float = 1.0,
) -> Scan:
    """A scan from named columns."""
    points = np.stack([columns[axis] for axis in "xyz"], axis=1) * unit_mm
    normals = None
    if set(normal_names) <= set(columns):
        raw = np.stack([columns[name] for name in normal_names], axis=1)
        length = np.linalg.norm(raw, axis=1, keepdims=True)
        # A cloud without normals may carry zeros or NaN in their place.
        if len(raw) and np.isfinite(length).all() and (length > 1e-6).mean() > 0.99:
            normals = raw / np.maximum(length, 1e-12)
    index = None if sensors_mm is None else _which_sensor(columns, len(sensors_mm), path)
    edge: UInt8[np.ndarray, " n"] | None = None
    if "edge" in columns:
        edge = np.clip(np.nan_to_num(columns["edge"]), 0, 255).astype(np.uint8)
    grids = None if grid is None else (grid,)
    return Scan(points, sigma_mm, frame, normals, sensors_mm, index, str(path), grids, edge)


def _which_sensor(columns: dict[str, Values], sensors: int, path: Path) -> Numbers:
    """(n,) which of the file's sensors saw each point."""
    if "sensor" not in columns:
        if sensors != 1:  # a wrong ray would cross the part and call it empty, so none is guessed
            raise InputError(
                f"{path}: the file names {sensors} sensors, and not which of them saw each point; "
                "write that into it, too, or one sensor"
            )
        return np.zeros(len(columns["x"]), np.int64)
    told = columns["sensor"]
    if not ((told >= 0) & (told < sensors)).all():
        raise InputError(f"{path}: points name sensors that are none of the file's {sensors}")
    return told.astype(np.int64)


def _read_npz(
    path: Path, frame: str, cell_mm: float | None, origin_mm: tuple[float, float] | None
) -> Scan:
    """An archive with `points_mm` (and `normals`, `sigma_mm`, sensors), or a map with `z_mm`."""
    stored = read_archive(path)
    if "z_mm" in stored:
        return read_height_map(path, frame=frame, cell_mm=cell_mm, origin_mm=origin_mm)
    points = stored.get("points_mm", stored.get("points"))
    if points is None or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: the archive needs points_mm (n, 3), it has {sorted(stored)}")
    normals, sensors = stored.get("normals", points), stored.get("sensors_mm", np.zeros((1, 3)))
    index = stored.get("sensor_index", points[:, 0])
    sigma = stored.get("sigma_mm", np.array(DEFAULT_SIGMA_MM))
    if (
        normals.shape != points.shape or index.shape != (len(points),)
        or sensors.shape[1:] != (3,) or sigma.size != 1
    ):  # fmt: skip
        raise InputError(
            f"{path}: normals are as many as points, sensors_mm is (k, 3), sensor_index (n,), and "
            "sigma_mm one number"
        )
    columns = dict(zip("xyz", points.T.astype(np.float64), strict=True))
    if "normals" in stored:
        columns |= zip(("nx", "ny", "nz"), normals.T.astype(np.float64), strict=True)
    if "sensor_index" in stored:
        columns["sensor"] = index.astype(np.float64)
    return _from_columns(
        columns, path, frame,
        sigma_mm=float(sigma.reshape(())),
        sensors_mm=sensors.astype(np.float64) if "sensors_mm" in stored else None,
    )  # fmt: skip


def _read_ply(path: Path, frame: str, given_mm: float | None) -> Scan:
    data = _bytes(path)
    header = read_header(data, path)
    unit_mm = millimetres_of(header, path, given_mm)
    if header.count_of("face") > 0:
        return read_mesh(path, frame, DEFAULT_SIGMA_MM, mm_from_file=unit_mm * np.eye(3))
    sigma_mm = DEFAULT_SIGMA_MM
    said = header.said("sigma_mm")
    if said is not None:
        try:
            sigma_mm = float(said)
        except ValueError as e:
            raise InputError(f"{path}: the PLY file's sigma_mm is '{said[:20]}'") from e
    columns, rest = read_vertices(data, header, path)
    grid = read_grid(rest, header, path)
    if grid is not None:
        columns, grid = _without_gaps(columns, grid)
    return _from_columns(
        columns, path, frame,
        sigma_mm=sigma_mm, sensors_mm=sensors_of(header, path), grid=grid, unit_mm=unit_mm,
    )  # fmt: skip


def _read_pcd(path: Path, frame: str, unit_mm: float) -> Scan:
    columns, header = read_pcd(_bytes(path), path)
    grid = None
    if header.shape is not None:
        grid = RangeGrid(np.arange(header.points, dtype=np.int32).reshape(header.shape))
        columns, grid = _without_gaps(columns, grid)
    else:
        nothing = np.isnan([columns[axis] for axis in "xyz"]).all(axis=0)
        columns = {name: values[~nothing] for name, values in columns.items()}
    sensors, kind = _viewpoint(columns, grid, header)
    if grid is not None and kind:
        grid = RangeGrid(grid.index, "perspective")
    names = ("normal_x", "normal_y", "normal_z")
    return _from_columns(
        columns, path, frame,
        sensors_mm=None if sensors is None else unit_mm * sensors,
        normal_names=names, grid=grid, unit_mm=unit_mm,
    )  # fmt: skip


def _without_gaps(
    columns: dict[str, Values], grid: RangeGrid
) -> tuple[dict[str, Float[np.ndarray, " m"]], RangeGrid]:
    """Points of a range image that are NaN are gaps.

    So are those that lie in the origin, where there are several: some drivers write 0 0 0 for
    NaN, and no two pixels see one point.
    """
    xyz = np.stack([columns[axis] for axis in "xyz"])
    gap = np.isnan(xyz).any(axis=0)
    nought = (xyz == 0).all(axis=0)
    if np.count_nonzero(nought) > 1:
        gap |= nought
    if not gap.any():
        return columns, grid
    number = np.where(gap, NO_POINT, np.cumsum(~gap) - 1).astype(np.int32)
    index = np.where(grid.index >= 0, number[np.maximum(grid.index, 0)], np.int32(NO_POINT))
    return {name: values[~gap] for name, values in columns.items()}, RangeGrid(index, grid.kind)


def _viewpoint(
    columns: dict[str, Values], grid: RangeGrid | None, header: PcdHeader
) -> tuple[Float[np.ndarray, "1 3"] | None, bool]:
    """Where a PCD file's VIEWPOINT puts the sensor, and whether rays meet there.

    Some programs write points in the sensor's own frame and its place in another one, others
    write both in one frame. The grid of an organised cloud tells which: where rays meet in the
    origin, the points are the sensor's own. The points stay as the file has them.
    """
    place, turn = np.array(header.viewpoint_mm), np.array(header.viewpoint_wxyz)
    # 0 0 0 1 0 0 0 is what writers put who know nothing of a viewpoint
    if not np.isfinite(place).all() or not (np.abs(place).max() > 0 or np.abs(turn[1:]).max() > 0):
        return None, False
    points = np.stack([columns[axis] for axis in "xyz"], axis=1)
    if grid is not None and np.isfinite(points).all():
        seen = viewpoint_of(points, grid)
        if seen is not None and seen.kind == "perspective":
            return seen.sensors_mm, True
    return place.reshape(1, 3), True


def _read_table(path: Path, frame: str, unit_mm: float) -> Scan:
    """Text or .npy rows of x y z, or x y z nx ny nz; one line of names, or a count, may be before.

    Six columns may be x y z and a colour, too: normals are as long as one another, colours are not.
    """
    table = load_npy(path) if path.suffix.lower() == ".npy" else read_rows(_bytes(path), path)
    if table.ndim != 2 or table.shape[1] < 3:
        raise InputError(f"{path}: rows need at least x y z, the array has shape {table.shape}")
    names = ["x", "y", "z"]
    if table.shape[1] == 6 and _are_unit(table[:, 3:]):
        names += ["nx", "ny", "nz"]
    columns = {n: table[:, i] for i, n in enumerate(names)}
    return _from_columns(columns, path, frame, unit_mm=unit_mm)


def _are_unit(vectors: Points) -> bool:
    """Whether nearly all are of length 1, as files round it."""
    length = np.linalg.norm(vectors, axis=1)
    return bool((np.abs(length - 1.0) < UNIT_LENGTH_WITHIN).mean() > UNIT_LENGTH_SHARE)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as e:
        raise InputError(f"{path}: the file cannot be read ({e.strerror})") from e
