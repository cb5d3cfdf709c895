"""`align`: the pose of a scan in its template, from a guess or from any pose at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from amrepair.align.anywhere import (
    DOUBTFUL,
    Found,
    explained_if_mirrored,
    limits_mm,
    pose_from_anywhere,
)
from amrepair.align.bed import bed_prior, level_on_bed
from amrepair.align.checks import refuse_repeated
from amrepair.align.pam import PUBLISHED_PAM, PamOptions, align_paper
from amrepair.align.refine import Prior, Refined, refine
from amrepair.align.registration import Registration
from amrepair.align.thinning import in_order, thin_out
from amrepair.errors import AlignmentError, InputError, PartMovedError
from amrepair.frames import Transform, in_box, moved
from amrepair.scans import Scan
from amrepair.template.port import Template, is_off_bed
from gcode.progress import Progress, silent

ALIGN_METHODS = ("robust", "paper")
FINE_POINTS, MOST_LOOKED_AT, SEEN_POINTS = 15_000, 150_000, 4_000
LEAST_SCAN_POINTS = 50
# A guess from a calibration is good to this; what is farther is not the part that was meant.
BOUND_MM, BOUND_DEG = 3.0, 3.0
# From a guess much of what is seen may be bed. From any pose less than this is another part: views
# of other parts lay up to two thirds of themselves on one; then nearly every printed defect passes.
LEAST_INLIERS, LEAST_FROM_ANYWHERE, LEAST_OF_KNOWN = 0.5, 0.7, 0.35
# Where so much of the scan is taken for what surrounds the part, the rest must lie on it well: of
# views of other parts some tenth always fits (up to 92 % of it did), of a part on its bed all.
MUCH_LEFT_OUT, LEAST_OF_REST = 0.4, 0.95
MIRRORED_BETTER = 0.4  # of what is left unexplained, where the mirror image is meant
# Sizes that differ by more are another unit, or too little of the part; large scans hold the bed.
SMALLEST_RATIO, LARGEST_RATIO = 0.15, 20.0
SCAN_UNITS = {"metres": 1e3, "inches": 25.4, "centimetres": 10.0, "micrometres": 1e-3}
UNIT_SLACK = 1.8  # a view may show less than the part, a turned box more
TOLD_SIZE_JUMP = 1.6  # sizes that differ by more are worth a word


def align(
    scan: Scan,
    template: Template,
    *,
    method: str = "robust",
    guess: Transform | None = None,
    bound_mm: float = BOUND_MM,
    bound_deg: float = BOUND_DEG,
    part_is_known: bool = False,
    pam_options: PamOptions = PUBLISHED_PAM,
    rng: np.random.Generator | None = None,
    progress: Progress = silent,
) -> Registration:
    """Find where a scan lies in the template.

    Parameters
    ----------
    scan
        In any frame; bed around the part is welcome where there is a guess.
    guess
        Template from the scan's frame, good to the bounds; only refinement runs then.
    bound_mm, bound_deg
        How far the result may lie from the guess.
    part_is_known
        The scan is of this part and no mirror image, however bent: less of it has to fit.
    pam_options
        Of the method `paper`: the code's variants and the ablations.
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
    if len(scan) < LEAST_SCAN_POINTS:
        raise AlignmentError(
            f"the scan {scan.source} has fewer points ({len(scan)}) than an alignment needs "
            f"({LEAST_SCAN_POINTS})"
        )
    refuse_repeated(scan, LEAST_SCAN_POINTS)
    rng = rng if rng is not None else np.random.default_rng(0)
    if method == "paper":
        _refuse_other_size(scan, template)
        return align_paper(
            scan, template, options=pam_options, guess=guess, rng=rng, progress=progress
        )
    progress("align", 0.0, 1.0)
    if guess is None:
        _refuse_other_size(scan, template)
        return _from_anywhere(scan, template, part_is_known, rng, progress)
    if guess.source != scan.frame:
        raise InputError(
            f"the guess starts from frame {guess.source}, the scan {scan.source} is in {scan.frame}"
        )
    sigma_mm, inlier_mm = limits_mm(scan.sigma_mm)
    found = _from_guess(scan, template, guess, sigma_mm, bound_mm, bound_deg, rng)
    progress("align", 1.0, 1.0)
    ratio = float((np.abs(found.residual_mm) <= inlier_mm).mean())
    _refuse_misfit(scan, found, ratio, inlier_mm, LEAST_INLIERS, "")
    answer = Found(found, (), ratio, scan.points_mm, 0.0, sigma_mm, inlier_mm)
    return _registration(scan, answer)


