"""From a toolpath to the text of a program, in one dialect.

The extruder is always relative in what is written here; rounding of E is carried on, so that a
million segments lose nothing. The writer judges nothing: that is `check`'s job.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float

from gcode.dialects import Dialect, dialect_of, fan_command, number
from gcode.errors import SliceError
from gcode.moves import (
    Comment,
    Extrude,
    FinishMoves,
    LayerChange,
    ModalState,
    Move,
    Prime,
    Program,
    Retract,
    Script,
    SetAcceleration,
    SetBed,
    SetFan,
    SetHotend,
    Toolpath,
    Travel,
)
from gcode.profiles import PrintSetup
from gcode.units import filament_area_mm2, mm_min_from_mm_s
from gcode.writer_kernels import bead_lines

XYZ_DIGITS = 3
E_DIGITS = 5
SAME_TEXT_MM = 5e-4  # half of the last digit that is written
JOINT_MM = 0.01  # a bead that begins further from the nozzle than this was not travelled to


def modes_restored(state: ModalState) -> list[str]:
    """Lines that set extruder position, feed and modes as a job had them."""
    return [
        f"G92 E{number(state.e_mm, E_DIGITS)}",
        *([f"G1 F{number(mm_min_from_mm_s(state.feed_mm_s), 1)}"] if state.feed_mm_s > 0 else []),
        *([] if state.absolute_xyz else ["G91"]),
        "M82" if state.absolute_e else "M83",  # after G90 and G91, always
        *([] if state.units_mm else ["G20"]),
    ]


def write(
    toolpath: Toolpath,
    setup: PrintSetup,
    *,
    title: str,
    resume: ModalState | None = None,
    restore: bool = True,
) -> Program:
    """Write a program.

    Parameters
    ----------
    toolpath
        Moves, build frame.
    title
        First line, as a comment.
    resume
        The state of the machine in mid-job; None writes a program that stands alone.
    restore
        With `resume`: end by putting position, extruder, feed, fan, temperature, acceleration and
        modes back to that state, so that the job's next line finds what it expects. The nozzle
        goes across at the height where the toolpath left it, then down.

    Raises
    ------
    SliceError
        If a bead does not begin where the nozzle is.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> setup = gcode.load_setup()
    >>> toolpath = gcode.slice_part(gcode.read_solid(Path("placed.stl")), setup)
    >>> gcode.write_program(toolpath, setup, title="block").text.splitlines()[0]
    '; block'
    """
    text = _Text(setup, resume)
    text.comment(title)
    text.modes()
    for move in toolpath:
        text.move(move)
    if resume is not None and restore:
        text.restore(resume)
    return Program("\n".join(text.lines) + "\n", setup.printer.dialect)


class _Text:
    """Lines so far, and what the firmware knows after them."""

    def __init__(self, setup: PrintSetup, state: ModalState | None) -> None:
        self.lines: list[str] = []
        self._dialect: Dialect = dialect_of(setup.printer.dialect)
        self._e_per_mm3 = setup.material.flow_ratio / filament_area_mm2(
            setup.printer.filament_diameter_mm
        )
        self._place: list[float] | None = None if state is None else list(state.position_mm)
        self._feed_mm_min: int | None = None
        self._owed_mm = 0.0
        self._tags: dict[str, str] = {}

    def comment(self, text: str) -> None:
        clean = text.encode("ascii", "replace").decode()
        self.lines += [f"; {line}" for line in clean.splitlines() or [""]]

    def modes(self) -> None:
        """G90 first: in Marlin it sets the extruder's mode too."""
        self.lines += ["G21", "G90", "M83", "G92 E0"]

    def move(self, move: Move) -> None:
        if isinstance(move, Extrude):
            self._extrude(move)
        elif isinstance(move, Travel):
            for point in move.points_mm:
                self._go(point, move.speed_mm_s)
        elif isinstance(move, Retract):
            self._filament(-move.length_mm, move.speed_mm_s)
        elif isinstance(move, Prime):
            self._filament(move.length_mm, move.speed_mm_s)
        elif isinstance(move, Script):
            self.lines += [f";AMREPAIR:{move.label}", *move.lines]
            self._place, self._feed_mm_min = None, None
            self.modes()  # whatever the script did
        elif isinstance(move, LayerChange):
            self.lines += [
                ";LAYER_CHANGE",
                f";Z:{number(move.z_mm, XYZ_DIGITS)}",
                f";HEIGHT:{number(move.height_mm, XYZ_DIGITS)}",
            ]
            self._tags["HEIGHT"] = number(move.height_mm, XYZ_DIGITS)
        elif isinstance(move, Comment):
            self.comment(move.text)
        else:
            self._set(move)

    def _set(self, move: SetHotend | SetBed | SetFan | SetAcceleration | FinishMoves) -> None:
        if isinstance(move, SetHotend):
            self.lines.append(f"M{109 if move.wait else 104} S{number(move.temperature_c, 1)}")
        elif isinstance(move, SetBed):
            self.lines.append(f"M{190 if move.wait else 140} S{number(move.temperature_c, 1)}")
        elif isinstance(move, SetFan):
            self._fan(move.ratio)
        elif isinstance(move, SetAcceleration):
            self._acceleration(move.acceleration_mm_s2)
        else:
            self.lines.append("M400")

    def _fan(self, ratio: float) -> None:
        self.lines.append(fan_command(ratio))

    def _acceleration(self, acceleration_mm_s2: float) -> None:
        self.lines.append(self._dialect.acceleration.format(a=number(acceleration_mm_s2, 0)))

    def _go(self, point_mm: Iterable[float], speed_mm_s: float) -> None:
        words = self._place_words(point_mm)
        if words:
            self.lines.append("G1" + words + self._feed_word(speed_mm_s))

    def _filament(self, length_mm: float, speed_mm_s: float) -> None:
        word = self._e_word(length_mm)
        if word:
            self.lines.append("G1" + word + self._feed_word(speed_mm_s))

    def _extrude(self, move: Extrude) -> None:
        points: Float[np.ndarray, "n 3"] = np.asarray(move.points_mm, dtype=np.float64)
        first = points[0]
        if self._place is None or math.dist(self._place, first) > JOINT_MM:
            raise SliceError(
                f"A bead begins at {tuple(round(float(v), 3) for v in first)} but the nozzle is at "
                f"{self._place}; a toolpath must travel there first."
            )
        self._tag("TYPE", str(move.role))
        self._tag("WIDTH", number(move.width_mm, 3))
        self._tag("HEIGHT", number(move.height_mm, 3))
        lines, first_end, place, self._owed_mm = bead_lines(
            points,
            np.asarray(move.section_mm2, dtype=np.float64),
            np.array(self._place),
            self._e_per_mm3,
            self._owed_mm,
            XYZ_DIGITS,
            E_DIGITS,
        )
        if first_end:
            text = lines.tobytes().decode("ascii")
            feed = self._feed_word(move.speed_mm_s)
            self.lines.append(text[:first_end] + feed + text[first_end:])
        self._place = place.tolist()

    def _tag(self, name: str, value: str) -> None:
        if self._tags.get(name) != value:
            self._tags[name] = value
            self.lines.append(f";{name}:{value}")

    def _place_words(self, point_mm: Iterable[float]) -> str:
        """Words of the axes that change; remembers what the firmware will have read."""
        words = ""
        target = [float(v) for v in point_mm]
        if self._place is None:
            self._place = [math.nan] * 3
        for axis, letter in enumerate("XYZ"):
            if not abs(target[axis] - self._place[axis]) < SAME_TEXT_MM:
                text = number(target[axis], XYZ_DIGITS)
                self._place[axis] = float(text)
                words += f" {letter}{text}"
        return words

    def _e_word(self, length_mm: float) -> str:
        exact = length_mm + self._owed_mm
        text = number(exact, E_DIGITS)
        self._owed_mm = exact - float(text)
        return "" if text == "0" else f" E{text}"

    def _feed_word(self, speed_mm_s: float) -> str:
        feed = max(1, round(mm_min_from_mm_s(speed_mm_s)))
        if feed == self._feed_mm_min:
            return ""
        self._feed_mm_min = feed
        return f" F{feed}"

    def restore(self, state: ModalState) -> None:
        """Everything back to where the job left it."""
        x, y, z = state.position_mm
        if self._place is not None:
            self._go((x, y, self._place[2]), 100.0)
            self._go((x, y, z), 10.0)
        self.lines.append(f"M104 S{number(state.hotend_c, 1)}")
        self._fan(state.fan_ratio)
        if state.acceleration_mm_s2 is not None:
            self._acceleration(state.acceleration_mm_s2)
        self.lines += modes_restored(state)
