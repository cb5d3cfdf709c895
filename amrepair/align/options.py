"""What an alignment is searched, refined and accepted by: each number once.

Ratios are of the template's diagonal, sigmas of the noise, where nothing else is said.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from amrepair.errors import InputError

LOSSES = ("chamfer", "directed")


@dataclass(frozen=True, slots=True)
class SearchRound:
    """A round of the search: points, Gauss-Newton steps, scales, poses kept.

    Attributes
    ----------
    first_scale, last_scale
        Of the loss, in diagonals.
    """

    points: int
    steps: int
    first_scale: float
    last_scale: float
    keep: int

    def scales(self, diagonal: float) -> Float[np.ndarray, " s"]:
        """(s,) from the first to the last, in equal ratios, in the diagonal's unit."""
        return diagonal * np.geomspace(self.first_scale, self.last_scale, self.steps)


@dataclass(frozen=True, slots=True)
class Effort:
    """How many rotations are tried (spread evenly over SO(3)), and the rounds that follow.

    Attributes
    ----------
    places
        Where each rotation is tried.
    gap_ratio
        Of the diagonal, between the places among which those are chosen.
    """

    rotations: int
    stages: tuple[SearchRound, ...]
    places: int = 1
    gap_ratio: float = np.inf


QUICK = Effort(
    1_200,
    (
        SearchRound(120, 6, 0.10, 0.03, 160),
        SearchRound(300, 8, 0.03, 0.01, 40),
        SearchRound(1_000, 6, 0.01, 0.005, 40),
    ),
)
THOROUGH = Effort(
    3_600,
    (
        SearchRound(160, 7, 0.10, 0.03, 480),
        SearchRound(400, 10, 0.03, 0.01, 80),
        SearchRound(1_500, 8, 0.01, 0.005, 40),
    ),
)
PIECE = Effort(
    2_400,
    (
        SearchRound(160, 7, 0.07, 0.02, 600),
        SearchRound(400, 10, 0.02, 0.01, 120),
        SearchRound(1_500, 8, 0.01, 0.005, 40),
    ),
    places=12,
    gap_ratio=0.1,
)
TWINS = Effort(
    192,
    (
        SearchRound(120, 6, 0.10, 0.03, 48),
        SearchRound(300, 8, 0.03, 0.01, 16),
        SearchRound(1_000, 6, 0.01, 0.005, 16),
    ),
)
PIECE_AGAIN = replace(PIECE, places=24)


@dataclass(frozen=True, slots=True)
class CoarseOptions:
    """The coarse field, on which every rotation is tried.

    Attributes
    ----------
    cells
        Along the longest side of the part.
    margin_ratio
        Around the part.
    cap_ratio
        Points farther off are as bad as this.
    same_pose_ratio
        Poses that move the points by less are one.
    quick
        Rotations about 23° apart; of 120 scans of our own parts, whole and single views, none was
        lost.
    thorough
        Where that leaves points unexplained.
    piece, piece_again
        For a scan that shows a piece of the part, which may lie anywhere in it. Of 40 searches for
        pieces of a bracket 8 failed with 4 places, 2 with 12, none with 24.
    twins
        For poses that are nearly known.
    worse, off_cells, fits_cells
        The coarse field rounds edges: a right pose may look worse than a wrong one by this factor
        and these cells. Of a scan that fits it is off by so many cells at most.
    most_refined, most_doubtful, most_twins
        Poses that go on to the exact field: of a scan that fits, of another, of a pose's twins.
    piece_ratio
        A scan smaller than this is a piece.
    """

    cells: int = 56
    margin_ratio: float = 0.15
    cap_ratio: float = 0.03
    same_pose_ratio: float = 0.007
    quick: Effort = QUICK
    thorough: Effort = THOROUGH
    piece: Effort = PIECE
    piece_again: Effort = PIECE_AGAIN
    twins: Effort = TWINS
    worse: float = 1.8
    off_cells: float = 0.05
    fits_cells: float = 0.2
    most_refined: int = 40
    most_doubtful: int = 5
    most_twins: int = 10
    piece_ratio: float = 0.6


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """How poses are moved on the exact field, and which of them are left on the way.

    Attributes
    ----------
    first_points, few_points, dense_points
        A scan's points in each round.
    first_iterations, few_iterations, dense_iterations
        Gauss-Newton steps in each, at most.
    first_ratio
        Scale of the loss to begin with.
    left_factor, few_factor
        After the first and after the second round, a pose worse than the best by this factor is
        left: its score changes little from there.
    most_finished
        Poses moved on all points.
    enough_sigmas
        On few points nothing is gained by shorter steps.
    least_cap_mm, cap_sigmas
        Points farther off than both are as bad as the farther one.
    least_scale_mm, scale_sigmas
        The larger is the loss's scale where a pose is at its end.
    same_fit_mm
        Scores that differ by less are alike.
    apart_ratio
        Poses that move the part by less are the same.
    plausible
        A mean distance above this share of the cap is no fit, with more points either.
    """

    first_points: int = 700
    few_points: int = 2_000
    dense_points: int = 15_000
    first_iterations: int = 10
    few_iterations: int = 30
    dense_iterations: int = 120
    first_ratio: float = 0.005
    left_factor: float = 1.6
    few_factor: float = 1.5
    most_finished: int = 3
    enough_sigmas: float = 0.05
    least_cap_mm: float = 1.0
    cap_sigmas: float = 10.0
    least_scale_mm: float = 0.1
    scale_sigmas: float = 3.0
    same_fit_mm: float = 0.005
    apart_ratio: float = 0.02
    plausible: float = 0.6

    def scale_mm(self, sigma_mm: float) -> float:
        """Of the loss where a pose is at its end, mm."""
        return max(self.least_scale_mm, self.scale_sigmas * sigma_mm)


