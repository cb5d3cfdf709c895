"""How warm nozzle and bed were at a run's looks, for its report."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from amrepair.report import TemperatureSeries
from gcode.errors import GcodeError
from gcode.hosts.port import Temperatures


class ThermalLog:
    """Asks a printer now and then.

    Parameters
    ----------
    ask
        Such as `Printer.temperatures`.
    clock
        s; only differences count.
    """

    def __init__(
        self, ask: Callable[[], Temperatures], clock: Callable[[], float] = time.monotonic
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

    def series(self) -> tuple[TemperatureSeries, ...]:
        """What the report draws; nothing where nothing was measured."""
        if not self._rows:
            return ()
        time_s, *warm = np.array(self._rows, dtype=np.float64).T
        found = (
            TemperatureSeries("hotend", time_s, warm[0], warm[1]),
            TemperatureSeries("bed", time_s, warm[2], warm[3]),
        )
        return tuple(series for series in found if np.isfinite(series.measured_c).all())
