"""The model of a patch: columns over a deficit, and where the tool head may be over them."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped
from scipy import ndimage

from gcode.meshes import mesh_of
from gcode.profiles import PrintSetup
from gcode.slicing.job_lines import JobColumns, JobLines
from gcode.slicing.options import DEFAULT_PATCH, PatchOptions
from gcode.slicing.reach import Reach, cells_below
from gcode.surfaces import HeightField
from gcode.surfaces import raster_kernels as kernels


class PatchModel:
    """Columns on a fine grid: what is missing in each, what stands there, where the tip may go."""

    def __init__(
        self,
        deficit: Any,
        setup: PrintSetup,
        as_built: HeightField,
        lines: JobLines | None = None,
        options: PatchOptions = DEFAULT_PATCH,
    ) -> None:
        self.options = options
        self.deficit = deficit
        self.as_built = as_built
        self.box = deficit.bounding_box()
        margin_mm = options.columns.margin_mm
        x0, y0 = self.box[0] - margin_mm, self.box[1] - margin_mm
        x1, y1 = self.box[3] + margin_mm, self.box[4] + margin_mm
        fine = (x1 - x0) * (y1 - y0) / options.columns.fine_mm**2 <= options.columns.fine_cells
        self.cell_mm = options.columns.fine_mm if fine else options.columns.coarse_mm
        nx = int(np.ceil((x1 - x0) / self.cell_mm))
        ny = int(np.ceil((y1 - y0) / self.cell_mm))
        self.shape = (ny, nx)
        self.origin_mm = np.array([x0, y0])
        vertices, faces = mesh_of(deficit)
        offsets, self._z, up = kernels.column_crossings(
            vertices, faces, x0, y0, self.cell_mm, nx, ny
        )
        self._sign = up.astype(np.float64)
        self._column = np.repeat(np.arange(nx * ny), np.diff(offsets))
        columns_mm3 = float(self.wanted_below(np.inf).sum()) * self.cell_mm**2
        # columns sample the solid; its own volume is exact
        self.weight = float(deficit.volume()) / columns_mm3 if columns_mm3 > 0 else 1.0
        self.top_mm = kernels.column_top(offsets, self._z, -np.inf).reshape(self.shape)
        self.points_mm = self._centres()
        floor_mm = as_built.sample(self.points_mm).reshape(self.shape)
        self.floor_mm = floor_mm
        # columns on which beads may be laid: over what is missing, or over air beside its rim
        away_mm = ndimage.distance_transform_edt(~np.isfinite(self.top_mm)) * self.cell_mm
        self.near = np.asarray(away_mm <= options.columns.no_lift_mm)
        self.beside_mm = ndimage.uniform_filter(
            floor_mm, round(2 * options.columns.seam_mm / self.cell_mm) + 1
        )
        self.job: JobColumns | None = None
        # a patch whose top follows the surface does not follow the job's planar lines
        if lines is not None and len(lines.rim) and not setup.process.nonplanar_top:
            wanted = np.isfinite(self.top_mm)
            low_mm, high_mm = float(self.box[2]), float(self.box[5])
            self.job = JobColumns(
                lines, wanted, self.points_mm, self.cell_mm,
                low_mm - options.columns.job_layer_mm, high_mm + options.columns.job_layer_mm,
                options.lines.rim_mm,
            )  # fmt: skip
        self.most_mm = options.columns.most_thick_nozzles * setup.printer.nozzle_diameter_mm
        self.drop_mm = options.columns.drop_nozzles * setup.printer.nozzle_diameter_mm
        self.spread_mm = options.columns.spread_nozzles * setup.printer.nozzle_diameter_mm
        self.material, self.line_width_mm = setup.material, setup.process.line_width_mm
        self._bridges = lines.bridges if lines is not None else None
        self._printer = setup.printer
        far_mm = options.columns.no_lift_mm
        self._window_mm = (x0 - far_mm, y0 - far_mm, x1 + far_mm, y1 + far_mm)
        self.reach = self.reach_of(as_built)
        self._tip_cells = self.reach.cells_of(self.points_mm)

    def reach_of(self, field: HeightField, before: Reach | None = None) -> Reach:
        """Where the nozzle may be around the patch, over what stands there."""
        # the lowest pass lies at most one thick bead above the deficit's floor
        lowest_mm = max(0.0, float(self.box[2]))
        return Reach(
            field,
            self._printer,
            lowest_tip_mm=lowest_mm,
            window_mm=self._window_mm,
            finer=self.options.columns.tip_cells,
            before=before,
        )

    def _centres(self) -> Float[np.ndarray, "n 2"]:
        ny, nx = self.shape
        x = self.origin_mm[0] + (np.arange(nx) + 0.5) * self.cell_mm
        y = self.origin_mm[1] + (np.arange(ny) + 0.5) * self.cell_mm
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)

    def wanted_below(self, z_mm: float | Float[np.ndarray, "ny nx"]) -> Float[np.ndarray, "ny nx"]:
        """How thick the deficit is below a height, in each column."""
        return _thick_below(z_mm, self._column, self._z, self._sign, self.shape)

    def own_columns(
        self, piece: Any
    ) -> tuple[tuple[slice, slice], Float[np.ndarray, "a b"], Float[np.ndarray, "a b"]]:
        """The columns around a connected piece of the deficit, and how thick it is in each.

        In all, and below what stands there. Pieces may lie over each other, or one in the box of
        another.
        """
        box = piece.bounding_box()
        low, high = (
            (np.array(corner) - self.origin_mm) / self.cell_mm for corner in (box[:2], box[3:5])
        )
        first = np.maximum(np.floor(low).astype(int), 0)
        last = np.minimum(np.ceil(high).astype(int) + 1, self.shape[::-1])
        (nx, ny), (x0, y0) = (last - first).tolist(), self.origin_mm + first * self.cell_mm
        offsets, z, up = kernels.column_crossings(*mesh_of(piece), x0, y0, self.cell_mm, nx, ny)
        column = np.repeat(np.arange(nx * ny), np.diff(offsets))
        cells = (slice(first[1], last[1]), slice(first[0], last[0]))
        own, under = (
            _thick_below(z_mm, column, z, up.astype(np.float64), (ny, nx))
            for z_mm in (np.inf, self.floor_mm[cells])
        )
        return cells, own, under

    @cached_property
    def bottom_mm(self) -> Float[np.ndarray, "ny nx"]:
        """The lowest height at which something is missing in each column; infinite: nowhere."""
        lowest = np.full(self.shape[0] * self.shape[1], np.inf)
        np.minimum.at(lowest, self._column, self._z)
        return lowest.reshape(self.shape)

    @cached_property
    def longest_span_mm(self) -> float:
        """The longest strand over air: what the material bears, or the longest that the job spans.

        The job's span is widened by a column at each end, since rims are known no better.
        """
        job_mm = self._bridges.longest_mm() if self._bridges is not None else 0.0
        return max(self.material.max_bridge_mm, job_mm + 2.0 * self.cell_mm)

    @property
    def need_mm(self) -> Float[np.ndarray, "ny nx"]:
        """The lowest height at which the tip clears everything, over each column."""
        index, inside = self._tip_cells
        need = np.where(inside, self.reach.need_mm[index[:, 0], index[:, 1]], -np.inf)
        return need.reshape(self.shape)

    def open_mm3(self, layer_mm: float) -> float:
        """The missing volume that the head lets a layer be laid into, whether or not it holds.

        Plastic goes aside as far as the nozzle's flat presses it, and at most a layer below it.
        """
        reach = round(self.spread_mm / self.cell_mm)
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1] * self.cell_mm
        disc = np.hypot(x, y) <= self.spread_mm
        from_mm = ndimage.minimum_filter(self.need_mm, footprint=disc, mode="nearest") - layer_mm
        over = np.isfinite(self.top_mm)
        thick_mm = np.minimum(self.top_mm[over] - from_mm[over], self.wanted_below(np.inf)[over])
        return float(np.clip(thick_mm, 0.0, None).sum()) * self.cell_mm**2 * self.weight

    def at(
        self, what: Shaped[np.ndarray, "ny nx"], points_mm: Float[np.ndarray, "n 2"], beyond: float
    ) -> Shaped[np.ndarray, " n"]:
        """The value of the column below each point; `beyond` for points outside the patch."""
        cells, inside = cells_below(points_mm, self.origin_mm, self.cell_mm, self.shape)
        return np.where(inside, what[cells[:, 0], cells[:, 1]], beyond)

    def free_at(self, reach: Bool[np.ndarray, "_ry _rx"]) -> Bool[np.ndarray, "ny nx"]:
        """Columns over which the nozzle may be, from a mask on the cells of `reach`."""
        return self.reach.free_in_cells(self._tip_cells, reach).reshape(self.shape)

    def is_over(self, points_mm: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
        """(n,) whether something is missing below each point."""
        return np.isfinite(self.at(self.top_mm, points_mm, np.inf))

    def raised(
        self, columns: Bool[np.ndarray, "ny nx"], to_mm: Float[np.ndarray, "ny nx"]
    ) -> HeightField:
        """The as-built field, at least as high as `to_mm` over some columns."""
        cells = self.as_built.cells_of(self.points_mm)
        ny, nx = self.as_built.shape
        ok = ((cells >= 0) & (cells < (ny, nx))).all(axis=1) & columns.ravel()
        z_mm = self.as_built.z_mm.astype(np.float64).copy()
        np.maximum.at(z_mm, (cells[ok, 0], cells[ok, 1]), to_mm.ravel()[ok])
        return self.as_built.raised(z_mm)


def _thick_below(
    z_mm: float | Float[np.ndarray, "ny nx"],
    column: Int[np.ndarray, " n"],
    crossing_mm: Float[np.ndarray, " n"],
    sign: Float[np.ndarray, " n"],
    shape: tuple[int, int],
) -> Float[np.ndarray, "ny nx"]:
    """How thick a solid is below a height, from the crossings of columns with its surface."""
    up_to_mm = z_mm if isinstance(z_mm, float) else z_mm.ravel()[column]
    weights = sign * np.minimum(crossing_mm, up_to_mm)
    below = np.bincount(column, weights=weights, minlength=shape[0] * shape[1])
    return np.maximum(below.reshape(shape), 0.0)
