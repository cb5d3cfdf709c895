"""A batch killed again and again ends with the rows of an undisturbed one."""

from __future__ import annotations

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from batch_bench import results, sums_files, tables, write_scans, write_template
from link_forks import Forks, until

KILLED = -9


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_template(tmp_path_factory.mktemp("template") / "lug.safetensors")


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks("batch_children") as forks:
        yield forks


def kept(out: Path) -> dict[Path, int]:
    """Results that are there, and when they were written."""
    return {p: p.stat().st_mtime_ns for p in (out / "results").glob("*/[!.]*.json")}


@pytest.mark.slow
def test_killed_thrice_it_ends_with_the_same_rows(
    forks: Forks, template: Path, tmp_path: Path
) -> None:
    scans = write_scans(tmp_path / "scans", 30, points=1_500)
    words = {"scans": str(scans), "template": str(template)}
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    assert forks.wait(forks.start("batch", out=str(calm), **words)) == 0
    before: dict[Path, int] = {}
    for least in (5, 14, 23):
        child = forks.start("batch", out=str(rough), **words)
        until(lambda: len(kept(rough)) >= least)  # noqa: B023
        assert forks.kill(child) == KILLED
        now = kept(rough)
        assert len(now) < 30
        assert {p: now[p] for p in before} == before
        before = now
    assert forks.wait(forks.start("batch", out=str(rough), **words)) == 0
    assert (rough / "told").read_text() == f"{30 - len(before)} {len(before)}"
    assert {p: kept(rough)[p] for p in before} == before
    assert tables(rough) == tables(calm)
    assert results(rough) == results(calm)
    assert sums_files(rough) == sums_files(calm)
    assert lines_of(rough / "table.csv") == 31


def lines_of(table: Path) -> int:
    return len(list(csv.reader(table.read_text().splitlines())))


MANY = 1_000
FLAT_MB = 40.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_thousand_scans_killed_three_times(template: Path, tmp_path: Path) -> None:
    """The supervisor, a worker, and a worker of Ray's where that is installed."""
    scans = write_scans(tmp_path / "scans", MANY)
    calm, rough = tmp_path / "calm", tmp_path / "rough"
    began_s = time.monotonic()
    assert start(scans, template, calm, "process").wait() == 0
    print(f"undisturbed: {MANY} scans in {time.monotonic() - began_s:.0f} s")
    tell_memory(calm)

    supervisor = start(scans, template, rough, "process")
    patient(lambda: len(kept(rough)) >= MANY // 4, supervisor)
    workers = children_of(supervisor.pid, b"spawn_main")
    supervisor.kill()
    supervisor.wait()
    first = kept(rough)
    patient(lambda: not any(Path(f"/proc/{one}").exists() for one in workers))
    assert kept(rough) == first  # orphans write nothing

    again = start(scans, template, rough, "process")
    patient(lambda: len(kept(rough)) >= MANY // 2, again)
    os.kill(children_of(again.pid, b"spawn_main")[0], signal.SIGKILL)
    patient(lambda: len(kept(rough)) >= 3 * MANY // 4, again)
    again.kill()  # it had got over the worker's end
    again.wait()

    crew = "ray" if importlib.util.find_spec("ray") else "process"
    last = start(scans, template, rough, crew)
    patient(lambda: len(kept(rough)) >= 7 * MANY // 8, last)
    workers = children_of(last.pid, b"ray::_Holder" if crew == "ray" else b"spawn_main")
    os.kill(workers[0], signal.SIGKILL)
    assert last.wait() == 0
    print(f"the last kill was of a worker of {crew}'s")
    assert {p: kept(rough)[p] for p in first} == first
    assert tables(rough) == tables(calm)
    assert results(rough) == results(calm)
    assert sums_files(rough) == sums_files(calm)
    assert lines_of(rough / "table.csv") == 1 + MANY


def start(scans: Path, template: Path, out: Path, crew: str) -> subprocess.Popen[bytes]:
    words = ["batch", "detect", str(scans), "--template", str(template), "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", "amrepair", *words, "--executor", crew,
         "--workers", "2"],
        stdout=subprocess.DEVNULL, cwd=Path(__file__).parents[2],
    )  # fmt: skip


def patient(true: Callable[[], object], process: subprocess.Popen[bytes] | None = None) -> None:
    end_s = time.monotonic() + 900.0
    while not true():
        assert process is None or process.poll() is None, "it ended by itself"
        assert time.monotonic() < end_s, "it never happened"
        time.sleep(0.05)


def children_of(parent: int, named: bytes) -> list[int]:
    """Processes below one, however far, whose command line has a word."""
    parent_of, words_of = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words_of[int(entry.name)] = (entry / "cmdline").read_bytes()
                stat = (entry / "stat").read_text()
            except OSError:
                continue
            parent_of[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    found = []
    for pid, words in words_of.items():
        above = pid
        while above in parent_of and above != parent:
            above = parent_of[above]
        if above == parent and pid != parent and named in words:
            found.append(pid)
    return found


def tell_memory(out: Path) -> None:
    """Workers' largest memory does not grow with what they have done."""
    costs = [
        (path.stat().st_mtime_ns, json.loads(path.read_text())["cost"]["peak_mb"])
        for path in (out / "results").glob("*/*.json")
    ]
    peaks = [peak for _, peak in sorted(costs)]
    early, late = max(peaks[: len(peaks) // 5]), max(peaks)
    print(f"largest worker: {early:.0f} MB after a fifth of the scans, {late:.0f} MB at the end")
    assert late < early + FLAT_MB
