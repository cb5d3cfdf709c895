"""`Scan`: points, how well they were measured, and from where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from amrepair.arrays import Mask, Numbers, Points
from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans.range_grid import RangeGrid

# What a structured-light scanner of the desktop class states; used where the file says nothing.
DEFAULT_SIGMA_MM = 0.04


@dataclass(frozen=True, slots=True)
class Scan:
    """A point cloud with its provenance.

    Attributes
    ----------
    points_mm
        (n, 3) float64 in `frame`.
    sigma_mm
        Standard deviation of one point along its ray.
    frame
        Name of the frame: `scanner`, `build`, `template`, …
    normals
        (n, 3) unit outward normals, or None.
    sensors_mm
        (k, 3) origins that the rays came from, in `frame`, or None where the file did not say.
    sensor_index
        (n,) which sensor saw each point, or None.
    source
        Where it came from, for messages.
    grids
        The pixels of each view, where the file is a range image; None otherwise.
    edge
        (n,) bits `EDGE` and `FLYING` of `amrepair.scans.range_grid`: what lies at the seen
        surface's edge, and what hangs between two surfaces; None where no grid told.

    Raises
    ------
    InputError
        If there is no point, a value is not finite, or the arrays do not match.

    Examples
    --------
    >>> import numpy as np
    >>> from amrepair import Scan
    >>> grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0), [2.0]), axis=-1).reshape(-1, 3)
    >>> scan = Scan(grid, sigma_mm=0.04, frame="build", source="a plane")
    >>> len(scan)
    20
    """

    points_mm: Points
    sigma_mm: float
    frame: str
    normals: Points | None = None
    sensors_mm: Float[np.ndarray, "k 3"] | None = None
    sensor_index: Numbers | None = None
    source: str = "memory"
    grids: tuple[RangeGrid, ...] | None = None
    edge: UInt8[np.ndarray, " n"] | None = None

    def __post_init__(self) -> None:
        if len(self.points_mm) == 0:
            raise InputError(
                f"the scan {self.source} has no points; scan again or check the export"
            )
        finite = np.isfinite(self.points_mm)
        if not finite.all():
            bad = int((~finite.all(axis=1)).sum())
            raise InputError(
                f"the scan {self.source} has {bad} of {len(self.points_mm)} points that are not "
                "finite numbers (NaN or infinity); remove them before use"
            )
        if not self.sigma_mm >= 0:
            raise InputError(
                f"the scan {self.source} has a noise of {self.sigma_mm} mm; it must be ≥ 0"
            )
        if self.normals is not None and self.normals.shape != self.points_mm.shape:
            raise InputError(
                f"the scan {self.source} has {len(self.points_mm)} points but "
                f"{len(self.normals)} normals"
            )
        if (self.sensor_index is None) != (self.sensors_mm is None):
            raise InputError(f"the scan {self.source} needs sensors_mm and sensor_index together")
        if self.edge is not None and len(self.edge) != len(self.points_mm):
            raise InputError(
                f"the scan {self.source} has {len(self.points_mm)} points but edge flags for "
                f"{len(self.edge)}"
            )
        most = max((int(grid.index.max()) for grid in self.grids or ()), default=-1)
        if most >= len(self.points_mm):
            raise InputError(
                f"the scan {self.source} has a range grid that names point {most}, but only "
                f"{len(self.points_mm)} points (counted from 0)"
            )
        for array in (
            self.points_mm, self.normals, self.sensors_mm, self.sensor_index, self.edge
        ):  # fmt: skip
            if array is not None:
                array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.points_mm)

    @property
    def view_index(self) -> Numbers | None:
        """(n,) which view saw each point; None where nobody knows, or all are of one.

        A grid is a view, however many places its sensor passed; else a sensor is.
        """
        if self.grids is None:
            index = self.sensor_index
            return None if index is None or int(index.max()) == 0 else index
        if len(self.grids) == 1:
            return None
        index = np.zeros(len(self), np.int64)
        for k, grid in enumerate(self.grids):
            index[grid.points] = k
        return index

    def moved(self, target_from_source: Transform) -> Scan:
        """The same scan in another frame; normals and sensors move along, grid and flags stay."""
        if target_from_source.source != self.frame:
            raise InputError(
                f"the scan {self.source} is in frame {self.frame}, the transform starts from "
                f"{target_from_source.source}"
            )
        return replace(
            self,
            points_mm=target_from_source.apply(self.points_mm),
            normals=None if self.normals is None else target_from_source.rotate(self.normals),
            sensors_mm=None
            if self.sensors_mm is None
            else target_from_source.apply(self.sensors_mm),
            frame=target_from_source.target,
        )

    def subset(self, keep: Mask | Int[np.ndarray, " k"]) -> Scan:
        """Some of the points, by a mask or by their numbers, with all that is said of each.

        The grids are dropped: their gaps would no longer be gaps. The edge flags stay true.
        """
        which = np.flatnonzero(keep) if keep.dtype == bool else keep

        def some(of_each: Any) -> Any:
            return None if of_each is None else of_each.take(which, axis=0)

        return replace(
            self,
            points_mm=some(self.points_mm),
            normals=some(self.normals),
            sensor_index=some(self.sensor_index),
            grids=None,
            edge=some(self.edge),
        )
