"""The overview of a batch: one HTML file that fetches nothing; the same rows give the same page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from jaxtyping import Float

from amrepair.batch.cells import CellSums, PartCells
from amrepair.batch.options import BatchKind
from amrepair.batch.table import DONE

WORST = 20
HISTOGRAM_BARS = 24
HEIGHT_BANDS = 12
# Squares of a picture along the part's diagonal; a square shows its highest cell.
PICTURE_CELLS = 56
SQUARE_PX = 5
_VIEWS = (
    ("from above", 2, 1.0),
    ("from below", 2, -1.0),
    ("from the front", 1, -1.0),
    ("from behind", 1, 1.0),
    ("from the right", 0, 1.0),
    ("from the left", 0, -1.0),
)
_BLUE, _ORANGE = (33, 113, 181), (214, 92, 16)
_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.45 system-ui,sans-serif;max-width:72rem;margin:1.5rem auto;padding:0 1rem}
h1{font-size:1.5rem;margin:0 0 .3rem}h2{font-size:1.1rem;margin:2rem 0 .5rem}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;max-width:100%}
.wide{overflow-x:auto}td,th{padding:.2rem .7rem .2rem 0;text-align:left;vertical-align:top}
td.n,th.n{text-align:right}tr+tr td{border-top:1px solid #8884}
.key{display:flex;flex-wrap:wrap;gap:.4rem 2.2rem;margin:.8rem 0}.key b{display:block;
font-size:1.35rem}figure{display:inline-block;margin:0 1.2rem 1rem 0}figcaption{font-size:.85rem}
svg{max-width:100%;height:auto}svg text{fill:currentColor;font:11px system-ui,sans-serif}
"""
NO_SCRIPT_POLICY = "default-src 'none'; style-src 'unsafe-inline'"


class PartOverview:
    """A template's cells, and the sums of the scans that show it."""

    def __init__(self, cells: PartCells) -> None:
        self.cells = cells
        self.sums = CellSums.zero(len(cells))
        self.scans = 0

    def add(self, sums: CellSums) -> None:
        """One scan's share."""
        self.sums = self.sums + sums
        self.scans += 1


def overview(
    rows: Sequence[Mapping[str, Any]], parts: Mapping[str, PartOverview], kind: BatchKind
) -> str:
    """The page."""
    title = f"{kind.value.capitalize()} of {len(rows):,} scans"
    sections = [_key_figures(rows)]
    if kind is not BatchKind.ALIGN:
        sections.append(_over_time(rows))
        for name, part in sorted(parts.items()):
            if part.scans:
                sections += [_places(name, part), _heights(name, part)]
        sections.append(_worst(rows))
    sections.append(_sentences(rows))
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{NO_SCRIPT_POLICY}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style></head>\n<body>"
        f"<h1>{escape(title)}</h1>\n{''.join(sections)}</body></html>\n"
    )


def _key_figures(rows: Sequence[Mapping[str, Any]]) -> str:
    good = [row for row in rows if row["status"] == DONE]
    figures = [("scans", f"{len(rows):,}"), ("with a sentence", f"{len(rows) - len(good):,}")]
    if good and "regions" in good[0]:
        defective = sum(row["regions"] > 0 for row in good)
        figures += [
            ("with a defect", f"{defective:,} ({defective / len(good):.1%})"),
            ("missing", f"{_total(good, 'missing_mm3'):,.1f} mm³"),
            ("too much", f"{_total(good, 'excess_mm3'):,.1f} mm³"),
        ]
    cells = "".join(f"<div>{escape(name)}<b>{value}</b></div>" for name, value in figures)
    return f'<div class="key">{cells}</div>\n'


def _total(rows: Iterable[Mapping[str, Any]], name: str) -> float:
    return float(sum(row[name] for row in rows))


