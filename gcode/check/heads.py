"""The heads of a machine as a program changes them: their heaters, and filament pulled back.

Most machines have one head; several filaments that go to one nozzle share one, too. Which command
changes a head is known to `commands`.
"""

from __future__ import annotations

from dataclasses import dataclass

from gcode.moves import ModalState
from gcode.profiles import PrinterProfile

# What switches a head's heater off, whichever is chosen. RepRapFirmware's have a second
# temperature, for while they wait (docs.duet3d.com, G10 and M568).
_HEAD_OFF = {"reprap": "G10 P{k} S0 R0"}


@dataclass(slots=True)
class Hotend:
    """A nozzle with its heater.

    Attributes
    ----------
    target_c, standby_c
        Its target temperature; and that while another head is chosen, where the firmware has one.
    ready_c
        The temperature that was waited for, so that it is at least as hot.
    pulled_mm
        How far its filament is pulled back.
    loads
        Whether another filament was chosen, of which nothing has been printed yet.
    """

    target_c: float = 0.0
    ready_c: float = 0.0
    standby_c: float = 0.0
    pulled_mm: float = 0.0
    loads: bool = False

    def heat(self, target_c: float, *, waits: bool) -> None:
        """Set the target; the head is ready by it if it is waited for, or if it only cools."""
        self.target_c = target_c
        if waits or target_c < self.ready_c:
            self.ready_c = target_c

    def off(self) -> None:
        """Switch the head off, by a command for all heaters."""
        self.target_c = self.ready_c = self.standby_c = 0.0


def heads_of(printer: PrinterProfile, state: ModalState | None) -> tuple[list[Hotend], int]:
    """A printer's heads as they are before the first line, and the number of the chosen one."""
    heads = [Hotend() for _ in range(printer.nozzles)]
    chosen = 0
    if state is not None:
        chosen = min(state.tool, len(heads) - 1) if printer.docks else 0
        if len(state.hotends_c) == len(heads):
            for head, target_c in zip(heads, state.hotends_c, strict=True):
                head.target_c = head.ready_c = target_c
        else:
            heads[chosen].target_c = heads[chosen].ready_c = state.hotend_c
        heads[chosen].pulled_mm = state.pulled_mm
    return heads, chosen


def switching_off(
    heads: list[Hotend], chosen: Hotend | None, dialect: str
) -> list[tuple[str, float, str]]:
    """For each head left on: its name, its temperature, and the line that would switch it off.

    Parameters
    ----------
    chosen
        The chosen head; None where none is, so that all wait.
    """
    found = []
    for k, head in enumerate(heads):
        on_c = head.target_c if head is chosen else max(head.target_c, head.standby_c)
        if on_c > 0:
            alone = len(heads) == 1
            off = "M104 S0" if alone else _HEAD_OFF.get(dialect, "M104 T{k} S0").format(k=k)
            found.append(("hotend" if head is chosen else f"hotend of T{k}", on_c, off))
    return found
