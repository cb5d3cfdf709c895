"""Range images of a ball that lies on a plane, by intersection of rays, and their files.

The plane is z = 0, the ball of radius 10 touches it in the origin. One pixel each is known for all
that a grid can tell: gaps, the ball's rim, pixels that fly between ball and plane.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from jaxtyping import Bool, Float
from PIL import Image

RADIUS_MM = 10.0
BALL_MM = np.array([0.0, 0.0, RADIUS_MM])
FOCAL, CENTRE, SHAPE = 220.0, (40.3, 29.6), (60, 80)
CAMERA_MM = 110.0  # over the plane, looking down
HOLE = (slice(5, 8), slice(10, 14))
PIXEL_MM = 0.5


@dataclass(frozen=True)
class RangeImage:
    """Places (rows, columns, 3), NaN where nothing came back, and what each pixel shows."""

    xyz: Float[np.ndarray, "rows columns 3"]
    ball: Bool[np.ndarray, "rows columns"]
    flying: Bool[np.ndarray, "rows columns"]
    sensor_mm: Float[np.ndarray, " 3"]

    @property
    def seen(self) -> Bool[np.ndarray, "rows columns"]:
        return np.asarray(~np.isnan(self.xyz).any(axis=2))


def cast(origin: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays (rows, columns, 3) meet ball or plane first, and whether it is the ball."""
    way = way / np.linalg.norm(way, axis=2, keepdims=True)
    plane = -origin[..., 2] / way[..., 2]
    to = origin - BALL_MM
    b = (to * way).sum(axis=2)
    inside = b**2 - (to**2).sum(axis=2) + RADIUS_MM**2
    ball = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
    hit = np.minimum(plane, ball)
    return origin + hit[..., None] * way, ball < plane


def perspective() -> RangeImage:
    """From a camera over the ball, in the frame of the plane; three pixels fly, a hole is dark."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    x, y = (columns - CENTRE[0]) / FOCAL, (rows - CENTRE[1]) / FOCAL
    way = np.stack([x, -y, -np.ones(SHAPE)], axis=2)  # the camera's y runs down, its z ahead
    sensor = np.array([0.0, 0.0, CAMERA_MM])
    xyz, ball = cast(np.broadcast_to(sensor, (*SHAPE, 3)), way)
    flying = np.zeros(SHAPE, bool)
    middle = round(CENTRE[1]), round(CENTRE[0])
    in_row, in_column = np.flatnonzero(ball[middle[0]]), np.flatnonzero(ball[:, middle[1]])
    flying[middle[0], [in_row[0] - 1, in_row[-1] + 1]] = True
    flying[in_column[-1] + 1, middle[1]] = True
    ratio = (CAMERA_MM - 0.5 * RADIUS_MM) / CAMERA_MM  # half way from the ball's rim to the plane
    xyz[flying] = sensor + (xyz[flying] - sensor) * ratio
    xyz[HOLE] = np.nan
    return RangeImage(xyz, ball, flying, sensor)


def orthographic(side: float = 1.0) -> RangeImage:
    """Straight from above; `side` -1 is the same from below a ball that hangs from the plane."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    x, y = (columns - CENTRE[0]) * PIXEL_MM, (rows - CENTRE[1]) * PIXEL_MM
    origin = np.stack([x, y, np.full(SHAPE, 100.0)], axis=2)
    xyz, ball = cast(origin, np.broadcast_to(np.array([0.0, 0.0, -1.0]), origin.shape))
    xyz[..., 2] *= side
    xyz[HOLE] = np.nan
    return RangeImage(xyz, ball, np.zeros(SHAPE, bool), np.array([0.0, 0.0, side * 1e4]))


def pushbroom(centre: tuple[float, float] = (40.0, 250.0)) -> RangeImage:
    """A sheet that moves along x; in it the rays meet in (y, z) = `centre`."""
    rows, columns = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    x = (columns - CENTRE[0]) * PIXEL_MM
    aim = (rows - CENTRE[1]) * PIXEL_MM  # where the ray meets the plane
    origin = np.stack([x, np.full(SHAPE, centre[0]), np.full(SHAPE, centre[1])], axis=2)
    way = np.stack([np.zeros(SHAPE), aim - centre[0], np.full(SHAPE, -centre[1])], axis=2)
    xyz, ball = cast(origin, way)
    xyz[HOLE] = np.nan
    return RangeImage(xyz, ball, np.zeros(SHAPE, bool), np.array([0.0, *centre]))


def in_camera(image: RangeImage) -> Float[np.ndarray, "rows columns 3"]:
    """The perspective image in its camera's own frame: x right, y down, z ahead."""
    return np.asarray((image.xyz - image.sensor_mm) * np.array([1.0, -1.0, -1.0]))


