"""Shared by every test: shapes checked at run time, the data folder, deterministic examples."""

from __future__ import annotations

import gc
import importlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import pytest

from tests.emulators import Forked
from tests.workers import pytest_runtestloop  # noqa: F401 - a hook

# Workers share the cores: threads of one that spin for their turn take the other's time. With one
# thread each, loops of kernels are compiled as loops, in a third of the time that it takes to make
# them ready for threads, and are kept apart. Without workers kernels are as users have them.
BY_WORKERS = any(word.startswith("--workers") for word in sys.argv)
if BY_WORKERS:
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(_name, "1")
    _kept = os.environ.get("NUMBA_CACHE_DIR") or Path(__file__).parents[1] / ".pytest_cache"
    os.environ["NUMBA_CACHE_DIR"] = str(Path(_kept, "kernels-without-threads"))

# Of so many tests some compile a kernel.
MANY_TESTS = 500

# a shell that starts the tests in the background has them ignore what some of them send
signal.signal(signal.SIGINT, signal.default_int_handler)
importlib.import_module("gcode.process").prepare()  # as the commands do, before numpy is loaded
importlib.import_module("tests.shapes").install(["amrepair", "gcode"])
if BY_WORKERS:
    _compiled = importlib.import_module("gcode.compiled")
    _njit = _compiled.njit
    _compiled.njit = lambda **options: _njit(**{**options, "parallel": False})

hypothesis.settings.register_profile(
    "suite",
    deadline=None,  # two busy cores: time says nothing about correctness
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("suite")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--regenerate-golden", action="store_true", help="write golden files anew")
    parser.addoption("--workers", type=int, default=1, help="forked processes that run the tests")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of tests that draw several times, the first draw belongs to every run, the others to slow."""
    for item in items:
        drawn = item.callspec.params.get("seed", 0) if hasattr(item, "callspec") else 0
        if isinstance(drawn, int) and drawn > 0:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish(session: pytest.Session) -> None:
    """What is loaded by now stays: to look through it time and again took a twentieth of a run.

    What numba loads and sets up with its first kernel, no forked worker need do again.
    """
    if session.config.getoption("--workers") > 1 and len(session.items) > MANY_TESTS:
        import numba
        import numpy as np

        numba.njit(lambda values: np.sort(values * 2).sum())(np.ones(3))
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _own_state(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Journals, locks and temporary files belong to the test run, not to the user.

    The folder's name is short: browsers put sockets into it, whose paths have at most 107 bytes.
    """
    os.environ["XDG_STATE_HOME"] = str(tmp_path_factory.mktemp("state"))
    folder = tempfile.mkdtemp(prefix="amr-")
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    yield
    tempfile.tempdir = None
    del os.environ["TMPDIR"]
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session", autouse=True)
def _printers_are_forked() -> Iterator[None]:
    """Emulated printers start at once, but where a test has them started as anywhere else."""
    with pytest.MonkeyPatch.context() as patch:
        if hasattr(os, "pidfd_open"):
            forked = SimpleNamespace(**{**vars(subprocess), "Popen": Forked})
            patch.setattr("gcode.firmware.process.subprocess", forked)
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of fetched test data; skips, visibly, where there is none."""
    value = os.environ.get("AMREPAIR_DATA", "")
    if not value:
        pytest.skip("AMREPAIR_DATA is not set: the fetched parts and G-code are not here")
    return Path(value)


@pytest.fixture(scope="session")
def regenerate_golden(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("--regenerate-golden"))
