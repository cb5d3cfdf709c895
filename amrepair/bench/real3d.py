"""Reader of the Real3D-AD layout.

    <class>/train/*template*.pcd   four full scans (the README says prototype)
    <class>/test/*.pcd             mostly single views; `good` anywhere in the name is normal
    <class>/gt/<stem>.txt          rows `x y z label`, white space

Of anomalous samples the txt is the geometry too: five published pcd/txt pairs differ in count.
Names with `temp` in `test/` are stray templates and are skipped; `cut` and `copy` are ordinary.
"""

from __future__ import annotations

from pathlib import Path

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
from amrepair.errors import InputError, refused_as_ours
from gcode.clouds.pcd import count_of_pcd

REAL3D_DEFECTS = ("bulge", "sink", "concavity", "hole", "break", "bend", "crack")
REAL3D_TRUTH_FOLDERS = ("gt", "GT")
LEAST_OF_CLOUD = 0.5  # of the published pairs none differs by so much


def find_classes(root: Path) -> tuple[BenchClass, ...]:
    """Classes in `root`, else in its only data folder (`Real3D-AD-PCD/…`)."""
    folders = class_folders(root)
    if not folders:
        for child in sorted(path for path in root.iterdir() if path.is_dir()):
            folders = class_folders(child)
            if folders:
                break
    return tuple(_read_class(folder) for folder in folders)


def _read_class(folder: Path) -> BenchClass:
    clouds = sorted((folder / "train").glob("*.pcd"))
    named = [path for path in clouds if "template" in path.name or "prototype" in path.name]
    truth = next((folder / name for name in REAL3D_TRUTH_FOLDERS if (folder / name).is_dir()), None)
    samples = [
        _sample(folder.name, path, truth or folder / REAL3D_TRUTH_FOLDERS[0])
        for path in sorted((folder / "test").glob("*.pcd"))
        if "temp" not in path.name
    ]
    return BenchClass(folder.name, tuple(named or clouds), None, tuple(samples), read_points)


def _sample(class_name: str, path: Path, truth: Path) -> Sample:
    normal = "good" in path.stem
    return Sample(
        class_name=class_name,
        name=path.stem,
        kind=GOOD if normal else defect_word(path.stem, REAL3D_DEFECTS),
        cloud_path=path,
        truth_path=None if normal else truth / f"{path.stem}.txt",
        read=load,
    )


def load(sample: Sample) -> SampleCloud:
    """Of anomalous samples geometry and labels from the txt alone, unless that is only a piece.

    Raises
    ------
    InputError
        If the txt has less than half of the cloud's points, or more than twice as many.
    """
    truth_path = sample.truth_path
    if truth_path is None:
        return without_labels(read_points(sample.cloud_path))
    points, labels = read_truth(truth_path)
    with refused_as_ours():
        count = count_of_pcd(sample.cloud_path)
    if not LEAST_OF_CLOUD * count <= len(points) <= count / LEAST_OF_CLOUD:
        raise InputError(
            f"{truth_path}: {len(points)} rows of truth for the {count} points of "
            f"{sample.cloud_path.name}; it is cut short or of another cloud: copy it again"
        )
    return SampleCloud(points, labels)
