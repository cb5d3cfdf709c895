"""Replay: the same scans lead to the same decisions, and a difference is said."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from loop_bench import LAYER, Small, scan_of

from amrepair.errors import InputError
from amrepair.frames import Transform
from amrepair.loop import Tape, plan_stops
from amrepair.loop.replay import decide_again, replay
from amrepair.loop.run_folder import Setting, keep
from amrepair.report.folder import RunFolder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with a pocket that was filled, and a scan afterwards."""
    folder = tmp_path_factory.mktemp("run")
    small = Small.made()
    setting = Setting.of(
        small.setup, ("prusa_mk3s", "pla", "repair_0.20"),
        stops=plan_stops(small.job, [LAYER], final=False), build_from_template=small.placed,
        build_from_scanner=Transform.identity("build", "scanner"), by_beads=False, seed=0,
    )  # fmt: skip
    keep(folder, setting, small.job.program.text, small.template)
    pocket = small.block(-0.6, 0.5)
    small.run(
        folder,
        lambda n: scan_of(small.standing - pocket if n == 1 else small.standing),
        tape=Tape(folder),
        look=RunFolder(folder).record,
    )
    return folder


def test_the_same_scans_lead_to_the_same_decisions(recorded: Path) -> None:
    before = (recorded / "run.jsonl").read_bytes()
    looks = replay(recorded)
    assert [(look.then["action"], look.differences) for look in looks] == [
        ("fill now", ()), ("go on", ()),
    ]  # fmt: skip
    assert (recorded / "run.jsonl").read_bytes() == before


def test_what_is_decided_differently_is_said(recorded: Path, tmp_path: Path) -> None:
    for path in recorded.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    # the first scan's defect was repaired when it was looked at: nothing is found there now
    (tmp_path / "scan-1.ply").write_bytes((recorded / "scan-2.ply").read_bytes())
    first, second = replay(tmp_path)
    assert "decided 'fill now' by S9 then, 'go on' by S12 now" in first.differences
    assert any("mm³ missing then, 0.00 mm³ now" in text for text in first.differences)
    assert second.stop == f"layer-{LAYER:03d}"
    said = json.loads((tmp_path / "run.json").read_text())
    assert said["layers"] == [LAYER]


def test_facts_alone_lead_to_the_same_decisions_and_to_others_by_other_rules(
    recorded: Path, tmp_path: Path
) -> None:
    for name in ("run.json", "run.jsonl", "job.gcode", "template.npz"):
        (tmp_path / name).write_bytes((recorded / name).read_bytes())  # and no scan
    assert [look.differences for look in decide_again(tmp_path)] == [(), ()]
    first, second = decide_again(tmp_path, ["least_mm3=1000"])
    assert "decided 'fill now' by S9 then, 'go on' by S12 now" in first.differences
    assert not second.differences
    for rule, said in (
        ("least=2", "there is no rule 'least'"), ("sure=high", "has no number"),
        ("sure=nan", "has no number"),  # regression: nothing was sure any more
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            decide_again(tmp_path, [rule])
