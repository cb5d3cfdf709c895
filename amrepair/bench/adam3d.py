"""Reader of the 3D-ADAM layout: printed parts on a table, seen by one depth camera.

    <class>/{train,test}/<good or defect>/xyz/<stem>.tiff           x y z of every pixel
    <class>/{train,test}/<good or defect>/ground_truth/<stem>.png   over 0 where defective

As MVTec 3D-AD has it; `rgb/` is not read. A pixel without depth is 0 0 0 or NaN. The table that the
part lies on is no part of the class, and is taken away: the plane through what the image shows
along its border, as in Horwitz and Hoshen, "Back to the Feature" (CVPR workshop 2023), section 3.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from amrepair.arrays import Points, Vector
from amrepair.bench.samples import GOOD, BenchClass, Sample, SampleCloud
from amrepair.errors import InputError, refused_as_ours
from amrepair.frames import diagonal
from amrepair.observe.robust import MAD_TO_SIGMA
from gcode.surfaces.sizes import (
    PARSER_ERRORS,
    UnpackLimit,
    in_words,
    quiet_tiff,
    refuse_swollen_page,
)

BORDER_RATIO = 0.03  # of the image's shorter side: the part does not reach so far out
# A table is flat to this share of the width that the border shows, as one standard deviation (a
# camera's own bow is a tenth of it). What lies within three of them cannot be told from it.
FLAT_RATIO, TABLE_SIGMAS = 0.005, 3.0
PLANE_DRAWS, PLANE_POINTS = 200, 2_000


def find_classes(root: Path) -> tuple[BenchClass, ...]:
    """Classes in `root`, else in its only data folder."""
    for base in (root, *sorted(path for path in root.iterdir() if path.is_dir())):
        folders = [path for path in sorted(base.iterdir()) if (path / "train").is_dir()]
        classes = tuple(_read_class(path) for path in folders if _scans(path / "train" / GOOD))
        if classes:
            return classes
    return ()


def _scans(label: Path) -> tuple[Path, ...]:
    """The scans of one label of one split."""
    return tuple(sorted((label / "xyz").glob("*.tif*")))


def _read_class(folder: Path) -> BenchClass:
    test = folder / "test"
    labels = sorted(path for path in test.iterdir() if path.is_dir()) if test.is_dir() else []
    samples = tuple(_sample(folder.name, label, path) for label in labels for path in _scans(label))
    return BenchClass(folder.name, _scans(folder / "train" / GOOD), None, samples, read_part)


def _sample(class_name: str, label: Path, path: Path) -> Sample:
    normal = label.name == GOOD
    return Sample(
        class_name=class_name,
        name=f"{label.name}_{path.stem}",  # stems repeat from label to label
        kind=label.name,
        cloud_path=path,
        truth_path=None if normal else label / "ground_truth" / f"{path.stem}.png",
        read=load,
    )


def load(sample: Sample) -> SampleCloud:
    """Points of the part and what the mask says of their pixels.

    Raises
    ------
    InputError
        If a file is missing or damaged, or scan and mask differ in size.
    """
    grid = read_grid(sample.cloud_path)
    part = on_part(grid)
    defective = np.zeros(part.shape, bool)
    if sample.truth_path is not None:
        defective = _read_mask(sample.truth_path, part.shape)
    return SampleCloud(grid[part], defective[part].astype(np.int64))


def read_part(path: Path) -> Points:
    """(n, 3) points of the part in a scan, without the table."""
    grid = read_grid(path)
    return np.asarray(grid[on_part(grid)])


def read_grid(path: Path) -> Float[np.ndarray, "rows columns 3"]:
    """A scan as it lies in the file; gaps are NaN.

    Raises
    ------
    InputError
        If it is damaged, or holds something else.
    """
    try:
        with refused_as_ours(), quiet_tiff(path) as tiff:
            page: Any = tiff.pages[0]
            refuse_swollen_page(path, page, UnpackLimit())
            grid = np.asarray(page.asarray(), dtype=np.float64)
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: the scan cannot be read ({in_words(e)})") from e
    if grid.ndim != 3 or grid.shape[2] != 3:
        raise InputError(
            f"{path}: a scan of 3D-ADAM is x y z for every pixel, this one has shape {grid.shape}"
        )
    grid[~(np.isfinite(grid).all(axis=2) & grid.any(axis=2))] = np.nan
    return grid


def on_part(grid: Float[np.ndarray, "rows columns 3"]) -> Bool[np.ndarray, "rows columns"]:
    """Pixels that show the part: those with depth, off the table where there is one."""
    seen = np.isfinite(grid).all(axis=2)
    wide = max(1, round(BORDER_RATIO * min(seen.shape)))
    border = seen.copy()
    border[wide:-wide, wide:-wide] = False
    table = _plane(grid[border])
    if table is None:
        return seen
    normal, offset, sigma = table
    off = np.abs(grid @ normal - offset) > TABLE_SIGMAS * sigma
    return np.asarray(seen & off)


def _plane(points: Points) -> tuple[Vector, float, float] | None:
    """Unit normal, offset and standard deviation of the flat that half the points lie on, or None.

    Drawn triples, the one with the least median distance (Rousseeuw 1984), then a fit to what lies
    within three standard deviations of it.
    """
    if len(points) < 3:
        return None
    rng = np.random.default_rng(0)  # the same table for the same scan
    some = points[rng.integers(0, len(points), min(PLANE_POINTS, len(points)))]
    a, b, c = some[rng.integers(0, len(some), (3, PLANE_DRAWS))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    normals, a = normals[length > 0] / length[length > 0, None], a[length > 0]
    if not len(normals):
        return None
    away = np.abs(some @ normals.T - (normals * a).sum(axis=1))
    median = np.median(away, axis=0)
    best = int(np.argmin(median))
    sigma = MAD_TO_SIGMA * float(median[best])
    if sigma > FLAT_RATIO * diagonal(some):
        return None
    near = some[away[:, best] <= TABLE_SIGMAS * sigma]
    middle = near.mean(axis=0)
    normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
    offset = float(middle @ normal)
    sigma = MAD_TO_SIGMA * float(np.median(np.abs(near @ normal - offset)))
    return normal, offset, sigma


def _read_mask(path: Path, shape: tuple[int, ...]) -> Bool[np.ndarray, "rows columns"]:
    """Where a mask is over 0; its size is held against the scan's before it is unpacked."""
    if not path.is_file():
        raise InputError(f"{path}: there is no such mask; the data set is incomplete")
    try:
        with Image.open(path) as image:
            size = (image.height, image.width)
            if size == tuple(shape):
                mask = np.asarray(image)
    except PARSER_ERRORS as e:
        raise InputError(f"{path}: the mask cannot be read ({in_words(e)})") from e
    if size != tuple(shape):
        raise InputError(
            f"{path}: the mask has {size[1]} × {size[0]} pixels, its scan {shape[1]} × {shape[0]}; "
            "they do not belong together"
        )
    return np.asarray(mask > 0 if mask.ndim == 2 else (mask > 0).any(axis=2))
