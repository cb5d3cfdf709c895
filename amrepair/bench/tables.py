"""Results as JSON, CSV and Markdown, with the published figures beside ours.

It arranges rows; it measures nothing.
"""

from __future__ import annotations

import csv
import io
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict, fields

import numpy as np

from amrepair.bench.cells import ScoreRow
from amrepair.bench.metrics import mean_and_spread
from amrepair.bench.registry import PAPER_METHOD, PUBLISHED, PUBLISHED_REPAIR
from amrepair.template.paper import PUBLISHED_NETWORK, PaperOptions

AREAS = ("o_auroc", "p_auroc", "o_aupr", "p_aupr")
FIGURES = (
    *AREAS,
    "seconds_per_sample",
    "fit_seconds",
    "cd",
    "emd",
    "cd_squared",
    "to_surface",
    "from_surface",
)


def _value(row: ScoreRow, figure: str) -> float:
    found = getattr(row, figure)
    return math.nan if found is None else float(found)


def summary(rows: Sequence[ScoreRow], method: str) -> dict[str, tuple[float, float]]:
    """Figure → (mean, spread): mean over classes for each seed, then over seeds."""
    own = [row for row in rows if row.method == method]
    seeds = sorted({row.seed for row in own})
    found = {}
    for figure in FIGURES:
        by_seed = [
            mean_and_spread(np.array([_value(row, figure) for row in own if row.seed == seed]))[0]
            for seed in seeds
        ]
        found[figure] = mean_and_spread(np.array(by_seed))
    return found


def _methods(rows: Sequence[ScoreRow]) -> list[str]:
    return list(dict.fromkeys(row.method for row in rows))


def _null(value: float) -> float | None:
    return None if math.isnan(value) else value


def recipe_note(paper: PaperOptions) -> str:
    """One sentence: where the recipe that ran differs from the published one."""
    was, now = asdict(PUBLISHED_NETWORK), asdict(paper)
    changes = [
        f"{name} {now[name]} instead of {was[name]}" for name in was if now[name] != was[name]
    ]
    if not changes:
        return f"{PAPER_METHOD}: the published recipe, unchanged."
    return f"{PAPER_METHOD}: the published recipe with {', '.join(changes)}."


def as_json(
    rows: Sequence[ScoreRow],
    format: str,
    *,
    synthetic: bool,
    complete: bool,
    paper: PaperOptions = PUBLISHED_NETWORK,
) -> str:
    """One object: rows by method, class and seed; means with spread; published figures."""
    means = []
    for method in _methods(rows):
        figures = {
            name: {"mean": _null(mean), "spread": _null(spread)}
            for name, (mean, spread) in summary(rows, method).items()
        }
        own = [row for row in rows if row.method == method]
        published = PUBLISHED.get(format, {}).get(method, (None, None))
        means.append(
            {
                "method": method,
                **figures,
                "failed_alignments": sum(row.failed_alignments for row in own),
                "badly_aligned": _total(own),
                "published_o_auroc": _share(published[0]),
                "published_p_auroc": _share(published[1]),
            }
        )
    said = {
        "format": str(format),
        "synthetic": synthetic,
        "complete": complete,
        "seeds": sorted({row.seed for row in rows}),
        "paper_recipe": asdict(paper) if PAPER_METHOD in _methods(rows) else None,
        "rows": [_renamed(row) for row in rows],
        "means": means,
        "published": {
            name: {"o_auroc": _share(o), "p_auroc": _share(p)}
            for name, (o, p) in PUBLISHED.get(format, {}).items()
        },
        "published_repair": dict(
            zip(("cd", "emd"), PUBLISHED_REPAIR.get(format, (None, None)), strict=True)
        ),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }
    return json.dumps(said, indent=1) + "\n"


def _renamed(row: ScoreRow) -> dict[str, object]:
    said = asdict(row)
    return {("class" if name == "class_name" else name): value for name, value in said.items()}


def _share(percent: float | None) -> float | None:
    return None if percent is None else round(percent / 100, 6)


def _total(rows: Sequence[ScoreRow]) -> int | None:
    known = [row.badly_aligned for row in rows if row.badly_aligned is not None]
    return sum(known) if known else None


