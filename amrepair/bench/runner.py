"""`amrepair bench`: every method on every class with every seed, resumable, in several processes.

    out/run.json            which data set this folder belongs to
    out/cells/…             one row for each finished method, class and seed
    out/partial/…           scores of samples of unfinished cells, and fitted templates
    out/results.{json,csv,md}   rewritten after every cell

A second run with the same arguments does only what is left.
"""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from pathlib import Path

from amrepair.bench.cells import Cell, ScoreRow, run_cell
from amrepair.bench.dataset import open_dataset
from amrepair.bench.paper import BENCH_PAPER
from amrepair.bench.registry import BENCH_METHODS, PAPER_METHOD, make_method
from amrepair.bench.samples import BenchData
from amrepair.bench.synth import MANIFEST
from amrepair.bench.tables import as_csv, as_json, as_markdown
from amrepair.errors import InputError
from amrepair.template.paper import PaperOptions
from gcode.compiled import get_num_threads, set_num_threads
from gcode.process import end_with_parent
from gcode.progress import Progress, silent
from gcode.whole import left_behind, write_bytes

DEFAULT_SEEDS = (0, 1, 2)
# Raised when scores of the same name would come out differently: old cells are then refused.
SCORES_LAYOUT_VERSION = 3


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The results of a benchmark run.

    Attributes
    ----------
    rows
        One for each method, class and seed, in that order.
    json_path, csv_path, markdown_path
        The files written.
    """

    rows: tuple[ScoreRow, ...]
    json_path: Path
    csv_path: Path
    markdown_path: Path


def run_bench(
    dataset: Path,
    *,
    format: str,
    methods: Sequence[str],
    out: Path,
    jobs: int = 1,
    seeds: Sequence[int] = DEFAULT_SEEDS,
    checkpoint: Path | None = None,
    paper: PaperOptions = BENCH_PAPER,
    progress: Progress = silent,
) -> BenchReport:
    """Compare methods on a data set.

    Parameters
    ----------
    dataset
        Its folder.
    format
        A name in `LAYOUTS`.
    methods
        Names out of `BENCH_METHODS`.
    out
        Folder of the results; one with results of the same data set is gone on with.
    jobs
        Processes; each does whole cells.
    seeds
        Registration and banks are random: three by default, their spread is reported.
    checkpoint
        Pretrained weights, for the methods that need them.
    paper
        Recipe of `pasdf-paper`; by default a shortened one.

    Raises
    ------
    InputError
        If a name is unknown, the data set cannot be read, or `out` belongs to another one.
    """
    data = open_dataset(Path(dataset), format)
    if not methods or not seeds or jobs < 1:
        raise InputError(
            f"a benchmark needs a method, a seed and at least one job; got {len(methods)} methods, "
            f"{len(seeds)} seeds and {jobs} jobs"
        )
    names = list(dict.fromkeys(methods))
    for name in names:
        make_method(name, checkpoint=checkpoint, paper=paper)
    out = Path(out)
    _claim(out, data, paper if PAPER_METHOD in names else None)
    cells = [
        Cell(method, one, data.format, seed, out, checkpoint, paper)
        for one in data.classes
        for method in names
        for seed in dict.fromkeys(seeds)
    ]
    rows: list[ScoreRow] = []
    for row in _work(cells, jobs, progress):
        rows.append(row)
        report = _write(out, data, rows, len(cells), paper)
        progress("bench", float(len(rows)), float(len(cells)))
    shutil.rmtree(out / "partial", ignore_errors=True)
    for draft in list(left_behind(out)):  # what a killed run was writing
        draft.unlink(missing_ok=True)
    return report


def _claim(out: Path, data: BenchData, paper: PaperOptions | None) -> None:
    """Mark the folder as this data set's, or refuse it."""
    listing = hashlib.sha256()
    for one in data.classes:
        for path in (*one.train, *(sample.cloud_path for sample in one.test)):
            listing.update(f"{one.name}/{path.name}:{path.stat().st_size}\n".encode())
    said: dict[str, object] = {
        "format": str(data.format),
        "files": listing.hexdigest(),
        "layout": SCORES_LAYOUT_VERSION,
    }
    path = out / "run.json"
    if path.is_file():
        try:
            found = json.loads(path.read_text())
        except ValueError:
            found = None
        recipe = found.pop("paper", None) if isinstance(found, dict) else None
        if found != said:
            raise InputError(
                f"{out} holds results of another data set or version; choose another --out"
            )
        if paper is not None and recipe is not None and recipe != asdict(paper):
            raise InputError(
                f"{out} holds results of {PAPER_METHOD} by another recipe; choose another --out"
            )
        said["paper"] = recipe
    if paper is not None:
        said["paper"] = asdict(paper)
    write_bytes(path, json.dumps(said).encode(), durable=True)


def _work(cells: Sequence[Cell], jobs: int, progress: Progress) -> Iterator[ScoreRow]:
    if jobs == 1:
        for cell in cells:
            yield run_cell(cell, progress)
        return
    threads = max(1, (os.cpu_count() or 1) // jobs)
    pool = ProcessPoolExecutor(
        max_workers=jobs,
        mp_context=multiprocessing.get_context("spawn"),  # threads of open3d do not survive fork
        initializer=_begin_worker,
        initargs=(threads,),
    )
    try:
        for done in as_completed([pool.submit(run_cell, cell) for cell in cells]):
            yield done.result()
    except BrokenProcessPool as error:
        raise InputError(
            "a benchmark process died (out of memory?); run again with fewer --jobs: what is "
            "done is kept"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _begin_worker(count: int) -> None:
    """Libraries loaded from here on share the cores among the jobs; killed, all of them end."""
    end_with_parent()
    os.environ["OMP_NUM_THREADS"] = str(count)
    set_num_threads(min(count, get_num_threads()))


def _write(
    out: Path, data: BenchData, rows: Sequence[ScoreRow], cells: int, paper: PaperOptions
) -> BenchReport:
    ordered = sorted(rows, key=lambda r: (BENCH_METHODS.index(r.method), r.class_name, r.seed))
    synthetic = (data.root / MANIFEST).is_file()
    report = BenchReport(
        tuple(ordered), out / "results.json", out / "results.csv", out / "results.md"
    )
    complete = len(rows) == cells
    said = as_json(ordered, data.format, synthetic=synthetic, complete=complete, paper=paper)
    write_bytes(report.json_path, said.encode(), durable=True)
    write_bytes(report.csv_path, as_csv(ordered).encode(), durable=True)
    table = as_markdown(ordered, data.format, synthetic=synthetic, complete=complete, paper=paper)
    write_bytes(report.markdown_path, table.encode(), durable=True)
    return report
