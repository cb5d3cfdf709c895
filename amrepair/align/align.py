"""`align`: the pose of a scan in its template, from a guess or from any pose at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from amrepair.align.anywhere import Found, explained_if_mirrored, pose_from_anywhere
from amrepair.align.bed import bed_prior, level_on_bed
from amrepair.align.level import is_level
from amrepair.align.options import DEFAULT_ALIGN, AlignOptions
from amrepair.align.pam import align_paper
from amrepair.align.poses import explained
from amrepair.align.refine import Prior, Refined, refine
from amrepair.align.registration import Registration
from amrepair.align.sizes import other_size, refuse_other_size
from amrepair.align.standing import box_on_bed, stood_up
from amrepair.align.thinning import in_order, thin_out
from amrepair.arrays import Mask, Matrix, Points, Vector
from amrepair.errors import AlignmentError, InputError, PartMovedError
from amrepair.frames import Transform, in_box, moved, turned_rad
from amrepair.scans import Scan
from amrepair.template.port import Template, is_off_bed
from gcode.progress import Progress, silent

Aside = Callable[[Points], Mask]
ALIGN_METHODS = ("robust", "paper")
LOOK_AT = 5_000  # repeats of a few places show in a sample
ALONG = np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])  # places that differ along it differ


@dataclass(frozen=True, slots=True)
class SoFar:
    """What stands of a part in mid-print, as its job has laid it.

    Attributes
    ----------
    planned
        In the template's frame.
    from_mm
        Height there from which on it is to be trusted: planned beads may end in mid-air below.
    """

    planned: Template
    from_mm: float


def align(
    scan: Scan,
    template: Template,
    *,
    method: str = "robust",
    guess: Transform | None = None,
    so_far: SoFar | None = None,
    aside: Aside | None = None,
    part_is_known: bool = False,
    options: AlignOptions = DEFAULT_ALIGN,
    rng: np.random.Generator | None = None,
    progress: Progress = silent,
) -> Registration:
    """Find where a scan lies in the template.

    Parameters
    ----------
    scan
        In any frame; bed around the part is welcome where there is a guess.
    guess
        Template from the scan's frame, good to the options' bounds; only refinement runs then.
    so_far
        What a guess is refined on in mid-print, where walls and infill lie open that no drawing
        has: drawn walls alone pull the pose aside by tenths of a millimetre where one is missing.
        The bed is found by `template` all the same.
    aside
        Which points, template frame, lie on what is known to stand beside the part, as supports:
        a guess is refined without them, and they are not counted as what does not fit.
    part_is_known
        The scan is of this part and no mirror image, however bent: less of it has to fit.
    options
        Of both methods: how poses are searched, and which are accepted.
    rng
        Chooses the points that are looked at; a fixed seed by default.

    Raises
    ------
    AlignmentError
        If no pose explains the scan, the refinement does not converge, or it leaves the guess.
    InputError
        If the method is unknown, or the guess starts from another frame.

    Examples
    --------
    >>> from pathlib import Path
    >>> from amrepair import align_scan, open_template, read_scan
    >>> scan = read_scan(Path("scan.ply"), frame="scanner")
    >>> found = align_scan(scan, open_template(Path("part.safetensors")))
    >>> [round(float(v)) for v in found.template_from_scan.translation_mm]  # x = 100, y = 80
    [-100, -80, 0]
    >>> found.rmse_mm < 0.05
    True
    """
    if method not in ALIGN_METHODS:
        raise InputError(
            f"the method '{method}' is unknown; choose one of {', '.join(ALIGN_METHODS)}"
        )
    if len(scan) < options.least_points:
        raise AlignmentError(
            f"the scan {scan.source} has fewer points ({len(scan)}) than an alignment needs "
            f"({options.least_points})"
        )
    _refuse_repeated(scan, options.least_points)
    rng = rng if rng is not None else np.random.default_rng(0)
    if method == "paper":
        refuse_other_size(scan, template, options)
        found = align_paper(
            scan, template, options=options.paper, guess=guess, rng=rng, progress=progress
        )
        return replace(found, options=options)
    progress("align", 0.0, 1.0)
    if guess is None:
        refuse_other_size(scan, template, options)
        return _from_anywhere(scan, template, part_is_known, options, rng, progress)
    if guess.source != scan.frame:
        raise InputError(
            f"the guess starts from frame {guess.source}, the scan {scan.source} is in {scan.frame}"
        )
    sigma_mm, inlier_mm = options.explained.limits_mm(scan.sigma_mm)
    refined, points_mm = _from_guess(scan, template, so_far, aside, guess, sigma_mm, options, rng)
    progress("align", 1.0, 1.0)
    ratio = explained(refined, inlier_mm)
    least = options.guess.least_explained
    if ratio < least and _is_stopped(refined, points_mm, inlier_mm, options):
        least = 0.0
    _refuse_misfit(scan, refined, ratio, inlier_mm, least, "")
    answer = Found(refined, (), ratio, scan.points_mm, 0.0, sigma_mm, inlier_mm)
    return _registration(scan, answer, options)


def _refuse_repeated(scan: Scan, least: int) -> None:
    """Refuse a scan that says the same few places again and again.

    Raises
    ------
    AlignmentError
        If there are fewer different points than `least`.
    """
    step = max(1, len(scan) // LOOK_AT)
    if len(np.unique(scan.points_mm[::step] @ ALONG)) >= least:
        return
    different = len(np.unique(scan.points_mm, axis=0))
    if different < least:
        raise AlignmentError(
            f"the scan {scan.source} has only {different} different points among {len(scan)}; an "
            f"alignment needs {least}; check the export"
        )


def _from_anywhere(
    scan: Scan,
    template: Template,
    part_is_known: bool,
    options: AlignOptions,
    rng: np.random.Generator,
    progress: Progress,
) -> Registration:
    """From any pose; a mirror image and too little of the part are refused."""
    least = options.least_of_known if part_is_known else options.least_explained
    found = pose_from_anywhere(
        _over_bed(scan, options),
        template,
        sigma_mm=scan.sigma_mm,
        options=options,
        rng=rng,
        least_ratio=least,
        progress=progress,
    )
    found = _as_it_was_seen(scan, template, found, options, rng)
    ratio = found.explained_ratio
    progress("align", 1.0, 1.0)
    if not part_is_known:
        if options.least_of_known < ratio < options.explained.doubtful:
            _refuse_mirrored(scan, template, found, found.part_mm, ratio, options, rng)
        if found.left_out_ratio > 0.0:  # what was left out may be half of the other hand
            whole = ratio * (1.0 - found.left_out_ratio)
            _refuse_mirrored(scan, template, found, scan.points_mm, whole, options, rng)
    sizes = other_size(scan, template, options)
    in_surroundings = found.left_out_ratio > options.much_left_out and not part_is_known
    if in_surroundings:
        sizes = f" ({found.left_out_ratio:.0%} of the scan are taken for its surroundings){sizes}"
        least = options.least_of_rest if found.is_piece else least
    if not part_is_known and ratio >= options.least_of_known:
        sizes += (
            "; if it is this part for certain, only bent, say so (align, detect and repair take "
            "--part-is-known)"
        )
    _refuse_misfit(scan, found.best, ratio, found.inlier_mm, least, sizes)
    if in_surroundings:
        _refuse_standing_out(scan, found, 1.0 - options.least_of_rest, sizes)
    if options.stands_upright:  # it is this part, however it stands
        found = _as_drawn(found, template, options, rng)
        points = in_order(thin_out(found.part_mm, options.poses.dense_points, rng))
        anywhere_mm = np.full(3, options.guess.bound_mm)
        best = _as_it_stands(points, template, found.best, anywhere_mm, found.sigma_mm, options)
        best = _on_its_bed(scan, points, template, best, found.sigma_mm, options)
        if best is not found.best:
            moved_by = np.linalg.inv(found.best.matrix) @ best.matrix
            others = tuple(other @ moved_by for other in found.others)
            ratio = explained(best, found.inlier_mm)
            found = replace(found, best=best, others=others, explained_ratio=ratio)
    return _registration(scan, found, options)


def _over_bed(scan: Scan, options: AlignOptions) -> Points:
    """A scan's points without the bed, which in the printer's own frame is known to be at Z = 0."""
    if not options.stands_upright:
        return scan.points_mm
    over = scan.points_mm[:, 2] > options.guess.above_bed_mm
    return scan.points_mm[over] if over.sum() >= options.clutter.least_left else scan.points_mm


def _as_drawn(
    found: Found, template: Template, options: AlignOptions, rng: np.random.Generator
) -> Found:
    """Of a symmetric part's poses that fit alike, the one that stands as it was drawn."""
    upright = [k for k, other in enumerate(found.others) if _is_upright(other, options)]
    if not upright or _is_upright(found.best.matrix, options):
        return found
    others = [*found.others]
    best = _finished(others.pop(upright[0]), found, template, options, rng)
    return replace(found, best=best, others=(found.best.matrix, *others))


