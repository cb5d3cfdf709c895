"""A finished part lost a piece: from one scan to checked G-code that prints only that piece.

python examples/01_offline_repair.py        writes repair.gcode and report.html
"""

from __future__ import annotations

import manifold3d as m3
import numpy as np
from _shared import PARTS, out_folder, scan_of

import amrepair
import gcode
from amrepair.repair import Stopwatch
from amrepair.report import report_of_plan, summary_of_result, write_report
from amrepair.report.collect import plan_result
from amrepair.scans import write_ply
from amrepair.template import MeshSdf, load_mesh

PLACE_MM = (125.0, 105.0, 0.0)  # where the knob stands on the bed


def main() -> None:
    out = out_folder(__doc__)

    # The accident: a corner of the rim breaks off, and somebody scans what is left.
    knob = gcode.read_solid(PARTS / "knob.stl")
    piece = m3.Manifold.cube((20.0, 20.0, 2.2)).translate((1.0, 1.0, 9.8)) ^ knob
    scan_file = out / "scan.ply"
    write_ply(scan_of((knob - piece).translate(PLACE_MM), frame="build"), scan_file)

    # The repair. `open_template` would fit a learned template, or take it from the cache; for a
    # single part the mesh's own exact field does as well.
    setup = gcode.load_setup("prusa_mk3s", "pla", "repair_0.20")
    template = MeshSdf.from_mesh(load_mesh(PARTS / "knob.stl"))
    scan = amrepair.read_scan(scan_file, frame="build")
    site = amrepair.Site.of_part(template, setup)
    guess = amrepair.Transform.from_rotation_translation(
        "template", "build", rotation=np.eye(3), translation_mm=-np.array(PLACE_MM)
    )  # knobs look alike from many sides: say roughly how it stands
    watch = Stopwatch()
    plan = amrepair.plan_repair(scan, site, title="knob", guess=guess, watch=watch)
    if plan.checked is None:
        raise SystemExit("nothing is missing that a bead could fill")
    program = out / "repair.gcode"
    program.write_text(plan.checked.program.text, encoding="utf-8")

    result = plan_result(plan, gcode=str(program), seed=None, seconds=watch.seconds, setup=setup)
    page = report_of_plan(plan, result, title="Repair of a knob", setup=setup, template=template)
    write_report(page, out / "report.html")
    print(f"broken off: {piece.volume():.1f} mm³, measured: {plan.deficit.missing_mm3:.1f} mm³")
    for line in summary_of_result(result, within_tolerance=plan.within_tolerance):
        print(line)
    print(f"Program: {program}")
    print(f"Report: {out / 'report.html'}")


if __name__ == "__main__":
    main()
