"""Shared detection: the bits of this process's own, and this process where the others fail."""

from __future__ import annotations

import os
import pickle
import pty
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import fleet_judges
import numpy as np
import pytest
import trimesh
from loop_bench import LAYER, Small, scan_of
from scipy.spatial import cKDTree

from amrepair.fleet import judges as fleet_judging
from amrepair.fleet import shared
from amrepair.fleet.desk import JUDGES, STATUS, Desk, read_note, write_note
from amrepair.fleet.judges import Judges
from amrepair.fleet.shared import BY_ITSELF, SharedDetection, mark, received, sent
from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.sites import sites
from amrepair.regions import AnomalyMap, detect
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.scans import Scan
from gcode.compiled import get_num_threads, set_num_threads
from tests.draws import draws

LONG_S = 200.0


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """As the supervisor starts a printer's process."""
    before = get_num_threads()
    set_num_threads(1)
    yield
    set_num_threads(before)


def hired(within_s: float = LONG_S, restarts: int = 3) -> Judges:
    """One that need not stand back: the tests' other processes have no end."""
    return Judges(
        1, asking=4, within_s=within_s, restarts=restarts, restarts_within_s=3600.0, nice=0
    )  # fmt: skip


@pytest.fixture(scope="module")
def judges() -> Iterator[Judges]:
    found = hired()
    yield found
    found.close()


@dataclass
class Asking:
    """A desk, what it asks with, and what it was told of each scan."""

    desk: Path
    why: list[str]

    @property
    def detector(self) -> SharedDetection:
        return SharedDetection(self.desk, self.why.append)

    def note(self, address: Path, within_s: float) -> None:
        write_note(self.desk / JUDGES, {"address": str(address), "within_s": within_s})


@pytest.fixture
def asking(tmp_path: Path) -> Asking:
    return Asking(tmp_path, [])


# ---- the same bits -------------------------------------------------------------------------------


def assert_same(one: Any, other: Any, where: str = "anomaly") -> None:
    """Every number of both, to the last bit."""
    assert type(one) is type(other), where
    if is_dataclass(one):
        for each in fields(one):
            name = each.name
            assert_same(getattr(one, name), getattr(other, name), f"{where}.{name}")
    elif isinstance(one, tuple | list):
        assert len(one) == len(other), where
        for k, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_same(a, b, f"{where}[{k}]")
    elif isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape), where
        assert one.tobytes() == other.tobytes(), where
    elif isinstance(one, float | np.floating):
        assert np.float64(one).tobytes() == np.float64(other).tobytes(), where
    elif isinstance(one, cKDTree):
        assert_same(np.asarray(one.data), np.asarray(other.data), where)
        assert_same(np.asarray(one.indices), np.asarray(other.indices), where)
    elif isinstance(one, trimesh.Trimesh):
        assert_same(np.asarray(one.vertices), np.asarray(other.vertices), where)
    else:
        assert one == other, where


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made()


def plan_of(scan: Scan, site: Site, small: Small) -> RepairPlan:
    guess = Transform("template", "scanner", small.placed.inverse().matrix)
    return plan_repair(scan, site, title="t", guess=guess, strict=False)


@pytest.mark.parametrize("stop", draws(["a layer", "the whole part"], "a layer"))
def test_shared_processes_come_to_the_same_bits(
    judges: Judges, asking: Asking, small: Small, stop: str
) -> None:
    """Planned beads with what the job told, and a template of its own; down to the program."""
    write_note(asking.desk / JUDGES, judges.note)
    layer, last = plan_stops(small.job, [LAYER])
    at = sites(small.job, small.template, small.placed, small.setup)
    site = at(layer if stop == "a layer" else last)
    standing = small.standing if stop == "a layer" else small.part.translate((100.0, 90.0, 0.0))
    scan = scan_of(standing - small.block(-0.6, 2.0))
    here = plan_of(scan, site, small)
    there = plan_of(scan, replace(site, detector=asking.detector), small)
    assert asking.why == [""]
    assert any(region.volume_mm3 > 10.0 for region in here.deficit.regions)
    assert_same(here.anomaly, there.anomaly)
    assert_same(here.deficit.regions, there.deficit.regions)
    assert here.checked is not None
    assert there.checked is not None
    assert here.checked.program.text == there.checked.program.text


def test_a_scan_that_cannot_be_judged_says_so_as_ever(
    judges: Judges, asking: Asking, small: Small
) -> None:
    """What is wrong with a scan is found there, and again here, where it is said."""
    write_note(asking.desk / JUDGES, judges.note)
    scan = replace(scan_of(small.part), frame="scanner")  # not the template's
    with pytest.raises(Exception) as own:  # noqa: PT011  whichever it is
        detect(scan, small.template)
    with pytest.raises(type(own.value), match="frame"):
        asking.detector(scan, small.template)
    assert asking.why == [f"it could not judge the scan ({type(own.value).__name__})"]


def test_they_hold_nothing_of_the_supervisors() -> None:
    """No port: what this process has open, a spawned one has not."""
    master, slave = pty.openpty()
    other = hired()
    try:
        (worker,) = other.processes
        deadline_s = time.monotonic() + LONG_S
        while b"spawn_main" not in Path(f"/proc/{worker}/cmdline").read_bytes():
            assert time.monotonic() < deadline_s
        held = [str(one.readlink()) for one in Path(f"/proc/{worker}/fd").iterdir()]
        assert any(one.startswith("socket:") for one in held)
        assert os.ttyname(slave) not in held
        assert not [one for one in held if "ptmx" in one]
    finally:
        other.close()
        os.close(master)
        os.close(slave)


