"""What the method of ours is set to in comparisons: where a part was bent, and by how much."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, slots=True)
class BendOptions:
    """A bend's zone, and the cuts at which a little bend is looked for.

    Attributes
    ----------
    least_cut_share, most_cut_share, cut_share_step
        Of the points on one side of a cut: those that are tried.
    ridge
        Of a motion that the points of a side do not show.
    widest_zone_ratio, zones
        Widths that the zone of a bend may have, from 0, which is a crease, of the diagonal.
    aside_ratio, asides
        How far its middle may lie from the plane that the pieces were parted by, of the diagonal.
    zone_points
        About the plane: enough to tell both.
    """

    least_cut_share: float = 0.2
    most_cut_share: float = 0.8
    cut_share_step: float = 0.05
    ridge: float = 1e-6
    widest_zone_ratio: float = 0.2
    zones: int = 11
    aside_ratio: float = 0.04
    asides: int = 9
    zone_points: int = 1_500

    @property
    def cut_shares(self) -> Float[np.ndarray, " c"]:
        """(c,) shares of the points on one side of a cut."""
        end = self.most_cut_share + 0.2 * self.cut_share_step
        return np.arange(self.least_cut_share, end, self.cut_share_step)

    @property
    def zone_ratios(self) -> Float[np.ndarray, " z"]:
        """(z,) widths, of the diagonal."""
        return np.linspace(0.0, self.widest_zone_ratio, self.zones)

    @property
    def aside_ratios(self) -> Float[np.ndarray, " a"]:
        """(a,) places of the middle, of the diagonal."""
        return np.linspace(-self.aside_ratio, self.aside_ratio, self.asides)


@dataclass(frozen=True, slots=True)
class BodyOptions:
    """When a scan shows a part bent in two, and in which poses its pieces stand.

    Attributes
    ----------
    least_bent_share
        Of the points: with fewer off the template nothing was bent.
    points, start_points, piece_points, last_points
        Of a cloud that poses are judged on; moved on to begin with; of a piece; at last.
    clear_sigmas, clear_ratio
        A point so far off the surface is off it; the ratio is of the diagonal.
    first_ratio, second_ratio
        Scale of the loss to begin with, of the diagonal: of a first piece, of a second one.
    sharp
        The loss's scale where a piece's pose ends, of the limit.
    iterations, rounds
        Of a pose, of a pair of poses.
    enough_sigmas
        Of the noise: a smaller step changes nothing that is asked.
    nearby_limits
        A point this near may yet come to lie on a piece.
    explained_share
        Of the points, explained by two poses: nothing better is looked for.
    bent_ratio, enough_beyond, least_beyond
        Nor where they explain all but outliers off the bend itself, which is neither piece's: so
        far from the plane between them, of the diagonal, where at least so many of the points lie.
    least_of_pair
        Fewer explained there: no bend. Of 117 bent scans one had less than 0.93, of 27 broken ones
        two had more than 0.85; a view of a bend, in sixteen draws of its points, 0.89 to 0.93.
    most_polished, most_tried
        Pairs of each pose, the best ones to begin with; poses of which a second piece is asked.
    neighbours, mostly
        A place lies on the template where so much of its neighbours does.
    same_ratio
        Poses that move the scan by less are one, of the diagonal.
    piece_turn_rad
        Starts of the second piece, about the middle of what the first leaves.
    cuts
        Shares of the scan on one side, along each of its main axes.
    least_turned_rad, most_turned_rad
        Of a bend; farther is another place that fits by chance.
    hinge_ratio
        At the plane between the pieces both poses agree to this, of the diagonal.
    least_piece_share, least_gained
        Of the points: a piece's; what the second pose explains beside the first.
    most_wrong
        Of either piece, on the wrong side of the plane between them.
    angles, as_good_ratio
        Planes about the hinge that are tried; wrong by so little more is as good.
    most_of_broken
        Where a pose holds more, the rest is a matter of its own.
    most_outside
        Of the points, beyond the noise, where something broke off.
    sunk_ratios
        The loss's scale to begin with there, of the diagonal.
    surface_ratio
        Spacing of the template's points, of the diagonal.
    gain_probability
        A bend that is looked for: noise alone has such a gain in one of so many scans.
    scale_ratio
        Scale of the loss where the pieces of a little bend begin, of the diagonal.
    cut_range
        Shares of the points below a cut.
    least_explained
        Of what is off in one pose, within the limit, two explain so much more: of bends of 0.6°
        0.15, of sound views, whose pieces slide along what the template is off by, up to 0.07.
    bends
        Of the zone, and of the cuts.
    """

    least_bent_share: float = 0.1
    points: int = 4_000
    start_points: int = 1_200
    piece_points: int = 600
    last_points: int = 15_000
    clear_sigmas: float = 4.0
    clear_ratio: float = 0.002
    first_ratio: float = 0.02
    second_ratio: float = 0.04
    sharp: float = 0.4
    iterations: int = 40
    rounds: int = 6
    enough_sigmas: float = 0.05
    nearby_limits: float = 3.0
    explained_share: float = 0.93
    bent_ratio: float = 0.06
    enough_beyond: float = 0.985
    least_beyond: float = 0.5
    least_of_pair: float = 0.87
    most_polished: int = 2
    most_tried: int = 4
    neighbours: int = 24
    mostly: float = 0.9
    same_ratio: float = 0.01
    piece_turn_rad: float = 0.14
    cuts: tuple[float, ...] = (0.3, 0.5, 0.7)
    least_turned_rad: float = 0.01
    most_turned_rad: float = 0.5
    hinge_ratio: float = 0.04
    least_piece_share: float = 0.05
    least_gained: float = 0.08
    most_wrong: float = 0.2
    angles: int = 36
    as_good_ratio: float = 0.02
    most_of_broken: float = 0.5
    most_outside: float = 0.01
    sunk_ratios: tuple[float, ...] = (0.01, 0.003)
    surface_ratio: float = 1.0 / 60.0
    gain_probability: float = 1e-6
    scale_ratio: float = 0.01
    cut_range: tuple[float, float] = (0.1, 0.9)
    least_explained: float = 0.1
    bends: BendOptions = BendOptions()


DEFAULT_BODIES = BodyOptions()


@dataclass(frozen=True, slots=True)
class LabelOptions:
    """When a made sample shows its defect.

    Attributes
    ----------
    visible_sigmas
        Of the noise: moved by less, a point cannot be told from a normal one.
    least_labelled_ratio, least_labelled
        A sample counts as anomalous only where the view shows this much of the defect, and so
        many points of it.
    least_normal_ratio
        A view of a bent end alone does not show what it is bent against.
    most_views, most_single_views
        That are tried; after so many from one sensor the defect is shown in a full scan.
    side_points
        Of a part, that tell on which sides its defect is.
    looseness
        Of a view's direction about the defect's normal.
    """

    visible_sigmas: float = 2.0
    least_labelled_ratio: float = 0.003
    least_labelled: int = 8
    least_normal_ratio: float = 0.1
    most_views: int = 40
    most_single_views: int = 25
    side_points: int = 4_000
    looseness: float = 0.6


DEFAULT_LABELS = LabelOptions()


@dataclass(frozen=True, slots=True)
class MakingOptions:
    """How defects are made on a solid; ratios are of the part's diagonal.

    Attributes
    ----------
    bulge_ratio
        Radius of bulges and concavities.
    seed_points
        Places of which one is a defect's.
    bend_points
        Of a bent part's surface.
    attempts
        To make a defect, each elsewhere.
    least_thickness_ratio
        Less material under a place is too thin to dent or crack.
    least_depth_ratio
        No defect moves less: 3 sigma of the default noise, more than twice over.
    waves
        Of a rough face.
    splinter_ratio
        How rough a broken face is.
    smooth_edges, least_smooth_ratio
        A smooth defect's surface is divided into so many edges a radius; smaller ones are made
        no finer.
    """

    bulge_ratio: tuple[float, float] = (0.04, 0.08)
    seed_points: int = 400
    bend_points: int = 4_000
    attempts: int = 30
    least_thickness_ratio: float = 0.008
    least_depth_ratio: float = 0.004
    waves: int = 6
    splinter_ratio: float = 0.01
    smooth_edges: float = 5.0
    least_smooth_ratio: float = 0.02


DEFAULT_MAKING = MakingOptions()


@dataclass(frozen=True, slots=True)
class ViewingOptions:
    """What a scanner sees of a made shape.

    Attributes
    ----------
    sensors
        Of a full scan: on a sphere they leave only true cavities unseen.
    most_incidence_deg
        Beyond this angle of incidence structured light returns nothing.
    distance_ratio
        Of a sensor, of the part's diagonal.
    candidates, rounds
        Of which a point that can be seen is one; drawn so many times at most.
    density_log
        Ends of the part differ in density by up to its exponential, about 4.5 times.
    """

    sensors: int = 32
    most_incidence_deg: float = 80.0
    distance_ratio: float = 4.0
    candidates: int = 4
    rounds: int = 12
    density_log: float = 1.5


DEFAULT_VIEWING = ViewingOptions()


@dataclass(frozen=True, slots=True)
class HouseOptions:
    """How the method of ours scores a data set's clouds.

    Attributes
    ----------
    near_neighbours
        Of a point, whose mean removes noise.
    wide_passes, wide_weight
        Means of means, as far as 64 neighbours, found in a quarter of the time; and their
        weight. Wide context carries a defect to those of its points that it moved along the
        surface (bends) or hardly at all (rims).
    least_sigma_ratio
        Noise of a data set, of its parts' diagonal, at least.
    most_offset_ratio
        Farther out than this share of the part nothing more is learned: clutter must not set
        the score.
    repair_points
        Of the template's surface that a repaired cloud has.
    surface_spacing_mm
        Of the extracted surface; at 0.5 thin walls are off by 2.5 times as much.
    retries
        Of an alignment that failed.
    followed_ratio, least_followed
        So near to the template, of the diagonal, sound clouds lie, or a pose is not told by it;
        where less of a sample lies so, it is laid wrong, and all of it is asked.
    learning_rounds
        Where the surface fused from clouds lies far off, the second look is from nearer by.
    """

    near_neighbours: int = 12
    wide_passes: int = 5
    wide_weight: float = 0.5
    least_sigma_ratio: float = 0.001
    most_offset_ratio: float = 0.15
    repair_points: int = 16_384
    surface_spacing_mm: float = 0.3
    retries: int = 3
    followed_ratio: float = 0.002
    least_followed: float = 0.5
    learning_rounds: int = 2


DEFAULT_HOUSE = HouseOptions()
