"""PLY scans: range images in, points out as binary; the header and the vertices: `gcode.clouds`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Numbers
from amrepair.errors import InputError
from amrepair.scans.range_grid import NO_POINT, RangeGrid
from amrepair.scans.range_grid_kernels import lists_of_bytes, lists_of_numbers
from amrepair.scans.scan import Scan
from gcode.clouds.ply import TYPES, PlyHeader, PlyList

SENSOR_COMMENT = "sensor_mm"
MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "in": 25.4, "inch": 25.4}
GRID_ELEMENT = "range_grid"


def read_grid(rest: memoryview, header: PlyHeader, path: Path) -> RangeGrid | None:
    """The grid of a range image, of the data after the vertices; None where there is none.

    An element `range_grid` holds for each pixel a list of no vertex or of one, row after row, as
    the range images of the Stanford 3D Scanning Repository have it; `obj_info num_cols` and
    `num_rows` say how many.

    Raises
    ------
    InputError
        If the grid's size is not told or not kept, or it names vertices that are not there.
    """
    if header.count_of(GRID_ELEMENT) == 0:
        return None
    grid = header.elements[1]
    kinds = [kind for _, kind in grid.properties]
    if grid.name != GRID_ELEMENT or len(kinds) != 1 or not isinstance(kinds[0], PlyList):
        raise InputError(
            f"{path}: the PLY file's range_grid is not one list a pixel right after the vertices"
        )
    try:
        rows, columns = (int(header.said(name) or "") for name in ("num_rows", "num_cols"))
    except ValueError as e:
        raise InputError(
            f"{path}: the PLY file has a range_grid but no obj_info num_rows and num_cols; "
            "export it again"
        ) from e
    if rows * columns != grid.count or rows < 1:
        raise InputError(
            f"{path}: the PLY file's range_grid has {grid.count} pixels, not {rows} rows of "
            f"{columns} columns; it is damaged"
        )
    entries = _grid_entries(rest, header.order, kinds[0], grid.count, path)
    if int(entries.min()) < NO_POINT or int(entries.max()) >= header.elements[0].count:
        raise InputError(
            f"{path}: a pixel of the PLY file's range_grid is neither a gap nor one of its "
            f"{header.elements[0].count} vertices; it is damaged"
        )
    if int(np.bincount(entries[entries >= 0], minlength=1).max()) > 1:
        raise InputError(
            f"{path}: two pixels of the PLY file's range_grid name one vertex; it is damaged"
        )
    return RangeGrid(entries.astype(np.int32).reshape(rows, columns))


def _grid_entries(rest: memoryview, order: str, kind: PlyList, count: int, path: Path) -> Numbers:
    """One number a pixel: its vertex, or -1 for a gap; others are errors."""
    if order == "":
        try:
            numbers = np.array(bytes(rest).split()).astype(np.int64)
        except (ValueError, OverflowError) as e:
            raise InputError(f"{path}: the PLY file's range_grid has words in it ({e})") from e
        entries, end = lists_of_numbers(numbers, count)
    else:
        if "f" in kind.entry:
            raise InputError(f"{path}: the PLY file's range_grid names vertices by fractions")
        entries, end = lists_of_bytes(
            np.frombuffer(rest, np.uint8),
            count,
            np.dtype(kind.length).itemsize,
            np.dtype(kind.entry).itemsize,
            order == ">",
        )
    if end < 0:
        raise InputError(f"{path}: the PLY file's range_grid breaks off; the file is cut off")
    return entries


def mm_per(unit: str, said: str) -> float:
    """Millimetres of a unit by its short name.

    Raises
    ------
    InputError
        If there is none of that name; it begins with what was `said` and where.
    """
    if unit.lower() not in MM_PER:
        raise InputError(f"{said} '{unit[:20]}'; known are {', '.join(MM_PER)}")
    return MM_PER[unit.lower()]


def millimetres_of(header: PlyHeader, path: Path, given_mm: float | None) -> float:
    """Millimetres in the file's unit: `comment unit m` or `obj_info unit m`; else as given, or 1.

    Raises
    ------
    InputError
        If the unit is unknown, or another one is given.
    """
    unit = header.said("unit")
    if unit is None:
        return given_mm or 1.0
    own_mm = mm_per(unit, f"{path}: the PLY file's unit is")
    if given_mm is not None and given_mm != own_mm:
        raise InputError(
            f"{path}: the PLY file says that its unit is '{unit}', of {own_mm:g} mm, and one of "
            f"{given_mm:g} mm is given; leave the scan's unit out, or mend the file"
        )
    return own_mm


def sensors_of(header: PlyHeader, path: Path) -> Float[np.ndarray, "k 3"] | None:
    """Sensor origins from `comment sensor_mm x y z` lines, in order; None without any."""
    found = [c.split()[1:4] for c in header.comments if c.startswith(SENSOR_COMMENT)]
    try:
        return np.array(found, dtype=np.float64).reshape(-1, 3) if found else None
    except ValueError as e:
        raise InputError(f"{path}: the PLY file's {SENSOR_COMMENT} is no three numbers") from e


def write_ply(
    scan: Scan,
    path: Path,
    *,
    colours: Int[np.ndarray, "n 3"] | None = None,
    scalars: dict[str, np.ndarray] | None = None,
) -> None:
    """Write a scan as binary PLY: points, normals, colours, named scalars, sensors, edges, noise.

    Parameters
    ----------
    colours
        (n, 3) 0…255.
    scalars
        Name → (n,) values, written as float properties.
    """
    n = len(scan)
    columns: list[tuple[str, str, np.ndarray]] = [
        (axis, "double", scan.points_mm[:, i]) for i, axis in enumerate("xyz")
    ]
    if scan.normals is not None:
        columns += [("n" + axis, "float", scan.normals[:, i]) for i, axis in enumerate("xyz")]
    if colours is not None:
        columns += [(c, "uchar", colours[:, i]) for i, c in enumerate(("red", "green", "blue"))]
    if scan.sensor_index is not None:
        columns.append(("sensor", "int", scan.sensor_index))
    if scan.edge is not None:
        columns.append(("edge", "uchar", scan.edge))
    for name, values in (scalars or {}).items():
        if len(values) != n:
            raise InputError(f"the scalar '{name}' has {len(values)} values for {n} points")
        columns.append((name, "float", values))
    rows = np.zeros(n, np.dtype([(name, "<" + TYPES[kind]) for name, kind, _ in columns]))
    for name, _, values in columns:
        rows[name] = values
    sensors = [] if scan.sensors_mm is None else scan.sensors_mm.tolist()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment unit mm",
        f"comment frame {scan.frame}",
        f"comment sigma_mm {scan.sigma_mm!r}",
        *(f"comment {SENSOR_COMMENT} {x!r} {y!r} {z!r}" for x, y, z in sensors),
        f"element vertex {n}",
        *(f"property {kind} {name}" for name, kind, _ in columns),
        "end_header",
    ]
    try:
        path.write_bytes(("\n".join(header) + "\n").encode("ascii") + rows.tobytes())
    except OSError as e:
        raise InputError(f"{path}: the scan cannot be written ({e.strerror})") from e
