"""What a data set is to the benchmark: classes, training clouds, test samples with point labels.

It holds what the readers of the layouts share (`shapenet`, `real3d`, `adam3d`, `folder`); `dataset`
picks the reader. Files keep their own units, and nothing is normalised.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Numbers, Points
from amrepair.errors import InputError
from amrepair.scans import read_scan

GOOD = "good"  # the kind of a normal sample
UNLABELLED = -1  # the label of a point of which nobody has said whether it is anomalous


class Format(StrEnum):
    """The layouts that amrepair brings, by their names on the command line."""

    SHAPENET = "anomaly-shapenet"
    REAL3D = "real3d-ad"
    ADAM3D = "3d-adam"
    FOLDER = "folder"


@dataclass(frozen=True, slots=True)
class SampleCloud:
    """A test cloud with its truth.

    Attributes
    ----------
    points
        (n, 3), the file's unit and frame.
    labels
        (n,) 0 normal, 1 anomalous; `UNLABELLED` where the data set does not say.
    """

    points: Points
    labels: Numbers

    def __post_init__(self) -> None:
        if len(self.points) != len(self.labels):
            raise InputError(
                f"there are {len(self.labels)} labels for {len(self.points)} points; "
                "the truth file belongs to another cloud"
            )


@dataclass(frozen=True, slots=True)
class Sample:
    """A test sample; its files are read only when asked.

    Attributes
    ----------
    name
        File name without ending, unique in its class.
    kind
        `good` or the defect's word.
    cloud_path, truth_path
        Geometry; labels (None where there are none).
    read
        Makes the cloud of a sample: a function of the layout's reader, so that samples can be sent
        to other processes.
    """

    class_name: str
    name: str
    kind: str
    cloud_path: Path
    truth_path: Path | None
    read: Callable[[Sample], SampleCloud]

    @property
    def anomalous(self) -> bool:
        """Whether the sample as a whole has a defect."""
        return self.kind != GOOD

    def load(self) -> SampleCloud:
        """Points and labels.

        Raises
        ------
        InputError
            If a file is missing, damaged, or truth and cloud do not belong together.
        """
        return self.read(self)


def read_points(path: Path) -> Points:
    """(n, 3) points of a cloud in any format that `scans` reads."""
    return np.asarray(read_scan(path, frame="scanner").points_mm)


def without_labels(points: Points, label: int = 0) -> SampleCloud:
    """A cloud all of whose points have one label; 0 is normal."""
    return SampleCloud(points, np.full(len(points), label, np.int64))


@dataclass(frozen=True, slots=True)
class BenchClass:
    """One class: what is normal, and what is to be judged.

    Attributes
    ----------
    train
        Normal clouds.
    mesh
        The normal shape as a mesh, where the data set has one.
    read_train
        Reads one of `train`.
    """

    name: str
    train: tuple[Path, ...]
    mesh: Path | None
    test: tuple[Sample, ...]
    read_train: Callable[[Path], Points]


@dataclass(frozen=True, slots=True)
class BenchData:
    """A data set as found on disk, classes sorted by name."""

    format: str
    root: Path
    classes: tuple[BenchClass, ...]


def read_truth(path: Path) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Rows of `x y z label`, separated by commas or white space: whichever the file uses.

    Returns
    -------
    (m, 3) points and (m,) labels, 0 or 1.

    Raises
    ------
    InputError
        If the file is missing, or rows are not four finite numbers.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: there is no such truth file; the data set is incomplete, or its "
            "layout is the other one (--format)"
        )
    try:
        with path.open(encoding="ascii", errors="replace") as stream:
            first = next((line for line in stream if line.strip()), "")
        delimiter = "," if "," in first else None
        table = np.loadtxt(path, delimiter=delimiter, ndmin=2) if first else np.zeros((0, 0))
    except ValueError as e:
        raise InputError(f"{path}: the truth cannot be read ({e})") from e
    except OSError as e:
        raise InputError(f"{path}: the truth cannot be read ({e.strerror})") from e
    if table.size == 0 or table.shape[1] != 4:
        columns = table.shape[1] if table.size else 0
        raise InputError(f"{path}: rows of truth are x y z label, these have {columns} values")
    if not np.isfinite(table).all():
        raise InputError(f"{path}: the truth holds values that are not finite numbers")
    return np.ascontiguousarray(table[:, :3]), (table[:, 3] > 0).astype(np.int64)


def class_folders(root: Path) -> tuple[Path, ...]:
    """Folders with `train` and `test` in them: the classes of a layout."""
    return tuple(
        sorted(
            child
            for child in root.iterdir()
            if (child / "train").is_dir() and (child / "test").is_dir()
        )
    )


def defect_word(stem: str, known: Sequence[str]) -> str:
    """The defect's word in a file name; the first of `known` that occurs, else the last word."""
    for word in known:
        if word in stem.lower():
            return word
    words = re.findall(r"[a-z]+", stem.lower())
    return words[-1] if words else "unknown"
