"""A void that the whole loop finds and fills, on a firmware that moves in real time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import trimesh

from amrepair.loop import run_loop
from amrepair.loop.sites import sites
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.run import prepare_run, set_stage
from amrepair.template import MeshSdf
from gcode.firmware.motion import MotionBatch
from gcode.hosts import connect
from gcode.profiles import PrintSetup


def fills_a_void(
    setup: PrintSetup,
    port: str,
    take_motion: Callable[[], MotionBatch],
    *,
    dialect: str,
    baud: int,
    wire_log: Path,
) -> None:
    """It heats, homes, prints, rests, goes aside, is looked at, mends and goes on.

    Plastic and light alone are simulated, by what the firmware says that it moved.
    """
    part = MeshSdf.from_mesh(trimesh.creation.box(bounds=((0, 0, 0), (13, 10, 1.6))))
    run = prepare_run(part, setup, [parse_defect("void:diameter=5,layers=2")], title="", seed=3)
    stage = set_stage(run, take_motion)
    with connect(port, dialect=dialect, baud=baud, wire_log=wire_log) as printer:
        report = run_loop(
            run.job, run.checked, printer, stage,
            sites(run.job, part, run.build_from_template, setup, by_beads=run.by_beads),
            stops=run.stops,
        )  # fmt: skip
        cooling = printer.temperatures()
    stage.finish()
    assert [look.printed for look in report.looks].count(True) == 1
    assert report.within_tolerance
    truth = stage.truth[0]
    assert truth.missing_mm3 > 4.0
    assert truth.filled_mm3 > 0.9 * truth.missing_mm3
    assert (cooling.hotend_target_c, cooling.bed_target_c) == (0.0, 0.0)
