"""The history of a fleet in SQLite: runs and looks, by part and printer, and what they teach.

It is read out of the runs' own records, as often as one likes: a look is kept once.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from amrepair.fleet.chart import Chart, chart
from amrepair.loop.tape import read_events

# Looks within so much of height are looks at the same height.
SAME_HEIGHT_MM = 5.0
HISTORY_VERSION = 1
_HISTORY_SCHEMA = """
CREATE TABLE run (
    id TEXT PRIMARY KEY,          -- printer and when it began
    printer TEXT NOT NULL,
    part TEXT NOT NULL,
    began_s REAL NOT NULL,        -- s since 1970
    ended_s REAL,
    outcome TEXT NOT NULL         -- as the page says it
);
CREATE TABLE look (
    run TEXT NOT NULL REFERENCES run (id),
    number INTEGER NOT NULL,
    stop TEXT NOT NULL,
    z_mm REAL NOT NULL,
    time_s REAL NOT NULL,
    missing_mm3 REAL NOT NULL,
    excess_mm3 REAL NOT NULL,
    repaired INTEGER NOT NULL,    -- a repair was printed after it
    first INTEGER NOT NULL,       -- of its stop: what the printer left by itself
    PRIMARY KEY (run, number)
);
"""


@dataclass(frozen=True, slots=True)
class Lesson:
    """What the looks of one printer at one height say.

    Attributes
    ----------
    low_mm, high_mm
        The band.
    times_s
        Of the looks, as those of `chart` are numbered.
    """

    printer: str
    low_mm: float
    high_mm: float
    times_s: tuple[float, ...]
    values_mm3: tuple[float, ...]
    chart: Chart

    def told(self) -> str:
        """In a sentence; empty where there is nothing to say."""
        if self.chart.alarm_at is None or self.chart.since is None:
            return ""
        since = datetime.fromtimestamp(self.times_s[self.chart.since]).strftime("%A, %d %B %H:%M")
        return (
            f"{self.printer} under-extrudes between {self.low_mm:g} and {self.high_mm:g} mm since "
            f"{since}: more than {self.chart.level_mm3:.2f} mm³ is missing more often than it was"
        )


class History:
    """One file.

    Raises
    ------
    InputError
        If it cannot be used, or is of another version.
    """

    def __init__(self, path: Path) -> None:
        self._mutex = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            tables = self._db.execute("SELECT COUNT(*) FROM sqlite_master").fetchone()[0]
            if not tables:
                self._db.executescript(
                    f"BEGIN IMMEDIATE; {_HISTORY_SCHEMA} "
                    f"PRAGMA user_version = {HISTORY_VERSION}; COMMIT;"
                )
            version = self._db.execute("PRAGMA user_version").fetchone()[0]
        except (sqlite3.Error, OSError) as error:
            raise InputError(f"the history {path} cannot be used ({error})") from error
        if version != HISTORY_VERSION:
            raise InputError(
                f"the history {path} is of version {version}, this program's is {HISTORY_VERSION}; "
                "move it away"
            )

    def close(self) -> None:
        """Close the file."""
        self._db.close()

    def take(self, printer: str, part: str, folder: Path, outcome: str) -> None:
        """Read a run's record; what is known already stays."""
        events = read_events(folder)
        if not events:
            return
        began_s = float(events[0].get("time_s", 0.0))
        run = f"{printer}/{began_s:.3f}"
        end = events[-1]
        ended_s = float(end["time_s"]) if end.get("event") == "end" else None
        looks = [e for e in events if e.get("event") == "look"]
        seen: set[str] = set()
        rows = []
        for look in looks:
            first = str(look["stop"]) not in seen
            seen.add(str(look["stop"]))
            rows.append(
                (run, int(look["look"]), str(look["stop"]), float(look["z_mm"]),
                 float(look.get("time_s", began_s)), float(look["missing_mm3"]),
                 float(look["excess_mm3"]), int(bool(look["printed"])), int(first))
            )  # fmt: skip
        with self._mutex:
            self._db.execute("BEGIN IMMEDIATE")
            self._db.execute(
                "INSERT INTO run VALUES (?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO UPDATE SET"
                " ended_s = excluded.ended_s, outcome = excluded.outcome",
                (run, printer, part, began_s, ended_s, outcome),
            )
            self._db.executemany(
                "INSERT OR REPLACE INTO look VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", rows
            )
            self._db.execute("COMMIT")

    def by_printer(self) -> list[dict[str, Any]]:
        """Runs, looks, repairs and volumes of every printer and part."""
        with self._mutex:
            rows = self._db.execute(
                "SELECT printer, part, COUNT(DISTINCT run.id), COUNT(look.number),"
                " COALESCE(SUM(repaired), 0), COALESCE(SUM(CASE WHEN first THEN missing_mm3 END),"
                " 0), COALESCE(SUM(CASE WHEN first THEN excess_mm3 END), 0)"
                " FROM run LEFT JOIN look ON look.run = run.id"
                " GROUP BY printer, part ORDER BY printer, part"
            ).fetchall()
        names = ("printer", "part", "runs", "looks", "repairs", "missing_mm3", "excess_mm3")
        return [dict(zip(names, row, strict=True)) for row in rows]

    def lessons(self) -> list[Lesson]:
        """A chart for each printer and height band, of what it left by itself."""
        with self._mutex:
            rows = self._db.execute(
                "SELECT printer, CAST(z_mm / ? AS INTEGER), time_s, missing_mm3 FROM look"
                " JOIN run ON look.run = run.id WHERE first ORDER BY 1, 2, time_s, run.id",
                (SAME_HEIGHT_MM,),
            ).fetchall()
        series: dict[tuple[str, int], list[tuple[float, float]]] = {}
        for printer, band, time_s, missing_mm3 in rows:
            series.setdefault((printer, band), []).append((time_s, missing_mm3))
        return [_lesson(key, found) for key, found in series.items()]


def _lesson(key: tuple[str, int], found: Sequence[tuple[float, float]]) -> Lesson:
    printer, band = key
    times_s, values_mm3 = zip(*found, strict=True)
    return Lesson(
        printer, band * SAME_HEIGHT_MM, (band + 1) * SAME_HEIGHT_MM, times_s, values_mm3,
        chart(values_mm3),
    )  # fmt: skip
