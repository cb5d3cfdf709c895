"""`LaidBeads`: how far from the drawing a job's own beads put a surface, by place and by volume.

A slicer's path is not the drawing: layers round heights up and down, infill overlaps perimeters so
that a layer is given more plastic than it has room for, bridges are laid thicker than a layer, and
what is thinner than a bead is left out. What has no room goes to the nearest free side; on which
side nobody can say. So every place of a surface gets an interval, from where its beads stand if
nothing is pushed to where they stand if all of it is pushed there. Nothing is judged here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from amrepair.arrays import Numbers, Points, Values
from amrepair.errors import TemplateError
from amrepair.template import laid_kernels as kernels

# A slicer cuts in the middle of a layer: tops are rounded by no more than half of one.
ROUNDED_LAYERS = 0.55
# So many layers over strands that hang lie lower by what strands hang lower: a skin's three.
SUNK_LAYERS = 3


def strands_hang_lower_mm(width_mm: Values, height_mm: Values) -> Values:
    """(n,) how much lower than its layer's the plastic of a strand lies: what hangs is round.

    No more than half a layer: what is laid on it fills the grooves between strands first.
    """
    round_mm = 2.0 * np.sqrt(width_mm * height_mm / np.pi)
    return np.clip(round_mm - height_mm, 0.0, 0.5 * height_mm)


@dataclass(frozen=True, slots=True)
class LaidOptions:
    """What is taken for granted of plastic that has no room.

    Attributes
    ----------
    flow_ratio
        More than asked for may come out by this share: filament of 1.75 ± 0.02 mm has 2.3 % more
        or less area.
    push_beads, push_strands
        The outermost bead is pushed out by at most this share of its own width: farther, the
        plastic climbs over it. A strand with nothing below gives way by as much as it is wide.
    around_layers
        A scanner's spot shows a wall that a layer pushed out so many layers over and under it.
    rise_layers
        What has no room in a layer rises over its top by at most this share of the layer: what
        stands higher, the nozzle's flat planes off.
    sag_layers
        Strands that cross a gap hang lower than their own height by at most this: more is a bridge
        that failed.
    reach_mm
        Plastic is pushed no farther than this from where it was laid: a nozzle's flat and the
        beads beside it.
    cell_mm, blur_mm
        Cells that plastic is counted in, and the width that it is averaged over: more than the
        spacing of two lines, so that the groove between them is no lack.
    upright
        A surface is a top (or an underside) where its normal's Z is at least this, 45°; else a
        wall.
    """

    flow_ratio: float = 0.023
    push_beads: float = 0.5
    push_strands: float = 1.0
    around_layers: float = 1.5
    rise_layers: float = 0.5
    sag_layers: float = 1.0
    reach_mm: float = 4.0
    cell_mm: float = 0.2
    blur_mm: float = 0.6
    upright: float = 0.7071


@dataclass(frozen=True, slots=True)
class _Fill:
    """Plastic over room of one layer, by cells; the widest bead's width there; their corner."""

    ratio: Float32[np.ndarray, "ny nx"]
    widest_mm: Float32[np.ndarray, "ny nx"]
    corner_mm: Float[np.ndarray, " 2"]

    @property
    def bytes(self) -> int:
        """What it takes of memory."""
        return self.ratio.nbytes + self.widest_mm.nbytes

    def at(self, place_mm: Float[np.ndarray, "q d"], cell_mm: float) -> Float[np.ndarray, " q"]:
        """(q,) the ratio at places."""
        return np.asarray(kernels.at(self.ratio, self.corner_mm, cell_mm, place_mm))


class KeptFills:
    """Plastic of a job's layers, made once for all looks at it: what is laid stays as it is.

    The lowest go where there is no more memory: looks at one layer after another ask for the
    highest few, and one at the finished part for all. Another process makes its own.
    """

    def __init__(self, most_bytes: int = 256 * 1024**2) -> None:
        self._room = self._most = most_bytes
        self._found: dict[tuple[int, int], _Fill] = {}

    def __reduce__(self) -> tuple[type[KeptFills], tuple[int]]:
        return KeptFills, (self._most,)

    def get(self, layer: tuple[int, int], make: Callable[[], _Fill]) -> _Fill:
        """Of a layer by its index and its number of beads; made where it is not there yet."""
        found = self._found.get(layer)
        if found is None:
            found = self._found[layer] = make()
            self._room -= found.bytes
            while self._room < 0:
                self._room += self._found.pop(min(self._found)).bytes
        return found


