"""Bead paths: a job's lines joined to paths without corners, sampled along their length."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.regions.options import SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from gcode.stretches import in_turn

LEVEL = 1e-9


@dataclass(frozen=True, slots=True)
class BeadPaths:
    """Beads joined to paths wherever one goes on in the next without a corner, and sampled.

    Slicers write a curve as many short lines; only as one path is it long enough to be judged.

    Attributes
    ----------
    lines
        The beads of all paths that are long enough, in the order in which they are laid.
    ends_mm
        (n + 1,) running length of the lines: before each of them, and the sum at the end.
    path, at_mm, step_mm, line, share
        (m,) for each sample its path, its place on the running length, the distance to the next
        sample, its line, and where on that line it lies, from 0 to 1.
    """

    lines: PlannedBeads
    ends_mm: Float[np.ndarray, " _k"]
    path: Numbers
    at_mm: Values
    step_mm: Values
    line: Numbers
    share: Values

    @classmethod
    def of(cls, beads: PlannedBeads, options: SkippedOptions) -> BeadPaths:
        """Join beads to paths, and sample them every `sample_step_mm`."""
        over = beads.end_mm - beads.start_mm
        length_mm = np.linalg.norm(over, axis=1)
        begins = np.ones(len(length_mm), dtype=bool)
        joined = np.abs(beads.start_mm[1:] - beads.end_mm[:-1]).max(axis=1) < options.joined_mm
        along = np.einsum("ij,ij->i", over[1:], over[:-1])
        begins[1:] = ~joined | (along < options.straight_on * length_mm[1:] * length_mm[:-1])
        path = np.cumsum(begins) - 1
        # nothing begins in a shorter path, but what is gone goes on round its corners
        chain = np.concatenate([[0], np.cumsum(~joined)])[: len(length_mm)]
        keep = np.bincount(chain, length_mm)[chain] >= options.least_stretch_mm
        lines, length_mm = beads.some(keep), length_mm[keep]
        path = np.unique(path[keep], return_inverse=True)[1]
        ends_mm = np.concatenate([[0.0], np.cumsum(length_mm)])
        first = np.searchsorted(path, np.arange(path.max(initial=-1) + 1))
        path_mm = np.bincount(path, length_mm)
        count = np.ceil(path_mm / options.sample_step_mm).astype(np.int64)
        of, number = in_turn(count)
        step_mm = (path_mm / np.maximum(count, 1))[of]
        at_mm = ends_mm[first[of]] + (number + 0.5) * step_mm
        line = np.searchsorted(ends_mm[1:], at_mm)
        share = (at_mm - ends_mm[line]) / length_mm[line]
        return cls(lines, ends_mm, of, at_mm, step_mm, line, share)

    @property
    def middles_mm(self) -> Points:
        """(m, 3) the samples' places, in the middle of a bead's height."""
        lines, line = self.lines, self.line
        over_mm = (lines.end_mm - lines.start_mm)[line]
        middle_mm = lines.start_mm[line] + self.share[:, None] * over_mm
        middle_mm[:, 2] -= 0.5 * lines.height_mm[line]
        return middle_mm

    def kept(self, gone: Mask, least_mm: Values) -> Mask:
        """(m,) `gone` without runs of neighbouring samples shorter than `least_mm`."""
        a, b = self._runs(gone, self.path)
        long = (b - a + 1) * self.step_mm[a] >= least_mm[a]
        found = np.zeros(len(gone), dtype=bool)
        for first, last in zip(a[long], b[long], strict=True):
            found[first : last + 1] = True
        return found

    def grown(self, kept: Mask, gone: Values, options: SkippedOptions) -> Mask:
        """(m,) `kept`, continued along the chain of lines, round corners too, as far as it is gone.

        `gone` is above 0 where less than half of a bead is there. That alone is too weak to begin
        a stretch, but enough to continue one in which the extruder is known to have slipped.
        """
        apart_mm = np.abs(self.lines.start_mm[1:] - self.lines.end_mm[:-1]).max(axis=1)
        chain = np.concatenate([[0], np.cumsum(apart_mm >= options.joined_mm)])[self.line]
        open_on = kept | (best_mean(gone, chain, options.samples_together) > 0)
        found = np.zeros_like(kept)
        for a, b in zip(*self._runs(open_on, chain), strict=True):
            mine = np.arange(a, b + 1)
            seen = mine[kept[a : b + 1] | (gone[a : b + 1] > 0)]  # an end that is there is none
            if kept[a : b + 1].any():
                found[seen[0] : seen[-1] + 1] = True
        return found

    @staticmethod
    def _runs(pick: Mask, of: Numbers) -> tuple[Int[np.ndarray, " r"], Int[np.ndarray, " r"]]:
        """First and last sample of each run of picked neighbours on one path or chain."""
        at = np.flatnonzero(pick)
        begins = np.ones(len(at), dtype=bool)
        begins[1:] = (np.diff(at) > 1) | (np.diff(of[at]) != 0)
        return at[begins], at[np.roll(begins, -1)]  # one ends where the next begins

    def stretches(self, gone: Mask) -> PlannedBeads:
        """The runs of `gone` samples as beads, one for each line that a run covers."""
        a, b = self._runs(gone, self.path)
        from_mm, to_mm = (
            self.at_mm[k] + sign * self.step_mm[k] for k, sign in ((a, -0.5), (b, 0.5))
        )
        inner = self.ends_mm[1:-1]
        first, last = np.searchsorted(inner, from_mm + LEVEL), np.searchsorted(inner, to_mm - LEVEL)
        count = last - first + 1
        which = np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
        length_mm = np.diff(self.ends_mm)[which]
        low, high = (
            np.clip((np.repeat(mm, count) - self.ends_mm[which]) / length_mm, 0.0, 1.0)[:, None]
            for mm in (from_mm, to_mm)
        )
        lines = self.lines.some(which)
        over = lines.end_mm - lines.start_mm
        return replace(
            lines, start_mm=lines.start_mm + low * over, end_mm=lines.start_mm + high * over
        )


def best_mean(value: Values, of: Numbers, together: int) -> Values:
    """(m,) the highest mean of all windows of `together` neighbours that hold each sample."""
    m = len(value)
    whole = np.full(m, -np.inf)
    if m < together:
        return whole
    total = np.concatenate([[0.0], np.cumsum(value)])
    mean = (total[together:] - total[:-together]) / together
    mean[of[together - 1 :] != of[: m - together + 1]] = -np.inf
    for k in range(together):
        np.maximum(whole[k : k + len(mean)], mean, out=whole[k : k + len(mean)])
    return whole
