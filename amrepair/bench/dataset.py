"""What a data set is to the benchmark: classes, training clouds, test samples with point labels.

Readers of the two published layouts live in `real3d` and `shapenet`; this module holds what they
share and picks the reader. It keeps the files' own units and does not normalise.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from amrepair.errors import InputError
from amrepair.scans import read_scan


class Format(StrEnum):
    """Layouts, by their names on the command line."""

    SHAPENET = "anomaly-shapenet"
    REAL3D = "real3d-ad"


@dataclass(frozen=True, slots=True)
class Cloud:
    """A test cloud with its truth.

    Attributes
    ----------
    points
        (n, 3), the file's unit and frame.
    labels
        (n,) 0 normal, 1 anomalous.
    """

    points: Float[np.ndarray, "n 3"]
    labels: Int[np.ndarray, " n"]

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
        `good` or the defect's word in the file name.
    cloud_path, truth_path
        Geometry; labels (None for normal samples).
    format
        Which reader loads it.
    """

    class_name: str
    name: str
    kind: str
    cloud_path: Path
    truth_path: Path | None
    format: Format

    @property
    def anomalous(self) -> bool:
        """Whether the sample as a whole has a defect."""
        return self.truth_path is not None

    def load(self) -> Cloud:
        """Points and labels.

        Raises
        ------
        InputError
            If a file is missing, damaged, or truth and cloud do not belong together.
        """
        if self.truth_path is None:
            points = read_points(self.cloud_path)
            return Cloud(points, np.zeros(len(points), np.int64))
        from amrepair.bench import real3d, shapenet

        if self.format is Format.SHAPENET:
            return shapenet.load_anomalous(self, self.truth_path)
        return real3d.load_anomalous(self, self.truth_path)


@dataclass(frozen=True, slots=True)
class BenchClass:
    """One class: what is normal, and what is to be judged.

    Attributes
    ----------
    train
        Normal clouds.
    mesh
        The normal shape as a mesh, where the data set has one.
    """

    name: str
    train: tuple[Path, ...]
    mesh: Path | None
    test: tuple[Sample, ...]


@dataclass(frozen=True, slots=True)
class BenchData:
    """A data set as found on disk, classes sorted by name."""

    format: Format
    root: Path
    classes: tuple[BenchClass, ...]


def open_dataset(root: Path, format: str) -> BenchData:
    """Find the classes of a data set.

    Parameters
    ----------
    root
        Its folder (or a folder or two above the classes).
    format
        `anomaly-shapenet` or `real3d-ad`.

    Raises
    ------
    InputError
        If the format is unknown, or the folder holds nothing of that layout.
    """
    from amrepair.bench import real3d, shapenet

    try:
        layout = Format(format)
    except ValueError as e:
        raise InputError(
            f"the format '{format}' is unknown; choose one of {', '.join(Format)}"
        ) from e
    if not Path(root).is_dir():
        raise InputError(f"{root}: there is no such folder; give the data set's root")
    finder = shapenet.find_classes if layout is Format.SHAPENET else real3d.find_classes
    classes = finder(Path(root))
    if not classes:
        raise InputError(
            f"{root}: no class of the {layout} layout is here (a folder with train/ and test/); "
            "give the data set's root, or another --format"
        )
    for one in classes:
        if not one.train:
            raise InputError(f"{root}: the class {one.name} has no training cloud in train/")
        if not one.test:
            raise InputError(f"{root}: the class {one.name} has no test cloud in test/")
    return BenchData(layout, Path(root), tuple(sorted(classes, key=lambda c: c.name)))


def read_points(path: Path) -> Float[np.ndarray, "n 3"]:
    """(n, 3) points of a cloud in any format that `scans` reads."""
    return np.asarray(read_scan(path, frame="scanner").points_mm)


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
