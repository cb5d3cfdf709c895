"""What the page's script draws: `ReportData` made into one JSON object, within a size budget.

Budgets bound the page, not the truth: tables, volumes and histograms use every point.
"""

from __future__ import annotations

import html
import math
from dataclasses import replace

import numpy as np

from amrepair.frames import in_box
from amrepair.report import encode
from amrepair.report.data import BeadPath, ReportData, ReportLook, SolidMesh
from amrepair.report.options import DEFAULT_PAGE

AGREES_LABEL, MISSING_LABEL, EXCESS_LABEL = 0, 1, 2

Json = dict[str, object]


def payload(data: ReportData) -> Json:
    """Everything that is drawn, ready for `json.dumps`; text in it is already HTML-escaped."""
    drawn = drawn_looks(data)
    share = max(len(drawn), 1)
    scales_mm = colour_scales(data)
    box_mm = bounds(data)
    side = facing(data, drawn, box_mm)
    return {
        "bounds": [[round(float(v), 4) for v in row] for row in box_mm],
        "facing": list(side),
        "scales": scales_mm,
        "expected": None if data.expected is None else _expected(data.expected),
        "looks": [
            _look(near_part(data.looks[index], box_mm), index, share, scales_mm[1], side)
            for index in drawn
        ],
        "compare": list(compared(data, drawn)),
        "volumes": {
            "label": [html.escape(look.label) for look in data.looks],
            "missing": [_rounded(look.missing_mm3) for look in data.looks],
            "excess": [_rounded(look.excess_mm3) for look in data.looks],
        },
        "temperatures": [
            _series(series.name, series.time_s, series.measured_c, series.target_c)
            for series in data.temperatures
        ],
    }


def drawn_looks(data: ReportData) -> tuple[int, ...]:
    """Indices of the looks that are drawn in 3D: all, or those where something happened."""
    count = len(data.looks)
    if count <= DEFAULT_PAGE.looks:
        return tuple(range(count))
    importance = [
        (look.beads is not None, look.missing_mm3 + look.excess_mm3, -index)
        for index, look in enumerate(data.looks)
    ]
    ranked = sorted(range(1, count - 1), key=lambda index: importance[index], reverse=True)
    return tuple(sorted({0, count - 1, *ranked[: DEFAULT_PAGE.looks - 2]}))


def compared(data: ReportData, drawn: tuple[int, ...]) -> tuple[int, int]:
    """Positions in `drawn` of the two looks that stand side by side at first."""
    if not drawn:
        return (0, 0)
    if data.compare is not None and set(data.compare) <= set(drawn):
        return drawn.index(data.compare[0]), drawn.index(data.compare[1])
    worst = max(range(len(drawn)), key=lambda i: (data.looks[drawn[i]].missing_mm3, -i))
    stop = data.looks[drawn[worst]].stop
    after = max(i for i in range(len(drawn)) if data.looks[drawn[i]].stop == stop)
    if after > worst:  # the same layers, before and after
        return worst, after
    return worst if worst < len(drawn) - 1 else 0, len(drawn) - 1


def facing(data: ReportData, drawn: tuple[int, ...], box_mm: np.ndarray) -> tuple[int, int]:
    """From which corner the first view looks, as signs of X and Y: from where the defect is seen.

    The front left one, unless most of what is missing (or too much) lies clearly away from it.
    """
    if not drawn:
        return -1, -1
    look = data.looks[drawn[compared(data, drawn)[0]]]
    defect = look.missing or look.excess
    if defect is None or len(defect.vertices_mm) == 0:
        return -1, -1
    away = defect.vertices_mm.mean(axis=0) - box_mm.mean(axis=0)
    x, y = (
        1 if away[axis] > DEFAULT_PAGE.aside_ratio * np.ptp(box_mm[:, axis]) else -1
        for axis in (0, 1)
    )
    return x, y


def bounds(data: ReportData) -> np.ndarray:
    """(2, 3) box around the part and every scan, mm; clutter far from the part is left out."""
    clouds = [] if data.expected is None else [data.expected.vertices_mm]
    if data.expected is None:
        clouds += [look.points_mm for look in data.looks]
    clouds += [mesh.vertices_mm for look in data.looks for mesh in (look.excess,) if mesh]
    clouds = [cloud for cloud in clouds if len(cloud)]
    if not clouds:
        return np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    low = np.min([cloud.min(axis=0) for cloud in clouds], axis=0)
    high = np.max([cloud.max(axis=0) for cloud in clouds], axis=0)
    margin_mm = 0.03 * float((high - low).max()) + 1e-3
    return np.stack([low - margin_mm, high + margin_mm])


