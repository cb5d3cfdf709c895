"""Where the part stands in a job, and how often: its template registered to the job's own beads.

It reads the job, not the bed: nothing is measured here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.align import align
from amrepair.arrays import Box, Mask, Numbers, PlanePoints, Points, Values
from amrepair.errors import AlignmentError
from amrepair.field.groups import cell_numbers
from amrepair.frames import Transform, box_of, rotation_from_vector
from amrepair.loop.outlines import outermost
from amrepair.scans import Scan
from amrepair.template import StoodTemplate
from amrepair.template.port import Template
from gcode.meshes import box_of_solid
from gcode.progress import Progress, silent
from gcode.reader import Beads, Job
from gcode.stretches import places_along
from gcode.surfaces.lines import columns_around, near_lines

# Names of the outermost bead: PrusaSlicer and SuperSlicer, OrcaSlicer and Bambu, Cura and
# ideaMaker, Simplify3D, KISSlicer.
OUTER_WALLS = frozenset(
    {
        "external perimeter", "overhang perimeter", "outer wall", "wall-outer", "outer perimeter",
        "perimeter path",
    }
)  # fmt: skip
# What takes the plastic that a change of filament pushes out, and what else lies beside a part and
# is none of it; the same slicers' names.
TOWERS = frozenset({"wipe tower", "prime tower", "prime-tower", "prime pillar", "pillar path"})
BESIDE_THE_PART = TOWERS | frozenset(
    {
        "skirt", "brim", "skirt/brim", "support material", "support material interface", "support",
        "support interface", "support transition", "support-interface", "custom", "skirt path",
        "support path", "brim path",
    }
)  # fmt: skip
THING_STEP_MM, THING_CELL_MM = 0.8, 0.2
# By more, a job lays its walls elsewhere than its part has them: 42 that do not, by 0.03 at most.
MOVED_MM, MOST_MOVES = 0.04, 5
# What users and makers of filaments tell slicers: hundredths of a millimetre, tenths of a per cent.
USUAL_MOVE_MM, USUAL_STRETCH = 0.1, 0.005
WALLS_TELL_RATIO = 0.3  # how exactly all walls together tell it, of a usual move
EVEN_MM = 4.0  # a slicer moves a fuzzy skin's points, 0.8 mm apart, each as it likes
MOST_STRETCH = 0.02  # polypropylene's; more is another scale
# Of its height, a bead is wider by so much than a rectangle: half of what round sides make, since
# some slicers reckon with those and some without.
BEAD_SIDES_RATIO = 0.5 * (1.0 - math.pi / 4.0)
OFF_LAYERS = 1.5  # walls tell the height to about a layer; a raft has two and more
FLAT = 0.1  # of a top's or a bottom's normal along the layers: within 6 degrees
UPRIGHT_SIDE = 0.5  # of a side's normal along Z: steeper than 60 degrees
UPRIGHT = math.cos(math.radians(0.5))  # walls of a low part tell its tilt to a third of a degree


@dataclass(frozen=True, slots=True)
class _Inset:
    """A template shrunk by `depth_mm` (`Template`, as far as an alignment asks it).

    Where it is known which way is `up`, along its layers, as slicers lay walls: of a slope that is
    less across it, by its sine. Under a flat top and over a flat bottom it is `high_mm`, half a
    layer, whatever the wall.
    """

    whole: Template
    depth_mm: float
    high_mm: float
    up: Float[np.ndarray, " 3"] | None = None

    @property
    def bounds_mm(self) -> Box:
        return self.whole.bounds_mm

    @property
    def bias_mm(self) -> float:
        return self.whole.bias_mm

    def distance(self, points_mm: Points) -> Values:
        if self.up is not None:
            return self.distance_and_gradient(points_mm)[0]
        return self.whole.distance(points_mm) + self.depth_mm

    def distance_and_gradient(self, points_mm: Points) -> tuple[Values, Points]:
        distance, gradient = self.whole.distance_and_gradient(points_mm)
        if self.up is None:
            return distance + self.depth_mm, gradient
        level = self.level(gradient)
        return distance + np.where(level < FLAT, self.high_mm, self.depth_mm * level), gradient

    def level(self, gradient: Points) -> Values:
        """(n,) how much of a move along a layer is across each surface."""
        if self.up is None:
            return np.ones(len(gradient))
        return np.sqrt(np.maximum(1.0 - (gradient @ self.up) ** 2, 0.0))

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        points, normals = self.whole.surface_points(spacing_mm)
        return points - self.depth_mm * normals, normals

    def solid(self) -> Any:
        return self.whole.solid()


def locate_part(job: Job, template: Template, *, layer_height_mm: float) -> Transform:
    """Where the only copy of a part stands in a job (`locate_parts`).

    Raises
    ------
    AlignmentError
        As `locate_parts`, and where there are more copies.
    """
    placed = locate_parts(job, template, layer_height_mm=layer_height_mm)
    if len(placed) > 1:
        raise AlignmentError(f"the job prints {len(placed)} copies of the part, not one")
    return placed[0]


class Located(NamedTuple):
    """One thing that a job prints: which of the templates it is of, and build from template."""

    which: int
    pose: Transform


def locate_parts(
    job: Job, template: Template, *, layer_height_mm: float, progress: Progress = silent
) -> tuple[Transform, ...]:
    """Where the part stands in a job, every copy of it (`locate_plate`).

    Returns
    -------
    tuple of Transform
        build from template, in the order in which they are begun.

    Raises
    ------
    AlignmentError
        As `locate_plate`.
    """
    found = locate_plate(job, (template,), layer_height_mm=layer_height_mm, progress=progress)
    return tuple(one.pose for one in found)


def locate_plate(
    job: Job,
    templates: Sequence[Template],
    *,
    layer_height_mm: float,
    progress: Progress = silent,
) -> tuple[Located, ...]:
    """What a job prints and where: each thing is of one of the templates, by the job's own beads.

    What is connected as seen from above is one thing, skirts, brims and supports left aside, and
    in jobs that name no roles what is one layer high beside what is higher. The
    centre lines of the outer walls lie half a bead inside the part, so they are registered to that
    level of its field. Of poses that fit alike the part is turned least; of templates that fit, the
    one counts whose walls and the job's leave the least of each other unmet.

    Returns
    -------
    tuple of Located
        In the order in which they are begun.

    Raises
    ------
    AlignmentError
        If walls fit no template to half a layer: another part, another scale, or one that
        stands beside ours.
    """
    beads = job.beads
    ours = (beads.layer >= 0) & ~of_roles(beads, BESIDE_THE_PART)
    outer = ours & of_roles(beads, OUTER_WALLS)
    pick = outer if outer.any() else ours
    half_mm = _half_bead_mm(beads, pick)
    thing = _things(beads.start_mm[ours, :2], beads.end_mm[ours, :2], half_mm)
    if not outer.any():
        higher = _of_what_rises(beads.layer[ours], thing)
        ours[ours] = higher
        thing = np.unique(thing[higher], return_inverse=True)[1]
        pick = outermost(beads, ours, half_mm)
    count = int(thing.max(initial=-1)) + 1
    if _seem_several(templates):
        thing[:], count = 0, 1
    of_pick = thing[pick[ours]]
    high_mm = _half_high_mm(beads, pick)
    insets = [_Inset(template, half_mm, high_mm) for template in templates]
    found: list[Located] = []
    for k in range(count):
        progress("locate", float(k), float(count))
        walls = _walls(beads, np.flatnonzero(pick)[of_pick == k])
        try:
            found.append(_place_one_of(walls, insets, layer_height_mm, found))
        except AlignmentError as error:
            if count == 1:
                raise
            raise _not_of(templates, count, k, error) from error
    progress("locate", float(count), float(count))
    layers = [int(beads.layer[ours][thing == k].min(initial=0)) for k in range(count)]
    stands = []
    for (which, placed), layer in zip(found, layers, strict=True):
        template, begins_mm = templates[which], _begins_mm(job, layer)
        upright = _untilted(placed, template, 0.5 * layer_height_mm)
        stands.append(Located(which, _on_foot(upright, template, begins_mm, layer_height_mm)))
    return tuple(stands)


def _seem_several(templates: Sequence[Template]) -> bool:
    """Whether the only part seems to be several things, as seen from above."""
    bodies = [len(template.solid().decompose()) for template in templates]
    if len(bodies) > 1 and max(bodies) > 1:
        raise AlignmentError(
            f"the {_nth(int(np.argmax(bodies)) + 1)} of {len(bodies)} templates is of "
            f"{max(bodies)} bodies that lie apart, and which of a job's things are its own does "
            "not show; give each body a template of its own, or one template of all that the job "
            "prints"
        )
    return max(bodies) > 1


def _not_of(
    templates: Sequence[Template], count: int, k: int, error: AlignmentError
) -> AlignmentError:
    """What is said where one of a job's things is of no template."""
    things = f"the job prints {count} things apart from each other, and the {_nth(k + 1)} of them"
    if len(templates) > 1:
        return AlignmentError(f"{things} fits none of the {len(templates)} templates ({error})")
    return AlignmentError(
        f"{things} does not fit the template ({error}); name a folder of templates, one of each "
        "part that the job prints, as --template"
    )


