"""Skipped beads: stretches of the job's own lines where rays say that no plastic is.

A missing line one bead wide beside a wall lies so near to the template's surface that no distance
to the template tells that it is gone. So the middles of the lines themselves are sampled, and each
sample is asked whether rays went through it. The missing stretches are handed to the deficit.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from amrepair.arrays import Numbers, Values
from amrepair.field.as_built import Evidence
from amrepair.observe.rays import rays_crossing
from amrepair.regions.bead_paths import BeadPaths, best_mean
from amrepair.regions.bead_samples import BeadSamples
from amrepair.regions.beads_as_laid import UP
from amrepair.regions.options import DEFAULT_SKIPPED, SkippedOptions
from amrepair.regions.planned_beads import PlannedBeads
from amrepair.scans import Scan
from amrepair.template.port import Template


def skipped(
    beads: PlannedBeads,
    scan: Scan,
    evidence: Evidence,
    template: Template,
    options: SkippedOptions = DEFAULT_SKIPPED,
    *,
    over_mm: float = 0.0,
) -> PlannedBeads:
    """Find the stretches of planned beads that are not there.

    Parameters
    ----------
    beads
        The job's topmost lines.
    scan
        In the template's frame. Its sensors must be known: without rays nothing is found.
    over_mm
        Length of line over which the scanner's errors may reach a line's height: a stretch is
        judged over at least so much. 0 for a scanner without such errors.

    Returns
    -------
    PlannedBeads
        The missing stretches, one bead for each line that they cover.
    """
    paths = BeadPaths.of(beads, options)
    lines, line = paths.lines, paths.line
    planned, together = BeadSamples.planned(paths), 0
    if evidence.has_rays and len(line):
        together = _enough_together(paths, planned, scan, over_mm, options)
    if not together:
        return lines.some(np.zeros(len(lines.width_mm), dtype=bool))
    # the emptiest of all rays cost little; only where they say "open" all of them are asked
    ask = np.flatnonzero(evidence.rays_say(planned.middle_mm) > 0)
    samples = planned.some(ask).as_laid(beads, evidence, template, options)
    ask, samples = ask[samples.rays_mm > 0], samples.some(samples.rays_mm > 0)
    opens = np.full(len(line), -1.0)
    opens[ask] = _by_views(samples, planned, scan, template, options)
    less = max(together // 2, options.samples_together)  # over which it must be the surer
    whole, part = (_together(opens, paths.path, count) for count in (together, less))
    share = options.gone_erring if over_mm else options.gone_share
    gone = (whole >= share) | (part >= options.sure_share)
    kept = paths.kept(gone, np.full(len(line), options.least_stretch_mm))
    found = paths.stretches(kept)
    if not len(found.width_mm):
        return found
    # what lies under such a stretch is seen through it
    gone |= found.holds(planned.middle_mm + 2.0 * planned.half_mm[:, None] * UP) & (part > 0)
    # where the extruder has slipped in a layer it is likelier to have slipped there again
    high_mm, slipped_mm = (np.maximum(b.start_mm[:, 2], b.end_mm[:, 2]) for b in (lines, found))
    off_mm = np.abs(high_mm[:, None] - np.unique(slipped_mm))
    again = (off_mm < options.same_layer_mm).any(axis=1)
    least_mm = np.where(again, options.least_again_mm, options.least_stretch_mm)[line]
    return paths.stretches(paths.grown(paths.kept(gone, least_mm), opens, options))


def _by_views(
    samples: BeadSamples,
    planned: BeadSamples,
    scan: Scan,
    template: Template,
    options: SkippedOptions,
) -> Values:
    """(k,) how open each line is, from −1 (there) to 1 (gone): the mean over all views.

    A scanner's errors hang together within a view, so every view counts once, and a single view
    that sees a line gone is outvoted. A line that no ray met counts as there.
    """
    met, deep, came = _met(samples, scan, options)
    sag = _sag(samples, planned, scan, template, options)
    assert scan.sensor_index is not None
    open_by = np.clip(2.0 * (deep - sag[met]), -1.0, 1.0)
    return _each_view_once(open_by, met, scan.sensor_index[came], len(sag))


def _each_view_once(
    value: Values, met: Numbers, view: Int[np.ndarray, " n"], samples: int
) -> Float[np.ndarray, " k"]:
    """(k,) the mean over views of each view's own mean; −1 for a sample that no view met.

    A sample met by fewer views than usual is divided by the usual number: a view that did not meet
    it counts as half open.
    """
    views = int(view.max(initial=0)) + 1
    seen = np.bincount(met * views + view, minlength=samples * views).reshape(samples, views)
    total = np.bincount(met * views + view, value, samples * views).reshape(samples, views)
    count = (seen > 0).sum(axis=1)
    usual = float(np.median(count[count > 0])) if len(met) else 1.0
    mean = (total / np.maximum(seen, 1)).sum(axis=1) / np.maximum(count, usual)
    return np.where(count > 0, mean, -1.0)


def _enough_together(
    paths: BeadPaths, planned: BeadSamples, scan: Scan, over_mm: float, options: SkippedOptions
) -> int:
    """Over how many neighbouring samples a line has to be judged so that errors cannot pass for it.

    A scanner's errors go both ways, while no missing line lies too high. So the number is raised
    until no stretch of the top lines seems as much too high as a missing one would be too low.
    0 where even `most_together_mm` is not enough.
    """
    if not over_mm:
        return options.samples_together
    if not np.isfinite(over_mm):
        return 0
    high_mm = planned.middle_mm[:, 2]
    which = np.flatnonzero(high_mm > high_mm.max() - options.same_layer_mm)
    met, deep, came = _met(planned.some(which), scan, options)
    assert scan.sensor_index is not None
    closed = np.clip(-2.0 * (deep + 1.0), -1.0, 1.0)
    closes = _each_view_once(closed, met, scan.sensor_index[came], len(which))
    together = int(np.ceil(max(over_mm, options.errs_along_mm) / options.sample_step_mm))
    while together * options.sample_step_mm <= options.most_together_mm:
        whole, part = (
            best_mean(closes, paths.path[which], count).max() for count in (together, together // 2)
        )
        if whole < options.gone_erring and part < options.sure_share:
            return together
        together *= 2
    return 0


def _sag(
    samples: BeadSamples,
    planned: BeadSamples,
    scan: Scan,
    template: Template,
    options: SkippedOptions,
) -> Values:
    """(k,) how much lower than planned each line may lie and still be there, in line heights.

    A line that rests on the layer below lies where it should: 0. One that hangs, or strays so that
    rays run past both its sides, may lie lower by its own height: 1. One over the rim of the layer
    below, as in leaning walls and cubic infill, spreads over the rim; how low it lies is told by
    the lines near it that are held alike, of which `there_of_alike` are taken to be there.
    """
    held = samples.held(template, options)
    sag = np.where((held == 0) | samples.strays, 1.0, 0.0)
    rim = (held > 0) & (held < options.held_places) & ~samples.strays
    if not rim.any():
        return sag
    alike = planned.held(template, options)
    z_mm, other_mm = (np.round(each.middle_mm[:, 2], 6) for each in (samples, planned))
    for high_mm, held_by in np.unique(np.column_stack([z_mm, held])[rim], axis=0):
        mine = np.flatnonzero((z_mm == high_mm) & (held == held_by))
        others = planned.some((other_mm == high_mm) & (alike == held_by))
        met, deep, _ = _met(others, scan, options)
        order = np.lexsort((deep, met))
        which, first, count = np.unique(met[order], return_index=True, return_counts=True)
        if not len(which):
            continue
        lies = 0.5 + deep[order][first + count // 2]
        near = cKDTree(others.middle_mm[which, :2]).query(
            samples.middle_mm[mine, :2], k=np.arange(1, min(len(which), options.alike) + 1)
        )[1]
        sag[mine] = np.clip(np.quantile(lies[near], options.there_of_alike, axis=1), 0.0, 1.0)
    return sag


def _met(
    samples: BeadSamples, scan: Scan, options: SkippedOptions
) -> tuple[Numbers, Values, Numbers]:
    """(r,) the sample that each ray met, how deep below its middle the ray ended, and the ray.

    Depths are in line heights. A ray meets a line where it crosses the height of the line's middle
    within the line's core, however far aside the surface lies that it ended on: between hanging
    strands slanting rays see all of the floor under them.
    """
    core_mm = options.under_share * samples.width_mm
    reach_mm = float(np.hypot(core_mm.max(initial=0.0), 0.5 * options.sample_step_mm))
    height_mm = np.round(samples.middle_mm[:, 2], 6)
    none = np.zeros(0, np.int64)
    found: list[tuple[Numbers, Values, Numbers]] = [(none, np.zeros(0), none)]
    for z_mm in np.unique(height_mm):
        mine = np.flatnonzero(height_mm == z_mm)
        place_mm, thick_mm = samples.middle_mm[mine], 2.0 * samples.half_mm[mine]
        came, crossing_mm = rays_crossing(
            scan, place_mm[:, :2], reach_mm, z_mm, z_mm + options.errs_over * float(thick_mm.max())
        )
        near = cKDTree(place_mm[:, :2]).query(crossing_mm, distance_upper_bound=reach_mm)[1]
        met = near < len(mine)
        near, crossing_mm, points_mm = near[met], crossing_mm[met], scan.points_mm[came[met]]
        off_mm = crossing_mm - place_mm[near, :2]
        x, y = samples.along[mine[near]].T
        deep = (z_mm - points_mm[:, 2]) / thick_mm[near]
        in_core = np.abs(off_mm[:, 0] * y - off_mm[:, 1] * x) < core_mm[mine[near]]
        in_core &= deep >= -options.errs_over
        found.append((mine[near[in_core]], deep[in_core], came[met][in_core]))
    which, depths, rays = (np.concatenate(each) for each in zip(*found, strict=True))
    return which, depths, rays


def _together(value: Values, path: Numbers, together: int) -> Values:
    """(m,) `best_mean`, but only where the sample itself says "gone"; −inf elsewhere.

    Otherwise a stretch would reach over its ends onto plastic that is there.
    """
    return np.where(value > 0, best_mean(value, path, together), -np.inf)
