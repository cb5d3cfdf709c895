"""From looks and plans to the `--json` result and to what the page shows.

It adds up and translates; every figure comes from the plan, the link or the world's truth.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from typing import Any

import manifold3d
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Mask
from amrepair.loop import Action, Look, LoopReport
from amrepair.loop.afterwards import Afterwards
from amrepair.loop.buried_defects import buried_mm3, pieces_of
from amrepair.loop.findings import reach_of
from amrepair.loop.learning import to_json
from amrepair.observe.options import DEFAULT_BACKGROUND
from amrepair.policy.table import FINDINGS, STOP_ROWS
from amrepair.regions import Label
from amrepair.repair import RepairPlan
from amrepair.report.data import (
    BeadPath,
    Counter,
    RegionRow,
    ReportDecision,
    ReportLook,
    ReportRule,
    SolidMesh,
)
from amrepair.report.left import left_parts
from amrepair.report.options import DEFAULT_PAGE
from amrepair.report.text import NEGLIGIBLE_MM3, kind_name, plan_lines, quantity
from gcode.meshes import mesh_of
from gcode.profiles import PrintSetup

DIGITS = 6  # of every figure in a result: beyond what any scan can tell
NEW_RATIO = 0.5  # of a piece, where nothing was missing before: more is not the same one again
_LIBRARIES = (
    "amrepair",
    "manifold3d",
    "numba",
    "numpy",
    "open3d",
    "scikit-image",
    "scipy",
    "torch",
)
_NOTE_TOO_SMALL = "smaller than one bead; left as it is"
_NOTE_EXCESS = "too much material; printing cannot take it away"


def versions(setup: PrintSetup | None = None) -> dict[str, str]:
    """Versions of what computed the result, and hashes of the profiles."""
    found = {"python": platform.python_version()}
    for name in _LIBRARIES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    if setup is not None:
        found |= {f"profiles/{key}": value[:16] for key, value in setup.hashes.items()}
    return found


def rounded(value: Any) -> Any:
    """The same structure with floats rounded to `DIGITS` significant digits."""
    if isinstance(value, (bool, str)) or value is None:
        return value
    if isinstance(value, (float, np.floating)):
        return float(f"{float(value):.{DIGITS}g}")
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, Mapping):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, (Iterable, np.ndarray)):
        return [rounded(item) for item in value]
    raise TypeError(f"a result cannot hold a {type(value).__name__}")


def region_rows(plan: RepairPlan) -> tuple[RegionRow, ...]:
    """The regions of one look, with what is known of reaching them.

    Crumbs of less than a bead are no defects beside larger ones; their volume is in the sums.
    """
    rows, regions = [], plan.deficit.regions
    for region in [region for region in regions if not region.below_bead] or regions:
        note, reach = "", None
        if region.label is Label.EXCESS:
            note = _NOTE_EXCESS
        elif region.below_bead:
            note = _NOTE_TOO_SMALL
        elif plan.patch is not None:
            reach = reach_of(plan, region.box_mm)
            if reach < 0.999:
                why = {u.reason for u in plan.patch.unreachable}
                note = "; ".join(sorted(why or {u.reason for u in plan.patch.unprintable}))
        rows.append(RegionRow(str(region.type), region.volume_mm3, region.box_mm, reach, note))
    return tuple(rows)


def plan_figures(
    first: Sequence[RepairPlan],
    last: Sequence[RepairPlan] | None,
    later: Sequence[RepairPlan] = (),
) -> dict[str, Any]:
    """Volumes over the first and last look of every stop; `last` None where not rescanned.

    What stands out at one stop is seen again at the next, and counts once. Of the `later` looks,
    after a stop's first, counts what no look before them found.
    """
    ends = first if last is None else last
    return {
        "missing_mm3_before": found_mm3(
            [p.deficit.missing for p in first], [p.deficit.missing for p in later]
        ),
        "missing_mm3_after": None
        if last is None
        else together_mm3(p.deficit.missing for p in last),
        "excess_mm3_before": together_mm3(p.deficit.excess for p in first),
        "excess_mm3_after": None if last is None else together_mm3(p.deficit.excess for p in last),
        "unreachable_mm3": sum(p.unreachable_mm3 for p in ends),
        "unprintable_mm3": float(sum(p.unprintable_mm3 for p in ends)),
        "unseen_area_mm2": ends[-1].deficit.unseen_area_mm2 if ends else 0.0,
        "regions": [
            {
                "type": row.type,
                "volume_mm3": row.volume_mm3,
                "box_mm": row.box_mm,
                "reachable_ratio": row.reachable_ratio,
            }
            for plan in first
            for row in region_rows(plan)
        ],
    }


def found_mm3(first: Sequence[manifold3d.Manifold], later: Sequence[manifold3d.Manifold]) -> float:
    """Volume of what any look found missing.

    A later look sees what is left otherwise by its noise, which is nothing new: of it those pieces
    count that lie for the larger part where nothing was missing before.
    """
    known = [solid for solid in first if not solid.is_empty()]
    for solid in later:
        for piece in solid.decompose():
            new = manifold3d.Manifold.batch_boolean([piece, *known], manifold3d.OpType.Subtract)
            if new.volume() > NEW_RATIO * piece.volume():
                known.append(piece)
    return together_mm3(known)


def covered_mm3(report: LoopReport) -> float:
    """What repairs did not get to and no look sees any more: it lies under what they printed."""
    covered = 0.0
    for last in report.last_looks:
        here = [look for look in report.looks if look.stop == last.stop]
        if any(look.printed for look in here):
            left_mm3 = buried_mm3(pieces_of(last.plan, here))
            covered += max(left_mm3 - last.plan.deficit.missing_mm3, 0.0)
    return covered


def together_mm3(solids: Iterable[manifold3d.Manifold]) -> float:
    """Volume of what any of some solids holds."""
    found = [solid for solid in solids if not solid.is_empty()]
    if not found:
        return 0.0
    return float(manifold3d.Manifold.batch_boolean(found, manifold3d.OpType.Add).volume())


def cost_figures(plans: Sequence[RepairPlan]) -> dict[str, float]:
    """Filament and time of the repairs' programs."""
    costs = [plan.estimate for plan in plans if plan.estimate is not None]
    return {
        "filament_mm": float(sum(cost.filament_mm for cost in costs)),
        "print_time_s": float(sum(cost.print_time_s for cost in costs)),
    }


