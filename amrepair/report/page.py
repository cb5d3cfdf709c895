"""The page: sections and words as HTML. It draws nothing; the script does.

Every text that comes from outside passes `tables.escape`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from amrepair.report.data import Outcome, ReportData, ReportLook
from amrepair.report.payload import drawn_looks
from amrepair.report.tables import DASH, LEFT_CAUSES, decisions, escape, left, regions, run
from amrepair.report.text import (
    HEADLINES,
    NEGLIGIBLE_MM3,
    duration,
    length,
    percent,
    quantity,
    summary_of,
)

_TONES = {
    Outcome.WITHIN_TOLERANCE: ("good", "✓"),
    Outcome.NOTHING_TO_REPAIR: ("good", "✓"),
    Outcome.PLANNED: ("plan", "→"),
    Outcome.PLANNED_IN_PART: ("warn", "→"),
    Outcome.NOT_WITHIN_TOLERANCE: ("warn", "!"),
    Outcome.STOPPED: ("warn", "■"),
}


def body(data: ReportData) -> str:
    """Everything between `<body>` and the scripts."""
    sections = [
        ("scan", "Scan and repair", _inspect(data)),
        ("compare", "Before and after", _compare(data)),
        ("volumes", _volumes_title(data), _volumes(data)),
        ("regions", "Defects", regions(data)),
        ("left", "What repairs leave", left(data)),
        ("decisions", "Decisions", decisions(data)),
        ("run", "The run", run(data)),
    ]
    shown = [(key, title, content) for key, title, content in sections if content]
    links = "".join(f'<li><a href="#{key}">{title}</a></li>' for key, title, _ in shown)
    blocks = "".join(
        f'<section id="{key}" aria-labelledby="{key}-title"><h2 id="{key}-title">{title}</h2>'
        f"{content}</section>"
        for key, title, content in shown
    )
    return (
        '<a class="skip" href="#main">Skip to the report</a>'
        f'{_header(data)}<nav class="index" aria-label="Sections"><ul>{links}</ul></nav>'
        f'<main id="main">{_summary(data)}{blocks}</main>{_footer(data)}'
    )


def _header(data: ReportData) -> str:
    tone, mark = _TONES[data.outcome]
    setup = "".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
        for name, value in data.setup.items()
    )
    return (
        '<header class="top"><p class="eyebrow">Repair report</p>'
        f'<div class="headline"><h1>{escape(data.title)}</h1>'
        f'<p class="verdict {tone}"><span aria-hidden="true">{mark}</span> '
        f"{HEADLINES[data.outcome]}</p></div>"
        f'<dl class="setup">{setup}</dl></header>'
    )


def _summary(data: ReportData) -> str:
    lines = "".join(f"<li>{escape(line)}</li>" for line in summary_of(data))
    tiles = "".join(
        f'<div class="tile"><dt>{name}</dt><dd>{value}</dd>{_remark(remark)}</div>'
        for name, value, remark in _tiles(data)
    )
    return (
        '<section id="summary" aria-label="Summary">'
        f'<ol class="lines">{lines}</ol><dl class="tiles">{tiles}</dl></section>'
    )


def _remark(text: str) -> str:
    return f'<dd class="remark">{text}</dd>' if text else ""


def _tiles(data: ReportData) -> Iterable[tuple[str, str, str]]:
    """Key figures: name, value and a remark, as HTML."""
    figures = data.figures
    yield "Missing before", _big(figures.missing_mm3_before, "mm³"), ""
    after = figures.missing_mm3_after
    yield (
        "Missing after",
        _big(after, "mm³"),
        "not scanned again" if after is None else "as the last scan measured it",
    )
    if figures.repaired_ratio is not None:
        value = percent(figures.repaired_ratio).replace(" %", " <small>%</small>")
        yield "Repaired", value, "by the true volume"
    if figures.excess_mm3_before > 0 or (figures.excess_mm3_after or 0) > 0:
        yield (
            "Too much",
            _big(
                figures.excess_mm3_before
                if figures.excess_mm3_after is None
                else figures.excess_mm3_after,
                "mm³",
            ),
            f"{quantity(figures.excess_mm3_before, 'mm³')} before",
        )
    if figures.unprintable_mm3 > NEGLIGIBLE_MM3:
        left_mm3 = figures.unreachable_mm3 + figures.unprintable_mm3
        why = "too small for a bead, or nothing holds one"
        if figures.unreachable_mm3 > NEGLIGIBLE_MM3:
            why = f"{quantity(figures.unreachable_mm3, 'mm³')} out of reach, the rest holds no bead"
        yield "Left out", _big(left_mm3, "mm³"), why
    else:
        yield "Out of reach", _big(figures.unreachable_mm3, "mm³"), "for this nozzle"
    if figures.covered_mm3 > NEGLIGIBLE_MM3:
        yield "Covered", _big(figures.covered_mm3, "mm³"), "left open under what was printed"
    yield "Not seen", _big(figures.unseen_area_mm2, "mm²"), "unknown, never filled"
    if figures.filament_mm > 0:
        yield (
            "Repair",
            f"<span>{escape(duration(figures.print_time_s))}</span>",
            f"{length(figures.filament_mm)} of filament",
        )


def _big(value: float | None, unit: str) -> str:
    if value is None or not math.isfinite(value):
        return f'<span aria-label="not known">{DASH}</span>'
    return f"{quantity(value, '')} <small>{unit}</small>"


def _inspect(data: ReportData) -> str:
    drawn = drawn_looks(data)
    if not drawn:
        return ""
    return (
        f'<div class="toolbar">{_look_picker(data, drawn, "look", "Scan")}{_presets()}</div>'
        '<div class="stage"><figure class="view" id="viewer" tabindex="0" role="group" '
        f'aria-label="{_alt(data)}" aria-describedby="scene-help">'
        '<div class="plot"></div></figure>'
        f'<aside class="panel" aria-label="What is drawn">{_layers()}{_scale()}{_views()}'
        "</aside></div>"
        f"{_player(data)}"
        '<p class="note" id="scene-note"></p>'
        '<p class="note" id="scene-help">Drag to turn, right-drag to shift. Click the drawing, '
        "then scroll to zoom; or use the arrow keys, + and −, and 0 for the first view.</p>"
        '<div class="pair"><figure class="chart"><figcaption><h3>How far points lie from the '
        'expected surface</h3></figcaption><div id="histogram" class="plot" role="img" '
        'aria-label="Histogram of the signed deviation with the threshold"></div>'
        '<p class="note" id="histogram-note"></p></figure>'
        '<figure class="chart" id="noise-figure"><figcaption><h3>What this scan could show'
        '</h3></figcaption><div id="noise" class="plot" role="img" '
        'aria-label="Least depth that the scan could show, by area"></div>'
        '<p class="note" id="noise-note"></p></figure>'
        '<figure class="chart" id="heights-figure"><figcaption><h3 id="heights-title">Top surface'
        '</h3></figcaption><div id="heights" class="plot" role="img" '
        'aria-label="Height map seen from above with the defects outlined"></div>'
        '<p class="note">Height above the bed, defects outlined in white; violet cells no '
        "sensor saw.</p></figure></div>"
        "<noscript><p>The drawings need JavaScript; the tables below do not.</p></noscript>"
    )


def _alt(data: ReportData) -> str:
    """Words for those who do not see the drawing."""
    found = summary_of(data)[0]
    return escape(
        f"Three-dimensional view of {data.title}: scan points coloured by deviation, the expected "
        f"part as a ghost, what is missing, what is too much and the repair. {found}"
    )


def _look_picker(data: ReportData, drawn: Sequence[int], key: str, name: str) -> str:
    options = "".join(
        f'<option value="{position}">{escape(data.looks[index].label)}</option>'
        for position, index in enumerate(drawn)
    )
    return f'<label class="pick">{name} <select id="{key}">{options}</select></label>'


def _presets() -> str:
    choices = (("deviation", "Deviation"), ("defects", "Defects"), ("repair", "Repair"))
    inputs = "".join(
        f'<label><input type="radio" name="preset" value="{key}"'
        f"{' checked' if key == 'deviation' else ''}><span>{title}</span></label>"
        for key, title in choices
    )
    return f'<fieldset class="segments"><legend class="hidden">Show</legend>{inputs}</fieldset>'


def _layers() -> str:
    rows = (
        ("scan", "Scan points", "dot scan"),
        ("ghost", "Expected part", "dot ghost"),
        ("missing", "Missing", "dot missing"),
        ("excess", "Too much", "dot excess"),
        ("beads", "Repair beads", "dot beads"),
        ("unseen", "Not seen", "dot unseen"),
        *((key, f"Left: {cause}", f"dot {key}") for key, cause in LEFT_CAUSES.items()),
    )
    boxes = "".join(
        f'<label class="check" data-layer="{key}"><input type="checkbox" data-layer="{key}">'
        f'<span class="{dot}" aria-hidden="true"></span>{title}</label>'
        for key, title, dot in rows
    )
    return f"<fieldset><legend>Drawn</legend>{boxes}</fieldset>"


def _scale() -> str:
    return (
        '<fieldset class="scale"><legend>Deviation, mm</legend><div class="ramp">'
        '<div id="ramp" class="bar" role="img" aria-label="Colour scale: blue is missing, orange '
        'is too much, grey agrees"></div><div id="ramp-ticks" class="ticks"></div></div>'
        '<label class="pick">Range <select id="range"></select></label></fieldset>'
    )


def _views() -> str:
    names = ("Overview", "Top", "Front", "Right")
    buttons = "".join(
        f'<button type="button" data-view="{name.lower()}">{name}</button>' for name in names
    )
    return f'<fieldset class="views"><legend>View</legend>{buttons}</fieldset>'


def _player(data: ReportData) -> str:
    if not any(look.beads is not None for look in data.looks):
        return ""
    return (
        '<div class="player" id="player"><button type="button" id="play" aria-label="Play the '
        'repair layer by layer"><span aria-hidden="true">▶</span></button>'
        '<label class="hidden" for="layer">Repair layer</label>'
        '<input type="range" id="layer" min="0" max="0" value="0" step="1">'
        '<output id="layer-text" for="layer"></output></div>'
    )


def _compare(data: ReportData) -> str:
    drawn = drawn_looks(data)
    if len(drawn) < 2:
        return ""
    panes = "".join(
        f'<figure class="view small" id="{key}" tabindex="0" role="group" '
        f'aria-label="{title}: scan points coloured by deviation">'
        f"<figcaption>{_look_picker(data, drawn, key + '-look', title)}"
        f'<span class="figure" id="{key}-figure"></span></figcaption>'
        '<div class="plot"></div></figure>'
        for key, title in (("before", "Before"), ("after", "After"))
    )
    return (
        '<p class="lead">Both views turn together and share the colour scale above.</p>'
        f'<div class="pair">{panes}</div>'
    )


def _volumes_title(data: ReportData) -> str:
    if not data.temperatures:
        return "Volumes"
    return "Volumes and temperatures" if len(data.looks) > 1 else "Temperatures"


def _volumes(data: ReportData) -> str:
    charts = []
    if len(data.looks) > 1:  # the summary has the volumes of one
        charts.append(
            '<figure class="chart"><figcaption><h3>Volume at each scan</h3></figcaption>'
            '<div id="volumes-chart" class="plot" role="img" aria-label="Bars of missing and '
            f'excess volume at each scan: {escape(_volumes_in_words(data.looks))}"></div></figure>'
        )
    if data.temperatures:
        charts.append(
            '<figure class="chart"><figcaption><h3>Temperatures</h3></figcaption>'
            '<div id="temperatures" class="plot" role="img" aria-label="Measured and target '
            'temperature of each heater over the run"></div></figure>'
        )
    return f'<div class="pair">{"".join(charts)}</div>' if charts else ""


def _volumes_in_words(looks: Sequence[ReportLook]) -> str:
    return "; ".join(
        f"{look.label}: {quantity(look.missing_mm3, 'mm³')} missing, "
        f"{quantity(look.excess_mm3, 'mm³')} too much"
        for look in looks
    )


def _footer(data: ReportData) -> str:
    omitted = len(data.looks) - len(drawn_looks(data))
    note = f" {omitted} scans without events are left out of the drawings." if omitted else ""
    return (
        "<footer><p>Coordinates are millimetres on the bed: origin at its front left corner, Z up. "
        "Negative deviation lies inside the expected part, where material is missing. Drawings of "
        "large scans are thinned to keep this file small; volumes and decisions use every point."
        f"{note}</p>"
        "<p>This file holds everything it shows and asks nothing of the network.</p></footer>"
    )
