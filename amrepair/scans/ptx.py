"""PTX: the grids of terrestrial laser scanners, several stations in one file.

Each station: columns, rows, the scanner's place, its three axes, a 4×4 matrix (it acts on row
vectors: the translation is its last row), then a line `x y z intensity [r g b]` for each pixel,
column after column. Lengths are metres, in the scanner's own frame; where nothing came back the
line says 0 0 0. The format is Leica's (Cyclone).
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amrepair.arrays import Matrix, Points, Vector
from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans.range_grid import RangeGrid
from amrepair.scans.scan import Scan
from gcode.clouds.text import filled, read_table
from gcode.surfaces.sizes import refuse_short

MM_PER_M = 1000.0
HEADER_LINES = 10
PIXEL_BYTES = 6  # "0 0 0" and the end of its line


@dataclass(frozen=True, slots=True)
class _Station:
    """One scan of a file: its seen points and its place, in the file's frame."""

    points_mm: Points
    sensor_mm: Vector
    grid: RangeGrid


def read_ptx(data: bytes, path: Path, *, frame: str, sigma_mm: float) -> Scan:
    """All stations of a file, in its common frame, as millimetres.

    Raises
    ------
    InputError
        If a header is none, a matrix is not rigid, or the file is shorter than it promises.
    """
    text = io.BytesIO(data)
    lines = filled(text)
    stations: list[_Station] = []
    first = 0
    while (head := next(lines, None)) is not None:
        stations.append(_station(head, lines, text, len(data), path, first))
        first += len(stations[-1].points_mm)
    if first == 0:
        raise InputError(f"{path}: the PTX file has no seen point; scan again or check the export")
    return Scan(
        points_mm=np.concatenate([s.points_mm for s in stations]),
        sigma_mm=sigma_mm,
        frame=frame,
        sensors_mm=np.stack([s.sensor_mm for s in stations]),
        sensor_index=np.repeat(np.arange(len(stations)), [len(s.points_mm) for s in stations]),
        source=str(path),
        grids=tuple(s.grid for s in stations),
    )


def _station(
    head: bytes, lines: Iterator[bytes], text: io.BytesIO, size: int, path: Path, first: int
) -> _Station:
    """The station whose first line is `head`; its points are counted from `first`."""
    columns, rows, place_m, matrix = _header(head, lines, path)
    pixels = columns * rows
    refuse_short(
        path, f"{columns} columns of {rows} rows", pixels * PIXEL_BYTES - 1, size - text.tell()
    )
    table = read_table(lines, path, "the PTX text", max_rows=pixels)
    if len(table) != pixels or table.shape[1] < 3:
        raise InputError(
            f"{path}: the PTX header promises {columns} columns of {rows} rows, the file holds "
            f"{len(table)} of {pixels} points; it is cut off"
        )
    by_row = table[:, :3].reshape(columns, rows, 3).transpose(1, 0, 2)
    seen = ~np.isnan(by_row).any(axis=2) & (by_row != 0).any(axis=2)
    if not np.isfinite(by_row[seen]).all():
        raise InputError(f"{path}: the PTX file has a point at infinity; it is damaged")
    # Some programs write points in the common frame already: they give a place and no matrix.
    moved = bool(np.abs(matrix - np.eye(4)).max() > 0)
    build = _rigid(matrix, path) if moved else None
    points_mm = by_row[seen] * MM_PER_M
    if build is not None:
        points_mm = build.apply(points_mm)
    sensor_mm = build.translation_mm.copy() if build is not None else place_m * MM_PER_M
    return _Station(points_mm, sensor_mm, RangeGrid.of_seen(seen, "perspective", first=first))


def _header(head: bytes, lines: Iterator[bytes], path: Path) -> tuple[int, int, Vector, Matrix]:
    """Columns, rows, the scanner's place and the matrix that acts on column vectors, metres."""
    try:
        said = [head, *(next(lines) for _ in range(HEADER_LINES - 1))]
        columns, rows = int(said[0]), int(said[1])
        place = np.array(said[2].split(), dtype=np.float64)
        matrix = np.array([line.split() for line in said[6:10]], dtype=np.float64).T
        if place.shape != (3,) or matrix.shape != (4, 4) or columns < 1 or rows < 1:
            raise ValueError("counts and a matrix of other sizes")
    except (ValueError, StopIteration, RuntimeError, OverflowError) as e:
        raise InputError(
            f"{path}: not a PTX header (columns, rows, the scanner's place, three axes and a 4×4 "
            "matrix, a line each); export it again"
        ) from e
    return columns, rows, place, matrix


def _rigid(matrix: Matrix, path: Path) -> Transform:
    """The matrix as a motion in millimetres."""
    in_mm = matrix.copy()
    in_mm[:3, 3] *= MM_PER_M
    try:
        return Transform("file", "station", in_mm)
    except InputError as e:
        raise InputError(f"{path}: a matrix of the PTX file cannot be used: {e}") from e
