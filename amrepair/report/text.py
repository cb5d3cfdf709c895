"""Words and numbers for people: the three-line summary, and how quantities are written.

It makes text, never markup; the terminal and the page share it.
"""

from __future__ import annotations

import math
from collections import Counter as Tally
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from amrepair.report.data import Figures, Outcome, RegionRow, ReportData, regions_from_result

if TYPE_CHECKING:
    from amrepair.repair import RepairPlan

# Below this a volume is less than half of the smallest bead that can be placed (0.08 mm³).
NEGLIGIBLE_MM3 = 0.04
NOT_KNOWN = "not known"
_DEFECT_NAMES = {
    "void": ("void", "voids"),
    "under_extrusion": ("patch of thin extrusion", "patches of thin extrusion"),
    "chip": ("chip", "chips"),
    "missing_beads": ("place without beads", "places without beads"),
    "over_extrusion": ("patch of thick extrusion", "patches of thick extrusion"),
    "blob": ("blob", "blobs"),
    "string": ("string", "strings"),
    "sag": ("sagging overhang", "sagging overhangs"),
    "layer_shift": ("shift of layers", "shifts of layers"),
    "warp": ("warped place", "warped places"),
    "detached": ("part off the bed", "parts off the bed"),
    "clog": ("clog", "clogs"),
}
HEADLINES = {
    Outcome.WITHIN_TOLERANCE: "Within tolerance",
    Outcome.NOT_WITHIN_TOLERANCE: "Not within tolerance",
    Outcome.NOTHING_TO_REPAIR: "Nothing to repair",
    Outcome.PLANNED: "Repair ready to print",
    Outcome.PLANNED_IN_PART: "Repair ready to print, but it does not mend all",
    Outcome.STOPPED: "Stopped",
}


def quantity(value: float, unit: str) -> str:
    """`1,234 mm³`, `12.3 mm³`, `0.04 mm³`: about three significant digits, no exponent.

    Examples
    --------
    >>> quantity(1234.56, "mm³"), quantity(12.34, "mm³"), quantity(0.0449, "mm")
    ('1,235 mm³', '12.3 mm³', '0.04 mm')
    """
    if not math.isfinite(value):
        return NOT_KNOWN
    magnitude = abs(value)
    decimals = 0 if magnitude >= 100 else 1 if magnitude >= 10 else 2
    text = f"{value:,.{decimals}f}"
    if float(text.replace(",", "")) == 0:
        text = "0"
    return f"{text} {unit}".strip()


def length(length_mm: float) -> str:
    """Filament: `36 mm`, `1.24 m`.

    Examples
    --------
    >>> length(36.4), length(1240.0)
    ('36 mm', '1.24 m')
    """
    if not math.isfinite(length_mm):
        return NOT_KNOWN
    if abs(length_mm) < 1000:
        return f"{length_mm:.0f} mm" if abs(length_mm) >= 10 else quantity(length_mm, "mm")
    return quantity(length_mm / 1000, "m")


def percent(ratio: float) -> str:
    """`95 %`; 100 % and 0 % are said only where they are true to the last digit.

    Examples
    --------
    >>> percent(0.953), percent(0.9996), percent(1.0)
    ('95 %', '99.9 %', '100 %')
    """
    if not math.isfinite(ratio):
        return NOT_KNOWN
    if ratio <= 0 or ratio >= 1:
        return f"{100 * ratio:.0f} %"
    if ratio >= 0.99 or ratio < 0.01:
        return f"{min(max(100 * ratio, 0.1), 99.9):.1f} %"
    return f"{100 * ratio:.0f} %"


def duration(seconds: float) -> str:
    """`1 h 05 min`, `6 min 40 s`, `12 s`, `0.8 s`.

    Examples
    --------
    >>> duration(3900), duration(400), duration(12.4), duration(0.81)
    ('1 h 05 min', '6 min 40 s', '12 s', '0.8 s')
    """
    if not math.isfinite(seconds):
        return NOT_KNOWN
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min"


def kind_name(name: str) -> str:
    """One defect's kind in words: `patch of thin extrusion`.

    Examples
    --------
    >>> kind_name("under_extrusion"), kind_name("scratch_mark")
    ('patch of thin extrusion', 'scratch mark')
    """
    return _DEFECT_NAMES.get(name, (name.replace("_", " "),))[0]


