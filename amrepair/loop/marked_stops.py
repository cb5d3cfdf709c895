"""The looks that are marked in a job, as the stops of a run over it.

They are put there by `amrepair.postprocess`; whoever prints the job rests behind each.
"""

from __future__ import annotations

import re

from amrepair.errors import InputError
from amrepair.loop.looks import Stop, end_stop
from gcode.hosts.job_text import LOOK_COMMANDS
from gcode.reader import Job

LOOK_MARK = ";AMREPAIR_LOOK"
_MARKED = re.compile(rf"^{LOOK_MARK} LAYER=(\d+) Z=(\S+)\s*$")


def marked_stops(job: Job, name: str, *, start: int = 0) -> tuple[Stop, ...]:
    """The stops of a job at its marks; those at the last layer of a part are its own.

    Parameters
    ----------
    start
        What would be stopped at before this line is left out: it has been printed.

    Raises
    ------
    InputError
        If the job has no mark, or one that nobody would hand on.
    """
    lines = job.program.text.split("\n")
    stops = []
    ends = {turn.end_layer - 1: turn for turn in job.turns}
    for number, line in enumerate(lines[:-1]):
        if (found := _MARKED.match(line)) is None:
            continue
        if not lines[number + 1].startswith(LOOK_COMMANDS):
            raise InputError(
                f"{name}: line {number + 2} at a mark is {lines[number + 1].strip()!r}, which is "
                "the firmware's own pause; mark the job for its host ('amrepair postprocess --for "
                "klipper')"
            )
        layer = int(found.group(1))
        if layer >= len(job.layers):
            raise InputError(f"{name}: line {number + 1} marks layer {layer}, which is not there")
        turn = ends.get(layer)
        stops.append(
            Stop(layer, number + 2, job.layers[layer].z_mm)
            if turn is None
            else end_stop(job, turn, number + 2)
        )
    if not stops:
        raise InputError(
            f"{name} has no looks in it; name 'amrepair postprocess' in the slicer's "
            "post-processing scripts"
        )
    if not (left := tuple(stop for stop in stops if stop.line >= start)):
        raise InputError(f"{name} has come past its last look, at line {stops[-1].line}")
    return left
