"""`Job`: a program of any slicer, read into layers and beads."""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from statistics import median

import numpy as np
from jaxtyping import Bool, Float, Int

from gcode.dialects import AS_LENGTH, volume_line
from gcode.errors import ReadError
from gcode.moves import ModalState, Program
from gcode.profiles import PrinterProfile
from gcode.progress import Progress, silent
from gcode.reader import text_kernels as kernels
from gcode.reader.blocks import READ_STEPS, Block, BlockReader
from gcode.units import filament_area_mm2

_LAYER_MARKS = ("LAYER_CHANGE", "CHANGE_LAYER", "BEFORE_LAYER_CHANGE")
_CURA_LAYER = re.compile(r"LAYER:\s*(-?\d+)")
_JOB_NUMBER = r"([-+]?\d*\.?\d+)"
_HEIGHT = re.compile(r"(?:HEIGHT|LAYER_HEIGHT):\s*" + _JOB_NUMBER)
_WIDTH = re.compile(r"(?:WIDTH|LINE_WIDTH):\s*" + _JOB_NUMBER)
# PrusaSlicer's kin, Cura and ideaMaker; Simplify3D ("feature outer perimeter"); KISSlicer
# ("'Perimeter Path', 12.0 [feed mm/s]").
_ROLE = re.compile(r"(?:TYPE|FEATURE):\s*(.+?)\s*$|^\W*feature (\w.*?)\s*$|^\W*'([\w/ ]+ Path)',")
_LEAST_LAYER_MM = 0.015
ROUNDED_Z_MM = 1e-4  # jobs are written to a thousandth of a millimetre
_SQUARE_LOSS = 1.0 - math.pi / 4.0
UNKNOWN_ROLE = "unknown"
IRONING = "ironing"  # PrusaSlicer, OrcaSlicer, Bambu Studio
NOTHING_LAID = "The program extrudes nothing; it is no print job."


@dataclass(frozen=True, slots=True)
class JobLayer:
    """One layer; it is written in lines [first_line, end_line) of the program.

    Attributes
    ----------
    z_mm
        The top of the layer, which is the nozzle's height.
    """

    index: int
    z_mm: float
    height_mm: float
    first_line: int
    end_line: int


@dataclass(frozen=True, slots=True)
class Turn:
    """A stack of layers [first_layer, end_layer), written in lines [first_line, end_line).

    A sequential job, which prints its objects one after another, has a turn for each object; any
    other job has a single one.
    """

    index: int
    first_layer: int
    end_layer: int
    first_line: int
    end_line: int


@dataclass(frozen=True, slots=True)
class Beads:
    """All extruding segments in order, build frame; arcs as chords.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions.
    section_mm2, width_mm, height_mm
        (n,) plastic cross-section, and the bead's nominal width and height.
    role
        (n,) index into `roles`.
    layer
        (n,) index of the layer; -1 before the first.
    line
        (n,) program line.
    """

    start_mm: Float[np.ndarray, "n 3"]
    end_mm: Float[np.ndarray, "n 3"]
    section_mm2: Float[np.ndarray, " n"]
    width_mm: Float[np.ndarray, " n"]
    height_mm: Float[np.ndarray, " n"]
    role: Int[np.ndarray, " n"]
    layer: Int[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]
    roles: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.line)

    def subset(self, pick: Bool[np.ndarray, " n"]) -> Beads:
        """The chosen beads, in their order."""
        per_bead = (f.name for f in fields(self) if f.name != "roles")
        return replace(self, **{name: getattr(self, name)[pick] for name in per_bead})

    @property
    def volume_mm3(self) -> float:
        """Volume of plastic in all beads."""
        lengths_mm = np.linalg.norm(self.end_mm - self.start_mm, axis=1)
        return float(lengths_mm @ self.section_mm2)


