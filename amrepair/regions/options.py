"""What the test is set to: each number once, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass, field

from amrepair.errors import InputError
from amrepair.field.options import EvidenceOptions, SurfelOptions
from amrepair.observe.options import BackgroundOptions
from amrepair.template.laid import SUNK_LAYERS


@dataclass(frozen=True, slots=True)
class SkippedOptions:
    """Lines of the job that rays went through.

    Attributes
    ----------
    sample_step_mm, samples_together
        Samples along a line, and so many of them are judged together.
    least_stretch_mm
        Shorter stretches are seams and corners.
    joined_mm, straight_on
        A line goes on in the next that begins where it ends, unless it turns there by more than
        45° (cosine): that is a corner, and plastic cuts it.
    gone_share, sure_share
        How far in the open a bead lies where it is gone, on the whole of a stretch, by the rays
        that meet its core: −1 on its top, 1 on its floor. Half of its plastic is 0, and pixels
        beside a silhouette let rays run past a wall. And over half of such a stretch, which must be
        the surer.
    gone_erring
        The first of the two where the scanner errs: of 114 sound looks, most at parts never tuned
        on, two told lines at 0.5 to 0.6, none at more.
    least_again_mm, same_layer_mm
        In a layer of which a stretch is gone others may be shorter.
    errs_over, errs_along_mm, most_together_mm
        Rays that end so many heights over a line's middle are errors that count. Where a scanner
        errs a line is judged over so much at least, as recorded errors that lie far off are no
        longer, and over so much at most.
    below_line_mm, wall_mm, most_shift_mm, upright_wall
        The walls that tell how far in a line stands: so far below the last lines' middles and so
        deep, as far off as a part shrinks and no farther, and upright (cosine).
    wall_cells, least_wall_cells, beside_wall_mm, same_wall
        Of so many cells near a line those of the nearest wall (cosine), a few at least.
    wall_share, wall_off_mm, shrinks_ratio
        What one of all walls' cells is worth, as errors hang together along a wall, and what it
        is off by as beads wander, where all of them tell how much the part is aside or has shrunk;
        and by what share plastic shrinks: one standard deviation.
    under_share
        Of a line's width: a ray that meets it so near to its middle ends there.
    held_places, alike, there_of_alike
        Places across a line that rest on the layer below or not. How low a line over a rim lies, so
        many samples of lines held alike tell, of which so many are taken to be there: over 50 mm.
    held_share
        Of a line's width: with less over what lies below a line hangs; walls that lean are held
        by a sixth.
    sunk_layers
        So many layers over strands that hang lie lower by what strands hang lower.
    sunk_cells, least_sunk_cells, sunk_reach_mm, sunk_share
        How much lower, so many of the nearest cells over strands tell, a few at least, no farther
        off: of their depths this quantile, as of lines that are gone the floor lies deeper.
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


USUAL_SKIPPED = SkippedOptions()
"""What the deficit goes by."""


@dataclass(frozen=True, slots=True)
class WallEndOptions:
    """Broken ends of thin walls, where no rays tell that the wall is gone.

    Attributes
    ----------
    stray_sigmas
        So much of a point's noise below the surface noise alone leaves one point in 700.
    thin_depths
        A wall no thicker than so many times a point's depth: the point lies in its middle half.
    """

    stray_sigmas: float = 3.0
    thin_depths: float = 4.0


@dataclass(frozen=True, slots=True)
class RegionOptions:
    """Settings of the test for regions; a result records those it was made with.

    Attributes
    ----------
    false_regions
        Expected number of regions that a scan of a sound part shows: the promise of the test,
        shared out over scales, signs and places.
    tolerance_mm
        δ, by how much a sound part may depart anywhere; None adds up the three that follow and
        the template's own bias.
    allowance_mm
        What the process may leave. Half a 0.2 mm layer: what section-at-mid-layer leaves on slopes
        and rounds off at tops.
    top_allowance_mm
        The same under the plane of the layer just printed, which lies where the job's G-code puts
        it: a quarter of a layer is left to the beads.
    registration_sigma_mm
        Standard deviation of the alignment at the surface.
    process_sigma_mm
        By how much sound parts of this process depart from the template as a whole, as a profile
        or a calibration knows it; 0 where nobody does: then all of it is taken for the scanner's.
    widest_mm
        Windows of local means reach up to this width: correlated errors of desktop and laser
        scanners hang together over 2 to 10 mm, so that wider means gain nothing.
    correlation_mm
        Errors hang together over about so far, where what belongs to the whole part is fitted.
    far_mm
        Windows between half of this and this far apart tell by how much errors wander: twice the
        length over which they hang together.
    most_wander
        Local means of well seen places wander by at most so many times the noise of one point: on
        the ten views of a real object 0.3 to 0.5 times, merged 0.1.
    tail_from
        Standard errors beyond the tolerance from which on exceedances tell the tail.
    longest_tail
        Standard errors over which exceedances of sound places fall to 1/e, at most: on twelve real
        range scans 0.2 to 1.5. A calibration takes what lies far off to spread so far before it
        has seen any.
    one_sided
        So many times as many outlying cells a scanner's errors leave on one side of the template
        as on the other, at most: in eleven real scans up to twice.
    grow_share
        A region goes on to where the mean deviation is this share of the tolerance.
    grow_sigmas
        … and beyond the noise by so many standard errors: 95 % of noise stays below.
    seen_step
        Classes of how densely and how squarely a place was seen, in octaves: aslant and at its
        edges a scanner sees fewer points an area, and worse ones.
    least_cells
        Cells from which the noise of a class is told; with fewer it is that of the class below.
        A scan with fewer in all cannot tell its noise: the profile's is used, and named.
    most_windows, bed_windows
        So many windows tell by how much means wander: enough for a few per cent; of the bed, for a
        tenth.
    spacing_mm
        Template surface points are asked for so far apart.
    guess_depths
        Behind surface that stands, as thick as a part may be there, a place is nobody's knowledge
        where a template's guess lies within so many times its depth.
    wall_ends, background, surfels, evidence
        Where thin walls broke off, what is not the part, how the scan is condensed, and how space
        around broken surface is known.
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
    wall_ends: WallEndOptions = field(default_factory=WallEndOptions)
    background: BackgroundOptions = field(default_factory=BackgroundOptions)
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