def loop_result(
    report: LoopReport,
    *,
    repaired_ratio: float | None,
    gcode: str | None,
    seed: int | None,
    seconds: Mapping[str, float],
    setup: PrintSetup,
) -> dict[str, Any]:
    """The keys that every result of `simulate` and `loop` has."""
    printed = [look.plan for look in report.looks if look.printed]
    result = {
        **plan_figures(
            [look.plan for look in report.first_looks],
            [look.plan for look in report.last_looks],
            [look.plan for looks in report.by_stop.values() for look in looks[1:]],
        ),
        "covered_mm3": covered_mm3(report),
        "repaired_ratio": repaired_ratio,
        "iterations": len(printed),
        "gcode": gcode,
        **cost_figures(printed),
        "seconds": dict(seconds),
        "seed": seed,
        "versions": versions(setup),
        "stopped": report.stopped or None,
        "learned": None if report.calibration is None else to_json(report.calibration),
        "passed_by": [stop.label for stop in report.passed],
        "given_up": list(report.given_up),
        "found_late": [
            {
                "stop": look.stop.label,
                "buried_mm3": look.decision.situation.buried_mm3,
                "ways": [way.to_json() for way in look.decision.ways],
            }
            for look in report.looks
            if look.decision.action is Action.OFFER
        ],
        "shifted": [
            {
                "stop": look.stop.label,
                "layer": look.plan.shifted_from,
                "ways": [way.to_json() for way in look.decision.ways],
            }
            for look in report.looks
            if look.plan.shifted_from is not None
        ],
        "stops": [_stop_row(look) for look in report.looks],
    }
    return dict(rounded(result))


def _stop_row(look: Look) -> dict[str, Any]:
    plan = look.plan
    return {
        "look": look.number,
        "stop": look.stop.label,
        "z_mm": look.stop.z_mm,
        "missing_mm3": plan.deficit.missing_mm3,
        "excess_mm3": plan.deficit.excess_mm3,
        "tolerance_mm": plan.deficit.tolerance_mm,
        "rmse_mm": plan.registration.rmse_mm,
        "within_tolerance": plan.within_tolerance,
        "printed": look.printed,
        "declined": look.declined,
        "decision": str(look.decision.action),
        "row": look.decision.row,
    }


