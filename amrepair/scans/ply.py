"""PLY point clouds: ascii and binary in, binary out. Faces are left to the mesh reader."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from amrepair.errors import InputError
from amrepair.scans.scan import Scan
from amrepair.scans.text import read_table

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
SENSOR_COMMENT = "sensor_mm"


@dataclass(frozen=True, slots=True)
class PlyHeader:
    """What stands before the data."""

    order: str
    vertices: int
    properties: tuple[tuple[str, str], ...]
    faces: int
    comments: tuple[str, ...]
    end: int


def read_header(data: bytes, path: Path) -> PlyHeader:
    """Parse the header.

    Raises
    ------
    InputError
        If it is not a PLY file with vertices first.
    """
    stop = data.find(b"end_header")
    if not data.startswith(b"ply") or stop < 0:
        raise InputError(f"{path}: not a PLY file (no 'ply' … 'end_header'); export it again")
    end = data.index(b"\n", stop) + 1 if b"\n" in data[stop:] else len(data)
    order, elements, comments = "", [], []
    properties: list[tuple[str, str]] = []
    try:
        for line in data[:stop].decode("ascii", "replace").splitlines():
            words = line.split()
            if not words:
                continue
            if words[0] == "format":
                order = FORMATS[words[1]]
            elif words[0] == "comment":
                comments.append(line.strip()[8:])
            elif words[0] == "element":
                elements.append((words[1], int(words[2])))
            elif words[0] == "property" and elements and elements[-1][0] == "vertex":
                properties.append((words[-1], TYPES[words[1]]))
    except (KeyError, IndexError, ValueError) as e:
        raise InputError(f"{path}: the PLY header cannot be understood ({e})") from e
    if not elements or elements[0][0] != "vertex":
        raise InputError(f"{path}: the PLY file does not start with vertices; export it again")
    faces = next((n for name, n in elements if name == "face"), 0)
    return PlyHeader(order, elements[0][1], tuple(properties), faces, tuple(comments), end)


def read_vertices(data: bytes, header: PlyHeader, path: Path) -> dict[str, Float[np.ndarray, " n"]]:
    """Columns of the vertex element by name.

    Raises
    ------
    InputError
        If the file is shorter than its header says, or x, y, z are not there.
    """
    names = [name for name, _ in header.properties]
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: the PLY vertices have no x, y, z but {names}")
    n = header.vertices
    if header.order == "":
        lines = io.BytesIO(data[header.end :])
        table = np.zeros((0, len(names)))
        if n:
            table = read_table(lines, path, "the PLY text", max_rows=n)
        if table.shape != (n, len(names)):
            raise InputError(
                f"{path}: the PLY header promises {n} vertices of {len(names)} values, "
                f"the file holds {table.shape[0]} of {table.shape[1]}; it is cut off or damaged"
            )
        return {name: table[:, i] for i, name in enumerate(names)}
    kind = np.dtype([(name, header.order + t) for name, t in header.properties])
    have = (len(data) - header.end) // kind.itemsize
    if have < n:
        raise InputError(
            f"{path}: the PLY header promises {n} vertices, the file holds {have}; it is cut off"
        )
    rows = np.frombuffer(data, kind, n, header.end)
    return {name: rows[name].astype(np.float64) for name in names}


def sensors_of(header: PlyHeader) -> Float[np.ndarray, "k 3"] | None:
    """Sensor origins from `comment sensor_mm x y z` lines, in order; None without any."""
    found = [c.split()[1:4] for c in header.comments if c.startswith(SENSOR_COMMENT)]
    try:
        return np.array(found, dtype=np.float64).reshape(-1, 3) if found else None
    except ValueError:
        return None


def write_ply(
    scan: Scan,
    path: Path,
    *,
    colours: Int[np.ndarray, "n 3"] | None = None,
    scalars: dict[str, np.ndarray] | None = None,
) -> None:
    """Write a scan as binary PLY: points, normals, colours, named scalars, sensors and noise.

    Parameters
    ----------
    colours
        (n, 3) 0…255.
    scalars
        Name → (n,) values, written as float properties.
    """
    n = len(scan)
    columns: list[tuple[str, str, np.ndarray]] = [
        (axis, "double", scan.points_mm[:, i]) for i, axis in enumerate("xyz")
    ]
    if scan.normals is not None:
        columns += [("n" + axis, "float", scan.normals[:, i]) for i, axis in enumerate("xyz")]
    if colours is not None:
        columns += [(c, "uchar", colours[:, i]) for i, c in enumerate(("red", "green", "blue"))]
    if scan.sensor_index is not None:
        columns.append(("sensor", "int", scan.sensor_index))
    for name, values in (scalars or {}).items():
        if len(values) != n:
            raise InputError(f"the scalar '{name}' has {len(values)} values for {n} points")
        columns.append((name, "float", values))
    rows = np.zeros(n, np.dtype([(name, "<" + TYPES[kind]) for name, kind, _ in columns]))
    for name, _, values in columns:
        rows[name] = values
    sensors = [] if scan.sensors_mm is None else scan.sensors_mm.tolist()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment unit mm",
        f"comment frame {scan.frame}",
        f"comment sigma_mm {scan.sigma_mm!r}",
        *(f"comment {SENSOR_COMMENT} {x!r} {y!r} {z!r}" for x, y, z in sensors),
        f"element vertex {n}",
        *(f"property {kind} {name}" for name, kind, _ in columns),
        "end_header",
    ]
    try:
        path.write_bytes(("\n".join(header) + "\n").encode("ascii") + rows.tobytes())
    except OSError as e:
        raise InputError(f"{path}: the scan cannot be written ({e.strerror})") from e