@dataclass(frozen=True, slots=True)
class Job:
    """A program that has been read.

    Attributes
    ----------
    program
        Its text and dialect.
    layers, beads
        What it lays.
    footer_start_line
        The line after the last bead; from there on the program retracts, parks, switches off.
    filament_diameter_mm, filament_mm
        The filament's diameter, and the length that is used.
    block
        The machine's state after each line.
    """

    program: Program
    layers: tuple[JobLayer, ...]
    beads: Beads
    footer_start_line: int
    filament_diameter_mm: float
    filament_mm: float
    block: Block

    def moves(
        self,
    ) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """By program line, as `Block.moves`."""
        return self.block.moves()

    @property
    def turns(self) -> tuple[Turn, ...]:
        """The turns in which the job prints: one for each object of a sequential job, else one."""
        return turns_of(self.layers)

    def turn_at(self, line: int) -> Turn:
        """The turn that is under way, or has just ended, before a line."""
        turns = self.turns
        begun = bisect_right([turn.first_line for turn in turns], line - 1)
        return turns[max(begun - 1, 0)]

    def turn_of(self, layer: int) -> Turn:
        """The turn that a layer belongs to."""
        return next(turn for turn in self.turns if layer < turn.end_layer)

    def end_of(self, turn: Turn) -> int:
        """The line after the last bead of a turn."""
        return int(self.beads.line[np.searchsorted(self.beads.layer, turn.end_layer) - 1]) + 1

    def laid_in(self, turn: Turn) -> Bool[np.ndarray, " n"]:
        """(n,) which beads belong to a turn."""
        layer = self.beads.layer
        return (layer >= turn.first_layer) & (layer < turn.end_layer)

    def of_turn(self, turn: Turn) -> Job:
        """The job with the beads of one turn only; layers keep their numbers."""
        own = self.laid_in(turn)
        return self if own.all() else replace(self, beads=self.beads.subset(own))

    @property
    def nozzles(self) -> int:
        """How many separately heated heads the job was read for."""
        return self.block.states.shape[1] - kernels.S_HOT

    @property
    def tools(self) -> Int[np.ndarray, " m1"]:
        """(m + 1,) the tool that is chosen before each line, and at the end."""
        return np.asarray(self.block.states[:, kernels.S_TOOL].astype(np.int64))

    def state_after(self, line: int) -> ModalState:
        """The machine's state after lines [0, line).

        Raises
        ------
        ReadError
            If the program has no such line, or the nozzle's place is not known there.
        """
        states = self.block.states
        if not 0 <= line < len(states):
            raise ReadError(f"Line {line} is not in a program of {len(states) - 1} lines.")
        s = states[line]
        if not np.isfinite(s[:3]).all():
            raise ReadError(
                f"Before line {line + 1} the nozzle's place is not known: the program has not "
                "homed or moved all axes yet."
            )
        acceleration = float(s[kernels.S_ACC])
        return ModalState(
            position_mm=(float(s[0]), float(s[1]), float(s[2])),
            e_mm=float(s[kernels.S_E]),
            absolute_xyz=bool(s[kernels.S_ABS]),
            absolute_e=bool(s[kernels.S_ABS_E]),
            feed_mm_s=float(s[kernels.S_FEED]),
            fan_ratio=float(s[kernels.S_FAN]),
            hotends_c=tuple(s[kernels.S_HOT :].tolist()),
            bed_c=float(s[kernels.S_BED]),
            acceleration_mm_s2=None if math.isnan(acceleration) else acceleration,
            units_mm=bool(s[kernels.S_MM]),
            tool=int(s[kernels.S_TOOL]),
        )


def read_job(
    program: Program | str,
    *,
    filament_diameter_mm: float = 1.75,
    dialect: str = "marlin",
    nozzles: int = 1,
    progress: Progress = silent,
) -> Job:
    """Read a program.

    Parameters
    ----------
    program
        Text of any slicer; for a bare text, `dialect` says whose modes it follows.
    nozzles
        How many separately heated heads the printer has.

    Raises
    ------
    ReadError
        If it extrudes nothing.

    Examples
    --------
    >>> from pathlib import Path
    >>> import gcode
    >>> job = gcode.read_job(Path("job.gcode").read_text(), dialect="prusa")
    >>> len(job.layers), round(job.layers[-1].z_mm, 2)
    (45, 9.0)
    """
    if isinstance(program, str):
        program = Program(program, dialect)
    volume = volume_line(program.text)
    if volume is not None:
        raise ReadError(
            f"Line {volume} says that the program tells extrusion as a volume, E in mm³; nothing "
            f"here reads it but as {AS_LENGTH}."
        )
    progress("read", 0.0, READ_STEPS)
    block = BlockReader(program.dialect, nozzles).read(program.text, progress)
    end, owner, filament = block.end_mm, block.line, block.filament_mm
    if not len(owner):
        raise ReadError(NOTHING_LAID)
    layers = layers_of(block.comments, end[:, 2], owner, filament, block.end_line)
    beads = _beads(block, layers, filament_diameter_mm)
    progress("read", READ_STEPS, READ_STEPS)
    return Job(
        program=program,
        layers=layers,
        beads=beads,
        footer_start_line=int(owner[-1]) + 1,
        filament_diameter_mm=filament_diameter_mm,
        filament_mm=float(filament.sum()),
        block=block,
    )


