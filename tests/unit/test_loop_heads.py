"""The loop over a job that changes between two heads, as an emulated printer carries it out."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from loop_bench import LAYER, PLACE_MM, Small, scan_of

from amrepair.loop import Action
from gcode.check import check
from gcode.firmware import FirmwareCore
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import job_for
from gcode.slicing.job import plan_part
from gcode.writer import write
from tests.draws import draws

HOT_C = (215.0, 220.0)


@pytest.fixture(scope="module")
def small() -> Small:
    """Layer by layer the one head, and the other, which is heated before it is taken."""
    made = Small.made()
    setup = load_setup("prusa_xl_2t", "pla", "repair_0.20")
    program = write(plan_part(made.part.translate(PLACE_MM), setup).toolpath, setup, title="small")
    lines = program.text.rstrip("\n").split("\n")
    job = job_for(program, setup.printer)
    for layer in reversed(job.layers[1:]):
        head, state = layer.index % 2, job.state_after(layer.first_line)
        x, y, _ = state.position_mm
        lines[layer.first_line + 1 : layer.first_line + 1] = [
            "G1 E0.8 F2100",
            f"M104 T{1 - head} S150",
            f"M109 T{head} S{HOT_C[head]:g}",
            f"T{head}",
            f"G1 X{x} Y{y} F9000",
            "G1 E-0.8 F2100",
        ]
    text = "\n".join([*lines, "M104 T0 S0", "M104 T1 S0", ""])
    checked = check(Program(text, setup.printer.dialect), setup)
    job = job_for(checked.program, setup.printer)
    return replace(made, setup=setup, job=job, checked=checked)


@pytest.mark.parametrize("after", draws([LAYER, LAYER + 1], LAYER + 1))
def test_a_pit_is_filled_by_the_head_that_is_there(
    after: int, small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("loop_bench.LAYER", after)
    pit = small.block(-0.4, 0.1)
    scans = [small.standing - pit, small.standing]
    report, sent = small.run(tmp_path, lambda n: scan_of(scans[n - 1]))
    first, again = report.looks
    assert (first.decision.action, first.printed) == (Action.FILL_NOW, True)
    assert again.decision.action is Action.GO_ON
    own = small.checked.program.text.split("\n")
    assert [line for line in sent if line[:1] == "T"] == [line for line in own if line[:1] == "T"]

    core = FirmwareCore(small.setup.printer, small.setup.printer.dialect)
    machine = core.machine
    pushed_mm, hot_c, laid = np.zeros(2), [], 0.0
    repair = first.plan.checked
    assert repair is not None
    inside = {line for line in repair.program.text.split("\n") if " E" in line and " X" in line}
    for line in sent:
        before_mm = machine.native_e
        core.feed(line.encode() + b"\n")
        core.run()
        assert b"cold" not in core.take_output()
        pushed_mm[machine.heads.chosen] += machine.native_e - before_mm
        if line in inside:
            hot_c.append((machine.heads.chosen, machine.heads.heater.target_c))
            laid += machine.native_e - before_mm
    own_c = HOT_C[after % 2]
    hotter_c = own_c + small.setup.material.repair_first_bead_delta_c
    assert set(hot_c) == {(after % 2, hotter_c), (after % 2, own_c)}
    assert laid * 2.405 == pytest.approx(first.plan.deficit.missing_mm3, rel=0.25)
    assert (pushed_mm > 50).all()
    assert [one.target_c for one in machine.heads.heaters] == [0.0, 0.0]
