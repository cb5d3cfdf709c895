"""PCD point clouds (version 0.7): ascii, binary and binary_compressed; organised ones too.

References
----------
The PCD file format, Point Cloud Library, pointclouds.org/documentation.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gcode.clouds.lzf_kernels import lzf_decompress
from gcode.clouds.text import filled, read_table
from gcode.errors import InputError
from gcode.surfaces.sizes import UnpackLimit, refuse_short

NUMBER_KINDS = {"F": "f", "I": "i", "U": "u"}
HEADER_BYTES = 65536
# A back reference of LZF: three bytes give at most 264.
LZF_MOST = UnpackLimit(least_bytes=1024, ratio=88.0)


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """What stands before the data.

    Attributes
    ----------
    names
        The fields of one value each; what has several (descriptors) or no name is passed over.
    dtype
        Those of a row, at their places.
    columns
        Where they are among all values of a row.
    values
        How many values a row has.
    shape
        HEIGHT and WIDTH of an organised cloud; None for a bare list.
    viewpoint_mm, viewpoint_wxyz
        Where the sensor stood, and its turn.
    end
        Where the data begin.
    """

    names: tuple[str, ...]
    dtype: np.dtype[np.void]
    columns: tuple[int, ...]
    values: int
    points: int
    shape: tuple[int, int] | None
    data: str
    viewpoint_mm: tuple[float, float, float]
    viewpoint_wxyz: tuple[float, float, float, float]
    end: int


def read_pcd(data: bytes, path: Path) -> tuple[dict[str, Float[np.ndarray, " n"]], PcdHeader]:
    """Columns by field name.

    Raises
    ------
    InputError
        If the header is not a PCD header or the data are shorter than it promises.
    """
    header = _header(data, path)
    if not {"x", "y", "z"} <= set(header.names):
        raise InputError(f"{path}: the PCD file has no x, y, z fields but {list(header.names)}.")
    if header.points == 0:
        raise InputError(f"{path}: the PCD file has no points; scan again or check the export.")
    body = memoryview(data)[header.end :]
    if header.data == "ascii":
        return _ascii(body, header, path), header
    if header.data == "binary":
        return _rows(body, header, path), header
    return _compressed(body, header, path), header


def count_of_pcd(path: Path) -> int:
    """How many points a file's header promises.

    Raises
    ------
    InputError
        If the file cannot be read, or its header is none of a PCD file.
    """
    try:
        with path.open("rb") as file:
            head = file.read(HEADER_BYTES)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from error
    return _header(head, path).points


def _header(data: bytes, path: Path) -> PcdHeader:
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:HEADER_BYTES], re.MULTILINE)
    if match is None:
        raise InputError(f"{path}: not a PCD file (no DATA line); export it again.")
    said: dict[str, list[str]] = {}
    for line in data[: match.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            said[words[0].upper()] = words[1:]
    mode = match.group(1).decode()
    if mode not in {"ascii", "binary", "binary_compressed"}:
        raise InputError(f"{path}: PCD data of kind '{mode}' are unknown; export as binary.")
    try:
        names, dtype, columns, values = _layout(said)
        points, shape = _extent(said)
        view = [float(v) for v in (said.get("VIEWPOINT") or ["0"] * 3)]
        if len(view) not in (3, 7):
            raise ValueError(f"VIEWPOINT has {len(view)} values instead of 7")
        turn = view[3:] or [1.0, 0.0, 0.0, 0.0]
    except (KeyError, IndexError, ValueError, TypeError, OverflowError) as e:
        raise InputError(f"{path}: the PCD header cannot be understood ({e}).") from e
    return PcdHeader(
        names=names,
        dtype=dtype,
        columns=columns,
        values=values,
        points=points,
        shape=shape,
        data=mode,
        viewpoint_mm=(view[0], view[1], view[2]),
        viewpoint_wxyz=(turn[0], turn[1], turn[2], turn[3]),
        end=match.end(),
    )


def _layout(
    said: dict[str, list[str]],
) -> tuple[tuple[str, ...], np.dtype[np.void], tuple[int, ...], int]:
    """Names, layout in bytes and places of the fields of one value, and the values of a row."""
    fields, kinds = said["FIELDS"], said["TYPE"]
    sizes = [int(s) for s in said["SIZE"]]
    counts = [int(c) for c in said.get("COUNT", ["1"] * len(fields))]
    if min([*sizes, *counts]) < 1:
        raise ValueError("a SIZE or COUNT below 1")
    of_field = list(zip(fields, sizes, kinds, counts, strict=True))
    starts = [0, *accumulate(size * count for _, size, _, count in of_field)]
    places = [0, *accumulate(counts)]
    one = [k for k, (name, _, _, count) in enumerate(of_field) if count == 1 and name != "_"]
    dtype = np.dtype(
        {
            "names": [fields[k] for k in one],
            "formats": [f"<{NUMBER_KINDS[kinds[k]]}{sizes[k]}" for k in one],
            "offsets": [starts[k] for k in one],
            "itemsize": starts[-1],
        }
    )
    return tuple(fields[k] for k in one), dtype, tuple(places[k] for k in one), places[-1]


def _extent(said: dict[str, list[str]]) -> tuple[int, tuple[int, int] | None]:
    """How many points, and rows and columns of an organised cloud."""
    width = int(said["WIDTH"][0]) if "WIDTH" in said else None
    height = int(said["HEIGHT"][0]) if "HEIGHT" in said else 1
    points = int(said["POINTS"][0]) if "POINTS" in said else None
    if points is None:
        if width is None:
            raise KeyError("POINTS")
        points = width * height
    if width is not None and "HEIGHT" in said and width * height != points:
        raise ValueError(f"WIDTH {width} times HEIGHT {height} is not POINTS {points}")
    if points < 0 or (width or 0) < 0 or height < 0:
        raise ValueError("a negative number of points")
    return points, (height, width) if width is not None and height > 1 else None


def _ascii(body: memoryview, header: PcdHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    need = header.points * header.values * 2 - 1  # a digit and a space or an end of line each
    refuse_short(path, f"{header.points} points of {header.values} values", need, len(body))
    table = read_table(filled(io.BytesIO(body)), path, "the PCD text")
    if table.shape != (header.points, header.values):
        raise InputError(
            f"{path}: the PCD header promises {header.points} points of {header.values} "
            f"values, the file holds {table.shape[0]} of {table.shape[1]}; it is damaged."
        )
    return {name: table[:, i].copy() for name, i in zip(header.names, header.columns, strict=True)}


def _rows(body: memoryview, header: PcdHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    have = len(body) // header.dtype.itemsize
    if have < header.points:
        raise InputError(
            f"{path}: the PCD header promises {header.points} points, the file holds {have}; "
            "it is cut off."
        )
    rows = np.frombuffer(body, header.dtype, header.points)
    return {name: rows[name].astype(np.float64) for name in header.names}


def _compressed(
    body: memoryview, header: PcdHeader, path: Path
) -> dict[str, Float[np.ndarray, " n"]]:
    """Two sizes, then one LZF stream that holds field after field, each for all points."""
    want = header.points * header.dtype.itemsize
    packed, size = (int(v) for v in np.frombuffer(bytes(body[:8]).ljust(8, b"\0"), "<u4"))
    if size != want or len(body) < 8 + packed:
        raise InputError(
            f"{path}: the compressed PCD data should unpack to {want} bytes, the file says {size} "
            f"from {packed} of which {max(len(body) - 8, 0)} are there; it is damaged."
        )
    LZF_MOST.refuse(path, size, packed)
    flat = lzf_decompress(np.frombuffer(body, np.uint8, packed, 8), size)
    if len(flat) != want:
        raise InputError(
            f"{path}: the compressed PCD data unpack to {len(flat)} of {want} bytes; it is damaged."
        )
    columns = {}
    assert header.dtype.fields is not None
    for name in header.names:
        kind, offset = header.dtype.fields[name][:2]
        at = offset * header.points  # as each field before it holds so many bytes a point
        columns[name] = flat[at : at + kind.itemsize * header.points].view(kind).astype(np.float64)
    return columns
