"""Layouts of data sets by name: who reads them, and where they are to be had.

A new layout is a function that finds classes in a folder, and a row of `LAYOUTS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from amrepair.bench import adam3d, folder, real3d, shapenet
from amrepair.bench.samples import BenchClass, BenchData, Format
from amrepair.errors import InputError


@dataclass(frozen=True, slots=True)
class Layout:
    """A layout of folders.

    Attributes
    ----------
    find_classes
        Classes in a folder; none where it is not of this layout.
    what_it_needs
        What a class is recognised by, in words.
    source
        One line: where the data set is to be had, and under which licence.
    """

    find_classes: Callable[[Path], tuple[BenchClass, ...]]
    what_it_needs: str
    source: str


LAYOUTS: dict[str, Layout] = {
    Format.SHAPENET: Layout(
        shapenet.find_classes,
        "a folder with train/ and test/",
        "Anomaly-ShapeNet v2, 40 classes, CC BY 4.0: the archive that "
        "github.com/Chopper-233/Anomaly-ShapeNet links to",
    ),
    Format.REAL3D: Layout(
        real3d.find_classes,
        "a folder with train/ and test/",
        "Real3D-AD, 12 classes of scanned toys, CC BY 4.0: the archive that "
        "github.com/M-3LAB/Real3D-AD links to (PCD)",
    ),
    Format.ADAM3D: Layout(
        adam3d.find_classes,
        "a folder with train/good/xyz/ and test/",
        "3D-ADAM, scans of printed parts, CC BY-NC-SA 4.0: "
        "huggingface.co/datasets/pmchard/3D-ADAM_anomalib (one camera, folders as published)",
    ),
    Format.FOLDER: Layout(
        folder.find_classes,
        "a folder with sound/ and test/",
        "scans of your own: sound/ (scans, or a mesh), test/good/ and test/DEFECT/ (scans), and "
        "where you have them masks/NAME.txt (a label a point, or x y z label)",
    ),
}


def open_dataset(root: Path, format: str) -> BenchData:
    """Find the classes of a data set.

    Parameters
    ----------
    root
        Its folder (or a folder or two above the classes).
    format
        A name in `LAYOUTS`.

    Raises
    ------
    InputError
        If the format is unknown, or the folder holds nothing of that layout.
    """
    if format not in LAYOUTS:
        raise InputError(f"the format '{format}' is unknown; choose one of {', '.join(LAYOUTS)}")
    about = LAYOUTS[format]
    root = Path(root)
    if not root.is_dir():
        raise InputError(
            f"{root}: there is no such folder; give the data set's root ({about.source})"
        )
    classes = about.find_classes(root)
    if not classes:
        raise InputError(
            f"{root}: no class of the {format} layout is here ({about.what_it_needs}); "
            "give the data set's root, or another --format"
        )
    for one in classes:
        if not one.train:
            raise InputError(f"{root}: the class {one.name} has no training cloud")
        if not one.test:
            raise InputError(f"{root}: the class {one.name} has no test cloud in test/")
    return BenchData(str(format), root, tuple(sorted(classes, key=lambda c: c.name)))
