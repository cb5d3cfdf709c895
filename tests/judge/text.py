"""G-code text to moves, by the plainest reading of the standard: no arcs, no inches."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

WORD = re.compile(r"([A-Z])([-+]?[\d.]+)")
FILAMENT_MM2 = np.pi / 4 * 1.75**2


@dataclass
class Steps:
    """(n, 3) starts and ends, mm; (n,) plastic pushed, mm³; (n,) line numbers from 1."""

    start_mm: np.ndarray
    end_mm: np.ndarray
    pushed_mm3: np.ndarray
    line: np.ndarray


def read_steps(text: str) -> Steps:
    """Straight moves of a program; a retraction's way back is not plastic."""
    at, e, relative, relative_e = np.zeros(3), 0.0, False, False
    pulled = 0.0
    rows = []
    for number, raw in enumerate(text.splitlines(), 1):
        words = WORD.findall(raw.split(";")[0].upper())
        if not words:
            continue
        command = words[0][0] + str(int(float(words[0][1])))
        values = {letter: float(value) for letter, value in words[1:]}
        if command in ("G90", "G91"):
            relative = command == "G91"
            relative_e = relative
        elif command in ("M82", "M83"):
            relative_e = command == "M83"
        elif command == "G92":
            e = values.get("E", e)
        elif command == "G28":
            named = set(raw.split(";")[0].upper()[3:]) & set("XYZ") or set("XYZ")
            for k, letter in enumerate("XYZ"):
                if letter in named:
                    at[k] = 0.0
        elif command in ("G0", "G1"):
            to = at.copy()
            for k, letter in enumerate("XYZ"):
                if letter in values:
                    to[k] = values[letter] + (at[k] if relative else 0.0)
            pushed = 0.0
            if "E" in values:
                step = values["E"] if relative_e else values["E"] - e
                e += step
                if step < 0:
                    pulled -= step
                else:
                    back = min(pulled, step)
                    pulled -= back
                    pushed = (step - back) * FILAMENT_MM2
            rows.append((*at, *to, pushed, number))
            at = to
    table = np.array(rows, float).reshape(-1, 8)
    return Steps(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7].astype(int))