def _finished(
    matrix: Matrix,
    found: Found,
    template: Template,
    options: AlignOptions,
    rng: np.random.Generator,
) -> Refined:
    """Another of the poses that were found, refined as the best one was."""
    scale_mm = options.poses.scale_mm(found.sigma_mm)
    return refine(
        in_order(thin_out(found.part_mm, options.poses.dense_points, rng)),
        template,
        matrix,
        start_scale_mm=scale_mm,
        end_scale_mm=scale_mm,
        sigma_mm=found.sigma_mm,
    )


def _on_its_bed(
    scan: Scan,
    points_mm: Points,
    template: Template,
    best: Refined,
    sigma_mm: float,
    options: AlignOptions,
) -> Refined:
    """The pose with the part's foot on the bed, where the bed was seen or the part was sunk in it.

    A print that stopped early fits its template as well where it is sunk until the tops agree.
    """
    if not _is_upright(best.matrix, options):
        return best
    shift = np.eye(4)  # up to the bed, in the scan's frame
    shift[2, 3] = -max(0.0, -_foot_mm(template, best.matrix))
    stood, on_bed = level_on_bed(scan.points_mm, template, best.matrix @ shift, options.bed)
    if not on_bed and shift[2, 3] == 0.0:
        return best
    scale_mm = options.poses.scale_mm(sigma_mm)
    known = _guess_prior(stood, on_bed, options)
    return refine(
        points_mm,
        template,
        stood,
        start_scale_mm=scale_mm,
        end_scale_mm=scale_mm,
        sigma_mm=sigma_mm,
        prior=replace(known, rotation_rad=np.full(3, options.bed.tilt_sigma_rad)),
        max_iterations=options.guess.most_steps,
    )