def _from_anywhere(
    scan: Scan,
    template: Template,
    part_is_known: bool,
    rng: np.random.Generator,
    progress: Progress,
) -> Registration:
    """From any pose; a mirror image and too little of the part are refused."""
    least = LEAST_OF_KNOWN if part_is_known else LEAST_FROM_ANYWHERE
    found = pose_from_anywhere(
        scan.points_mm,
        template,
        sigma_mm=scan.sigma_mm,
        rng=rng,
        least_ratio=least,
        progress=progress,
    )
    found = _as_it_was_seen(scan, template, found, rng)
    ratio = found.explained_ratio
    progress("align", 1.0, 1.0)
    if not part_is_known:
        if LEAST_OF_KNOWN < ratio < DOUBTFUL:
            _refuse_mirrored(scan, template, found, found.part_mm, ratio, rng)
        if found.left_out_ratio > 0.0:  # what was left out may be half of the other hand
            whole = ratio * (1.0 - found.left_out_ratio)
            _refuse_mirrored(scan, template, found, scan.points_mm, whole, rng)
    sizes = _other_size(scan, template)
    if found.left_out_ratio > MUCH_LEFT_OUT and not part_is_known:
        least = LEAST_OF_REST
        sizes = f" ({found.left_out_ratio:.0%} of the scan are taken for its surroundings){sizes}"
    if not part_is_known and ratio >= LEAST_OF_KNOWN:
        sizes += "; if it is this part for certain, only bent, say --part-is-known"
    _refuse_misfit(scan, found.best, ratio, found.inlier_mm, least, sizes)
    return _registration(scan, found)


def _as_it_was_seen(
    scan: Scan, template: Template, found: Found, rng: np.random.Generator
) -> Found:
    """Without the poses in which the sensors would have looked from within the part.

    A view of one side of a plate fits the other side as well; where the sensors stood decides.
    """
    if scan.sensors_mm is None or scan.sensor_index is None or not found.others:
        return found
    some = rng.permutation(len(scan))[:SEEN_POINTS]
    points = scan.points_mm[some]
    to_sensor = scan.sensors_mm[scan.sensor_index[some]] - points

    def is_possible(matrix: Float[np.ndarray, "4 4"]) -> bool:
        placed = points @ matrix[:3, :3].T + matrix[:3, 3]
        distance, outward = template.distance_and_gradient(placed)
        near = np.abs(distance) <= found.inlier_mm
        facing = np.einsum("ni,ni->n", outward, to_sensor @ matrix[:3, :3].T) > 0.0
        return bool(near.any() and facing[near].mean() > 0.5)

    others = [other for other in found.others if is_possible(other)]
    best, ratio = found.best, found.explained_ratio
    if not is_possible(best.matrix):
        if not others:  # then it is the sensors' places that are wrong
            return found
        best = refine(
            in_order(thin_out(found.part_mm, FINE_POINTS, rng)),
            template,
            others.pop(0),
            start_scale_mm=max(0.1, 3.0 * found.sigma_mm),
            end_scale_mm=max(0.1, 3.0 * found.sigma_mm),
            sigma_mm=found.sigma_mm,
        )
        ratio = float((np.abs(best.residual_mm) <= found.inlier_mm).mean())
    return replace(found, best=best, others=tuple(others), explained_ratio=ratio)


def _refuse_mirrored(
    scan: Scan,
    template: Template,
    found: Found,
    points_mm: Float[np.ndarray, "n 3"],
    ratio: float,
    rng: np.random.Generator,
) -> None:
    """Refuse a left hand where a right hand was meant: its mirror image fits far better."""
    mirrored = explained_if_mirrored(points_mm, found, template, rng)
    if 1.0 - mirrored < MIRRORED_BETTER * (1.0 - ratio):
        # A scan of another part may also fit better mirrored.
        said = "shows the mirror image of" if mirrored >= DOUBTFUL else "does not fit"
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


def _registration(scan: Scan, found: Found) -> Registration:
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
    )


