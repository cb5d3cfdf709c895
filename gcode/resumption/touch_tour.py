"""Touches in mid-job, at places that somebody chose: from where the job rests, and back there.

It makes checked programs; `hosts.touching` carries them out. A nozzle that feels is cold while it
does, so one program cools it and another heats it again.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gcode.check import CheckedProgram, Touch, check
from gcode.dialects import dialect_of, fan_command, number
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.resumption.head import feed
from gcode.resumption.touch import touch_line
from gcode.surfaces import HeightField

OVER_FLAT_MM = 2.0
"""Between touches, over all that stands there: what stands out of a layer is mostly lower."""
ABOVE_BED_C = 10.0
"""Beside a hot bed a nozzle gets no colder."""


def tour(
    places_mm: Float[np.ndarray, "k 3"],
    setup: PrintSetup,
    rest: ModalState,
    standing: HeightField,
) -> CheckedProgram:
    """Feel at places, one after another, and go back to where the job rests.

    Parameters
    ----------
    places_mm
        What is to be felt, where, build frame; never deeper below it than the profile's depth.
    rest
        Where the job rests, above all that stands there.
    standing
        What stands on the bed.

    Raises
    ------
    CheckRefusedError
        If the head would hit something on its way.
    """
    printer, probe = setup.printer, setup.printer.feeler
    tip_mm = np.asarray(places_mm) - probe.offset_mm  # the nozzle's, where the probe's meets
    touches = tuple(Touch(x, y, z, z - probe.depth_mm) for x, y, z in tip_mm.tolist())
    high_mm = standing.top_mm + OVER_FLAT_MM - probe.offset_mm[2]
    travel, down = (f" F{feed(v)}" for v in (printer.travel_speed_mm_s, printer.z_speed_mm_s))
    x, y, z = (number(float(v), 3) for v in rest.position_mm)
    lines = ["; touches", "G21", "G90"]
    for touch in touches:
        near_mm = touch.surface_mm + OVER_FLAT_MM
        lines += [
            f"G1 X{number(touch.x_mm, 3)} Y{number(touch.y_mm, 3)}{travel}",
            f"G1 Z{number(near_mm, 3)}{down}",
            touch_line(printer, from_mm=near_mm, lowest_mm=touch.lowest_mm),
            f"G1 Z{number(high_mm, 3)}{down}",
        ]
    lines += [f"G1 Z{z}{down}", f"G1 X{x} Y{y}{travel}"]
    program = Program("\n".join(lines) + "\n", printer.dialect)
    cold = rest.with_hotend(0.0) if probe.kind == "nozzle" else rest
    return check(program, setup, as_built=standing, initial=cold, touches=touches)


def cooled(setup: PrintSetup, rest: ModalState) -> CheckedProgram | None:
    """Switch the hotend off and wait until it is cold, the fan on; None where it may stay hot."""
    probe = setup.printer.feeler
    if probe.kind != "nozzle" or rest.hotend_c <= 0:
        return None
    cold = number(max(probe.cold_c, rest.bed_c + ABOVE_BED_C), 0)
    sensor = f"extruder{rest.heater or ''}"
    dialect = dialect_of(setup.printer.dialect)
    wait = [line.format(c=cold, sensor=sensor) for line in dialect.wait_to_cool]
    lines = ["; cold, to touch", "M104 S0", "M106 S255", *wait, fan_command(rest.fan_ratio)]
    program = Program("\n".join(lines) + "\n", setup.printer.dialect)
    return check(program, setup, initial=rest)


def heated(setup: PrintSetup, rest: ModalState) -> CheckedProgram | None:
    """Heat the hotend again as it was; None where it never cooled."""
    if setup.printer.feeler.kind != "nozzle" or rest.hotend_c <= 0:
        return None
    text = f"; as hot as before\nM109 S{number(rest.hotend_c, 0)}\n"
    program = Program(text, setup.printer.dialect)
    return check(program, setup, initial=rest.with_hotend(0.0))
