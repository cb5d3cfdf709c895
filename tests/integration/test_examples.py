"""Every example runs as a user runs it, and what it prints is true."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from gcode.check import find_refusals
from gcode.moves import Program
from gcode.profiles import load_setup

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


CASES: dict[str, Callable[[str, Path], None]] = {
    "01_offline_repair": offline_repair,
    "03_layerwise_loop": layerwise_loop,
    "04_real_printer_over_serial": serial_printer,
    "06_benchmark": benchmark,
    "07_custom_scanner": custom_scanner,
    "08_custom_defect": custom_defect,
}
SLOW = {"03_layerwise_loop", "08_custom_defect"}  # a whole simulated run each


def test_no_example_goes_untested() -> None:
    assert {path.stem for path in EXAMPLES.glob("[0-9]*.py")} == set(CASES)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES],
)
def test_example(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "ignore", EXAMPLES / f"{name}.py", "--out", tmp_path],
        capture_output=True, text=True, timeout=280, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    CASES[name](done.stdout, tmp_path)
