"""Whether the layers from some one on lie aside of those below them: one model, two explanations.

What is seen from above is the top of the highest bead at each place. The model has two things free:
from which layer on all beads lie aside, by how much in X and Y; and which share of the height that
those layers should have is there, in any mix of shares over the layer. Unmoved, it explains layers
that are as planned, thin, or gone; moved, it explains layers that the motors have put elsewhere. Of
one look both are fitted, and the evidence of the moved one over the best unmoved one is told patch
by patch. Errors hang together within a patch and not beyond it: how much they do so the look tells
itself, and so of how many observations a patch is worth. Two things are asked of the evidence:

- There is enough of it for all the moves that were tried. Were the unmoved model true, a likelihood
  ratio of e^x would be as rare as e^-x (Markov's inequality; Vovk and Wang, "E-values", Annals of
  Statistics 49, 2021), however few the patches are that tell it: a slim part has not many.
- It is told by the patches at large, since neither model is quite true: its mean over the patches
  stands out from its own spread (Vuong's test of models that are not nested, Econometrica 57, 1989,
  with patches for observations). What some damage happens to explain is told by a few of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri, stdtr

from amrepair.arrays import Numbers, Points, Values
from amrepair.field.groups import cell_numbers
from amrepair.frames import cells_of
from amrepair.loop import layer_shift_kernels as kernels
from gcode.reader import Job
from gcode.surfaces.lines import heights_by_lines


@dataclass(frozen=True, slots=True)
class ShiftOptions:
    """What it takes to tell that layers lie aside.

    Attributes
    ----------
    false_alarm
        Probability that a look at layers which lie where they should tells a shift; and that
        patches which speak for neither explanation differ so much to one side: what passes only
        the first test is told by a few patches, as damage is.
    prior
        Of looks, the share at which layers have shifted: what evidence is held against, for how
        sure a shift is. What is no surer than as sure as not is looked at again.
    tolerance_mm
        So far aside any layer may lie, half a bead: backlash, registration. What views disagree by
        comes on top.
    reach_mm
        The farthest move that is tried, in X and in Y.
    step_mm, finest_mm
        Moves are tried so far apart at first (a bead's width), and at last.
    lateral_mm
        So far aside of its place a bead's edge, or a point of the scan, is found: its standard
        deviation in X and in Y.
    shares
        Of the height that the layers should have, which are there.
    whole
        Of the layer, what is taken to have all of its height before the look has told.
    mixing_steps
        So many steps of expectation and maximisation fit the mix of shares.
    stray
        Share of the points that lie anywhere.
    patch_mm
        Beyond it neither a bead's waver nor a scanner's errors hang together.
    least_patches
        Of a look that tells something.
    most_points, wall_points, points_per_up
        Points that are looked at from above, and of walls; of how many of the scan's for each that
        faces up.
    first_points, second_points
        How many of them at the first moves, and where the best of those are refined; only what
        those tell is looked at by all.
    first_layers, refined
        At first one in so many layers is tried as the first that lies aside; and so many of the
        best first moves are refined.
    column_mm, roof_mm
        Edge of a column, a bead and a half, in which what lies so far below the highest point is
        under a roof.
    cell_mm, most_cells
        Edge of a column; it grows where a plate would have more of them.
    layers_back, growth
        So many of the last layers are tried one by one, then in steps that grow by so much.
    """

    false_alarm: float = 1e-3
    prior: float = 1e-2
    tolerance_mm: float = 0.2
    reach_mm: float = 5.0
    step_mm: float = 0.4
    finest_mm: float = 0.05
    lateral_mm: float = 0.12
    shares: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    whole: float = 0.6
    mixing_steps: int = 12
    stray: float = 0.05
    patch_mm: float = 2.0
    least_patches: int = 20
    most_points: int = 6_000
    wall_points: int = 2_000
    points_per_up: int = 5
    first_points: int = 400
    second_points: int = 1_500
    first_layers: int = 3
    refined: int = 2
    column_mm: float = 0.7
    roof_mm: float = 0.6
    cell_mm: float = 0.1
    most_cells: int = 1_500_000
    layers_back: int = 8
    growth: float = 1.15


DEFAULT_SHIFT = ShiftOptions()
"""What the loop goes by."""
_AROUND = np.array([(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) if x or y])
_STAY = np.zeros_like(_AROUND)
# Of upper and lower layers: both together, the upper ones, the lower ones.
_MOVES_AROUND = np.block([[_AROUND, _AROUND], [_AROUND, _STAY], [_STAY, _AROUND]])


@dataclass(frozen=True, slots=True)
class LayerShift:
    """Layers that lie aside of those below.

    Attributes
    ----------
    layer
        The first of them, as near as the look tells.
    by_mm
        In X and in Y.
    p_value
        Probability of such evidence where nothing lies aside.
    confidence
        That it is there: the prior against such evidence where it is not.
    """

    layer: int
    by_mm: tuple[float, float]
    p_value: float
    confidence: float

    @property
    def size_mm(self) -> float:
        """How far aside."""
        return float(np.hypot(*self.by_mm))

    def told(self) -> str:
        """One sentence for people."""
        axes = [
            f"{size_mm:+.1f} mm in {axis}"
            for axis, size_mm in zip("XY", self.by_mm, strict=True)
            if abs(size_mm) >= 0.3 * self.size_mm
        ]
        return f"from layer {self.layer} on it lies aside of what is below, {' and '.join(axes)}"


@dataclass(frozen=True, slots=True)
class _Fit:
    """One explanation, with the mix of shares that fits best.

    `move` is that of the layers from `layer` on, in X and Y, and that of the layers below.
    """

    layer: int
    move: Float[np.ndarray, " 4"]
    log_density: Values

    @property
    def by_mm(self) -> Float[np.ndarray, " 2"]:
        """By what the upper layers lie aside of the lower ones, in X and Y."""
        return self.move[:2] - self.move[2:]

    @property
    def size_mm(self) -> float:
        return float(np.hypot(*self.by_mm))

    @property
    def total(self) -> float:
        return float(self.log_density.sum())


@dataclass(frozen=True, slots=True)
class Walls:
    """Points of upright walls, build frame: how far out they lie, and which way is out in X and Y.

    `sigma_mm` is the standard deviation of where sound walls lie.
    """

    place_mm: Points
    deviation_mm: Values
    outward: Float[np.ndarray, "w 2"]
    sigma_mm: float

    def some(self, every: int) -> Walls:
        """One in so many."""
        return Walls(
            self.place_mm[::every], self.deviation_mm[::every], self.outward[::every], self.sigma_mm
        )

    def log_density(
        self, cut_mm: float, moves: Float[np.ndarray, "m 4"], options: ShiftOptions
    ) -> Float[np.ndarray, "w m"]:
        """Of each point, by move; those above the cut lie aside by the move of the upper layers."""
        above = (self.place_mm[:, 2] > cut_mm)[:, None]
        told_mm = np.where(above, self.outward @ moves[:, :2].T, self.outward @ moves[:, 2:].T)
        off = (self.deviation_mm[:, None] - told_mm) / self.sigma_mm
        density = np.exp(-0.5 * off * off) / (self.sigma_mm * kernels.ROOT_TWO_PI)
        other = options.stray / (2.0 * options.reach_mm)
        return np.asarray(np.log((1.0 - options.stray) * density + other))


@dataclass(frozen=True, slots=True)
class _Seen:
    """Seen heights, and how high beads reach: all of them, and those before each layer; and walls.

    `place_mm` is from the rasters' corner.
    """

    place_mm: Points
    walls: Walls
    sigma_mm: float
    all_mm: Float[np.ndarray, "ny nx"]
    before_mm: dict[int, Float[np.ndarray, "ny nx"]]
    tops_mm: Float[np.ndarray, " layers"]
    cell_mm: float
    options: ShiftOptions

    @property
    def other(self) -> float:
        """Density of a height that may be anything."""
        return 1.0 / max(float(self.all_mm.max()), 1.0)

    @property
    def aside_mm(self) -> Float[np.ndarray, "a 2"]:
        """Three places that have the spread of `lateral_mm` in X and in Y."""
        turn = 2.0 * np.pi * np.arange(3) / 3.0
        return (
            np.sqrt(2.0) * self.options.lateral_mm * np.column_stack([np.cos(turn), np.sin(turn)])
        )

    def some(self, most: int) -> _Seen:
        """With fewer points, evenly."""
        every = max(1, -(-len(self.place_mm) // most))
        return replace(
            self,
            place_mm=np.ascontiguousarray(self.place_mm[::every]),
            walls=self.walls.some(every),
        )

    def cut_mm(self, layer: int) -> float:
        return float(0.5 * (self.tops_mm[layer] + self.tops_mm[layer - 1]))

    def evidence(
        self, layer: int, moves: Float[np.ndarray, "m 4"], weights: Values
    ) -> Float[np.ndarray, " m"]:
        """Of moves, with the same mix of shares."""
        o, cut_mm = self.options, self.cut_mm(layer)
        from_above = kernels.evidence(
            self.place_mm, self.aside_mm, self.all_mm, self.before_mm[layer], cut_mm,
            self.cell_mm, np.ascontiguousarray(moves), np.array(o.shares), weights,
            self.sigma_mm, o.stray, self.other,
        )  # fmt: skip
        return np.asarray(from_above + self.walls.log_density(cut_mm, moves, o).sum(axis=0))

    def fitted(self, layer: int, move: Float[np.ndarray, " 4"]) -> tuple[_Fit, Values]:
        """The best mix of shares at one move (expectation and maximisation), and what it leaves."""
        o, cut_mm = self.options, self.cut_mm(layer)
        by_share = kernels.densities(
            self.place_mm, self.aside_mm, self.all_mm, self.before_mm[layer], cut_mm,
            self.cell_mm, np.asarray(move, np.float64), np.array(o.shares), self.sigma_mm,
        )  # fmt: skip
        weights, other = self.mix, o.stray * self.other
        for _ in range(o.mixing_steps):
            density = (1.0 - o.stray) * (by_share @ weights) + other
            of_share = weights * (by_share.T @ (1.0 / density))
            weights = of_share / max(float(of_share.sum()), 1e-9)
        density = (1.0 - o.stray) * (by_share @ weights) + other
        beside = self.walls.log_density(cut_mm, move[None], o)[:, 0]
        return _Fit(layer, np.asarray(move), np.append(np.log(density), beside)), weights

    @property
    def mix(self) -> Values:
        """Shares as they are taken to be before the look has told: most of a layer is whole."""
        count = len(self.options.shares)
        rest = (1.0 - self.options.whole) / (count - 1)
        return np.array([*[rest] * (count - 1), self.options.whole])


def layer_shift(
    place_mm: Points,
    walls: Walls,
    noise_mm: float,
    job: Job,
    line: int,
    options: ShiftOptions = DEFAULT_SHIFT,
    *,
    regions: bool = True,
    between_views_mm: float = 0.0,
) -> LayerShift | None:
    """Which layers lie aside of those below, if any do.

    Parameters
    ----------
    place_mm
        (n, 3) points that face up, build frame.
    walls
        Points that face aside.
    noise_mm
        Standard deviation of a height: of the scan, and of beads that are as they should be.
    line
        The job's first line that is not yet printed.
    regions
        Whether something was found missing or too much. If not, tops are as they should be, and
        only walls can tell.
    between_views_mm
        Standard deviation between what views say of one place. Of the upper layers one view may
        show more, and of the lower ones another.
    """
    apart_mm = float(ndtri(1.0 - options.false_alarm)) * np.sqrt(2.0) * between_views_mm
    options = replace(options, tolerance_mm=float(np.hypot(options.tolerance_mm, apart_mm)))
    seen = _seen(place_mm, walls, noise_mm, job, line, options)
    if seen is None:
        return None
    patch = _patches(seen, options.patch_mm)
    if patch.max() + 1 < options.least_patches:
        return None
    by_walls = _by_walls(seen)
    if not regions and by_walls[0] < np.log(_moves_as_far(seen, options.step_mm)):
        return None
    fits = _fits(seen, *by_walls[1:])
    if fits is None or fits[0].size_mm <= options.tolerance_mm:
        return None
    moved, *rivals = fits
    kinds = (slice(0, len(seen.place_mm)), slice(len(seen.place_mm), None))
    worth = np.concatenate([_worth(moved.log_density[one], patch[one]) for one in kinds])
    rival = max(rivals, key=lambda fit: float(worth @ fit.log_density))
    gain = np.bincount(patch, worth * (moved.log_density - rival.log_density))
    spread = max(float(gain.std(ddof=1)) / np.sqrt(len(gain)), 1e-12)
    if float(stdtr(len(gain) - 1, -gain.mean() / spread)) > options.false_alarm:
        return None
    p_value = float(_moves_as_far(seen, moved.size_mm) * np.exp(-gain.sum()))
    if p_value > options.false_alarm:
        return None
    x_mm, y_mm = moved.by_mm.tolist()
    sure = options.prior / (options.prior + p_value)
    return LayerShift(moved.layer, (x_mm, y_mm), p_value, sure)


def _fits(
    seen: _Seen, by_walls: int, walls_move: Float[np.ndarray, " 4"]
) -> tuple[_Fit, ...] | None:
    """The best explanation with a move, and then those without; walls alone tell one to begin with.

    Without a move the part may lie as the best one says that the upper layers do, or the lower
    ones: what damage adds to the sum in a few places has pulled neither of them away. None where a
    part of the points tells that the move explains no more than as many moves do by chance.
    """
    some = seen.some(seen.options.second_points)
    first = _moved(some, by_walls, walls_move)
    if first.total - _unmoved(some).total < np.log(_moves_as_far(seen, first.size_mm)):
        return None
    moved = _best_layer(seen, _climbed(seen, first.layer, first.move, _MOVES_AROUND))
    moved, rival = _climbed(seen, moved.layer, moved.move, _MOVES_AROUND), _unmoved(seen)
    as_upper, as_lower = (
        seen.fitted(rival.layer, np.tile(one, 2))[0] for one in (moved.move[:2], moved.move[2:])
    )
    return moved, rival, as_upper, as_lower


def _moves_as_far(seen: _Seen, size_mm: float) -> float:
    """How many moves of this size are tried, from all layers on, times sizes: each has its share.

    So the rate of false alarms is spread evenly over sizes, and large moves, of which there are
    many, take nothing from small ones.
    """
    o = seen.options
    ring = max(1.0, np.ceil(size_mm / o.step_mm))
    return float(len(seen.before_mm) * (o.reach_mm / o.step_mm) * 2.0 * np.pi * ring)


def _seen(
    place_mm: Points, walls: Walls, noise_mm: float, job: Job, line: int, options: ShiftOptions
) -> _Seen | None:
    """What is seen and what the job planned, in columns; None before its second layer."""
    beads = job.beads
    laid = (beads.line < line) & (beads.layer >= 0)
    if not laid.any():
        return None
    start, end, layer = beads.start_mm[laid], beads.end_mm[laid], beads.layer[laid]
    half_mm = 0.5 * beads.width_mm[laid]
    last, first = int(layer.max()), int(layer.min())
    candidates = _layers(first, last, options)
    if not candidates:
        return None
    own = layer > first
    ends = np.concatenate([start[own, :2], end[own, :2]])
    low, high = ends.min(axis=0) - options.reach_mm, ends.max(axis=0) + options.reach_mm
    inside = ((place_mm[:, :2] > low) & (place_mm[:, :2] < high)).all(axis=1)
    if not inside.any():
        return None
    cell_mm = max(options.cell_mm, float(np.sqrt(np.prod(high - low) / options.most_cells)))
    nx, ny = np.ceil((high - low) / cell_mm).astype(int).tolist()
    top = np.maximum(start[:, 2], end[:, 2])

    def raster(which: np.ndarray) -> Float[np.ndarray, "ny nx"]:
        found = heights_by_lines(
            start[which], end[which], half_mm[which], top[which],
            low_mm=low, cell_mm=cell_mm, shape=(ny, nx),
        )  # fmt: skip
        return np.maximum(found, 0.0).astype(np.float32)  # beside them lies the bed

    before, done, below = {}, first, raster(layer < first)
    for k in candidates:
        below = np.maximum(below, raster((layer >= done) & (layer < k)))
        before[k], done = below, k
    every = np.maximum(below, raster(layer >= done))
    tops_mm = np.array([one.z_mm for one in job.layers])
    which = np.flatnonzero(inside & (place_mm[:, 2] < float(top.max()) + 1.0))
    which = which[:: max(1, -(-len(which) // options.most_points))]
    corner = np.array([*low, 0.0])
    walls = walls.some(max(1, -(-len(walls.place_mm) // options.wall_points)))
    walls = replace(walls, place_mm=walls.place_mm - corner)
    return _Seen(
        place_mm[which] - corner, walls, noise_mm, every, before, tops_mm, cell_mm, options
    )


def _layers(first: int, last: int, options: ShiftOptions) -> list[int]:
    """Layers from which a shift may begin, ascending; the first one has nothing below."""
    found, back = [], 0.0
    while last - int(back) > first:
        found.append(last - int(back))
        back = back + 1.0 if back < options.layers_back else options.growth * back
    return found[::-1]


def _patches(seen: _Seen, patch_mm: float) -> Numbers:
    """Of each point, walls after tops, the number of its patch."""
    place_mm = np.concatenate([seen.place_mm, seen.walls.place_mm])
    return cell_numbers(cells_of(place_mm, 0.0, patch_mm))


def _worth(log_density: Values, patch: Numbers) -> Values:
    """Of each point, what part of an independent observation it is, of one kind of surface.

    Errors that correlate by ρ leave n / (1 + (n - 1) ρ) of a patch's n points (Kish, "Survey
    Sampling", 1965, on design effects). A log density is the square of an error, and squares of
    normal errors correlate by ρ²: the share of their variance that lies between patches, as the
    analysis of variance tells it.
    """
    _, patch = np.unique(patch, return_inverse=True)
    count = np.bincount(patch).astype(np.float64)
    points, patches = len(patch), len(count)
    if not 1 < patches < points:
        return np.asarray(1.0 / count[patch])
    mean = np.bincount(patch, log_density) / count
    within = float(((log_density - mean[patch]) ** 2).sum()) / (points - patches)
    between = float((count * (mean - log_density.mean()) ** 2).sum()) / (patches - 1)
    usual = (points - float((count**2).sum()) / points) / (patches - 1)
    share = (between - within) / max(between + (usual - 1.0) * within, 1e-12)
    together = float(np.sqrt(np.clip(share, 0.0, 1.0)))
    return np.asarray(1.0 / (1.0 + (count[patch] - 1.0) * together))


def _by_walls(seen: _Seen) -> tuple[float, int, Float[np.ndarray, " 4"]]:
    """How much more of the walls alone small moves of upper and lower ones explain than one of all.

    From which layer on, and the moves. Far moves tell nothing here: walls are held against the
    nearest surface.
    """
    o = seen.options
    far = 0.5 * o.step_mm * np.arange(-4.0, 5.0)
    by = np.array([(x, y) for x in far for y in far])
    told = seen.walls.log_density(0.0, np.hstack([by, by]), o)
    fits: list[tuple[float, int, Float[np.ndarray, " 4"]]] = []
    for layer in seen.before_mm:
        above = seen.walls.place_mm[:, 2] > seen.cut_mm(layer)
        upper, lower = told[above].sum(axis=0), told[~above].sum(axis=0)
        one, other = int(upper.argmax()), int(lower.argmax())
        gain = float(upper[one] + lower[other] - (upper + lower).max())
        fits.append((gain, layer, np.concatenate([by[one], by[other]])))
    return max(fits, key=lambda fit: fit[0])


def _moved(seen: _Seen, by_walls: int, walls_move: Float[np.ndarray, " 4"]) -> _Fit:
    """The best explanation by layers that lie aside of those below.

    The scan was registered to both of them: it may lie as either does, or between. What all walls
    tell is one of the moves to begin with.
    """
    o = seen.options
    far = np.arange(-o.reach_mm, o.reach_mm + 0.5 * o.step_mm, o.step_mm)
    by = np.array([(x, y) for x in far for y in far])
    grid = np.vstack([np.hstack([by, 0.0 * by]), np.hstack([0.0 * by, -by])])
    few, mix, layers = seen.some(o.first_points), seen.mix, [*seen.before_mm]
    first: list[tuple[float, Float[np.ndarray, " 4"]]] = []
    for layer in layers[:: -o.first_layers]:
        told = few.evidence(layer, grid, mix)
        best_of = [int(part.argmax()) for part in told.reshape(2, -1)]
        first += [(float(told[k]), grid[k]) for k in (best_of[0], len(by) + best_of[1])]
    fits = [_climbed(seen, by_walls, walls_move, _MOVES_AROUND)]
    for _, move in sorted(first, key=lambda one: -one[0])[: o.refined]:
        told_by = [few.evidence(layer, move[None], mix)[0] for layer in layers]
        fits.append(_climbed(seen, layers[int(np.argmax(told_by))], move, _MOVES_AROUND))
    return max(fits, key=lambda fit: fit.total)


def _best_layer(seen: _Seen, fit: _Fit) -> _Fit:
    """The same move, from the layer on that explains the most."""
    fits = [seen.fitted(layer, fit.move)[0] for layer in seen.before_mm]
    return max(fits, key=lambda one: one.total)


def _unmoved(seen: _Seen) -> _Fit:
    """The best explanation by layers that lie over those below, within the tolerance."""
    best = _best_layer(seen, _Fit(0, np.zeros(4), np.zeros(0)))
    best = _climbed(seen, best.layer, best.move, _MOVES_AROUND[:8])
    ring = (
        seen.options.tolerance_mm
        * _MOVES_AROUND[8:16]
        / np.linalg.norm(_MOVES_AROUND[:8], axis=1)[:, None]
    )
    near = [seen.fitted(best.layer, best.move + move)[0] for move in ring]
    return max([best, *near], key=lambda fit: fit.total)


def _climbed(
    seen: _Seen, layer: int, move: Float[np.ndarray, " 4"], ways: Float[np.ndarray, "w 4"]
) -> _Fit:
    """From one move to the best near it, in steps that get finer."""
    fit, weights = seen.fitted(layer, move)
    step_mm, total = 0.5 * seen.options.step_mm, -np.inf
    while step_mm > 0.99 * seen.options.finest_mm:
        around = fit.move + step_mm * np.vstack([np.zeros(4), ways])
        # beyond it the rasters end
        around = around[(np.abs(around) <= seen.options.reach_mm).all(axis=1)]
        told = seen.evidence(layer, around, weights)
        if told.argmax() and told.max() > total:
            total = float(told.max())
            fit, weights = seen.fitted(layer, around[int(told.argmax())])
        else:
            step_mm *= 0.5
    return fit
