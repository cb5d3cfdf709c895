"""A plate of three blocks, one of which is lost in the simulated world: the others are printed."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.cli import main
from gcode.profiles import load_printer
from gcode.reader import job_for, objects_of
from gcode.reader.objects import box_of_beads_mm

SIZE_MM = (9.0, 9.0, 2.0)
APART_MM = 16.0
LAST = 6
"""The defect's last layer."""


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("part") / "three.stl"
    blocks = []
    for k in range(3):
        block = trimesh.creation.box(SIZE_MM)
        block.apply_translation((APART_MM * k, 0.0, 0.5 * SIZE_MM[2]))
        blocks.append(block)
    trimesh.util.concatenate(blocks).export(path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("printer", ["prusa_mk3s", "voron_2_4"])
def test_one_of_three_is_given_up_and_the_others_are_printed(
    printer: str,
    three: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = (
        f"simulate {three} --printer {printer} --out {tmp_path} --json "
        f"--defect void:diameter=14,layers={LAST},wall=0,layer={LAST}"
    )
    monkeypatch.setattr(sys, "argv", ["amrepair", *words.split()])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 3  # one is lost: not within tolerance
    result = json.loads(capsys.readouterr().out)
    events = [json.loads(line) for line in (tmp_path / "run.jsonl").read_text().splitlines()]
    rows = [e["decision"]["row"] for e in events if e["event"] == "look"]
    assert rows == ["S3", "S2a", "S12", "S12"]  # again, given up, the rest is sound twice
    assert events[-1] == {**events[-1], "event": "end", "stopped": ""}
    job = job_for((tmp_path / "job.gcode").read_text(), load_printer(printer))
    objects = objects_of(job)
    assert sorted(objects.names) == ["body_1", "body_2", "body_3"]
    (lost,) = result["given_up"]
    # what is still missing is that one's: a block at most, and more than the defect took
    (truth,) = result["truth"]
    assert truth["missing_mm3"] < result["missing_mm3_after"] < float(np.prod(SIZE_MM))
    x0, _, x1, _ = box_of_beads_mm(job, objects.own([lost]))
    for region in result["regions"]:
        (low, *_), (high, *_) = region["box_mm"]
        assert x0 - 1.0 < low < high < x1 + 1.0
