"""The journal of a job: SQLite in WAL mode, written ahead of the wire.

Before a line goes out, the journal already says that it may (`reserved`): after a crash the
uncertain interval is [acked, reserved), never smaller than the truth. Lines are reserved in steps,
and a step that is under way is extended by one synchronous commit while its lines go out, so that
the wire does not wait for the disk; where the printer counts no lines the step is short, for its
place must tell them apart.
A step also says which wire number its first line gets, and every command of the host's own is
preceded by an empty step: so the number that a printer has reached names one program line.
Numbers begin anew with every session, above all that were used before: a printer whose number
does not belong to the session was reset, or somebody else has spoken to it.
It stores what was sent and said; what follows from that is decided in `resume`.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import random
import sqlite3
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from gcode.errors import JournalError, JournalFileError

JOURNAL_VERSION = 2
"""Of the tables below; a journal of another version is not read."""
FIRST_BASES = (10_000, 20_000)
"""Range of a new journal's first number: no firmware is there by itself after a reset."""
CLOCK_SLEW_S = 5.0
"""A clock that is more behind what was noted was set back: one without a battery, at its start."""
FOREIGN_LINES = 50_000
"""Most commands of the host's own after a step: a question a second for half a day of pause."""


def passed_s(then_s: float, now_s: float) -> float:
    """How long it is from then until now, s; infinite where a clock was set back since."""
    return math.inf if now_s < then_s - CLOCK_SLEW_S else max(now_s - then_s, 0.0)


