"""Klipper's named commands of heads and heaters, put among the numbered ones that mean the same."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float, Int, UInt8

from gcode.reader import text_kernels as kernels

_HEADS_NAMED = re.compile(
    rb"^[ \t]*(?:(SET_HEATER_TEMPERATURE|ACTIVATE_EXTRUDER)\b([^;\n]*)|TURN_OFF_HEATERS\b)",
    re.IGNORECASE | re.MULTILINE,
)
_TOLD = re.compile(rb"\b(HEATER|EXTRUDER|TARGET)\s*=\s*(\S+)", re.IGNORECASE)
_HEAD = re.compile(rb"extruder(\d{0,3})", re.IGNORECASE)


def number_named(
    data: UInt8[np.ndarray, " bytes"],
    starts: Int[np.ndarray, " n1"],
    kinds: Int[np.ndarray, " n"],
    codes: Int[np.ndarray, " n"],
    words: Float[np.ndarray, "n 11"],
) -> None:
    """Fill in lines that `text_kernels.parse` has left out; the last three are changed.

    Examples
    --------
    `SET_HEATER_TEMPERATURE HEATER=extruder1 TARGET=210` is `M104 T1 S210`, where no target is told
    0; `ACTIVATE_EXTRUDER EXTRUDER=extruder1` is `T1`.
    """
    for found in _HEADS_NAMED.finditer(data.tobytes()):
        line = int(np.searchsorted(starts, found.start(), side="right")) - 1
        if found[1] is None:
            kinds[line] = kernels.ALL_OFF
            continue
        told = {key.upper(): value for key, value in _TOLD.findall(bytes(found[2]))}
        heats = bytes(found[1]).upper().startswith(b"SET")
        named = told.get(b"HEATER" if heats else b"EXTRUDER", b"")
        head = _HEAD.fullmatch(named)
        if head is not None:
            number = int(head[1] or b"0")
        elif not (heats and named.lower() == b"heater_bed"):
            continue
        if not heats:
            kinds[line], codes[line] = ord("T"), 10 * number
            continue
        try:
            words[line, kernels.S] = float(told.get(b"TARGET", b"0"))
        except ValueError:
            continue
        kinds[line], codes[line] = ord("M"), 1400 if head is None else 1040
        if head is not None:
            words[line, kernels.T] = number