def _from_guess(
    scan: Scan,
    template: Template,
    guess: Transform,
    sigma_mm: float,
    bound_mm: float,
    bound_deg: float,
    rng: np.random.Generator,
) -> Refined:
    levelled, on_bed = guess.matrix, False
    if not is_off_bed(template):  # a planned one is cut: its foot is in mid-air
        levelled, on_bed = level_on_bed(scan.points_mm, template, guess.matrix)
    step = max(1, len(scan) // MOST_LOOKED_AT)
    points = _part_only(scan.points_mm[::step], template, levelled)
    if len(points) < LEAST_SCAN_POINTS:
        raise AlignmentError(
            f"the scan {scan.source} has {len(points)} points where the part should stand; check "
            "the scanner's calibration and the part's pose"
        )
    points = points[:: -(-len(points) // (4 * FINE_POINTS))]
    points = in_order(thin_out(points, FINE_POINTS, rng))
    wide = Prior(np.full(3, np.deg2rad(bound_deg)), np.full(3, bound_mm))
    prior = bed_prior(np.deg2rad(bound_deg), bound_mm) if on_bed else wide
    found = refine(
        points,
        template,
        levelled,
        start_scale_mm=1.0,
        end_scale_mm=max(0.1, 3.0 * sigma_mm),
        sigma_mm=sigma_mm,
        prior=prior,
    )
    away = found.matrix @ np.linalg.inv(guess.matrix)
    centre = points.mean(axis=0) @ guess.matrix[:3, :3].T + guess.matrix[:3, 3]
    moved_mm = float(np.linalg.norm(away[:3, :3] @ centre + away[:3, 3] - centre))
    cosine = np.clip(0.5 * (np.trace(away[:3, :3]) - 1.0), -1.0, 1.0)
    turned_deg = float(np.rad2deg(np.arccos(cosine)))
    if moved_mm > bound_mm or turned_deg > bound_deg:
        raise PartMovedError(
            f"the scan {scan.source} fits its template only {moved_mm:.2f} mm and "
            f"{turned_deg:.2f}° away from where it should be (limits {bound_mm:g} mm and "
            f"{bound_deg:g}°); the part has come off and moved, or the calibration is wrong"
        )
    return found


def _part_only(
    points_mm: Float[np.ndarray, "n 3"], template: Template, matrix: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, "m 3"]:
    """Points that can lie on the part: in its box, and above the bed."""
    low, high = template.bounds_mm
    placed = moved(points_mm, matrix)
    near = in_box(placed, low - 3.0, high + 3.0)
    above = placed[:, 2] > low[2] + 0.35
    # A flat part seen from below has no other points: then all points in the box count.
    keep = near & above if (near & above).sum() >= LEAST_SCAN_POINTS else near
    return points_mm[keep]


def _other_size(scan: Scan, template: Template) -> str:
    """What to add to a refusal, where the sizes differ much."""
    size = float(np.linalg.norm(np.ptp(scan.points_mm, axis=0)))
    other = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    if 1.0 / TOLD_SIZE_JUMP < size / max(other, 1e-12) < TOLD_SIZE_JUMP:
        return ""
    return f" (the scan is {size:.3g} mm across, its template {other:.3g} mm)"


def _refuse_other_size(scan: Scan, template: Template) -> None:
    size = float(np.linalg.norm(np.ptp(scan.points_mm, axis=0)))
    other = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    ratio = size / max(other, 1e-12)
    if SMALLEST_RATIO <= ratio <= LARGEST_RATIO:
        return
    near = [unit for unit, mm in SCAN_UNITS.items() if 1 / UNIT_SLACK < ratio * mm < UNIT_SLACK]
    near += [  # no drawing is in micrometres
        f"a template in {unit}"
        for unit, mm in SCAN_UNITS.items()
        if mm > 1.0 and 1 / UNIT_SLACK < ratio / mm < UNIT_SLACK
    ]
    hint = f" ({' or '.join(near)} for millimetres?)" if near else ""
    raise AlignmentError(
        f"the scan {scan.source} is {size:.3g} mm across, its template {other:.3g} mm: they cannot "
        f"be the same part in the same unit{hint}"
        + ("" if near or ratio > 1.0 else ", or it shows too little of it")
    )
