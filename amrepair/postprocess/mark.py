"""`mark`: the text of a job with looks in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amrepair.errors import InputError
from amrepair.loop.marked_stops import LOOK_MARK
from amrepair.loop.pace import layers_at, layers_every
from amrepair.postprocess.covering import covered_mm2
from amrepair.postprocess.lifted import over_finished
from amrepair.postprocess.places import Place, Places
from amrepair.postprocess.words import Target, lines_of
from gcode.errors import ReadError
from gcode.reader import Job, read_job

# What the smallest repair that is worth its stop would lie under: a square of 5 mm.
COVERS_MM2 = 25.0
BINARY = b"GCDE"  # the first bytes of Prusa's binary G-code
HOST_DIALECTS = {"octoprint": "marlin"}  # whose modes a job follows, where a host reads the marks


@dataclass(frozen=True, slots=True)
class LooksAsked:
    """When to look.

    Attributes
    ----------
    every
        Layers from look to look; 0: none so.
    at_z_mm
        Heights, build frame; the first layer that reaches one is the last before the look.
    adaptive
        Before each layer that covers at least `covers_mm2` of what has lain open.
    final
        When all is printed.
    command
        Instead of the target's own words.
    """

    every: int = 0
    at_z_mm: tuple[float, ...] = ()
    adaptive: bool = False
    covers_mm2: float = COVERS_MM2
    final: bool = True
    command: str | None = None


@dataclass(frozen=True, slots=True)
class Marked:
    """A job with its looks.

    Attributes
    ----------
    places
        The looks, in the job's order; none where the job was marked before.
    on_walls
        How many of them are on an outer wall: there was no other place.
    moved
        How many come later than asked, because the place was better there.
    spiral
        Layers that climb in a spiral, where nothing can be looked at.
    """

    text: str
    places: tuple[Place, ...]
    on_walls: int
    moved: int
    spiral: int
    marked_before: bool = False


def decoded(data: bytes, name: str) -> str:
    """A job's text, from which `encoded` makes the same bytes again.

    Raises
    ------
    InputError
        If it is no text.
    """
    if data[:4] == BINARY:
        raise InputError(
            f"{name} is binary G-code, which no script can mark; switch 'Supports binary G-code' "
            "off in the slicer's printer settings"
        )
    if b"\0" in data:
        raise InputError(f"{name} is no text; give a job as plain G-code")
    return data.decode("utf-8", "surrogateescape")


def mark(text: str, name: str, target: Target, asked: LooksAsked) -> Marked:
    """Put looks into a job.

    Parameters
    ----------
    text
        The job; its line ends stay what they are.

    Raises
    ------
    InputError
        If the job lays nothing, or a command is not understood.
    LoopError
        If a height is not in the job.
    """
    if f"\n{LOOK_MARK} " in text:
        return Marked(text, (), 0, 0, 0, marked_before=True)
    plain = text.encode("utf-8", "replace").decode("utf-8")
    try:
        job = read_job(plain, dialect=HOST_DIALECTS.get(target, target))
    except ReadError as error:
        raise InputError(f"{name}: {error}") from error
    places = Places(job)
    chosen, moved = _chosen(job, places, asked)
    lines = text.split("\n")
    end = "\r" if lines[0].endswith("\r") else ""
    out: list[str] = []
    before = 0
    for place in chosen:
        out += lines[before : place.line]
        words = lines_of(target, place.layer, place.z_mm, asked.command)
        out += [f"{line}{end}" for line in over_finished(job, place, words)]
        before = place.line
    out += lines[before:]
    return Marked(
        "\n".join(out),
        chosen,
        sum(place.off_wall_mm < places.width_mm for place in chosen),
        moved,
        sum(places.is_spiral(layer) for layer in range(len(job.layers))),
    )


def _chosen(job: Job, places: Places, asked: LooksAsked) -> tuple[tuple[Place, ...], int]:
    """The looks in the job's order, and how many were moved to a later layer."""
    room = max(asked.every // 2, 1)
    wanted: dict[int, int] = {}  # layer: how many layers later it may be
    wanted |= dict.fromkeys(layers_every(job, asked.every), room)
    if asked.adaptive:
        covers = covered_mm2(job)
        wanted |= dict.fromkeys((np.flatnonzero(covers[1:] >= asked.covers_mm2)).tolist(), 0)
    wanted |= dict.fromkeys(layers_at(job, asked.at_z_mm), 0)
    ends = [turn.end_layer - 1 for turn in job.turns]
    if asked.final:
        wanted |= dict.fromkeys(ends, 0)
    found: dict[int, Place] = {}
    moved = 0
    for layer in sorted(wanted):
        end = next(last for last in ends if layer <= last)
        tried = [places.after(k) for k in range(layer, min(layer + wanted[layer], end) + 1)]
        options = [place for place in tried if place is not None]
        good = [place for place in options if place.off_wall_mm >= places.width_mm]
        if options:
            place = (good or options)[0]
            moved += place.layer not in wanted
            found[place.layer] = place
    return tuple(found[layer] for layer in sorted(found)), moved
