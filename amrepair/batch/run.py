"""`run_batch`: read what is asked, skip what is known, hand out the rest, write what it came to.

    out/results/ab/…json     one for each scan's content, written whole
    out/results/ab/…gcode    with `repair`: its program
    out/table.csv, .parquet  a row for each scan, sorted by name
    out/overview.html, batch.json

A second run with the same arguments does only what is left.
"""

from __future__ import annotations

import base64
import errno
import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from amrepair.batch.cells import CellSums, PartCells
from amrepair.batch.entries import Entry, read_entries
from amrepair.batch.executors import make_executor
from amrepair.batch.options import (
    BatchKind,
    BatchOptions,
    Task,
    TaskOutcome,
    TemplateFile,
    Work,
    scan_id,
)
from amrepair.batch.overview import PartOverview, overview
from amrepair.batch.places import ResultFolder, digest_of, is_remote, open_place, suffix_of
from amrepair.batch.table import DONE, as_csv, as_parquet, row_of
from amrepair.batch.work import PROGRAM, SUMS
from amrepair.errors import InputError
from amrepair.library import template_files
from amrepair.regions.error_calibration import Calibration
from amrepair.template import GridSdf, PaperSdf, open_template
from gcode.profiles import load_setup
from gcode.progress import Progress, silent

# Folders by the first letters of an id: file systems and listings stay quick.
FAN = 2
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True, slots=True)
class BatchReport:
    """What a batch came to.

    Attributes
    ----------
    rows
        One for each scan, sorted by name.
    computed, known, repeated
        Scans judged now, those whose result was there before, and those that have the bytes of
        another one of the batch.
    cost
        CPU seconds, bytes read, the largest worker's memory in MB: of what was judged now.
    files
        Names of what was written into the output folder.
    notes
        Sentences for whoever started it.
    """

    rows: tuple[Mapping[str, Any], ...]
    computed: int
    known: int
    repeated: int
    cost: Mapping[str, float]
    files: tuple[str, ...]
    notes: tuple[str, ...]

    @property
    def refused(self) -> int:
        """Rows with a sentence instead of figures."""
        return sum(row["status"] != DONE for row in self.rows)

    def to_json(self) -> dict[str, Any]:
        """What it came to, for programs."""
        return {
            "scans": len(self.rows),
            "refused": self.refused,
            "computed": self.computed,
            "known_before": self.known,
            "repeated": self.repeated,
            "cost": {name: round(value, 3) for name, value in self.cost.items()},
            "notes": list(self.notes),
        }


@dataclass(slots=True)
class _Books:
    """What a batch knows while it runs.

    Attributes
    ----------
    known
        Ids of the results that are there.
    id_of, sentence_of
        By name: the scan's result, or why it has none.
    passing
        By id: sentences that are not kept, since the next run may come to another.
    """

    known: set[str]
    id_of: dict[str, str] = field(default_factory=dict)
    sentence_of: dict[str, str] = field(default_factory=dict)
    passing: dict[str, str] = field(default_factory=dict)
    begun: set[str] = field(default_factory=set)
    before: int = 0
    repeated: int = 0
    finished: int = 0


def run_batch(
    source: str,
    *,
    options: BatchOptions,
    template: Path,
    out: str,
    executor: str = "process",
    workers: int | None = None,
    address: str | None = None,
    calibration: Calibration | None = None,
    progress: Progress = silent,
) -> BatchReport:
    """Judge many scans, each content once.

    Parameters
    ----------
    source
        Folder of scans, or a manifest; may be in an object store.
    template
        Template file, mesh, or a folder of them to choose from.
    out
        Folder of the results, here or in an object store; one with results is gone on with.
    executor
        `process`, `serial` or `ray`.
    workers
        None: one a core.
    address
        Of a Ray cluster.

    Raises
    ------
    InputError
        If there is nothing to do, the output cannot be written, or the disk is full: what is done
        stays done.
    """
    started_s = time.monotonic()
    entries = read_entries(source)
    place = open_place(out)
    with tempfile.TemporaryDirectory(prefix="amrepair-batch-") as scratch, place.alone():
        files, parts = _templates(template, Path(scratch), progress)
        setup = None
        if options.kind is BatchKind.REPAIR:
            setup = load_setup(options.printer, options.material, options.process)
        work = Work(options, files, setup, calibration)
        books = _Books(_kept(place))
        cost = {"cpu_s": 0.0, "read_bytes": 0.0, "peak_mb": 0.0, "computed": 0.0}
        total = float(len(entries))
        with closing(make_executor(executor, work, workers=workers, address=address)) as crew:
            progress("scans", 0.0, total)
            for outcome in crew.outcomes(_tasks(entries, work, books, progress)):
                with _told_where_full(out, books, total):
                    _keep(place, outcome, books)
                _add_cost(cost, outcome)
                books.finished += 1
                progress("scans", float(_settled(books)), total)
        with _told_where_full(out, books, total):
            report = _written(place, entries, books, parts, options.kind, cost, progress)
            wall_s = round(time.monotonic() - started_s, 3)
            said = {**report.to_json(), "executor": executor, "wall_s": wall_s}
            text = json.dumps(said, indent=2, ensure_ascii=False) + "\n"
            place.write("batch.json", text.encode())
    return report


def _templates(
    path: Path, scratch: Path, progress: Progress
) -> tuple[tuple[TemplateFile, ...], dict[str, PartOverview]]:
    """Templates as workers load them, and their cells; a mesh is fitted once, here."""
    if not path.exists():
        raise InputError(f"--template {path}: there is no such file or folder")
    found, parts = [], {}
    for k, file in enumerate(template_files(path) if path.is_dir() else [path]):
        template = open_template(file, progress=progress)
        fitted = file
        if file.suffix.lower() != ".safetensors":
            fitted = scratch / f"{k}.safetensors"
            assert isinstance(template, (GridSdf, PaperSdf))
            template.save(fitted)
        found.append(TemplateFile(file.stem, digest_of(str(file))[0], fitted.resolve()))
        parts[file.stem] = PartOverview(PartCells.of(open_template(fitted)))
    return tuple(found), parts


