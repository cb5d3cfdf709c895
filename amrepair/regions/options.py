"""Options of detection: each number once, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.errors import InputError
from amrepair.field.options import EvidenceOptions, SurfelOptions
from amrepair.observe.options import BackgroundOptions, OrderOptions
from amrepair.template.laid import SUNK_LAYERS


@dataclass(frozen=True, slots=True)
class SkippedOptions:
    """How missing lines of the job are found, by rays that went through them.

    Attributes
    ----------
    sample_step_mm, samples_together
        Distance between samples along a line, and how many samples are judged together.
    least_stretch_mm
        Shorter missing stretches are seams and corners.
    joined_mm, straight_on
        A line continues in the next one if that begins within `joined_mm` of its end and turns by
        no more than 45° (`straight_on` is the cosine). A sharper turn is a corner, which plastic
        cuts short.
    gone_share, sure_share
        A stretch is missing if it is this open on average, as told by the rays that meet its
        core, where −1 is its top, 0 half of its plastic, and 1 its floor. It is missing, too, if
        half as many samples are open by `sure_share`, which is higher for fewer. Both are
        well above 0, since pixels beside a silhouette let rays run past a wall.
    gone_erring
        Takes the place of `gone_share` where the scanner errs. Of 114 sound looks, most at parts
        never tuned on, two showed lines as open as 0.5 to 0.6, none more.
    least_again_mm, same_layer_mm
        Least length of a further stretch in a layer where one is missing already; lines within
        `same_layer_mm` of height are of one layer.
    errs_over, errs_along_mm, most_together_mm
        Rays that end up to `errs_over` line heights above a line's middle show the scanner's
        errors. Where it errs, a line is judged over at least `errs_along_mm`, since recorded
        outliers are no longer than that, and at most over `most_together_mm`.
    below_line_mm, wall_mm, most_shift_mm, upright_wall
        Which walls tell how far inside its plan a line stands: from `below_line_mm` below the top
        lines' middles down by `wall_mm`, no farther off than `most_shift_mm`, as parts shrink no
        more, and upright (a cosine).
    wall_cells, least_wall_cells, beside_wall_mm, same_wall
        Of the `wall_cells` nearest cells within `beside_wall_mm` of a line, those of the nearest
        wall count (`same_wall`, a cosine), if they are `least_wall_cells` or more.
    wall_share, wall_off_mm, shrinks_ratio
        For the fit of shift, turn and shrinkage to all walls: how much a single cell counts, since
        errors are correlated along a wall; its standard deviation, as beads wander; and the
        standard deviation of the plastic's shrinkage.
    under_share
        A ray meets a line if it passes within this share of the line's width of its middle.
    held_places, alike, there_of_alike
        At how many places across a line it is asked whether the layer below holds it. How low a
        line over a rim may lie is told by `alike` samples of lines held alike, over 50 mm, of which
        the share `there_of_alike` is taken to be there.
    held_share
        A line hangs if less than this share of its width lies over the layer below. Leaning walls
        are held by a sixth.
    sunk_layers
        So many layers over hanging strands lie lower, as those strands do.
    sunk_cells, least_sunk_cells, sunk_reach_mm, sunk_share
        How much lower is told by the nearest cells over strands: at most `sunk_cells`, at least
        `least_sunk_cells`, within `sunk_reach_mm`. The quantile `sunk_share` of their depths is
        taken, since under a missing line the floor lies deeper.
    """

    sample_step_mm: float = 0.25
    samples_together: int = 5
    least_stretch_mm: float = 1.5
    joined_mm: float = 1e-3
    straight_on: float = 0.7
    gone_share: float = 0.5
    sure_share: float = 0.65
    gone_erring: float = 0.6
    least_again_mm: float = 1.0
    same_layer_mm: float = 0.05
    below_line_mm: float = 0.1
    wall_mm: float = 2.0
    most_shift_mm: float = 0.35
    upright_wall: float = 0.4
    wall_cells: int = 12
    least_wall_cells: int = 4
    beside_wall_mm: float = 1.5
    same_wall: float = 0.7
    wall_share: float = 0.1
    wall_off_mm: float = 0.1
    shrinks_ratio: float = 0.003
    errs_over: float = 2.5
    errs_along_mm: float = 4.0
    most_together_mm: float = 10.0
    under_share: float = 0.25
    held_places: int = 5
    alike: int = 200
    there_of_alike: float = 0.25
    held_share: float = 0.15
    sunk_layers: int = SUNK_LAYERS
    sunk_cells: int = 24
    least_sunk_cells: int = 4
    sunk_reach_mm: float = 2.0
    sunk_share: float = 0.25


DEFAULT_SKIPPED = SkippedOptions()
"""The default of the deficit."""


@dataclass(frozen=True, slots=True)
class WallEndOptions:
    """How broken ends of thin walls are found, where no rays tell that the wall is gone.

    Attributes
    ----------
    stray_sigmas
        A point may be part of an end if it lies this many standard deviations of its noise below
        the surface; noise alone leaves one point in 700 there.
    thin_depths
        A wall counts as thin if it is no thicker than this many times the point's depth, so that
        the point lies in its middle half.
    """

    stray_sigmas: float = 3.0
    thin_depths: float = 4.0


@dataclass(frozen=True, slots=True)
class RegionOptions:
    """Settings of detection; a result records those it was made with.

    Attributes
    ----------
    false_regions
        The expected number of false regions on a scan of a sound part. This is what the test
        promises; it is shared out over scales, signs and places.
    tolerance_mm
        δ, by how much a sound part may deviate anywhere. None combines `allowance_mm`,
        `registration_sigma_mm` and the template's own bias.
    allowance_mm
        How far off the template the process may leave a surface. Half a 0.2 mm layer: so much
        slicing at mid-layer leaves on slopes, and rounds off at tops.
    top_allowance_mm
        The same under the plane of the layer just printed. That plane lies where the G-code puts
        it, so only a quarter of a layer is left to the beads.
    registration_sigma_mm
        Standard deviation of the alignment, at the surface.
    process_sigma_mm
        By how much the surface of sound parts of this process wanders, as a profile knows it: taken
        off what a calibration tells. A scan alone does not tell the two apart.
    widest_mm
        The widest windows of local means. Errors of desktop and laser scanners are correlated over
        2 to 10 mm, so that wider means gain nothing.
    correlation_mm
        Over which length errors are taken to be correlated, where pose, scale and bow are fitted.
    far_mm
        The wander of errors is estimated from windows between half of this and this far apart:
        twice the length over which errors are correlated.
    most_wander
        The largest wander that is believed, in standard deviations of a single point. The ten views
        of a real object show 0.3 to 0.5, merged 0.1.
    tail_from
        The tail of the errors is fitted to peaks this many standard errors beyond the tolerance.
    longest_tail
        The longest tail that is believed: in standard errors, over which peaks of sound places fall
        to 1/e. Twelve real range scans show 0.2 to 1.5. A calibration that has seen no outlier
        takes this spread for them.
    one_sided
        How many times as many outliers errors may leave on one side of the template as on the
        other. In eleven real scans it is up to twice.
    grow_share, grow_sigmas
        A region grows to where the deviation is below `grow_share` of the tolerance plus
        `grow_sigmas` standard errors; 95 % of noise stays below the latter.
    seen_step
        Width, in octaves, of the classes of how densely and how squarely a place was seen. Aslant
        and at edges a scanner sees fewer and worse points.
    least_cells
        How many cells a class needs for its noise to be estimated; with fewer it takes that of the
        class before it. A scan with fewer in all cannot tell its noise: then the profile's is used,
        and named.
    most_windows, bed_windows
        How many windows the wander is estimated from: enough for a few per cent; on the bed, for a
        tenth.
    spacing_mm
        Distance between points on the template's surface.
    guess_depths
        A cell behind surface that stands is not judged if a place where the template was guessed
        lies within this many times the cell's depth.
    sheet_beads
        Two sheets of points at one place are an error if they lie closer than so many beads, as no
        thinner wall stands between them: slicers make one of two beads at least.
    wall_ends, background, order, surfels, evidence
        Options for the ends of thin walls, for what is not the part, for views told apart by the
        order of points, for condensing the scan, and for the space around broken surface.
    top_k
        How many of the highest scores make the object score (PASDF: 1000).
    """

    false_regions: float = 0.05
    tolerance_mm: float | None = None
    allowance_mm: float = 0.1
    top_allowance_mm: float = 0.05
    registration_sigma_mm: float = 0.03
    process_sigma_mm: float = 0.0
    widest_mm: float = 10.0
    correlation_mm: float = 2.5
    far_mm: float = 20.0
    most_wander: float = 3.0
    tail_from: float = 1.0
    longest_tail: float = 2.0
    one_sided: float = 2.0
    grow_share: float = 0.5
    grow_sigmas: float = 2.0
    seen_step: float = 0.5
    least_cells: int = 30
    most_windows: int = 3000
    bed_windows: int = 1000
    spacing_mm: float = 0.6
    guess_depths: float = 2.0
    sheet_beads: float = 2.0
    wall_ends: WallEndOptions = field(default_factory=WallEndOptions)
    background: BackgroundOptions = field(default_factory=BackgroundOptions)
    order: OrderOptions = field(default_factory=OrderOptions)
    surfels: SurfelOptions = field(default_factory=SurfelOptions)
    evidence: EvidenceOptions = field(default_factory=EvidenceOptions)
    top_k: int = 1000

    def __post_init__(self) -> None:
        if not self.false_regions > 0.0:
            raise InputError(
                f"the expected false regions per scan are {self.false_regions}; give more than 0, "
                "such as 0.05"
            )
        if self.tolerance_mm is not None and not self.tolerance_mm >= 0.0:
            raise InputError(f"the tolerance is {self.tolerance_mm} mm; it must be ≥ 0")
