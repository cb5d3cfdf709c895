"""The simulated world: beads are laid in it, pieces break off it, scanners look at it.

Columns of at most 0.15 mm in XY, each a list of solid z-intervals in continuous z. What the
nozzle did comes as `MotionBatch`; the world knows neither G-code nor the part that was meant.
The bead model is told in `deposit_kernels`, what a strand without hold does in `strand_kernels`,
their parameters in `parameters`. What shrinks and curls is told apart from where plastic was laid:
columns hold the part as if it had not cooled, `as_cooled` says where its points are now, and a
nozzle that comes back to it (`onto_cold`) meets them there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import manifold3d
import numpy as np

from amrepair.arrays import Points, Values
from amrepair.errors import InputError
from amrepair.simulate.columns import Columns, IntervalMap, Window
from amrepair.simulate.columns_kernels import Stacks
from amrepair.simulate.defects import PlacedDefect
from amrepair.simulate.deposit_kernels import LAYER, STATE_SIZE, deposit
from amrepair.simulate.parameters import BeadModel, ThermalModel, WorldParameters
from amrepair.simulate.strand_kernels import Head, Path, StandingColumns
from gcode.firmware.motion import MotionBatch
from gcode.profiles import PrinterProfile
from gcode.surfaces import HeightField

MAX_WORLD_CELL_MM = 0.15
WORLD_MARGIN_MM, TOP_MARGIN_MM = 10.0, 2.0  # of the bed, and of what stands there
_PHASES = 8  # sub-column positions of the nozzle that have a list of neighbours of their own


class World:
    """What stands on the bed.

    Parameters
    ----------
    bed_size_mm
        Bed in X and Y.
    cell_mm
        Edge of a column, at most 0.15 mm.
    nozzle_diameter_mm, filament_diameter_mm
        Bore of the nozzle, and the filament that motion is told in.
    bead, thermal
        How plastic lies, and how it cools; without `thermal` it neither shrinks nor curls.
    bed_min_mm
        The bed's corner of least X and Y, build frame.
    middle_mm
        XY that the part shrinks towards and curls around, build frame; the bed's middle.

    """

    def __init__(
        self,
        bed_size_mm: tuple[float, float],
        *,
        cell_mm: float = 0.125,
        nozzle_diameter_mm: float = 0.4,
        filament_diameter_mm: float = 1.75,
        bead: BeadModel | None = None,
        thermal: ThermalModel | None = None,
        bed_min_mm: tuple[float, float] = (0.0, 0.0),
        middle_mm: tuple[float, float] | None = None,
    ) -> None:
        if not 0.02 <= cell_mm <= MAX_WORLD_CELL_MM:
            raise InputError(
                f"a world's columns must be 0.02 to {MAX_WORLD_CELL_MM} mm wide, not {cell_mm} mm"
            )
        self.bead = bead or BeadModel()
        self.thermal = thermal or ThermalModel()
        corner, size = np.array(bed_min_mm), np.array(bed_size_mm)
        self._middle_mm = corner + 0.5 * size if middle_mm is None else np.array(middle_mm)
        self.nozzle_diameter_mm = nozzle_diameter_mm
        self.filament_mm2 = np.pi / 4 * filament_diameter_mm**2
        self.columns = Columns(
            origin_mm=tuple(corner - WORLD_MARGIN_MM),
            size_mm=tuple(size + 2 * WORLD_MARGIN_MM),
            cell_mm=cell_mm,
        )
        self._near, self._counts = _neighbours(cell_mm, nozzle_diameter_mm, self.bead)
        self._state = np.zeros(STATE_SIZE)
        # For each column: the layer that last touched it, and its top before that layer.
        self._before = np.zeros(self.columns.shape, dtype=np.float32)
        self._stamp = np.zeros(self.columns.shape, dtype=np.int32)
        self._pulled_mm = 0.0  # filament retracted and not yet pushed back
        self._layer_tops_mm = np.zeros(0)  # heights extruded at so far, rising
        self.pushed_mm3 = 0.0

    @classmethod
    def of(
        cls,
        printer: PrinterProfile,
        told: WorldParameters,
        middle_mm: tuple[float, float] | None = None,
    ) -> World:
        """An empty world over a printer's bed; `middle_mm` is where parts shrink to."""
        return cls(
            printer.bed_size_mm,
            cell_mm=told.columns_mm,
            nozzle_diameter_mm=printer.nozzle_diameter_mm,
            filament_diameter_mm=printer.filament_diameter_mm,
            bead=told.bead,
            thermal=told.thermal,
            bed_min_mm=printer.bed_min_mm,
            middle_mm=middle_mm,
        )

    @property
    def cell_mm(self) -> float:
        """Edge of a column."""
        return self.columns.cell_mm

    @property
    def volume_mm3(self) -> float:
        """Volume of everything solid."""
        return self.snapshot().volume_mm3

    def deposit(
        self,
        motion: MotionBatch,
        defects: Sequence[PlacedDefect] = (),
        *,
        onto_cold: bool = False,
    ) -> float:
        """Lay what the nozzle pushed out.

        Parameters
        ----------
        motion
            Executed moves, in order, build frame; they end at a rest: a strand that has found no
            second hold by then has none.
        defects
            Placed defects that change the flow of these moves.
        onto_cold
            A repair: the part has cooled, and the little that is added shrinks by next to nothing.

        Returns
        -------
        float
            Volume that left the nozzle, mm³.
        """
        if len(motion) == 0:
            return 0.0
        volume_mm3 = self._pushed_mm(motion.filament_mm) * self.filament_mm2
        thickness_mm = self._thickness_mm(motion, volume_mm3, onto_cold=onto_cold)
        if onto_cold:
            self._state[LAYER] += 1.0  # at the height of the layer before it, but not of it
        none = np.zeros((0, 9))
        regions = np.concatenate([none, *(defect.flow_regions for defect in defects)])
        path = Path(
            self._as_laid(motion.start_mm, onto_cold=onto_cold),
            self._as_laid(motion.end_mm, onto_cold=onto_cold),
            volume_mm3,
            thickness_mm,
            np.ascontiguousarray(regions),
        )
        world = StandingColumns(Stacks(*self.columns.arrays), self._before, self._stamp)
        lay_all: Any = deposit
        pool, pool_next, pushed = lay_all(
            world, self._head(onto_cold=onto_cold), path, self.columns.touched, self._state
        )
        self.columns.pool, self.columns.pool_next = pool, pool_next
        self.pushed_mm3 += float(pushed)
        return float(pushed)

    def _head(self, *, onto_cold: bool) -> Head:
        """The nozzle and its strands, as the kernels take them."""
        thermal = (
            *self._middle_mm,
            self.thermal.curl_per_mm,
            self.thermal.held_mm,
            self._risen if onto_cold else -1.0,
        )
        return Head(
            near=self._near,
            counts=self._counts,
            phases=_PHASES,
            grid=np.array([*self.columns.origin_mm, self.cell_mm]),
            step_mm=self.bead.step_mm,
            bridges=int(self.bead.bridges_mm / self.cell_mm + 1e-6),
            planes=self.bead.planes_layers,
            carry_limit=self.bead.carry_mm3 / self.cell_mm**2,
            swell=self.bead.swell_ratio,
            sag=self.bead.sag_per_mm,
            droop=self.bead.droop_per_mm,
            beside=self.nozzle_diameter_mm,
            pools=self.bead.pools_layers,
            thermal=np.array(thermal),
        )

    def as_cooled(self, points_mm: Points) -> Points:
        """(n, 3) where points of the part as it was laid are now, build frame."""
        if self.thermal.shrink_ratio == 0.0 and self.thermal.curl_per_mm == 0.0:
            return points_mm
        away_mm = points_mm[:, :2] - self._middle_mm
        smaller = 1.0 - self.thermal.shrink_ratio * self.thermal.rise(points_mm[:, 2])
        out = points_mm.copy()
        out[:, :2] = self._middle_mm + away_mm * smaller[:, None]
        out[:, 2] += self.thermal.curl_per_mm * (away_mm**2).sum(axis=1) * self._risen
        return out

    @property
    def _risen(self) -> float:
        """Share of its curl that the part has now, its warm top contracted."""
        top_mm = float(self._layer_tops_mm[-1]) if len(self._layer_tops_mm) else 0.0
        return float(self.thermal.rise(top_mm + self.thermal.warm_mm))

    def _as_laid(self, place_mm: Points, *, onto_cold: bool) -> Points:
        """Where on the part as it was laid the nozzle is (its height is the kernel's business)."""
        place = np.array(place_mm, dtype=np.float64, order="C")
        if onto_cold and self.thermal.shrink_ratio > 0.0:
            smaller = 1.0 - self.thermal.shrink_ratio * self.thermal.rise(place[:, 2])
            away_mm = place[:, :2] - self._middle_mm
            place[:, :2] = self._middle_mm + away_mm / smaller[:, None]
        return place

    def add(self, solid: manifold3d.Manifold) -> float:
        """Unite the world with a solid of the build frame; returns the volume added, mm³."""
        return self.columns.unite(self.columns.rasterise(solid))

    def remove(self, solid: manifold3d.Manifold) -> float:
        """Take a solid of the build frame out of the world; returns the volume removed, mm³."""
        return self.columns.cut(self.columns.rasterise(solid))

    def snapshot(self, window: Window | None = None) -> IntervalMap:
        """The intervals of a window (default: all in use) as they are now."""
        return self.columns.snapshot(self.window() if window is None else window)

    def window(self) -> Window:
        """The columns in use, and as far around them as plastic can have spread."""
        spread_mm = self.bead.spread_ratio * self.nozzle_diameter_mm
        return self.columns.window(margin_mm=spread_mm + self.cell_mm)

    def top(self) -> HeightField:
        """The highest solid of every column in use, as a height field; all of it is seen."""
        window = self.columns.window(margin_mm=TOP_MARGIN_MM)
        z_mm = self.snapshot(window).top_mm()
        return HeightField(
            origin_mm=np.array(window.corner_mm),
            cell_mm=self.cell_mm,
            z_mm=z_mm,
            seen=np.ones(z_mm.shape, dtype=bool),
        )

    def felt(self) -> HeightField:
        """Heights that a probe meets: the top as it has cooled, its columns where they were laid.

        What shrinks sideways, some hundredths of a millimetre, a probe's flat does not tell.
        """
        top = self.top()
        x_mm, y_mm = top.centres_mm()
        laid = np.column_stack([
            np.tile(x_mm, len(y_mm)), np.repeat(y_mm, len(x_mm)), top.z_mm.ravel()
        ]).astype(np.float64)  # fmt: skip
        cooled_mm = self.as_cooled(laid)[:, 2].reshape(top.shape)
        return replace(top, z_mm=np.where(top.z_mm > 0, cooled_mm, 0.0))

    def copy(self) -> World:
        """An independent copy; what is laid in one does not show in the other."""
        twin = World.__new__(World)
        twin.__dict__.update(self.__dict__)
        twin.columns = self.columns.copy()
        twin._state = self._state.copy()
        twin._before, twin._stamp = self._before.copy(), self._stamp.copy()
        return twin

    def _pushed_mm(self, filament_mm: Values) -> Values:
        """Filament that left the nozzle in each move: what was pulled must come back first."""
        position = np.concatenate([[-self._pulled_mm], filament_mm]).cumsum()
        front = np.maximum.accumulate(np.maximum(position, 0.0))
        self._pulled_mm = float(front[-1] - position[-1])
        return np.diff(front)

    def _thickness_mm(self, motion: MotionBatch, volume_mm3: Values, *, onto_cold: bool) -> Values:
        """Layer thickness of each move: the step to the highest layer laid below its height.

        Bounded by what its own cross-section can fill, for moves that follow no layers. A repair
        follows the job's layers: it may lie between two of them, but makes none.
        """
        z_mm = motion.end_mm[:, 2]
        laid = volume_mm3 > 0
        if not onto_cold or not len(self._layer_tops_mm):
            self._layer_tops_mm = np.union1d(self._layer_tops_mm, np.round(z_mm[laid], 3))
        tops = self._layer_tops_mm
        floor_mm = np.concatenate([[0.0], tops])
        below = floor_mm[np.searchsorted(tops, z_mm - 0.02, side="right")]
        length_mm = np.linalg.norm(motion.end_mm - motion.start_mm, axis=1)
        nozzle_mm = self.nozzle_diameter_mm
        flat_mm = volume_mm3 / np.maximum(length_mm, 0.1) / nozzle_mm
        step_mm = np.clip(z_mm - below, 0.25 * flat_mm, 4.0 * flat_mm)
        return np.clip(step_mm, 0.05, nozzle_mm)


