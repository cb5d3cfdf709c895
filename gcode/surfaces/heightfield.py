"""`HeightField`: the top surface over a regular XY grid, and what one may ask of it.

Reads and writes `.npz` (complete), `.tif`/`.tiff` (float heights, NaN = unseen, placement in the
description) and `.npy` (heights alone). It holds one height per column: undercuts are not here.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from gcode.compiled import read_only
from gcode.errors import InputError
from gcode.surfaces import raster_kernels as kernels
from gcode.surfaces.sizes import (
    PARSER_ERRORS,
    UnpackLimit,
    in_words,
    quiet_tiff,
    refuse_swollen_page,
)

MOST_READ_CELLS = 20_000_000  # of a file: a bed of 400 mm in cells of 0.1 mm, and then some
MAX_FIELD_CELLS = 60_000_000  # half a gigabyte of heights: beyond that a cell size is a mistake


@dataclass(frozen=True, slots=True)
class HeightField:
    """Top surface over a regular XY grid, build frame.

    Attributes
    ----------
    origin_mm
        (2,) XY of the *corner* of cell [0, 0]; cell [iy, ix] has its centre at
        origin + (ix + ½, iy + ½) × cell.
    cell_mm
        Edge of a square cell.
    z_mm
        (ny, nx) height of the top surface; 0 is the bed. Unseen cells carry the height that
        is safe for collisions, since unseen may be solid, and are False in `seen`.
    seen
        (ny, nx) whether a sensor measured the cell.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> standing = gcode.HeightField.from_manifold(gcode.read_solid(Path("placed.stl")), 0.5)
    >>> round(standing.top_mm, 1)
    9.0
    """

    origin_mm: Float[np.ndarray, " 2"]
    cell_mm: float
    z_mm: Float[np.ndarray, "ny nx"]
    seen: Bool[np.ndarray, "ny nx"]

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return (int(self.z_mm.shape[0]), int(self.z_mm.shape[1]))

    @property
    def top_mm(self) -> float:
        """Height of the highest cell; 0 for a field without cells."""
        return float(self.z_mm.max()) if self.z_mm.size else 0.0

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max)."""
        ny, nx = self.shape
        x, y = float(self.origin_mm[0]), float(self.origin_mm[1])
        return (x, y, x + nx * self.cell_mm, y + ny * self.cell_mm)

    def centres_mm(self) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " ny"]]:
        """X of the columns and Y of the rows, at the cells' centres."""
        ny, nx = self.shape
        return (
            self.origin_mm[0] + (np.arange(nx) + 0.5) * self.cell_mm,
            self.origin_mm[1] + (np.arange(ny) + 0.5) * self.cell_mm,
        )

    def cells_of(self, xy_mm: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        """(n, 2) indices (iy, ix) of the cells that hold the points; may lie outside."""
        index = np.floor((xy_mm - self.origin_mm) / self.cell_mm).astype(np.int64)
        return np.ascontiguousarray(index[:, ::-1])

    def rows_and_columns_of(
        self, other: HeightField
    ) -> tuple[Int[np.ndarray, " rows"], Int[np.ndarray, " columns"]]:
        """Rows and columns of this field that hold the middles of another's; may lie outside."""
        x_mm, y_mm = other.centres_mm()
        iy, ix = (
            np.floor((mm - low_mm) / self.cell_mm).astype(np.int64)
            for mm, low_mm in ((y_mm, self.origin_mm[1]), (x_mm, self.origin_mm[0]))
        )
        return iy, ix

    def sample(
        self, xy_mm: Float[np.ndarray, "n 2"], *, smooth: bool = False, outside_mm: float = 0.0
    ) -> Float[np.ndarray, " n"]:
        """Heights at points: of the cell that holds each, or bilinear between centres.

        Parameters
        ----------
        xy_mm
            Points, build frame.
        smooth
            Interpolate; leave it off near steep walls, which interpolation smears.
        outside_mm
            Height beyond the field (the bed).
        """
        ny, nx = self.shape
        if ny == 0 or nx == 0:
            return np.full(len(xy_mm), outside_mm)
        index = self.cells_of(xy_mm)
        inside = ((index >= 0) & (index < (ny, nx))).all(axis=1)
        iy = np.clip(index[:, 0], 0, ny - 1)
        ix = np.clip(index[:, 1], 0, nx - 1)
        z_mm = self.z_mm[iy, ix].astype(np.float64)
        if smooth:
            place = (xy_mm - self.origin_mm) / self.cell_mm - 0.5
            low = np.clip(np.floor(place).astype(np.int64), 0, (max(nx - 2, 0), max(ny - 2, 0)))
            u, v = np.clip(place - low, 0.0, 1.0).T
            x0, y0 = low.T
            x1, y1 = np.minimum(x0 + 1, nx - 1), np.minimum(y0 + 1, ny - 1)
            z = self.z_mm
            z_mm = (z[y0, x0] * (1 - u) + z[y0, x1] * u) * (1 - v)
            z_mm += (z[y1, x0] * (1 - u) + z[y1, x1] * u) * v
        return np.where(inside, z_mm, outside_mm)

    def max_within(
        self,
        polygon_mm: Sequence[tuple[float, float]],
        window: tuple[slice, slice] | None = None,
        *,
        aside_mm: float = 0.0,
        widening_mm: float = 0.0,
        height_mm: float = 0.0,
    ) -> Float[np.ndarray, "_my _mx"]:
        """Greatest height under a convex polygon placed with its origin on each cell's centre.

        Or under a cone of which it is the lower rim: what lies farther out counts for less, by as
        much as the cone is higher there.

        Parameters
        ----------
        polygon_mm
            Convex outline relative to the cell's centre. Every cell that it touches counts, so
            the answer is never too low.
        window
            Rows and columns of the cells that are asked about; all by default.
        aside_mm
            The origin may lie this far from its cell's centre, each way.
        widening_mm, height_mm
            How far the cone's upper rim lies outside of the polygon, and above it. The head must
            be wider there: the cone is taken to go on for two cells.
        """
        ny, nx = self.shape
        rows, columns = window or (slice(0, ny), slice(0, nx))
        if widening_mm > 0:
            far = widening_mm / self.cell_mm
            margin = math.ceil(far) + 2
            wider = tuple(slice(w.start - margin, w.stop + margin) for w in (rows, columns))
            under = self.max_within(polygon_mm, (wider[0], wider[1]), aside_mm=aside_mm)
            found = kernels.less_with_distance(under, height_mm / far, far + 2.0)
            return np.asarray(found[margin : len(found) - margin, margin : len(found[0]) - margin])
        dy, low, high = footprint_rows(polygon_mm, self.cell_mm, aside_mm=aside_mm)
        box = len(dy) > 0 and (low == low[0]).all() and (high == high[0]).all()
        if not box:
            return kernels.dilate_rows(
                read_only(self.z_mm, np.float64), dy, low, high,
                rows.start, rows.stop, columns.start, columns.stop,
            )  # fmt: skip
        wide = _greatest_of_next(
            self.z_mm.astype(np.float64), columns.start + int(low[0]), columns.stop - columns.start,
            int(high[0] - low[0]) + 1, axis=1,
        )  # fmt: skip
        return _greatest_of_next(
            wide, rows.start + int(dy[0]), rows.stop - rows.start, len(dy), axis=0
        )

    def window(self, box_mm: tuple[float, float, float, float]) -> tuple[slice, slice]:
        """Rows and columns of the cells that touch (x_min, y_min, x_max, y_max)."""
        ny, nx = self.shape
        low = np.floor((np.array(box_mm[:2]) - self.origin_mm) / self.cell_mm).astype(int)
        high = np.ceil((np.array(box_mm[2:]) - self.origin_mm) / self.cell_mm).astype(int)
        x0, x1 = (int(v) for v in np.clip((low[0], high[0]), 0, nx))
        y0, y1 = (int(v) for v in np.clip((low[1], high[1]), 0, ny))
        return slice(y0, y1), slice(x0, x1)

    def crop(self, box_mm: tuple[float, float, float, float]) -> HeightField:
        """Cells that touch (x_min, y_min, x_max, y_max); empty if none does."""
        rows, columns = self.window(box_mm)
        return HeightField(
            origin_mm=self.origin_mm + np.array([columns.start, rows.start]) * self.cell_mm,
            cell_mm=self.cell_mm,
            z_mm=self.z_mm[rows, columns].copy(),
            seen=self.seen[rows, columns].copy(),
        )

    def coarsened(self, factor: int) -> HeightField:
        """Cells joined by `factor` each way, each as high as its highest; seen if all were."""
        if factor <= 1:
            return self
        ny, nx = self.shape
        rows, columns = -(-ny // factor), -(-nx // factor)
        z_mm = np.full((rows * factor, columns * factor), -np.inf)
        seen = np.ones(z_mm.shape, dtype=bool)
        z_mm[:ny, :nx], seen[:ny, :nx] = self.z_mm, self.seen
        blocks = (rows, factor, columns, factor)
        return HeightField(
            self.origin_mm,
            self.cell_mm * factor,
            z_mm.reshape(blocks).max(axis=(1, 3)),
            np.asarray(seen.reshape(blocks).all(axis=(1, 3))),
        )

    def raised(self, z_mm: Float[np.ndarray, "ny nx"]) -> HeightField:
        """The same grid with heights max(z, own)."""
        return HeightField(self.origin_mm, self.cell_mm, np.maximum(self.z_mm, z_mm), self.seen)

    def raised_by(self, other: HeightField) -> HeightField:
        """As high as another field's cells whose middles lie within its own, or higher."""
        iy, ix = self.rows_and_columns_of(other)
        ny, nx = self.shape
        rows, columns = (iy >= 0) & (iy < ny), (ix >= 0) & (ix < nx)
        z_mm = self.z_mm.astype(np.float64)
        np.maximum.at(z_mm, np.ix_(iy[rows], ix[columns]), other.z_mm[np.ix_(rows, columns)])
        return HeightField(self.origin_mm, self.cell_mm, z_mm, self.seen)

    def write(self, path: Path) -> None:
        """Write `.npz` (all), `.tif`/`.tiff` (heights and placement) or `.npy` (heights)."""
        suffix = path.suffix.lower()
        placement = {"origin_mm": self.origin_mm.tolist(), "cell_mm": self.cell_mm}
        shown = np.where(self.seen, self.z_mm, np.nan).astype(np.float32)
        if suffix == ".npz":
            np.savez_compressed(
                path, origin_mm=self.origin_mm, cell_mm=self.cell_mm, z_mm=self.z_mm, seen=self.seen
            )
        elif suffix in {".tif", ".tiff"}:
            import tifffile

            tifffile.imwrite(path, shown, description=json.dumps(placement))
        elif suffix == ".npy":
            np.save(path, shown)
        else:
            raise InputError(
                f"{path}: a height map is written as .npz, .tif or .npy, not '{suffix}'."
            )

    @classmethod
    def read(
        cls,
        path: Path,
        *,
        cell_mm: float | None = None,
        origin_mm: tuple[float, float] | None = None,
    ) -> HeightField:
        """Read what `write` writes; cells that are no number are as high as the highest seen.

        Parameters
        ----------
        cell_mm, origin_mm
            Placement for files that carry none (`.npy`, plain TIFF); origin defaults to 0, 0.

        Raises
        ------
        InputError
            Where the file cannot be read or its placement is unknown.
        """
        z_mm, placement, seen = _read_heights(path)
        cell = cell_mm if cell_mm is not None else placement.get("cell_mm")
        origin = origin_mm if origin_mm is not None else placement.get("origin_mm", (0.0, 0.0))
        if cell is None:
            raise InputError(f"{path}: the height map does not say its cell size; pass one in mm.")
        try:
            cell, origin = float(cell), np.asarray(origin, float).reshape(2)
        except (TypeError, ValueError) as e:
            raise InputError(f"{path}: its placement is {cell!r} at {origin!r}, no numbers.") from e
        if (
            not 0 < cell < math.inf
            or not np.isfinite(origin).all()
            or z_mm.ndim != 2
            or z_mm.size == 0
        ):
            raise InputError(
                f"{path}: a height map needs two dimensions and a cell above 0 mm, "
                f"not shape {z_mm.shape} and cell {cell} mm."
            )
        finite = np.isfinite(z_mm)
        if seen is not None and seen.shape != z_mm.shape:
            raise InputError(f"{path}: it has heights {z_mm.shape} and says of {seen.shape}, seen.")
        if not finite.any():
            raise InputError(f"{path}: the height map holds no finite height.")
        solid_mm = float(z_mm[finite].max())  # unseen is solid
        return cls(
            origin_mm=origin,
            cell_mm=cell,
            z_mm=np.where(finite, z_mm, solid_mm),
            seen=finite if seen is None else seen & finite,
        )

    @classmethod
    def flat(
        cls,
        size_mm: tuple[float, float],
        cell_mm: float,
        *,
        z_mm: float = 0.0,
        origin_mm: tuple[float, float] = (0.0, 0.0),
    ) -> HeightField:
        """A plane of `size_mm` at one height; `origin_mm` is its corner of least X and Y."""
        ny, nx = (math.ceil(size_mm[1] / cell_mm), math.ceil(size_mm[0] / cell_mm))
        origin = np.array(origin_mm, np.float64)
        return cls(origin, cell_mm, np.full((ny, nx), z_mm), np.ones((ny, nx), bool))

    @classmethod
    def from_mesh(
        cls,
        vertices: Float[np.ndarray, "n 3"],
        faces: Int[np.ndarray, "m 3"],
        cell_mm: float,
        *,
        box_mm: tuple[float, float, float, float] | None = None,
        ground_mm: float = 0.0,
    ) -> HeightField:
        """Top of a mesh (open ones too) over a grid; `ground_mm` where there is none.

        Parameters
        ----------
        vertices, faces
            Mesh, mm, build frame.
        box_mm
            (x_min, y_min, x_max, y_max) to cover; the mesh's own box by default.
        """
        if box_mm is None:
            if len(vertices) == 0:
                raise InputError("A height field needs a mesh with at least one vertex.")
            low, high = vertices[:, :2].min(0), vertices[:, :2].max(0)
            box_mm = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        nx = max(1, math.ceil((box_mm[2] - box_mm[0]) / cell_mm - 1e-9))
        ny = max(1, math.ceil((box_mm[3] - box_mm[1]) / cell_mm - 1e-9))
        if nx * ny > MAX_FIELD_CELLS:
            raise InputError(
                f"A height field of {nx}×{ny} cells is over the limit of {MAX_FIELD_CELLS}; "
                f"use cells larger than {cell_mm:g} mm."
            )
        offset, z, _ = kernels.column_crossings(
            read_only(vertices, np.float64),
            np.ascontiguousarray(faces, np.int64),
            box_mm[0],
            box_mm[1],
            cell_mm,
            nx,
            ny,
        )
        top = kernels.column_top(offset, z, ground_mm).reshape(ny, nx)
        return cls(
            np.array(box_mm[:2]), cell_mm, np.maximum(top, ground_mm), np.ones((ny, nx), bool)
        )

    @classmethod
    def from_manifold(
        cls,
        solid: Any,
        cell_mm: float,
        *,
        box_mm: tuple[float, float, float, float] | None = None,
        margin_mm: float = 0.0,
    ) -> HeightField:
        """Top of a `manifold3d.Manifold` over its own box, grown by `margin_mm`, or `box_mm`."""
        mesh = solid.to_mesh()
        vertices = np.asarray(mesh.vert_properties, np.float64)[:, :3]
        if box_mm is None:
            b = solid.bounding_box()
            box_mm = (b[0] - margin_mm, b[1] - margin_mm, b[3] + margin_mm, b[4] + margin_mm)
        return cls.from_mesh(vertices, np.asarray(mesh.tri_verts, np.int64), cell_mm, box_mm=box_mm)


def footprint_rows(
    polygon_mm: Sequence[tuple[float, float]], cell_mm: float, *, aside_mm: float = 0.0
) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
    """Rows of cell offsets (dy, low, high) that a convex polygon around a cell's centre touches.

    With `aside_mm`, around any point that is no farther from the centre each way.
    """
    outline = np.asarray(polygon_mm, float) / cell_mm
    closed = np.vstack([outline, outline[:1]])
    aside = aside_mm / cell_mm
    reach = 0.5 + aside  # from a cell's centre to the far side of what it touches
    first = math.floor(outline[:, 1].min() - aside + 0.5)
    last = math.ceil(outline[:, 1].max() + aside - 0.5)
    dy = np.arange(first, last + 1)
    # This is the polygon's extent in x over each row's whole band, [dy − reach, dy + reach].
    (px, py), (qx, qy) = closed[:-1].T, closed[1:].T
    y = np.stack(
        [
            np.maximum(np.minimum(py, qy), dy[:, None] - reach),
            np.minimum(np.maximum(py, qy), dy[:, None] + reach),
        ]
    )
    level = qy == py
    x = px + (y - py) * (qx - px) / np.where(level, 1.0, qy - py)
    x = np.where(level, np.stack([px, qx])[:, None, :], x)
    crossed = y[0] <= y[1]
    low = np.where(crossed, x.min(axis=0), np.inf).min(axis=1) - aside
    high = np.where(crossed, x.max(axis=0), -np.inf).max(axis=1) + aside
    some = crossed.any(axis=1)
    low_at = np.floor(low[some] + 0.5).astype(np.int64)
    high_at = np.ceil(high[some] - 0.5).astype(np.int64)
    return dy[some].astype(np.int64), low_at, high_at


def _greatest_of_next(
    z_mm: Float[np.ndarray, "ny nx"], first: int, count: int, size: int, *, axis: int
) -> Float[np.ndarray, "_my _mx"]:
    """Greatest of cells [i, i + size) along an axis, for `count` cells i from `first` on."""
    from scipy import ndimage  # half a second to load, and a job without what stands has no use

    shape = list(z_mm.shape)
    shape[axis] = count + size - 1
    padded = np.full(shape, -np.inf)
    low, high = max(first, 0), min(first + shape[axis], z_mm.shape[axis])
    if low < high:
        inside, source = [slice(None)] * 2, [slice(None)] * 2
        inside[axis], source[axis] = slice(low - first, high - first), slice(low, high)
        padded[tuple(inside)] = z_mm[tuple(source)]
    # scipy centres its window; it is shifted so that it begins at each cell.
    greatest = ndimage.maximum_filter1d(
        padded, size, axis=axis, mode="constant", cval=-np.inf, origin=-(size // 2)
    )
    kept = [slice(None)] * 2
    kept[axis] = slice(0, count)
    return np.asarray(greatest[tuple(kept)])


def _read_heights(
    path: Path,
) -> tuple[Float[np.ndarray, " ..."], dict[str, Any], Bool[np.ndarray, " ..."] | None]:
    """Heights, placement and seen mask of a file, as far as it carries them."""
    suffix = path.suffix.lower()
    readers = {".npz": _read_npz, ".tif": _read_tiff, ".tiff": _read_tiff, ".npy": _read_npy}
    if suffix not in readers:
        raise InputError(f"{path}: a height map is a .npz, .tif or .npy file, not '{suffix}'.")
    try:
        return readers[suffix](path)
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: the height map cannot be read ({in_words(e)}).") from e


def _read_npz(
    path: Path,
) -> tuple[Float[np.ndarray, " ..."], dict[str, Any], Bool[np.ndarray, " ..."] | None]:
    with zipfile.ZipFile(path) as packed:
        for info in packed.infolist():
            with packed.open(info) as member:
                _refuse_more_than_it_holds(path, member, info.file_size)
    with np.load(path) as archive:
        placement = {
            "cell_mm": float(archive["cell_mm"]),
            "origin_mm": archive["origin_mm"].tolist(),
        }
        z_mm = archive["z_mm"].astype(np.float64, copy=False)
        return z_mm, placement, archive["seen"].astype(bool)


def _read_npy(path: Path) -> tuple[Float[np.ndarray, " ..."], dict[str, Any], None]:
    with path.open("rb") as file:
        _refuse_more_than_it_holds(path, file, path.stat().st_size)
    return np.load(path).astype(np.float64, copy=False), {}, None


def _refuse_more_than_it_holds(path: Path, file: Any, size_bytes: int) -> None:
    """Refuse an array of NumPy's that promises more than there is, before room is made for it."""
    version = np.lib.format.read_magic(file)
    read_header = getattr(np.lib.format, f"read_array_header_{version[0]}_0")
    shape, _, kind = read_header(file)
    cells = math.prod(shape)
    if cells * kind.itemsize > size_bytes:
        raise ValueError(f"it promises {cells:,} numbers and is too short for them")
    _refuse_too_many(cells)


def _refuse_too_many(cells: int) -> None:
    if cells > MOST_READ_CELLS:
        raise ValueError(f"it has {cells:,} cells, the limit is {MOST_READ_CELLS:,}")


def _read_tiff(path: Path) -> tuple[Float[np.ndarray, " ..."], dict[str, Any], None]:
    with quiet_tiff(path) as tiff:
        page = tiff.pages[0]
        _refuse_too_many(math.prod(page.shape))
        refuse_swollen_page(path, page, UnpackLimit())
        heights = page.asarray().astype(np.float64, copy=False)
        try:
            placement = json.loads(getattr(page, "description", "") or "{}")
        except json.JSONDecodeError:
            placement = {}
    return heights, placement if isinstance(placement, dict) else {}, None
