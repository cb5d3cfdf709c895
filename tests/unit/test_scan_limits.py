"""Files that promise more than they hold: one sentence, at once, with next to no memory."""

from __future__ import annotations

import io
import json
import struct
import time
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

from amrepair.errors import InputError
from amrepair.scans import read_scan

MOST_S, MOST_BYTES = 2.0, 500_000_000


def npy_header(shape: tuple[int, ...], kind: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return file.getvalue()


def pcd(fields: str, count: str, points: int, kind: str = "binary", more: str = "") -> bytes:
    n = len(fields.split())
    return (
        f"VERSION 0.7\nFIELDS {fields}\nSIZE {'4 ' * n}\nTYPE {'F ' * n}\nCOUNT {count}\n{more}"
        f"POINTS {points}\nDATA {kind}\n"
    ).encode() + bytes(240)


def ply(vertices: str, kind: str, more: str = "") -> bytes:
    return (
        f"ply\nformat {kind} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\n"
        f"property float z\n{more}end_header\n"
    ).encode() + b"1 2 3\n" * 40


def zipped(members: dict[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return file.getvalue()


def png(width: int, height: int) -> bytes:
    def chunk(name: bytes, data: bytes) -> bytes:
        whole = name + data
        return struct.pack(">I", len(data)) + whole + struct.pack(">I", zlib.crc32(whole))

    head = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(500)))
        + chunk(b"IEND", b"")
    )  # fmt: skip


def tiff(width: int, height: int) -> bytes:
    """A TIFF whose directory promises another size than it holds."""
    file = io.BytesIO()
    tifffile.imwrite(file, np.ones((24, 32), np.float32))
    data = bytearray(file.getvalue())
    for old, new in ((32, width), (24, height)):
        for kind in ("<HHIH", "<HHII"):
            tag = 256 if old == 32 else 257
            found = data.find(struct.pack(kind, tag, 3 if kind[-1] == "H" else 4, 1, old))
            if found >= 0:
                data[found : found + 12] = struct.pack("<HHII", tag, 4, 1, new)
                break
        else:
            raise AssertionError("the tag is not where it is looked for")
    return bytes(data)


def strips(rows: int) -> bytes:
    """A TIFF of one packed strip whose directory promises many: the others were read as zeros."""
    file = io.BytesIO()
    image = np.ones((24, 32), np.float32)
    tifffile.imwrite(file, image, compression="zlib", rowsperstrip=24)
    data = bytearray(file.getvalue())
    for kind, width in ((3, "<HHIH"), (4, "<HHII")):
        found = data.find(struct.pack(width, 257, kind, 1, 24))
        if found >= 0:
            data[found : found + 12] = struct.pack("<HHII", 257, 4, 1, rows)
            return bytes(data)
    raise AssertionError("the tag is not where it is looked for")


def camera(width: int, height: int) -> bytes:
    return json.dumps(
        {"fx": 100, "fy": 100, "cx": 5, "cy": 5, "width": width, "height": height,
         "depth_scale_mm": 1}
    ).encode()  # fmt: skip


SIX = "\n".join(["0 0 0", "1 0 0", "0 1 0", "0 0 1", "1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"])
ENTITIES = b"<!DOCTYPE m [" + b"".join(
    f'<!ENTITY e{k} "{f"&e{k - 1};" * 10 if k else "x" * 100}">'.encode() for k in range(12)
) + b"]><model>&e11;</model>"  # fmt: skip