def _foot_mm(template: Template, matrix: Matrix) -> float:
    """How high over the bed a pose, template from build, puts the lowest of a part."""
    return float(box_on_bed(template, Transform("template", "build", matrix).inverse())[0, 2])


def _as_it_was_seen(
    scan: Scan, template: Template, found: Found, options: AlignOptions, rng: np.random.Generator
) -> Found:
    """Without the poses in which the sensors would have looked from within the part.

    A view of one side of a plate fits the other side as well; where the sensors stood decides.
    """
    if scan.sensors_mm is None or scan.sensor_index is None or not found.others:
        return found
    some = rng.permutation(len(scan))[: options.sight_points]
    points = scan.points_mm[some]
    to_sensor = scan.sensors_mm[scan.sensor_index[some]] - points

    def is_possible(matrix: Matrix) -> bool:
        placed = moved(points, matrix)
        distance, outward = template.distance_and_gradient(placed)
        near = np.abs(distance) <= found.inlier_mm
        facing = np.einsum("ni,ni->n", outward, to_sensor @ matrix[:3, :3].T) > 0.0
        return bool(near.any() and facing[near].mean() > 0.5)

    others = [other for other in found.others if is_possible(other)]
    best, ratio = found.best, found.explained_ratio
    if not is_possible(best.matrix):
        if not others:  # then it is the sensors' places that are wrong
            return found
        best = _finished(others.pop(0), found, template, options, rng)
        ratio = explained(best, found.inlier_mm)
    return replace(found, best=best, others=tuple(others), explained_ratio=ratio)


