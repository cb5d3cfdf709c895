"""Point clouds: PLY, PCD and text as scanners write them, read with limits; places alone.

What a file promises is held against its length before anything is made for it. What a scan tells
besides (normals, grids, sensors) is `amrepair.scans`'.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gcode.clouds.pcd import read_pcd
from gcode.clouds.ply import read_header, read_vertices
from gcode.clouds.text import read_rows
from gcode.errors import InputError

_log = logging.getLogger(__name__)

CLOUD_SUFFIXES = frozenset({".ply", ".pcd", ".xyz", ".txt", ".csv", ".asc"})
MOST_BYTES = 2 * 2**30
LEAST_CLOUD_POINTS = 100


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """Read a point cloud.

    Returns
    -------
    (n, 3) places in the file's own frame, mm; those that are not finite, as in
    the gaps of a range image, are left out, which is logged.

    Raises
    ------
    InputError
        If the file cannot be read, is cut, promises more than it holds, or holds too little.
    """
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise InputError(
                f"{path} has {size / 2**30:.1f} GB, the limit is {MOST_BYTES / 2**30:g}: thin it."
            )
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}).") from error
    points = _places(data, path)
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        _log.warning(
            "%s: %d of %d points are not finite numbers (NaN or infinity) and count as not seen",
            path.name, int((~finite).sum()), len(points),
        )  # fmt: skip
    points = points[finite]
    if len(points) < LEAST_CLOUD_POINTS:
        raise InputError(
            f"{path} has {len(points)} points; {LEAST_CLOUD_POINTS} are the least that shows a "
            "surface."
        )
    return points


def is_ply_mesh(path: Path) -> bool:
    """Whether a file is a PLY whose header names faces, and more than none."""
    try:
        with path.open("rb") as file:
            head = file.read(65536).partition(b"end_header")[0]
    except OSError:  # whoever reads it says so
        return False
    return (
        head.startswith(b"ply")
        and re.search(rb"^element face [1-9]", head, re.MULTILINE) is not None
    )


def _places(data: bytes, path: Path) -> Float[np.ndarray, "n 3"]:
    """(n, 3) as the file has them, by the ending of its name."""
    if path.suffix.lower() == ".ply":
        columns, _ = read_vertices(data, read_header(data, path), path)
    elif path.suffix.lower() == ".pcd":
        columns, _ = read_pcd(data, path)
    else:
        rows = read_rows(data, path)
        if rows.shape[1] < 3:
            raise InputError(f"{path}: rows need three numbers, x y z; they have {rows.shape[1]}.")
        return np.ascontiguousarray(rows[:, :3])
    return np.stack([columns[axis] for axis in "xyz"], axis=1)