def kinds(regions: Sequence[RegionRow]) -> str:
    """`a void and 2 chips`; empty where there are no regions."""
    tally = Tally(region.type for region in regions)
    parts = []
    for name, count in tally.items():
        one, many = _DEFECT_NAMES.get(name, (kind_name(name), kind_name(name) + "s"))
        parts.append(f"{_article(one)} {one}" if count == 1 else f"{count} {many}")
    if len(parts) < 2:
        return "".join(parts)
    return ", ".join(parts[:-1]) + " and " + parts[-1]


def summary(
    outcome: Outcome, figures: Figures, regions: Sequence[RegionRow]
) -> tuple[str, str, str]:
    """Three lines: what was found, what was done about it, what is left.

    Examples
    --------
    >>> from amrepair.report.data import Figures, Outcome
    >>> clean = Figures(0.0, None, 0.0, None, None, 0.0, 0.0, 0, 0.0, 0.0)
    >>> summary(Outcome.NOTHING_TO_REPAIR, clean, ())[0]
    'Nothing is missing: the part agrees with its template.'
    """
    return _found(figures, regions), _done(figures), _left(outcome, figures)


def summary_of(data: ReportData) -> tuple[str, str, str]:
    """The three lines of a report."""
    return summary(data.outcome, data.figures, data.regions)


def outcome_of(result: Mapping[str, object], *, within_tolerance: bool) -> Outcome:
    """How a run ended, told from its `--json` result and whether its exit code is 0."""
    figures = Figures.from_result(result)
    if result.get("stopped"):
        return Outcome.STOPPED
    if not figures.missing_mm3_before > NEGLIGIBLE_MM3 and figures.filament_mm <= 0:
        return Outcome.NOTHING_TO_REPAIR if within_tolerance else Outcome.NOT_WITHIN_TOLERANCE
    if figures.missing_mm3_after is None and figures.repaired_ratio is None:
        if within_tolerance:
            return Outcome.PLANNED
        if figures.filament_mm > 0:
            return Outcome.PLANNED_IN_PART
    return Outcome.WITHIN_TOLERANCE if within_tolerance else Outcome.NOT_WITHIN_TOLERANCE


def summary_of_result(
    result: Mapping[str, object], *, within_tolerance: bool
) -> tuple[str, str, str]:
    """The three lines for the terminal, from a `--json` result."""
    found, done, left = summary(
        outcome_of(result, within_tolerance=within_tolerance),
        Figures.from_result(result),
        regions_from_result(result),
    )
    names = result.get("given_up")
    if isinstance(names, list) and names:
        left += f" Given up, so that the other objects could go on: {', '.join(map(str, names))}."
    return found, done, left


def _found(figures: Figures, regions: Sequence[RegionRow]) -> str:
    missing, excess = figures.missing_mm3_before, figures.excess_mm3_before
    if not figures.looked:
        return "The part was not looked at: what is missing is not known."
    listed = kinds(regions)
    where = f" ({listed})" if listed else ""
    if missing > NEGLIGIBLE_MM3 and excess > NEGLIGIBLE_MM3:
        return (
            f"Found {quantity(missing, 'mm³')} missing and "
            f"{quantity(excess, 'mm³')} too much{where}."
        )
    if missing > NEGLIGIBLE_MM3:
        return f"Found {quantity(missing, 'mm³')} missing{where}."
    if excess > NEGLIGIBLE_MM3:
        return (
            f"Nothing is missing, but {quantity(excess, 'mm³')} too much stands there{where}; "
            "printing cannot take it away."
        )
    if figures.passed_by:
        return "Nothing was missing at the looks that had a scan."
    return "Nothing is missing: the part agrees with its template."


def _done(figures: Figures) -> str:
    if figures.filament_mm <= 0:
        return "No repair was made or printed."
    cost = f"{length(figures.filament_mm)} of filament"
    if math.isfinite(figures.print_time_s):
        cost += f" in {duration(figures.print_time_s)}"
    if figures.missing_mm3_after is None and figures.repaired_ratio is None:
        return f"The repair takes {cost}; its G-code passed every check and has not been printed."
    rounds = f" over {figures.iterations} repairs" if figures.iterations > 1 else ""
    if figures.repaired_ratio is not None and math.isfinite(figures.repaired_ratio):
        return (
            f"Printed {cost}{rounds}; {percent(figures.repaired_ratio)} of what was missing "
            "is there now."
        )
    return f"Printed {cost}{rounds}."