def near_part(look: ReportLook, box_mm: np.ndarray) -> ReportLook:
    """The look without what lies outside the box: the bed around the part, clutter."""
    inside = in_box(look.points_mm, box_mm[0], box_mm[1])
    if inside.all():
        return look
    return replace(
        look,
        points_mm=look.points_mm[inside],
        deviation_mm=look.deviation_mm[inside],
        label_of_point=look.label_of_point[inside],
        normals=None if look.normals is None else look.normals[inside],
    )


def colour_scales(data: ReportData) -> list[float]:
    """Three half-ranges for the colours, mm: close to the threshold, usual, everything."""
    threshold_mm = max((look.threshold_mm for look in data.looks), default=0.1) or 0.1
    flagged = [
        np.abs(look.deviation_mm[look.label_of_point != AGREES_LABEL])
        for look in data.looks
        if (look.label_of_point != AGREES_LABEL).any()
    ]
    largest = max((float(part.max()) for part in flagged), default=2 * threshold_mm)
    usual = float(np.quantile(np.concatenate(flagged), 0.9)) if flagged else 2 * threshold_mm
    close = nice_ceiling(2 * threshold_mm)
    middle = max(nice_ceiling(min(usual, 8 * threshold_mm)), close)
    return [close, middle, max(nice_ceiling(largest), middle)]


