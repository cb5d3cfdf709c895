"""The space around broken surface, as voxels: which there are, and what a scan is there."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage
from scipy.spatial import cKDTree

from amrepair.arrays import Mask, Numbers, Points, Values, VoxelMask, Voxels
from amrepair.field.groups import group_points
from amrepair.field.near import has_near
from amrepair.field.options import OccupancyOptions
from amrepair.frames import box_of, cells_of, diagonal, unit_vectors
from amrepair.template.port import Template

# Before and behind a plane, in voxels: there its sides are looked up.
LOOK_VOXELS = (0.75, 1.5, 2.5)
# Blocks of so many voxels a side whose middle is so many sides from the template's surface are
# wholly in it or outside it: √3 / 2, and a little.
TRACED_BLOCK, FAR_BLOCKS = 4, 1.1


@dataclass(frozen=True, slots=True)
class Broken:
    """Scanned surface that is not the template's; nobody knows which way its planes look.

    Attributes
    ----------
    place_mm, plane
        (q, 3) places, and unit normals of the planes through their neighbours.
    f_mm, outward
        (q,) the template's distance there, and (q, 3) its unit gradient.
    """

    place_mm: Points
    plane: Points
    f_mm: Values
    outward: Points


@dataclass(frozen=True)
class Occupancy:
    """Voxels of a box, template frame.

    Attributes
    ----------
    low_mm, voxel_mm
        Corner of the box, and edge of a voxel.
    solid
        (x, y, z) whether material is there.
    designed
        (x, y, z) whether it should be.
    """

    low_mm: Float[np.ndarray, " 3"]
    voxel_mm: float
    solid: VoxelMask
    designed: VoxelMask

    def at(self, points_mm: Points) -> Values:
        """Of points in the template: positive where solid, negative empty; 0 beyond the box."""
        index, ok = voxels_at(points_mm, self.low_mm, self.voxel_mm, self.solid.shape)
        said = np.zeros(len(points_mm))
        said[ok] = self._told[tuple(index[ok].T)]
        thin = np.flatnonzero(ok & (said == 0))
        if len(thin) and self.designed.any():
            said[thin] = self._told[tuple(self._near_designed(points_mm[thin]).T)]
        return said

    @property
    def standing_mm(self) -> Points:
        """(n, 3) middles of voxels that are solid, and should be."""
        return self.low_mm + (np.argwhere(self.solid & self.designed) + 0.5) * self.voxel_mm

    def _near_designed(self, points_mm: Points) -> Int[np.ndarray, "n 3"]:
        """Designed voxels nearest to points: of a sheet that is thinner none holds a middle."""
        every, tree = self._designed_voxels
        nearest = tree.query((points_mm - self.low_mm) / self.voxel_mm - 0.5)[1]
        return np.asarray(every[nearest])

    @cached_property
    def _designed_voxels(self) -> tuple[Int[np.ndarray, "k 3"], cKDTree]:
        """Where they are, as numbers along each axis; searched once for all that is asked."""
        every = np.argwhere(self.designed)
        return every, cKDTree(every)

    @cached_property
    def _told(self) -> Voxels:
        """As voxels say; one that the template's surface cuts off, as those beside it in there."""
        told = np.where(self.solid, np.float32(1.0), np.float32(-1.0))
        beside = ndimage.uniform_filter(np.where(self.designed, told, np.float32(0.0)), 3)
        return np.asarray(np.where(self.designed, told, np.where(np.abs(beside) > 1e-3, beside, 0)))

    def open_side(self, faces: Broken) -> Values:
        """(q,) positive where space ahead of a plane is empty, negative behind, 0 unknown.

        Only on the same side of the template's surface: beyond that one surface more may lie.
        """
        side = np.zeros(len(faces.f_mm))
        for step in LOOK_VOXELS:
            for way in (-1.0, 1.0):
                at_mm = faces.place_mm + way * step * self.voxel_mm * faces.plane
                index, ok = voxels_at(at_mm, self.low_mm, self.voxel_mm, self.solid.shape)
                at = tuple(index[ok].T)
                same = self.designed[at] == (faces.f_mm[ok] < 0)
                side[ok] -= way * np.where(same, np.where(self.solid[at], 1.0, -1.0), 0.0)
        return side


