"""The objects of a job as a run knows them: whose a finding is, how much is gone, who was given up.

An object that cannot be repaired is given up, and the others go on: by the printer itself where a
server prints the job, else by a job that is written anew from where the nozzle rests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from amrepair.arrays import Box
from amrepair.loop.looks import Stop
from gcode.reader import Job, JobObjects, objects_of
from gcode.resumption.rest import Rest, without_beads

OWN_SHARE = 0.9
"""Of the beads over a finding, so many must be one object's: else nobody knows whose it is."""
OBJECT_MARGIN_MM = 1.0
SAME_Z_MM = 1e-3


@dataclass(frozen=True, slots=True)
class Objects:
    """A job's objects; none where the slicer has not labelled several.

    Attributes
    ----------
    given_up
        Names, in the order in which they were given up.
    """

    job: Job
    found: JobObjects
    given_up: tuple[str, ...] = ()

    @classmethod
    def of(cls, job: Job) -> Objects:
        """Those that are labelled in a job."""
        return cls(job, objects_of(job))

    @property
    def left(self) -> tuple[str, ...]:
        """Those that are still printed."""
        return tuple(name for name in self.found.names if name not in self.given_up)

    def owner(self, box_mm: Box) -> str:
        """The object that a box lies in, seen from above; empty where that is in doubt."""
        if len(self.found.names) < 2:
            return ""
        beads, low, high = (
            self.job.beads,
            box_mm[0, :2] - OBJECT_MARGIN_MM,
            box_mm[1, :2] + OBJECT_MARGIN_MM,
        )
        first = np.minimum(beads.start_mm[:, :2], beads.end_mm[:, :2])
        last = np.maximum(beads.start_mm[:, :2], beads.end_mm[:, :2])
        over = ((last >= low) & (first <= high)).all(axis=1) & (beads.layer >= 0)
        owners = self.found.of_bead[over]
        if not len(owners):
            return ""
        count = np.bincount(owners[owners >= 0], minlength=len(self.found.names))
        best = int(np.argmax(count))
        return self.found.names[best] if count[best] >= OWN_SHARE * len(owners) else ""

    def laid_mm3(self, name: str, line: int) -> float:
        """What the job has laid of an object before a line."""
        beads, index = self.job.beads, self.found.names.index(name)
        own = (self.found.of_bead == index) & (beads.line < line)
        return beads.subset(own).volume_mm3

    def giving_up(self, names: Sequence[str]) -> Objects:
        """The same without some more."""
        return replace(self, given_up=(*self.given_up, *names))

    def expected(self, line: int, names: Sequence[str]) -> Job:
        """The job, for what it will have laid where the printer leaves some out from a line on."""
        return without_beads(self.job, self.found, names, line)


def is_laid(job: Job, stop: Stop) -> bool:
    """Whether the job still prints what a stop would look at.

    Of objects that are printed one after another, one that was given up comes no higher.
    """
    if stop.number is None and len(job.turns) == 1:
        return True
    before = int(np.searchsorted(job.beads.line, stop.line)) - 1
    layer = int(job.beads.layer[before]) if before >= 0 else -1
    return layer >= 0 and abs(job.layers[layer].z_mm - stop.z_mm) < SAME_Z_MM


@dataclass(frozen=True, slots=True)
class Course:
    """Where the job's lines are now: as the run was begun with, or written anew since.

    Attributes
    ----------
    line_of
        (m,) by line of the job that the run was begun with; None: as it was.
    """

    job: Job
    line_of: Int[np.ndarray, " m"] | None = None

    def line(self, line: int) -> int:
        """Where a line of the first job is now; past its end, the end."""
        if self.line_of is None:
            return line
        if line >= len(self.line_of):
            return self.job.program.line_count
        return int(self.line_of[line])

    def stop(self, stop: Stop) -> Stop | None:
        """A stop of the first job as it is now; None where its layer is not printed any more."""
        if self.line_of is None:
            return stop
        now = replace(stop, line=self.line(stop.line))
        if stop.layer_index is None:
            return now
        tops = np.array([layer.z_mm for layer in self.job.layers])
        turn = self.job.turn_at(now.line)
        same = np.abs(tops[turn.first_layer : turn.end_layer] - stop.z_mm) < SAME_Z_MM
        if not same.any():
            return None
        return replace(now, layer_index=turn.first_layer + int(np.argmax(same)))

    def anew(self, rest: Rest) -> Course:
        """After the job was written anew."""
        return Course(rest.job, self.own_lines(rest))

    def own_lines(self, rest: Rest) -> Int[np.ndarray, " m"]:
        """(m,) by line of the job that the run was begun with: its line in what is written anew."""
        return rest.line_of if self.line_of is None else rest.line_of[self.line_of]