def plan_result(
    plan: RepairPlan,
    *,
    gcode: str | None,
    seed: int | None,
    seconds: Mapping[str, float],
    setup: PrintSetup,
    late: Afterwards | None = None,
) -> dict[str, Any]:
    """The keys of a result of `repair`: planned, not printed; `late` where its job is at hand."""
    result = {
        **plan_figures([plan], None),
        "repaired_ratio": None,
        "iterations": 0 if plan.checked is None else 1,
        "gcode": gcode,
        **cost_figures([plan]),
        "seconds": dict(seconds),
        "seed": seed,
        "versions": versions(setup),
        "build_from_scan": plan.build_from_scan.matrix,
        "rmse_mm": plan.registration.rmse_mm,
        "inlier_ratio": plan.registration.inlier_ratio,
    }
    if late is not None:
        result["buried_mm3"] = late.buried_mm3
        result["ways"] = [way.to_json() for way in late.ways]
        result["not_again"] = late.not_again or None
    return dict(rounded(result))


def look_of(
    plan: RepairPlan, label: str, *, printed: bool, stop: str = "", scanned_points: int = 0
) -> ReportLook:
    """What the page shows of one scan.

    Parameters
    ----------
    printed
        Whether its repair was printed.
    stop, scanned_points
        As in `ReportLook`.
    """
    build_from_template = plan.build_from_template
    scan, anomaly = plan.scan, plan.anomaly
    shown = of_the_part(plan)
    unseen = anomaly.template_points_mm[anomaly.template_label == int(Label.UNSEEN)]
    beads = None
    if plan.patch is not None and (printed or plan.checked is not None):
        beads = BeadPath.from_toolpath(plan.patch.toolpath)
    return ReportLook(
        label=label,
        points_mm=build_from_template.apply(scan.points_mm[shown]),
        deviation_mm=anomaly.deviation_mm[shown],
        label_of_point=anomaly.label[shown],
        threshold_mm=anomaly.threshold_mm,
        smallest_mm=() if anomaly.noise is None else anomaly.noise.smallest_mm,
        noise=" ".join(([anomaly.noise.told()] if anomaly.noise else []) + list(anomaly.told())),
        normals=None if scan.normals is None else build_from_template.rotate(scan.normals[shown]),
        unseen_mm=build_from_template.apply(unseen) if len(unseen) else None,
        missing=solid_mesh(plan.deficit.missing),
        excess=solid_mesh(plan.deficit.excess),
        beads=beads,
        left=() if plan.patch is None else left_parts(plan.patch.left),
        missing_mm3=plan.deficit.missing_mm3,
        excess_mm3=plan.deficit.excess_mm3,
        height_map=plan.deficit.as_built,
        outlines_mm=outlines_mm(plan),
        stop=stop,
        scanned_points=scanned_points or len(scan),
    )


def of_the_part(plan: RepairPlan) -> Mask:
    """(n,) points of the scan that show the part: detection's own word on bed, skirt and strays.

    The bed beside the part lies outside of it, and is no excess; nor are reflections in mid-air.
    Drawn in its colour, they would be taken for some.
    """
    anomaly = plan.anomaly
    foot_mm = (
        float(anomaly.template_points_mm[:, 2].min()) if len(anomaly.template_points_mm) else 0
    )
    flat = plan.scan.points_mm[:, 2] < foot_mm + DEFAULT_BACKGROUND.band_mm
    outside = anomaly.deviation_mm > anomaly.threshold_mm
    far = anomaly.deviation_mm > DEFAULT_PAGE.stray_limits * anomaly.threshold_mm
    return ~(((flat & outside) | far) & (anomaly.label == int(Label.OK)))


def outlines_mm(plan: RepairPlan) -> tuple[Float[np.ndarray, "_ 2"], ...]:
    """Closed XY outlines of what is missing and what is too much, build frame."""
    outlines = []
    for solid in (plan.deficit.missing, plan.deficit.excess):
        if not solid.is_empty():
            smooth = solid.project().simplify(DEFAULT_PAGE.outline_mm)
            outlines += [np.asarray(ring, dtype=np.float64) for ring in smooth.to_polygons()]
    return tuple(outlines)


