"""Reader of a user's own folder of scans.

    sound/…                 scans of sound parts, or one mesh of the part
    test/good/…             scans of sound parts to be judged
    test/<defect>/…         scans of parts with that defect
    test/…                  scans of which only the masks say what they are
    masks/<stem>.txt        a label a point (0 or 1), or rows `x y z label`; optional

The folder itself is a class, or each of its folders with `sound` and `test` in it is one. Scans are
of any kind that amrepair reads. Of a defective scan without a mask the object score is judged and
the points' scores are not.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amrepair.arrays import Numbers
from amrepair.bench.samples import (
    GOOD,
    UNLABELLED,
    BenchClass,
    Sample,
    SampleCloud,
    read_points,
    read_truth,
    without_labels,
)
from amrepair.bench.shapenet import match_labels
from amrepair.errors import InputError
from amrepair.scans.files import SCAN_SUFFIXES
from amrepair.scans.readers import MESH_SUFFIXES

MASKS = "masks"
DECIMALS = 6  # that text files of points are commonly written with


def find_classes(root: Path) -> tuple[BenchClass, ...]:
    """The folder as one class, else each of its folders that is one."""
    folders = [root, *sorted(path for path in root.iterdir() if path.is_dir())]
    classes = [path for path in folders if (path / "sound").is_dir() and (path / "test").is_dir()]
    return tuple(_read_class(path) for path in (classes[:1] if classes[:1] == [root] else classes))


def _read_class(folder: Path) -> BenchClass:
    sound = _files(folder / "sound")
    meshes = [path for path in sound if path.suffix.lower() in MESH_SUFFIXES]
    if len(meshes) > 1:
        raise InputError(
            f"{folder}/sound: {len(meshes)} meshes ({meshes[0].name}, {meshes[1].name}, …); one "
            "mesh says what is sound: leave one, or give scans"
        )
    samples = [_sample(folder, path) for path in _files(folder / "test")]
    names = [sample.name for sample in samples]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{folder}/test: two scans are named {twice}; rename one")
    mesh = meshes[0] if meshes else None
    return BenchClass(folder.name, tuple(sound), mesh, tuple(samples), read_points)


def _files(folder: Path) -> list[Path]:
    """Scans in a folder and below it, by name."""
    return sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and path.suffix.lower() in SCAN_SUFFIXES and not path.name.startswith(".")
    )


def _sample(folder: Path, path: Path) -> Sample:
    inside = path.relative_to(folder / "test").parts
    mask = folder / MASKS / f"{path.stem}.txt"
    has_mask = mask.is_file()
    if len(inside) > 1:
        kind = inside[0]
    else:
        kind = "defect" if has_mask and _mask_labels(mask).any() else GOOD
    return Sample(
        class_name=folder.name,
        name="_".join((*inside[:-1], path.stem)),
        kind=kind,
        cloud_path=path,
        truth_path=mask if has_mask else None,
        read=load,
    )


def load(sample: Sample) -> SampleCloud:
    """Points and, where there is a mask, their labels.

    Raises
    ------
    InputError
        If a file is damaged, or mask and scan do not belong together.
    """
    points = read_points(sample.cloud_path)
    if sample.truth_path is None:
        return without_labels(points, UNLABELLED if sample.anomalous else 0)
    if _columns(sample.truth_path) == 1:
        labels = _mask_labels(sample.truth_path)
        if len(labels) != len(points):
            raise InputError(
                f"{sample.truth_path}: {len(labels)} labels for the {len(points)} points of "
                f"{sample.cloud_path.name}; a mask has a label a point, or rows of x y z label"
            )
        return SampleCloud(points, labels)
    rows, labels = read_truth(sample.truth_path)
    return SampleCloud(points, match_labels(points, rows, labels, DECIMALS, sample.truth_path))


def _columns(path: Path) -> int:
    """How many values the first row of a text file has."""
    with path.open(encoding="ascii", errors="replace") as stream:
        first = next((line for line in stream if line.strip()), "")
    return len(first.replace(",", " ").split())


def _mask_labels(path: Path) -> Numbers:
    """(n,) labels of a mask's rows, 0 or 1."""
    if _columns(path) != 1:
        return read_truth(path)[1]
    try:
        table = np.loadtxt(path, ndmin=1)
    except ValueError as e:
        raise InputError(f"{path}: the mask cannot be read ({e})") from e
    if not np.isin(table, (0, 1)).all():
        raise InputError(f"{path}: the labels of a mask are 0 or 1, there is {table.max():g}")
    return table.astype(np.int64)
