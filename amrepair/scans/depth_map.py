"""Depth maps as scans: a 16-bit PNG or a TIFF, and a JSON file beside it with the camera.

What the JSON file says is told in `gcode.surfaces.depth_maps`; `pose` is frame_from_camera.
"""

from __future__ import annotations

import json
import math
import warnings
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
from gcode.surfaces.depth_maps import COUNT_MM, Camera, camera_of

MOST_JSON_BYTES = 1_000_000
RAW = 1  # TIFF's number for no compression


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
        return camera_of(said)
    except (KeyError, TypeError, ValueError, OverflowError, InputError) as e:
        raise InputError(
            f"{beside}: the camera cannot be understood ({type(e).__name__}: {in_words(e)}); it "
            "needs fx, fy, cx, cy or intrinsic_matrix, and width and height"
        ) from e


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
    points_mm, seen = camera.points_mm(image, count_mm)
    if len(points_mm) == 0:
        raise InputError(f"{path}: the depth map has no seen pixel")
    if points_mm[:, 2].min() < 0:
        raise InputError(f"{path}: the depth map has depths below 0; it is damaged")
    pose = None if camera.pose is None else Transform("file", "camera", camera.pose)
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
    promised, there = math.prod(page.chunked), len(page.dataoffsets)
    if there < promised:  # what is not there would be read as zeros
        raise InputError(
            f"{path}: {what} is in {promised} pieces, and the file has {there}; it is cut off or "
            "damaged"
        )
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
