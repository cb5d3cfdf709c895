"""A job's layer with its flow changed where the surface below lies too low or too high.

Bead by bead: a bead carries as much more as the gap under it is deeper than planned, or as much
less. Moves are split where that changes; everything else of the layer stays as the slicer wrote
it. What comes out is a program of its own, judged by the checker, that leaves the machine exactly
where the job's own layer would.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
from jaxtyping import Float

from gcode.check import CheckedProgram, check, policy_of
from gcode.dialects import WORD, command_of, number
from gcode.errors import InputError
from gcode.meshes import mesh_of
from gcode.moves import ModalState, Program
from gcode.profiles import PrintSetup
from gcode.reader import Job
from gcode.surfaces import HeightField, raster_kernels
from gcode.units import filament_area_mm2

LEAST_FACTOR, MOST_FLOW_FACTOR = 0.3, 1.8
"""Flow of a bead, of what the job plans: below, it tears; above, the nozzle ploughs."""
FLOW_STEP_MM = 0.5
SAME_FACTOR = 0.03
HEADROOM = 0.98
"""Of the printer's limits, so that rounding does not exceed them."""


def gap_field(solids: Sequence[tuple[manifold3d.Manifold, float]], cell_mm: float) -> HeightField:
    """How much deeper than planned (negative: higher) the surface is, by column, in mm.

    Thickness of what is missing (sign +1) or too much (sign −1); 0 beyond the field.
    """
    boxes = np.array([solid.bounding_box() for solid, _ in solids]).reshape(-1, 2, 3)
    low = np.floor(boxes[:, 0, :2].min(axis=0) / cell_mm) * cell_mm
    size = np.ceil((boxes[:, 1, :2].max(axis=0) - low) / cell_mm).astype(int)
    nx, ny = int(max(size[0], 1)), int(max(size[1], 1))
    gap = np.zeros(ny * nx)
    for solid, sign in solids:
        vertices, faces = mesh_of(solid)
        offset, z, up = raster_kernels.column_crossings(
            vertices, faces, float(low[0]), float(low[1]), cell_mm, nx, ny
        )
        column = np.repeat(np.arange(ny * nx), np.diff(offset))
        thick = np.bincount(column, weights=up * z, minlength=ny * nx)
        level = np.bincount(column, weights=up, minlength=ny * nx)
        # A column that meets an edge may miss a crossing, so it is left out.
        gap += sign * np.where(level == 0, np.maximum(thick, 0.0), 0.0)
    return HeightField(low, cell_mm, gap.reshape(ny, nx), np.ones((ny, nx), bool))


@dataclass(frozen=True, slots=True)
class ChangedLayer:
    """A layer rewritten.

    Attributes
    ----------
    first_line, end_line
        The job's lines that it stands for.
    beads
        Moves whose flow was changed.
    added_mm3
        Plastic more than the job planned; negative where less.
    """

    checked: CheckedProgram
    first_line: int
    end_line: int
    beads: int
    added_mm3: float


def change_flow(job: Job, setup: PrintSetup, layer: int, gap: HeightField) -> ChangedLayer | None:
    """Rewrite a layer; None where no bead of it runs over the field.

    Raises
    ------
    InputError
        If the layer uses relative coordinates or inches.
    CheckRefusedError
        If the checker refuses what comes out.
    """
    one = job.layers[layer]
    initial = job.state_after(one.first_line)
    if not initial.absolute_xyz or not initial.units_mm:
        raise InputError(
            f"Layer {layer} begins in relative coordinates or inches; its flow cannot be changed "
            "bead by bead."
        )
    pen = _Pen(job, setup, layer, gap, initial)
    lines = job.program.text.split("\n")
    for line in range(one.first_line, one.end_line):
        pen.line(line, lines[line])
    if not pen.changed:
        return None
    pen.end(job.state_after(one.end_line))
    program = Program("\n".join(pen.text) + "\n", job.program.dialect)
    checked = check(program, setup, initial=initial, policy=policy_of(job.program))
    return ChangedLayer(checked, one.first_line, one.end_line, pen.changed, pen.added_mm3)


