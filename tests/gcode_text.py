"""What a program's text says, for tests of what is printed in the end: no plan, no reader of ours.

Straight moves in millimetres with relative extrusion, as the writer makes them.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

FILAMENT_MM2 = float(np.pi / 4 * 1.75**2)
_WORD = re.compile(r"([A-Z])([-+]?[\d.]+)")


@dataclass(frozen=True)
class Step:
    """One G1: where from and to, filament pushed (pulled below 0), and what it is done with.

    `pulled_mm` is how much filament is pulled back before it; `hot_c` is what the hotend was told
    last, `waited` whether that was waited for; `layer` counts layer changes, 0 before the first.
    """

    start_mm: Float[np.ndarray, " 3"]
    end_mm: Float[np.ndarray, " 3"]
    e_mm: float
    pulled_mm: float
    feed_mm_s: float
    hot_c: float
    waited: bool
    layer: int
    role: str

    @property
    def sideways_mm(self) -> float:
        """Length in X and Y."""
        return float(np.hypot(*(self.end_mm - self.start_mm)[:2]))

    @property
    def is_bead(self) -> bool:
        """Whether plastic is laid along it."""
        return self.e_mm > 0 and self.sideways_mm > 0

    @property
    def volume_mm3(self) -> float:
        """Plastic beyond what had been pulled back."""
        return max(self.e_mm - self.pulled_mm, 0.0) * FILAMENT_MM2


def steps_of(text: str, start_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> list[Step]:
    """Every move of a program, from where the nozzle stands before it."""
    at, feed, hot_c, waited, layer, role = np.array(start_mm), 0.0, 0.0, False, 0, ""
    pulled, relative, steps = 0.0, False, []
    for line in text.splitlines():
        layer += line == ";LAYER_CHANGE"
        role = line.removeprefix(";TYPE:") if line.startswith(";TYPE:") else role
        command, _, rest = line.partition(";")[0].strip().partition(" ")
        words = {letter: float(value) for letter, value in _WORD.findall(rest)}
        if command in ("G90", "G91"):
            relative = command == "G91"
        elif command in ("M104", "M109"):
            hot_c, waited = words["S"], command == "M109"
        elif command == "G28":
            at = np.array([0.0 if letter in rest else at[k] for k, letter in enumerate("XYZ")])
        elif command == "G1":
            here = at if relative else np.zeros(3)
            to = [here[k] + words[x] if x in words else at[k] for k, x in enumerate("XYZ")]
            feed, e = words.get("F", 60.0 * feed) / 60.0, words.get("E", 0.0)
            steps.append(Step(at, np.array(to), e, pulled, feed, hot_c, waited, layer, role))
            at, pulled = np.array(to), max(pulled - e, 0.0)
    return steps


def beads_of(steps: list[Step]) -> list[list[Step]]:
    """Unbroken runs of steps that lay plastic."""
    return [list(run) for laid, run in itertools.groupby(steps, lambda step: step.is_bead) if laid]


def points_of(bead: list[Step]) -> Float[np.ndarray, "n 3"]:
    """The points of a run."""
    return np.array([bead[0].start_mm, *(step.end_mm for step in bead)])


def ways_of(steps: list[Step]) -> list[list[Step]]:
    """What the nozzle does between one bead and the next."""
    runs = [(laid, list(run)) for laid, run in itertools.groupby(steps, lambda step: step.is_bead)]
    inner = runs[next(k for k, (laid, _) in enumerate(runs) if laid) :]
    return [run for laid, run in inner[:-1] if not laid]
