"""Heads of the emulated printer: a heater each, one of them chosen.

Marlin and Klipper heat every head to its own target, chosen or not. A head of RepRapFirmware's that
waits is at a temperature of its own (docs.duet3d.com, G10).
"""

from __future__ import annotations

from gcode.firmware.thermal import HOTEND, Heater


class Heads:
    """The heads of one printer, all of them off.

    Parameters
    ----------
    waits_cooler
        Whether a head that is not chosen has a temperature of its own.
    """

    def __init__(self, count: int, now_s: float, *, waits_cooler: bool) -> None:
        self.heaters = [Heater(HOTEND) for _ in range(count)]
        self.chosen = 0
        self._waits_cooler = waits_cooler
        self._told_c = [[0.0, 0.0] for _ in range(count)]  # chosen, and waiting
        for heater in self.heaters:
            heater.set_target(0.0, now_s)

    @property
    def heater(self) -> Heater:
        """That of the head that is chosen."""
        return self.heaters[self.chosen]

    def meant(self, told: float | None) -> int | None:
        """The head that a number means, or none does; None where it is not there."""
        if told is None or len(self.heaters) == 1:  # filaments to one nozzle have numbers, too
            return self.chosen
        return int(told) if 0 <= told < len(self.heaters) else None

    def choose(self, number: int, now_s: float) -> bool:
        """Take a head; whether it is another one."""
        number = number if len(self.heaters) > 1 else 0
        other = number != self.chosen
        before, self.chosen = self.chosen, number
        for k in {before, number}:
            self._apply(k, now_s)
        return other

    def heat(self, head: int, target_c: float, now_s: float) -> None:
        """Aim at a temperature, chosen or not."""
        self.tell(head, target_c, target_c, now_s)

    def tell(
        self, head: int, chosen_c: float | None, waiting_c: float | None, now_s: float
    ) -> None:
        """Set a head's temperatures, for while it is chosen and while it waits."""
        for which, target_c in enumerate((chosen_c, waiting_c)):
            if target_c is not None:
                self._told_c[head][which] = max(target_c, 0.0)
        self._apply(head, now_s)

    def _apply(self, head: int, now_s: float) -> None:
        waits = self._waits_cooler and head != self.chosen
        target_c = self._told_c[head][waits]
        if self.heaters[head].target_c != target_c:
            self.heaters[head].set_target(target_c, now_s)
