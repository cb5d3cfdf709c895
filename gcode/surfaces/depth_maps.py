"""Depth maps of the bed, as a camera photographs them: PNG or TIFF, and JSON beside it.

`bed.png` (16 bits, grey) or `bed.tif` with `bed.json`, which says either `fx fy cx cy width height`
(RealSense's `ppx ppy` for the centre do as well) or, as Open3D writes it, `width`, `height` and an
`intrinsic_matrix` of nine numbers, column after column. Further keys: `depth_scale_mm` (millimetres
a count), or `depth_scale` (counts a metre as Open3D has it, where it is 1 or more; metres a count
as RealSense has it, below), and `pose`, a 4×4 bed_from_camera in millimetres, row after row. Depth
is along the camera's axis; the camera looks along +z, x to the right, y down. 0 or NaN is a gap.
"""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Num

from gcode.errors import InputError
from gcode.surfaces.sizes import (
    PARSER_ERRORS,
    UnpackLimit,
    in_words,
    length_of,
    quiet_tiff,
    refuse_swollen_page,
)

DEPTH_SUFFIXES = frozenset({".png", ".tif", ".tiff"})
MOST_JSON_BYTES = 1_000_000
COUNT_MM = 1.0  # of depth cameras (RealSense, Azure Kinect) where nothing is said
CAMERA_RIGID = 1e-3  # digits of a rotation in a file
BAND_MM, TILT_RAD = 10.0, math.radians(3.0)
"""How far off a camera's pose may be for the bed to put it right."""
ON_BED_MM = 0.7
"""Of one plane: what depth cameras of this class are off by at half a metre."""
UNDER_MM, UNDER_RATIO = 2.0, 0.01
LEAST_BED_RATIO = 0.05
PLANE_TRIES = (
    400  # of three points: where a tenth is bed, one in three such runs in a hundred misses it
)


@dataclass(frozen=True, slots=True)
class Camera:
    """What the JSON file says.

    Attributes
    ----------
    focal, centre
        fx, fy and cx, cy in pixels.
    shape
        Rows and columns.
    count_mm
        Millimetres a count; None where the file does not say.
    pose
        (4, 4) frame_from_camera, mm; None where the file does not say.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    shape: tuple[int, int]
    count_mm: float | None
    pose: Float[np.ndarray, "4 4"] | None

    def points_mm(
        self, image: Num[np.ndarray, "rows columns"], count_mm: float
    ) -> tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, "rows columns"]]:
        """(n, 3) the seen pixels in the camera's frame, row after row, and which they are."""
        seen = np.isfinite(image) & (image != 0)
        rows, columns = np.nonzero(seen)
        z_mm = image[seen].astype(np.float64) * count_mm
        across = (columns - self.centre[0]) / self.focal[0] * z_mm
        down = (rows - self.centre[1]) / self.focal[1] * z_mm
        return np.stack([across, down, z_mm], axis=1), seen


def camera_of(said: dict[str, Any]) -> Camera:
    """The camera that a JSON object tells of.

    Raises
    ------
    KeyError, TypeError, ValueError, OverflowError
        If something is missing, is no number, or cannot be.
    """
    if "intrinsic_matrix" in said:
        k = np.array(said["intrinsic_matrix"], dtype=np.float64)
        k = k.reshape(3, 3) if k.ndim == 2 else k.reshape(3, 3).T
        focal, centre = (float(k[0, 0]), float(k[1, 1])), (float(k[0, 2]), float(k[1, 2]))
    else:
        focal = float(said["fx"]), float(said["fy"])
        x, y = ("cx", "cy") if "cx" in said else ("ppx", "ppy")
        centre = float(said[x]), float(said[y])
    shape = int(said["height"]), int(said["width"])
    if not all(0 < f < np.inf for f in focal) or not np.isfinite(centre).all() or min(shape) < 1:
        raise ValueError(f"focal length {focal}, centre {centre}, size {shape}")
    bent = np.array(said.get("distortion", said.get("coeffs", [])), dtype=np.float64)
    if np.abs(bent).max(initial=0.0) > 0:
        raise ValueError("lens distortion is not undone here: export a rectified depth map")
    pose = None
    if said.get("pose") is not None:
        pose = np.array(said["pose"], dtype=np.float64).reshape(4, 4)
        turn = pose[:3, :3]
        if not (np.abs(turn @ turn.T - np.eye(3)).max() < CAMERA_RIGID and np.linalg.det(turn) > 0):
            raise ValueError("the pose is no rigid motion: its rotation stretches or mirrors")
    return Camera(focal, centre, shape, _count_mm(said), pose)


