"""Heaters of the emulated printer: first-order heating and cooling, exact in closed form.

    heating   T(t) = T_full − (T_full − T0)·exp(−t/τ_heat), held once the target is reached
    cooling   T(t) = T_amb  + (T0 − T_amb)·exp(−t/τ_cool), held once a lower target is reached

No control loop is simulated: a real one holds its target to a degree, which nothing here needs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

AMBIENT_C = 22.0
RESIDENCY_S = 10.0
"""TEMP_RESIDENCY_TIME of Marlin: how long M109 and M190 want to see the target."""


@dataclass(frozen=True, slots=True)
class HeaterModel:
    """Steady temperature at full power, and time constants."""

    full_c: float
    heat_tau_s: float
    cool_tau_s: float


HOTEND = HeaterModel(full_c=440.0, heat_tau_s=150.0, cool_tau_s=240.0)
"""A 40 W cartridge in an aluminium block: about 100 s to 215 °C."""
BED_HEATER = HeaterModel(full_c=145.0, heat_tau_s=300.0, cool_tau_s=700.0)
"""A 200 W bed: about two minutes to 60 °C."""


class Heater:
    """One heater with its target, asked for its temperature at any later time."""

    __slots__ = ("_aim_c", "_from_c", "_from_s", "model", "target_c")

    def __init__(self, model: HeaterModel) -> None:
        self.model = model
        self.target_c = self._aim_c = 0.0
        self._from_c = AMBIENT_C
        self._from_s = 0.0

    def set_target(self, target_c: float, now_s: float) -> None:
        """Aim at `target_c` from `now_s` on; 0 is off."""
        self._from_c = self.temperature_c(now_s)
        self._from_s = now_s
        self.target_c = self._aim_c = target_c

    def cut(self, now_s: float) -> None:
        """Heat no more, whatever the target that is told."""
        told_c = self.target_c
        self.set_target(0.0, now_s)
        self.target_c = told_c

    def temperature_c(self, now_s: float) -> float:
        """Temperature at `now_s`."""
        elapsed_s = now_s - self._from_s
        if self._aim_c > self._from_c:
            full_c = max(self.model.full_c, self._aim_c + 20.0)
            heated_c = full_c - (full_c - self._from_c) * math.exp(
                -elapsed_s / self.model.heat_tau_s
            )
            return min(heated_c, self._aim_c)
        cooled_c = AMBIENT_C + (self._from_c - AMBIENT_C) * math.exp(
            -elapsed_s / self.model.cool_tau_s
        )
        return max(cooled_c, min(self._aim_c, self._from_c))

    def reached_s(self, *, cooling: bool) -> float:
        """When the target is reached; now, where M109 S need not wait for cooling."""
        start_c, target_c = self._from_c, self.target_c
        if target_c > start_c:
            full_c = max(self.model.full_c, target_c + 20.0)
            return self._from_s + self.model.heat_tau_s * math.log(
                (full_c - start_c) / (full_c - target_c)
            )
        if not cooling or target_c >= start_c:
            return self._from_s
        floor_c = max(target_c, AMBIENT_C + 0.5)
        if floor_c >= start_c:
            return self._from_s
        return self._from_s + self.model.cool_tau_s * math.log(
            (start_c - AMBIENT_C) / (floor_c - AMBIENT_C)
        )

    def cooled_s(self, limit_c: float, now_s: float) -> float:
        """When it is no warmer than a limit; never, where its target or the room is warmer."""
        if self.temperature_c(now_s) <= limit_c:
            return now_s
        if max(self.target_c, AMBIENT_C) >= limit_c:
            return math.inf
        return self._from_s + self.model.cool_tau_s * math.log(
            (self._from_c - AMBIENT_C) / (limit_c - AMBIENT_C)
        )
