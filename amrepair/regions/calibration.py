"""Calibration: what a scanner and a printer leave on sound parts, learned once and kept by name.

It stands in for what a scan has to tell of itself: how far window means wander, by their width and
by how densely they were seen, and how the peaks over the tolerance fall off.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from amrepair.arrays import Values
from amrepair.errors import InputError
from gcode.whole import write_bytes

CALIBRATION_VERSION = 3


@dataclass(frozen=True, slots=True)
class Tail:
    """How the standardised exceedances of sound places fall off.

    Attributes
    ----------
    start, scale
        Beyond `start` peaks are exponential with mean `scale`; 0: as normal noise.
    peaks
        How many such peaks a scan has.
    told_by
        How many peaks told the scale: the fewer, the less sure it is.
    longest
        They fall to 1/e over so many standard errors at most, however few told the scale.
    """

    start: float
    scale: float
    peaks: float
    told_by: float
    longest: float = np.inf

    def log_expected(self, z: Values) -> Values:
        """(s,) logarithm of how many peaks of sound places a scan has beyond each value.

        An exponential whose mean is itself told by `told_by` peaks predicts a Lomax tail.
        """
        beyond = np.maximum(z - self.start, 0.0)
        falls = np.maximum(
            self.told_by * np.log1p(beyond / (self.told_by * self.scale)), beyond / self.longest
        )
        return np.asarray(np.log(self.peaks) - falls)

    def exceeded_by(self, expected: float) -> float:
        """Beyond which value a scan has so many peaks of sound places."""
        ratio = max(self.peaks / expected, 1.0)
        told = self.told_by * self.scale * (ratio ** (1.0 / self.told_by) - 1.0)
        return self.start + min(told, self.longest * float(np.log(ratio)))


TailTold = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Calibration:
    """Errors of sound parts.

    Attributes
    ----------
    name, scans
        What it is kept by, and how many scans of sound parts it was learned from.
    width_mm
        (k,) widths of the windows that it knows.
    wander_mm
        (k, c) standard deviation of window means, by width and by how well they were seen, the
        best first.
    tails
        Of three cells together, then of window medians by width: for side 0, missing, and 1,
        excess, start, scale, peaks a window and peaks in all. In wide windows errors that lie far
        off at one place fall out.
    """

    name: str
    scans: int
    width_mm: tuple[float, ...] = ()
    wander_mm: tuple[tuple[float, ...], ...] = ()
    tails: tuple[tuple[TailTold, TailTold], ...] = ()

    def wander(self, width_mm: float, classes: int) -> Values:
        """(c,) standard deviation of means of windows so wide, by class; 0 where none is known."""
        if not self.width_mm:
            return np.zeros(classes)
        known = np.array(self.wander_mm[self._nearest(width_mm)])
        return np.asarray(known[np.minimum(np.arange(classes), len(known) - 1)])

    def tail(self, width_mm: float | None, side: int, windows: int) -> Tail:
        """How the peaks of so many windows fall off; without a width, of three cells together."""
        if not self.tails:
            return Tail(0.0, 0.0, 0.0, 0.0)
        row = 0 if width_mm is None else 1 + self._nearest(width_mm)
        start, scale, rate, told_by = self.tails[row][side]
        return Tail(start, scale, rate * windows, told_by)

    def _nearest(self, width_mm: float) -> int:
        """The width that is known and most alike."""
        return int(np.argmin(np.abs(np.log(np.array(self.width_mm) / width_mm))))

    def told(self) -> str:
        """Whose errors they are, in a sentence."""
        if self.name == BED_BESIDE:
            return (
                f"Judged by what this scan shows of {BED_BESIDE}: its errors are not normal noise."
            )
        scans = f"{self.scans} sound scan{'' if self.scans == 1 else 's'}"
        return f"Judged by what {scans} left ('{self.name}')."

    def save(self, folder: Path) -> Path:
        """Write it into the user's folder; the whole file or nothing.

        Raises
        ------
        InputError
            If it cannot be written.
        """
        path = file_of(self.name, folder)
        try:
            said = {"version": CALIBRATION_VERSION, **asdict(self)}
            write_bytes(path, (json.dumps(said, indent=1) + "\n").encode())
        except OSError as e:
            raise InputError(f"{path}: the calibration cannot be written ({e.strerror})") from e
        return path

    @classmethod
    def load(cls, name: str, folder: Path) -> Calibration:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            If there is none of that name, or it is damaged.
        """
        path = file_of(name, folder)
        if not path.is_file():
            there = sorted(p.stem for p in folder.glob("*.json"))
            known = f"there are {', '.join(there)}" if there else "there is none yet"
            raise InputError(
                f"no calibration is named '{name}' in {folder}; {known}: make it with 'amrepair "
                f"calibrate --sound SCAN --template FILE --name {name}'"
            )
        try:
            said: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            if said.pop("version") != CALIBRATION_VERSION:
                raise InputError(
                    f"{path}: the calibration is of another version than {CALIBRATION_VERSION}; "
                    "make it again with 'amrepair calibrate'"
                )
            return cls(**{key: as_tuples(value) for key, value in said.items()})
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as e:
            raise InputError(f"{path}: the calibration cannot be read ({e}); make it again") from e


def of_touches(sigma_mm: float, process_sigma_mm: float) -> Calibration:
    """The errors of scans by touches: all that is said of one touch errs as that touch does.

    Parameters
    ----------
    sigma_mm
        Standard deviation of one touch.
    process_sigma_mm
        By how much sound parts depart as a whole, which the test takes out of the wander.
    """
    wander_mm = float(np.hypot(sigma_mm, process_sigma_mm))
    return Calibration("repeated touches", 1, (1.0,), ((wander_mm,),))


# What an own calibration of a scan by the bed in it is called.
BED_BESIDE = "the bed beside the part"
# Independent normal errors and nothing else: what the simulated scanner leaves by default.
NORMAL_NOISE = Calibration("normal noise", 0)


def file_of(name: str, folder: Path) -> Path:
    """The file that a calibration is kept in.

    Raises
    ------
    InputError
        If the name is no plain file name.
    """
    if not name or Path(name).name != name or name.startswith("."):
        raise InputError(f"a calibration's name is a plain word, not '{name}'")
    return folder / f"{name}.json"


def users_folder() -> Path:
    """Where calibrations are kept."""
    return Path.home() / ".config" / "amrepair" / "calibrations"


def as_tuples(value: Any) -> Any:
    """What JSON keeps as lists, as it was."""
    return tuple(as_tuples(item) for item in value) if isinstance(value, list) else value
