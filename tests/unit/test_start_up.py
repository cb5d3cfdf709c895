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


RUN = """
import importlib
for words in {calls}:
    sys.argv = words.split()
    try:
        importlib.import_module(sys.argv[0] + ".cli").main()
    except SystemExit as end:
        assert not end.code, (words, end.code)
"""


def loaded_by(*calls: str, folder: Path) -> set[str]:
    """The heavy libraries that commands, one after another, have loaded when they end."""
    (folder / "job.gcode").write_text(PROGRAM)
    code = SHOW + RUN.format(calls=calls)
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False,
        cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {name.split(".")[0] for name in done.stderr.splitlines()[-1].split()} & HEAVY


def test_help_loads_no_library_that_computes(tmp_path: Path) -> None:
    gcode = ("gcode --version", "gcode check --help")
    largest = ("amrepair --help", "amrepair simulate --help", "amrepair template fit --help")
    assert loaded_by(*gcode, *largest, folder=tmp_path) == set()


@pytest.mark.parametrize("program", ["amrepair", "gcode"])
def test_a_command_runs_as_a_module_too(program: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", program, "--version"],
        capture_output=True, text=True, timeout=120, check=False, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(program)


def test_profiles_are_shown_without_what_prints(tmp_path: Path) -> None:
    both = ("gcode profiles list", "gcode profiles show prusa_mk3s")
    assert loaded_by(*both, folder=tmp_path) == set()


def test_a_check_loads_nothing_that_scans_meshes_or_sends(tmp_path: Path) -> None:
    # numba brings numpy and a part of scipy; tifffile reads height maps
    needed = {"jaxtyping", "numba", "numpy", "scipy", "tifffile"}
    assert loaded_by("gcode check job.gcode", folder=tmp_path) <= needed


@pytest.mark.slow
def test_sending_over_a_cable_loads_nothing_of_the_web(tmp_path: Path) -> None:
    loaded = loaded_by("gcode send job.gcode --port file:out.gcode", folder=tmp_path)
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
