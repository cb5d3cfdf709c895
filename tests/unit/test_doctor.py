"""The doctor: each thing that can be wrong is told, with how to mend it, and nothing raises."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from amrepair import doctor
from amrepair.cli.app import app
from amrepair.doctor import CheckFinding, SerialPort, State
from amrepair.doctor.options import tunables
from amrepair.errors import MissingDependencyError
from amrepair.policy import PolicyOptions
from gcode.profiles import profile_dir
from tests.commands import here

ROOT = Path(__file__).parents[2]


def test_an_old_python_is_bad() -> None:
    found = doctor.check_python((3, 10, 4))
    assert found.state is State.BAD
    assert "3.11" in found.mend
    assert doctor.check_python((3, 11, 0)).state is State.OK


def test_a_missing_library_is_named() -> None:
    found = doctor.check_libraries(["numpy>=2.0", "no-such-library[x]>=1; python_version>'3'"])
    assert found.state is State.BAD
    assert "missing: no-such-library" in found.found
    assert "numpy" not in found.found
    assert found.mend
    assert doctor.check_libraries(["numpy>=2", "nonsense; extra == 'dev'"]).state is State.OK


def test_open3d_without_its_system_library_says_what_to_install() -> None:
    def load() -> object:
        raise MissingDependencyError("open3d cannot be loaded (libusb-1.0.so.0)")

    found = doctor.check_open3d(load)
    assert found.state is State.BAD
    assert "libusb" in found.found
    assert "apt-get install" in found.mend


@pytest.mark.parametrize(
    ("ports", "may", "state", "said"),
    [
        ([], True, State.NOTE, "plug"),
        ([SerialPort("/dev/ttyACM0", "Original Prusa")], True, State.OK, ""),
        ([SerialPort("/dev/ttyACM0")], False, State.BAD, "usermod -aG dialout"),
    ],
)
def test_serial_ports(ports: list[SerialPort], may: bool, state: State, said: str) -> None:
    found = doctor.check_serial_ports(ports, access=lambda path, mode: may)
    assert found.state is state
    assert said in found.mend
    assert all(port.device in found.found for port in ports)


def test_one_closed_port_of_two_is_told() -> None:
    ports = [SerialPort("/dev/ttyACM0"), SerialPort("/dev/ttyUSB0")]
    found = doctor.check_serial_ports(ports, access=lambda path, mode: "ACM" in path)
    assert found.state is State.BAD
    assert found.found.endswith("no permission to open /dev/ttyUSB0")


def test_a_broken_profile_is_found(tmp_path: Path) -> None:
    shutil.copytree(profile_dir(), tmp_path / "profiles")
    assert doctor.check_profiles(tmp_path / "profiles").state is State.OK
    bad = tmp_path / "profiles" / "materials" / "pla.toml"
    bad.write_text(bad.read_text() + "\nnonsense_mm = 3\n")
    found = doctor.check_profiles(tmp_path / "profiles")
    assert found.state is State.BAD
    assert "nonsense_mm" in found.found
    assert doctor.check_profiles(tmp_path).state is State.BAD  # none at all


@pytest.mark.parametrize(
    ("free_mb", "state"), [(50.0, State.BAD), (500.0, State.NOTE), (5000.0, State.OK)]
)
def test_disk(tmp_path: Path, free_mb: float, state: State) -> None:
    found = doctor.check_disk(tmp_path, lambda folder: free_mb)
    assert found.state is state
    assert bool(found.mend) == (state is not State.OK)


def test_a_cache_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    found = doctor.check_cache(tmp_path / "file" / "templates")
    assert found.state is State.BAD
    assert "XDG_CACHE_HOME" in found.mend
    good = doctor.check_cache(tmp_path / "templates")
    assert good.state is State.OK
    assert list((tmp_path / "templates").iterdir()) == []


def test_a_check_that_fails_itself_is_a_finding(monkeypatch: pytest.MonkeyPatch) -> None:
    def fall() -> CheckFinding:
        raise RuntimeError("what nobody thought of")

    for name in dir(doctor):
        if name.startswith("check_"):
            monkeypatch.setattr(doctor, name, fall)
    found = doctor.examine()
    assert len(found) == 9
    assert all(f.state is State.BAD and "nobody thought of" in f.found for f in found)


@pytest.mark.parametrize("healthy", [True, False])
def test_the_command(monkeypatch: pytest.MonkeyPatch, healthy: bool) -> None:
    findings = (
        CheckFinding("python", State.OK, "3.11.7"),
        CheckFinding("cache", State.NOTE if healthy else State.BAD, "[bold]read-only", "chmod it"),
    )
    monkeypatch.setattr("amrepair.cli.health.examine", lambda progress: findings)
    shown = CliRunner().invoke(app, ["doctor"])
    assert shown.exit_code == (0 if healthy else 2)
    assert "[bold]read-only" in shown.stdout  # text, not markup
    assert "→ chmod it" in shown.stdout
    told = CliRunner().invoke(app, ["doctor", "--json"])
    assert told.exit_code == (0 if healthy else 2)
    result = json.loads(told.stdout)
    assert result["ok"] is healthy
    assert [check["mend"] for check in result["checks"]] == [None, "chmod it"]


def test_this_machine() -> None:
    done = here("doctor", "--json")
    result = json.loads(done.stdout)
    assert done.returncode == (0 if result["ok"] else 2), done.stderr
    states = {check["name"]: check["state"] for check in result["checks"]}
    # what the suite itself stands on is there
    assert {states[name] for name in ("python", "libraries", "torch", "open3d", "profiles")} == {
        "ok"
    }


def test_without_its_libraries_the_program_still_says_what_is_missing() -> None:
    code = (
        "import sys; sys.modules.update(numpy=None, open3d=None, torch=None)\n"
        "from amrepair.cli import main; main()"
    )  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, "simulate"],
        capture_output=True, text=True, timeout=120, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "libraries: " in done.stderr
    assert "pip install" in done.stderr


def test_every_number_that_can_be_set_is_told_with_its_reason() -> None:
    found = tunables()
    assert {one.options.rpartition(".")[2] for one in found} >= {
        "PolicyOptions", "RepairOptions", "RegionOptions", "OccupancyOptions", "TouchOptions",
    }  # fmt: skip
    assert [f"{one.options}.{one.name}" for one in found if not one.reason] == []
    (least,) = (one for one in found if one.name == "least_mm3")
    assert (least.value, least.unit) == (PolicyOptions().least_mm3, "mm³")
    assert "a bead 11 mm long" in least.reason


def test_the_command_tells_them_without_a_check(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amrepair.cli.health.examine", lambda tell: pytest.fail("it checked"))
    done = CliRunner().invoke(app, ["doctor", "--options", "--json"])
    assert done.exit_code == 0, done.output
    assert {one["name"] for one in json.loads(done.stdout)["options"]} >= {"false_regions", "sure"}
