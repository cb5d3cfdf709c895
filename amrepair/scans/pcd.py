"""PCD point clouds (version 0.7): ascii, binary and binary_compressed."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError
from amrepair.scans.lzf_kernels import lzf_decompress
from amrepair.scans.text import read_table

KINDS = {"F": "f", "I": "i", "U": "u"}


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """What stands before the data: one entry per field, counts spelled out."""

    names: tuple[str, ...]
    dtype: np.dtype[np.void]
    points: int
    data: str
    viewpoint_mm: tuple[float, float, float]
    end: int


def read_pcd(data: bytes, path: Path) -> tuple[dict[str, Float[np.ndarray, " n"]], PcdHeader]:
    """Columns by field name.

    Raises
    ------
    InputError
        If the header is not a PCD header or the data are shorter than it promises.
    """
    header = _header(data, path)
    body = data[header.end :]
    if header.data == "ascii":
        columns = _ascii(body, header, path)
    elif header.data == "binary":
        columns = _rows(body, header, path)
    else:
        columns = _compressed(body, header, path)
    if not {"x", "y", "z"} <= set(columns):
        raise InputError(f"{path}: the PCD file has no x, y, z fields but {list(header.names)}")
    return columns, header


def count_of_pcd(path: Path) -> int:
    """How many points a file's header promises.

    Raises
    ------
    InputError
        If the file cannot be read, or its header is none of a PCD file.
    """
    try:
        with path.open("rb") as file:
            head = file.read(65536)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    return _header(head, path).points


def _header(data: bytes, path: Path) -> PcdHeader:
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data[:65536], re.MULTILINE)
    if match is None:
        raise InputError(f"{path}: not a PCD file (no DATA line); export it again")
    said: dict[str, list[str]] = {}
    for line in data[: match.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            said[words[0].upper()] = words[1:]
    try:
        fields, sizes, kinds = said["FIELDS"], said["SIZE"], said["TYPE"]
        counts = said.get("COUNT", ["1"] * len(fields))
        points = (
            int(said["POINTS"][0])
            if "POINTS" in said
            else (int(said["WIDTH"][0]) * int(said["HEIGHT"][0]))
        )
        names, parts = [], []
        for i, (f, s, k, c) in enumerate(zip(fields, sizes, kinds, counts, strict=True)):
            for j in range(int(c)):
                name = f"_{i}_{j}" if f == "_" else f if int(c) == 1 else f"{f}_{j}"
                names.append(name)
                parts.append((name, f"<{KINDS[k]}{int(s)}"))
        view = [float(v) for v in said.get("VIEWPOINT", ["0"] * 3)[:3]]
        kind = np.dtype(parts)
    except (KeyError, IndexError, ValueError, TypeError) as e:
        raise InputError(f"{path}: the PCD header cannot be understood ({e})") from e
    mode = match.group(1).decode()
    if mode not in {"ascii", "binary", "binary_compressed"}:
        raise InputError(f"{path}: PCD data of kind '{mode}' are unknown; export as binary")
    return PcdHeader(tuple(names), kind, points, mode, (view[0], view[1], view[2]), match.end())


def _ascii(body: bytes, header: PcdHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    empty = not body.strip()
    table = np.zeros((0, 0)) if empty else read_table(io.BytesIO(body), path, "the PCD text")
    if table.shape != (header.points, len(header.names)):
        raise InputError(
            f"{path}: the PCD header promises {header.points} points of {len(header.names)} "
            f"values, the file holds {table.shape[0]} of {table.shape[1]}; it is damaged"
        )
    return {name: table[:, i] for i, name in enumerate(header.names)}


def _rows(body: bytes, header: PcdHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    have = len(body) // header.dtype.itemsize
    if have < header.points:
        raise InputError(
            f"{path}: the PCD header promises {header.points} points, the file holds {have}; "
            "it is cut off"
        )
    rows = np.frombuffer(body, header.dtype, header.points)
    return {name: rows[name].astype(np.float64) for name in header.names}


def _compressed(body: bytes, header: PcdHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    """Two sizes, then one LZF stream that holds field after field, each for all points."""
    want = header.points * header.dtype.itemsize
    packed, size = (int(v) for v in np.frombuffer(body[:8].ljust(8, b"\0"), "<u4"))
    if size != want or len(body) < 8 + packed:
        raise InputError(
            f"{path}: the compressed PCD data should unpack to {want} bytes, the file says {size} "
            f"from {packed} of which {max(len(body) - 8, 0)} are there; it is damaged"
        )
    flat = lzf_decompress(np.frombuffer(body, np.uint8, packed, 8), size)
    if len(flat) != want:
        raise InputError(
            f"{path}: the compressed PCD data unpack to {len(flat)} of {want} bytes; it is damaged"
        )
    columns, at = {}, 0
    for name in header.names:
        kind = header.dtype[name]
        columns[name] = flat[at : at + kind.itemsize * header.points].view(kind).astype(np.float64)
        at += kind.itemsize * header.points
    return columns
