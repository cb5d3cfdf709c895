"""Where solids are to be made: boxes around what detection labelled, and how deep it lies.

They hold a void's walls and mouth too, which nobody sampled; what is solid there `compute` says.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from amrepair.deficit.options import VoxelOptions
from amrepair.field.as_built import Evidence
from amrepair.field.groups import group_points, touching_mm
from amrepair.frames import diagonal
from amrepair.regions import AnomalyMap, Label
from amrepair.regions.skipped import PlannedBeads
from amrepair.template.port import Template


def boxes_of(
    anomaly: AnomalyMap,
    evidence: Evidence,
    template: Template,
    label: Label,
    lines: PlannedBeads | None,
    options: VoxelOptions,
) -> list[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], float]]:
    """Low corner, high corner and depth of each group of labelled cells and template points."""
    s = evidence.surfels
    which = np.flatnonzero(np.asarray(anomaly.surfel_label) == int(label))
    points, depth = s.place_mm[which], np.abs(s.deviation_mm[which])
    film = np.zeros(len(which), dtype=bool)
    if label is Label.MISSING:
        film = _films(template, evidence, which, options)
        gone = anomaly.template_points_mm[anomaly.template_label == int(Label.MISSING)]
        gone = np.concatenate([gone, _paths_out(template, evidence, which, options)])
        points = np.concatenate([points, gone])
        depth = np.concatenate([depth, np.full(len(gone), np.nan)])
    else:
        points = np.concatenate([points, _feet(evidence, which)])
        depth = np.concatenate([depth, np.full(len(which), np.nan)])
    film = np.pad(film, (0, len(points) - len(film)))
    group = group_points(points, reach_mm=touching_mm(s.cell_mm))
    found = []
    for g in range(int(group.max()) + 1 if len(group) else 0):
        mine = points[group == g]
        deep = depth[group == g]
        known = deep[~np.isnan(deep)]
        # cells with a handful of template points and nothing else are pixels, not defects
        if len(known) == 0 and (len(mine) < 4 or label is Label.EXCESS):
            continue  # nor is where something would stand what stands
        thick = float(np.percentile(known, 90)) if len(known) else 2.0
        thin = deep[film[group == g]]
        if len(thin) * s.cell_mm**2 > options.least_film_mm2:
            thick = min(thick, float(np.median(thin)))  # so that samples lie in its lower half
        low, high = mine.min(axis=0), mine.max(axis=0)
        found.append((low - options.margin_mm, high + options.margin_mm, thick))
    if lines is not None:
        for a, b, thick in zip(lines.start_mm, lines.end_mm, lines.height_mm, strict=True):
            low, top = np.minimum(a, b) - options.margin_mm, np.maximum(a, b) + options.margin_mm
            found.append((low, top, float(thick)))
    return _merge(found)


def _films(
    template: Template, evidence: Evidence, which: Int[np.ndarray, " q"], options: VoxelOptions
) -> Bool[np.ndarray, " q"]:
    """Cells of an even surface over which a film is missing: no deeper, and it faces out of it.

    What is left of a thin roof lies as near to the template's surface, but to its other side.
    """
    s = evidence.surfels
    depth_mm, wide_mm = np.abs(s.deviation_mm[which]), np.abs(s.wide_deviation_mm[which])
    film = (depth_mm < options.film_mm) & (np.abs(depth_mm - wide_mm) < options.even_mm)
    some = which[film]
    outward = template.distance_and_gradient(s.place_mm[some])[1]
    film[film] = (outward * evidence.normal[some]).sum(axis=1) > options.facing
    return film


def _paths_out(
    template: Template, evidence: Evidence, which: Int[np.ndarray, " q"], options: VoxelOptions
) -> Float[np.ndarray, "p 3"]:
    """Points through the empty space from a void's floor to where it leaves the template.

    They tie the floor to the mouth where nobody sampled the walls between.
    """
    s, step_mm = evidence.surfels, options.path_step_mm
    if len(which) == 0:
        return np.zeros((0, 3))
    _, first = np.unique(
        np.floor(s.place_mm[which] / step_mm).astype(np.int64), axis=0, return_index=True
    )
    front, along = s.place_mm[which[first]], evidence.normal[which[first]]
    found = []
    reach_mm = diagonal(template.bounds_mm)
    for _ in range(int(reach_mm / step_mm) + 1):
        front = front + step_mm * along
        f = template.distance(front)
        go_on = (f < 0) & (evidence.clearance(front, f)[0] > 0)
        if not go_on.any():
            break
        front, along = front[go_on], along[go_on]
        found.append(front)
    return np.concatenate(found) if found else np.zeros((0, 3))


def _feet(evidence: Evidence, which: Int[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
    """Where excess surfels stand on the template: along their planes, back by their height."""
    s = evidence.surfels
    return np.asarray(s.place_mm[which] - s.deviation_mm[which, None] * evidence.normal[which])


def _merge(
    boxes: list[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], float]],
) -> list[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"], float]]:
    """Boxes that overlap become one, so that no volume is made twice."""
    merged = list(boxes)
    changed = True
    while changed:
        changed = False
        for i in range(len(merged)):
            for j in range(i + 1, len(merged)):
                (a_low, a_high, a), (b_low, b_high, b) = merged[i], merged[j]
                if (a_low <= b_high).all() and (b_low <= a_high).all():
                    joined = (np.minimum(a_low, b_low), np.maximum(a_high, b_high), min(a, b))
                    merged = [m for k, m in enumerate(merged) if k not in {i, j}] + [joined]
                    changed = True
                    break
            if changed:
                break
    return merged