@dataclass(frozen=True, slots=True)
class ExplainedOptions:
    """When a point lies on the part, and when a pose explains a scan so well that others are not.

    Attributes
    ----------
    inlier_mm, inlier_sigmas
        A real print lies this near to its template nearly everywhere, or within the noise.
    floor_mm
        Process and columns: points agree no better than this.
    bias_sigmas
        A template's bias is the 99th percentile of its error.
    doubtful
        With fewer points explained the noise is measured, and the mirror image tried.
    noisier, most_noise_mm, most_noise_ratio
        Noise that was measured is taken where it is so many times what was said, up to what a thin
        wall's two sides could pretend, or of the diagonal: sensors for large parts see them from
        afar.
    well, mostly, explained
        With fewer points on the part the search goes on, and is made thorough; with more than the
        last the pose is worth turning.
    cleared
        With fewer on the part clutter is looked for, until so many are.
    clearer_by
        A pose lays so much more of all on the part than one found without clutter: that was none.
    few_tried
        Poses refined of what is left without clutter, and of the mirror image.
    as_good
        Another pose fits as well if its score is at most so many times the best one's, and no more
        than a few points lie on the part in the best pose and clearly off it in the other.
    against_ratio, against_sigmas
        Those few: share of the points, and standard deviations of chance.
    clear_mm, clear_sigmas
        Clearly off: beyond what prints of one part differ by, and beyond the noise.
    feature_points
        Of the template's surface, that features are made of.
    half_points, least_half
        Points of halves of a scan; of fewer a half says nothing.
    """

    inlier_mm: float = 0.3
    inlier_sigmas: float = 3.0
    floor_mm: float = 0.02
    bias_sigmas: float = 2.6
    doubtful: float = 0.93
    noisier: float = 1.5
    most_noise_mm: float = 0.25
    most_noise_ratio: float = 0.001
    well: float = 0.97
    mostly: float = 0.95
    explained: float = 0.7
    cleared: float = 0.85
    clearer_by: float = 0.1
    few_tried: int = 3
    as_good: float = 1.5
    against_ratio: float = 0.003
    against_sigmas: float = 4.0
    clear_mm: float = 0.1
    clear_sigmas: float = 4.0
    feature_points: int = 30_000
    half_points: int = 2_000
    least_half: int = 100

    def limits_mm(self, noise_mm: float, bias_mm: float = 0.0) -> tuple[float, float]:
        """How well points can agree with the template, and how near explained ones lie.

        A good guess needs no `bias_mm` of the template: hardly more than half of the points must
        fit.
        """
        floor_mm = np.hypot(self.floor_mm, bias_mm / self.bias_sigmas)
        sigma_mm = float(np.hypot(max(noise_mm, 1e-3), floor_mm))
        return sigma_mm, max(self.inlier_mm, self.inlier_sigmas * sigma_mm)

    def clearly_off_mm(self, sigma_mm: float) -> float:
        """Points farther off speak against a pose."""
        return max(self.clear_mm, self.clear_sigmas * sigma_mm)