def _left(outcome: Outcome, figures: Figures) -> str:
    parts = []
    if not figures.looked:
        parts.append("look at it, or scan it and let 'amrepair detect' judge")
    elif figures.missing_mm3_after is None:
        if outcome is Outcome.NOTHING_TO_REPAIR:
            parts.append("Nothing is left to do")
        elif figures.filament_mm <= 0:
            missing = figures.missing_mm3_before > NEGLIGIBLE_MM3
            parts.append("All of it is still missing" if missing else "There is nothing to print")
        else:
            parts.append("What is left is not known yet: scan again after printing")
    elif figures.missing_mm3_after > NEGLIGIBLE_MM3:
        parts.append(f"{quantity(figures.missing_mm3_after, 'mm³')} still missing")
    else:
        looks = " that a look shows" if figures.covered_mm3 > NEGLIGIBLE_MM3 else ""
        was = figures.missing_mm3_before > NEGLIGIBLE_MM3 or figures.filament_mm > 0
        parts.append(f"Nothing is missing{' any more' if was else ''}{looks}")
    if figures.covered_mm3 > NEGLIGIBLE_MM3:
        parts.append(
            f"{quantity(figures.covered_mm3, 'mm³')} that the nozzle did not get to are covered now"
        )
    if figures.excess_mm3_after is not None and figures.excess_mm3_after > NEGLIGIBLE_MM3:
        parts.append(f"{quantity(figures.excess_mm3_after, 'mm³')} too much")
    if figures.unreachable_mm3 > NEGLIGIBLE_MM3:
        parts.append(f"the nozzle cannot reach {quantity(figures.unreachable_mm3, 'mm³')}")
    if figures.unprintable_mm3 > NEGLIGIBLE_MM3:
        parts.append(f"{quantity(figures.unprintable_mm3, 'mm³')} can hold no bead")
    if figures.unseen_area_mm2 >= 0.5:
        parts.append(
            f"no sensor saw {quantity(figures.unseen_area_mm2, 'mm²')} of the surface (what it "
            "stands on included), for which nobody can vouch"
        )
    if figures.passed_by:
        parts.append(f"no scan came at {', '.join(figures.passed_by)}")
    text = "; ".join(parts)
    return text[0].upper() + text[1:] + "."


def plan_lines(plan: RepairPlan) -> list[str]:
    """What was found at a scan, and what its repair would do: said before anything moves."""
    regions = plan.to_fill
    lines = [f"missing: {quantity(plan.deficit.missing_mm3, 'mm³')} in {_count(regions, 'region')}"]
    if regions:
        low = np.min([np.asarray(region.box_mm)[0] for region in regions], axis=0)
        high = np.max([np.asarray(region.box_mm)[1] for region in regions], axis=0)
        lines[0] += (
            f", at X {low[0]:.1f} to {high[0]:.1f}, Y {low[1]:.1f} to {high[1]:.1f}, "
            f"Z {low[2]:.2f} to {high[2]:.2f} mm"
        )
    if plan.too_much:
        count = _count(plan.too_much, "region")
        lines.append(f"too much, which printing cannot take away: {count}")
    if plan.estimate is not None:
        cost = plan.estimate
        lines.append(
            f"the repair takes {duration(cost.print_time_s)} and {length(cost.filament_mm)} of "
            "filament"
        )
        if plan.patch is not None:
            lines.append(plan.patch.first_pass.replace(" C", " °C"))
    elif regions:
        lines.append("no repair can be printed here")
    lines += [f"left out: {line}" for line in left_out_lines(plan)]
    if plan.refused:
        lines.append(f"the checker refuses it: {plan.refused}")
    return lines


def left_out_lines(plan: RepairPlan) -> list[str]:
    """What a plan leaves out, by reason: `3.9 mm³: the nozzle would touch …`, largest first."""
    if plan.patch is None:
        return []
    pieces = [(piece.reason, piece.volume_mm3) for piece in plan.patch.unreachable]
    pieces += [(piece.reason, piece.volume_mm3) for piece in plan.patch.unprintable]
    by_reason: dict[str, float] = {}
    for reason, volume_mm3 in pieces:
        by_reason[reason] = by_reason.get(reason, 0.0) + volume_mm3
    ranked = sorted(by_reason.items(), key=lambda item: -item[1])
    worth = [(reason, mm3) for reason, mm3 in ranked if mm3 > NEGLIGIBLE_MM3]
    return [f"{quantity(mm3, 'mm³')}: {reason}" for reason, mm3 in worth]


def _count(things: Sequence[object], name: str) -> str:
    return f"{len(things)} {name}{'' if len(things) == 1 else 's'}"


def _article(word: str) -> str:
    return "an" if word[0] in "aeiou" else "a"
