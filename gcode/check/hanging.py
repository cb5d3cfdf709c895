"""What a patch lays over air: every strand must end, both ways, on something that holds it.

A bead is held where something stands beside it or under it, or where the floor is near below. Where
neither is the case it hangs, and must be a bridge: straight from one hold to the next, and no
longer than its material bears, or than the patch's job spans itself. What was laid in the same pass
holds nothing, so that each strand is judged as if it were alone. What fell onto a floor does not
hold a strand's end.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from gcode.check import hanging_kernels as kernels
from gcode.check.findings import Moves, Refusal, Text
from gcode.profiles import PrintSetup
from gcode.surfaces import HeightField
from gcode.surfaces.standing import half_widths_mm

# From its middle: its own half, two lines' widths (each line is pressed against the one before, and
# the first against what stands), and as far as the flat presses plastic aside.
BESIDE_MM = 1.2
# In bores: so deep below the tip something still holds a bead; a round strand of a bore's width
# with as much room again under it hangs.
DEEP_NOZZLES = 1.4
# In bores: so near a floor a strand lies under the nozzle as what is purged in the air does.
DROP_NOZZLES = 6.0
SPAN_SLACK_MM = 0.5  # of a span: rims are known to some cells
LEAST_STRAIGHT = 0.9  # of a stretch's length, from end to end: a strand is straight while it sets
STEP_MM = 0.2
JOB_CELL_MM = 0.2  # of what a job has laid
MOST_SAID = 20
MOST_CELLS = 4_000_000


class JobBridges:
    """What a job's own lines bridge over air, since its slicer trusts printer and material so far.

    The job's lines are judged by the same rule as a patch, from an empty bed up, when the answer is
    first asked for; the slicer's comments are ignored.

    Parameters
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions, build frame, in the order in which they are laid.
    section_mm2
        (n,) plastic cross-section.
    bore_mm
        Of the nozzle.
    """

    def __init__(
        self,
        start_mm: Float[np.ndarray, "n 3"],
        end_mm: Float[np.ndarray, "n 3"],
        section_mm2: Float[np.ndarray, " n"],
        bore_mm: float,
    ) -> None:
        self._start_mm, self._end_mm, self._section_mm2 = start_mm, end_mm, section_mm2
        self._bore_mm = bore_mm

    def longest_mm(self) -> float:
        """The longest straight span from hold to hold; 0 where there is none."""
        return self._longest_mm

    @cached_property
    def _longest_mm(self) -> float:
        start, end = self._start_mm, self._end_mm
        if not len(start):
            return 0.0
        low, high = _box(start, end)
        cell_mm = max(JOB_CELL_MM, math.sqrt(float(np.prod(high - low)) / MOST_CELLS))
        ny, nx = (int(n) + 1 for n in np.ceil((high - low) / cell_mm)[::-1])
        bed = HeightField(low, cell_mm, np.zeros((ny, nx)), np.ones((ny, nx), dtype=bool))
        laid = np.ones(len(start), dtype=bool)
        what, length_mm = _followed(start, end, self._section_mm2, laid, bed, self._bore_mm, 0.0)
        spans_mm = length_mm[what == kernels.TOO_LONG]  # than nothing
        return float(spans_mm.max()) + 2 * (STEP_MM + BESIDE_MM) if len(spans_mm) else 0.0


def hanging(
    moves: Moves,
    text: Text,
    setup: PrintSetup,
    as_built: HeightField,
    job: JobBridges | None = None,
) -> list[Refusal]:
    """A refusal for every strand over air that is not held at both ends, or is too long.

    Too long is more than the material bears, and more than the `job` itself bridges.
    """
    laid = moves.pushed_mm3 > 0
    if not laid.any() or not as_built.z_mm.size:
        return []
    start, end, line = moves.start_mm, moves.end_mm, moves.line
    low, high = _box(start[laid], end[laid])
    near = as_built.crop((float(low[0]), float(low[1]), float(high[0]), float(high[1])))
    near = near.coarsened(max(1, math.ceil(math.sqrt(near.z_mm.size / MOST_CELLS))))
    section_mm2 = moves.pushed_mm3 / np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)
    bore_mm, limit_mm = setup.printer.nozzle_diameter_mm, setup.material.max_bridge_mm
    longest_mm = _over_air_mm(limit_mm)
    wrong, length_mm = _followed(start, end, section_mm2, laid, near, bore_mm, longest_mm)
    if job is not None and (wrong == kernels.TOO_LONG).any():
        limit_mm = max(limit_mm, job.longest_mm())
        wrong[(wrong == kernels.TOO_LONG) & (length_mm <= _over_air_mm(limit_mm))] = 0
    found = []
    for k in np.flatnonzero(wrong)[:MOST_SAID]:
        number, out_mm = int(line[k]), float(length_mm[k])
        what, value, limit = {
            kernels.FREE_END: (
                "strand over air that ends on nothing",
                f"{out_mm:.1f} mm out",
                f"a hold within {BESIDE_MM:g} mm of both ends",
            ),
            kernels.TOO_LONG: (
                "bridge too long", f"{out_mm + 2 * BESIDE_MM:.1f} mm", f"{limit_mm:.4g} mm",
            ),
            kernels.BENT: (
                "bridge that is not straight",
                f"{out_mm:.1f} mm along it",
                f"{1 / LEAST_STRAIGHT - 1:.0%} more than from end to end",
            ),
        }[int(wrong[k])]  # fmt: skip
        found.append(Refusal(number, text.line(number), what, value, limit))
    return found


def _over_air_mm(span_mm: float) -> float:
    """The part of a span over which nothing is beside the bead."""
    return max(span_mm + SPAN_SLACK_MM - 2 * BESIDE_MM, 0.0)


def _box(
    start_mm: Float[np.ndarray, "n 3"], end_mm: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]:
    """The lowest and highest corner of the area in which something may hold some moves."""
    both = np.concatenate([start_mm[:, :2], end_mm[:, :2]])
    low, high = both.min(axis=0), both.max(axis=0)
    return low - BESIDE_MM, high + BESIDE_MM


def _followed(
    start_mm: Float[np.ndarray, "n 3"],
    end_mm: Float[np.ndarray, "n 3"],
    section_mm2: Float[np.ndarray, " n"],
    laid: Bool[np.ndarray, " n"],
    stands: HeightField,
    bore_mm: float,
    longest_mm: float,
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """For each move that ends a stretch over air, what is wrong with that, and its length."""
    return kernels.follow(
        np.ascontiguousarray(start_mm),
        np.ascontiguousarray(end_mm),
        laid,
        # over air nothing but the flat presses it aside
        np.maximum(half_widths_mm(section_mm2, bore_mm), bore_mm),
        stands.z_mm.astype(np.float64),
        stands.origin_mm.astype(np.float64),
        stands.cell_mm,
        _beside(stands.cell_mm),
        (
            DEEP_NOZZLES * bore_mm,
            DROP_NOZZLES * bore_mm,
            longest_mm,
            LEAST_STRAIGHT,
            BESIDE_MM,
            bore_mm,  # hardly more than a drop
            STEP_MM,
        ),
    )


def _beside(cell_mm: float) -> np.ndarray:
    """(c, 2) offsets, in rows and columns, of all cells beside a cell; itself first."""
    reach = int(BESIDE_MM / cell_mm + 0.5)
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    apart_mm = np.hypot(rows, columns) * cell_mm
    keep = np.flatnonzero(apart_mm <= BESIDE_MM + 0.5 * cell_mm)
    keep = keep[np.argsort(apart_mm[keep], kind="stable")]
    return np.ascontiguousarray(np.stack([rows[keep], columns[keep]], axis=1))
