"""Layers that came out thin and lie under sound ones: told by how far their walls stand in.

A bead that gets a share f of its plastic at its layer's height is f of its width wide. So a wall of
such a layer stands in by (1 - f) w / 2 against those of the layers around it, and what the layer
lacks lies inside, in pores and grooves that later layers have closed over: no look from above sees
it any more. Each place of the walls is held against the same place in the layers around, so that
neither a notch nor a scanner's error on one wall counts; and against where it is expected, since
layers that got more plastic than they have room for bulge, and those beside them do not. Layers of
a sound job differ by themselves, too: their own scatter is what a run of layers is held against, at
a stated rate of false alarms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import stdtrit

from amrepair.arrays import Mask, Points, Values
from amrepair.field.groups import cell_numbers
from amrepair.frames import cells_of, in_box, unit_vectors
from amrepair.loop.looks import Look, Stop
from amrepair.observe.robust import sigma_by_median
from amrepair.regions import Label
from amrepair.repair import RepairPlan
from amrepair.repair.plan import CoveredLayers
from amrepair.template.port import Template
from gcode.reader import Job
from gcode.reader.job import Beads
from gcode.slicing.patch import PatchRegion


@dataclass(frozen=True, slots=True)
class ThinLayersOptions:
    """What it takes to tell that layers lack plastic that nobody sees any more.

    Attributes
    ----------
    false_alarm
        Probability that a look at a sound job tells of such layers.
    least_lacking
        Of its plastic, what a layer lacks that is told of. Where a solid layer has a tenth less,
        its walls stand in by as much as if a quarter lacked: what has no room goes there.
    least_share
        Of what a run lacks on average, what each of its layers does at least.
    fewest_layers, most_layers
        The shortest and the longest run of thin layers that is looked for: the walls of a single
        one stand in where a slicer rounds a height.
    around_layers
        So many layers below a run, and above it, tell how far sound ones stand in.
    least_layers
        Of these, what is needed to tell how they differ.
    lowest_layers, rim_layers
        So many layers above the bed do not count, where the first is pressed wide; nor so many
        below what was printed last, whose walls go over into its rim.
    known_mm, known_layers
        How far the walls of sound layers differ, as a standard deviation, and how many layers that
        is worth: printers' axes waver by one or two hundredths of a millimetre.
    patch_mm
        Beyond it neither a bead's waver nor a scanner's errors hang together.
    least_patches
        Of a layer that tells something.
    wall_cosine
        Steepness of a wall.
    near_mm
        What lies farther off is no bead that is thin.
    hole_mm
        A thin bead's wall stands in by half its width at most. What is deeper than a whole one is a
        hole, whose floor lies inside of the walls around it.
    most_points
        That are looked at.
    """

    false_alarm: float = 1e-3
    least_lacking: float = 0.3
    least_share: float = 0.5
    fewest_layers: int = 2
    most_layers: int = 12
    around_layers: int = 10
    least_layers: int = 4
    lowest_layers: int = 2
    rim_layers: int = 2
    known_mm: float = 0.015
    known_layers: int = 10
    patch_mm: float = 2.0
    least_patches: int = 8
    wall_cosine: float = 0.4
    near_mm: float = 1.0
    hole_mm: float = 0.45
    most_points: int = 40_000


DEFAULT_THIN = ThinLayersOptions()
"""What the loop goes by."""


@dataclass(frozen=True, slots=True)
class ThinLayers:
    """A run of layers, first to last, that lack a share of their plastic.

    `sigma` is the standard deviation of that share.
    """

    first: int
    last: int
    lacking: float
    sigma: float


def with_covered(
    plan: RepairPlan,
    job: Job,
    expected: Template,
    stop: Stop,
    looks: Sequence[Look] = (),
    options: ThinLayersOptions = DEFAULT_THIN,
) -> RepairPlan:
    """The plan with the layers that lack plastic under later ones, where their walls tell of any.

    Plastic is neither lost nor made: what these layers lack is seen missing over them, was filled
    at an earlier stop, or is covered.

    Parameters
    ----------
    expected
        What the plan's scan was compared with.
    looks
        The earlier looks. Those at this stop count as nothing; layers that one at another stop saw
        from above, or told of, are not told of again.
    """
    before = [look for look in looks if look.stop != stop]
    thin = thin_layers(*_on_part(plan, expected, options), job, stop, options)
    if thin is None:
        return plan
    told = [look.plan.covered.last for look in before if look.plan.covered is not None]
    told += [look.stop.layer_index for look in before if look.stop.layer_index is not None]
    first = max([thin.first, *(layer + 1 for layer in told if thin.first <= layer <= thin.last)])
    if first > thin.last:
        return plan
    beads = job.beads.subset((job.beads.layer >= first) & (job.beads.layer <= thin.last))
    low_mm = job.layers[first].z_mm - job.layers[first].height_mm
    open_mm3 = thin.lacking * beads.volume_mm3 - _seen_mm3(plan, low_mm)
    filled = [look for look in before if look.printed and look.stop.z_mm > low_mm]
    open_mm3 -= sum(look.plan.patch.reachable_mm3 for look in filled if look.plan.patch is not None)
    if open_mm3 <= 0.0:
        return plan
    ends_mm = np.concatenate([beads.start_mm, beads.end_mm])
    (x0, y0, _), (x1, y1, z1) = ends_mm.min(axis=0).tolist(), ends_mm.max(axis=0).tolist()
    piece = PatchRegion(open_mm3, (x0, y0, low_mm, x1, y1, z1), 0.0)
    return replace(plan, covered=CoveredLayers(first, thin.last, thin.lacking, piece))


def _seen_mm3(plan: RepairPlan, low_mm: float) -> float:
    """Volume of what is seen missing above a height, build frame."""
    return float(
        sum(
            region.volume_mm3
            for region in plan.deficit.regions
            if region.label is Label.MISSING and region.box_mm[1, 2] > low_mm
        )
    )


def _on_part(
    plan: RepairPlan, expected: Template, options: ThinLayersOptions
) -> tuple[Points, Values, Points]:
    """Points of the scan near the part, build frame; how far out they lie; which way is out.

    None of where more than a bead is gone: a hole's floor lies inside of the part's walls, too.
    """
    points_mm, deviation_mm = plan.anomaly.points_mm, plan.anomaly.deviation_mm
    near = np.flatnonzero(np.abs(deviation_mm) < options.near_mm)
    near = near[:: max(1, -(-len(near) // options.most_points))]
    placed = plan.build_from_template
    place_mm = placed.apply(points_mm[near])
    wall = ~_by_holes(plan, place_mm, options)
    near, place_mm = near[wall], place_mm[wall]
    outward = placed.rotate(unit_vectors(expected.distance_and_gradient(points_mm[near])[1]))
    return place_mm, deviation_mm[near], outward


def _by_holes(plan: RepairPlan, place_mm: Points, options: ThinLayersOptions) -> Mask:
    """(n,) which places are in the box of a hole, or beside it by no more than is tolerated."""
    beside_mm = plan.deficit.tolerance_mm
    within = np.zeros(len(place_mm), dtype=bool)
    for region in plan.deficit.regions:
        if region.label is Label.MISSING and region.depth_mm > options.hole_mm:
            low, high = region.box_mm
            within |= in_box(place_mm, low - beside_mm, high + beside_mm)
    return within


def thin_layers(
    place_mm: Points,
    deviation_mm: Values,
    outward: Points,
    job: Job,
    stop: Stop,
    options: ThinLayersOptions = DEFAULT_THIN,
) -> ThinLayers | None:
    """The run of layers whose walls stand in the most clearly, if those of any do.

    Parameters
    ----------
    place_mm, deviation_mm, outward
        (n, 3), (n,), (n, 3) points on the part, build frame; how far out of what is expected they
        lie; and which way is out there.
    stop
        Before which the job's layers were laid. The last of them are seen from above, and no run
        ends in them.
    """
    turn = job.turn_at(stop.line)
    beads = job.beads
    laid = (beads.line < stop.line) & (beads.layer >= turn.first_layer)
    if not laid.any():
        return None
    last = int(beads.layer[laid].max())
    tops_mm = np.array([one.z_mm for one in job.layers[turn.first_layer : last + 1]])
    width_mm = _widths_mm(beads, laid, turn.first_layer, len(tops_mm))
    walls = _Walls.of(place_mm, deviation_mm, outward, tops_mm, width_mm, options)
    found = _clearest(walls, width_mm, options)
    if found is None:
        return None
    return replace(found, first=found.first + turn.first_layer, last=found.last + turn.first_layer)


def _widths_mm(
    beads: Beads, laid: Bool[np.ndarray, " n"], first: int, count: int
) -> Float[np.ndarray, " k"]:
    """(k,) the median width of each layer's beads."""
    layer, width_mm = beads.layer[laid] - first, beads.width_mm[laid]
    whole_mm = float(np.median(width_mm))
    own = [width_mm[layer == k] for k in range(count)]
    return np.array([float(np.median(each)) if len(each) else whole_mm for each in own])