def stood(template: Template, placed: tuple[Transform, ...]) -> tuple[Template, Transform]:
    """The template as a job lays it on the bed, with its Z upright, and where that stands.

    One copy that is only turned about Z stays as it is; else the frame is the bed's own.
    """
    return stood_plate((template,), tuple(Located(0, pose) for pose in placed))


def stood_plate(
    templates: Sequence[Template], found: Sequence[Located]
) -> tuple[Template, Transform]:
    """As `stood`, of all that a job prints."""
    if len(found) == 1 and is_upright(found[0].pose):
        return templates[found[0].which], found[0].pose
    parts = tuple(templates[one.which] for one in found)
    stands = StoodTemplate.of_parts(parts, tuple(one.pose for one in found))
    return stands, Transform.identity("build", "template")


def is_upright(placed: Transform) -> bool:
    """Whether a pose has no tilt: the part lies as its own file has it."""
    return bool(placed.matrix[2, 2] > UPRIGHT)


def of_roles(beads: Beads, names: frozenset[str]) -> Mask:
    """Which beads have one of some roles."""
    which = [k for k, name in enumerate(beads.roles) if name.lower() in names]
    return np.isin(beads.role, which)


def _things(start_mm: PlanePoints, end_mm: PlanePoints, half_mm: float) -> Numbers:
    """(n,) to which of the connected things, seen from above, each bead belongs; as they begin."""
    low, shape = columns_around(start_mm, end_mm, 2.0, THING_CELL_MM)
    covered = near_lines(
        start_mm, end_mm, half_mm + 0.5 * THING_CELL_MM,
        low_mm=low, cell_mm=THING_CELL_MM, shape=shape,
    )  # fmt: skip
    groups, _ = ndimage.label(covered, structure=np.ones((3, 3)))
    x, y = np.floor((0.5 * (start_mm + end_mm) - low) / THING_CELL_MM).astype(np.int64).T
    mine = groups[y, x]
    _, first, number = np.unique(mine, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]


