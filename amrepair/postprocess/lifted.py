"""A pause beside objects that are finished: lifted over them, whatever the firmware does then.

A firmware's own pause lifts by what somebody once told it, and then goes aside; what is finished
may stand higher than that.
"""

from __future__ import annotations

import re

from amrepair.errors import InputError
from amrepair.loop.travel import PARK_LIFT_MM
from amrepair.postprocess.places import Place
from gcode.dialects import number
from gcode.reader import Job
from gcode.reader.text_kernels import INCH_MM
from gcode.resumption.head import feed

LIFT_MM_S = 10.0
_Z_SHIFT = re.compile(r"^\s*G92\b[^;\n]*Z.*$", re.IGNORECASE | re.MULTILINE)


def over_finished(job: Job, place: Place, words: tuple[str, ...]) -> tuple[str, ...]:
    """The lines of a look, and around them up over all that is finished, and down again.

    Unchanged where nothing is, or the nozzle is as high already.

    Raises
    ------
    InputError
        If the job tells its firmware another Z than it is at.
    """
    turn = job.turn_at(place.line)
    tops_mm = [layer.z_mm for layer in job.layers[: turn.first_layer]]
    state = job.state_after(place.line)
    z_mm = state.position_mm[2]
    high_mm = max(tops_mm, default=-PARK_LIFT_MM) + PARK_LIFT_MM
    if not tops_mm or high_mm <= z_mm:
        return words
    if (shift := _Z_SHIFT.search(job.program.text)) is not None:
        raise InputError(
            f"the job prints its objects one after the other and says {shift.group(0).strip()!r}: "
            "nobody knows how high a pause has to be lifted over what is finished"
        )
    unit_mm = 1.0 if state.units_mm else INCH_MM
    up, down = (high_mm, z_mm) if state.absolute_xyz else (high_mm - z_mm, z_mm - high_mm)
    speed = f" F{feed(LIFT_MM_S / unit_mm)}"
    again = [f"G1 F{feed(state.feed_mm_s / unit_mm)}"] if state.feed_mm_s > 0 else []
    return (
        f"G1 Z{number(up / unit_mm, 4)}{speed}",
        *words,
        f"G1 Z{number(down / unit_mm, 4)}{speed}",
        *again,
    )
