"""A height field from a scan in the bed's frame: what no point lies on is as high as its rim.

A scan shows surfaces from above and leaves holes where it saw nothing. For a collision a hole is
solid up to the highest that stands around it; beyond the scan's own outline nothing is said.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from gcode.errors import InputError
from gcode.surfaces.heightfield import HeightField

OUTLINE_CELLS = 3  # gaps this wide in what was seen are within the scan's outline
WIDEST_MM = 1000.0  # of a bed, and what stands around it
MOST_SCANNED_CELLS = (
    8_000_000  # some seconds to close the holes of: a bed of 560 mm in cells of 0.2 mm
)
LEAST_SCAN_MM = 5.0  # less is no bed with something on it, but a scan in metres or inches
UNDER_MM = 2.0  # points so far below the bed are of another frame


def from_points(points_mm: Float[np.ndarray, "n 3"], cell_mm: float, *, what: str) -> HeightField:
    """The highest point of each cell; holes within the outline as high as what stands around them.

    Parameters
    ----------
    points_mm
        (n, 3), build frame.
    what
        The scan's name, for messages.

    Raises
    ------
    InputError
        If the points are not in the bed's frame, or spread too far for the cells.
    """
    _refuse_below(points_mm, what)
    _refuse_wide(points_mm, cell_mm, what)
    origin = np.floor(points_mm[:, :2].min(axis=0) / cell_mm) * cell_mm
    index = np.floor((points_mm[:, :2] - origin) / cell_mm).astype(np.int64)
    nx, ny = (int(v) + 1 for v in index.max(axis=0))
    highest = np.full(ny * nx, -np.inf)
    np.maximum.at(highest, index[:, 1] * nx + index[:, 0], points_mm[:, 2])
    z_mm = highest.reshape(ny, nx)
    seen = np.isfinite(z_mm)
    return HeightField(origin, cell_mm, _filled(z_mm, seen), seen)


def from_open_mesh(
    vertices_mm: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    cell_mm: float,
    *,
    what: str,
) -> HeightField:
    """The top of a scanner's mesh, which has holes, as `from_points`."""
    _refuse_below(vertices_mm, what)
    _refuse_wide(vertices_mm, cell_mm, what)
    bare = HeightField.from_mesh(vertices_mm, faces, cell_mm, ground_mm=-np.inf)
    seen = np.isfinite(bare.z_mm)
    return HeightField(bare.origin_mm, cell_mm, _filled(bare.z_mm, seen), seen)


def _refuse_below(points_mm: Float[np.ndarray, "n 3"], what: str) -> None:
    low_mm = float(np.percentile(points_mm[:, 2], 1.0))
    if low_mm < -UNDER_MM:
        raise InputError(
            f"{what} reaches {-low_mm:.1f} mm below the bed: it is not in the bed's frame; "
            "calibrate the scanner, or move the scan so that the bed is at Z 0."
        )


def _refuse_wide(points_mm: Float[np.ndarray, "n 3"], cell_mm: float, what: str) -> None:
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    x_mm, y_mm = (float(v) for v in high - low)
    if max(x_mm, y_mm) < LEAST_SCAN_MM:
        raise InputError(
            f"{what} spreads over {x_mm:.3g} × {y_mm:.3g} mm, {LEAST_SCAN_MM:g} mm are the least "
            "that shows a bed; is it in metres? Scale it to millimetres."
        )
    if max(x_mm, y_mm) > WIDEST_MM or x_mm * y_mm > MOST_SCANNED_CELLS * cell_mm**2:
        raise InputError(
            f"{what} spreads over {x_mm:.3g} × {y_mm:.3g} mm, the limit is {WIDEST_MM:g} mm, or "
            f"{MOST_SCANNED_CELLS / 1e6:g} million cells of {cell_mm:g} mm; is it in millimetres, "
            "and of the bed alone?"
        )


def _filled(z_mm: Float[np.ndarray, "ny nx"], seen: np.ndarray) -> Float[np.ndarray, "ny nx"]:
    """Holes as high as the highest around them; the bed outside of the outline."""
    around = ndimage.binary_closing(
        np.pad(seen, OUTLINE_CELLS), iterations=OUTLINE_CELLS, structure=np.ones((3, 3))
    )[OUTLINE_CELLS:-OUTLINE_CELLS, OUTLINE_CELLS:-OUTLINE_CELLS]
    holes, count = ndimage.label(ndimage.binary_fill_holes(around | seen) & ~seen)
    filled = np.where(seen, z_mm, 0.0)
    if count:
        rim = ndimage.grey_dilation(np.where(seen, z_mm, -np.inf), size=(3, 3))
        highest = np.atleast_1d(ndimage.maximum(rim, holes, np.arange(1, count + 1)))
        highest = np.where(np.isfinite(highest), highest, float(z_mm[seen].max()))
        filled = np.where(holes > 0, np.concatenate([[0.0], highest])[holes], filled)
    return np.maximum(filled, 0.0)