def _of_what_rises(layer: Numbers, thing: Numbers) -> Mask:
    """Whose thing has more than one layer: a skirt has one; all, where none has more."""
    every = range(int(thing.max(initial=-1)) + 1)
    rises = ndimage.maximum(layer, thing, every) > ndimage.minimum(layer, thing, every)
    return rises[thing] if rises.any() else np.ones(len(thing), bool)


def _walls(beads: Beads, which: Int[np.ndarray, " w"]) -> Scan:
    """Points along the middles of some beads."""
    points, owner = places_along(beads.start_mm[which], beads.end_mm[which], THING_STEP_MM)
    points[:, 2] -= 0.5 * beads.height_mm[which][owner]
    return Scan(points, 0.05, "build", source="the job's walls")


def _place_one_of(
    walls: Scan, insets: Sequence[_Inset], layer_height_mm: float, found: Sequence[Located]
) -> Located:
    """Which of the templates walls are of, and where it stands."""
    fits: list[tuple[float, Located]] = []
    for k, inset in enumerate(insets):
        like = next((one.pose for one in found if one.which == k), None)
        try:
            placed = Located(k, _place(walls, inset, layer_height_mm, like))
        except AlignmentError:
            if len(insets) == 1:
                raise
            continue
        fits.append((_unmet_ratio(walls, inset, placed.pose) if len(insets) > 1 else 0.0, placed))
    if not fits:
        raise AlignmentError("its walls lie on those of no template, at their scale")
    return min(fits, key=lambda fit: fit[0])[1]