@dataclass(frozen=True, slots=True)
class FamilyOptions:
    """Motions that a scan hardly hinders: poses along them are one family.

    Attributes
    ----------
    step_ratio
        What the farthest point moves from one pose to the next.
    swept_points, coarse_points, radius_points
        That the poses of a family are judged by; on the coarse field; that tell its radius.
    least_judges
        Fewer points that are off are outliers.
    most_families, best_of_each, most_asked
        Families, poses of each, and dips of the coarse field that the exact one puts in order.
    same_steps
        From the nearest pose of a family: the axis is known no better.
    most_resisting
        Share of the points that a motion may press against the surface.
    least_radius_ratio
        About the axis: less turns nothing.
    """

    step_ratio: float = 0.01
    swept_points: int = 4_000
    coarse_points: int = 1_500
    radius_points: int = 1_500
    least_judges: int = 10
    most_families: int = 6
    best_of_each: int = 3
    most_asked: int = 12
    same_steps: float = 4.0
    most_resisting: float = 0.02
    least_radius_ratio: float = 0.02


@dataclass(frozen=True, slots=True)
class ClutterOptions:
    """What of a scan can be the part: a surface's points lie in planes, scattered ones fill space.

    Attributes
    ----------
    points, neighbours
        That are looked at, and around each.
    far_factor, usual_quantile
        A point is scattered where its neighbours are so many times as far as is usual.
    thick_ratio
        Of the neighbours' variance, across their plane; an edge of 90° has about this.
    least_kept
        Less left over: the scan is too noisy or sparse to tell.
    hypotheses, plane_rounds, plane_points, least_in_plane
        Planes tried for the bed, rounds of each, points it is tried on, and points in it at least.
    first_tolerance_ratio, last_tolerance_ratio, plane_sigmas
        How near its points lie, of the scan's diagonal and of its noise.
    least_plane, one_side
        The bed is a plane with so much of the scan in it, and of the rest so much on one side.
    gap_factor
        Pieces farther apart than so many usual distances are separate.
    least_piece, most_pieces, most_cells
        Share of the points that a piece has, how many are tried, and cells they are told by.
    least_left
        Points that a part must have.
    noise_places, noise_neighbours, noise_quantile
        Where noise is measured, on how many points each, and the quantile that edges do not reach.
    worth
        Leaving out less than this share changes nothing.
    """

    points: int = 60_000
    neighbours: int = 9
    far_factor: float = 3.0
    usual_quantile: float = 0.3
    thick_ratio: float = 0.1
    least_kept: float = 0.3
    hypotheses: int = 40
    plane_rounds: int = 6
    plane_points: int = 4_000
    least_in_plane: int = 10
    first_tolerance_ratio: float = 0.02
    last_tolerance_ratio: float = 0.004
    plane_sigmas: float = 4.0
    least_plane: float = 0.12
    one_side: float = 0.97
    gap_factor: float = 2.5
    least_piece: float = 0.1
    most_pieces: int = 3
    most_cells: int = 4_000_000
    least_left: int = 500
    noise_places: int = 2_000
    noise_neighbours: int = 24
    noise_quantile: float = 0.2
    worth: float = 0.02


