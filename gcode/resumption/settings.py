"""What a job has set before a line, besides modes and position: to be said again."""

from __future__ import annotations

import re
from dataclasses import dataclass

from gcode.dialects import command_of
from gcode.errors import ReadError
from gcode.profiles.importers.jobs import read_settings
from gcode.reader import Job

_LIMITS = ("M201", "M203", "M204", "M205", "M566", "M593", "SET_VELOCITY_LIMIT")
_FACTOR_COMMANDS = ("M220", "M221", "M572", "M900", "SET_PRESSURE_ADVANCE")
# RepRapFirmware's temperatures of each head, while it prints and while it waits.
_OF_A_HEAD = ("G10", "M568")
_OTHER_COMMANDS = ("M141", "M486", "EXCLUDE_OBJECT_DEFINE", "G17", "G18", "G19")
REPLAYED = frozenset((*_LIMITS, *_FACTOR_COMMANDS, *_OTHER_COMMANDS))
"""Limits, factors, pressure advance, planes, chamber, names of objects: the last word counts."""
_PLANES = frozenset({"G17", "G18", "G19"})
_KEY = re.compile(r"([A-Z_]+)=?")
_MACRO_HEAT = re.compile(
    r"\b(BED|EXTRUDER|HOTEND|NOZZLE|TOOL)\w*?(?:_?TEMP\w*)?\s*=\s*(\d+(?:\.\d+)?)"
)
_OFFSET = re.compile(r"-?\d+(?:\.\d+)?")
_LEVELLING = frozenset({"G29", "M420"})


@dataclass(frozen=True, slots=True)
class Settings:
    """What lines [0, line) of a job set.

    Attributes
    ----------
    commands
        To be said again, in their order.
    hotends_c, bed_c
        Targets, °C, a macro's parameters included; of each head, 0 where it is off, and of the one
        that is chosen None where the job says nothing.
    levelled
        The job has a mesh of the bed measured or switched on.
    """

    commands: tuple[str, ...]
    hotends_c: tuple[float | None, ...]
    bed_c: float | None
    levelled: bool


def settings_before(job: Job, line: int) -> Settings:
    """Read the settings in force before a line.

    Raises
    ------
    ReadError
        If the job has shifted its coordinate system: the shift is lost with the printer's memory.
        If its slicer has, for a head.
    """
    require_one_frame(job)
    last: dict[tuple[str, ...], str] = {}
    macro_c: dict[str, float] = {}
    says_bed = levelled = False
    for number, raw in enumerate(job.program.text.split("\n")[:line], start=1):
        command = raw.partition(";")[0].strip()
        name, rest = command_of(command)
        if name == "G92" and re.search(r"[XYZ]", rest):
            raise ReadError(
                f"Line {number} ({command!r}) shifts the coordinate system, which a job begun "
                f"later cannot know to be in force; send the whole job, or slice it anew."
            )
        if name in REPLAYED or (name == "M106" and re.search(r"P\s*[1-9]", rest)):
            key = _key(name, rest)
            last.pop(key, None)  # the order is that of the last word
            last[key] = command
        elif name in _OF_A_HEAD and (head := re.search(r"P\s*(\d+)", rest)):
            last.pop(key := ("head", head[1]), None)
            last[key] = command
        elif name in _LEVELLING:
            levelled = True
        elif name in ("M140", "M190"):
            says_bed = True
        elif name[:1] not in ("G", "M", "T"):
            for what, value in _MACRO_HEAT.findall(rest):
                macro_c["bed" if what == "BED" else "hotend"] = float(value)
    state = job.state_after(line)
    bed_c = state.bed_c or macro_c.get("bed", 0.0)
    hotends_c: list[float | None] = list(state.hotends_c)
    hotends_c[state.heater] = state.hotend_c or macro_c.get("hotend") or None
    return Settings(
        commands=tuple(last.values()),
        hotends_c=tuple(hotends_c),
        bed_c=bed_c if bed_c or says_bed else None,
        levelled=levelled,
    )


def require_one_frame(job: Job) -> None:
    """Refuse a job whose slicer moves what a head lays by how far its nozzle is from the first.

    Raises
    ------
    ReadError
        If what a head lays is elsewhere than its lines say.
    """
    settings = read_settings("job", job.program.text) if job.nozzles > 1 else None
    told = "" if settings is None else settings[1].values.get("extruder_offset", "")
    for head, offset in enumerate(told.split(",")):
        if any(float(value) for value in _OFFSET.findall(offset)):
            raise ReadError(
                f"The job's slicer has moved what head T{head} lays by {offset} mm "
                "(extruder_offset), and where it comes to lie is not followed; let the firmware "
                "know where each nozzle is, and slice with offsets of 0."
            )


def _key(name: str, rest: str) -> tuple[str, ...]:
    """Commands that set the same things: the later one replaces the earlier."""
    if name in _PLANES:
        return ("plane",)
    if name in ("EXCLUDE_OBJECT_DEFINE", "M106"):
        return (name, rest)
    return (name, *sorted(_KEY.findall(re.sub(r"[-+]?\d*\.?\d+", " ", rest))))