# ---- files ---------------------------------------------------------------------------------------


def write_ply_grid(path: Path, xyz: np.ndarray, kind: str, *, header: str = "") -> None:
    """As Stanford's range images; `kind` is ascii or one of the binary orders."""
    seen = ~np.isnan(xyz).any(axis=2)
    number = np.cumsum(seen).reshape(seen.shape) - 1
    points = xyz[seen]
    head = (
        f"ply\nformat {kind} 1.0\nobj_info num_cols {seen.shape[1]}\n"
        f"obj_info num_rows {seen.shape[0]}\n{header}element vertex {len(points)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element range_grid {seen.size}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()
    if kind == "ascii":
        rows = [" ".join(f"{v:.9g}" for v in row) for row in points]
        cells = [f"1 {n}" if s else "0" for n, s in zip(number.flat, seen.flat, strict=True)]
        body = "\n".join([*rows, *cells]).encode() + b"\n"
    else:
        order = "<" if kind.endswith("little_endian") else ">"
        cells_ = [
            b"\1" + np.array(n, order + "i4").tobytes() if s else b"\0"
            for n, s in zip(number.flat, seen.flat, strict=True)
        ]
        body = points.astype(order + "f4").tobytes() + b"".join(cells_)
    path.write_bytes(head + body)


def write_pcd_grid(
    path: Path, xyz: np.ndarray, kind: str = "binary", viewpoint: str = "0 0 0 1 0 0 0"
) -> None:
    """An organised PCD; gaps are NaN."""
    rows, columns = xyz.shape[:2]
    head = (
        "VERSION 0.7\nFIELDS x y z _\nSIZE 4 4 4 1\nTYPE F F F U\nCOUNT 1 1 1 4\n"
        f"WIDTH {columns}\nHEIGHT {rows}\nVIEWPOINT {viewpoint}\nPOINTS {rows * columns}\n"
        f"DATA {kind}\n"
    ).encode()
    flat = xyz.reshape(-1, 3).astype("<f4")
    if kind == "ascii":
        body = "\n".join(" ".join(f"{v:.9g}" for v in row) + " 0 0 0 0" for row in flat).encode()
    elif kind == "binary":
        padded = np.zeros((len(flat), 4), "<f4")
        padded[:, :3] = flat
        body = padded.tobytes()
    else:
        plain = flat.T.tobytes() + bytes(4 * len(flat))
        pieces = [plain[i : i + 32] for i in range(0, len(plain), 32)]
        packed = b"".join(bytes([len(piece) - 1]) + piece for piece in pieces)
        body = np.array([len(packed), len(plain)], "<u4").tobytes() + packed
    path.write_bytes(head + body)


def ptx_station(
    xyz_mm: np.ndarray, matrix: np.ndarray | None = None, place_m: str = "0 0 0"
) -> str:
    """One station: column after column, metres, `matrix` acts on row vectors."""
    rows, columns = xyz_mm.shape[:2]
    turn = np.eye(4) if matrix is None else matrix
    head = [str(columns), str(rows), place_m, "1 0 0", "0 1 0", "0 0 1"]
    head += [" ".join(f"{v:.12g}" for v in row) for row in turn]
    points = xyz_mm.transpose(1, 0, 2).reshape(-1, 3) / 1000
    body = [
        "0 0 0 0.5" if np.isnan(p).any() else f"{p[0]:.9f} {p[1]:.9f} {p[2]:.9f} 0.7"
        for p in points
    ]
    return "\n".join([*head, *body]) + "\n"


def write_depth_map(
    path: Path, camera_xyz: np.ndarray, *, count_mm: float, style: str = "plain"
) -> None:
    """PNG or TIFF of 16 bits, or TIFF of fractions where `count_mm` is 0, and its JSON."""
    z = camera_xyz[..., 2]
    beside = {"width": SHAPE[1], "height": SHAPE[0]}
    if style == "open3d":
        k = [FOCAL, 0, 0, 0, FOCAL, 0, *CENTRE, 1]
        said: dict[str, object] = {**beside, "intrinsic_matrix": k, "depth_scale": 1000 / count_mm}
    else:
        said = {**beside, "fx": FOCAL, "fy": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1]}
        said["depth_scale_mm"] = count_mm or 1.0
    path.with_suffix(".json").write_text(json.dumps(said))
    if count_mm == 0:
        tifffile.imwrite(path, z.astype(np.float32))
        return
    counts = np.round(np.nan_to_num(z) / count_mm).astype(np.uint16)
    if path.suffix == ".png":
        Image.fromarray(counts).save(path)
    else:
        tifffile.imwrite(path, counts, compression="zlib")
