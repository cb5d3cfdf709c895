"""How a scan is condensed, and how space around what broke off is known: each number once."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class SurfelOptions:
    """Cells that a scan is condensed to.

    Attributes
    ----------
    cell_spacings, least_cell_mm, most_cell_mm
        Edge of a cell in spacings of the scan, between the two.
    area_per_cell
        Occupied unit cells hold about so many cells² of surface each (a plane at a random slope).
    least_near
        Of surface a cell, or one of those around it, holds so many points; else they stray.
    """

    cell_spacings: float = 2.0
    least_cell_mm: float = 0.3
    most_cell_mm: float = 2.0
    area_per_cell: float = 1.5
    least_near: int = 3


@dataclass(frozen=True, slots=True)
class OneViewOptions:
    """When a bare cloud counts as one view, and how its way is looked for.

    Attributes
    ----------
    places
        So many of the template's surface tell the way.
    ways, tried
        Ways that are compared by what faces them (9° apart), and of how many of those it is then
        told what of the template lies before its surface.
    finer_rad, finer_ways
        Around the best of them so many more are tried, within these, one after the other.
    least_facing
        Cosine of what a scanner sees for certain: it may miss what it looks at more aslant.
    off_mm
        So far before its surface a line of sight begins, and no step along it is shorter.
    most_hidden_seen
        Of what one view cannot have seen no more seems to be seen, the edge of what was apart.
        (Nine cuts in printed parts: 0.004 at most of one view.)
    as_good
        Ways that tell this share of what the best tells may as well be the one: of a block every
        way from which three faces are seen.
    enough_ways
        So many of those that are spread evenly do, without finer ones.
    least_past
        Of what is broken so much at least is seen past what stands from a way that all was seen
        from: more than half.
    squarely
        Cosine of a line of sight and a scanned surface's normal that it ends at.
    """

    places: int = 1500
    ways: int = 500
    tried: int = 60
    finer_rad: tuple[float, ...] = (0.15, 0.08, 0.04)
    finer_ways: int = 24
    least_facing: float = 0.25
    off_mm: float = 0.3
    most_hidden_seen: float = 0.02
    as_good: float = 0.98
    enough_ways: int = 4
    least_past: float = 0.5
    squarely: float = 0.5


@dataclass(frozen=True, slots=True)
class OccupancyOptions:
    """What the labelling is set to.

    Attributes
    ----------
    voxel_spacings, most_voxels
        Edge of a voxel in spacings of the scan, and how many there may be: else they are larger.
    seen_spacings
        Surface is seen where at least half as many points as expected lie within this.
    gap_spacings
        A hole of chance between points is no wider.
    stray
        Probability of a point that lies on no surface.
    largest_cover
        Nothing is seen for certain: at most with this probability.
    hidden_cover
        Bare surface is hidden rather than gone if less was seen of what faces the same way.
    unscanned_share
        Empty space is a guess where ends that were not scanned take more of the view from there: a
        disc does so as deep as its radius, 1 − √½.
    deep_extents
        A void is less probable by one nat for so much of its depth, in the template's largest
        extents.
    hole_mm, margin_mm
        Unseen places so near to each other are one hole; space looked at around what is broken.
    bead_mm, least_seen
        No broken edge is thinner than a bead, and so much of it at least is seen.
    way_cosine
        Surface faces a way if it is less askew to it.
    hole_places, looking_places
        So many bare places make a hole, and so many broken ones are asked what they look out of.
    box_ratio
        A box holds at most so many times as many voxels as are to be labelled.
    one_view
        When all was seen from one way.
    """

    voxel_spacings: float = 1.5
    most_voxels: int = 200_000
    seen_spacings: float = 2.5
    gap_spacings: float = 1.6
    stray: float = 0.05
    largest_cover: float = 0.999
    hidden_cover: float = 0.5
    unscanned_share: float = 1.0 - 0.5**0.5
    deep_extents: float = 2.0
    hole_mm: float = 1.0
    margin_mm: float = 1.5
    bead_mm: float = 0.4
    least_seen: float = 0.5
    way_cosine: float = 0.7
    hole_places: int = 5
    looking_places: int = 2000
    box_ratio: float = 30.0
    one_view: OneViewOptions = field(default_factory=OneViewOptions)


@dataclass(frozen=True, slots=True)
class FaceOptions:
    """Broken faces around what left the template, where no rays tell.

    Attributes
    ----------
    around_mm
        The scan is looked at point by point within this of what lies off the template.
    plane_points, plane_rounds
        Points of one plane: at the spacing s of the scan a disc of about 2 s; how often it is
        fitted again.
    lone_ratio
        Of a broken point's neighbours must be broken, too.
    neighbours
        Faces that answer for a point of space.
    strip_cosine, strip_mm
        Planes more askew to the template's own slope are another surface, if they lie below it.
    beside_spacings, beside_per_height
        A face answers for what lies over it: sideways within these.
    near_spacings
        No face answers for what is farther off.
    normal_agreement
        A file's normals need this mean agreement with the template before they are believed.
    """

    around_mm: float = 1.5
    plane_points: int = 16
    plane_rounds: int = 4
    lone_ratio: float = 0.2
    neighbours: int = 6
    strip_cosine: float = 0.77
    strip_mm: float = 0.03
    beside_spacings: float = 2.0
    beside_per_height: float = 0.5
    near_spacings: float = 3.0
    normal_agreement: float = 0.5


@dataclass(frozen=True, slots=True)
class EvidenceOptions:
    """What a scan says of any point in space.

    Attributes
    ----------
    sideways_cells, sideways_per_height
        A plane fitted to a void's floor speaks for what lies above it, not beside it: sideways by
        so many cells and so many heights.
    neighbours
        Cells that answer for a point.
    sharp_steps, sharp_mm
        A pixel beside a silhouette, seen aslant, is off by no more than so many of its steps; and
        a deficit's voxel is no larger: farther off no surface is shaped.
    back_cosine
        Parallel to the template's surface, and turned away from the sensor that saw it by 17°.
    stub_cells, stub_mm
        As far from template that is gone as a stub of it can be, and as deep as noise is not.
    patch_mm
        The template's surface is looked at this finely.
    faces, occupancy
        Where no rays tell.
    """

    sideways_cells: float = 1.5
    sideways_per_height: float = 1.0
    neighbours: int = 4
    sharp_steps: float = 1.5
    sharp_mm: float = 0.25
    back_cosine: float = -0.3
    stub_cells: float = 2.5
    stub_mm: float = 0.05
    patch_mm: float = 0.4
    faces: FaceOptions = field(default_factory=FaceOptions)
    occupancy: OccupancyOptions = field(default_factory=OccupancyOptions)


DEFAULT_SURFELS = SurfelOptions()
"""What scans are condensed by."""