def _unmet_ratio(walls: Scan, inset: _Inset, placed: Transform) -> float:
    """The share of a job's walls that are none of a part's, and of the part's that the job lacks.

    A hole more or less is all that some parts differ by.
    """
    off_mm = np.abs(inset.distance(placed.inverse().apply(walls.points_mm)))
    surface, normals = inset.surface_points(THING_STEP_MM)
    sides = np.abs(placed.rotate(normals)[:, 2]) < UPRIGHT_SIDE
    apart_mm = cKDTree(walls.points_mm).query(placed.apply(surface[sides]))[0]
    lacks = apart_mm > THING_STEP_MM
    return float((off_mm > inset.depth_mm).mean()) + float(lacks.mean() if len(lacks) else 0.0)


def _place(walls: Scan, inset: _Inset, layer_height_mm: float, like: Transform | None) -> Transform:
    """Where one copy stands: as another one beside it, or in any way."""
    if like is not None:
        centre = 0.5 * inset.bounds_mm.sum(axis=0)
        away = box_of(walls.points_mm).mean(axis=0) - like.apply(centre[None])[0]
        beside = like.matrix.copy()
        beside[:2, 3] += away[:2]
        with suppress(AlignmentError):
            guess = Transform("build", "template", beside).inverse()
            there = align(walls, inset, guess=guess).template_from_scan.inverse()
            placed, moved = _as_moved(walls, inset, there)
            if moved.off_mm < 0.5 * layer_height_mm:
                return placed
    try:
        found = align(walls, inset)
    except AlignmentError as error:
        raise AlignmentError(
            "the job prints another part: its walls do not lie on this one's; name the part that "
            "the job prints, at its scale"
        ) from error
    alike = (found.template_from_scan, *found.symmetric_alternatives)
    placed = max((pose.inverse() for pose in alike), key=lambda pose: float(np.trace(pose.matrix)))
    placed, moved = _as_moved(walls, inset, placed)
    if (
        moved.off_mm > 0.5 * layer_height_mm
        or abs(moved.outside_mm) > inset.depth_mm
        or abs(moved.stretch) > MOST_STRETCH
    ):
        raise AlignmentError(
            f"the job's walls lie {moved.outside_mm:+.3f} mm outside the template's, are stretched "
            f"by {100.0 * moved.stretch:+.1f} % and lie {moved.off_mm:.3f} mm off that; the limits "
            f"are half a bead ({inset.depth_mm:.2g} mm), {100.0 * MOST_STRETCH:g} % and half a "
            f"layer ({0.5 * layer_height_mm:g} mm); is it this part, at this scale?"
        )
    return placed


