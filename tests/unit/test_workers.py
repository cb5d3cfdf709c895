"""The suite's own workers: what they run is reported as if one process had run it."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONFTEST = """
from tests.workers import pytest_runtestloop

def pytest_addoption(parser):
    parser.addoption("--workers", type=int, default=1)
"""
SOME = """
import os, time
import pytest

@pytest.fixture(scope="module")
def made():
    yield "made"
    with open("ended", "a") as file:
        file.write("one ended\\n")

def test_passes(made, capsys):
    print("heard")
    assert capsys.readouterr().out == "heard\\n"

def test_fails(made):
    print("said")
    assert made == "other"

@pytest.mark.skip(reason="of no use")
def test_is_skipped(): ...

@pytest.fixture
def breaks_at_the_end():
    yield
    raise ValueError("at the end")

def test_errs(breaks_at_the_end): ...

def test_leaves_a_process():
    if os.fork() == 0:
        time.sleep(9)
        os._exit(0)
"""
OTHERS = """
import os
import pytest

def test_kills_its_worker():
    os.kill(os.getpid(), 9)

@pytest.mark.parametrize("name", ["a::b", "c"])
def test_after_it(name): ...
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """What pytest says of these tests, run by two workers, and the folder where."""
    folder = tmp_path_factory.mktemp("some tests")
    for name, text in (("conftest", CONFTEST), ("test_some", SOME), ("test_others", OTHERS)):
        (folder / f"{name}.py").write_text(text)
    plugins = [
        word
        for name in ("dash", "jaxtyping", "hypothesispytest", "anyio", "cacheprovider")
        for word in ("-p", f"no:{name}")
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-ra", "--workers", "2", *plugins],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 1, done.stdout + done.stderr
    return done.stdout, folder


def test_each_test_is_told_once(told: tuple[str, Path]) -> None:
    assert "2 failed, 5 passed, 1 skipped, 1 error in" in told[0]


def test_a_failure_has_its_reason_and_what_it_printed(told: tuple[str, Path]) -> None:
    for said in ("assert 'made' == 'other'", "said", "of no use", "ValueError: at the end"):
        assert said in told[0]


def test_a_worker_that_dies_fails_its_test_and_others_run_the_rest(told: tuple[str, Path]) -> None:
    assert "test_others.py::test_kills_its_worker ended with -9" in told[0]


def test_what_tests_of_a_module_share_is_made_and_ended_once(told: tuple[str, Path]) -> None:
    assert (told[1] / "ended").read_text() == "one ended\n"