def job_for(program: Program | str, printer: PrinterProfile, progress: Progress = silent) -> Job:
    """Read a program as the printer that it is meant for understands it.

    Parameters
    ----------
    program
        A bare text is taken in the printer's dialect.

    Raises
    ------
    ReadError
        If it extrudes nothing.
    """
    if isinstance(program, str):
        program = Program(program, printer.dialect)
    return read_job(
        program,
        filament_diameter_mm=printer.filament_diameter_mm,
        dialect=program.dialect,
        nozzles=printer.nozzles,
        progress=progress,
    )


def layers_of(
    comments: list[tuple[int, str]],
    end_z_mm: Float[np.ndarray, " n"],
    owner: Int[np.ndarray, " n"],
    filament: Float[np.ndarray, " n"],
    lines: int,
) -> tuple[JobLayer, ...]:
    """Layers by the slicer's own marks, else by the heights at which plastic is laid.

    Parameters
    ----------
    comments
        With their lines.
    end_z_mm, owner, filament
        (n,) of what extrudes: where it ends, its line, its filament.
    lines
        Of the program.
    """
    marks = _marks(comments)
    if not marks:
        marks = _marks_by_height(end_z_mm, owner)
    bounds = [*marks, lines]
    found: list[JobLayer] = []
    below_mm = 0.0
    for first, stop in pairwise(bounds):
        a, b = np.searchsorted(owner, [first, stop])
        if a == b:  # nothing is laid: what is there belongs to the layer before
            if found:
                last = found[-1]
                found[-1] = JobLayer(last.index, last.z_mm, last.height_mm, last.first_line, stop)
            continue
        z_mm = _main_height(end_z_mm[a:b], filament[a:b])
        found.append(JobLayer(len(found), z_mm, max(z_mm - below_mm, 0.0), first, stop))
        below_mm = z_mm
    return _with_heights(found, comments)


def _with_heights(layers: list[JobLayer], comments: list[tuple[int, str]]) -> tuple[JobLayer, ...]:
    """Correct the heights of layers that are no higher than the one before.

    Such a layer takes the height that the slicer states, else the usual one. The first layer of a
    further object in a sequential job is as high as the job's first.
    """
    stated = [
        (line, float(match.group(1)))
        for line, text in comments
        if (match := _HEIGHT.search(text)) is not None
    ]
    at = [line for line, _ in stated]
    told = [layer.height_mm for layer in layers if layer.height_mm > _LEAST_LAYER_MM]
    usual_mm = median(told) if told else 0.0
    out = []
    for layer in layers:
        k = bisect_right(at, layer.first_line)
        height_mm = layer.height_mm
        if k < len(stated) and stated[k][0] < layer.end_line and height_mm <= _LEAST_LAYER_MM:
            height_mm = stated[k][1]
        elif height_mm <= _LEAST_LAYER_MM and layer.index:
            height_mm = layers[0].height_mm if layer.z_mm <= layers[0].z_mm else usual_mm
        out.append(JobLayer(layer.index, layer.z_mm, height_mm, layer.first_line, layer.end_line))
    return tuple(out)


def turns_of(layers: Sequence[JobLayer]) -> tuple[Turn, ...]:
    """Divide layers into turns.

    A new turn begins where a layer lies at least a layer lower than the one before. A smaller step
    down occurs in the first layer over a raft, which the next one presses down.
    """
    firsts = [0]
    for before, after in pairwise(layers):
        height_mm = max(before.height_mm, after.height_mm)
        if before.z_mm - after.z_mm > height_mm - ROUNDED_Z_MM:
            firsts.append(after.index)
    ends = [*firsts[1:], len(layers)]
    return tuple(
        Turn(k, first, end, layers[first].first_line if k else 0, layers[end - 1].end_line)
        for k, (first, end) in enumerate(zip(firsts, ends, strict=True))
    )


def mark_of(comment: str) -> str | None:
    """What kind of layer mark a comment is, if it is one."""
    body = comment.strip().lstrip(";").strip()
    if _CURA_LAYER.match(body):
        return "LAYER:"
    return body if body in _LAYER_MARKS else None