# ---- late, dead, full, another -------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(small: Small) -> AnomalyMap:
    return detect(replace(scan_of(small.part), frame="template"), small.template)


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch, found: AnomalyMap) -> AnomalyMap:
    """What this process comes to: enough that it is this one."""
    monkeypatch.setattr(shared, "detect", lambda *_, **__: found)
    return found


Answer = Callable[[socket.socket, bytes], object]


def hello(pipe: socket.socket, own: bytes) -> None:
    sent(pipe, own, lambda: LONG_S)


def asked(pipe: socket.socket, own: bytes) -> None:
    hello(pipe, own)
    received(pipe, lambda: LONG_S)


def half(pipe: socket.socket, own: bytes) -> None:
    asked(pipe, own)
    pipe.sendall(b"\0\0\0\0\0\0\1\0" + b"half")


def junk(pipe: socket.socket, own: bytes) -> None:
    asked(pipe, own)
    sent(pipe, b"no pickle", lambda: LONG_S)


def other(pipe: socket.socket, own: bytes) -> None:
    asked(pipe, own)
    sent(pipe, pickle.dumps("it has had enough"), lambda: LONG_S)


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda pipe, own: None, "EOFError: the other side has gone"),  # it died before a word
        (asked, "EOFError: the other side has gone"),  # it died with the scan
        (half, "EOFError: the other side has gone"),  # it died with the answer
        (junk, "UnpicklingError"),
        (other, "it has had enough"),
        (lambda pipe, own: hello(pipe, own[::-1]), "another program or other threads"),
    ],
    ids=["dead", "dies with the scan", "dies with the answer", "junk", "refuses", "another"],
)
def test_whatever_goes_wrong_it_is_done_here(
    asking: Asking, own: AnomalyMap, small: Small, answer: Answer, why: str
) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(asking.desk / "ask"))
        listener.listen(1)
        asking.note(asking.desk / "ask", LONG_S)
        mine = mark()  # a thread of its own has others

        def serve() -> None:
            pipe, _ = listener.accept()
            with pipe:
                answer(pipe, mine)

        worker = threading.Thread(target=serve)
        worker.start()
        assert asking.detector(scan_of(small.part), small.template) is own
        worker.join()
    assert why in asking.why[0]


def test_late_full_and_nobody_there(asking: Asking, own: AnomalyMap, small: Small) -> None:
    scan, address = scan_of(small.part), asking.desk / "ask"
    assert asking.detector(scan, small.template) is own
    assert asking.why == [BY_ITSELF]
    asking.note(address, LONG_S)
    assert asking.detector(scan, small.template) is own
    assert "No such file" in asking.why[-1]
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(address))
        listener.listen(0)
        asking.note(address, 0.2)  # nobody takes it
        began_s = time.monotonic()
        assert asking.detector(scan, small.template) is own
        assert asking.why[-1] == "no answer within 0.2 s"
        waiting = [socket.socket(socket.AF_UNIX) for _ in range(3)]
        for one in waiting:
            one.setblocking(False)
            one.connect_ex(str(address))
        assert asking.detector(scan, small.template) is own  # no room to wait in
        assert time.monotonic() - began_s < 0.5 * LONG_S
        for one in waiting:
            one.close()
    assert len(asking.why) == 4
    assert asking.detector(scan, small.template) is own
    assert "ConnectionRefusedError" in asking.why[-1]


def test_one_that_hangs_ends_and_is_replaced(asking: Asking, own: AnomalyMap, small: Small) -> None:
    judges = hired(within_s=1.0)
    try:
        write_note(asking.desk / JUDGES, judges.note | {"within_s": LONG_S})
        before = judges.processes
        scan = replace(scan_of(small.part), frame="template")
        assert asking.detector(scan, small.template, off_by_job=fleet_judges.hang) is own
        assert "EOFError" in asking.why[0]  # by the alarm, and not by the limit of who asked
        deadline_s = time.monotonic() + LONG_S
        while judges.processes == before:
            assert time.monotonic() < deadline_s
            assert judges.step(0.0) == ""
        assert len(judges.processes) == 1
    finally:
        judges.close()


def test_they_are_replaced_so_often_and_no_more(
    asking: Asking, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_judging, "serve", fleet_judges.idle)
    judges = Judges(2, asking=1, within_s=1.0, restarts=2, restarts_within_s=100.0)
    said = [killed_and_stepped(judges, now_s) for now_s in (0.0, 10.0, 105.0)]
    assert said == ["", "", ""]  # the first is long ago by then
    assert len(judges.processes) == 2
    said.append(killed_and_stepped(judges, 106.0))
    assert "ended 3 times in 100 s (the last with code -9)" in said[3]
    assert judges.processes == ()
    assert not Path(str(judges.note["address"])).exists()
    assert judges.step(107.0) == ""
    judges.close()


def killed_and_stepped(judges: Judges, now_s: float) -> str:
    """What is said when one of them has died."""
    killed = judges.processes[0]
    os.kill(killed, signal.SIGKILL)
    said = ""
    while killed in judges.processes and not said:
        said = judges.step(now_s)
    return said


@pytest.mark.slow
def test_a_desk_counts_who_judged(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    for why in ("", "", "it was late"):
        desk.judged(why)
    note = read_note(tmp_path / STATUS)
    assert note is not None
    assert note["judged"] == {"shared": 2, "itself": 1, "why": "it was late"}
