"""All views into one frame: told or found, refined together; what does not fit is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from amrepair.arrays import Matrix
from amrepair.errors import AlignmentError
from amrepair.frames import moved
from amrepair.merge.groups import Graph, grouped
from amrepair.merge.joint import Slack, slacks, together
from amrepair.merge.options import DEFAULT_MERGE, MergeOptions
from amrepair.merge.told import of_views, on_turntable
from amrepair.merge.views import Fit, Placed, View, joined, judged
from gcode.progress import Progress, silent


@dataclass(frozen=True, slots=True)
class Placement:
    """Views in the frame of the first of them that could be placed.

    Attributes
    ----------
    poses
        By number: (4, 4) common frame from the view.
    rmse_mm
        Point to plane, over what overlaps.
    left_out
        By number of a view that was left out: why, as a predicate.
    slacks
        By number: how surely each is held.
    """

    poses: Placed
    rmse_mm: float
    left_out: Mapping[int, str] = field(default_factory=dict)
    slacks: Mapping[int, Slack] = field(default_factory=dict)


def place(
    views: Sequence[View],
    rng: np.random.Generator,
    *,
    told: Mapping[str, Matrix] | None = None,
    unit_mm: float = 1.0,
    turntable_deg: float | None = None,
    options: MergeOptions = DEFAULT_MERGE,
    progress: Progress = silent,
) -> Placement:
    """Bring views of one part into one frame.

    Parameters
    ----------
    told
        Poses by file name, in units of `unit_mm`.
    turntable_deg
        Between each view and the next.

    Raises
    ------
    AlignmentError
        If no group that agrees has more than half of the views.
    """
    if len(views) == 1:
        return Placement({0: np.eye(4)}, 0.0)
    size_mm = max(view.size_mm for view in views)
    if told is not None:
        begun = of_views(told, views, unit_mm)
    elif turntable_deg is not None:
        begun = on_turntable(views, turntable_deg, size_mm, options)
    else:
        begun = _as_given(views, options)
    begun, begun_rmse_mm = _held(views, begun, rng, options)
    graph = grouped(views, size_mm, options, begun=begun, progress=progress)
    progress("refine poses", 0.0, 1.0)
    found = graph.groups[0]
    left_out = {k: _why(graph, k) for k in range(len(views)) if k not in found}
    if begun_rmse_mm is not None and found.keys() == begun.keys():
        poses, rmse_mm = found, begun_rmse_mm  # nothing came to what is refined and agrees
    else:
        poses, rmse_mm, dropped = _agreed(views, found, rng, options)
        left_out |= dropped
    if 2 * len(poses) <= len(views):
        raise AlignmentError(_said_apart(graph, left_out))
    home = np.linalg.inv(poses[min(poses)])
    poses = {k: home @ poses[k] for k in sorted(poses)}
    chosen = list(poses)
    open_ = slacks([views[k] for k in chosen], list(poses.values()), rng, options.joint)
    progress("refine poses", 1.0, 1.0)
    return Placement(poses, rmse_mm, left_out, dict(zip(chosen, open_, strict=True)))


def _as_given(views: Sequence[View], options: MergeOptions) -> Placed:
    """All at rest, where the scans came in one frame already; else none.

    Chance does not bring scans together without contradiction. But what turns before a fixed sensor
    looks alike from all sides if it is round: so the sensors must have stood in different places.
    """
    if not all(view.looks.each for view in views):
        return {}
    sides = []
    for view in views:
        way = (view.looks.sensors_mm - view.thin.points_mm.mean(axis=0)).mean(axis=0)
        sides.append(way / max(float(np.linalg.norm(way)), 1e-12))
    if (np.array(sides) @ np.array(sides).T).min() > options.one_sensor_side:
        return {}
    rest: Placed = {k: np.eye(4) for k in range(len(views))}
    kept, dropped = _consistent(views, rest, options)
    return {} if dropped else kept


def _held(
    views: Sequence[View], begun: Placed, rng: np.random.Generator, options: MergeOptions
) -> tuple[Placed, float | None]:
    """Poses that were told, refined, without those that the views contradict; and the residual.

    None where some were contradicted: the others are to be refined without them.
    """
    if len(begun) < 2:
        return {}, None
    poses, rmse_mm = _refined(views, begun, options, rng)
    kept, dropped = _consistent(views, poses, options)
    return (kept if len(kept) > 1 else {}), (None if dropped else rmse_mm)


def _agreed(
    views: Sequence[View], found: Placed, rng: np.random.Generator, options: MergeOptions
) -> tuple[Placed, float, dict[int, str]]:
    """Poses refined together, the residual, and why views that contradict them were left out."""
    poses, rmse_mm = _refined(views, found, options, rng)
    poses, dropped = _consistent(views, poses, options)
    if dropped and len(poses) > 1:
        poses, rmse_mm = _refined(views, poses, options, rng)
    return poses, rmse_mm, dropped


def _refined(
    views: Sequence[View], poses: Placed, options: MergeOptions, rng: np.random.Generator
) -> tuple[Placed, float]:
    which = sorted(poses)
    if len(which) < 2:
        return dict(poses), 0.0
    own, begun = [views[k] for k in which], [poses[k] for k in which]
    refined, rmse_mm = together(own, begun, rng, options.joint)
    return dict(zip(which, refined, strict=True)), rmse_mm


def _consistent(
    views: Sequence[View], poses: Placed, options: MergeOptions
) -> tuple[Placed, dict[int, str]]:
    """Views without those that contradict the rest: the worst goes, the rest is asked again."""
    kept, dropped = dict(poses), dict[int, str]()
    while len(kept) > 1:
        fits: dict[int, Fit] = {}
        for k, pose in kept.items():
            rest = {m: p for m, p in kept.items() if m != k}
            fits[k] = judged(views, rest, {k: pose}, np.eye(4), options)
        bad = {k: fit for k, fit in fits.items() if fit.why_not(options)}
        if not bad:
            break
        worst = min(bad, key=lambda k: bad[k].score)
        gap_mm = _gap_mm(views, kept, worst, options)
        dropped[worst] = bad[worst].why_not(options) + (
            f"; where they face each other its surface is {gap_mm:.2f} mm off in the median"
            if np.isfinite(gap_mm) else ""
        )  # fmt: skip
        del kept[worst]
    return kept, dropped


def _gap_mm(views: Sequence[View], poses: Placed, k: int, options: MergeOptions) -> float:
    """Median height of a view over the others' surface beside it; NaN where there is none."""
    rest = joined(views, {m: p for m, p in poses.items() if m != k}, options.judge.points)
    points = moved(views[k].thin.points_mm, poses[k])
    within = options.gap_spacings * views[k].thin_spacing_mm
    distance, index = rest.tree.query(points, distance_upper_bound=within)
    near = np.isfinite(distance)
    if not near.any():
        return float("nan")
    there = index[near]
    height = ((points[near] - rest.points_mm[there]) * rest.normals[there]).sum(axis=1)
    return float(np.median(np.abs(height)))


