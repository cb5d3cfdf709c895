"""Reader of the Anomaly-ShapeNet layout (v2).

    dataset/{pcd,new_pcd,16384}/<class>/{train,test,GT}/…   clouds and truth
    dataset/obj/<class>/…                                   the normal shapes as meshes

`ashtray0_template0`, `ashtray0_positive3` (normal), `ashtray0_bulge0`. Truth is separated by
commas in `pcd`, by spaces in `16384`. Its rows may be in another order than the cloud's, and five
files of helmet1 have another count: each point takes the label of the nearest row. Where the
coordinates agree (to 6 decimals, 7 for vase) that is the point's own row.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Points
from amrepair.bench.samples import (
    GOOD,
    BenchClass,
    Sample,
    SampleCloud,
    class_folders,
    defect_word,
    read_points,
    read_truth,
    without_labels,
)
from amrepair.errors import InputError
from amrepair.frames import diagonal

_log = logging.getLogger(__name__)

CLOUD_FOLDERS = ("pcd", "new_pcd", "16384")
SHAPENET_DEFECTS = (
    "bulge",
    "concavity",
    "sink",
    "hole",
    "broken",
    "break",
    "bending",
    "bend",
    "crack",
)
SAMPLE_SUFFIXES = frozenset({".pcd", ".ply", ".xyz"})
SHAPENET_TRUTH_FOLDERS = ("GT", "gt")
# Wrong counts leave a few points without a row of their own; farther than this part of the
# shape's diagonal for half the points, the truth is another shape's.
MAX_GAP_RATIO = 0.02


def find_classes(root: Path) -> tuple[BenchClass, ...]:
    """Classes of the variant that `root` names, else of the first of pcd, new_pcd, 16384."""
    for base in (root, root / "dataset"):
        for folder in (base, *(base / variant for variant in CLOUD_FOLDERS)):
            if folder.is_dir() and class_folders(folder):
                meshes = folder.parent / "obj"
                return tuple(_read_class(one, meshes) for one in class_folders(folder))
    return ()


def _read_class(folder: Path, meshes: Path) -> BenchClass:
    truth = next(
        (folder / name for name in SHAPENET_TRUTH_FOLDERS if (folder / name).is_dir()), None
    )
    samples = [
        _sample(folder.name, path, truth or folder / SHAPENET_TRUTH_FOLDERS[0])
        for path in _clouds(folder / "test")
        if "template" not in path.stem.removeprefix(folder.name)
    ]
    train = tuple(_clouds(folder / "train"))
    return BenchClass(
        folder.name, train, _mesh_of(meshes, folder.name), tuple(samples), read_points
    )


def _clouds(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in SAMPLE_SUFFIXES)


def _mesh_of(meshes: Path, class_name: str) -> Path | None:
    """The normal shape: a mesh of the class's training folder, or one that is named normal."""
    folder = meshes / class_name
    if not folder.is_dir():
        return None
    found = sorted(folder.rglob("*.obj"))
    normal = [
        path
        for path in found
        if "template" in path.name or "train" in path.relative_to(folder).parts
    ] or [path for path in found if path.stem == class_name]
    return normal[0] if normal else None


def _sample(class_name: str, path: Path, truth: Path) -> Sample:
    word = path.stem.removeprefix(class_name)  # a class may be called positive_stop or holder
    normal = "positive" in word
    return Sample(
        class_name=class_name,
        name=path.stem,
        kind=GOOD if normal else defect_word(word, SHAPENET_DEFECTS),
        cloud_path=path,
        truth_path=None if normal else _truth_path(truth, class_name, path.stem),
        read=load,
    )


def _truth_path(truth: Path, class_name: str, stem: str) -> Path:
    """`<stem>.txt`; `desk_bulge0.txt` belongs to `desk0_bulge0`."""
    exact = truth / f"{stem}.txt"
    bare = class_name.rstrip("0123456789")
    loose = truth / f"{bare}{stem.removeprefix(class_name)}.txt"
    return loose if loose.is_file() and not exact.is_file() else exact


def load(sample: Sample) -> SampleCloud:
    """Geometry from the cloud, labels from the truth by coordinates."""
    points = read_points(sample.cloud_path)
    if sample.truth_path is None:
        return without_labels(points)
    rows, labels = read_truth(sample.truth_path)
    decimals = 7 if "vase" in sample.name else 6
    return SampleCloud(points, match_labels(points, rows, labels, decimals, sample.truth_path))


def match_labels(
    points: Points,
    rows: Float[np.ndarray, "m 3"],
    labels: Int[np.ndarray, " m"],
    decimals: int,
    path: Path,
) -> Numbers:
    """(n,) labels of the nearest truth rows.

    Raises
    ------
    InputError
        If half the points are far from every row: the truth is another shape's.
    """
    gap, nearest = cKDTree(rows).query(points)
    across = diagonal(points)
    typical = float(np.median(gap))
    if typical > MAX_GAP_RATIO * across:
        raise InputError(
            f"{path}: the truth belongs to another cloud: half the points are {typical:.3g} or "
            f"more from any of its {len(rows)} rows (limit {MAX_GAP_RATIO:.0%} of the shape, "
            f"{MAX_GAP_RATIO * across:.3g})"
        )
    strangers = int((gap > 2 * 10.0**-decimals).sum())
    if strangers or len(rows) != len(points):
        _log.info(
            "%s: %d rows for %d points, %d points took the nearest row's label",
            path, len(rows), len(points), strangers,
        )  # fmt: skip
    return labels[nearest]
