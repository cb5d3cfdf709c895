"""The page's tables: defects, decisions with their reasons, the run.

Every text that comes from outside passes `escape` here.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

from amrepair.report.data import ReportData, SolidMesh
from amrepair.report.text import NEGLIGIBLE_MM3, duration, kind_name, percent, quantity

DASH = "–"
# Why a repair leaves something, as the drawing and the table call it.
LEFT_CAUSES = {
    "left_reach": "out of the head's reach",
    "left_bead": "no bead fits, or nothing holds one",
    "left_covered": "under what stands above it",
    "left_span": "over a gap too wide for a bridge",
}


def regions(data: ReportData) -> str:
    """The defects that were found."""
    if not data.regions:
        return '<p class="lead">No defect was found.</p>'
    rows: list[tuple[str, ...]] = []
    for number, region in enumerate(data.regions, start=1):
        low, high = region.box_mm
        size = " × ".join(f"{side:.1f}" for side in high - low)
        centre = ", ".join(f"{value:.1f}" for value in (low + high) / 2)
        reach = DASH if region.reachable_ratio is None else percent(region.reachable_ratio)
        rows.append(
            (
                str(number),
                escape(kind_name(region.type)),
                quantity(region.volume_mm3, ""),
                size,
                centre,
                reach,
                escape(region.note),
            )
        )
    heads: tuple[str, ...] = (
        "#",
        "Kind",
        "Volume, mm³",
        "Size X × Y × Z, mm",
        "Centre on the bed, mm",
        "Can be filled",
        "Remark",
    )
    if not any(row[-1] for row in rows):
        heads, rows = heads[:-1], [row[:-1] for row in rows]
    return table("Defects that were found", heads, rows, numeric=(0, 2, 3, 4, 5))


def left(data: ReportData) -> str:
    """What repairs leave open, by cause, in the drawing's colours; nothing where that is none."""
    rows = [
        (
            escape(look.label),
            f'<span class="dot {part.key}" aria-hidden="true"></span> {LEFT_CAUSES[part.key]}',
            quantity(part.volume_mm3, ""),
            escape(_box_of(part.shape)),
        )
        for look in data.looks
        for part in look.left
        if part.volume_mm3 > NEGLIGIBLE_MM3
    ]
    if not rows:
        return ""
    heads = ("Planned after", "Why", "Volume, mm³", "From X, Y, Z to X, Y, Z, mm")
    return table("What repairs leave open, by cause", heads, rows, numeric=(2, 3))


def _box_of(shape: SolidMesh) -> str:
    low, high = shape.vertices_mm.min(axis=0), shape.vertices_mm.max(axis=0)
    return " to ".join(", ".join(f"{value:.1f}" for value in corner) for corner in (low, high))


def decisions(data: ReportData) -> str:
    """What was decided where, why, and what the rules say that it rests on."""
    rows = []
    for decision in data.decisions:
        why = "<br>".join(escape(reason) for reason in decision.reasons)
        named = ", ".join(escape(rule.id) for rule in decision.rules)
        if named:
            why += f'<span class="by">By rule {named}.</span>'
        rows.append((escape(decision.where), f"<strong>{escape(decision.choice)}</strong>", why))
    shown = table("Decisions with their reasons", ("Where", "Decision", "Why"), rows)
    return shown + _rules(data)


def _rules(data: ReportData) -> str:
    """What the rules say that the decisions name."""
    used = {rule.id: rule for decision in data.decisions for rule in decision.rules}
    rows = [
        (escape(rule.id), escape(rule.when), escape(rule.then))
        for rule in sorted(used.values(), key=lambda rule: (rule.id[0], len(rule.id), rule.id))
    ]
    if not rows:
        return ""
    return (
        "<details><summary>What these rules say</summary>"
        '<p class="note">Each defect is held against rules F1, F2, …, then the stop against S1, '
        "S2, …; the first that holds counts.</p>"
        f"{table('Rules that decided', ('Rule', 'Where', 'What is done'), rows)}</details>"
    )


def run(data: ReportData) -> str:
    """The wire, the time by stage, and what another person needs to repeat the run."""
    wire = table(
        "What went over the wire",
        ("Counter", "Value", "Meaning"),
        [(escape(c.name), _counted(c.value), escape(c.meaning)) for c in data.wire],
        numeric=(1,),
    )
    seconds = table(
        "Time by stage",
        ("Stage", "Time"),
        [(escape(name), escape(duration(value))) for name, value in data.seconds.items()],
        numeric=(1,),
    )
    provenance = table(
        "What another person needs to repeat this run",
        ("Item", "Value"),
        [
            (escape(name), f"<code>{escape(value)}</code>")
            for name, value in data.provenance.items()
        ],
    )
    blocks = [block for block in (wire, seconds, provenance) if block]
    return f'<div class="columns">{"".join(blocks)}</div>' if blocks else ""


def _counted(value: float) -> str:
    """A counter, whole where it is whole, else to three digits; a dash where nobody knows."""
    if not math.isfinite(value):
        return DASH
    return f"{value:,.0f}" if value == round(value) else f"{value:.3g}"


def table(
    caption: str,
    heads: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    numeric: Sequence[int] = (),
) -> str:
    """A table from cells that are HTML already; empty where there are no rows.

    Each cell carries its head, which narrow pages show beside it; the roles say that it is a table
    there, too.
    """
    if not rows:
        return ""
    kind = [' class="num"' if column in numeric else "" for column in range(len(heads))]
    head = "".join(
        f'<th scope="col" role="columnheader"{k}>{name}</th>'
        for k, name in zip(kind, heads, strict=True)
    )
    lines = "".join(
        '<tr role="row">'
        + "".join(
            f'<td role="cell" data-head="{name}"{k}><span>{cell}</span></td>'
            for k, name, cell in zip(kind, heads, row, strict=True)
        )
        + "</tr>"
        for row in rows
    )
    cards = " cards" if len(heads) > 2 else ""  # where a narrow page has no room for the columns
    return (
        f'<div class="table{cards}" role="region" aria-label="{caption}" tabindex="0">'
        '<table role="table">'
        f'<caption>{caption}</caption><thead role="rowgroup"><tr role="row">{head}</tr></thead>'
        f'<tbody role="rowgroup">{lines}</tbody></table></div>'
    )


def escape(text: str) -> str:
    """Text from outside, safe in content and in quoted attributes."""
    return html.escape(text, quote=True)