def _as_it_stands(
    points_mm: Points,
    template: Template,
    leaning: Refined,
    shift_mm: Vector,
    sigma_mm: float,
    options: AlignOptions,
) -> Refined:
    """Upright, unless a lean explains far more at the scale of the noise.

    Layers that lie aside of those below look like a part that leans, which fits neither of them;
    and so do tops that lie too low, which say nothing of a lean.
    """
    centre = moved(points_mm.mean(axis=0)[None], leaning.matrix)[0]
    most_rad = np.deg2rad(options.guess.bound_deg)
    upright = stood_up(template, leaning.matrix, centre, most_rad)
    turn = upright[:3, :3] @ leaning.matrix[:3, :3].T
    if turned_rad(turn) < np.deg2rad(options.upright_deg):
        return leaning
    scale_mm = options.poses.scale_mm(sigma_mm)
    # it leans about some place of its own: at first all but the turn is found again
    as_turned = Prior(np.full(3, options.bed.tilt_sigma_rad), shift_mm)
    stands = refine(
        points_mm,
        template,
        upright,
        start_scale_mm=options.guess.start_scale_mm,
        end_scale_mm=scale_mm,
        sigma_mm=sigma_mm,
        prior=as_turned,
    )
    free = Prior(np.full(3, most_rad), shift_mm)
    tilt_rad = options.bed.tilt_sigma_rad if _is_upright(stands.matrix, options) else most_rad
    held = Prior(np.array([tilt_rad, tilt_rad, most_rad]), shift_mm)
    leans, stands = (
        refine(
            points_mm,
            template,
            start.matrix,
            start_scale_mm=scale_mm,
            end_scale_mm=scale_mm,
            sigma_mm=sigma_mm,
            prior=prior,
        )
        for start, prior in ((leaning, free), (stands, held))
    )
    inlier_mm = options.explained.limits_mm(sigma_mm)[1]
    tells = ~_is_low_top(points_mm, stands, inlier_mm, options)
    is_lean = leans.loss(scale_mm, tells) < options.lean_believed * stands.loss(scale_mm, tells)
    return leaning if is_lean or not stands.converged else stands


def _refuse_mirrored(
    scan: Scan,
    template: Template,
    found: Found,
    points_mm: Points,
    ratio: float,
    options: AlignOptions,
    rng: np.random.Generator,
) -> None:
    """Refuse a left hand where a right hand was meant: its mirror image fits far better."""
    mirrored = explained_if_mirrored(points_mm, found, template, options, rng)
    if 1.0 - mirrored < options.mirrored_better * (1.0 - ratio):
        # A scan of another part may also fit better mirrored.
        is_other_hand = mirrored >= options.explained.doubtful
        said = "shows the mirror image of" if is_other_hand else "does not fit"
        raise AlignmentError(
            f"the scan {scan.source} {said} its template: mirrored, "
            f"{mirrored:.0%} of its points lie within {found.inlier_mm:.2g} mm, as it is "
            f"{ratio:.0%}; check the part and the export's axes (left-handed?), or take the "
            "template of the other hand"
        )


def _refuse_misfit(
    scan: Scan, found: Refined, ratio: float, inlier_mm: float, least: float, sizes: str
) -> None:
    if found.converged and ratio >= least:
        return
    raise AlignmentError(
        f"the scan {scan.source} does not fit its template: {ratio:.0%} of its points lie "
        f"within {inlier_mm:.2g} mm (at least {least:.0%} are needed)"
        + ("" if found.converged else " and the refinement did not converge")
        + f"; check part, unit and calibration{sizes}"
    )


def _refuse_standing_out(scan: Scan, found: Found, most: float, sizes: str) -> None:
    if found.outside_ratio <= most:
        return
    raise AlignmentError(
        f"the scan {scan.source} does not fit its template: {found.outside_ratio:.0%} of its "
        f"points stand out of it by more than {found.inlier_mm:.2g} mm (at most {most:.0%} may); "
        f"check part, unit and calibration{sizes}"
    )


def _registration(scan: Scan, found: Found, options: AlignOptions) -> Registration:
    best = found.best
    inlier = np.abs(best.residual_mm) <= found.inlier_mm
    return Registration(
        template_from_scan=Transform("template", scan.frame, best.matrix),
        rmse_mm=float(np.sqrt(np.mean(best.residual_mm[inlier] ** 2))),
        inlier_ratio=found.explained_ratio,
        clutter_ratio=found.left_out_ratio,
        information=best.information,
        symmetric_alternatives=tuple(
            Transform("template", scan.frame, other) for other in found.others
        ),
        method="robust",
        iterations=best.iterations,
        options=options,
    )


