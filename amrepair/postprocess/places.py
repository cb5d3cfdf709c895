"""Where between two layers a job may be stopped: plastic pulled back, and off the perimeter.

A pause goes back to where it came from and leaves a blob there; on an outer wall it is seen.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from amrepair.loop.locate import OUTER_WALLS, first_layer, of_roles
from gcode.errors import ReadError
from gcode.reader import Job

SPIRAL_RATIO = 0.5  # of its height: a layer that climbs so much within itself is a spiral's turn
PULLED_MM = 0.01  # of filament: numbers in a file are rounded to less
MOST_FOOTER_LINES = 60
# From here on a job's end is under way: heaters off, homing, motors off.
_ENDING_COMMAND = re.compile(
    r"^\s*(M104|M109|M140|M190|G28|M84|M18|END_PRINT|PRINT_END)\b", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class Place:
    """A place between two lines.

    Attributes
    ----------
    line
        The mark goes before this line, counted from 0.
    layer
        The layer that is finished there, counted from 0.
    off_wall_mm
        How far the nozzle is from the nearest outer wall of that layer and the next; inf where the
        job does not say which its outer walls are.
    """

    line: int
    layer: int
    z_mm: float
    off_wall_mm: float


class Places:
    """The places of a job, by layer."""

    def __init__(self, job: Job) -> None:
        self._job = job
        _, pushed_mm, _ = job.moves()
        self._filament_mm = np.concatenate([[0.0], np.cumsum(pushed_mm)])  # after lines [0, k)
        beads = job.beads
        self._first = np.searchsorted(beads.layer, np.arange(len(job.layers)), side="left")
        self._stop = np.searchsorted(beads.layer, np.arange(len(job.layers)), side="right")
        self._outer = of_roles(beads, OUTER_WALLS)
        self._first_layers = {
            layer: first_layer(job.of_turn(turn))
            for turn in job.turns
            for layer in range(turn.first_layer, turn.end_layer)
        }
        self._ends = {turn.end_layer - 1 for turn in job.turns}
        self.width_mm = float(np.median(beads.width_mm))

    def is_spiral(self, layer: int) -> bool:
        """Whether a layer climbs within itself, as a vase's does."""
        beads = self._job.beads
        part = slice(int(self._first[layer]), int(self._stop[layer]))
        rise_mm = float(np.ptp(beads.end_mm[part, 2])) if part.stop > part.start else 0.0
        return rise_mm > SPIRAL_RATIO * max(self._job.layers[layer].height_mm, 1e-3)

    def after(self, layer: int) -> Place | None:
        """The best place after a layer; None where there is none: in a spiral."""
        layers = self._job.layers
        last = int(self._job.beads.line[self._stop[layer] - 1])
        if layer < self._first_layers[layer] or self.is_spiral(layer):
            return None
        if layer + 1 == len(layers):
            return self._best(layer, last + 1, self._end_of_footer(last), (layer,))
        if layer in self._ends:  # before another object begins
            return self._best(layer, last + 1, layers[layer].end_line, (layer,))
        if self.is_spiral(layer + 1):
            return None
        first = int(self._job.beads.line[self._first[layer + 1]])
        return self._best(layer, last + 1, first, (layer, layer + 1))

    def _end_of_footer(self, last: int) -> int:
        """The first line after the last bead before which the part is no more as it was printed."""
        lines = self._job.program.text.split("\n")
        stop = min(len(lines) - 1, last + MOST_FOOTER_LINES)
        for line in range(last + 1, stop):
            if _ENDING_COMMAND.match(lines[line]):
                return line
        return stop

    def _best(self, layer: int, start: int, stop: int, beside: tuple[int, ...]) -> Place | None:
        """Of the lines [start, stop] the one with the plastic pulled back, farthest from walls."""
        if stop < start:  # layers that overlap in the text: no line is between them
            return None
        lines: Int[np.ndarray, " c"] = np.arange(start, stop + 1)
        at = np.array([self._position_mm(int(line)) for line in lines])
        filament_mm = self._filament_mm[lines]
        pulled = filament_mm <= filament_mm[np.isfinite(at[:, 0])].min(initial=np.inf) + PULLED_MM
        fit = pulled & np.isfinite(at[:, 0])
        if not fit.any():
            return None
        off_mm = self._off_walls_mm(at[fit], beside)
        best = int(np.argmax(np.round(np.minimum(off_mm, 2.0 * self.width_mm), 3)))
        z_mm = self._job.layers[layer].z_mm
        return Place(int(lines[fit][best]), layer, z_mm, float(off_mm[best]))

    def _position_mm(self, line: int) -> tuple[float, float]:
        try:
            x_mm, y_mm, _ = self._job.state_after(line).position_mm
        except ReadError:
            return np.nan, np.nan
        return x_mm, y_mm

    def _off_walls_mm(
        self, at_mm: Float[np.ndarray, "c 2"], layers: tuple[int, ...]
    ) -> Float[np.ndarray, " c"]:
        """(c,) distance to the outer walls of some layers."""
        beads = self._job.beads
        which = np.concatenate([np.arange(self._first[k], self._stop[k]) for k in layers])
        which = which[self._outer[which]]
        if len(which) == 0:
            return np.full(len(at_mm), np.inf)
        start, end = beads.start_mm[which, :2], beads.end_mm[which, :2]
        along = end - start
        square = np.maximum((along**2).sum(axis=1), 1e-12)
        found = np.empty(len(at_mm))
        for k, point in enumerate(at_mm):
            share = np.clip(((point - start) * along).sum(axis=1) / square, 0.0, 1.0)
            found[k] = np.linalg.norm(start + share[:, None] * along - point, axis=1).min()
        return found
