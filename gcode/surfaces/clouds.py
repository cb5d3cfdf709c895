"""Point clouds of what stands on the bed: PLY, PCD, XYZ and NPY, as scanners write them.

Only places are read, no normals and no colours. What a file promises is held against its length
before anything is made for it. Packed forms (`binary_compressed` PCD, images) are not here.
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gcode.errors import InputError

_log = logging.getLogger(__name__)

CLOUD_SUFFIXES = frozenset({".ply", ".pcd", ".xyz", ".txt", ".csv", ".asc"})
MOST_BYTES = 2 * 2**30
MOST_HEADER_BYTES = 64 * 1024
LEAST_CLOUD_POINTS = 100
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_PCD_TYPES = {
    ("F", 4): "f4", ("F", 8): "f8", ("I", 1): "i1", ("I", 2): "i2", ("I", 4): "i4",
    ("U", 1): "u1", ("U", 2): "u2", ("U", 4): "u4",
}  # fmt: skip


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
    suffix = path.suffix.lower()
    try:
        if suffix == ".ply":
            points = _ply(path, data)
        elif suffix == ".pcd":
            points = _pcd(path, data)
        else:
            points = _columns(data.decode("ascii", "replace"))
    except (ValueError, KeyError, IndexError, OverflowError, TypeError) as error:
        what = " ".join(str(error).split())[:120]
        raise InputError(
            f"{path} cannot be read as a point cloud ({what}); export it anew."
        ) from error
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


def _columns(text: str) -> Float[np.ndarray, "n 3"]:
    """The first three numbers of each line; lines that begin with anything else are comments."""
    lines = [line for line in text.splitlines() if line[:1] in "+-.0123456789 \t" and line.strip()]
    rows = [re.split(r"[\s,;]+", line.strip())[:3] for line in lines]
    if not rows or any(len(row) < 3 for row in rows):
        raise ValueError("not three numbers in every line")
    return np.array(rows, dtype=np.float64)


def _ply(path: Path, data: bytes) -> Float[np.ndarray, "n 3"]:
    stop = data.find(b"end_header", 0, MOST_HEADER_BYTES)
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(f"{path} is no PLY: it has no header from 'ply' to 'end_header'.")
    body = data[data.index(b"\n", stop) + 1 :]
    header = data[:stop].decode("ascii", "replace").splitlines()
    form = ""
    elements: list[tuple[str, int, list[list[str]]]] = []
    for line in header[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(words[1:])
    if not elements or elements[0][0] != "vertex":
        raise InputError(f"{path}: the PLY does not begin with its vertices; export it anew.")
    count, properties = elements[0][1], elements[0][2]
    names = [words[-1] for words in properties]
    if form == "ascii":
        if count * 2 * len(names) > len(body) + 1:
            raise _too_short(path, count)
        rows = body.decode("ascii", "replace").split("\n", count)[:count]
        values = np.array([row.split()[: len(names)] for row in rows], dtype=np.float64)
        if values.shape != (count, len(names)):
            raise _too_short(path, count)
        return values[:, [names.index(axis) for axis in "xyz"]]
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[form]
    kind = np.dtype([(words[-1], order + _PLY_TYPES[words[0]]) for words in properties])
    return _binary(path, body, kind, count)


def _pcd(path: Path, data: bytes) -> Float[np.ndarray, "n 3"]:
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t\r]*\n", data[:MOST_HEADER_BYTES], re.MULTILINE)
    if match is None:
        raise InputError(f"{path} is no PCD: it has no line 'DATA'.")
    head = {}
    for line in data[: match.start()].decode("ascii", "replace").splitlines():
        key, _, rest = line.partition(" ")
        head[key] = rest.split()
    names, count = head["FIELDS"], int(head["POINTS"][0])
    repeats = [int(word) for word in head.get("COUNT", ["1"] * len(names))]
    form, body = match.group(1).decode(), data[match.end() :]
    if min(repeats) < 1 or count < 0 or sum(repeats) > len(data):
        raise InputError(f"{path}: COUNT or POINTS of the PCD is {max(repeats)} or {count}.")
    if form == "ascii":
        at = {name: sum(repeats[:k]) for k, name in enumerate(names)}
        if count * 2 * sum(repeats) > len(body) + 1:
            raise _too_short(path, count)
        rows = [row.split() for row in body.decode("ascii", "replace").splitlines()[:count]]
        if len(rows) < count:
            raise _too_short(path, count)
        return np.array([[row[at[axis]] for axis in "xyz"] for row in rows], dtype=np.float64)
    if form != "binary":
        raise InputError(f"{path}: its points are packed ({form}); export it as binary or ascii.")
    kinds = zip(names, head["TYPE"], head["SIZE"], repeats, strict=True)
    kind = np.dtype(
        [
            (f"{name}{k}" if name in "_" else name, "<" + _PCD_TYPES[type_, int(size)], (many,))
            for k, (name, type_, size, many) in enumerate(kinds)
        ]
    )
    return _binary(path, body, kind, count)


def _binary(path: Path, body: bytes, kind: np.dtype, count: int) -> Float[np.ndarray, "n 3"]:
    if count < 0 or count * kind.itemsize > len(body):
        raise _too_short(path, count)
    table = np.frombuffer(body, dtype=kind, count=count)
    return np.stack([table[axis].reshape(count).astype(np.float64) for axis in "xyz"], axis=1)


def _too_short(path: Path, count: int) -> InputError:
    return InputError(f"{path} promises {count} points and is too short for them; it is cut.")