@dataclass(frozen=True, slots=True)
class BedOptions:
    """The bed as a witness of height and tilt.

    Attributes
    ----------
    most_points, most_fitted
        Of the scan, and of the bed: it is a plane.
    under_foot_mm
        How far under the part's foot the bed lies: the height of the raft that it stands on.
    band_mm
        How far off the guess may have the bed.
    skirt_mm
        Bed points this near to the part may be its skirt, its foot or its raft.
    least_points
        Of the bed.
    least_spread_mm
        Root mean square, across the bed that is seen: a strip does not tell its tilt.
    rounds, shrink, last_scale_mm
        Of the robust plane: the loss's scale begins at the band.
    height_sigma_mm, tilt_sigma_rad
        What the bed leaves open: a few micrometres of height, and tilt over a part's length.
    frame_sigma_mm
        What the printer's own frame leaves open of the bed's height where a scan does not show it.
    """

    most_points: int = 80_000
    most_fitted: int = 10_000
    under_foot_mm: float = 0.0
    band_mm: float = 1.0
    skirt_mm: float = 2.0
    least_points: int = 300
    least_spread_mm: float = 3.0
    rounds: int = 12
    shrink: float = 0.6
    last_scale_mm: float = 0.1
    height_sigma_mm: float = 0.01
    tilt_sigma_rad: float = 2e-4
    frame_sigma_mm: float = 0.02


@dataclass(frozen=True, slots=True)
class LevelOptions:
    """What is a level surface, as the top of a layer.

    Attributes
    ----------
    steepest_deg
        Of a layer's top, as of a plane through a point and its neighbours.
    neighbours
        That the plane goes through, the point among them.
    """

    steepest_deg: float = 45.0
    neighbours: int = 9


@dataclass(frozen=True, slots=True)
class GuessOptions:
    """An alignment that begins near its end.

    Attributes
    ----------
    bound_mm, bound_deg
        How far the pose may lie from the guess. One from a calibration is good to this; what is
        farther is not the part that was meant.
    most_points
        Of the scan, that are looked at.
    beside_mm, above_bed_mm
        Points can lie on the part this far beside its box, and from so far above the bed.
    start_scale_mm
        Of the loss.
    most_steps
        Where walls were laid too narrow or too low, both of their sides lie inside, and the pose
        slides slowly along a shallow valley between them: looks that 60 steps had ended took 61 to
        97.
    least_explained, least_of_walls
        Much of what is seen may be bed. Where no more stands out of the part than may
        (`least_of_rest`), the tops of layers that lie in it say nothing, as where it stopped early
        or was laid with half of its plastic: then this share of all else needs to fit.
    """

    bound_mm: float = 3.0
    bound_deg: float = 3.0
    most_points: int = 150_000
    beside_mm: float = 3.0
    above_bed_mm: float = 0.35
    start_scale_mm: float = 1.0
    most_steps: int = 240
    least_explained: float = 0.5
    least_of_walls: float = 0.8


@dataclass(frozen=True, slots=True)
class PamOptions:
    """Algorithm 1 of the paper; the defaults are the paper's.

    Attributes
    ----------
    voxel
        v, edge of the down-sampling voxel, in template radii.
    threshold, threshold_step, iterations
        τ, Δτ by which it grows after each iteration, and K.
    loss
        `chamfer`: mean squared nearest distance, both directions (eq. 7); `directed`: mean nearest
        distance from source to target × 100 (the released code).
    loss_points, loss_on_voxels
        Points drawn for the loss (0: all), and whether of the down-sampled clouds.
    normal_voxels, normal_neighbours, feature_voxels, feature_neighbours
        Radii in voxels, and how many neighbours at most, of normals and of FPFH.
    mutual, ransac_voxels, edge_ratio, ransac_iterations, confidence
        RANSAC: mutual filter, distance check in voxels, edge-length check, and when it ends.
    icp_voxels, icp_iterations
        Point-to-point ICP on the full clouds.
    target_points
        Points that stand for the template.
    inlier_mm, least_explained
        A real print lies this near to its template nearly everywhere, or as near as the last search
        radius; so large a share of the points must.
    ransac, icp, iterate
        Off for the ablations of the paper's Table 4.
    """

    voxel: float = 0.03
    threshold: float = 0.016
    threshold_step: float = 0.001
    iterations: int = 10
    loss: str = "chamfer"
    loss_points: int = 0
    loss_on_voxels: bool = False
    normal_voxels: float = 2.0
    normal_neighbours: int = 30
    feature_voxels: float = 5.0
    feature_neighbours: int = 100
    mutual: bool = True
    ransac_voxels: float = 1.5
    edge_ratio: float = 0.9
    ransac_iterations: int = 100_000
    confidence: float = 0.999
    icp_voxels: float = 0.4
    icp_iterations: int = 100
    target_points: int = 50_000
    inlier_mm: float = 0.3
    least_explained: float = 0.5
    ransac: bool = True
    icp: bool = True
    iterate: bool = True

    def __post_init__(self) -> None:
        if not 1e-3 <= self.voxel <= 0.5:
            raise InputError(f"PAM's voxel is {self.voxel} radii; choose 0.001 to 0.5")
        if self.loss not in LOSSES:
            raise InputError(f"PAM's loss '{self.loss}' is unknown; choose {', '.join(LOSSES)}")
        if self.iterations < 1 or self.target_points < 100:
            raise InputError(
                f"PAM needs at least 1 iteration and 100 points of the template, got "
                f"{self.iterations} and {self.target_points}"
            )