def nice_ceiling(value: float) -> float:
    """The smallest of 1, 2, 2.5, 4, 5 × 10ⁿ that is not below `value`."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    for factor in (1.0, 2.0, 2.5, 4.0, 5.0, 10.0):
        if factor * power >= value * (1 - 1e-9):
            return float(f"{factor * power:.6g}")
    return float(f"{10 * power:.6g}")


def _look(look: ReportLook, index: int, share: int, scale_mm: float, side: tuple[int, int]) -> Json:
    budget = min(DEFAULT_PAGE.points_per_look, DEFAULT_PAGE.points // share)
    kept = encode.thinned(look.points_mm, look.label_of_point != AGREES_LABEL, budget=budget)
    points_mm = look.points_mm[kept]
    normals = None if look.normals is None else look.normals[kept]
    faces = DEFAULT_PAGE.faces // (2 * share)
    return {
        "index": index,
        "label": html.escape(look.label),
        "threshold": _rounded(look.threshold_mm),
        "total": max(look.scanned_points, len(look.points_mm)),
        "shown": len(kept),
        "flagged": int((look.label_of_point != AGREES_LABEL).sum()),
        "points": encode.quantised(points_mm),
        "deviation": encode.quantised(look.deviation_mm[kept]),
        "shade": encode.integers(encode.shading(points_mm, normals, side)),
        "missing": _solid(look.missing, faces),
        "excess": _solid(look.excess, faces),
        **{part.key: _boxes(part.shape) for part in look.left},
        "unseen": _unseen(look.unseen_mm),
        "beads": None if look.beads is None else _beads(look.beads, DEFAULT_PAGE.beads // share),
        "histogram": _histogram(look, scale_mm),
        "noise": {
            "told": html.escape(look.noise),
            "area": [_rounded(area) for area, _ in look.smallest_mm],
            "depth": [_rounded(depth) for _, depth in look.smallest_mm],
        },
        "heights": _heights(look, share),
    }


def _unseen(points_mm: np.ndarray | None) -> Json | None:
    if points_mm is None or len(points_mm) == 0:
        return None
    everything = np.zeros(len(points_mm), dtype=np.bool_)
    return encode.quantised(
        points_mm[encode.thinned(points_mm, everything, budget=DEFAULT_PAGE.unseen_per_look)]
    )


def _solid(mesh: SolidMesh | None, budget: int) -> Json | None:
    if mesh is None or len(mesh.faces) == 0:
        return None
    return _boxes(encode.simplified(mesh, budget=budget))


def _boxes(mesh: SolidMesh) -> Json:
    """As it is: boxes are few, and have none to spare."""
    return {"vertices": encode.quantised(mesh.vertices_mm), "faces": encode.integers(mesh.faces)}


def _expected(mesh: SolidMesh) -> Json | None:
    if len(mesh.faces) == 0:
        return None
    small = encode.simplified(mesh, budget=DEFAULT_PAGE.expected_faces)
    return {
        "vertices": encode.quantised(small.vertices_mm),
        "faces": encode.integers(small.faces),
        "edges": encode.integers(encode.feature_edges(small, budget=DEFAULT_PAGE.expected_edges)),
    }


def _beads(beads: BeadPath, budget: int) -> Json:
    """Beads of whole layers, from the first on, as many as the budget allows."""
    count = len(beads)
    if count > budget:
        last = int(beads.layer[budget])
        count = max(int(np.searchsorted(beads.layer, last)), budget if last == 0 else 0)
    layers = int(beads.layer[count - 1]) + 1
    ends_mm = np.hstack([beads.start_mm[:count], beads.end_mm[:count]])
    return {
        "ends": encode.quantised(ends_mm),
        "section": encode.quantised(
            np.stack([beads.width_mm[:count], beads.height_mm[:count]], axis=1)
        ),
        "layer": encode.integers(beads.layer[:count]),
        "role": encode.integers(beads.role[:count]),
        "tops": [_rounded(float(z)) for z in beads.layer_top_mm[:layers]],
        "roles": [html.escape(role) for role in beads.roles],
        "shown": count,
        "total": len(beads),
    }


def _histogram(look: ReportLook, scale_mm: float) -> Json:
    """Counts of all points; what lies beyond the scale is in the outermost bins."""
    edges_mm = np.linspace(-scale_mm, scale_mm, DEFAULT_PAGE.histogram_bins + 1)
    inside = np.clip(look.deviation_mm, -scale_mm * (1 - 1e-9), scale_mm * (1 - 1e-9))
    counts, _ = np.histogram(inside, bins=edges_mm)
    return {
        "low": -scale_mm,
        "step": 2 * scale_mm / DEFAULT_PAGE.histogram_bins,
        "counts": counts.tolist(),
        "beyond": int((np.abs(look.deviation_mm) > scale_mm).sum()),
    }


def _heights(look: ReportLook, share: int) -> Json | None:
    """The map on a grid coarse enough for the budget: the highest cell of each block."""
    heights = look.height_map
    if heights is None:
        return None
    ny, nx = heights.shape
    block = max(1, math.ceil(math.sqrt(ny * nx * share / DEFAULT_PAGE.cells)))
    pad = ((0, -ny % block), (0, -nx % block))
    z_mm = np.pad(heights.z_mm, pad, mode="edge")
    seen = np.pad(heights.seen, pad, mode="edge")
    shape = (z_mm.shape[0] // block, block, z_mm.shape[1] // block, block)
    seen_block = seen.reshape(shape).any(axis=(1, 3))
    top_mm = np.where(seen, z_mm, -np.inf).reshape(shape).max(axis=(1, 3))
    top_mm = np.where(seen_block, top_mm, 0.0)
    return {
        "title": html.escape(f"Top surface, {look.label}"),
        "origin": [_rounded(float(v)) for v in heights.origin_mm],
        "cell": _rounded(heights.cell_mm * block),
        "shape": list(top_mm.shape),
        "z": encode.quantised(top_mm.reshape(-1)),
        "seen": encode.integers(seen_block.reshape(-1).astype(np.int64)),
        "outlines": [
            [[_rounded(float(x)), _rounded(float(y))] for x, y in outline]
            for outline in look.outlines_mm
        ],
    }


def _series(
    name: str, time_s: np.ndarray, measured_c: np.ndarray, target_c: np.ndarray | None
) -> Json:
    step = max(1, math.ceil(len(time_s) / DEFAULT_PAGE.samples))
    return {
        "name": html.escape(name),
        "time": [_rounded(float(v)) for v in time_s[::step]],
        "measured": [_rounded(float(v)) for v in measured_c[::step]],
        "target": None if target_c is None else [_rounded(float(v)) for v in target_c[::step]],
    }


def _rounded(value: float) -> float | None:
    """A number that JSON can hold, to a tenth of a micrometre."""
    return round(value, 4) if math.isfinite(value) else None