@dataclass(frozen=True, slots=True)
class _Walls:
    """A job's walls, and how its slicer has moved them from where the part has them.

    Slicers move all walls by what their user tells them ('XY compensation', 'horizontal
    expansion'), so that holes and shafts of a printer that lays too much fit, and stretch what
    shrinks as it cools.

    Attributes
    ----------
    outside_mm, stretch
        How far outwards all of them were moved, and by what share X and Y are longer.
    off_mm
        How far each lies off that, the median.
    """

    laid: Scan
    outside_mm: float = 0.0
    stretch: float = 0.0
    off_mm: float = math.inf

    @property
    def half_mm(self) -> float:
        """Half of how far they go in X or Y."""
        return 0.5 * float(np.ptp(self.laid.points_mm[:, :2], axis=0).max())

    @property
    def unstretched(self) -> Scan:
        """Where they would lie without the stretch, their middle where it is."""
        points = self.laid.points_mm.copy()
        middle = box_of(points).mean(axis=0)[:2]
        points[:, :2] = middle + (points[:, :2] - middle) / (1.0 + self.stretch)
        return replace(self.laid, points_mm=points)

    def moved(self, inset: _Inset, placed: Transform) -> _Inset:
        """Where they are expected, the part being placed so."""
        up = placed.inverse().rotation[:, 2]
        return replace(inset, depth_mm=inset.depth_mm - self.outside_mm, up=up)

    def told_off(self, inset: _Inset, placed: Transform) -> _Walls:
        """What else has moved them, where the part is placed so, is added to what is known.

        Of walls all around, what a wrong place moves cancels out.
        """
        points = placed.inverse().apply(self.unstretched.points_mm)
        moved = self.moved(inset, placed)
        off_mm, gradient = moved.distance_and_gradient(points)
        far_mm = np.einsum(
            "ij,ij->i", (points - box_of(points).mean(axis=0))[:, :2], gradient[:, :2]
        )
        near_mm = np.clip(off_mm, -inset.depth_mm, inset.depth_mm)
        told = np.column_stack([USUAL_MOVE_MM * moved.level(gradient), USUAL_STRETCH * far_mm])
        # as points along a wall are off together, they tell no more than a few of them would
        prior = np.eye(2) * len(told) * (WALLS_TELL_RATIO * USUAL_MOVE_MM) ** 2
        share = np.linalg.solve(told.T @ told + prior, told.T @ near_mm)
        return replace(
            self,
            outside_mm=self.outside_mm + USUAL_MOVE_MM * share[0],
            stretch=self.stretch + USUAL_STRETCH * share[1],
            off_mm=_off_together_mm(off_mm - told @ share, points, gradient),
        )


def _off_together_mm(off_mm: Values, points_mm: Points, outward: Points) -> float:
    """How far walls lie off, the median of what neighbours of a side do: a fuzzy skin is even."""
    cells = np.floor(points_mm / EVEN_MM).astype(np.int64)
    side = (outward[:, :2] > 0.0).astype(np.int64)
    patch = cell_numbers(np.column_stack([cells, side]))
    together_mm = np.bincount(patch, off_mm) / np.bincount(patch)
    return float(np.median(np.abs(together_mm[patch])))


def _as_moved(laid: Scan, inset: _Inset, placed: Transform) -> tuple[Transform, _Walls]:
    """The pose, and how the walls were moved."""
    walls = _Walls(laid)
    for _ in range(MOST_MOVES):
        more = walls.told_off(inset, placed)
        change_mm = abs(more.outside_mm - walls.outside_mm)
        change_mm += walls.half_mm * abs(more.stretch - walls.stretch)
        walls = more
        if change_mm < MOVED_MM:
            break
        found = align(walls.unstretched, walls.moved(inset, placed), guess=placed.inverse())
        placed = found.template_from_scan.inverse()
    return placed, walls


def walls_moved_mm(job: Job, template: Template, placed: Transform) -> float:
    """How far a job moves a part's outer walls, at most; 0 where none of its beads is known as one.

    Outwards or inwards, by what it moves all of them and stretches X and Y.
    """
    beads = job.beads
    pick = (beads.layer >= 0) & of_roles(beads, OUTER_WALLS)
    if not pick.any():
        return 0.0
    inset = _Inset(template, _half_bead_mm(beads, pick), _half_high_mm(beads, pick))
    walls = _Walls(_walls(beads, np.flatnonzero(pick))).told_off(inset, placed)
    return abs(walls.outside_mm) + abs(walls.stretch) * walls.half_mm


def half_widths_mm(beads: Beads, pick: Mask) -> Float[np.ndarray, " k"]:
    """(k,) of some beads, as if they were as wide at the top as at the bottom."""
    return np.asarray(0.5 * beads.section_mm2[pick] / np.maximum(beads.height_mm[pick], 1e-6))


