"""Calibration of errors: a noise model of a scanner and a printer, learned once from sound parts.

A calibration replaces what a scan can tell of its own errors: how far window means wander, for each
width and for how well windows were seen, and how far off sound places may seem to lie. It is kept
as a file by name. (Where a scanner hangs over the bed is another thing: `amrepair.loop.calibrate`.)
"""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtr, stdtrit

from amrepair.arrays import Values
from amrepair.errors import InputError
from gcode.surfaces.sizes import in_words
from gcode.whole import write_bytes

CALIBRATION_VERSION = 4


FarOffTold = tuple[float, float, float]
# From scale to scale windows double in width; widths within half of that step count as the same.
HALF_OCTAVE = 0.5


@dataclass(frozen=True, slots=True)
class FarOff:
    """Outliers: how far beyond the tolerance sound places seem to lie where a scanner errs most.

    Outliers are as deep at places that were seen well as at others. Their depth is therefore told
    in millimetres and not in standard errors; it is half-normally distributed.

    Attributes
    ----------
    spread_mm
        Root mean square of their depths; 0 where there are none.
    places
        How many outliers a scan has.
    told_by
        How many outliers the spread was estimated from.
    """

    spread_mm: float
    places: float
    told_by: float

    def log_expected(self, beyond_mm: Values) -> Values:
        """(s,) logarithm of how many outliers of a scan are expected beyond each depth.

        Student's t, since the spread of the normal distribution is itself an estimate.
        """
        if not self.spread_mm:
            return np.full(len(beyond_mm), -np.inf)
        ratio = np.maximum(beyond_mm, 0.0) / self.spread_mm
        with np.errstate(divide="ignore"):
            return np.asarray(np.log(2.0 * self.places * stdtr(self.told_by, -ratio)))

    def exceeded_by(self, expected: float) -> float:
        """The depth, mm, beyond which so many outliers are expected; 0 if there are fewer."""
        share = 0.5 * min(expected / self.places, 1.0) if self.spread_mm else 0.5
        return -self.spread_mm * float(stdtrit(self.told_by, share)) if share < 0.5 else 0.0


@dataclass(frozen=True, slots=True)
class Calibration:
    """The errors that a scanner and a printer leave on sound parts.

    Attributes
    ----------
    name, scans
        The name that it is kept by, and how many scans of sound parts it was learned from.
    width_mm
        (k,) widths of the windows for which errors are known.
    wander_mm, freedom
        (k, c) standard deviation of window means and the degrees of freedom of that estimate, for
        each width and each class of how well windows were seen, the best first.
    far_off
        Outliers of three cells together, and then of window medians for each width. Each has a
        pair, for missing and for excess, of: spread in mm, outliers a window, and how many the
        spread was estimated from. In wide windows an outlier at one place drops out of the median.
    facing
        The smallest cosine of incidence that it was learned from. Surface seen more aslant is taken
        to err more.
    """

    name: str
    scans: int
    width_mm: tuple[float, ...] = ()
    wander_mm: tuple[tuple[float, ...], ...] = ()
    freedom: tuple[tuple[float, ...], ...] = ()
    far_off: tuple[tuple[FarOffTold, FarOffTold], ...] = ()
    facing: float = 0.0

    @property
    def is_normal(self) -> bool:
        """Whether it tells of independent normal errors and of nothing else."""
        return not self.width_mm and not self.far_off

    def wander(self, width_mm: float, classes: int) -> tuple[Values, Values]:
        """(c,) standard deviation of the means of windows of a width, for each class.

        And (c,) its degrees of freedom. 0 where the calibration knows of no wander.
        """
        if not self.width_mm:
            return np.zeros(classes), np.full(classes, np.inf)
        row = self._row(width_mm)
        known = np.minimum(np.arange(classes), len(self.wander_mm[row]) - 1)
        return np.array(self.wander_mm[row])[known], np.array(self.freedom[row])[known]

    def far_off_in(self, width_mm: float | None, side: int, windows: int) -> FarOff:
        """The outliers of so many windows of a width; without a width, of three cells together."""
        if not self.far_off:
            return FarOff(0.0, 0.0, 0.0)
        row = 0 if width_mm is None else 1 + self._row(width_mm)
        spread_mm, rate, told_by = self.far_off[row][side]
        return FarOff(spread_mm, rate * windows, told_by)

    def _row(self, width_mm: float) -> int:
        """The row of the widest known width that is no wider than this one (to a quarter octave).

        Never a wider one: narrower windows err more, so that way an error is never underestimated.
        """
        as_wide = np.array(self.width_mm) <= width_mm * 2.0 ** (0.5 * HALF_OCTAVE)
        return max(int(as_wide.sum()) - 1, 0)

    def told(self) -> str:
        """Says by whose errors the scan was judged, in a sentence."""
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
                f"calibrate --sound SCAN --template FILE --name {shlex.quote(name)}'"
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
            raise InputError(
                f"{path}: the calibration cannot be read ({in_words(e)}); make it again"
            ) from e


def of_touches(sigma_mm: float, process_sigma_mm: float) -> Calibration:
    """The errors of a scan made of touches: all points that stem from one touch err together.

    Parameters
    ----------
    sigma_mm
        Standard deviation of one touch.
    process_sigma_mm
        By how much the surface of sound parts wanders, which the test subtracts again.
    """
    wander_mm = float(np.hypot(sigma_mm, process_sigma_mm))
    return Calibration("repeated touches", 1, (1.0,), ((wander_mm,),), ((np.inf,),))


# The name of the calibration that a scan gets from the bed seen in it.
BED_BESIDE = "the bed beside the part"
# Independent normal errors and nothing else, as the simulated scanner has them by default.
NORMAL_NOISE = Calibration("normal noise", 0)
# The same, but seen, and not taken for granted.
NORMAL_BY_BED = Calibration(f"normal noise, as {BED_BESIDE} shows", 0)


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
    """Turn the lists of a JSON file back into tuples."""
    return tuple(as_tuples(item) for item in value) if isinstance(value, list) else value