def as_csv(rows: Sequence[ScoreRow]) -> str:
    """One line for each method, class and seed."""
    stream = io.StringIO()
    names = ["class" if field.name == "class_name" else field.name for field in fields(ScoreRow)]
    writer = csv.DictWriter(stream, names, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow(_renamed(row))
    return stream.getvalue()


def _percent(mean: float, spread: float) -> str:
    return "–" if math.isnan(mean) else f"{100 * mean:.1f} ± {100 * spread:.1f}"


def _plain(mean: float, digits: int) -> str:
    return "–" if math.isnan(mean) else f"{mean:.{digits}f}"


def _published(format: str, method: str) -> str:
    pair = PUBLISHED.get(format, {}).get(method)
    if pair is None:
        return "–"
    return " / ".join("–" if value is None else f"{value:.1f}" for value in pair)


def in_short(rows: Sequence[ScoreRow]) -> str:
    """A line for each method: what one wants to know first."""
    lines = []
    for method in _methods(rows):
        found = summary(rows, method)
        own = [row for row in rows if row.method == method]
        bad, samples = _total(own), sum(row.samples for row in own)
        lines.append(
            f"{method}: O-AUROC {_percent(*found['o_auroc'])}, P-AUROC "
            f"{_percent(*found['p_auroc'])}, {_plain(found['seconds_per_sample'][0], 2)} s a sample"
            + ("" if bad is None else f", {bad} of {samples} badly aligned")
        )
    return "\n".join(lines)


def as_markdown(
    rows: Sequence[ScoreRow],
    format: str,
    *,
    synthetic: bool,
    complete: bool,
    paper: PaperOptions = PUBLISHED_NETWORK,
) -> str:
    """Means over classes with the spread over seeds, then every class."""
    seeds = sorted({row.seed for row in rows})
    classes = sorted({row.class_name for row in rows})
    lines = [
        f"# {format}: {len(classes)} classes, seeds {', '.join(map(str, seeds))}",
        "",
        *([] if complete else ["**Not finished: the table holds what is done so far.**", ""]),
        "Areas in %, mean over classes ± standard deviation over seeds. Published: O-AUROC / "
        "P-AUROC"
        + (
            " **on the published data, not on this synthetic set**."
            if synthetic
            else " as printed in PASDF (arXiv 2505.24431)."
        ),
        "",
        "| method | O-AUROC | P-AUROC | O-AUPR | P-AUPR | s/sample | CD | EMD | to surface "
        "| from surface | badly aligned | published |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for method in _methods(rows):
        found = summary(rows, method)
        own = [row for row in rows if row.method == method]
        bad = _total(own)
        cells = [
            method,
            *(_percent(*found[name]) for name in AREAS),
            _plain(found["seconds_per_sample"][0], 3),
            _plain(found["cd"][0], 4),
            _plain(found["emd"][0], 4),
            _plain(found["to_surface"][0], 6),
            _plain(found["from_surface"][0], 6),
            "–" if bad is None else f"{bad} of {sum(row.samples for row in own)}",
            _published(format, method),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    others = [name for name in PUBLISHED.get(format, {}) if name not in _methods(rows)]
    lines += [
        f"| {name} (not run) " + "| – " * 10 + f"| {_published(format, name)} |" for name in others
    ]
    if format in PUBLISHED_REPAIR:
        cd, emd = PUBLISHED_REPAIR[format]
        lines += ["", f"Published CD / EMD of the repair template: {cd} / {emd}."]
    lines.append("")
    lines += [
        "CD and EMD of two samples of the same surface are not 0: at 16,000 points they sit on "
        "their sampling floor. To surface and from surface are mean distances of the repair "
        "template's points to the normal surface and back; all four in units of its radius.",
        "",
    ]
    if PAPER_METHOD in _methods(rows):
        lines += [recipe_note(paper), ""]
    lines += ["## By class (O-AUROC / P-AUROC, mean over seeds)", ""]
    lines.append("| class | " + " | ".join(_methods(rows)) + " |")
    lines.append("|---" * (len(_methods(rows)) + 1) + "|")
    for name in classes:
        pairs = [_pair(rows, name, method) for method in _methods(rows)]
        lines.append(f"| {name} | " + " | ".join(pairs) + " |")
    return "\n".join(lines) + "\n"


def _pair(rows: Sequence[ScoreRow], class_name: str, method: str) -> str:
    own = [row for row in rows if row.method == method and row.class_name == class_name]
    if not own:
        return "–"
    means = [mean_and_spread(np.array([_value(row, name) for row in own]))[0] for name in AREAS[:2]]
    return " / ".join("–" if math.isnan(mean) else f"{100 * mean:.1f}" for mean in means)