def solid_mesh(solid: Any) -> SolidMesh | None:
    """Triangles of a solid; None where it is empty."""
    if solid.is_empty():
        return None
    vertices, faces = mesh_of(solid)
    return SolidMesh(vertices, faces)


def decision_of(look: Look) -> ReportDecision:
    """What was decided at a look, and why: the rows of the table that fitted."""
    plan, decided = look.plan, look.decision
    choice = str(decided.action)
    if look.declined:
        choice += ": the operator declined" if decided.action is Action.FILL_NOW else ": ended"
    reasons = [_sentence(decided.reason)]
    same: dict[tuple[str, str, str, str], list[float]] = {}
    for verdict in decided.verdicts:
        one = verdict.finding
        key = (one.kind, str(one.type), str(verdict.action), verdict.reason)
        same.setdefault(key, []).append(one.volume_mm3)
    for (kind, type_, action, reason), volumes in same.items():
        count = "" if len(volumes) == 1 else f"{len(volumes)} × "
        volume = f"{quantity(sum(volumes), 'mm³')} {'too much' if kind == 'excess' else kind}"
        reasons.append(_sentence(f"{count}{kind_name(type_)}, {volume}: {action}; {reason}"))
    if plan.refused:
        reasons.append(_sentence(plan.refused))
    if decided.situation.beyond:
        reasons.append(_sentence(decided.situation.beyond))
    if decided.situation.other_material:
        reasons.append(_sentence(f"the nozzle holds {decided.situation.other_material}"))
    reasons += [_sentence(way.told) for way in decided.ways]
    if plan.unreachable_mm3 > NEGLIGIBLE_MM3:
        reasons.append(f"The nozzle cannot reach {quantity(plan.unreachable_mm3, 'mm³')}.")
    where = f"{look_label(look)}, z = {look.stop.z_mm:.2f} mm"
    rows = {decided.row, *(verdict.row for verdict in decided.verdicts)}
    return ReportDecision(
        where, choice, tuple(reasons), tuple(r for r in _REPORTED_RULES if r.id in rows)
    )


def look_label(look: Look) -> str:
    """`Layer 44, scan 3`, or `Finished part, scan 5`: scans are counted over the whole run."""
    index, number = look.stop.layer_index, look.stop.number
    finished = "Finished part" if number is None else f"Finished object {number}"
    where = finished if index is None else f"Layer {index}"
    return f"{where}, scan {look.number}"


_REPORTED_RULES = tuple(
    ReportRule(
        row.id,
        ", ".join(map(str, row.when)) or "in any other case",
        f"{row.action}: {row.reason}",
    )
    for row in (*STOP_ROWS, *FINDINGS)
)


def decision_of_plan(
    plan: RepairPlan, *, enough: bool, late: Afterwards | None = None
) -> ReportDecision:
    """What a single planned repair comes to, and why."""
    if plan.checked is None:
        choice = "nothing to print" if enough else "no repair"
    else:
        choice = "print the repair" if enough else "print the repair: it does not fill all"
    reasons = [_sentence(line) for line in plan_lines(plan)]
    left = [region for region in plan.deficit.regions if region.label is Label.MISSING]
    small = len(left) - len(plan.to_fill)
    if small:
        reasons.append(f"{small} smaller than is worth a repair, left as it is.")
    if plan.checked is not None:
        reasons.append("The program has passed the checker, against what stands there.")
    reasons += [_sentence(line) for line in (late.told if late is not None else ())]
    return ReportDecision("as scanned", choice, tuple(reasons))


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def wire_counters(report: LoopReport) -> tuple[Counter, ...]:
    """What the link counted, over the job and all repairs."""
    prints = (*report.job_prints, *report.repair_prints)
    slowest_s = max((p.round_trip_s[2] for p in prints), default=0.0)
    return (
        Counter(
            "lines acknowledged",
            float(sum(p.lines_acked for p in prints)),
            "each taken by the printer",
        ),
        Counter("resends", float(sum(p.resends for p in prints)), "lines asked for again"),
        Counter("stalls", float(sum(p.stalls for p in prints)), "silences that had to be probed"),
        Counter("bytes sent", float(sum(p.bytes_sent for p in prints)), "of the job and repairs"),
        Counter("slowest round trip, ms", 1e3 * slowest_s, "99th percentile"),
    )
