"""Shared by every test: shapes checked at run time, the data folder, deterministic examples."""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import hypothesis
import pytest

from tests.emulators import Forked

# Workers share the cores: threads of one that spin for their turn take the other's time.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    _share = max(1, (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"]))
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(_name, str(_share))

# a shell that starts the tests in the background has them ignore what some of them send
signal.signal(signal.SIGINT, signal.default_int_handler)
importlib.import_module("gcode.process").prepare()  # as the commands do, before numpy is loaded
importlib.import_module("tests.shapes").install(["amrepair", "gcode"])

hypothesis.settings.register_profile(
    "suite",
    deadline=None,  # two busy cores: time says nothing about correctness
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.load_profile("suite")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--regenerate-golden", action="store_true", help="write golden files anew")


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Load a share of the tests before all are collected.

    pytest rewrites the asserts of a module where no worker has done so and kept it. Workers that
    collect in one order rewrite the same module at the same time, each for itself.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    if worker is None or session.config.args != session.config.getini("testpaths"):
        return
    here, count = Path(__file__).parent, int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    for path in sorted(here.rglob("test_*.py"))[int(worker.removeprefix("gw")) :: count]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # told when collected
            importlib.import_module(".".join(path.relative_to(here.parent).with_suffix("").parts))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of tests that draw several times, the first draw belongs to every run, the others to slow."""
    for item in items:
        drawn = item.callspec.params.get("seed", 0) if hasattr(item, "callspec") else 0
        if isinstance(drawn, int) and drawn > 0:
            item.add_marker(pytest.mark.slow)


def pytest_collection_finish() -> None:
    """What is loaded by now stays: to look through it time and again took a twentieth of a run."""
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