def _count_mm(said: dict[str, Any]) -> float | None:
    """Millimetres a count, by whichever key says it."""
    if said.get("depth_scale_mm") is not None:
        count_mm = float(said["depth_scale_mm"])
    elif said.get("depth_scale") is not None:
        scale = float(said["depth_scale"])
        count_mm = 1000.0 / scale if scale >= 1 else 1000.0 * scale
    else:
        return None
    if not 0 < count_mm < np.inf:
        raise ValueError(f"a depth scale of {count_mm} mm a count")
    return count_mm


def is_depth_map(path: Path) -> bool:
    """Whether a camera's JSON lies beside an image; a TIFF without one is a height map."""
    suffix = path.suffix.lower()
    if suffix == ".png":
        return True
    beside = path.with_suffix(".json")
    if suffix not in DEPTH_SUFFIXES or not beside.is_file():
        return False
    said = _said(beside)
    return isinstance(said, dict) and bool({"fx", "intrinsic_matrix"} & said.keys())


@dataclass(frozen=True, slots=True)
class Seen:
    """What a depth map shows.

    Attributes
    ----------
    points_mm
        (n, 3) in the bed's frame.
    spacing_mm
        Between the pixels of one thing, the median.
    told
        By how much the camera's pose was put right, in a sentence.
    """

    points_mm: Float[np.ndarray, "n 3"]
    spacing_mm: float
    told: str


def read_on_bed(path: Path, box_mm: tuple[float, float, float, float] | None = None) -> Seen:
    """What a depth map shows of the bed and what stands on it.

    The camera's own pose is taken, then height and tilt from the bed that it sees.

    Parameters
    ----------
    box_mm
        (x_min, y_min, x_max, y_max) of the bed: what lies around it is left out.

    Raises
    ------
    InputError
        If something cannot be read, nobody says where the camera stands, or it sees no bed.
    """
    depth = read_depth(path)
    points_mm, pose = depth.points_mm, depth.camera.pose
    if pose is None:
        raise InputError(
            f"{path}: the JSON file beside it does not say where the camera stands: add 'pose', a "
            "4×4 bed_from_camera in millimetres, row after row, good to a centimetre and 3°."
        )
    placed_mm = points_mm @ pose[:3, :3].T + pose[:3, 3]
    if box_mm is not None:
        low, high = np.array(box_mm[:2]), np.array(box_mm[2:])
        inside = ((placed_mm[:, :2] >= low) & (placed_mm[:, :2] <= high)).all(axis=1)
        points_mm, placed_mm = points_mm[inside], placed_mm[inside]
    moved_mm, told = levelled(placed_mm, what=str(path))
    spacing_mm = float(np.median(points_mm[:, 2])) / min(depth.camera.focal)
    return Seen(moved_mm, spacing_mm, told)