def _over_time(rows: Sequence[Mapping[str, Any]]) -> str:
    """Share of scans with a defect, by when they were taken; by name where nobody said."""
    good = [row for row in rows if row["status"] == DONE]
    if not good:
        return ""
    timed = all(row["time"] for row in good)
    ordered = sorted(good, key=lambda row: (row["time"], row["name"])) if timed else good
    buckets = np.array_split(np.arange(len(ordered)), min(HISTOGRAM_BARS, len(ordered)))
    rates = [float(np.mean([ordered[k]["regions"] > 0 for k in bucket])) for bucket in buckets]
    key = "time" if timed else "name"
    labels = [
        f"{ordered[bucket[0]][key]} to {ordered[bucket[-1]][key]}: {rate:.0%} of {len(bucket)}"
        for bucket, rate in zip(buckets, rates, strict=True)
    ]
    how = "when they were taken" if timed else "name, since not every scan has a time"
    return (
        f"<h2>Share of scans with a defect, by {how}</h2>"
        f"{_bars(rates, labels, lambda rate: f'{rate:.0%}', _BLUE)}\n"
    )


def _bars(
    values: Sequence[float],
    labels: Sequence[str],
    words: Callable[[float], str],
    colour: tuple[int, int, int],
) -> str:
    width, height = 640, 120
    most = max([*values, 1e-12])
    step = width / max(len(values), 1)
    bars = []
    for k, (value, label) in enumerate(zip(values, labels, strict=True)):
        tall = height * value / most
        bars.append(
            f'<rect x="{k * step:.1f}" y="{14 + height - tall:.1f}" width="{max(step - 2, 1):.1f}" '
            f'height="{tall:.1f}" fill="rgb{colour}"><title>{escape(label)}</title></rect>'
        )
    return (
        f'<svg viewBox="0 0 {width} {height + 18}" width="{width}" role="img" '
        f'aria-label="{escape("; ".join(labels))}"><text x="0" y="10">{words(most)}</text>'
        f"{''.join(bars)}</svg>"
    )


def _places(name: str, part: PartOverview) -> str:
    """Six views of the template, coloured by volume."""
    pictures = []
    for word, column, colour in (
        ("missing", "missing", _BLUE),
        ("too much", "excess", _ORANGE),
    ):
        volume = part.sums.volume_mm3(column)
        most = float(volume.max(initial=0.0))
        often = int(part.sums.column(column).max(initial=0))
        pictures.append(
            f"<h2>Where it is {word}: {escape(name)}</h2><p>{float(volume.sum()):,.1f} mm³ over "
            f"{part.scans:,} scans; the darkest place has {most:,.2f} mm³, and the place that is "
            f"{word} most often is so in {often:,} scans.</p>"
        )
        if most > 0:
            shares = volume / most
            pictures += [_view(part.cells, shares, one, colour) for one in _VIEWS]
    return "".join(pictures) + "\n"


def _view(
    cells: PartCells,
    share: Float[np.ndarray, " k"],
    view: tuple[str, int, float],
    colour: tuple[int, int, int],
) -> str:
    """The cells that face one way, each square as dark as its darkest cell."""
    word, axis, sign = view
    facing = np.flatnonzero(sign * cells.normal[:, axis] > 0.5)
    if not len(facing):
        return ""
    across, up = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[axis]
    low, high = cells.place_mm.min(axis=0), cells.place_mm.max(axis=0)
    square_mm = float(np.linalg.norm(high - low)) / PICTURE_CELLS
    flip = -1.0 if (axis == 1) == (sign > 0) else 1.0
    side = cells.place_mm[facing, across] * flip
    column = np.floor((side - side.min()) / square_mm).astype(np.int64)
    line = np.floor((high[up] - cells.place_mm[facing, up]) / square_mm).astype(np.int64)
    wide, tall = int(column.max()) + 1, int(line.max()) + 1
    shown = np.full((tall, wide), -1.0)
    np.maximum.at(shown, (line, column), share[facing])
    squares = []
    for (y, x), value in np.ndenumerate(shown):
        if value >= 0:
            strong = 0.0 if value == 0 else 0.2 + 0.8 * value
            tone = [round(224 + strong * (one - 224)) for one in colour]
            squares.append(
                f'<rect x="{x * SQUARE_PX}" y="{y * SQUARE_PX}" width="{SQUARE_PX}" '
                f'height="{SQUARE_PX}" fill="rgb({tone[0]},{tone[1]},{tone[2]})"/>'
            )
    size = f'width="{wide * SQUARE_PX}" height="{tall * SQUARE_PX}"'
    return f"<figure><svg {size}>{''.join(squares)}</svg><figcaption>{word}</figcaption></figure>"


