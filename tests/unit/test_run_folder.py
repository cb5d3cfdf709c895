"""A run's folder that is none, or is damaged, is one sentence."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import trimesh

from amrepair.errors import AmrepairError, InputError
from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.run_folder import Setting, keep, open_run
from amrepair.template import MeshSdf
from gcode.errors import GcodeError
from gcode.profiles import DEFAULT_PROCESS, load_setup
from gcode.reader import job_for

JOB = """G28
M190 S60
M109 S200
G21
G90
M83
G1 Z0.2 F600
G1 X50 Y50 F3000
G1 X70 Y50 E1
G1 Z0.4
G1 X50 Y70 E1
M104 S0
M140 S0
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ids = ("prusa_mk3s", "pla", DEFAULT_PROCESS)
    setup = load_setup(*ids)
    here = Transform.identity("build", "template")
    setting = Setting.of(
        setup, ids, stops=plan_stops(job_for(JOB, setup.printer), [1]), build_from_template=here,
        build_from_scanner=Transform.identity("build", "scanner"), by_beads=True, seed=0,
    )  # fmt: skip
    keep(tmp_path, setting, JOB, MeshSdf.from_mesh(trimesh.creation.box((10, 10, 10))))
    open_run(tmp_path)
    return tmp_path


def test_a_folder_without_a_run_says_what_is_not_there(tmp_path: Path) -> None:
    """Regression: it said '[Errno 2] No such file or directory'."""
    with pytest.raises(InputError, match=r"it has no run\.json: no run was begun there") as empty:
        open_run(tmp_path)
    with pytest.raises(InputError, match="there is no such folder") as none:
        open_run(tmp_path / "nowhere")
    assert "Errno" not in f"{empty.value}{none.value}"


@pytest.mark.parametrize("name", ["job.gcode", "template.npz"])
def test_a_half_made_run_is_one_sentence(folder: Path, name: str) -> None:
    path = folder / name
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2):
        path.write_bytes(whole[:size])
        with pytest.raises((AmrepairError, GcodeError)) as cut:
            open_run(folder).judged()
        assert "Errno" not in str(cut.value)
    path.unlink()
    with pytest.raises(AmrepairError, match=r"no job\.gcode|does not exist"):
        open_run(folder)


def test_a_setting_that_means_nothing_is_one_sentence(folder: Path) -> None:
    good = json.loads((folder / "run.json").read_text())
    wrong: list[Any] = [None, "x", {}, 3, [[1, 2], [3]]]
    for key in good:
        for value in wrong:
            (folder / "run.json").write_text(json.dumps({**good, key: value}))
            with suppress(AmrepairError, GcodeError):
                open_run(folder)
