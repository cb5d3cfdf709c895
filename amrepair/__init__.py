"""amrepair turns scans into a solid that is missing; `gcode` turns that solid into G-code.

From a scan file to checked G-code:

>>> from pathlib import Path
>>> import amrepair, gcode
>>> setup = gcode.load_setup("prusa_mk3s", "pla", "repair_0.20")
>>> template = amrepair.open_template(Path("part.safetensors"))  # or the part's mesh
>>> scan = amrepair.read_scan(Path("scan.ply"), frame="build")
>>> site = amrepair.Site.of_part(template, setup)
>>> plan = amrepair.plan_repair(scan, site, title="repair of scan.ply")
>>> if plan.checked is not None:
...     written = Path("repair.gcode").write_text(plan.checked.program.text)
>>> print(f"{plan.deficit.missing_mm3:.0f} mm³ missing in {len(plan.to_fill)} region")
90 mm³ missing in 1 region

The names below are all there is to learn for that; they are loaded when first used, so that
importing this package costs nothing. Each room (`amrepair.scans`, `amrepair.align`, …) has more.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gcode.lazy import lazy_names

if TYPE_CHECKING:
    from amrepair.align import align as align_scan
    from amrepair.errors import AmrepairError
    from amrepair.frames import Transform
    from amrepair.loop import run_loop
    from amrepair.regions import detect as detect_defects
    from amrepair.repair import RepairPlan, Site, plan_repair
    from amrepair.scans import Scan, Scanner, read_scan
    from amrepair.template import fit_template, open_template

__version__ = "0.1.0"

__all__ = [
    "AmrepairError",
    "RepairPlan",
    "Scan",
    "Scanner",
    "Site",
    "Transform",
    "align_scan",
    "detect_defects",
    "fit_template",
    "open_template",
    "plan_repair",
    "read_scan",
    "run_loop",
]

# `align` and `detect` are rooms of this package: their functions go by a longer name up here.
_HOMES = {
    "amrepair.align": "align as align_scan",
    "amrepair.errors": "AmrepairError",
    "amrepair.frames": "Transform",
    "amrepair.loop": "run_loop",
    "amrepair.regions": "detect as detect_defects",
    "amrepair.repair": "RepairPlan, Site, plan_repair",
    "amrepair.scans": "Scan, Scanner, read_scan",
    "amrepair.template": "fit_template, open_template",
}

__getattr__, __dir__ = lazy_names(globals(), _HOMES)