@dataclass(frozen=True, slots=True)
class VoxelGrid:
    """Voxels of a box: the template's distance at each, and the number of those to be labelled."""

    low_mm: Float[np.ndarray, " 3"]
    voxel_mm: float
    f_mm: Voxels
    number: Int[np.ndarray, "x y z"]

    @property
    def is_inside(self) -> Mask:
        """(v,) whether the voxels to be labelled lie in the template."""
        return np.asarray(self.f_mm[self.number >= 0] < 0)

    def labelled(self, empty: Mask) -> Occupancy:
        """All voxels, by which of those to be labelled are empty."""
        solid = np.zeros(self.number.shape, bool)
        solid[self.number >= 0] = ~empty
        return Occupancy(self.low_mm, self.voxel_mm, solid, self.f_mm < 0)

    def numbers_at(self, points_mm: Points) -> Numbers:
        """(k,) number of the voxel that holds each point, −1 where none does."""
        index, ok = voxels_at(points_mm, self.low_mm, self.voxel_mm, self.number.shape)
        found = np.full(len(points_mm), -1, np.int64)
        found[ok] = self.number[tuple(index[ok].T)]
        return found


@dataclass(frozen=True, slots=True)
class ScannedSpace:
    """A scan around broken surface: what of it is broken, points on the template, its spacing."""

    template: Template
    broken: Broken
    on_mm: Points
    spacing_mm: float
    options: OccupancyOptions

    def sees(self, asked_mm: Points) -> Mask:
        """Whether at least half as many points lie around each place as on surface that was seen.

        Half, so that along a straight rim of what was seen neither side gains.
        """
        within_mm = self.options.seen_spacings * self.spacing_mm
        half = int(0.5 * np.pi * self.options.seen_spacings**2)
        return has_near(asked_mm, self.on_mm, within_mm, enough=half)

    def points_on_facet(self, voxel_mm: float) -> float:
        """How many points lie on a voxel's side, at the scan's density."""
        return (voxel_mm / self.spacing_mm) ** 2

    def width_mm(self, voxel_mm: float) -> float:
        """How far from its points surface may be put; steps of voxels by up to half of one more."""
        return self.options.gap_spacings * self.spacing_mm + 0.6 * voxel_mm


def box_about(scan: ScannedSpace, bare_mm: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "2 3"]:
    """What is broken, holes in the seen surface that touch it, and where it looks out of others."""
    broken, options = scan.broken, scan.options
    reach_mm = max(options.hole_mm, 3.0 * scan.spacing_mm)
    # a bare place among covered ones is chance
    holes_mm = bare_mm[has_near(bare_mm, bare_mm, reach_mm, enough=options.hole_places)]
    marked_mm = np.concatenate([broken.place_mm, holes_mm])
    group = group_points(marked_mm, reach_mm=reach_mm)
    touching = np.isin(group, np.unique(group[: len(broken.f_mm)]))
    places = [marked_mm[touching]]
    if len(holes_mm):
        out_mm = _ways_out(scan.template, broken, options)
        places.append(out_mm[has_near(out_mm, holes_mm, reach_mm)])
    outward = np.array([[-1.0], [1.0]])
    over_mm = max(float(broken.f_mm.max()), 0.0) + 2.0 * scan.spacing_mm
    most_mm = scan.template.bounds_mm + over_mm * outward
    box_mm = box_of(np.concatenate(places)) + options.margin_mm * outward
    # a sliver of the template beyond it would be taken to stand
    return np.where((most_mm - box_mm) * outward < options.margin_mm, most_mm, box_mm)