def _kept(place: ResultFolder) -> set[str]:
    """Ids of whole results."""
    folders = place.names("results")
    names = (name for folder in folders for name in place.names(f"results/{folder}"))
    return {name.removesuffix(".json") for name in names if name.endswith(".json")}


def _path_of(scan_id: str, ending: str) -> str:
    return f"results/{scan_id[:FAN]}/{scan_id}{ending}"


def _tasks(
    entries: Sequence[Entry], work: Work, books: _Books, progress: Progress
) -> Iterator[Task]:
    """What is left to do; read one by one, as workers ask."""
    fingerprint = work.fingerprint()
    for entry in entries:
        try:
            sha256, _ = digest_of(entry.uri)
        except FileNotFoundError:
            books.sentence_of[entry.name] = "{scan}: there is no such file"
            continue
        except OSError as error:
            said = error.strerror or str(error)
            books.sentence_of[entry.name] = f"{{scan}} cannot be read ({said})"
            continue
        name = scan_id(fingerprint, sha256, suffix_of(entry.uri))
        books.id_of[entry.name] = name
        if name in books.begun:
            books.repeated += 1
        elif name in books.known:
            books.before += 1
            books.begun.add(name)
        else:
            books.begun.add(name)
            yield Task(name, entry.uri, sha256)
    progress("scans", float(_settled(books)), float(len(entries)))


def _settled(books: _Books) -> int:
    return books.finished + books.before + books.repeated + len(books.sentence_of)


def _keep(place: ResultFolder, outcome: TaskOutcome, books: _Books) -> None:
    """Write a result; its JSON comes last and makes the rest count."""
    if not outcome.lasting:
        books.passing[outcome.scan_id] = outcome.sentence
        return
    for name, data in outcome.files.items():
        if name == SUMS:
            continue
        place.write(_path_of(outcome.scan_id, Path(name).suffix), data)
    said = {
        "scan_id": outcome.scan_id,
        "sentence": outcome.sentence,
        "figures": outcome.figures,
        "program": PROGRAM in outcome.files,
        "sums": base64.b64encode(outcome.files.get(SUMS, b"")).decode(),
        "cost": outcome.cost,
    }
    text = json.dumps(said, separators=(",", ":"), ensure_ascii=False)
    place.write(_path_of(outcome.scan_id, ".json"), text.encode())
    books.known.add(outcome.scan_id)


def _add_cost(cost: dict[str, float], outcome: TaskOutcome) -> None:
    cost["computed"] += 1
    cost["cpu_s"] += outcome.cost.get("cpu_s", 0.0)
    cost["read_bytes"] += outcome.cost.get("read_bytes", 0.0)
    cost["peak_mb"] = max(cost["peak_mb"], outcome.cost.get("peak_mb", 0.0))


def _written(
    place: ResultFolder,
    entries: Sequence[Entry],
    books: _Books,
    parts: dict[str, PartOverview],
    kind: BatchKind,
    cost: Mapping[str, float],
    progress: Progress,
) -> BatchReport:
    """Table and overview of all that there is."""
    rows = []
    last, result = "", {}
    for number, entry in enumerate(entries):
        progress("table", float(number), float(len(entries)))
        name = books.id_of.get(entry.name, "")
        if not name or name in books.passing:
            said = books.sentence_of.get(entry.name) or books.passing[name]
            rows.append(row_of(entry, name, {}, said))
            continue
        if name != last:  # names of one content need not follow each other: it is read again
            last, result = name, json.loads(place.read(_path_of(name, ".json")))
        gcode = _path_of(name, ".gcode") if result["program"] else ""
        rows.append(row_of(entry, name, result["figures"], result["sentence"], gcode))
        if result["sums"]:  # a scan that was handed in twice counts twice
            sums = CellSums.from_bytes(base64.b64decode(result["sums"]))
            parts[result["figures"]["template"]].add(sums)
    progress("table", 1.0, 1.0)
    notes = []
    files = ["table.csv", "overview.html", "batch.json"]
    place.write("table.csv", as_csv(rows, kind))
    parquet = as_parquet(rows, kind)
    if parquet is None:
        notes.append("table.parquet is not written: pip install 'amrepair[batch]' for pyarrow.")
    else:
        place.write("table.parquet", parquet)
        files.insert(1, "table.parquet")
    refused = [row for row in rows if row["status"] != DONE]
    if refused:
        notes.append(
            f"{len(refused)} of {len(rows)} scans have a sentence instead of figures; the first: "
            f"{refused[0]['sentence']}"
        )
    place.write("overview.html", overview(rows, parts, kind).encode())
    return BatchReport(
        tuple(rows),
        int(cost["computed"]),
        books.before,
        books.repeated,
        dict(cost),
        tuple(files),
        tuple(notes),
    )


@contextmanager
def _told_where_full(out: str, books: _Books, total: float) -> Iterator[None]:
    """A full disk in one sentence, with what is done and how to go on."""
    try:
        yield
    except OSError as error:
        full = error.errno in _NO_SPACE and not is_remote(out)
        raise InputError(
            f"{out} cannot be written any more ({error.strerror or error}); {len(books.known)} "
            f"results of {total:.0f} scans are kept: {'free some space' if full else 'mend it'} "
            "and give the same command again to go on"
        ) from error
