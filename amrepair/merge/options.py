"""What views are placed and judged by: shares of surface, and lengths in units of a measurement."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class MatchOptions:
    """How two views are laid on each other from nothing known; lengths in sizes of the part.

    Attributes
    ----------
    rotations
        About 16° apart.
    cap
        Points farther in free space are as bad as this.
    free_counts, free_counts_guessed
        What lies in free space counts so many times what agrees. More, and views that hide behind
        each other and share nothing come first.
    features_within, search_within, last_within
        Pairs of points lie within these, at first (of features, of the search) and at last.
    rough_points, points, most_poses
        That poses are settled on, at first and at last, and how many are at last.
    sure_overlap
        Of a pair that features lay on each other without contradiction.
    """

    rotations: int = 3_600
    cap: float = 0.1
    free_counts: float = 1.5
    free_counts_guessed: float = 0.75
    features_within: float = 0.05
    search_within: float = 0.03
    last_within: float = 0.012
    rough_points: int = 800
    points: int = 3_000
    most_poses: int = 6
    sure_overlap: float = 0.3


@dataclass(frozen=True, slots=True)
class JointOptions:
    """The joint refinement of all poses, and how surely each is held.

    Attributes
    ----------
    sampled, least_sampled
        Points of all scans together; of each.
    rounds, still_spacings
        At most; a smaller step ends it.
    within_spacings
        Of the other scan: farther apart are no pair.
    over_spacings
        A point lies over the other scan's nearest one, or beyond its rim; chance leaves such a
        place without one in exp(-pi) = 4 %.
    agrees
        Cosine of the normals of a pair: edges are blends of two faces.
    least_pairs
        Of two scans, or they say nothing of each other.
    scale_noises, first_medians, first_spacings, least_spacings, shrink
        Scale of the Geman-McClure loss: of the noise; at first, of the residuals' median and the
        spacing, so that poses find together which the groups left a millimetre apart. The least, of
        a spacing: scans without noise differ by rounding. And from round to round.
    patch_ratio
        Residuals of one facing within this share of the part err alike.
    shared_spacings
        What all points of a patch may share: what of the spacing a fit cannot tell, beside how far
        points lie from their plane beyond the noise, at edges and curves.
    worst_held_points
        Of a scan, for where its surface is held worst.
    free_ratio
        A motion with less information than this share of the best known one's is free.
    held_spacings
        Slips of more than so many are contradicted by what the sensors saw through.
    """

    sampled: int = 48_000
    least_sampled: int = 4_000
    rounds: int = 15
    still_spacings: float = 1e-3
    within_spacings: float = 4.0
    over_spacings: float = 1.0
    agrees: float = 0.9
    least_pairs: int = 100
    scale_noises: float = 4.0
    first_medians: float = 4.0
    first_spacings: float = 0.5
    least_spacings: float = 5e-3
    shrink: float = 0.6
    patch_ratio: float = 0.04
    shared_spacings: float = 0.05
    worst_held_points: int = 20_000
    free_ratio: float = 1e-6
    held_spacings: float = 3.0


@dataclass(frozen=True, slots=True)
class FuseOptions:
    """The field of placed scans, and the surface that is made of it.

    Attributes
    ----------
    least_node_points
        In reach of a node, or it has no support.
    rounds, outlier_sigmas, outlier_spacings
        Of the robust fit, and what is an outlier of it.
    far_spacings, facing
        How far along its normal another scan's surface contradicts a point, and the cosine to it.
    outvoted_marks
        Marks in a cell, or it is chance.
    seen_spacings
        A disc of so many of the sparsest scan's spacings that holds no point was not seen.
    side_agreement
        Share of a component's neighbours that must agree about its side.
    dust_ratio
        Closed pieces smaller than this share of the whole are clutter.
    wanted_spacings
        The mean's standard error that a reach is chosen for.
    least_nodes, least_spread_noises
        That a cell's spread is pooled from; and a share of the noise, below which chance cannot be
        told from disagreement.
    poisson_depth, poisson_points
        Of the closure where nothing was seen (Kazhdan and Hoppe 2013).
    """

    least_node_points: int = 6
    rounds: int = 3
    outlier_sigmas: float = 5.0
    outlier_spacings: float = 0.05
    far_spacings: float = 24.0
    facing: float = 0.3
    outvoted_marks: int = 2
    seen_spacings: float = 3.0
    side_agreement: float = 0.97
    dust_ratio: float = 1e-3
    wanted_spacings: float = 0.05
    least_nodes: int = 8
    least_spread_noises: float = 1 / 3
    poisson_depth: int = 8
    poisson_points: int = 150_000


DEFAULT_FUSE = FuseOptions()
"""What scans are fused by."""


@dataclass(frozen=True, slots=True)
class JudgeOptions:
    """How one view is held against another.

    Attributes
    ----------
    points
        Of each, at most.
    paired, agrees
        Cosine between normals of points that may be, and that are, one surface.
    least_pairs
        Of two views that are settled on each other.
    loss_reach
        Scale of the loss, of how far pairs may lie apart.
    over_spacings
        Over or under a surface is where it has a point within so many spacings; chance leaves such
        a place without one in exp(-pi) = 4 %.
    above
        Cosine to a surface's normal: above or below it, not beside it.
    """

    points: int = 3_000
    paired: float = 0.5
    agrees: float = 0.8
    least_pairs: int = 30
    loss_reach: float = 0.3
    over_spacings: float = 1.0
    above: float = 0.8


@dataclass(frozen=True, slots=True)
class SightOptions:
    """What a sensor's place tells, and where it may have stood; angles as cosines.

    Attributes
    ----------
    pixel_spacings
        Every pixel of a face seen at an angle of up to 60° has a point.
    closing_px
        Gaps that chance leaves in an image are closed.
    edge_on, edge_on_guessed
        A surface that is seen this nearly edge-on returns nothing, though it stands there; where
        the sensor's place is a guess, this much more.
    places
        Directions that are tried where nobody says where the sensor stood.
    behind_pixels, steepest
        A point so far behind another of its pixel is hidden by it, on faces no steeper than this.
    grazing, grazing_counts
        A point seen more aslant counts as so much of a hidden one.
    hidden_ratio, above_least
        Hidden shares up to this, or so much above the least, are noise and chance: of 48 views of
        eight parts the sensor's true direction was within 9° of one that passed, always.
    view_ratio
        No view's least share was above this (0.031 at most); whole scans of ten parts had 0.088
        and more.
    most_guesses, few_guesses, ring_rad
        At most so many places are kept; fewer than these are widened to what lies beside them.
    sensor_distances
        In the view's diagonal: nearer and farther than scanners stand.
    least_seen
        Points of one sensor, or it saw nothing to speak of.
    way_ratio
        Places of one sensor that lie within this share of their length of a line are its way.
    """

    pixel_spacings: float = 1.6
    closing_px: int = 2
    edge_on: float = 0.25
    edge_on_guessed: float = 0.35
    places: int = 400
    behind_pixels: float = 3.5
    steepest: float = 0.25
    grazing: float = 0.12
    grazing_counts: float = 0.5
    hidden_ratio: float = 0.02
    above_least: float = 0.01
    view_ratio: float = 0.05
    most_guesses: int = 10
    few_guesses: int = 8
    ring_rad: float = 0.16
    sensor_distances: tuple[float, float] = (2.0, 8.0)
    least_seen: int = 100
    way_ratio: float = 1e-3


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """How much of each scan is looked at.

    Attributes
    ----------
    least_points, most_points
        Of one scan; more add time, not accuracy.
    thin_points, image_points, guess_points
        That poses are looked for with, that an image is made of, that a sensor's place is guessed
        from.
    clear
        Cosine of a normal to a sensor's ray, or it is not clear which way it faces.
    """

    least_points: int = 2_000
    most_points: int = 400_000
    thin_points: int = 15_000
    image_points: int = 40_000
    guess_points: int = 8_000
    clear: float = 0.2


@dataclass(frozen=True, slots=True)
class GroupOptions:
    """How groups of views are laid on each other.

    Attributes
    ----------
    tried
        Poses of two groups that are looked at closely.
    points, steps
        Of each view, that groups are settled on; steps of it.
    """

    tried: int = 4
    points: int = 3_000
    steps: int = 8


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """Each figure once. "Noise" is a scan's own, "spacing" its own, "size" the part's diagonal.

    Attributes
    ----------
    least_overlap, least_overlap_guessed
        Share of one group of views that must lie on another; more where the sensors' places had to
        be guessed. Sixty-nine views of nine parts shared at least 0.11 with what they were laid on.
    most_against, most_against_guessed
        Share of a view that may contradict another: noise, edges, and small defects. At their true
        poses the same views had 0.013 at most.
    cropped_share
        What lies beside a view's silhouette does not speak against a pose as long as it is less
        than this share of the overlap: people crop what they scan (of the ten range images of the
        Stanford bunny up to 0.3 of a view lies beside another's silhouette, at the true poses).
    rival_share, rival_against
        Another pose is as good where it has this share of the overlap asked for, and at most so
        much more against it.
    reach_spacings, free_spacings
        How far surfaces that are one may lie apart, and by how much a ray must pass.
    off_spacings, off_noises
        Surface that faces one way is another's where it is farther off than chance and curves make
        it (spacings), and noise.
    same_size
        Of the size: poses that differ by less are one.
    followed_noises
        Of one point's noise: a template that follows what is finer is larger, slower, and no truer
        (4 scans of 200,000 points, noise 30 µm: 8.8 µm off, 8.2 so).
    unit_size_jump
        Scans of one part in one unit differ in size by less.
    told_share
        Of the surface: less that is unseen is not told.
    outvoted_spacings, outvoted_share, outvoted_times
        A scan is named that was outvoted on more surface than chance marks: so many spacings
        square, that share of the part's area, and so many times what the scans have in the median
        (where a scanner errs, each is outvoted somewhere).
    one_sensor_side
        Sensors within this of one direction (cosine) did not walk round the part: it turned.
    gap_spacings
        How far off a contradicting view's surface is looked for.
    view, sight, match, group, joint, judge, fuse
        Of each stage.
    """

    least_overlap: float = 0.1
    least_overlap_guessed: float = 0.2
    most_against: float = 0.05
    most_against_guessed: float = 0.03
    cropped_share: float = 0.67
    rival_share: float = 0.75
    rival_against: float = 0.015
    reach_spacings: float = 3.0
    free_spacings: float = 1.5
    off_spacings: float = 0.25
    off_noises: float = 6.0
    same_size: float = 0.02
    followed_noises: float = 0.5
    unit_size_jump: float = 3.0
    told_share: float = 0.002
    outvoted_spacings: float = 20.0
    outvoted_share: float = 1e-3
    outvoted_times: float = 5.0
    one_sensor_side: float = 0.9
    gap_spacings: float = 8.0
    view: ViewOptions = field(default_factory=ViewOptions)
    sight: SightOptions = field(default_factory=SightOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    group: GroupOptions = field(default_factory=GroupOptions)
    joint: JointOptions = field(default_factory=JointOptions)
    judge: JudgeOptions = field(default_factory=JudgeOptions)
    fuse: FuseOptions = field(default_factory=FuseOptions)

    def overlap(self, *, guessed: bool) -> float:
        """Of one group on another, at least."""
        return self.least_overlap_guessed if guessed else self.least_overlap

    def against(self, *, guessed: bool) -> float:
        """Of a view, at most."""
        return self.most_against_guessed if guessed else self.most_against


DEFAULT_MERGE = MergeOptions()
"""What the command line goes by."""


@dataclass(frozen=True, slots=True)
class CloudOptions:
    """Planes and sides of points that know neither normals nor sensors.

    Attributes
    ----------
    narrow_points, wide_points
        Points that planes are fitted to, on average: few where walls are thin, or more, by the
        tilt.
    plane_noises, growths, growth
        A plane's radius over the noise, at least: 4 of them tilt it by some 3°. How often it
        grows, and by how much.
    noise_noises
        Radius over the noise from which on a plane tells the noise.
    noise_quantile, least_plane_points
        Of the planes' scatter, that tells the noise; points of a plane that does.
    directions
        That a point looks in: a deep hole is open in one of a hundred.
    looking_points
        So many look around themselves; the others are told by those beside them.
    hiding_points, disc_spacings
        So many stand for the surface that hides others, each as a disc of so many spacings,
        which leaves one place in a hundred bare.
    most_cells
        Of the grid that rays pass, along the longest side.
    sheet_slope, sheet_noises
        Of two places on one sheet the height over the distance is less than so much, or chance.
    own_discs
        Discs nearer than so many of their radii are not in the way if they are of the looker's
        own sheet.
    tells_spacings, told_by, told_enough
        A point tells others of its side within; so many tell one; so many on one's own sheet
        are enough.
    agree_rounds
        Places that a verdict travels.
    """

    narrow_points: int = 10
    wide_points: int = 25
    plane_noises: float = 8.0
    growths: int = 3
    growth: float = 1.6
    noise_noises: float = 4.0
    noise_quantile: float = 0.1
    least_plane_points: int = 8
    directions: int = 256
    looking_points: int = 8_000
    hiding_points: int = 50_000
    disc_spacings: float = 1.2
    most_cells: int = 250
    sheet_slope: float = 0.2
    sheet_noises: float = 4.0
    own_discs: float = 2.5
    tells_spacings: float = 2.2
    told_by: int = 8
    told_enough: float = 1.0
    agree_rounds: int = 60


DEFAULT_CLOUD = CloudOptions()
