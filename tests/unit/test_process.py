"""A command's process keeps the memory that it lets go of, and its workers end with it."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

# Six arrays of twelve megabytes, made and let go together, twice; the faults of the second time.
AGAIN = """
import {first}
import os, resource
import numpy as np
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(6):
        arrays = [np.ones(1_500_000) for _ in range(6)]
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults(), os.environ.get("OPENBLAS_NUM_THREADS"))
"""


def run_again(first: str, **settings: str) -> tuple[int, str]:
    mine = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "OPENBLAS"))}
    told = subprocess.run(
        [sys.executable, "-c", AGAIN.format(first=first)],
        env=mine | settings, capture_output=True, text=True, check=True,
    ).stdout.split()  # fmt: skip
    return int(told[0]), told[1]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library's memory")
def test_memory_is_kept_where_a_command_runs() -> None:
    assert run_again("gcode.cli") == (pytest.approx(0, abs=50), "1")
    assert run_again("amrepair.cli")[0] < 50
    # numpy asks for huge pages: there are few; without them some three thousand an array
    assert run_again("math")[0] > 50


def test_what_the_environment_says_comes_first() -> None:
    faults, threads = run_again(
        "gcode.cli", MALLOC_MMAP_THRESHOLD_="131072", OPENBLAS_NUM_THREADS="2"
    )
    assert faults > 50
    assert threads == "2"


HELD = """
import gcode.cli
from pathlib import Path
import numpy as np
from gcode.process import gives_back
def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 1e6
def task():
    arrays = [np.ones(1_000_000) for _ in range(20)]  # 160 MB, of which the last stays
    task.kept = arrays.pop()
for a_task in (task, gives_back(task)):
    a_task()
    print(resident_mb())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library's memory")
def test_a_long_task_gives_its_memory_back() -> None:
    mine = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_")}
    told = subprocess.run(
        [sys.executable, "-c", HELD], env=mine, capture_output=True, text=True, check=True
    ).stdout.split()
    kept_mb, given_back_mb = (float(word) for word in told)
    assert given_back_mb < kept_mb - 100


WORKING = """
import multiprocessing, sys, time
from gcode.process import end_with_parent
def work(said):
    end_with_parent()
    said.set()
    time.sleep(600)
if __name__ == "__main__":
    spawn = multiprocessing.get_context("spawn")
    said = spawn.Event()
    spawn.Process(target=work, args=(said,)).start()
    said.wait()
    print("working", flush=True)
    time.sleep(600)
"""


def test_a_worker_ends_with_the_process_that_was_killed(tmp_path: Path) -> None:
    # regression: killed, `bench --jobs 2` left two processes that wrote on into its folder
    script = tmp_path / "working.py"
    script.write_text(WORKING)
    mine = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen([sys.executable, script], env=mine, stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"working\n"
        parent.kill()
        # the worker holds the same pipe: its end is seen where both have ended
        parent.communicate(timeout=20)
