"""A wire that damages bytes either way, as a long cable beside a stepper motor does.

Each byte is hit with the same probability, by itself: a bit of it flips, it becomes another, or it
is gone. Damage that the protocol cannot show to either side is drawn anew and counted: a line whose
checksum is right all the same (the exclusive or of two equal flips is none), and a piece of a line
that is a whole command without a number.
"""

from __future__ import annotations

import random
import re

from gcode.firmware.framing import Numbers, unframed

_MOST_DRAWS = 20
_COMMAND = re.compile(rb"\s*[GMT]\s*\d")


class Wire:
    """A wire that damages a share of its bytes.

    Parameters
    ----------
    ratio
        Share of the bytes that are damaged.
    numbers
        What the firmware makes of number and checksum. Where it verifies none of them, the way to
        it is a pseudo-terminal, which is not damaged.

    Attributes
    ----------
    damaged
        Bytes hit so far.
    """

    def __init__(self, ratio: float, numbers: Numbers, *, seed: int) -> None:
        self._ratio = ratio
        self._numbers = numbers
        self._rng = random.Random(seed)
        self._sent = b""  # of the line that is not ended yet
        self.damaged = 0

    def to_printer(self, waiting: bytes, data: bytes) -> bytes:
        """What arrives of `data`, `waiting` being the half line that arrived before it."""
        if self._numbers == "ignore" or not data:
            return data
        sent = (self._sent + data).split(b"\n")
        self._sent = sent[-1]
        for _ in range(_MOST_DRAWS):
            arrived = self._damage(data)
            lines = (waiting + arrived).split(b"\n")
            if not any(self._passes(line) for line in lines if line not in sent):
                return arrived
        return b"\xff" + data  # what waits there would pass, however this line ends

    def to_host(self, data: bytes) -> bytes:
        """What arrives of the printer's answers."""
        return self._damage(data)

    def _damage(self, data: bytes) -> bytes:
        rng, arrived = self._rng, bytearray()
        for byte in data:
            if rng.random() >= self._ratio:
                arrived.append(byte)
                continue
            self.damaged += 1
            kind = rng.randrange(3)
            if kind == 0:
                arrived.append(byte ^ (1 << rng.randrange(8)))
            elif kind == 1:
                arrived.append(rng.randrange(256))
        return bytes(arrived)

    def _passes(self, line: bytes) -> bool:
        """Whether the firmware would carry out a line that nobody sent."""
        line = line.partition(b";")[0].strip()
        match = re.match(rb"N\s*(-?\d{1,10})", line)
        if match is None:
            return _COMMAND.match(line) is not None
        return unframed(line, self._numbers, int(match.group(1)) - 1).command is not None