def _neighbours(
    cell_mm: float, nozzle_mm: float, bead: BeadModel
) -> tuple[np.ndarray, np.ndarray]:  # integer tables, (phases², L, 2) and (phases², 4)
    """Column offsets by rising distance from the nozzle's axis, for each sub-column position.

    Counts: columns under the bore, within reach, under the flat, within the spread.
    """
    radius_mm = bead.spread_ratio * nozzle_mm
    half = int(np.ceil(radius_mm / cell_mm)) + 1
    dy, dx = (grid.ravel() for grid in np.mgrid[-half : half + 1, -half : half + 1])
    most = int(np.pi * (radius_mm / cell_mm + 1) ** 2) + 8
    near = np.zeros((_PHASES**2, most, 2), dtype=np.int64)
    counts = np.zeros((_PHASES**2, 4), dtype=np.int64)
    ratios = (0.5, bead.reach_ratio, bead.flat_ratio, bead.spread_ratio)
    for py in range(_PHASES):
        for px in range(_PHASES):
            x = (dx + 0.5 - (px + 0.5) / _PHASES) * cell_mm
            y = (dy + 0.5 - (py + 0.5) / _PHASES) * cell_mm
            distance_mm = np.hypot(x, y)
            order = np.lexsort((np.arctan2(y, x), np.round(distance_mm, 9)))
            order = order[distance_mm[order] <= radius_mm][:most]
            row = py * _PHASES + px
            near[row, : len(order), 0] = dy[order]
            near[row, : len(order), 1] = dx[order]
            limits = [ratio * nozzle_mm for ratio in ratios]
            counts[row] = np.searchsorted(distance_mm[order], limits, side="right")
    return near, counts
