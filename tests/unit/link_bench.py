"""A printer, a journal, and one sender after another: what the tests of resuming share."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
from pathlib import Path
from typing import Any

from link_children import beads_of, job_lines
from link_forks import Forks, until

from gcode.hosts.journal import Journal

LINES = 3000
BEADS = beads_of("\n".join(job_lines(LINES)))
HEAD = len(job_lines(0)) - 2
assert len(set(BEADS)) == LINES
SLOW = "always slow_reader s=0.0005"
"""So that a busy machine cannot let a job end before it is killed in its middle."""


class Bench:
    """A printer, a journal, and one sender after another."""

    def __init__(
        self,
        forks: Forks,
        folder: Path,
        *,
        lines: int = LINES,
        slow: bool = True,
        **printer: Any,
    ) -> None:
        self.lines, self.beads = lines, BEADS[:lines]
        self.forks, self.folder = forks, folder
        self.port, self.journal = folder / "port", folder / "journal.sqlite"
        self.record, self.outcome = folder / "executed", folder / "outcome"
        self.dialect = printer.get("firmware", "marlin")
        if slow:
            printer["faults"] = f"{printer.get('faults', '')}\n{SLOW}"
        self.printer = forks.printer(self.port, self.record, **printer)

    def send(self, **options: Any) -> int:
        self.outcome.unlink(missing_ok=True)
        return self.forks.sender(
            self.port,
            self.journal,
            outcome=str(self.outcome),
            lines=self.lines,
            dialect=self.dialect,
            **options,
        )

    def executed(self) -> list[str]:
        return beads_of(self.record.read_text()) if self.record.exists() else []

    def kill_after(self, sender: int, beads: int) -> None:
        """Kill the sender once the printer has executed so many beads more."""
        done = len(self.executed())
        until(lambda: len(self.executed()) >= done + beads)
        assert self.forks.kill(sender) == -signal.SIGKILL

    def heated(self, times: int) -> bool:
        return self.record.read_text().splitlines().count("M109 S205") >= times

    def told(self) -> Any:
        return json.loads(self.outcome.read_text())

    def go_on(self, **options: Any) -> Any:
        status = self.forks.wait(self.send(go_on=True, **options))
        told = self.told()
        assert (status == 0) == ("error" not in told), told
        assert status in (0, 4), told
        return told

    def say(self, *lines: bytes) -> None:
        """Somebody types at the printer, without line numbers."""
        fd = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        os.write(fd, b"".join(line + b"\n" for line in lines) + b"M118 done\n")
        until(lambda: self.record.read_text().endswith("M118 done\n"))
        os.close(fd)


def is_whole(journal: Path) -> bool:
    """Whether SQLite finds the file whole."""
    with contextlib.closing(sqlite3.connect(journal)) as file:
        return bool(file.execute("PRAGMA integrity_check").fetchone()[0] == "ok")


def notes(journal: Path) -> bytes:
    book = Journal(journal)
    try:
        return "\n".join(book.notes()).encode()
    finally:
        book.close()
