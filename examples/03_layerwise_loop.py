"""The closed loop in simulation: a void is found at its layer and filled before the next is laid.

python examples/03_layerwise_loop.py        writes the job, every repair and report.html

Between the G-code and the nozzle everything is real: the serial adapter, a pseudo-terminal, the
protocol, an emulated firmware. Only plastic and light are simulated.
"""

from __future__ import annotations

import manifold3d as m3
from _shared import mesh_of, out_folder

import gcode
from amrepair.report import TemperatureSeries, report_of_loop, summary_of_result, write_report
from amrepair.report.collect import loop_result
from amrepair.report.folder import RunFolder
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.run import prepare_run, simulate_run
from amrepair.template import MeshSdf


def part() -> m3.Manifold:
    """A plate with a step: 22 mm long, 22 layers."""
    return m3.Manifold.cube((22.0, 18.0, 3.0)) + m3.Manifold.cube((12.0, 11.0, 1.5)).translate(
        (3.0, 3.0, 2.9)
    )


def main() -> None:
    out = out_folder(__doc__)
    folder = RunFolder(out)
    setup = gcode.load_setup("prusa_mk3s", "pla", "repair_0.20")
    template = MeshSdf.from_mesh(mesh_of(part()))
    defects = [parse_defect("void:diameter=7,layers=3")]

    prepared = prepare_run(template, setup, defects, title="plate", seed=3)
    folder.write_text("job.gcode", prepared.checked.program.text)
    run = simulate_run(prepared, record=folder.record)

    for look in run.report.looks:
        what = "repaired" if look.printed else "went on"
        missing_mm3 = look.plan.deficit.missing_mm3
        print(f"{look.stop.label}: {missing_mm3:5.1f} mm³ missing, {what}")
    result = loop_result(
        run.report, repaired_ratio=run.repaired_ratio, gcode=None, seed=3, seconds={}, setup=setup
    )
    clock, hotend, bed = run.temperatures.T
    page = report_of_loop(
        run.report,
        result,
        title="A plate with a void",
        setup=setup,
        expected=prepared.part,
        temperatures=(
            TemperatureSeries("hotend", clock, hotend),
            TemperatureSeries("bed", clock, bed),
        ),
    )
    write_report(page, out / "report.html")
    for line in summary_of_result(result, within_tolerance=run.report.within_tolerance):
        print(line)
    print(f"Report: {out / 'report.html'}")


if __name__ == "__main__":
    main()