def _from_guess(
    scan: Scan,
    template: Template,
    so_far: SoFar | None,
    aside: Aside | None,
    guess: Transform,
    sigma_mm: float,
    options: AlignOptions,
    rng: np.random.Generator,
) -> tuple[Refined, Points]:
    """The pose, and the points that it was found by."""
    least, most = options.least_points, options.poses.dense_points
    bound_mm, bound_deg = options.guess.bound_mm, options.guess.bound_deg
    levelled, on_bed = guess.matrix, False
    if not is_off_bed(template):  # a planned one is cut: its foot is in mid-air
        levelled, on_bed = level_on_bed(scan.points_mm, template, guess.matrix, options.bed)
    step = max(1, len(scan) // options.guess.most_points)
    points = _part_only(scan.points_mm[::step], template, levelled, options)
    if aside is not None:
        points = np.compress(~aside(moved(points, levelled)), points, axis=0)
    if so_far is not None:
        points = np.compress(moved(points, levelled)[:, 2] > so_far.from_mm, points, axis=0)
    if len(points) < least:
        raise AlignmentError(
            f"the scan {scan.source} has {len(points)} points where the part should stand; check "
            "the scanner's calibration and the part's pose"
        )
    points = points[:: -(-len(points) // (4 * most))]
    points = in_order(thin_out(points, most, rng))
    prior = _guess_prior(levelled, on_bed, options)
    expected = template if so_far is None else so_far.planned
    found = refine(
        points,
        expected,
        levelled,
        start_scale_mm=options.guess.start_scale_mm,
        end_scale_mm=options.poses.scale_mm(sigma_mm),
        sigma_mm=sigma_mm,
        prior=prior,
        max_iterations=options.guess.most_steps,
    )
    if options.stands_upright:
        found = _as_it_stands(points, expected, found, prior.translation_mm, sigma_mm, options)
    away = found.matrix @ np.linalg.inv(guess.matrix)
    centre = points.mean(axis=0) @ guess.matrix[:3, :3].T + guess.matrix[:3, 3]
    moved_mm = float(np.linalg.norm(away[:3, :3] @ centre + away[:3, 3] - centre))
    turned_deg = float(np.rad2deg(turned_rad(away[:3, :3])))
    if moved_mm > bound_mm or turned_deg > bound_deg:
        raise PartMovedError(
            f"the scan {scan.source} fits its template only {moved_mm:.2f} mm and "
            f"{turned_deg:.2f}° away from where it should be (limits {bound_mm:g} mm and "
            f"{bound_deg:g}°); the part has come off and moved, or the calibration is wrong"
        )
    return found, points


def _guess_prior(matrix: Matrix, on_bed: bool, options: AlignOptions) -> Prior:
    """How far a pose may be off its guess; of what stands on its bed the height is known better."""
    turn_rad, shift_mm = np.deg2rad(options.guess.bound_deg), options.guess.bound_mm
    if on_bed:
        return bed_prior(turn_rad, shift_mm, options.bed)
    wide = Prior(np.full(3, turn_rad), np.full(3, shift_mm))
    if not options.stands_upright or not _is_upright(matrix, options):
        return wide
    return replace(wide, translation_mm=np.array([shift_mm, shift_mm, options.bed.frame_sigma_mm]))


def _is_upright(matrix: Matrix, options: AlignOptions) -> bool:
    """Whether the template's Z is the scan's."""
    return bool(matrix[2, 2] > np.cos(np.deg2rad(options.guess.bound_deg)))


def _is_stopped(found: Refined, points_mm: Points, inlier_mm: float, options: AlignOptions) -> bool:
    """Whether what lies in the part is the tops of its layers, and its walls are the part's.

    A print may have stopped at any height, and its layers may lie too low; where a wall of it
    stands, no layer moves.
    """
    if (found.residual_mm > inlier_mm).mean() > 1.0 - options.least_of_rest:
        return False
    on = int((np.abs(found.residual_mm) <= inlier_mm).sum())
    judging = int((~_is_low_top(points_mm, found, inlier_mm, options)).sum())
    return on >= max(options.least_points, options.guess.least_of_walls * judging)


def _is_low_top(points_mm: Points, found: Refined, inlier_mm: float, options: AlignOptions) -> Mask:
    """(n,) points that lie in the part and on a level surface."""
    low = found.residual_mm < -inlier_mm
    placed = moved(points_mm, found.matrix)
    low[low] = is_level(placed, np.flatnonzero(low), options.level)
    return low


def _part_only(
    points_mm: Points, template: Template, matrix: Matrix, options: AlignOptions
) -> Float[np.ndarray, "m 3"]:
    """Points that can lie on the part: in its box, and above the bed."""
    low, high = template.bounds_mm
    placed = moved(points_mm, matrix)
    beside_mm = options.guess.beside_mm
    near = in_box(placed, low - beside_mm, high + beside_mm)
    above = placed[:, 2] > low[2] + options.guess.above_bed_mm
    # A flat part seen from below has no other points: then all points in the box count.
    keep = near & above if (near & above).sum() >= options.least_points else near
    return np.compress(keep, points_mm, axis=0)