def _half_bead_mm(beads: Beads, pick: Mask) -> float:
    """Half of what slicers take some beads to be wide, the median."""
    sides_mm = 0.5 * BEAD_SIDES_RATIO * beads.height_mm[pick]
    return float(np.median(half_widths_mm(beads, pick) + sides_mm))


def _half_high_mm(beads: Beads, pick: Mask) -> float:
    """Half of how high some beads are, the median."""
    return 0.5 * float(np.median(beads.height_mm[pick]))


def _nth(number: int) -> str:
    return {1: "first", 2: "second", 3: "third"}.get(number, f"{number}th")


def _untilted(placed: Transform, template: Template, off_mm: float) -> Transform:
    """The pose turned about Z alone, where it is upright: slicers do not tilt, walls waver.

    So it is where it leans, over the part's height, by no more than its walls may lie off.
    """
    leans_mm = float(np.hypot(*placed.matrix[:2, 2])) * float(np.ptp(template.bounds_mm[:, 2]))
    stands = placed.matrix[2, 2] > 0.0 and leans_mm < off_mm
    if not (stands or is_upright(placed)):
        return placed
    turn_rad = float(np.arctan2(placed.matrix[1, 0], placed.matrix[0, 0]))
    turn = rotation_from_vector(np.array([0.0, 0.0, turn_rad]))
    centre = template.bounds_mm.mean(axis=0)
    return Transform.from_rotation_translation(
        placed.target,
        placed.source,
        rotation=turn,
        translation_mm=placed.apply(centre[None])[0] - turn @ centre,
    )


def first_layer(job: Job) -> int:
    """The first layer that has beads of a part in it; those before are a raft, seldom any.

    Of a job that prints one object after another, this is the first object's (`Job.of_turn`).
    """
    ours = job.beads.layer[~of_roles(job.beads, BESIDE_THE_PART)]
    return int(ours[ours >= 0].min()) if (ours >= 0).any() else 0


def tops_of(job: Job) -> list[float]:
    """How high each layer ends: one that is laid no lower than the next is pressed down by it.

    Cura lays the first layer over a raft's gap so.
    """
    tops_mm = [layer.z_mm for layer in job.layers]
    for turn in job.turns:
        for k in range(turn.end_layer - 2, turn.first_layer - 1, -1):
            if tops_mm[k] >= tops_mm[k + 1]:
                tops_mm[k] = tops_mm[k + 1] - job.layers[k + 1].height_mm
    return tops_mm


def _begins_mm(job: Job, layer: int) -> float:
    """Where the part begins of which a layer is one."""
    return foot_mm(job.of_turn(job.turn_of(layer)))


def foot_mm(job: Job) -> float:
    """Where a part's lowest layer begins: on the bed, or on the raft that the job lays before."""
    beads, first = job.beads, first_layer(job)
    if any(first == turn.first_layer for turn in job.turns):
        return 0.0
    lowest = (beads.layer == first) & ~of_roles(beads, BESIDE_THE_PART)
    over = [layer.height_mm for layer in job.layers[first + 1 :]]  # the first one's may have a gap
    height_mm = min(np.median(beads.height_mm[lowest]), np.median(over or [np.inf]))
    return float(tops_of(job)[first] - height_mm)


def _on_foot(
    placed: Transform, template: Template, begins_mm: float, layer_height_mm: float
) -> Transform:
    """The pose with the part's lowest point where its beads begin: walls tell height the least."""
    low_mm = float(box_of_solid(placed.solid(template.solid()))[0, 2])
    limit_mm = OFF_LAYERS * layer_height_mm
    if abs(low_mm - begins_mm) > limit_mm:
        raise AlignmentError(
            f"the part found in the job stands {low_mm:.2f} mm above the bed, its lowest beads "
            f"begin at {begins_mm:.2f} mm, and they may be {limit_mm:g} mm apart; is it this part, "
            "and does the job say what is raft and what is part?"
        )
    matrix = placed.matrix.copy()
    matrix[2, 3] -= low_mm - begins_mm
    return Transform(placed.target, placed.source, matrix)