PUBLISHED_PAM = PamOptions()
# The released code: its loss is directed, on 5,000 points of the down-sampled clouds.
RELEASED_PAM = PamOptions(
    threshold=1.6,
    threshold_step=0.1,
    loss="directed",
    loss_points=5_000,
    loss_on_voxels=True,
)
PAM_VARIANTS = {"paper": PUBLISHED_PAM, "code": RELEASED_PAM}


@dataclass(frozen=True, slots=True)
class AlignOptions:
    """Settings of an alignment; a registration records those it was made with.

    Attributes
    ----------
    least_points
        Of a scan.
    stands_upright
        The scan is in the bed's frame, and the part stands on the bed.
    upright_deg, lean_believed
        Less is no lean: calibrations are off by as much. Of a part that stands upright a lean is
        believed that leaves less than this share of the loss that it has upright: one whose layers
        lie aside has 0.95 and more of it, and one that really leans is found to lean from either.
    least_explained, least_of_known
        Share of the points that the pose must explain: views of other parts lay up to two thirds
        of themselves on one. Where the part is known for certain, nearly every printed defect
        passes with the second.
    much_left_out, least_of_rest
        Where so much of the scan is taken for what surrounds the part, no more than the others of
        the rest may stand out of it: of 54 damaged parts on their beds none did, and 85 % of them
        and more lay on their templates; of 408 scans of other things two thirds at most lay on it,
        and all that came near stood out. Where the rest is one of several pieces, so much of it
        must lie on the part: some tenth of a view of another part always fits (up to 92 % of it
        did).
    mirrored_better
        Of what is left unexplained, where the mirror image is meant.
    smallest_ratio, largest_ratio
        Scan's size over the template's: beyond these it is another unit, or too little of the
        part; large scans hold the bed.
    unit_slack
        A view may show less than the part, a turned box more, by this factor.
    told_size_jump
        Sizes that differ by more are worth a word.
    sight_points
        That tell whether the sensors could have seen the part in a pose.
    guess, coarse, poses, explained, families, clutter, bed, level
        Of each stage.
    paper
        Of the published method.
    """

    least_points: int = 50
    stands_upright: bool = False
    upright_deg: float = 0.3
    lean_believed: float = 0.5
    least_explained: float = 0.7
    least_of_known: float = 0.35
    much_left_out: float = 0.4
    least_of_rest: float = 0.95
    mirrored_better: float = 0.4
    smallest_ratio: float = 0.15
    largest_ratio: float = 20.0
    unit_slack: float = 1.8
    told_size_jump: float = 1.6
    sight_points: int = 4_000
    guess: GuessOptions = field(default_factory=GuessOptions)
    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    poses: PoseOptions = field(default_factory=PoseOptions)
    explained: ExplainedOptions = field(default_factory=ExplainedOptions)
    families: FamilyOptions = field(default_factory=FamilyOptions)
    clutter: ClutterOptions = field(default_factory=ClutterOptions)
    bed: BedOptions = field(default_factory=BedOptions)
    level: LevelOptions = field(default_factory=LevelOptions)
    paper: PamOptions = PUBLISHED_PAM


DEFAULT_ALIGN = AlignOptions()
"""What the loop and the command line go by."""
