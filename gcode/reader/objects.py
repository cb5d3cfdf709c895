"""The objects of a job, as slicers mark them so that one may be left out: `Job` by its objects.

Klipper's EXCLUDE_OBJECT_DEFINE, _START and _END; M486 S of Marlin, Prusa's firmware and
RepRapFirmware (S-1: none, A: its name); and the comments of PrusaSlicer and OrcaSlicer.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int

from gcode.reader.job import Job

_KLIPPER_OBJECT = re.compile(r"^\s*EXCLUDE_OBJECT_(START|END)(?:\s+NAME=(\S+))?", re.IGNORECASE)
_DEFINE = re.compile(r"^\s*EXCLUDE_OBJECT_DEFINE\b.*?\bNAME=(\S+)", re.IGNORECASE)
_M486 = re.compile(r"^\s*M486\s+S(-?\d+)", re.IGNORECASE)
_M486_NAME = re.compile(r"^\s*M486\b.*?\bA\"?([^\";]+)", re.IGNORECASE)
_COMMENT = re.compile(r"^; (stop )?printing object (.+?)\s*$")
NONE = -1


@dataclass(frozen=True, slots=True)
class JobObjects:
    """Which object each bead belongs to.

    Attributes
    ----------
    names
        In the order in which they are begun, or defined.
    of_bead
        (n,) index into `names` for the job's beads; -1 for none (skirt, prime tower).
    """

    names: tuple[str, ...]
    of_bead: Int[np.ndarray, " n"]

    def own(self, names: Sequence[str]) -> Bool[np.ndarray, " n"]:
        """(n,) which of the job's beads are of some objects."""
        return np.isin(self.of_bead, [self.names.index(name) for name in names])


def box_of_beads_mm(job: Job, which: Bool[np.ndarray, " n"]) -> tuple[float, float, float, float]:
    """(x_min, y_min, x_max, y_max) of some of a job's beads, build frame."""
    both = np.concatenate([job.beads.start_mm[which, :2], job.beads.end_mm[which, :2]])
    (x0, y0), (x1, y1) = both.min(axis=0).tolist(), both.max(axis=0).tolist()
    return x0, y0, x1, y1


def objects_of(job: Job) -> JobObjects:
    """The objects of a job; where several kinds of marks are in it, those that firmware reads.

    Examples
    --------
    >>> from gcode.reader import objects_of, read_job
    >>> square = "G1 X9 Y0 E1\\nG1 X9 Y9 E1\\n"
    >>> text = f"G28\\nG1 X0 Y0 Z.2\\nM486 S0\\nM486 Alid\\n{square}M486 S-1\\nG1 X5 E2\\n"
    >>> found = objects_of(read_job(text))
    >>> found.names, found.of_bead.tolist()
    (('lid',), [0, 0, -1])
    """
    lines = job.program.text.split("\n")
    for read in (_klipper, _m486, _comments):
        names, changes = read(lines)
        if changes:
            at = np.array([line for line, _ in changes])
            which = np.array([NONE, *(index for _, index in changes)])
            found = which[np.searchsorted(at, job.beads.line, side="right")]
            return JobObjects(tuple(names), found)
    return JobObjects((), np.full(len(job.beads), NONE))


Changes = list[tuple[int, int]]  # line, and the object from there on


def _klipper(lines: list[str]) -> tuple[list[str], Changes]:
    names: list[str] = []
    changes: Changes = []
    for number, line in enumerate(lines):
        if "EXCLUDE_OBJECT" not in line.upper():
            continue
        if (defined := _DEFINE.match(line)) is not None:
            _index(names, defined.group(1))
        elif (match := _KLIPPER_OBJECT.match(line)) is not None:
            begins = match.group(1).upper() == "START" and match.group(2) is not None
            changes.append((number, _index(names, match.group(2)) if begins else NONE))
    return names, changes


def _m486(lines: list[str]) -> tuple[list[str], Changes]:
    numbers: list[str] = []
    names: dict[int, str] = {}
    changes: Changes = []
    now = NONE
    for number, line in enumerate(lines):
        if not line.lstrip().upper().startswith("M486"):
            continue
        if (match := _M486.match(line)) is not None:
            now = _index(numbers, match.group(1)) if int(match.group(1)) >= 0 else NONE
            changes.append((number, now))
        if now != NONE and (named := _M486_NAME.match(line)) is not None:
            names[now] = named.group(1).strip()
    return [names.get(k, number) for k, number in enumerate(numbers)], changes


def _comments(lines: list[str]) -> tuple[list[str], Changes]:
    names: list[str] = []
    changes: Changes = []
    for number, line in enumerate(lines):
        if not line.startswith("; ") or "printing object" not in line:
            continue
        match = _COMMENT.match(line.rstrip("\r"))
        if match is not None:
            index = NONE if match.group(1) else _index(names, match.group(2))
            changes.append((number, index))
    return names, changes


def _index(names: list[str], name: str) -> int:
    """An object's number; a new one where it has none yet."""
    if name not in names:
        names.append(name)
    return names.index(name)