PROMISES: dict[str, Callable[[], dict[str, bytes]]] = {
    "npy of 745 GB": lambda: {"a.npy": npy_header((100_000_000_000, 1)) + bytes(100)},
    "npy of 745 GB in rows": lambda: {"a.npy": npy_header((33_333_333_333, 3)) + bytes(100)},
    "npy of an endless shape": lambda: {"a.npy": npy_header((10**30, 3)) + bytes(100)},
    "npz with a npy of 745 GB": lambda: {
        "a.npz": zipped({"points_mm.npy": npy_header((33_333_333_333, 3)) + bytes(100)})
    },
    "npz that swells": lambda: {
        "a.npz": zipped({"points_mm.npy": npy_header((8_000_000, 3)) + bytes(192_000_000)})
    },
    "pcd of 10^8 values": lambda: {"a.pcd": pcd("x y z d", "1 1 1 100000000", 1)},
    "pcd of 10^12 points": lambda: {"a.pcd": pcd("x y z", "1 1 1", 10**12)},
    "pcd text of 10^12 points": lambda: {"a.pcd": pcd("x y z", "1 1 1", 10**12, "ascii")},
    "pcd packed to 4 GB": lambda: {
        "a.pcd": pcd("x y z", "1 1 1", 357_913_941, "binary_compressed")[:-240]
        + np.array([100, 4_294_967_292], "<u4").tobytes() + bytes(100)
    },
    "pcd of a width that is not there": lambda: {
        "a.pcd": pcd("x y z", "1 1 1", 20, more="WIDTH 1000000\nHEIGHT 1000000\n")
    },
    "ply of 10^12 vertices": lambda: {"a.ply": ply("1000000000000", "binary_little_endian")},
    "ply text of 10^12 vertices": lambda: {"a.ply": ply("1000000000000", "ascii")},
    "ply of 10^40 vertices": lambda: {"a.ply": ply("1" + "0" * 40, "ascii")},
    "ply of -1 vertices": lambda: {"a.ply": ply("-1", "binary_little_endian")},
    "ply of 10^12 faces": lambda: {
        "a.ply": ply("3", "ascii", "element face 1000000000000\nproperty list uchar int v\n")
    },
    "ply of an element without properties": lambda: {
        "a.ply": ply(
            "3", "binary_little_endian", "element face 1\nproperty list uchar int v\n"
        ).replace(b"property float", b"prXperty float")
    },
    "ply of 10^12 pixels": lambda: {
        "a.ply": ply("3", "binary_little_endian", "obj_info num_cols 1000000\nobj_info num_rows "
                     "1000000\nelement range_grid 1000000000000\nproperty list uchar int v\n")
    },
    "ptx of 10^12 pixels": lambda: {"a.ptx": f"1000000\n1000000\n{SIX}\n0 0 0 0\n".encode()},
    "ptx of a cut station": lambda: {"a.ptx": f"2\n1\n{SIX}\n1 2 3 0\n".encode()},
    "png of 4 gigapixels": lambda: {"a.png": png(65535, 65535), "a.json": camera(65535, 65535)},
    "png of 100 megapixels": lambda: {"a.png": png(10000, 10000), "a.json": camera(10000, 10000)},
    "tiff of a terapixel": lambda: {
        "a.tif": tiff(1_000_000, 1_000_000), "a.json": camera(1_000_000, 1_000_000)
    },
    "height map of strips that are not there": lambda: {"a.tif": strips(40_000)},
    "height map of a terapixel": lambda: {"a.tif": tiff(1_000_000, 1_000_000)},
    "3mf that swells": lambda: {"a.3mf": zipped({"3D/3dmodel.model": b" " * 200_000_000})},
    "3mf whose entities grow": lambda: {"a.3mf": zipped({"3D/3dmodel.model": ENTITIES})},
    "3mf that is no archive": lambda: {"a.3mf": b"solid nothing"},
    "3mf without a model": lambda: {"a.3mf": zipped({"readme.txt": b"nothing"})},
}  # fmt: skip


@pytest.mark.parametrize("name", PROMISES)
def test_a_promise_beyond_the_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    # regression: a .npy that promised 745 GB was a traceback, a PCD with COUNT 10^8 took a minute
    # and 6.9 GB
    files = PROMISES[name]()
    for file, data in files.items():
        (tmp_path / file).write_bytes(data)
    read_something(tmp_path)
    tracemalloc.start()
    began = time.perf_counter()
    with pytest.raises(InputError) as caught:
        read_scan(tmp_path / next(iter(files)), frame="scanner", cell_mm=1.0)
    spent_s = time.perf_counter() - began
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    said = str(caught.value)
    assert next(iter(files)) in said or "a.json" in said
    assert "\n" not in said
    assert spent_s < MOST_S
    assert most < MOST_BYTES / 10  # what the interpreter and its libraries take comes on top


def read_something(folder: Path) -> None:
    """Load what a first reading loads, so that only the file's own cost is measured."""
    (folder / "warm.xyz").write_text("1 2 3\n4 5 6\n")
    read_scan(folder / "warm.xyz", frame="scanner")