class _Pen:
    """The layer's text so far; E goes on where the job's own would, plus what was added."""

    def __init__(
        self, job: Job, setup: PrintSetup, layer: int, gap: HeightField, initial: ModalState
    ) -> None:
        self.text: list[str] = []
        self.changed = 0
        self.added_mm3 = 0.0
        self._job, self._gap = job, gap
        self._area_mm2 = filament_area_mm2(job.filament_diameter_mm)
        self._most_mm2 = HEADROOM * setup.printer.max_bead_section_mm2
        self._most_mm3_s = HEADROOM * setup.max_volumetric_mm3_s
        self._height_mm = max(job.layers[layer].height_mm, 0.05)
        self._offset_mm = 0.0
        self._owed_mm = 0.0
        beads = job.beads
        own = np.flatnonzero(beads.layer == layer)
        lines, first, count = np.unique(beads.line[own], return_index=True, return_counts=True)
        self._beads = {
            int(line): own[a : a + n] for line, a, n in zip(lines, first, count, strict=True)
        }
        self._absolute_e = initial.absolute_e

    def line(self, line: int, raw: str) -> None:
        """Take the job's line over, changed or not."""
        name, rest = command_of(raw)
        if name in ("M82", "M83"):
            self._absolute_e = name == "M82"
        if name == "G92" and "E" in rest:
            self._offset_mm = 0.0
        words = dict(WORD.findall(rest))
        rows = self._beads.get(line)
        pieces = [] if rows is None else self._pieces(rows, line)
        if rows is None or all(abs(factor - 1.0) < SAME_FACTOR for _, _, factor in pieces):
            self.text.append(self._shifted(raw, name, words))
            return
        self.changed += 1
        if name not in ("G0", "G1") or len(rows) > 1:  # an arc keeps its shape
            filament = sum(mm for _, mm, _ in pieces)
            factor = sum(mm * f for _, mm, f in pieces) / filament
            pieces = [(None, filament, factor)]
        self._write(line, name, words, pieces)

    def end(self, state: ModalState) -> None:
        """The extruder's count is the job's own again."""
        if self._offset_mm != 0.0:
            self.text.append(f"G92 E{number(state.e_mm, 5)}")

    def _pieces(
        self, rows: Sequence[int] | np.ndarray, line: int
    ) -> list[tuple[Float[np.ndarray, " 3"] | None, float, float]]:
        """(end, planned filament, factor) of runs along a move."""
        beads, found = self._job.beads, []
        feed_mm_s = self._job.state_after(line + 1).feed_mm_s
        for row in rows:
            start, end = beads.start_mm[row], beads.end_mm[row]
            length_mm = float(np.linalg.norm(end - start))
            count = max(1, math.ceil(length_mm / FLOW_STEP_MM))
            ends = start + (end - start) * (np.arange(1, count + 1) / count)[:, None]
            middles = ends - (end - start) * (0.5 / count)
            section = float(beads.section_mm2[row])
            most = min(
                MOST_FLOW_FACTOR,
                self._most_mm2 / section,
                self._most_mm3_s / max(section * feed_mm_s, 1e-9),
            )
            wanted = 1.0 + self._gap.sample(middles[:, :2]) / self._height_mm
            factor = np.clip(wanted, LEAST_FACTOR, max(most, 1.0))
            filament_mm = section * length_mm / self._area_mm2 / count
            run: list[tuple[Float[np.ndarray, " 3"] | None, float, float]] = []
            for k in range(count):
                if run and abs(run[-1][2] - factor[k]) < SAME_FACTOR:
                    run[-1] = (ends[k], run[-1][1] + filament_mm, run[-1][2])
                else:
                    run.append((ends[k], filament_mm, float(factor[k])))
            found += run
        return found

    def _write(
        self,
        line: int,
        name: str,
        words: Mapping[str, str],
        pieces: Sequence[tuple[Float[np.ndarray, " 3"] | None, float, float]],
    ) -> None:
        """One move a piece; feed with the first."""
        e_mm = self._job.state_after(line).e_mm + self._offset_mm
        for k, (end, filament_mm, factor) in enumerate(pieces):
            pushed_mm = filament_mm * factor + self._owed_mm
            text = number(e_mm + pushed_mm if self._absolute_e else pushed_mm, 5)
            written = float(text) - (e_mm if self._absolute_e else 0.0)
            self._owed_mm = pushed_mm - written
            e_mm += written
            self._offset_mm += written - filament_mm
            self.added_mm3 += (written - filament_mm) * self._area_mm2
            if end is None:
                places = [f"{key}{words[key]}" for key in words if key not in "GEF"]
            elif k == len(pieces) - 1:
                places = [f"{key}{words[key]}" for key in "XYZ" if key in words]
            else:
                axes = zip("XYZ", end, strict=True)
                places = [f"{key}{number(v, 3)}" for key, v in axes if key in words]
            feed = [f"F{words['F']}"] if "F" in words and k == 0 else []
            self.text.append(" ".join([name, *places, f"E{text}", *feed]))

    def _shifted(self, raw: str, name: str, words: Mapping[str, str]) -> str:
        """An unchanged line; an absolute E moves along with what was added before."""
        moves = name in ("G0", "G1", "G2", "G3") and "E" in words
        if not (self._absolute_e and self._offset_mm and moves):
            return raw
        return re.sub(
            r"[Ee]\s*[-+]?(?:\d+\.?\d*|\.\d+)",
            f"E{number(float(words['E']) + self._offset_mm, 5)}",
            raw.partition(";")[0].rstrip(),
            count=1,
        )
