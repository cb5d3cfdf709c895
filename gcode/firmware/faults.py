"""The fault script: what goes wrong in the emulated printer, and when.

One fault a line, `#` begins a comment:

    line 100 lose_ok            at the 100th line that reaches the printer
    every 37 corrupt_in         at every 37th
    always resend_without_ok    from the beginning
    line 200 silence s=2.5      with a value

The faults themselves are carried out by `core` and, where the port is concerned, by `serve`.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from typing import Literal

from gcode.errors import InputError

FAULT_KINDS: dict[str, str] = {
    "lose_ok": "the ok of this line is not sent",
    "garble_ok": "the ok of this line is garbled",
    "double_ok": "the ok of this line is sent twice",
    "corrupt_in": "one bit of the line is flipped on its way to the printer",
    "drop_in": "the line does not reach the printer",
    "noise_in": "random bytes arrive with the line",
    "corrupt_out": "one bit of the answer is flipped on its way to the host",
    "noise_out": "random bytes precede the answer",
    "resend_storm": "the printer asks n times (default 8) for the line it is waiting for",
    "resend_gone": "the printer asks for line n (default 1), long gone",
    "resend_without_ok": "resend requests come without an ok (Marlin 2.0.x)",
    "silence": "nothing is said for s seconds (default 1) of the host's time",
    "dead": "nothing is said ever after",
    "busy": "the line takes s seconds (default 30) of the printer's time, with busy messages",
    "reset": "the printer starts anew",
    "silent_reset": "the printer starts anew without a banner",
    "thermal_runaway": "the firmware halts on thermal runaway",
    "runout": "filament runs out: the firmware pauses for s seconds (default 20)",
    "clog": "nothing comes out of the nozzle on the next n moves (default 100) that extrude",
    "disconnect": "the port vanishes for s seconds (default 0.2)",
    "slow_reader": "the printer reads one line each s seconds (default 0.001)",
    "damage": "each byte is damaged on its way, in both directions, with probability s (default "
    "0.005); never so that neither side could notice",
    "ignore_checksums": "number and checksum are stripped unread",
    "no_arcs": "the firmware was built without arcs (G2, G3)",
    "no_inches": "the firmware was built without inches (G20), as Marlin is where nobody asks",
}


@dataclass(frozen=True, slots=True)
class Fault:
    """One line of a fault script."""

    when: Literal["line", "every", "always"]
    count: int
    kind: str
    value: float | None = None


class FaultScript:
    """Faults looked up by the number of lines that have arrived."""

    def __init__(self, faults: tuple[Fault, ...] = ()) -> None:
        self.faults = faults
        self.always = {fault.kind: fault for fault in faults if fault.when == "always"}
        self._at: dict[int, list[Fault]] = {}
        for fault in faults:
            if fault.when == "line":
                self._at.setdefault(fault.count, []).append(fault)
        self._every = tuple(fault for fault in faults if fault.when == "every")

    def at(self, count: int) -> dict[str, Fault]:
        """Faults that strike the `count`-th line, by kind."""
        found = {fault.kind: fault for fault in self._at.get(count, ())}
        for fault in self._every:
            if count % fault.count == 0:
                found.setdefault(fault.kind, fault)
        return found

    def text(self) -> str:
        """The script as it is written."""
        rows = []
        for fault in self.faults:
            when = "always" if fault.when == "always" else f"{fault.when} {fault.count}"
            value = "" if fault.value is None else f" s={fault.value:g}"
            rows.append(f"{when} {fault.kind}{value}")
        return "\n".join(rows)


def parse_faults(text: str) -> FaultScript:
    """Read a fault script.

    Raises
    ------
    InputError
        Naming the first line that cannot be understood.
    """
    faults = []
    for row, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            faults.append(_parse_fault(words))
        except ValueError as error:
            raise InputError(
                f"Line {row} of the fault script, {line.strip()!r}, {error}; "
                f"write 'line 100 lose_ok' or 'every 37 corrupt_in'."
            ) from error
    return FaultScript(tuple(faults))


def _parse_fault(words: list[str]) -> Fault:
    when, *rest = words
    count = 0
    if when in ("line", "every"):
        if not rest or not rest[0].isdecimal() or int(rest[0]) < 1:
            raise ValueError("needs a count of at least 1")
        count = int(rest.pop(0))
    elif when != "always":
        raise ValueError("begins with none of line, every, always")
    if not rest or rest[0] not in FAULT_KINDS:
        raise ValueError(f"names no fault of {', '.join(FAULT_KINDS)}")
    kind = rest.pop(0)
    value = None
    if rest:
        name, _, number = rest.pop(0).partition("=")
        if name not in ("s", "n") or rest:
            raise ValueError("takes one value, s=… or n=…")
        value = math.nan
        with contextlib.suppress(ValueError):
            value = float(number)
        if not 0.0 <= value < math.inf:
            raise ValueError(f"has {number!r} for {name}, a number from 0 on")
    return Fault(when, count, kind, value)  # type: ignore[arg-type]
