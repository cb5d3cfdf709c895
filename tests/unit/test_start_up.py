"""A command loads what it needs and nothing else: help answers at once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gcode.firmware import EmulatedPrinterProcess
from gcode.profiles import load_printer

ROOT = Path(__file__).parents[2]
# Not pydantic, which typer itself loads where it is installed.
HEAVY = frozenset(
    (
        *("torch", "open3d", "numba", "scipy", "numpy", "trimesh", "httpx", "viser"),
        *("websockets", "skimage", "shapely", "manifold3d", "plotly", "lxml", "serial", "networkx"),
        *("tifffile", "jaxtyping", "beartype", "safetensors", "sqlite3"),
    )
)
PROGRAM = "G28\nG90\nM83\nM104 S200\nM109 S200\nG1 X10 Y10 Z0.2 F3000\nG1 X20 E0.5\nM104 S0\n"
SHOW = "import atexit, sys; atexit.register(lambda: print('', *sys.modules, file=sys.stderr))"


def loaded_by(words: str, folder: Path) -> set[str]:
    """The heavy libraries that a command has loaded when it ends."""
    (folder / "job.gcode").write_text(PROGRAM)
    program, *arguments = words.split()
    code = f"{SHOW}\nsys.argv = {[program, *arguments]}\nfrom {program}.cli import main\nmain()"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False,
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stderr.splitlines()[-1].split()} & HEAVY


@pytest.mark.parametrize("words", ["amrepair --help", "gcode check --help", "gcode --version"])
def test_help_loads_no_library_that_computes(words: str, tmp_path: Path) -> None:
    assert loaded_by(words, tmp_path) == set()


@pytest.mark.parametrize("words", ["amrepair simulate --help", "amrepair template fit --help"])
def test_help_of_the_largest_commands_loads_none_either(words: str, tmp_path: Path) -> None:
    assert loaded_by(words, tmp_path) == set()


@pytest.mark.parametrize("program", ["amrepair", "gcode"])
def test_a_command_runs_as_a_module_too(program: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", program, "--version"],
        capture_output=True, text=True, timeout=120, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(program)


def test_profiles_are_shown_without_what_prints(tmp_path: Path) -> None:
    assert loaded_by("gcode profiles list", tmp_path) == set()
    assert loaded_by("gcode profiles show prusa_mk3s", tmp_path) == set()


def test_a_check_loads_nothing_that_scans_meshes_or_sends(tmp_path: Path) -> None:
    # numba brings numpy and a part of scipy; tifffile reads height maps
    needed = {"jaxtyping", "numba", "numpy", "scipy", "tifffile"}
    assert loaded_by("gcode check job.gcode", tmp_path) <= needed


def test_sending_over_a_cable_loads_nothing_of_the_web(tmp_path: Path) -> None:
    loaded = loaded_by("gcode send job.gcode --port file:out.gcode", tmp_path)
    assert not loaded & {"httpx", "websockets", "trimesh", "torch", "open3d", "shapely"}


def test_an_emulated_printer_loads_no_kernels() -> None:
    # regression: of 0.6 s that each one took to start, 0.3 s loaded heights that few printers feel
    code = "import sys, gcode.firmware.child; assert not {'numba', 'scipy'} & sys.modules.keys()"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_an_emulated_printer_is_started_as_it_is_outside_the_tests(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where they are forked from a warm process (tests/emulators.py), this one is not."""
    monkeypatch.setattr("gcode.firmware.process.subprocess", subprocess)
    with EmulatedPrinterProcess(printer=load_printer("generic_marlin")) as machine:
        assert machine.state()["hotend_target_c"] == 0
        assert "gcode.firmware.child" in Path(f"/proc/{machine.pid}/cmdline").read_text()


def test_compiled_kernels_do_not_load_what_multiplies_matrices() -> None:
    # regression: numba loaded scipy.linalg with its first kernel, 0.15 s and 15 MB for nothing
    code = (
        "import sys, numpy; from gcode.meshes_kernels import paired;"
        "paired(numpy.array([[0, 1, 2], [0, 2, 1]], numpy.int32));"
        "print('scipy.linalg' in sys.modules, 'numba.np.arraymath' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False,
        cwd=ROOT,
    )  # fmt: skip
    assert done.stdout.split() == ["False", "True"], done.stderr
