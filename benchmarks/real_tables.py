"""The tables of `bench_real.py`: every case, dents by depth, and each goal beside its figure."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Row = dict[str, Any]
GOAL_VIEW_MM, GOAL_S, GOAL_GB, GOAL_VOLUME, GOAL_DEPTH_MM = 0.35, 3.0, 1.5, 0.1, 1.5
PAGE_KINDS = ("sound", "dents", "view", "load")


def tables(rows: Sequence[Row]) -> str:
    """Markdown: every case, dents by depth, and the goals."""
    parts = [_case_table(rows)]
    dents = [
        dent | {"base": base}
        for row in rows
        for dent, base in zip(row.get("dents", ()), row["base_found"], strict=False)
    ]
    if dents:
        parts.append(_dent_table(dents))
    parts.append(_goal_table(rows, dents))
    return "\n\n".join(parts)


def _case_table(rows: Sequence[Row]) -> str:
    lines = [
        "| case | points | false regions | ≥ 2 mm² | missing > 1 mm³ | dents found | off, mm "
        "| wall, s | stages, s | peak, GB | baseline: false | ≥ 2 mm² | dents | s "
        "| largest false |",
        "|---|" + "---|" * 14,
    ]
    for row in rows:
        base = (row["base_false"], row["base_false_2mm2"], _found(row["base_found"]), row["base_s"])
        if row["refused"]:
            shown = ("refused", "", "", "", "", row["wall_s"], "", row["peak_gb"], *base)
            last = row["refused"].replace("|", "/").replace("\n", " ")
        else:
            keys = ("false", "false_2mm2", "false_missing_1mm3")
            found = _found([dent["found"] for dent in row["dents"]])
            own = (found, row["off_mm"], row["wall_s"], row["stages_s"], row["peak_gb"])
            shown, last = (*(row[key] for key in keys), *own, *base), row["worst"]
        cells = " | ".join(str(value) for value in (row["case"], row["points"], *shown, last))
        lines.append(f"| {cells} |")
    return "\n".join(lines)


def _found(which: Sequence[bool]) -> str:
    return f"{sum(which)} of {len(which)}" if which else "–"


def _dent_table(dents: Sequence[Row]) -> str:
    lines = [
        "| dents, mm deep | planted | found | within 10 % | error, median | worst "
        "| baseline found |",
        "|---|---|---|---|---|---|---|",
    ]
    groups: list[tuple[str, list[Row]]] = [
        (f"{depth:g}", [dent for dent in dents if dent["depth_mm"] == depth])
        for depth in sorted({dent["depth_mm"] for dent in dents})
    ]
    groups.append(("of one face, 1.5 and more", [d for d in _deep(dents) if d["one_sided"]]))
    groups.append(("all, 1.5 and more", _deep(dents)))
    for name, mine in groups:
        errors = np.array([dent["error"] for dent in mine if dent["found"]])
        within = int((np.abs(errors) <= GOAL_VOLUME).sum())
        middle = f"{np.median(np.abs(errors)):.1%}" if len(errors) else "–"
        worst = f"{errors[np.argmax(np.abs(errors))]:+.1%}" if len(errors) else "–"
        lines.append(
            f"| {name} | {len(mine)} | {len(errors)} | {within} | {middle} | {worst} "
            f"| {sum(dent['base'] for dent in mine)} |"
        )
    return "\n".join(lines)


def _deep(dents: Sequence[Row]) -> list[Row]:
    return [dent for dent in dents if dent["depth_mm"] >= GOAL_DEPTH_MM]


PAGE_HEADER = (
    "object", "merged: false", "baseline", "views: false, mean", "baseline", "views laid, worst mm",
    "dents found", "detection, s", "memory, GB",
)  # fmt: skip


def page_row(rows: Sequence[Row], name: str) -> tuple[object, ...]:
    """An object's figures; dents are those of `GOAL_DEPTH_MM` and more."""
    kinds = {kind: [row for row in rows if row["kind"] == kind] for kind in PAGE_KINDS}

    def of(kind: str, key: str, count: Callable[[Sequence[float]], float]) -> str:
        values = [row.get(key, np.inf) for row in kinds[kind]]
        return f"{count(values):.3g}" if values else "–"

    deep = _deep([dent for row in kinds["dents"] for dent in row.get("dents", ())])
    return (
        name,
        of("sound", "false", max), of("sound", "base_false", max),
        of("view", "false", statistics.fmean), of("view", "base_false", statistics.fmean),
        of("view", "off_mm", max),
        f"{sum(dent['found'] for dent in deep)} of {len(deep)}",
        of("load", "stages_s", max), of("load", "peak_gb", max),
    )  # fmt: skip


def _goal_table(rows: Sequence[Row], dents: Sequence[Row]) -> str:
    """Each goal with its figure; a scan that was refused meets none."""

    def of(kind: str) -> list[Row]:
        return [row for row in rows if row["kind"] == kind]

    def most(mine: Sequence[Row], key: str) -> float:
        return max((row.get(key, np.inf) for row in mine), default=np.nan)

    lines = ["| goal | limit | measured | met |", "|---|---|---|---|"]

    def add(what: str, limit: str, measured: str, *, met: bool) -> None:
        lines.append(f"| {what} | {limit} | {measured} | {'yes' if met else 'NO'} |")

    if sound := of("sound"):
        false, large = most(sound, "false"), most(sound, "false_missing_1mm3")
        add("sound merged scan: regions", "≤ 1", f"{false:g}", met=false <= 1)
        add("… of them missing and over 1 mm³", "0", f"{large:g}", met=large <= 0)
    if merged := of("dents"):
        false = float(np.mean([row.get("false", np.inf) for row in merged]))
        base = np.mean([row["base_false"] for row in merged])
        add("scans with dents: regions elsewhere, mean", f"≤ 1 (baseline {base:g})", f"{false:g}",
            met=false <= 1)  # fmt: skip
        # a refused scan says nothing of its dents: they count as not found
        deep = _deep(dents)
        found = sum(dent["found"] for dent in deep)
        good = sum(dent["found"] and abs(dent["error"]) <= GOAL_VOLUME for dent in deep)
        whole = not any(row["refused"] for row in merged)
        add("dents of 1.5 mm and more found", "all", f"{found} of {len(deep)}",
            met=whole and found == len(deep))  # fmt: skip
        add("… volumes within 10 %", "all", f"{good} of {len(deep)}",
            met=whole and good == len(deep))  # fmt: skip
    if views := of("view"):
        false = float(np.mean([row.get("false", np.inf) for row in views]))
        base = np.mean([row["base_false"] for row in views])
        off = sum(row.get("off_mm", np.inf) <= GOAL_VIEW_MM for row in views)
        add("sound single views: regions, mean", f"≤ 1 (baseline {base:g})", f"{false:g}",
            met=false <= 1)  # fmt: skip
        add("views laid within 0.35 mm", "all",
            f"{off} of {len(views)}, worst {most(views, 'off_mm'):g} mm",
            met=off == len(views))  # fmt: skip
    if load := of("load"):
        stages, wall = most(load, "stages_s"), most(load, "wall_s")
        gb, any_refused = most(load, "peak_gb"), any(row["refused"] for row in load)
        add("470,000 points: stages (whole process)", "≤ 3 s", f"{stages:g} ({wall:g}) s",
            met=stages <= GOAL_S)  # fmt: skip
        add("… memory", "≤ 1.5 GB", f"{gb:g} GB", met=gb <= GOAL_GB and not any_refused)
    return "\n".join(lines)
