"""What a batch does to each scan, and what passes between its supervisor and its workers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amrepair.regions.error_calibration import Calibration
    from gcode.profiles import PrintSetup

# Raised when results of the same name would come out differently: old ones are then not taken.
BATCH_LAYOUT_VERSION = 1


class BatchKind(StrEnum):
    """What is done to each scan, in the words of the command line."""

    ALIGN = "align"
    DETECT = "detect"
    REPAIR = "repair"


# A task that took so many workers with it is given up: it, and not they, is what is wrong.
MOST_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """What is done to each scan; part of every result's name.

    Attributes
    ----------
    seed
        Of everything that is drawn, the same for each scan.
    part_is_known
        As of `align`: less of a scan has to fit.
    sensors_mm
        Places of the sensors in the scans' frames, mm; none where the files tell.
    scan_unit
        Of the scans' lengths, where the files do not say it; None is mm.
    part_pose
        X, Y, Z in mm and the turn about Z in degrees at which each part stands on the bed; None
        where the scans are in the build frame. Only `repair` asks.
    on_fixture
        Finished parts stand on a fixture, not with their foot on the bed.
    printer, material, process
        Profiles; only `repair` asks.
    """

    kind: BatchKind
    seed: int = 0
    part_is_known: bool = False
    sensors_mm: tuple[tuple[float, float, float], ...] = ()
    scan_unit: str | None = None
    part_pose: tuple[float, float, float, float] | None = None
    on_fixture: bool = False
    printer: str = "prusa_mk3s"
    material: str = "pla"
    process: str = "repair_0.20"


@dataclass(frozen=True, slots=True)
class TemplateFile:
    """A template as workers load it.

    Attributes
    ----------
    sha256
        Of the file that the user named.
    path
        A fitted template that this machine can read.
    """

    name: str
    sha256: str
    path: Path


@dataclass(frozen=True, slots=True)
class Work:
    """All that a worker needs besides scans."""

    options: BatchOptions
    templates: tuple[TemplateFile, ...]
    setup: PrintSetup | None = None
    calibration: Calibration | None = None

    def fingerprint(self) -> str:
        """What results follow from besides the scan's own bytes."""
        from amrepair import __version__

        said = {
            "layout": BATCH_LAYOUT_VERSION,
            "version": __version__,
            "options": asdict(self.options),
            "templates": {one.name: one.sha256 for one in self.templates},
            "profiles": None if self.setup is None else dict(self.setup.hashes),
            "calibration": None if self.calibration is None else asdict(self.calibration),
        }
        text = json.dumps(said, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Task:
    """One scan to be judged.

    Attributes
    ----------
    scan_id
        Name of its result.
    uri
        A path, or an address of an object store.
    sha256
        Of the scan's bytes: what is judged is what was named.
    """

    scan_id: str
    uri: str
    sha256: str


@dataclass(frozen=True, slots=True)
class TaskOutcome:
    """What became of a task.

    Attributes
    ----------
    figures
        What is known of the scan; JSON. Empty where it has a sentence.
    sentence
        Why there are no figures, with `{scan}` for the scan's name; empty where there are.
    lasting
        Whether the same scan would come to the same: not so where a worker died or a file could
        not be reached.
    files
        Bytes to be kept beside the result, by name.
    cost
        `cpu_s`, `wall_s`, `read_bytes`; `peak_mb` of the worker so far, if the system tells.
    """

    scan_id: str
    figures: Mapping[str, Any] = field(default_factory=dict)
    sentence: str = ""
    lasting: bool = True
    files: Mapping[str, bytes] = field(default_factory=dict)
    cost: Mapping[str, float] = field(default_factory=dict)


def scan_id(fingerprint: str, sha256: str, suffix: str) -> str:
    """Name of a result: the scan's bytes, how they are read, and what is done to them."""
    return hashlib.sha256(f"{fingerprint}\n{sha256}\n{suffix}".encode()).hexdigest()[:32]


def given_up(task: Task, attempts: int) -> TaskOutcome:
    """Of a task that its workers do not survive."""
    return TaskOutcome(
        task.scan_id,
        sentence=f"{{scan}} ended its worker {attempts} times (out of memory?); try it alone, or "
        "with fewer --workers",
        lasting=False,
    )
