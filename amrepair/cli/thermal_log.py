"""How warm nozzle and bed were over a run, for its report."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from amrepair.report import TemperatureSeries
from gcode.errors import GcodeError
from gcode.hosts.port import Temperatures


class ThermalLog:
    """Asks a printer now and then, and takes what its journal noted in between.

    Parameters
    ----------
    ask
        Such as `Printer.temperatures`.
    clock
        s since 1970, as the journal's.
    """

    def __init__(
        self, ask: Callable[[], Temperatures], clock: Callable[[], float] = time.time
    ) -> None:
        self._ask, self._clock, self._start_s = ask, clock, clock()
        # time, then measured and target of the hotend and of the bed
        self._rows: list[tuple[float, float, float, float, float]] = []

    def note(self) -> None:
        """Ask, and keep the answer; where there is none, a run goes on without."""
        try:
            now = self._ask()
        except GcodeError:  # a file has no temperature
            return
        bed = [np.nan if value is None else value for value in (now.bed_c, now.bed_target_c)]
        when_s = self._clock() - self._start_s
        self._rows.append((when_s, now.hotend_c, now.hotend_target_c, bed[0], bed[1]))

    def series(
        self, noted: Sequence[tuple[float, float, float | None]] = ()
    ) -> tuple[TemperatureSeries, ...]:
        """What the report draws; nothing where nothing was measured.

        Parameters
        ----------
        noted
            Of `Journal.temperatures`: it knows no targets, which are drawn where they were asked.
        """
        nan = float("nan")
        rows = [
            (when_s - self._start_s, hotend_c, nan, nan if bed_c is None else bed_c, nan)
            for when_s, hotend_c, bed_c in noted
            if when_s >= self._start_s  # a journal keeps earlier runs
        ]
        rows = sorted([*rows, *self._rows])
        if not rows:
            return ()
        time_s, *warm = np.array(rows, dtype=np.float64).T
        found = []
        for name, measured_c, target_c in (("hotend", *warm[:2]), ("bed", *warm[2:])):
            known = np.isfinite(measured_c)
            if known.any():
                told = target_c[known] if np.isfinite(target_c).any() else None
                found.append(TemperatureSeries(name, time_s[known], measured_c[known], told))
        return tuple(found)