class _Found:
    """What the layers so far say of every place; NaN where they say nothing."""

    def __init__(
        self, surface_mm: Float[np.ndarray, "s 3"], inward: Float[np.ndarray, "s 2"]
    ) -> None:
        self.surface_mm = np.ascontiguousarray(surface_mm)
        self.inward = np.ascontiguousarray(inward)
        self.low = np.full(len(surface_mm), np.nan)
        self.high = np.full(len(surface_mm), np.nan)


@dataclass(frozen=True, slots=True)
class LaidBeads:
    """A job's beads by layer, asked where they put a surface.

    Attributes
    ----------
    start_mm, end_mm
        (n, 3) nozzle positions, in the frame that places are told in; layer by layer.
    section_mm2, height_mm
        (n,) plastic, and height, of each.
    first
        (k + 1,) where each layer's beads begin.
    top_mm, layer_mm
        (k,) height of each layer's top, and of the layer; rising.
    index
        (k,) of each layer in the job.
    kept
        Plastic of layers that earlier looks at the same job asked for.
    """

    start_mm: Points
    end_mm: Points
    section_mm2: Values
    height_mm: Values
    first: Int[np.ndarray, " k1"]
    top_mm: Float[np.ndarray, " k"]
    layer_mm: Float[np.ndarray, " k"]
    index: Int[np.ndarray, " k"]
    options: LaidOptions = LaidOptions()
    kept: KeptFills = field(default_factory=KeptFills, compare=False)

    @classmethod
    def from_beads(
        cls,
        start_mm: Points,
        end_mm: Points,
        section_mm2: Values,
        height_mm: Values,
        layer: Numbers,
        *,
        options: LaidOptions = LaidOptions(),
        kept: KeptFills | None = None,
    ) -> LaidBeads:
        """Sort beads into layers.

        Parameters
        ----------
        layer
            (n,) index of each bead's layer; its top is the height of most of its plastic.
        kept
            Of an earlier look at the same job; None keeps what this one asks for.

        Raises
        ------
        TemplateError
            If there is no bead.
        """
        if len(layer) == 0:
            raise TemplateError("there are no beads to say what a job lays; give at least one")
        order = np.argsort(layer, kind="stable")
        index, begins = np.unique(layer[order], return_index=True)
        start, end = (np.ascontiguousarray(xyz[order], dtype=np.float64) for xyz in
                      (start_mm, end_mm))  # fmt: skip
        top = np.array([np.median(z) for z in np.split(end[:, 2], begins[1:])])
        rising = np.argsort(top, kind="stable")
        ends = np.append(begins[1:], len(order))
        again = np.concatenate([np.arange(begins[k], ends[k]) for k in rising])
        counts = (ends - begins)[rising]
        low = np.array([height_mm[order][begins[k] : ends[k]].min() for k in rising])
        step = np.diff(top[rising], prepend=0.0)
        # Copies printed one by one lie beside lower layers; there beads have their own height.
        layer_mm = np.where((step > 1e-3) & (step < low), step, low)
        return cls(
            start[again],
            end[again],
            np.ascontiguousarray(section_mm2[order][again], dtype=np.float64),
            np.ascontiguousarray(height_mm[order][again], dtype=np.float64),
            np.concatenate([[0], np.cumsum(counts)]),
            top[rising],
            layer_mm,
            index[rising],
            options,
            kept or KeptFills(),
        )

    def interval(
        self,
        place_mm: Float[np.ndarray, "s 3"],
        normal: Float[np.ndarray, "s 3"],
        deviation_mm: Float[np.ndarray, " s"],
    ) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
        """From where to where the job puts the surface, along its normal.

        Parameters
        ----------
        place_mm
            (s, 3) places that were seen.
        normal
            (s, 3) outward unit normals of what is expected there.
        deviation_mm
            (s,) how far out of what is expected each place lies: the surface is that far back.

        Returns
        -------
        low_mm, high_mm
            (s,) each, positive outwards; 0 where no layer of the job is near.
        """
        o = self.options
        surface = place_mm - deviation_mm[:, None] * normal
        level, upright = np.hypot(normal[:, 0], normal[:, 1]), np.abs(normal[:, 2])
        found = _Found(surface, -normal[:, :2] / np.maximum(level, 1e-9)[:, None])
        wall, up = upright < o.upright, normal[:, 2] > 0
        fill: _Fill | None = None
        for k in range(len(self.top_mm)):
            h, over, below = float(self.layer_mm[k]), surface[:, 2] - self.top_mm[k], fill
            walls = np.flatnonzero(wall & (np.abs(over + 0.5 * h) < (o.around_layers + 0.5) * h))
            tops = np.flatnonzero(~wall & up & (np.abs(over) < ROUNDED_LAYERS * h))
            unders = np.flatnonzero(~wall & ~up & (np.abs(over + h) < ROUNDED_LAYERS * h))
            fill = None
            if not len(walls) + len(tops) + len(unders):
                continue
            fill = self._fill(k)
            if below is None and k > 0:
                below = self._fill(k - 1)
            self._walls(k, fill, below, walls, found)
            self._tops(k, fill, tops, found)
            self._undersides(k, fill, unders, found)
        low, high = (np.where(np.isfinite(side), side, 0.0) for side in (found.low, found.high))
        share = np.where(wall, level, upright)  # of a way out, or up, along the normal
        return low * share, np.maximum(high, low) * share

    def expected_offset_mm(
        self,
        place_mm: Float[np.ndarray, "s 3"],
        normal: Float[np.ndarray, "s 3"],
        deviation_mm: Float[np.ndarray, " s"],
    ) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
        """(s,) middle of `interval`, and (s,) half its width: an offset and its tolerance."""
        low, high = self.interval(place_mm, normal, deviation_mm)
        return 0.5 * (low + high), 0.5 * (high - low)

    def sunk_mm(
        self,
        place_mm: Float[np.ndarray, "s 3"],
        normal: Float[np.ndarray, "s 3"],
        deviation_mm: Float[np.ndarray, " s"],
        asked: Bool[np.ndarray, " s"],
    ) -> Float[np.ndarray, " s"]:
        """(s,) how much lower than planned tops lie that were laid on strands over a gap.

        Of a strand's plastic some lies below its layer, and what is laid on it fills the grooves
        between strands first: the layers over open infill are all lower, by no more than that. By
        how much tells the median of all of a layer that lies so, where any of it is asked for. As
        in `interval`.
        """
        surface, found = place_mm - deviation_mm[:, None] * normal, np.zeros(len(place_mm))
        rising = np.argsort(surface[:, 2])
        rising = rising[normal[rising, 2] >= self.options.upright]
        high_mm, near_mm = surface[rising, 2], ROUNDED_LAYERS * self.layer_mm
        first = np.searchsorted(high_mm, self.top_mm - near_mm, "right")
        end = np.searchsorted(high_mm, self.top_mm + near_mm)
        low = np.concatenate([[0], np.cumsum(asked[rising])])
        fills: dict[int, _Fill] = {}  # of the layers below the last one that was asked for
        for k in np.flatnonzero(low[end] > low[first]):
            fills = {below: fills[below] for below in fills if below >= k - SUNK_LAYERS - 1}
            at, most_mm = self._over_strands(int(k), surface, rising[first[k] : end[k]], fills)
            if len(at):
                lies_mm = float(np.median(self.top_mm[k] - surface[at, 2] - deviation_mm[at]))
                found[at] = np.minimum(most_mm, max(lies_mm, 0.0))
        return found

    def _over_strands(
        self, k: int, surface_mm: Points, at: Int[np.ndarray, " a"], fills: dict[int, _Fill]
    ) -> tuple[Int[np.ndarray, " z"], Float[np.ndarray, " z"]]:
        """Which of some places on a layer's top lie over strands, and how much lower at most."""
        over, most_mm = [np.zeros(0, np.int64)], [np.zeros(0)]
        for lower in range(k, max(k - SUNK_LAYERS - 1, 0) - 1, -1):
            if lower not in fills:
                fills[lower] = self._fill(lower)
            filled = fills[lower].at(surface_mm[at], self.options.cell_mm) > 0.5
            if lower < k - 1:
                over.append(at[~filled])
                most_mm.append(np.full(len(over[-1]), self._strand_mm(lower + 1)))
            at = at[filled]
            if not len(at):
                break
        return np.concatenate(over), np.concatenate(most_mm)

    def _strand_mm(self, k: int) -> float:
        """How much lower a layer's strands lie where they hang."""
        mine = slice(int(self.first[k]), int(self.first[k + 1]))
        high_mm, section_mm2 = self.layer_mm[k : k + 1], self.section_mm2[mine]
        plastic = section_mm2 * np.linalg.norm(self.end_mm[mine] - self.start_mm[mine], axis=1)
        order = np.argsort(section_mm2)
        half = np.searchsorted(np.cumsum(plastic[order]), 0.5 * plastic.sum())
        width_mm = section_mm2[order[half : half + 1]] / high_mm
        return float(strands_hang_lower_mm(width_mm, high_mm)[0])

    def _walls(
        self,
        k: int,
        fill: _Fill,
        below: _Fill | None,
        which: Int[np.ndarray, " w"],
        found: _Found,
    ) -> None:
        """How far a layer pushes walls out that lie in it, over it or under it."""
        o, h = self.options, float(self.layer_mm[k])
        share = np.full(len(which), o.push_beads)
        if below is not None:
            inside = found.surface_mm[which, :2] + 0.5 * o.blur_mm * found.inward[which]
            share[below.at(inside, o.cell_mm) < 0.5] = o.push_strands
        pushed, back = kernels.pushed_out(
            fill.ratio, fill.widest_mm, fill.corner_mm, o.cell_mm,
            found.surface_mm[which, :2], found.inward[which],
            1.0 + o.flow_ratio, o.blur_mm, o.reach_mm, share,
        )  # fmt: skip
        found.high[which] = np.fmax(found.high[which], pushed)
        own = np.abs(found.surface_mm[which, 2] - self.top_mm[k] + 0.5 * h) <= 0.5 * h + 1e-6
        found.low[which[own]] = np.fmax(found.low[which[own]], -back[own])

    def _tops(self, k: int, fill: _Fill, which: Int[np.ndarray, " w"], found: _Found) -> None:
        """Tops lie where the layer that is rounded to them does, a little off by its own plastic.

        What earlier layers had no room for went aside: the nozzle's flat levels every layer.
        """
        o, h = self.options, float(self.layer_mm[k])
        mm = fill.at(found.surface_mm[which], o.cell_mm) * h
        over = float(self.top_mm[k]) - found.surface_mm[which, 2]
        near = mm > 0.5 * h
        at, over, spare = which[near], over[near], mm[near] - h
        found.low[at] = over + np.minimum(spare, 0.0)
        found.high[at] = over + np.clip(spare, 0.0, o.rise_layers * h)

    def _undersides(self, k: int, fill: _Fill, which: Int[np.ndarray, " w"], found: _Found) -> None:
        """Undersides lie where the lowest layer's strands hang, and sag a little."""
        o, h = self.options, float(self.layer_mm[k])
        laid = fill.at(found.surface_mm[which], o.cell_mm) > 0.5
        at = which[laid & ~np.isfinite(found.low[which])]
        hangs = float(self.height_mm[self.first[k] : self.first[k + 1]].max())
        under = found.surface_mm[at, 2] - float(self.top_mm[k])
        found.low[at] = under + h
        found.high[at] = under + max(hangs, h) + o.sag_layers * h

    def _fill(self, k: int) -> _Fill:
        """A layer's plastic over its room, averaged."""
        beads = slice(int(self.first[k]), int(self.first[k + 1]))
        name = int(self.index[k]), beads.stop - beads.start
        return self.kept.get(name, lambda: self._filled(k, beads))

    def _filled(self, k: int, which: slice) -> _Fill:
        o = self.options
        start, end, section = self.start_mm[which], self.end_mm[which], self.section_mm2[which]
        h = float(self.layer_mm[k])
        wide = section / h
        margin = 0.5 * float(wide.max()) + o.blur_mm + 2 * o.cell_mm
        low = np.minimum(start, end).min(axis=0)[:2] - margin
        size = np.maximum(start, end).max(axis=0)[:2] + margin - low
        nx, ny = (int(n) for n in np.ceil(size / o.cell_mm))
        volume, widest = kernels.plastic(start, end, section, wide, low, o.cell_mm, ny, nx)
        over = 2 * int(0.5 * o.blur_mm / o.cell_mm) + 1
        ratio = kernels.averaged(volume / (o.cell_mm**2 * h), over)
        return _Fill(ratio, widest.astype(np.float32), low)
