"""The journal of a job: SQLite in WAL mode, written ahead of the wire.

Before a line goes out, the journal already says that it may (`reserved`): after a crash the
uncertain interval is [acked, reserved), never smaller than the truth. Lines are reserved in steps,
one synchronous commit each, so that the wire does not wait for the disk; where the printer
cannot be asked how far it came (no line numbers) the step is one line.
It stores what was sent and said; what follows from that is decided in `recover`.
"""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gcode.errors import JournalError

_SCHEMA = """
CREATE TABLE IF NOT EXISTS job (
    id INTEGER PRIMARY KEY,
    program_sha256 TEXT NOT NULL,
    port TEXT NOT NULL,
    first_line INTEGER NOT NULL,
    end_line INTEGER NOT NULL,
    acked INTEGER NOT NULL,       -- every program line below is acknowledged
    reserved INTEGER NOT NULL,    -- no program line from here on was ever sent
    phase TEXT NOT NULL,          -- printing, finished
    started_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS step (
    job INTEGER NOT NULL REFERENCES job (id),
    line INTEGER NOT NULL,        -- program line from which on
    number INTEGER NOT NULL,      -- this wire number was given to that line
    reserved INTEGER NOT NULL,
    time_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS note (
    job INTEGER,
    time_s REAL NOT NULL,
    text TEXT NOT NULL
);
CREATE TABLE IF NOT EXISTS temperature (
    job INTEGER,
    time_s REAL NOT NULL,
    hotend_c REAL NOT NULL,
    bed_c REAL
);
"""


@dataclass(frozen=True, slots=True)
class JobRecord:
    """What the journal knows of its latest job; lines are program lines, half-open."""

    id: int
    program_sha256: str
    port: str
    first_line: int
    end_line: int
    acked: int
    reserved: int
    phase: str


class Journal:
    """One journal file; may hold many jobs, the latest counts.

    Parameters
    ----------
    step_lines
        Lines reserved by one commit: the widest interval that a crash can leave uncertain
        before the printer is asked.
    """

    def __init__(
        self,
        path: Path,
        *,
        step_lines: int = 512,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.path = path
        self.step_lines = step_lines
        self._clock = clock
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.execute("PRAGMA busy_timeout=5000")
            self._db.executescript(_SCHEMA)
        except (sqlite3.Error, OSError) as error:
            raise JournalError(
                f"The journal {path} cannot be used ({error}); name another file."
            ) from error
        self._job: int | None = None

    def begin(self, program_sha256: str, port: str, first: int, end: int) -> None:
        """Begin a job, or the next part of the one under way."""
        latest = self.latest()
        if (
            self._job is not None
            and latest is not None
            and latest.program_sha256 == program_sha256
            and latest.phase == "printing"
            and first >= latest.acked
        ):
            self._run("UPDATE job SET end_line = ? WHERE id = ?", end, self._job)
            return
        cursor = self._run(
            "INSERT INTO job (program_sha256, port, first_line, end_line, acked, reserved, phase,"
            " started_s) VALUES (?, ?, ?, ?, ?, ?, 'printing', ?)",
            program_sha256,
            port,
            first,
            end,
            first,
            first,
            self._clock(),
        )
        self._job = cursor.lastrowid

    def reserve(self, up_to: int, number_offset: int, acked: int) -> None:
        """Say, before it happens, that lines below `up_to` may be sent.

        Parameters
        ----------
        number_offset
            Wire number of the next line less its program line.
        acked
            Every program line below is acknowledged.
        """
        self._run("BEGIN IMMEDIATE")
        self._run(
            "INSERT INTO step VALUES (?, ?, ?, ?, ?)",
            self._job,
            acked,
            number_offset,
            up_to,
            self._clock(),
        )
        self._run("UPDATE job SET reserved = ?, acked = ? WHERE id = ?", up_to, acked, self._job)
        self._run("COMMIT")

    def acknowledged(self, acked: int, number: int) -> None:
        """Say that every program line below `acked` has been received, proved by an answer."""
        self._run("UPDATE job SET acked = ?, reserved = ? WHERE id = ?", acked, acked, self._job)

    def finish(self) -> None:
        """Say that the job is done."""
        self._run("UPDATE job SET phase = 'finished' WHERE id = ?", self._job)

    def note(self, text: str) -> None:
        """Write a remark (a pause, a safe exit)."""
        self._run("INSERT INTO note VALUES (?, ?, ?)", self._job, self._clock(), text)

    def temperature(self, hotend_c: float, bed_c: float | None) -> None:
        """Write temperatures down."""
        self._run(
            "INSERT INTO temperature VALUES (?, ?, ?, ?)",
            self._job,
            self._clock(),
            hotend_c,
            bed_c,
        )

    def latest(self) -> JobRecord | None:
        """Return the latest job, or None."""
        row = self._run(
            "SELECT id, program_sha256, port, first_line, end_line, acked, reserved, phase"
            " FROM job ORDER BY id DESC LIMIT 1"
        ).fetchone()
        return None if row is None else JobRecord(*row)

    def lowest_bed_c(self) -> float | None:
        """Return the lowest bed temperature noted during the latest job, or None."""
        row = self._run(
            "SELECT MIN(bed_c) FROM temperature WHERE job = (SELECT MAX(id) FROM job)"
        ).fetchone()
        return row[0]

    def notes(self) -> tuple[str, ...]:
        """Return the remarks, oldest first."""
        return tuple(row[0] for row in self._run("SELECT text FROM note ORDER BY rowid"))

    def check(self) -> bool:
        """Whether SQLite finds the file whole."""
        return bool(self._run("PRAGMA integrity_check").fetchone()[0] == "ok")

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def _run(self, sql: str, *values: object) -> sqlite3.Cursor:
        try:
            return self._db.execute(sql, values)
        except sqlite3.Error as error:
            raise JournalError(
                f"The journal {self.path} cannot be read or written ({error})."
            ) from error
