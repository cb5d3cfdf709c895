"""The job's own lines: a patch that follows them prints what the job would have printed there.

Newly drawn lines would leave grooves and ridges against the layers around them, and other steps on
slopes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from gcode.moves import Role
from gcode.slicing.beads import Bead
from gcode.slicing.options import DEFAULT_PATCH, JobLineOptions
from gcode.surfaces.lines import near_lines

SAME_LEVEL_MM = 2e-3  # lines of one layer are as high, but for the text's last digits
ON_MM = 0.05  # of a line's middle
BOX_MM = 1.5 * ON_MM  # about a stretch: nothing outside lies on it, however sums are rounded
EXACTLY_MM = 0.01  # how exactly it is told which columns lie in a line


@runtime_checkable
class Spans(Protocol):
    """What can say how far a job bridges over air."""

    def longest_mm(self) -> float:
        """The longest straight span from hold to hold; 0 where there is none."""


@dataclass(frozen=True, slots=True)
class JobLines:
    """Lines that a job laid, build frame.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions, in the order in which they were laid.
    section_mm2, height_mm
        (n,) plastic cross-section, and the layer's height.
    rim
        (n,) whether a line is a perimeter.
    gone_mm
        (g, 2, 3) start and end of stretches that were found to be missing altogether.
    bridges
        What the lines bridge over air, as the checker will judge it; None where that is not known.
    """

    start_mm: Float[np.ndarray, "n 3"]
    end_mm: Float[np.ndarray, "n 3"]
    section_mm2: Float[np.ndarray, " n"]
    height_mm: Float[np.ndarray, " n"]
    rim: Bool[np.ndarray, " n"]
    gone_mm: Float[np.ndarray, "g 2 3"] = field(default_factory=lambda: np.zeros((0, 2, 3)))
    bridges: Spans | None = None

    def some(self, which: Bool[np.ndarray, " n"]) -> JobLines:
        """The chosen lines."""
        return replace(
            self,
            start_mm=self.start_mm[which],
            end_mm=self.end_mm[which],
            section_mm2=self.section_mm2[which],
            height_mm=self.height_mm[which],
            rim=self.rim[which],
        )

    def near(self, low_mm: Float[np.ndarray, " 3"], high_mm: Float[np.ndarray, " 3"]) -> JobLines:
        """The horizontal lines that pass through a box."""
        low, high = np.minimum(self.start_mm, self.end_mm), np.maximum(self.start_mm, self.end_mm)
        through = ((high >= low_mm) & (low <= high_mm)).all(axis=1)
        return self.some(through & (high[:, 2] - low[:, 2] < SAME_LEVEL_MM))

    def at(self, z_mm: float) -> JobLines:
        """The lines at one height."""
        return self.some(np.abs(self.end_mm[:, 2] - z_mm) < SAME_LEVEL_MM)

    def chains(self) -> list[tuple[Bead, Float[np.ndarray, " _m"]]]:
        """Consecutive lines joined to beads, each with the cross-sections of its pieces."""
        n = len(self.rim)
        if n == 0:
            return []
        off = np.abs(self.start_mm[1:, :2] - self.end_mm[:-1, :2]).max(axis=1) > SAME_LEVEL_MM
        begins = np.flatnonzero(np.concatenate([[True], off | (self.rim[1:] != self.rim[:-1])]))
        found = []
        for a, b in zip(begins, [*begins[1:], n], strict=True):
            xy = np.concatenate([self.start_mm[a : a + 1, :2], self.end_mm[a:b, :2]])
            role = Role.PERIMETER if self.rim[a] else Role.SOLID_INFILL
            share_mm = self.section_mm2[a:b] / self.height_mm[a:b]
            found.append((Bead(xy, share_mm, role, closed=False), self.section_mm2[a:b]))
        return found


class JobColumns:
    """Which columns of a patch the job's lines lie over, layer by layer.

    Parameters
    ----------
    lines
        The job's lines.
    asked
        Columns in which something is missing; those within `rim_mm` of them are included.
    points_mm
        (ny · nx, 2) middles of all columns.
    low_mm, high_mm
        The heights that matter.
    rim_mm
        How far around the asked columns others are included.
    """

    def __init__(
        self,
        lines: JobLines,
        asked: Bool[np.ndarray, "ny nx"],
        points_mm: Float[np.ndarray, "k 2"],
        cell_mm: float,
        low_mm: float,
        high_mm: float,
        rim_mm: float,
    ) -> None:
        away_mm = ndimage.distance_transform_edt(~asked) * cell_mm
        self.near = np.asarray(away_mm <= rim_mm)
        self._corner_mm = points_mm[0] - 0.5 * cell_mm
        near_mm = points_mm[self.near.ravel()]
        low, high = near_mm.min(axis=0), near_mm.max(axis=0)
        wide_mm = float((lines.section_mm2 / np.maximum(lines.height_mm, 1e-6)).max(initial=0.0))
        self._cell_mm = cell_mm
        self._lines = lines.near(
            np.array([*(low - wide_mm), low_mm - SAME_LEVEL_MM]),
            np.array([*(high + wide_mm), high_mm + SAME_LEVEL_MM]),
        )
        self._masks: dict[float, Bool[np.ndarray, "ny nx"] | None] = {}
        order = np.argsort(self._lines.end_mm[:, 2])
        steps = np.flatnonzero(np.diff(self._lines.end_mm[order, 2]) > SAME_LEVEL_MM) + 1
        self._layers = [
            (
                float(np.median(self._lines.end_mm[of, 2])),
                float(np.median(self._lines.height_mm[of])),
            )
            for of in np.split(order, steps)
            if len(of)
        ]

    def lines_at(self, z_mm: float) -> JobLines:
        """The job's lines near the patch at one height."""
        return self._lines.at(z_mm)

    def at(self, z_mm: float) -> Bool[np.ndarray, "ny nx"] | None:
        """The columns under lines at one height; None where the job has no line there."""
        key = round(z_mm, 4)
        if key not in self._masks:
            self._masks[key] = self._over(self.lines_at(z_mm))
        return self._masks[key]

    def laid_mm(
        self, from_mm: Float[np.ndarray, "ny nx"], to_mm: float
    ) -> Float[np.ndarray, "ny nx"]:
        """How much of each column the job filled, from the column's own height to a common one."""
        laid = np.zeros(self.near.shape)
        for top_mm, height_mm in self._layers:
            over = self.at(top_mm) if top_mm < to_mm + SAME_LEVEL_MM else None
            if over is not None:
                under_mm = np.maximum(from_mm, top_mm - height_mm)
                laid += np.where(over, np.clip(min(top_mm, to_mm) - under_mm, 0.0, None), 0.0)
        return laid

    def _over(self, lines: JobLines) -> Bool[np.ndarray, "ny nx"] | None:
        if len(lines.rim) == 0:
            return None
        half_mm = 0.5 * lines.section_mm2 / lines.height_mm
        over = near_lines(
            lines.start_mm, lines.end_mm, half_mm + EXACTLY_MM,
            low_mm=self._corner_mm, cell_mm=self._cell_mm, shape=self.near.shape,
        )  # fmt: skip
        return over & self.near