_JOURNAL_SCHEMA = """
CREATE TABLE IF NOT EXISTS session (
    id INTEGER PRIMARY KEY,
    base INTEGER NOT NULL,        -- M110 sets the printer's number to this
    resumes INTEGER,              -- the job that this session is to go on with, or NULL
    time_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS job (
    id INTEGER PRIMARY KEY,
    session INTEGER,              -- NULL where lines carry no numbers of ours
    program_sha256 TEXT NOT NULL,
    port TEXT NOT NULL,
    first_line INTEGER NOT NULL,
    end_line INTEGER NOT NULL,
    acked INTEGER NOT NULL,       -- every program line below is acknowledged
    reserved INTEGER NOT NULL,    -- no program line from here on was ever sent
    phase TEXT NOT NULL,          -- printing, forgotten, finished
    started_s REAL NOT NULL
);
CREATE TABLE IF NOT EXISTS step (
    job INTEGER NOT NULL REFERENCES job (id),
    line INTEGER NOT NULL,        -- program line from which on
    number INTEGER NOT NULL,      -- the wire number of the first command from there on
    reserved INTEGER NOT NULL,    -- end of the step; `line`, if no program line is sent
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


def default_path(port: str) -> Path | None:
    """Where a port's journal is kept unless told otherwise: one a printer, in the user's state.

    None for a server or a file, which keep no journal here. A link is followed by no one: what it
    leads to may change.
    """
    if "://" in port or port.startswith("file:"):
        return None
    folder = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    name = hashlib.sha256(str(Path(port).absolute()).encode()).hexdigest()[:16]
    return folder / "gcode" / f"{name}.sqlite"


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
    session: int | None


@dataclass(frozen=True, slots=True)
class Step:
    """Program lines [line, reserved) were given wire numbers from `number` on."""

    line: int
    number: int
    reserved: int


@dataclass(frozen=True, slots=True)
class Session:
    """One conversation with the printer; `resumes` is the job it was to go on with."""

    id: int
    base: int
    resumes: int | None


class Journal:
    """One journal file; may hold many jobs, the latest counts.

    Parameters
    ----------
    step_lines, step_s
        So many lines are reserved ahead at most, or as many as go out in so many seconds where
        that is more: the widest interval that a crash can leave uncertain before the printer is
        asked. A disk is asked no more often by a faster printer.
    """

    def __init__(
        self,
        path: Path,
        *,
        step_lines: int = 500,
        step_s: float = 0.4,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self.path = path
        self.step_lines, self.step_s = step_lines, step_s
        self._clock = clock
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.execute("PRAGMA busy_timeout=5000")
            self._prepare()
        except (sqlite3.Error, OSError) as error:
            in_use = getattr(error, "sqlite_errorcode", None) == sqlite3.SQLITE_BUSY
            why = getattr(error, "strerror", None) or error
            raise (JournalError if in_use else JournalFileError)(
                f"The journal {path} cannot be used ({why}); name another file with --journal, or "
                f"another folder by XDG_STATE_HOME."
            ) from error
        self._disk: ThreadPoolExecutor | None = None
        self._extension: Future[None] | None = None
        self._job: int | None = None
        self._session: int | None = None
        self._settled: int | None = None

    def _prepare(self) -> None:
        tables = self._db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        if tables and version != JOURNAL_VERSION:
            raise JournalFileError(
                f"The journal {self.path} is of version {version}, this program writes version "
                f"{JOURNAL_VERSION}; name another file."
            )
        if not tables:  # in one transaction: a kill leaves all of it or nothing
            self._db.executescript(
                f"BEGIN IMMEDIATE; {_JOURNAL_SCHEMA} "
                f"PRAGMA user_version = {JOURNAL_VERSION}; COMMIT;"
            )

    def open_session(self) -> int:
        """Begin a conversation; returns the number to set the printer to, never used before.

        A job settled before is the one that it is to go on with.
        """
        row = self._run(
            "SELECT MAX(base), (SELECT MAX(number + reserved - line) FROM step) FROM session"
        ).fetchone()
        if row[0] is None:
            base = random.randrange(*FIRST_BASES)
        else:
            base = max(row[0], row[1] or 0) + FOREIGN_LINES
        cursor = self._run(
            "INSERT INTO session (base, resumes, time_s) VALUES (?, ?, ?)",
            base,
            self._settled,
            self._clock(),
        )
        self._session, self._settled = cursor.lastrowid, None
        return base

    def begin(self, program_sha256: str, port: str, first: int, end: int) -> None:
        """Begin a job, or the next part of the one under way."""
        latest = self.latest()
        if (
            self._job is not None
            and latest is not None
            and latest.program_sha256 == program_sha256
            and latest.phase == "printing"
            and latest.session == self._session
            and first >= latest.acked
        ):
            self._run("UPDATE job SET end_line = ? WHERE id = ?", end, self._job)
            return
        cursor = self._run(
            "INSERT INTO job (session, program_sha256, port, first_line, end_line, acked,"
            " reserved, phase, started_s) VALUES (?, ?, ?, ?, ?, ?, ?, 'printing', ?)",
            self._session,
            program_sha256,
            port,
            first,
            end,
            first,
            first,
            self._clock(),
        )
        self._job = cursor.lastrowid

    def reserve(self, line: int, number: int | None, up_to: int, acked: int) -> None:
        """Say, before it happens, that lines [line, up_to) may be sent.

        Parameters
        ----------
        number
            Wire number of the first of them; with `up_to == line`: of a command of the host's.
            None where the firmware does not count.
        acked
            Every program line below is acknowledged.
        """
        steps = []
        if number is not None:
            row = (self._job, line, number, up_to, self._clock())
            steps.append(("INSERT INTO step VALUES (?, ?, ?, ?, ?)", row))
        self._await_disk()
        self._advance(up_to, acked, *steps)

    def extend(self, up_to: int, acked: int) -> None:
        """Begin to say that the lines up to `up_to` may be sent as well; see `extended`.

        They get the numbers that follow in the step under way: nothing else may be sent between.
        A thread waits for the disk meanwhile.
        """
        if self._disk is None:
            self._disk = ThreadPoolExecutor(1, "journal")
        last = "(SELECT MAX(rowid) FROM step)"
        step = f"UPDATE step SET reserved = ?, time_s = ? WHERE rowid = {last}"
        self._extension = self._disk.submit(
            self._advance, up_to, acked, (step, (up_to, self._clock()))
        )

    def extended(self) -> None:
        """Return when what `extend` was told is on the disk.

        Raises
        ------
        JournalError
            If it is not.
        """
        if self._extension is not None:
            error = self._extension.exception()
            self._extension = None  # now, and not where the wait was interrupted
            if error is not None:
                raise error

    def acknowledged(self, acked: int) -> None:
        """Say that every program line below `acked` has been received, proved by an answer."""
        self._run("UPDATE job SET acked = ?, reserved = ? WHERE id = ?", acked, acked, self._job)

    def lost(self, acked: int, sent: int, *, forgot: bool = False) -> None:
        """Say that the link is lost: acknowledged below `acked`, nothing sent from `sent` on.

        With `forgot`, the printer has lost what waited in its buffers as well.
        """
        progress = (acked, sent, "forgotten" if forgot else "printing", self._job)
        self._run("UPDATE job SET acked = ?, reserved = ?, phase = ? WHERE id = ?", *progress)

    def settle(self, job: int, line: int) -> None:
        """Say of an earlier session's job: all below `line` is executed, nothing else was sent.

        Notes and temperatures are that job's from here on.
        """
        self._job = self._settled = job
        self._run("UPDATE job SET acked = ?, reserved = ? WHERE id = ?", line, line, job)

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
            "SELECT id, program_sha256, port, first_line, end_line, acked, reserved, phase,"
            " session FROM job ORDER BY id DESC LIMIT 1"
        ).fetchone()
        return None if row is None else JobRecord(*row)

    def steps(self, job: int) -> tuple[Step, ...]:
        """Return the steps of a job, oldest first."""
        rows = self._run(
            "SELECT line, number, reserved FROM step WHERE job = ? ORDER BY rowid", job
        )
        return tuple(Step(*row) for row in rows)

    def session_of(self, number: int) -> Session | None:
        """Return the session that gave out a wire number; None if none did."""
        row = self._run(
            "SELECT id, base, resumes FROM session WHERE base <= ? ORDER BY base DESC LIMIT 1",
            number,
        ).fetchone()
        return None if row is None else Session(*row)

    def lowest_bed_c(self, warm_c: float) -> float | None:
        """Return the lowest bed temperature since the bed was first at `warm_c`.

        Of the latest program's jobs in a row: whatever was printed then still stands there.
        None where the bed was never noted that warm.
        """
        jobs = (
            "SELECT id FROM job WHERE program_sha256 ="
            " (SELECT program_sha256 FROM job ORDER BY id DESC LIMIT 1)"
            " AND id >= (SELECT COALESCE(MAX(id), 0) FROM job WHERE first_line = 0)"
        )
        row = self._run(
            f"SELECT MIN(bed_c) FROM temperature WHERE job IN ({jobs}) AND rowid >= (SELECT"
            f" MIN(rowid) FROM temperature WHERE job IN ({jobs}) AND bed_c >= ?)",
            warm_c,
        ).fetchone()
        return None if row[0] is None else float(row[0])

    def temperatures(self) -> tuple[tuple[float, float, float | None], ...]:
        """Return (time_s, hotend_c, bed_c) as noted, oldest first."""
        return tuple(self._run("SELECT time_s, hotend_c, bed_c FROM temperature ORDER BY rowid"))

    def heaters_left_alone(self) -> bool:
        """Whether no temperature was noted since the heaters were last told to switch off."""
        off = [row[0] for row in self._run("SELECT time_s, text FROM note") if "heaters" in row[1]]
        noted_s = self._run("SELECT MAX(time_s) FROM temperature").fetchone()[0]
        return bool(off) and (noted_s is None or max(off) > noted_s)

    def longest_silence_s(self, now_s: float) -> float:
        """Return the longest time without an entry since the latest job's last step, s.

        Infinite where the clock was set back since: nobody knows how long it was then. What a
        later attempt to go on has noted ends no silence that came before it.
        """
        rows = self._run(
            "WITH latest AS (SELECT MAX(id) AS id, MAX(started_s) AS begun_s FROM job),"
            " stepped AS (SELECT COALESCE((SELECT MAX(time_s) FROM step WHERE job = latest.id),"
            " begun_s) AS time_s FROM latest)"
            " SELECT time_s FROM stepped UNION"
            " SELECT time_s FROM (SELECT job, time_s FROM note UNION SELECT job, time_s FROM"
            " temperature) WHERE job = (SELECT id FROM latest)"
            " AND time_s > (SELECT time_s FROM stepped) ORDER BY 1"
        )
        times_s = [row[0] for row in rows if row[0] is not None] or [now_s]
        return max([passed_s(times_s[-1], now_s), *(b - a for a, b in pairwise(times_s))])

    def notes(self) -> tuple[str, ...]:
        """Return the remarks, oldest first."""
        return tuple(row[0] for row in self._run("SELECT text FROM note ORDER BY rowid"))

    def close(self) -> None:
        """Close the file."""
        if self._disk is not None:
            self._disk.shutdown()
        self._db.close()

    def _advance(self, reserved: int, acked: int, *steps: tuple[str, tuple[object, ...]]) -> None:
        """Write what is said of steps, and how far the job is, in one synchronous commit."""
        progress = (reserved, acked, self._job)
        self._execute("BEGIN IMMEDIATE")
        try:
            for sql, values in steps:
                self._execute(sql, *values)
            self._execute("UPDATE job SET reserved = ?, acked = ? WHERE id = ?", *progress)
            self._execute("COMMIT")
        except JournalError:
            with contextlib.suppress(JournalError):
                self._execute("ROLLBACK")
            raise

    def _await_disk(self) -> None:
        """One writer at a time; what became of an extension is `extended`'s to tell."""
        if self._extension is not None:
            self._extension.exception()

    def _run(self, sql: str, *values: object) -> sqlite3.Cursor:
        self._await_disk()
        return self._execute(sql, *values)

    def _execute(self, sql: str, *values: object) -> sqlite3.Cursor:
        try:
            return self._db.execute(sql, values)
        except sqlite3.Error as error:
            raise JournalError(
                f"The journal {self.path} cannot be read or written ({error})."
            ) from error