def _ways_out(template: Template, broken: Broken, options: OccupancyOptions) -> Points:
    """Where lines from broken surface along its planes' normals first leave the template.

    No surface is nearer than the template's distance: so far each step goes (Hart 1996).
    """
    some = slice(None, None, max(1, len(broken.f_mm) // options.looking_places))
    front_mm = np.concatenate([broken.place_mm[some]] * 2)
    along = np.concatenate([broken.plane[some], -broken.plane[some]])
    f_mm = np.concatenate([broken.f_mm[some]] * 2)
    step_mm = 0.5 * options.hole_mm
    out = []
    for _ in range(int(diagonal(template.bounds_mm) / step_mm) + 1):
        front_mm = front_mm + np.maximum(-f_mm, step_mm)[:, None] * along
        f_mm = template.distance(front_mm)
        left = f_mm >= 0
        out.append(front_mm[left] - f_mm[left, None] * along[left])
        front_mm, along, f_mm = front_mm[~left], along[~left], f_mm[~left]
        if len(front_mm) == 0:
            break
    return np.concatenate(out)


def grid_over(scan: ScannedSpace, box_mm: Float[np.ndarray, "2 3"]) -> VoxelGrid:
    """Voxels of a box, as fine as their number allows.

    Those to be labelled lie in the template, or no farther outside it than the scan does.
    """
    options, highest_mm = scan.options, float(scan.broken.f_mm.max())
    extent_mm = np.maximum(np.ptp(box_mm, axis=0), 1e-6)
    voxel_mm = options.voxel_spacings * scan.spacing_mm
    most = options.box_ratio * options.most_voxels
    voxel_mm = max(voxel_mm, float(np.cbrt(np.prod(extent_mm) / most)))
    while True:
        shape = np.ceil(extent_mm / voxel_mm).astype(np.int64)
        f_mm = _distances(scan.template, box_mm[0], voxel_mm, shape)
        asked = f_mm < (highest_mm + voxel_mm if highest_mm > 0 else 0.0)
        count = int(asked.sum())
        if count <= options.most_voxels:
            break
        voxel_mm *= 1.02 * (count / options.most_voxels) ** (1 / 3)
    number = np.full(f_mm.shape, -1, np.int64)
    number[asked] = np.arange(count)
    return VoxelGrid(box_mm[0], voxel_mm, f_mm, number)


def _distances(
    template: Template,
    low_mm: Float[np.ndarray, " 3"],
    voxel_mm: float,
    shape: Int[np.ndarray, " 3"],
) -> Voxels:
    """The template's distance at each voxel's middle; far from its surface that of a block's."""
    blocks = -(-shape // TRACED_BLOCK)
    middles = TRACED_BLOCK * (np.argwhere(np.ones(blocks, bool)) + 0.5)
    coarse = template.distance(low_mm + voxel_mm * middles)
    whole = coarse.reshape(blocks)
    for axis in range(3):
        whole = whole.repeat(TRACED_BLOCK, axis=axis)
    f_mm = whole[tuple(slice(size) for size in shape)].copy()
    # no voxel of a block lies farther from its middle
    near = np.argwhere(np.abs(f_mm) < FAR_BLOCKS * TRACED_BLOCK * voxel_mm)
    f_mm[tuple(near.T)] = template.distance(low_mm + voxel_mm * (near + 0.5))
    return f_mm


def feet_on(template: Template, points_mm: Points) -> tuple[Points, Points]:
    """Nearest places on the template, and outward unit normals."""
    f_mm, gradient = template.distance_and_gradient(points_mm)
    outward = unit_vectors(gradient)
    return points_mm - f_mm[:, None] * outward, outward


def voxels_at(
    points_mm: Points, low_mm: Float[np.ndarray, " 3"], voxel_mm: float, shape: tuple[int, ...]
) -> tuple[Int[np.ndarray, "n 3"], Mask]:
    """Voxel of each point, and whether it lies in the box."""
    index = cells_of(points_mm, low_mm, voxel_mm)
    return index, np.asarray(((index >= 0) & (index < np.array(shape))).all(axis=1))