def _marks(comments: list[tuple[int, str]]) -> list[int]:
    """The lines with the slicer's layer marks, all of one kind."""
    by_kind: dict[str, list[int]] = {}
    for line, text in comments:
        kind = mark_of(text)
        if kind is not None:
            by_kind.setdefault(kind, []).append(line)
    for kind in ("LAYER_CHANGE", "CHANGE_LAYER", "LAYER:"):
        if by_kind.get(kind):
            return by_kind[kind]
    return []


def _marks_by_height(end_z_mm: Float[np.ndarray, " n"], owner: Int[np.ndarray, " n"]) -> list[int]:
    """The first lines of runs of beads at one height."""
    z = np.round(end_z_mm, 4)
    marks = [int(owner[0])]
    current = z[0]
    for i in np.flatnonzero(np.diff(z) != 0) + 1:
        if z[i] - current >= _LEAST_LAYER_MM or z[i] < current - _LEAST_LAYER_MM:
            current = z[i]
            marks.append(int(owner[i]))
    return marks


def _main_height(z_mm: Float[np.ndarray, " n"], filament: Float[np.ndarray, " n"]) -> float:
    """The height at which most plastic is laid."""
    heights, group = np.unique(np.round(z_mm, 4), return_inverse=True)
    return float(heights[int(np.argmax(np.bincount(group, filament)))])


def _beads(block: Block, layers: tuple[JobLayer, ...], diameter_mm: float) -> Beads:
    comments, owner, filament = block.comments, block.line, block.filament_mm
    start, end = block.start_mm, block.end_mm
    firsts = np.array([layer.first_line for layer in layers])
    layer = np.searchsorted(firsts, owner, side="right") - 1
    role_of_line, roles = _roles(comments, owner)
    width = _stated(comments, owner, _WIDTH)
    heights = np.array([one.height_mm for one in layers])
    height = _stated(comments, owner, _HEIGHT)
    own = np.where(layer >= 0, heights[np.maximum(layer, 0)], heights[0])
    height = np.where(np.isfinite(height) & (height > 0), height, own)
    ironed = np.isin(role_of_line, [k for k, name in enumerate(roles) if name.lower() == IRONING])
    height = _as_high_as_the_rest(height, own, ironed, layer)
    lengths_mm = np.linalg.norm(end - start, axis=1)
    section = filament * filament_area_mm2(diameter_mm) / lengths_mm
    guessed = section / np.maximum(height, 1e-6) + height * _SQUARE_LOSS
    return Beads(
        start_mm=start,
        end_mm=end,
        section_mm2=section,
        width_mm=np.where(np.isfinite(width) & (width > 0), width, guessed),
        height_mm=height,
        role=role_of_line,
        layer=layer,
        line=owner,
        roles=roles,
    )


def _as_high_as_the_rest(
    height_mm: Float[np.ndarray, " n"],
    layer_mm: Float[np.ndarray, " n"],
    ironed: Bool[np.ndarray, " n"],
    layer: Int[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Bead heights, where ironing has the height of the layer that it irons.

    Slicers state a tiny height there, that of the little plastic which ironing spreads.
    """
    if not ironed.any():
        return height_mm
    tallest_mm = np.zeros(int(layer.max()) + 2)  # the last: before the first layer
    np.maximum.at(tallest_mm, layer[~ironed], height_mm[~ironed])
    of_rest_mm = tallest_mm[layer]
    return np.where(ironed, np.where(of_rest_mm > 0, of_rest_mm, layer_mm), height_mm)


def _roles(
    comments: list[tuple[int, str]], owner: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " n"], tuple[str, ...]]:
    names = [UNKNOWN_ROLE]
    at, which = [-1], [0]
    for line, text in comments:
        match = _ROLE.search(text)
        if match is not None:
            name = next(filter(None, match.groups()))
            if name not in names:
                names.append(name)
            at.append(line)
            which.append(names.index(name))
    index = np.searchsorted(np.array(at), owner, side="right") - 1
    return np.array(which)[index], tuple(names)


def _stated(
    comments: list[tuple[int, str]], owner: Int[np.ndarray, " n"], pattern: re.Pattern[str]
) -> Float[np.ndarray, " n"]:
    """The value that a comment before each bead states; NaN where none does."""
    at, values = [-1], [math.nan]
    for line, text in comments:
        match = pattern.search(text)
        if match is not None:
            at.append(line)
            values.append(float(match.group(1)))
    index = np.searchsorted(np.array(at), owner, side="right") - 1
    return np.array(values)[index]