def _why(graph: Graph, k: int) -> str:
    """Why a view is not in the largest group."""
    own = next(group for group in graph.groups if k in group)
    reason = graph.why_not(graph.ways(graph.groups[0], own))
    if len(own) == 1:
        return reason
    names = ", ".join(graph.views[m].name for m in sorted(own) if m != k)
    return f"agrees with {names} only, and with them {reason}"


def _said_apart(graph: Graph, left_out: Mapping[int, str]) -> str:
    """That no group has most of the views, with the groups and what is against each view."""
    together_ = [sorted(group) for group in graph.groups if len(group) > 1]
    names = [view.name for view in graph.views]
    said = []
    if together_:
        groups = "; ".join(", ".join(names[k] for k in group) for group in together_)
        said.append(f"these agree with each other: {groups}")
    alone = [k for group in graph.groups if len(group) == 1 for k in group]
    same: dict[str, list[str]] = {}
    for k in alone:
        same.setdefault(left_out.get(k, "overlaps no other enough"), []).append(names[k])
    said += [f"{', '.join(whose)}: {reason}" for reason, whose in same.items()]
    return (
        f"no more than half of the {len(names)} views overlap and agree with each other ("
        + "; ".join(said)
        + "). Check that they show the same part in the same unit, scan with more overlap, tell "
        "where the sensors stood (--sensor-at, or in the files) or the poses (--poses, "
        "--turntable), export the views in one frame, or give the part's mesh beside them"
    )
