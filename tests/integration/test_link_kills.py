"""Kills at random moments, of sender and printer in turn: nothing twice, no journal corrupted."""

from __future__ import annotations

import random
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_bench import HEAD, Bench, is_whole
from link_forks import Forks

from gcode.hosts.journal import Journal

LINES = 2500
STATED_S = 5.0
"""Within this time of a sender's death its supervisor has told the heaters to switch off."""
_HEAT = re.compile(r"^M1(?:04|09|40|90) S(\d+)$", re.MULTILINE)


@pytest.fixture(scope="module")
def forks() -> Iterator[Forks]:
    with Forks() as forks:
        yield forks


class Gallows:
    """One bench, many deaths; `seen` counts what came of them.

    Kills come up to `job_s` after the start, from before the hello to about the last line: what
    the last job took that nobody killed, on this machine and under what else it did then.
    """

    began_s: float | None

    def __init__(self, forks: Forks, folder: Path, seed: int) -> None:
        self.bench = Bench(forks, folder, lines=LINES, slow=False)
        self.forks, self.rng, self.seen = forks, random.Random(seed), Counter[str]()
        self.job_s = 0.0
        assert forks.wait(self.start()) == 0
        self.next_job(ended=True)

    def moment(self) -> None:
        """Let a random time pass: a kill waits for no event."""
        time.sleep(self.rng.uniform(0.0, self.job_s))

    def start(self) -> int:
        """Go on where something has been printed, else begin."""
        go_on = bool(self.bench.executed())
        self.seen["gone on" if go_on else "begun"] += 1
        self.began_s = None if go_on else time.time()
        return self.bench.send(go_on=go_on)

    def next_job(self, *, ended: bool) -> None:
        """Begin a record; of a job that was printed from first line to last take its time."""
        if ended and self.began_s is not None:
            self.job_s = self.bench.record.stat().st_mtime - self.began_s
        self.bench.record.write_text("")

    def kill_sender(self) -> None:
        bench = self.bench
        sender = self.start()
        self.moment()
        status = self.forks.kill(sender)
        self.seen[{-9: "senders killed", 0: "jobs finished"}.get(status, "refused")] += 1
        if status not in (-9, 0):
            error = bench.told()["error"]
            ended = "printed to its end" in error  # killed between its last line and its exit
            assert ended or "start script" in error, error
            assert not ended or len(bench.executed()) == LINES
        if status == -9:
            self.await_cold()
        self.judge(finished=status == 0)
        if status != -9:
            self.next_job(ended=status == 0)

    def kill_printer(self) -> None:
        bench = self.bench
        sender = self.start()
        self.moment()
        self.forks.kill(bench.printer)
        status = self.forks.wait(sender)
        told = bench.told()
        self.seen["printers killed"] += 1
        assert status in (0, 4) or "gcode.errors." in told["error"].splitlines()[-1], told
        done = len(bench.executed())
        ended = "printed to its end" in told.get("error", "")
        assert not ended or done == LINES
        if status == 4 and "sent" in told and done and not ended:
            # From 0; beads begin after the head of the program, none is counted within it.
            # What comes after the last bead may have been executed, too.
            assert min(told["executed"] - HEAD + 1, LINES) <= done <= told["sent"] - HEAD + 1, told
            self.seen["intervals true"] += 1
        self.judge(finished=status == 0)
        again = bench.folder / "again"
        bench.printer = self.forks.printer(again, bench.record)
        again.replace(bench.port)
        if status != 0 and done and not ended and self.rng.random() < 0.2:
            assert "cannot be resumed" in bench.go_on()["error"]
            assert len(bench.executed()) == done
            self.seen["resets refused"] += 1
        self.next_job(ended=status == 0)

    def judge(self, *, finished: bool) -> None:
        """In order, none twice, none left out; the journal whole and never behind the truth."""
        bench = self.bench
        executed = bench.executed()
        assert executed == bench.beads[: len(executed)]
        assert not finished or len(executed) == LINES
        journal = Journal(bench.journal)
        assert is_whole(bench.journal)
        job = journal.latest()
        if executed:
            assert job is not None
            assert len(executed) + HEAD <= job.reserved + 2
        journal.close()

    def await_cold(self) -> None:
        end_s = time.monotonic() + STATED_S
        while True:
            text = self.bench.record.read_text() if self.bench.record.exists() else ""
            heats = _HEAT.findall(text)
            if not heats or heats[-2:] == ["0", "0"]:
                return
            assert time.monotonic() < end_s, text[-200:]
            time.sleep(0.005)


def hang(forks: Forks, folder: Path, kills: int, seed: int) -> Counter[str]:
    gallows = Gallows(forks, folder, seed)
    for _ in range(kills // 2):
        gallows.kill_sender()
        gallows.kill_printer()
    return gallows.seen


def test_thirty_kills_execute_nothing_twice(forks: Forks, tmp_path: Path) -> None:
    seen = hang(forks, tmp_path, 30, seed=1)
    # a machine that grows quicker meanwhile lets many a job end first
    assert seen["senders killed"] > 4
    assert seen["intervals true"] > 1


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("part", range(10))
def test_a_thousand_kills_execute_nothing_twice(forks: Forks, tmp_path: Path, part: int) -> None:
    """A hundred at a time, so that a part can be run by name."""
    seen = hang(forks, tmp_path, 100, seed=2 + part)
    print(dict(seen))
    assert seen["senders killed"] > 25
    assert seen["gone on"] > 5
    assert seen["intervals true"] > 10