def _heights(name: str, part: PartOverview) -> str:
    """Volume by height over the part's foot."""
    z_mm = part.cells.place_mm[:, 2]
    edges = np.linspace(z_mm.min(), z_mm.max(), HEIGHT_BANDS + 1)
    band = np.clip(np.searchsorted(edges, z_mm, side="right") - 1, 0, HEIGHT_BANDS - 1)
    parts = []
    for word, column, colour in (("Missing", "missing", _BLUE), ("Too much", "excess", _ORANGE)):
        volume = np.bincount(band, part.sums.volume_mm3(column), HEIGHT_BANDS)
        if volume.sum() <= 0:
            continue
        labels = [
            f"{edges[k]:.1f} to {edges[k + 1]:.1f} mm: {volume[k]:.1f} mm³"
            for k in range(HEIGHT_BANDS)
        ]
        bars = _bars(list(volume), labels, lambda mm3: f"{mm3:,.1f} mm³", colour)
        parts.append(f"<figure>{bars}<figcaption>{word}, by height</figcaption></figure>")
    return f"<h2>By height: {escape(name)}</h2>{''.join(parts)}\n" if parts else ""


def _worst(rows: Sequence[Mapping[str, Any]]) -> str:
    """The scans with most missing and too much."""
    found = [row for row in rows if row["status"] == DONE and row["regions"]]
    if not found:
        return ""
    found.sort(key=lambda row: (-(row["missing_mm3"] + row["excess_mm3"]), row["name"]))
    heads = ("scan", "label", "missing mm³", "too much mm³", "regions", "worst", "at X Y Z mm")
    lines = []
    for row in found[:WORST]:
        at = " ".join(f"{row[f'worst_{axis}_mm']:.1f}" for axis in "xyz")
        words = (row["name"], row["label"], f"{row['missing_mm3']:,.2f}",
                 f"{row['excess_mm3']:,.2f}", str(row["regions"]),
                 f"{row['worst_type']}, {row['worst_mm3']:,.2f} mm³", at)  # fmt: skip
        lines.append(_line(words))
    head = "".join(f"<th{_right(k)}>{word}</th>" for k, word in enumerate(heads))
    table = f"<table><tr>{head}</tr>{''.join(lines)}</table>"
    return f'<h2>The worst {len(lines)}</h2><div class="wide">{table}</div>\n'


def _line(words: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<td{_right(k)}>{escape(w)}</td>' for k, w in enumerate(words))}</tr>"


def _right(column: int) -> str:
    return ' class="n"' if column in {2, 3, 4} else ""


def _sentences(rows: Sequence[Mapping[str, Any]]) -> str:
    """What is wrong with scans, the most frequent first; each with one scan that has it."""
    grouped: dict[str, list[str]] = {}
    for row in rows:
        if row["status"] != DONE:
            said = row["sentence"].replace(row["name"], "…")
            grouped.setdefault(said, []).append(row["name"])
    if not grouped:
        return ""
    ordered = sorted(grouped.items(), key=lambda item: (-len(item[1]), item[0]))[:WORST]
    lines = "".join(
        f'<tr><td class="n">{len(names):,}</td><td>{escape(said)}</td><td>{escape(names[0])}</td>'
        "</tr>"
        for said, names in ordered
    )
    head = '<tr><th class="n">scans</th><th>what is wrong</th><th>such as</th></tr>'
    return f'<h2>Without figures</h2><div class="wide"><table>{head}{lines}</table></div>\n'
