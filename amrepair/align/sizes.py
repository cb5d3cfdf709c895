"""Sizes of a scan and its template: whether they can be one part, and which unit was mistaken."""

from __future__ import annotations

from amrepair.align.options import AlignOptions
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import diagonal
from amrepair.scans import Scan
from amrepair.scans.ply import MM_PER
from amrepair.template.port import Template

SCAN_UNITS = {"m": "metres", "in": "inches", "cm": "centimetres", "um": "micrometres"}
# So many points tell a scan's size, to the factor between two units.
SIZE_POINTS = 20_000
# No piece of a part that is looked at is so small, and nothing around it so large.
WRONG_SCALE = 200.0


def other_size(scan: Scan, template: Template, options: AlignOptions) -> str:
    """What to add to a refusal, where the sizes differ much: also which unit would explain it."""
    size = diagonal(scan.points_mm)
    other = diagonal(template.bounds_mm)
    ratio = size / max(other, 1e-12)
    if 1.0 / options.told_size_jump < ratio < options.told_size_jump:
        return ""
    question, advice = _other_unit(ratio, options)
    question = f": {question}" if question else ""
    return f" (the scan is {size:.3g} mm across, its template {other:.3g} mm{question}){advice}"


def _other_unit(ratio: float, options: AlignOptions) -> tuple[str, str]:
    """Ask which unit explains two sizes, and say how the scan's is told; empty if none does."""
    slack = options.unit_slack
    as_large = {unit: ratio * MM_PER[unit] for unit in SCAN_UNITS}
    units = [unit for unit in SCAN_UNITS if 1 / slack < as_large[unit] < slack]
    if not units and ratio < 1.0:  # with what surrounds the part a scan is larger
        units = [unit for unit in SCAN_UNITS if slack <= as_large[unit] <= options.largest_ratio]
    near = [SCAN_UNITS[unit] for unit in units]
    near += [  # no drawing is in micrometres
        f"a template in {name}"
        for unit, name in SCAN_UNITS.items()
        if MM_PER[unit] > 1.0 and 1 / slack < ratio / MM_PER[unit] < slack
    ]
    question = f"{' or '.join(near)} for millimetres?" if near else ""
    advice = f"; the scan's is said with --scan-unit {' or '.join(units)}" if units else ""
    return question, advice


def refuse_other_size(scan: Scan, template: Template, options: AlignOptions) -> None:
    """Refuse to align what cannot be the same part in the same unit.

    Raises
    ------
    AlignmentError
        With the units that would explain it.
    """
    size = diagonal(scan.points_mm)
    other = diagonal(template.bounds_mm)
    ratio = size / max(other, 1e-12)
    if options.smallest_ratio <= ratio <= options.largest_ratio:
        return
    question, advice = _other_unit(ratio, options)
    hint = f" ({question}){advice}" if question else ""
    raise AlignmentError(
        f"the scan {scan.source} is {size:.3g} mm across, its template {other:.3g} mm: they cannot "
        f"be the same part in the same unit{hint}"
        + ("" if question or ratio > 1.0 else ", or it shows too little of it")
    )


def refuse_wrong_scale(scan: Scan, template: Template) -> None:
    """Refuse a scan that is said to lie in its template and is of another unit.

    Raises
    ------
    InputError
        If the sizes differ by more than any part of it could.
    """
    size = diagonal(scan.points_mm[:: max(1, len(scan) // SIZE_POINTS)])
    other = diagonal(template.bounds_mm)
    sizes = f"the scan {scan.source} spans {size:.3g} mm and the template {other:.3g} mm: "
    if 0 < size * WRONG_SCALE < other:
        raise InputError(f"{sizes}the scan looks like metres: read it as such (--scan-unit m)")
    if size > WRONG_SCALE * other:
        raise InputError(
            f"{sizes}the scan looks like micrometres, or the template like metres; "
            "convert one to mm"
        )
