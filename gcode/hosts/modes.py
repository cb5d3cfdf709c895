"""Where a program leaves the machine after some of its lines: modes, feed, position.

Just enough to come back after a pause and to compare with M114; the full reader is `gcode.reader`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from gcode.dialects import WORD, command_of, dialect_of
from gcode.hosts.port import PrintableProgram
from gcode.protocol import command_in

_HEAD_NAME = re.compile(r"T(\d{1,3})")
_EXTRUDER_NAME = re.compile(r"EXTRUDER(\d{0,3})")
_TOUCH_LINE = re.compile(r"G38\.2\s+Z(?P<to>[-+.\d]+)|AMREPAIR_TOUCH\s+DEPTH=(?P<by>[.\d]+)")


PROGRAM_LINES_AT_ONCE = 4096
GO_MM_MIN, LIFT_MM_MIN = 6000, 600
"""Back to where the machine was, along the bed and along Z."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Modal state of a machine; positions are logical, as M114 tells them, None if unknown.

    Attributes
    ----------
    hotend_c
        Target of the only heater, where there is one.
    heads_c
        The same by head, where there are several.
    tool
        The head that is chosen.
    """

    absolute: bool = True
    absolute_e: bool = True
    unit_mm: float = 1.0
    feed_mm_min: float | None = None
    position_mm: dict[str, float] = field(default_factory=dict)
    hotend_c: float = 0.0
    heads_c: dict[int, float] = field(default_factory=dict)
    tool: int = 0
    bed_c: float = 0.0
    fan: float = 0.0  # 0..255

    def targets_c(self, heads: int) -> tuple[float, ...]:
        """What each of so many heads is told to be at."""
        if heads < 2:
            return (self.hotend_c,)
        return tuple(self.heads_c.get(head, 0.0) for head in range(heads))

    def heating(self, heads: int, dialect: str) -> list[str]:
        """Lines that heat every head that is on, and wait for it; the one that is chosen last."""
        targets_c = self.targets_c(heads)
        own = self.tool if heads > 1 else 0
        heats, waits = dialect_of(dialect).head_heats
        others = {k: f"{c:g}" for k, c in enumerate(targets_c) if c > 0 and k != own}
        lines = [heats.format(k=k, c=c) for k, c in others.items()]
        hot = own < len(targets_c) and targets_c[own] > 0
        if hot:
            lines.append(f"M104 S{targets_c[own]:g}")
        lines += [waits.format(k=k, c=c) for k, c in others.items()]
        return [*lines, f"M109 S{targets_c[own]:g}"] if hot else lines

    def restore(self, x_mm: float, y_mm: float, z_mm: float, e_mm: float) -> tuple[str, ...]:
        """Commands that bring the machine to a place and back into these modes."""
        commands = ["G21", "G90", f"G1 X{x_mm:.3f} Y{y_mm:.3f} F{GO_MM_MIN}"]
        commands += [f"G1 Z{z_mm:.3f} F{LIFT_MM_MIN}", f"G92 E{e_mm:.5f}"]
        if self.feed_mm_min is not None:
            commands.append(f"G1 F{self.feed_mm_min:g}")
        if not self.absolute:
            commands.append("G91")
        commands.append("M82" if self.absolute_e else "M83")  # after G90 and G91, always
        if self.unit_mm != 1.0:
            commands.append("G20")
        return tuple(commands)


def batches_of(
    checked: PrintableProgram, first: int, end: int, size: int
) -> Iterator[tuple[list[int], list[str]]]:
    """Lines to send and their numbers in the program, those of `size` lines at a time."""
    for start in range(first, end, size):
        lines = [command_in(line) for line in checked.lines(start, min(end, start + size))]
        yield (
            [start + offset for offset, line in enumerate(lines) if line],
            [line for line in lines if line],
        )


def commands_of(checked: PrintableProgram, first: int, end: int) -> Iterator[tuple[int, str]]:
    """Lines to send with their numbers in the program; comments and empty lines left out."""
    for numbers, commands in batches_of(checked, first, end, PROGRAM_LINES_AT_ONCE):
        yield from zip(numbers, commands, strict=True)


def before_commands(checked: PrintableProgram, first: int, line: int, count: int) -> int:
    """The line from which on `count` commands come before `line`; no line before `first`."""
    start = line
    while start > first:
        start = max(first, start - 2 * count)
        found = [index for index, _ in commands_of(checked, start, line)]
        if len(found) >= count:
            return found[-count]
    return first


def modes_after(
    checked: PrintableProgram,
    line: int,
    dialect: str,
    *,
    first: int = 0,
    modes: Modes | None = None,
) -> Modes:
    """Return the modes after the lines [first, line) of a program, from `modes` before them."""
    modes = modes or Modes()
    for start in range(first, line, PROGRAM_LINES_AT_ONCE):
        for text in checked.lines(start, min(line, start + PROGRAM_LINES_AT_ONCE)):
            modes = follow(modes, text, dialect)
    return modes


def follow(modes: Modes, text: str, dialect: str) -> Modes:
    """Return the modes after one more line."""
    name, rest = command_of(text)
    touch = _TOUCH_LINE.match(f"{name} {rest}")
    if touch is not None:
        return _touched(modes, touch)
    if (head := _HEAD_NAME.fullmatch(name)) is not None:
        e_mm = (
            {"E": 0.0} if dialect_of(dialect).tool_zeroes_e and int(head[1]) != modes.tool else {}
        )
        place = {**modes.position_mm, **e_mm}
        return replace(modes, tool=int(head[1]), position_mm=place)
    if name[:1] not in ("G", "M"):
        return _named(modes, name, rest, dialect)
    words = {letter: float(value) for letter, value in WORD.findall(rest)}
    if name in ("G0", "G1", "G2", "G3"):
        return _move(modes, words, g91_moves_e=dialect_of(dialect).g91_moves_e)
    if name in ("G90", "G91"):
        absolute = name == "G90"
        if dialect_of(dialect).g90_sets_e:
            return replace(modes, absolute=absolute, absolute_e=absolute)
        return replace(modes, absolute=absolute)
    if name in ("M82", "M83"):
        return replace(modes, absolute_e=name == "M82")
    if name in ("G20", "G21"):
        return replace(modes, unit_mm=25.4 if name == "G20" else 1.0)
    if name == "G92":
        place = {letter: words[letter] * modes.unit_mm for letter in "XYZE" if letter in words}
        return replace(modes, position_mm={**modes.position_mm, **place})
    if name == "G28":
        gone: set[str] = {letter for letter in "XYZ" if letter in rest} or set("XYZ")
        return replace(
            modes,
            position_mm={k: v for k, v in modes.position_mm.items() if k not in gone},
        )
    return _heat(modes, name, words)


def _touched(modes: Modes, touch: re.Match[str]) -> Modes:
    """After a touch the nozzle is at the lowest where it may be, or straight above that."""
    place = dict(modes.position_mm)
    if touch["to"] is not None:
        place["Z"] = float(touch["to"]) * modes.unit_mm
    elif "Z" in place:
        place["Z"] -= float(touch["by"])
    return replace(modes, position_mm=place)


def _named(modes: Modes, name: str, rest: str, dialect: str) -> Modes:
    """Klipper's commands of heads and heaters."""
    told = dict(word.partition("=")[::2] for word in rest.split())
    if name == "TURN_OFF_HEATERS":
        return replace(modes, hotend_c=0.0, heads_c={}, bed_c=0.0)
    key = {"SET_HEATER_TEMPERATURE": "HEATER", "ACTIVATE_EXTRUDER": "EXTRUDER"}.get(name, "")
    head = _EXTRUDER_NAME.fullmatch(told.get(key, ""))
    if name == "ACTIVATE_EXTRUDER" and head is not None:
        return follow(modes, f"T{head[1] or 0}", dialect)
    target = WORD.fullmatch(f"S{told.get('TARGET', '0')}")
    if name != "SET_HEATER_TEMPERATURE" or target is None:
        return modes
    if told.get(key) == "HEATER_BED":
        return replace(modes, bed_c=float(target[2]))
    return modes if head is None else _hotend(modes, float(head[1] or 0), float(target[2]))