def levelled(
    points_mm: Float[np.ndarray, "n 3"], *, what: str
) -> tuple[Float[np.ndarray, "n 3"], str]:
    """The same points, moved so that the bed among them lies at Z 0, and what that took.

    The bed is the plane with the most points on it that has nothing below it.

    Raises
    ------
    InputError
        If there is none within 10 mm and 3° of where it should be.
    """
    near = np.flatnonzero(np.abs(points_mm[:, 2]) < 2 * BAND_MM)
    some = points_mm[near[:: max(1, len(near) // 20_000)]]
    every = points_mm[:: max(1, len(points_mm) // 20_000)]
    rng, best, plane = np.random.default_rng(0), 0, None
    for _ in range(PLANE_TRIES if len(some) > 2 else 0):
        fitted = _plane(some[rng.choice(len(some), 3, replace=False)])
        if fitted is None:
            continue
        count = int((np.abs(_above(some, fitted)) < ON_BED_MM).sum())
        if count > best and (_above(every, fitted) < -UNDER_MM).mean() < UNDER_RATIO:
            best, plane = count, fitted
    if plane is None or best < LEAST_BED_RATIO * len(some):
        raise InputError(
            f"{what} shows no bed within {BAND_MM:g} mm and {math.degrees(TILT_RAD):g}° of Z 0: "
            "photograph more of the bed, or calibrate the camera's pose."
        )
    for _ in range(3):
        plane = _plane(some[np.abs(_above(some, plane)) < ON_BED_MM]) or plane
    a, b, c = plane
    up = np.array([-a, -b, 1.0]) / math.sqrt(a * a + b * b + 1.0)
    axis = np.array([up[1], -up[0], 0.0])  # up × Z
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn = np.eye(3) + cross + cross @ cross / (1.0 + up[2])
    foot = np.array([0.0, 0.0, c])
    moved = (points_mm - foot) @ turn.T
    middle = points_mm.mean(axis=0)
    off_mm = a * middle[0] + b * middle[1] + c
    tilt = math.degrees(math.acos(min(1.0, up[2])))
    return moved, f"{what}: put right by its bed, {-off_mm:+.2f} mm in height and {tilt:.2f}°."


Plane = tuple[float, float, float]
"""z = a x + b y + c."""


def _plane(points_mm: Float[np.ndarray, "k 3"]) -> Plane | None:
    """The plane through some points; None where it is steep, or is far from the bed's place."""
    if len(points_mm) < 3:
        return None
    design = np.column_stack([points_mm[:, :2], np.ones(len(points_mm))])
    (a, b, c), _, rank, _ = np.linalg.lstsq(design, points_mm[:, 2], rcond=None)
    middle = design.mean(axis=0)
    far = abs(float(middle @ [a, b, c])) > BAND_MM
    if rank < 3 or far or math.hypot(a, b) > math.tan(TILT_RAD):
        return None
    return float(a), float(b), float(c)


def _above(points_mm: Float[np.ndarray, "n 3"], plane: Plane) -> Float[np.ndarray, " n"]:
    return np.asarray(points_mm[:, 2] - points_mm[:, :2] @ plane[:2] - plane[2])


@dataclass(frozen=True, slots=True)
class Depth:
    """A depth map as it was read.

    Attributes
    ----------
    points_mm
        (n, 3) the seen pixels in the camera's frame, row after row.
    seen
        (rows, columns) which they are.
    """

    camera: Camera
    points_mm: Float[np.ndarray, "n 3"]
    seen: Bool[np.ndarray, "rows columns"]


def read_depth(path: Path) -> Depth:
    """Read a depth map, and the camera beside it.

    Raises
    ------
    InputError
        If either cannot be read, they do not belong together, or nothing was seen.
    """
    camera = _camera_beside(path)
    image = _image(path, camera)
    count_mm = camera.count_mm
    if count_mm is None:
        if image.dtype.kind == "f":
            raise InputError(
                f"{path}: the JSON file beside it does not say depth_scale_mm, and depths in "
                "fractions may be metres or millimetres; add it."
            )
        count_mm = COUNT_MM
    points_mm, seen = camera.points_mm(image, count_mm)
    if not len(points_mm):
        raise InputError(f"{path}: the depth map has no seen pixel.")
    if points_mm[:, 2].min() < 0:
        raise InputError(f"{path}: the depth map has depths below 0; it is damaged.")
    return Depth(camera, points_mm, seen)


def _said(beside: Path) -> Any:
    try:
        if length_of(beside) > MOST_JSON_BYTES:
            raise InputError(f"{beside}: over {MOST_JSON_BYTES} bytes are no camera's intrinsics.")
        return json.loads(beside.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"{beside}: the camera of the depth map cannot be read ({in_words(error)}); it is a "
            "JSON file of the image's name, with fx, fy, cx, cy, width, height and pose."
        ) from error


def _camera_beside(path: Path) -> Camera:
    beside = path.with_suffix(".json")
    if not beside.is_file():
        raise InputError(
            f"{path}: a PNG is read as a depth map, and needs the camera in {beside.name} beside "
            "it: fx, fy, cx, cy, width, height, depth_scale_mm and pose."
        )
    said = _said(beside)
    try:
        return camera_of(said)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{beside}: the camera cannot be understood ({type(error).__name__}: "
            f"{in_words(error)}); it needs fx, fy, cx, cy or intrinsic_matrix, and width and "
            "height."
        ) from error


def _image(path: Path, camera: Camera) -> Num[np.ndarray, "rows columns"]:
    from PIL import Image

    read = _png if path.suffix.lower() == ".png" else _tiff
    try:
        return read(path, camera)
    except (*PARSER_ERRORS, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: the depth map cannot be read ({in_words(error)}).") from error


def _png(path: Path, camera: Camera) -> Num[np.ndarray, "rows columns"]:
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bombs: the limit here is held below
        with Image.open(path, formats=["PNG"]) as image:
            _refuse_shape(path, (image.height, image.width), camera)
            if image.mode not in {"I;16", "I;16B", "I"}:
                raise InputError(
                    f"{path}: a depth map is grey of 16 bits a pixel, this one is '{image.mode}'."
                )
            UnpackLimit().refuse(path, 2 * image.height * image.width, length_of(path))
            return np.asarray(image)


def _tiff(path: Path, camera: Camera) -> Num[np.ndarray, "rows columns"]:
    with quiet_tiff(path) as tiff:
        page: Any = tiff.pages[0]
        refuse_swollen_page(path, page, UnpackLimit())
        if len(page.shape) != 2 or page.dtype is None or page.dtype.kind not in "uif":
            raise InputError(
                f"{path}: a depth map is one number a pixel, this one has shape {page.shape}."
            )
        _refuse_shape(path, page.shape, camera)
        return np.asarray(page.asarray())


def _refuse_shape(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if tuple(shape) != camera.shape:
        raise InputError(
            f"{path}: the depth map has {shape[1]} × {shape[0]} pixels, the JSON file beside it "
            f"says {camera.shape[1]} × {camera.shape[0]}; they do not belong together."
        )
