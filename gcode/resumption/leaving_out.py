"""A job's lines without those of one object: what it would have laid is passed over.

Moves of the object go; what else its lines say (fans, limits, temperatures) stays. After each gap
the machine is brought to where the job takes up again: place, feed, and the filament as far back as
the job has it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from gcode.dialects import number
from gcode.errors import InputError
from gcode.moves import ModalState
from gcode.profiles import PrinterProfile
from gcode.reader import Job, JobObjects, objects_of
from gcode.resumption.head import feed, filament_back_mm
from gcode.stretches import stretches_of

MOVE_OR_ARC = re.compile(r"^\s*[Gg]0*[0123](?!\d)")
LEAST_MOVE_MM = 5e-4


def object_named(job: Job, name: str) -> tuple[JobObjects, int]:
    """The objects of a job, and which of them has a name.

    Raises
    ------
    InputError
        If there is no such object, or no other one.
    """
    found = objects_of(job)
    if name not in found.names:
        known = ", ".join(found.names) or "none: the slicer has to label its objects"
        raise InputError(f"The job has no object {name!r}; its objects are {known}.")
    if len(found.names) == 1:
        raise InputError(f"The job has no other object than {name!r}; nothing would be left.")
    return found, found.names.index(name)


def lines_without(job: Job, first: int, name: str, printer: PrinterProfile) -> tuple[str, ...]:
    """The job's lines from one on, without what one object would lay.

    Parameters
    ----------
    first
        The first line that is kept, from 0.

    Raises
    ------
    InputError
        If there is no such object, or no other one, or a head is changed amid what it would lay.
    """
    objects, index = object_named(job, name)
    lines = job.program.text.rstrip().split("\n")
    out: list[str] = []
    at = first
    for start, stop in _gaps(job, objects, index, first):
        require_same_head(job, start, stop)
        out += lines[at:start]
        out += [line for line in lines[start:stop] if not MOVE_OR_ARC.match(line)]
        out += _across(job, start, stop, printer)
        at = stop
    return (*out, *lines[at:])


def require_same_head(job: Job, start: int, stop: int) -> None:
    """Refuse to pass over lines among which another head is taken.

    What it and the one before pull back for that is in the moves that would be left out.

    Raises
    ------
    InputError
        If lines [start, stop) take another head.
    """
    tools = job.tools[start : stop + 1]
    if job.nozzles > 1 and len(tools) and (tools != tools[0]).any():
        line = start + int((tools != tools[0]).argmax())
        raise InputError(
            f"line {line} takes another head amid what would be left out, and how far each head's "
            "filament is pulled back would not be known after it"
        )


def _gaps(job: Job, objects: JobObjects, index: int, first: int) -> Sequence[tuple[int, int]]:
    """Lines [start, stop) from the object's first bead to after its last, each time it is laid."""
    gaps = []
    for start, stop in stretches_of(objects.of_bead == index):
        lines = job.beads.line[start:stop]
        if lines[-1] >= first:
            gaps.append((max(int(lines[0]), first), int(lines[-1]) + 1))
    return gaps


def _across(job: Job, start: int, stop: int, printer: PrinterProfile) -> list[str]:
    """From the state before a gap to that after it."""
    before, after = job.state_after(start), job.state_after(stop)
    travel = f" F{feed(printer.travel_speed_mm_s)}"
    x, y, z = after.position_mm
    over = [f"G1 X{number(x, 5)} Y{number(y, 5)}{travel}"]
    lift = [f"G1 Z{number(z, 5)} F{feed(printer.z_speed_mm_s)}"]
    moves = [*lift, *over] if z > before.position_mm[2] else [*over, *lift]
    return ["G90", "M83", *_filament(job, start, stop, printer), *moves, *modes_as(after)]


def _filament(job: Job, start: int, stop: int, printer: PrinterProfile) -> list[str]:
    """What is to be pulled back before the way over the gap, as the job has it behind it."""
    back_mm = filament_back_mm(job)
    more_mm = float(back_mm[stop] - back_mm[start])
    if abs(more_mm) < LEAST_MOVE_MM:
        return []
    return [f"G1 E{number(-more_mm, 5)} F{feed(printer.retraction_speed_mm_s)}"]


def modes_as(after: ModalState) -> list[str]:
    """What brings a machine in G90 and M83 into a state's modes; it is at its place already."""
    said = [f"G92 E{number(after.e_mm, 5)}"]
    if after.feed_mm_s > 0:
        said.append(f"G1 F{feed(after.feed_mm_s)}")
    if not after.absolute_xyz:
        said.append("G91")
    return [*said, "M82" if after.absolute_e else "M83"]
