"""Scans in numpy's files and in height maps: .npy, .npz, .tif."""

from __future__ import annotations

import math
import tokenize
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from amrepair.errors import InputError, refused_as_ours
from amrepair.scans.range_grid import RangeGrid
from amrepair.scans.scan import DEFAULT_SIGMA_MM, Scan
from amrepair.scans.viewpoint import straight_from
from gcode.surfaces.sizes import (
    PARSER_ERRORS,
    UnpackLimit,
    in_words,
    length_of,
    refuse_short,
)

ARRAY_ERRORS = (*PARSER_ERRORS, tokenize.TokenError)
STRAIGHT_DOWN = np.array([0.0, 0.0, 1.0])
NUMBERS = "fiub"


def load_npy(path: Path) -> Float[np.ndarray, " ..."]:
    """An array of numbers; what it promises is held against the file before it is read.

    Raises
    ------
    InputError
        If it is damaged, shorter than it says, or holds something else.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # numpy's, on headers that Python 2 wrote
            table = np.load(path, mmap_mode="r", allow_pickle=False)  # maps: allocates nothing
        if not isinstance(table, np.ndarray) or table.dtype.kind not in NUMBERS:
            raise InputError(f"{path}: the file holds no array of numbers; export it again")
        return np.array(table, dtype=np.float64)
    except ARRAY_ERRORS as e:
        raise InputError(f"{path}: the array cannot be read ({in_words(e)})") from e


def is_map(path: Path) -> bool:
    """Whether an .npy file is a height map: two dimensions, and not three or six columns."""
    try:
        with path.open("rb") as file:
            shape = _promised(file)[0]
    except ARRAY_ERRORS as e:
        raise InputError(f"{path}: the array cannot be read ({in_words(e)})") from e
    return len(shape) == 2 and shape[1] not in {3, 6}


def _promised(file: Any) -> tuple[tuple[int, ...], np.dtype[np.generic]]:
    """Shape and type of an array, by its header."""
    version = np.lib.format.read_magic(file)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, _, dtype = read(file)
    return shape, dtype


def read_archive(path: Path) -> dict[str, Shaped[np.ndarray, " ..."]]:
    """All arrays of an archive, by name; sizes are held against its directory first.

    Raises
    ------
    InputError
        If it is damaged, swells beyond the limit, or an array holds no numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            infos = [i for i in archive.infolist() if i.filename.endswith(".npy")]
            UnpackLimit().refuse(path, sum(i.file_size for i in infos), length_of(path))
            for info in infos:
                with archive.open(info) as file:
                    shape, dtype = _promised(file)
                need = math.prod(shape) * dtype.itemsize
                refuse_short(path, f"{info.filename} of shape {shape}", need, info.file_size)
        with np.load(path, allow_pickle=False) as loaded:
            stored = {name: np.asarray(loaded[name]) for name in loaded.files}
    except ARRAY_ERRORS as e:
        raise InputError(f"{path}: the archive cannot be read ({in_words(e)})") from e
    odd = [name for name, array in stored.items() if array.dtype.kind not in NUMBERS + "U"]
    if odd:
        raise InputError(f"{path}: {odd[0]} of the archive holds no numbers; export it again")
    return {name: array for name, array in stored.items() if array.dtype.kind in NUMBERS}


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
    from gcode.surfaces import HeightField

    try:
        with refused_as_ours():
            if path.suffix.lower() == ".npz":
                read_archive(path)  # may not swell; others hold what they promise, or are refused
            heights = HeightField.read(path, cell_mm=cell_mm, origin_mm=origin_mm)
        if not np.isfinite(heights.origin_mm).all() or not np.isfinite(heights.cell_mm):
            raise InputError(f"{path}: the height map's cell or origin is no finite number")
        x, y = heights.centres_mm()
    except ARRAY_ERRORS as e:
        raise InputError(f"{path}: the height map cannot be read ({in_words(e)})") from e
    grid_x, grid_y = np.meshgrid(x, y)
    seen = heights.seen
    if seen.shape != grid_x.shape:
        raise InputError(f"{path}: the height map's mask of seen cells is not of its size")
    points = np.stack([grid_x[seen], grid_y[seen], heights.z_mm[seen]], axis=1).astype(np.float64)
    if len(points) == 0:
        raise InputError(f"{path}: the height map has no seen cell")
    above = straight_from(points, STRAIGHT_DOWN, heights.cell_mm)
    return Scan(
        points,
        DEFAULT_SIGMA_MM,
        frame,
        None,
        above.sensors_mm,
        above.sensor_index,
        str(path),
        grids=(RangeGrid.of_seen(seen, "orthographic"),),
    )