@dataclass(frozen=True, slots=True)
class JobPieces:
    """What the job laid where the pieces of some beads lie.

    Attributes
    ----------
    section_mm2
        (n,) the job's cross-section there.
    height_mm
        The layer's height.
    half_mm
        Half the lines' width.
    gone
        (n,) whether the job's line was found to be missing altogether.
    over
        The columns under the job's lines, whether something is missing there or not.
    """

    section_mm2: Float[np.ndarray, " n"]
    height_mm: float
    half_mm: float
    gone: Bool[np.ndarray, " n"]
    over: Bool[np.ndarray, "ny nx"]


def gathered(
    volume_mm3: Float[np.ndarray, " n"],
    deep_mm: Float[np.ndarray, " n"],
    job: JobPieces,
    length_mm: Float[np.ndarray, " n"],
    middle_mm: Float[np.ndarray, "n 2"],
    width_mm: float,
    options: JobLineOptions = DEFAULT_PATCH.lines,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How much to lay in each piece of the job's lines.

    A scan blurs: from a missing line it takes some volume and gives it to the lines beside it. So
    pieces that lack a little hand it over to a piece near by that lacks a lot.

    Parameters
    ----------
    volume_mm3, deep_mm
        (n,) missing volume in each piece, as the scan tells it, and its mean depth.
    job
        What the job laid there. No piece gets more than that (on a deeper floor, in proportion);
        a piece of a missing line gets no less, where it stands out from those around it.
    length_mm, middle_mm
        (n,) length and (n, 2) middle of each piece.

    Returns
    -------
    (n,) the volume to lay in each piece; and (n,) how much of each piece's missing volume is laid,
    there or in the piece that it was handed to.
    """
    own_mm3 = np.maximum(job.section_mm2 * length_mm, 1e-9)
    most_mm3 = own_mm3 * np.maximum(1.0, deep_mm / job.height_mm)
    share = volume_mm3 / own_mm3
    gone = job.gone & (share > options.little)
    gone[gone] = _rounded_off(share, gone, middle_mm, options.beside_widths * width_mm, options)
    volume = np.where(gone, np.maximum(volume_mm3, own_mm3), volume_mm3)
    share = volume / own_mm3
    little = np.flatnonzero((share < options.little) & (share > 0))
    lot = np.flatnonzero(share >= options.lot)
    if len(little) and len(lot):
        beside = cKDTree(middle_mm[lot]).query_ball_point(
            middle_mm[little], options.beside_widths * width_mm
        )
        for k, others in zip(little, beside, strict=True):
            near = lot[others][np.argsort(-share[lot[others]])]
            for other in near:
                moved = min(volume[k], max(most_mm3[other] - volume[other], 0.0))
                volume[other] += moved
                volume[k] -= moved
            if gone[near].any():
                volume[k] = 0.0  # it belongs to the missing line, which is given all of its plastic
    dropped = volume < options.nothing * own_mm3
    return np.where(dropped, 0.0, volume), volume_mm3 - np.where(dropped, volume, 0.0)


def _rounded_off(
    share: Float[np.ndarray, " n"],
    asked: Bool[np.ndarray, " n"],
    middle_mm: Float[np.ndarray, "n 2"],
    around_mm: float,
    options: JobLineOptions,
) -> Bool[np.ndarray, " q"]:
    """(q,) which pieces lack all of a line though the scan, blurred, shows them to lack less.

    They must lack nearly all, or clearly more than the pieces around them. Where all around lacks
    as much, lines are thin rather than missing.
    """
    tree = cKDTree(middle_mm)
    near = tree.query_ball_point(middle_mm[asked], around_mm)
    around = np.array([share[others].mean() for others in near])
    return (share[asked] > options.nearly_all) | (share[asked] - around > options.stands_out)


def runs_of(
    lines: JobLines,
    over: Bool[np.ndarray, "ny nx"],
    cut: Callable[[Bead], list[Bead]],
) -> tuple[list[Bead], JobPieces]:
    """The job's lines as beads, cut into runs, and what the job laid in the pieces of those runs.

    `cut` divides a bead into the runs that can be laid; `over` are the columns under the lines.
    """
    runs: list[Bead] = []
    places, sections = [np.zeros((0, 2))], [np.zeros(0)]
    for bead, section in lines.chains():
        tree = cKDTree(0.5 * (bead.xy_mm[1:] + bead.xy_mm[:-1]))
        for run in cut(bead):
            runs.append(run)
            places.append(0.5 * (run.xy_mm[1:] + run.xy_mm[:-1]))
            sections.append(section[_piece_of(places[-1], bead, tree)])
    middles, section_mm2 = np.concatenate(places), np.concatenate(sections)
    gone = np.zeros(len(section_mm2), dtype=bool)
    if runs and len(lines.gone_mm):
        high_mm = float(lines.end_mm[0, 2])
        level = np.abs(lines.gone_mm[:, 0, 2] - high_mm) < SAME_LEVEL_MM
        gone = _on_any(middles, lines.gone_mm[level, :, :2])
    height_mm = float(np.median(lines.height_mm)) if runs else 0.0
    half_mm = 0.5 * float(np.median(section_mm2)) / height_mm if runs else 0.0
    return runs, JobPieces(section_mm2, height_mm, half_mm, gone, over)


def _on_any(
    points_mm: Float[np.ndarray, "p 2"], stretches_mm: Float[np.ndarray, "g 2 2"]
) -> Bool[np.ndarray, " p"]:
    """(p,) which points lie on any of some stretches; only points in a stretch's box are tested."""
    found = np.zeros(len(points_mm), dtype=bool)
    order = np.argsort(points_mm[:, 0])
    x_mm, y_mm = points_mm[order].T
    low, high = stretches_mm.min(axis=1) - BOX_MM, stretches_mm.max(axis=1) + BOX_MM
    first, last = np.searchsorted(x_mm, low[:, 0]), np.searchsorted(x_mm, high[:, 0], side="right")
    for k, (a_mm, b_mm) in enumerate(stretches_mm):
        beside = slice(first[k], last[k])
        near = order[beside][(y_mm[beside] >= low[k, 1]) & (y_mm[beside] <= high[k, 1])]
        found[near] |= _on(points_mm[near], a_mm, b_mm)
    return found


def _on(
    points_mm: Float[np.ndarray, "p 2"],
    a_mm: Float[np.ndarray, " 2"],
    b_mm: Float[np.ndarray, " 2"],
) -> Bool[np.ndarray, " p"]:
    """(p,) which points lie on a stretch."""
    along = b_mm - a_mm
    t = (points_mm - a_mm) @ along / max(float(along @ along), 1e-12)
    off = points_mm - a_mm - t[:, None] * along
    return np.asarray((t >= 0) & (t <= 1) & (np.hypot(*off.T) < ON_MM))


def _piece_of(
    points_mm: Float[np.ndarray, "p 2"], bead: Bead, tree: cKDTree
) -> Int[np.ndarray, " p"]:
    """(p,) the piece of a bead that each point lies on, of those with the nearest middles."""
    m = len(bead.xy_mm) - 1
    if m == 1:
        return np.zeros(len(points_mm), dtype=np.int64)
    asked = tree.query(points_mm, k=min(m, 8))[1].reshape(len(points_mm), -1)
    a, b = bead.xy_mm[:-1][asked], bead.xy_mm[1:][asked]
    along = b - a
    t = ((points_mm[:, None] - a) * along).sum(axis=2) / np.maximum((along**2).sum(axis=2), 1e-12)
    off = points_mm[:, None] - a - np.clip(t, 0.0, 1.0)[..., None] * along
    best = np.argmin((off**2).sum(axis=2), axis=1)
    return np.asarray(asked[np.arange(len(asked)), best], dtype=np.int64)
