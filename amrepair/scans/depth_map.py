"""Depth maps: a 16-bit PNG or a TIFF of depths, and a JSON file beside it with the camera.

`part.png` or `part.tif` with `part.json`, which says either `fx fy cx cy width height` (RealSense's
`ppx ppy` for the centre do as well) or, as Open3D writes it, `width`, `height` and an
`intrinsic_matrix` of nine numbers, column after column. Further keys: `depth_scale_mm`
(millimetres a count), or `depth_scale` (counts a metre as Open3D has it, where it is 1 or more;
metres a count as RealSense has it, below), and `pose`, a 4×4 frame_from_camera in millimetres,
row after row. Depth is along the camera's axis; the camera looks along +z, x to the right, y down.
Depth 0 or NaN is a gap.
"""

from __future__ import annotations

import json
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from jaxtyping import Num
from PIL import Image

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.scans.range_grid import RangeGrid
from amrepair.scans.scan import Scan
from amrepair.scans.sizes import PARSER_ERRORS, UnpackLimit, in_words, length_of, refuse_short

# What depth cameras count in (RealSense, Azure Kinect, Kinect 1 and 2) where nothing is said.
COUNT_MM = 1.0
MOST_JSON_BYTES = 1_000_000
RAW = 1  # TIFF's number for no compression


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
    frame_from_camera
        The camera's pose; None where the file does not say.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    shape: tuple[int, int]
    count_mm: float | None
    frame_from_camera: Transform | None


def camera_beside(path: Path) -> Camera | None:
    """The camera of a depth map; None where no JSON file with intrinsics lies beside it.

    Raises
    ------
    InputError
        If the JSON file is there but damaged, or says what cannot be.
    """
    beside = path.with_suffix(".json")
    if not beside.is_file():
        return None
    if length_of(beside) > MOST_JSON_BYTES:
        raise InputError(f"{beside}: over {MOST_JSON_BYTES} bytes are no camera's intrinsics")
    try:
        said = json.loads(beside.read_bytes())
    except (OSError, ValueError, RecursionError) as e:
        raise InputError(
            f"{beside}: the file beside the depth map cannot be read ({in_words(e)})"
        ) from e
    if not isinstance(said, dict) or not {"fx", "intrinsic_matrix"} & set(said):
        return None
    try:
        return _camera(said)
    except (KeyError, TypeError, ValueError, OverflowError, InputError) as e:
        raise InputError(
            f"{beside}: the camera cannot be understood ({type(e).__name__}: {in_words(e)}); it "
            "needs fx, fy, cx, cy or intrinsic_matrix, and width and height"
        ) from e


def _camera(said: dict[str, Any]) -> Camera:
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
        matrix = np.array(said["pose"], dtype=np.float64).reshape(4, 4)
        pose = Transform("file", "camera", matrix)
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


def read_depth_map(path: Path, camera: Camera, *, frame: str, sigma_mm: float) -> Scan:
    """The seen pixels as points; the camera is their sensor.

    Raises
    ------
    InputError
        If the image is damaged, is no depth map, or is not of the camera's size.
    """
    limit = UnpackLimit()
    read = _read_png if path.suffix.lower() == ".png" else _read_tiff
    try:
        image = read(path, camera, limit)
    except (*PARSER_ERRORS, tifffile.TiffFileError, Image.DecompressionBombError) as e:
        raise InputError(f"{path}: the depth map cannot be read ({in_words(e)})") from e
    count_mm = camera.count_mm
    if count_mm is None:
        if image.dtype.kind == "f":
            raise InputError(
                f"{path}: the JSON file beside it does not say depth_scale_mm, and depths in "
                "fractions may be metres or millimetres; add it"
            )
        count_mm = COUNT_MM
    seen = np.isfinite(image) & (image != 0)
    rows, columns = np.nonzero(seen)
    if len(rows) == 0:
        raise InputError(f"{path}: the depth map has no seen pixel")
    z_mm = image[seen].astype(np.float64) * count_mm
    if z_mm.min() < 0:
        raise InputError(f"{path}: the depth map has depths below 0; it is damaged")
    points_mm = np.stack(
        [
            (columns - camera.centre[0]) / camera.focal[0] * z_mm,
            (rows - camera.centre[1]) / camera.focal[1] * z_mm,
            z_mm,
        ],
        axis=1,
    )
    pose = camera.frame_from_camera
    return Scan(
        points_mm=points_mm if pose is None else pose.apply(points_mm),
        sigma_mm=sigma_mm,
        frame=frame,
        sensors_mm=np.zeros((1, 3)) if pose is None else pose.translation_mm[None].copy(),
        sensor_index=np.zeros(len(points_mm), np.int64),
        source=str(path),
        grids=(RangeGrid.of_seen(seen, "perspective"),),
    )


def _read_png(path: Path, camera: Camera, limit: UnpackLimit) -> Num[np.ndarray, "rows columns"]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of bombs: the limit here is held below
        with Image.open(path, formats=["PNG"]) as image:
            _refuse_size(path, (image.height, image.width), camera)
            if image.mode not in {"I;16", "I;16B", "I"}:
                raise InputError(
                    f"{path}: a depth map is grey of 16 bits a pixel, this one is '{image.mode}'"
                )
            limit.refuse(path, 2 * image.height * image.width, length_of(path))
            return np.asarray(image)


def _read_tiff(path: Path, camera: Camera, limit: UnpackLimit) -> Num[np.ndarray, "rows columns"]:
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages[0]
        refuse_swollen_page(path, page, limit)
        if len(page.shape) != 2 or page.dtype is None or page.dtype.kind not in "uif":
            raise InputError(
                f"{path}: a depth map is one number a pixel, this one has shape {page.shape}"
            )
        _refuse_size(path, page.shape, camera)
        return np.asarray(page.asarray())


def refuse_swollen_page(path: Path, page: Any, limit: UnpackLimit) -> None:
    """Refuse a page of a TIFF that the file cannot hold.

    Raises
    ------
    InputError
        If it is larger than what is stored of it, or swells beyond the limit.
    """
    size = length_of(path)
    what = "an image of " + " × ".join(str(n) for n in page.shape)
    if page.compression == RAW:
        refuse_short(path, what, page.nbytes, size)
    else:
        limit.refuse(path, page.nbytes, min(size, sum(page.databytecounts)))


def _refuse_size(path: Path, shape: tuple[int, ...], camera: Camera) -> None:
    if tuple(shape) != camera.shape:
        raise InputError(
            f"{path}: the depth map has {shape[1]} × {shape[0]} pixels, the JSON file beside it "
            f"says {camera.shape[1]} × {camera.shape[0]}; they do not belong together"
        )