@dataclass(frozen=True, slots=True)
class _Walls:
    """How far walls stand in, summed up by patch and layer; how many points that is of.

    Sums run over the layers, with a zero before the first.
    """

    total_mm: Float[np.ndarray, "p k1"]
    count: Float[np.ndarray, "p k1"]

    @classmethod
    def of(
        cls,
        place_mm: Points,
        deviation_mm: Values,
        outward: Points,
        tops_mm: Float[np.ndarray, " k"],
        width_mm: Float[np.ndarray, " k"],
        options: ThinLayersOptions,
    ) -> _Walls:
        """Of points; one that lies off by more than a bead's width is of no bead that is thin."""
        layer = np.searchsorted(tops_mm, place_mm[:, 2])
        wall = (np.abs(outward[:, 2]) < options.wall_cosine) & (layer < len(tops_mm))
        wall[wall] = np.abs(deviation_mm[wall]) < width_mm[layer[wall]]
        layer, way = layer[wall], outward[wall, :2]
        quarter = np.round(np.arctan2(way[:, 1], way[:, 0]) / (0.5 * np.pi)).astype(np.int64) % 4
        cell = cells_of(place_mm[wall, :2], 0.0, options.patch_mm)
        patch = cell_numbers(np.column_stack([cell, quarter]))
        shape = (int(patch.max(initial=-1)) + 1, len(tops_mm))
        of = patch * shape[1] + layer
        count, total_mm = (
            np.bincount(of, weights=weights, minlength=shape[0] * shape[1]).reshape(shape)
            for weights in (None, -deviation_mm[wall])
        )
        return cls(*(np.pad(np.cumsum(each, axis=1, dtype=float), ((0, 0), (1, 0)))
                     for each in (total_mm, count)))  # fmt: skip

    def over_mm(self, own: tuple[int, int], around: Sequence[tuple[int, int]], least: int) -> float:
        """How far layers [first, end) stand in against others: the median of the patches.

        Each patch is held against itself, so that neither its place nor a notch in some of them
        counts. NaN where fewer than `least` are seen in both.
        """
        mine_mm, mine = self._sum(*own)
        rest = [self._sum(*each) for each in around]
        other_mm, other = (np.sum(each, axis=0) for each in zip(*rest, strict=True))
        both = (mine > 0) & (other > 0)
        if both.sum() < least:
            return float("nan")
        return float(np.median(mine_mm[both] / mine[both] - other_mm[both] / other[both]))

    def in_mm(self, own: tuple[int, int], least: int) -> float:
        """How far layers [first, end) stand in of where they are expected: the patches' median.

        NaN where fewer than `least` are seen.
        """
        total_mm, count = self._sum(*own)
        seen = count > 0
        if seen.sum() < least:
            return float("nan")
        return float(np.median(total_mm[seen] / count[seen]))

    def _sum(self, first: int, end: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        return (
            self.total_mm[:, end] - self.total_mm[:, first],
            self.count[:, end] - self.count[:, first],
        )


def _clearest(
    walls: _Walls, width_mm: Float[np.ndarray, " k"], options: ThinLayersOptions
) -> ThinLayers | None:
    """The run of layers that stands in the most clearly against those around it.

    How layers differ by themselves is told by those around, and by what is known beforehand, as if
    from so many more layers (a scaled inverse chi-squared prior).
    """
    best, clearest = None, 0.0
    count = len(width_mm) - options.rim_layers
    runs = [
        (first, end)
        for first in range(options.lowest_layers, count)
        for end in range(first + options.fewest_layers, min(first + options.most_layers, count) + 1)
    ]
    for first, end in runs:
        # of the layers next to a run points lie on both sides
        low = (max(options.lowest_layers, first - 1 - options.around_layers), first - 1)
        high = (end + 1, min(end + 1 + options.around_layers, count))
        around = [each for each in (low, high) if each[1] > each[0]]
        others = [k for each in around for k in range(*each)]
        if len(others) < options.least_layers:
            continue
        per_mm = 2.0 / float(width_mm[first:end].mean())
        # against either side: where walls go over from one level to another, they do not
        sides = [walls.over_mm((first, end), [side], options.least_patches) for side in around]
        # and against where they are to stand: sound layers that bulge make none beside them thin
        sides.append(walls.in_mm((first, end), options.least_patches))
        lacking = per_mm * min((each for each in sides if np.isfinite(each)), default=0.0)
        if lacking < options.least_lacking:
            continue
        each_mm = [walls.over_mm((k, k + 1), around, options.least_patches)
                   for k in (*range(first, end), *others)]  # fmt: skip
        own, sound = np.array(each_mm[: end - first]), np.array(each_mm[end - first :])
        sound = sound[np.isfinite(sound)]
        if not (per_mm * own >= options.least_share * lacking).all() or not len(sound):
            continue
        sigma = per_mm * _sigma_mm(sound, end - first, options)
        quantile = -float(
            stdtrit(len(sound) - 1 + options.known_layers, options.false_alarm / len(runs))
        )
        if lacking > quantile * sigma and lacking / sigma > clearest:
            best = ThinLayers(first, end - 1, min(lacking, 1.0), sigma)
            clearest = lacking / sigma
    return best


def _sigma_mm(sound_mm: Float[np.ndarray, " s"], layers: int, options: ThinLayersOptions) -> float:
    """Standard deviation of how far so many sound layers stand in against those around them."""
    freedom = len(sound_mm) - 1 + options.known_layers
    seen_mm = sigma_by_median(sound_mm)
    known = options.known_layers * options.known_mm**2
    spread_mm = np.sqrt(((len(sound_mm) - 1) * seen_mm**2 + known) / freedom)
    return float(spread_mm * np.sqrt(1.0 / layers + 1.0 / len(sound_mm)))
