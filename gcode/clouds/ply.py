"""PLY files: the header, and what its vertices say. Grids and faces are other readers' business."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gcode.clouds.text import filled, read_table
from gcode.errors import InputError
from gcode.surfaces.sizes import refuse_short

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True, slots=True)
class PlyList:
    """A list property: the types of its length and of its entries."""

    length: str
    entry: str


@dataclass(frozen=True, slots=True)
class PlyElement:
    """One element of a header: properties by name, a type of numpy or a list."""

    name: str
    count: int
    properties: tuple[tuple[str, str | PlyList], ...]

    def least_bytes(self, *, text: bool) -> int:
        """How short it can be: every list empty; in text a digit and a space a value."""
        each = sum(
            2 if text else np.dtype(kind.length if isinstance(kind, PlyList) else kind).itemsize
            for _, kind in self.properties
        )
        return self.count * each


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """What stands before the data.

    Attributes
    ----------
    order
        Of the bytes, as numpy writes it; empty for text.
    elements
        In the file's order; vertices come first.
    comments, infos
        What stands after `comment` and after `obj_info`.
    end
        Where the data begin.
    """

    order: str
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]
    infos: tuple[str, ...]
    end: int

    def count_of(self, name: str) -> int:
        """How many of an element there are; 0 of one that the file does not have."""
        return next((e.count for e in self.elements if e.name == name), 0)

    def said(self, name: str) -> str | None:
        """The one word that a comment or an obj_info says of `name`; None without any."""
        for line in (*self.comments, *self.infos):
            words = line.split()
            if len(words) == 2 and words[0] == name:
                return words[1]
        return None


def read_header(data: bytes, path: Path) -> PlyHeader:
    """Parse the header, and hold what it promises against the file's length.

    Raises
    ------
    InputError
        If it is not a PLY file with vertices first, or the file is shorter than it says.
    """
    stop = data.find(b"end_header")
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(f"{path}: not a PLY file (no 'ply' … 'end_header'); export it again.")
    end = data.find(b"\n", stop) + 1 or len(data)
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str | PlyList]]]] = []
    comments, infos = [], []
    try:
        for line in data[:stop].decode("ascii", "replace").splitlines():
            words = line.split()
            if not words:
                continue
            if words[0] == "format":
                order = FORMATS[words[1]]
            elif words[0] == "comment":
                comments.append(line.strip()[8:])
            elif words[0] == "obj_info":
                infos.append(line.strip()[9:])
            elif words[0] == "element":
                elements.append((words[1], int(words[2]), []))
            elif words[0] == "property" and elements:
                elements[-1][2].append((words[-1], _type_of(words)))
    except (KeyError, IndexError, ValueError) as e:
        raise InputError(f"{path}: the PLY header cannot be understood ({e}).") from e
    if order is None or not elements or elements[0][0] != "vertex":
        raise InputError(f"{path}: the PLY file does not start with vertices; export it again.")
    header = PlyHeader(
        order,
        tuple(PlyElement(name, count, tuple(properties)) for name, count, properties in elements),
        tuple(comments),
        tuple(infos),
        end,
    )
    _refuse_promises(header, len(data) - end, path)
    return header


def _type_of(words: list[str]) -> str | PlyList:
    """The type of a property's line."""
    if words[1] != "list":
        return TYPES[words[1]]
    length, entry = TYPES[words[2]], TYPES[words[3]]
    if "f" in length:
        raise ValueError(f"a list whose length is of type {words[2]}")
    return PlyList(length, entry)


def _refuse_promises(header: PlyHeader, have_bytes: int, path: Path) -> None:
    """Refuse counts and names that cannot be."""
    need = 0
    for element in header.elements:
        names = [name for name, _ in element.properties]
        if element.count < 0 or len(set(names)) < len(names):
            raise InputError(
                f"{path}: the PLY header cannot be understood ({element.count} of {element.name} "
                f"with {names})."
            )
        need += element.least_bytes(text=header.order == "")
        # The last value of a text file needs no end of line.
        refuse_short(path, f"{element.count} of {element.name}", need - 1, have_bytes)


def read_vertices(
    data: bytes, header: PlyHeader, path: Path
) -> tuple[dict[str, Float[np.ndarray, " n"]], memoryview]:
    """Columns of the vertex element by name, and the data after it.

    Raises
    ------
    InputError
        If the file is shorter than its header says, or x, y, z are not there.
    """
    vertices = header.elements[0]
    kinds = {name: kind for name, kind in vertices.properties if isinstance(kind, str)}
    n = vertices.count
    if not {"x", "y", "z"} <= set(kinds):
        raise InputError(f"{path}: the PLY vertices have no x, y, z but {list(kinds)}.")
    if len(kinds) < len(vertices.properties):
        raise InputError(f"{path}: PLY vertices with lists are not read; export plain vertices.")
    if n == 0:
        raise InputError(f"{path}: the PLY file has no vertices; scan again or check the export.")
    body = memoryview(data)[header.end :]
    if header.order == "":
        text = io.BytesIO(body)
        table = read_table(filled(text), path, "the PLY text", max_rows=n)
        if table.shape != (n, len(kinds)):
            raise InputError(
                f"{path}: the PLY header promises {n} vertices of {len(kinds)} values, "
                f"the file holds {table.shape[0]} of {table.shape[1]}; it is cut off or damaged."
            )
        return {name: table[:, i].copy() for i, name in enumerate(kinds)}, body[text.tell() :]
    kind = np.dtype([(name, header.order + t) for name, t in kinds.items()])
    have = len(body) // kind.itemsize
    if have < n:
        raise InputError(
            f"{path}: the PLY header promises {n} vertices, the file holds {have}; it is cut off."
        )
    rows = np.frombuffer(body, kind, n)
    columns = {name: rows[name].astype(np.float64) for name in kinds}
    return columns, body[n * kind.itemsize :]