def _hotend(modes: Modes, told: float | None, target_c: float) -> Modes:
    """A head's target; of the only heater a line may say the number of the head that is chosen."""
    head = modes.tool if told is None else int(told)
    alone_c = target_c if head in (0, modes.tool) else modes.hotend_c
    return replace(modes, hotend_c=alone_c, heads_c={**modes.heads_c, head: target_c})


def _heat(modes: Modes, name: str, words: dict[str, float]) -> Modes:
    """Heaters and the part's fan (further ones have a P)."""
    value = words.get("S", words.get("R"))
    if name in ("M104", "M104.1", "M109") and value is not None:
        return _hotend(modes, words.get("T"), value)
    if name in ("G10", "M568") and "S" in words and "P" in words:  # RepRapFirmware's
        return _hotend(modes, words["P"], max(words["S"], 0.0))
    if name in ("M140", "M190") and value is not None:
        return replace(modes, bed_c=value)
    if name == "M106" and not words.get("P"):
        return replace(modes, fan=words.get("S", 255.0))
    if name == "M107":
        return replace(modes, fan=0.0)
    return modes


def _move(modes: Modes, words: dict[str, float], *, g91_moves_e: bool) -> Modes:
    """A move; Klipper's G91 makes E relative while it lasts, whatever M82 says."""
    absolute_e = modes.absolute_e and (modes.absolute or not g91_moves_e)
    place = dict(modes.position_mm)
    for letter in "XYZE":
        if letter not in words:
            continue
        value = words[letter] * modes.unit_mm
        absolute = absolute_e if letter == "E" else modes.absolute
        if absolute:
            place[letter] = value
        elif letter in place:
            place[letter] += value
    feed = words.get("F")
    return replace(
        modes,
        position_mm=place,
        feed_mm_min=modes.feed_mm_min if feed is None else feed * modes.unit_mm,
    )
