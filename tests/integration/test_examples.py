"""Every example runs as a user runs it, and what it prints is true."""

from __future__ import annotations

import functools
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

from gcode.check import find_refusals
from gcode.moves import Program
from gcode.profiles import load_setup
from tests.commands import ended

EXAMPLES = Path(__file__).parents[2] / "examples"


def numbers(text: str, pattern: str) -> list[float]:
    found = re.search(pattern, text)
    assert found, f"{pattern!r} is not in what it printed:\n{text}"
    return [float(group) for group in found.groups()]


def offline_repair(text: str, out: Path) -> None:
    broken, measured = numbers(text, r"broken off: ([\d.]+) mm³, measured: ([\d.]+) mm³")
    # the rim of the break is within the tolerance and is given up
    assert measured == pytest.approx(broken, rel=0.12)
    assert "has not been printed" in text
    program = (out / "repair.gcode").read_text()
    assert [line for line in program.splitlines() if line.startswith("G28")] == ["G28 X Y"]
    assert (out / "report.html").stat().st_size > 1e6


def layerwise_loop(text: str, out: Path) -> None:
    assert numbers(text, r"(\d+) % of what was missing is there now")[0] >= 85
    assert len(re.findall(r"^layer-011: .*", text, re.M)) >= 2  # it looked again
    assert (out / "repair-1.gcode").is_file()


def serial_printer(text: str, out: Path) -> None:
    lines, resent = numbers(text, r"(\d+) lines acknowledged, (\d+) resent, ok=True")
    assert lines > 100
    assert resent >= 1  # the garbled line was asked for again
    assert "hotend target 0 °C, bed target 0 °C" in text
    assert {"wire.log", "job.journal"} <= {path.name for path in out.iterdir()}


def benchmark(text: str, out: Path) -> None:
    assert len(re.findall(r"^btf-\w+ .*object AUROC [\d.]+", text, re.M)) == 2
    assert (out / "results" / "results.json").is_file()


def custom_scanner(text: str, out: Path) -> None:
    (broken,) = numbers(text, r"broken off ([\d.]+) mm³")
    (measured,) = numbers(text, r"\n([\d.]+) mm³; a repair was sent: True")
    assert measured == pytest.approx(broken, rel=0.05)
    sent = Program((out / "sent.gcode").read_text(), "prusa")
    # job and repair together are one program that the checker passes
    assert find_refusals(sent, load_setup()) == ()


def custom_defect(text: str, out: Path) -> None:
    assert numbers(text, r"ratio ([\d.]+) in")[0] >= 0.8


def template_from_scans(text: str, out: Path) -> None:
    (off_mm,) = numbers(text, r"4 scans, template off by ([\d.]+) mm on average")
    assert off_mm < 0.03  # the noise of one point
    (found_mm3,) = numbers(text, r"missing, about (\d+) mm³")
    assert found_mm3 == pytest.approx(128, rel=0.4)  # a region's own estimate, not the deficit's
    assert {"template.safetensors", "template.stl"} <= {path.name for path in out.iterdir()}


def octoprint(text: str, out: Path) -> None:
    (size,) = numbers(text, r"ok=True, (\d+) bytes uploaded")
    assert size > 1000
    assert "SECRET" not in (out / "octoprint.log").read_text(errors="replace")


CASES: dict[str, Callable[[str, Path], None]] = {
    "01_offline_repair": offline_repair,
    "02_template_from_scans": template_from_scans,
    "03_layerwise_loop": layerwise_loop,
    "04_real_printer_over_serial": serial_printer,
    "05_octoprint": octoprint,
    "06_benchmark": benchmark,
    "07_custom_scanner": custom_scanner,
    "08_custom_defect": custom_defect,
}
NEEDS = {"02_template_from_scans": "amrepair.merge", "05_octoprint": "gcode.hosts.octoprint"}
SLOW = {
    "01_offline_repair",
    "02_template_from_scans",
    "03_layerwise_loop",
    "04_real_printer_over_serial",
    "06_benchmark",
    "07_custom_scanner",
    "08_custom_defect",
}  # fits, whole runs


@contextmanager
def serving(name: str) -> Iterator[tuple[list[str], dict[str, str]]]:
    """What an example needs beside it: for 05 a server that answers as OctoPrint does."""
    if name != "05_octoprint":
        yield [], {}
        return
    sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))
    try:
        fake_class = import_module("test_hosts_octoprint")
    finally:
        sys.path.pop(0)
    fake = fake_class.FakeOctoPrint()
    with fake.server:
        yield ["--port", f"octoprint+{fake.server.base}"], {"OCTOPRINT_API_KEY": fake_class.KEY}


def test_no_example_goes_untested() -> None:
    assert {path.stem for path in EXAMPLES.glob("[0-9]*.py")} == set(CASES)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES],
)
def test_example(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name in NEEDS and find_spec(NEEDS[name]) is None:
        pytest.skip(f"{NEEDS[name]} is not there yet")
    script = str(EXAMPLES / f"{name}.py")
    monkeypatch.syspath_prepend(EXAMPLES)  # as where it is run by itself
    with serving(name) as (more, environment):
        for key, value in environment.items():
            monkeypatch.setenv(key, value)
        run = functools.partial(runpy.run_path, script, run_name="__main__")
        done = ended([script, "--out", str(tmp_path), *more], run)
    assert done.returncode == 0, done.stderr
    CASES[name](done.stdout, tmp_path)
