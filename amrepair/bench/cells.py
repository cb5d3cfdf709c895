"""One cell of the table: a method, a class, a seed; fitted, scored sample by sample, judged.

Each sample's scores are on disk, whole, before the next one starts, so that a killed run goes on
where it was. The draws of a sample depend on seed, class and sample alone: order, resuming and
the number of jobs change nothing.
"""

from __future__ import annotations

import json
import math
import shutil
import time
import zipfile
import zlib
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from amrepair.bench.method import DIAGONAL_MM, Model, class_input
from amrepair.bench.metrics import Detection, detection
from amrepair.bench.registry import make_method
from amrepair.bench.samples import BenchClass, Sample
from amrepair.template.paper import PaperOptions
from gcode.progress import Progress, silent
from gcode.whole import put_in_place, write_bytes

# Median residual of the normal points after alignment, over the noise: flat parts of a well
# aligned cloud give 0.7, over another cloud's planes 1, a template's own error some more. Published
# clouds may have no noise at all: below a thousandth of the part none is told to be off.
BAD_ALIGNMENT_SIGMAS, BAD_ALIGNMENT_MM = 4.0, 0.001 * DIAGONAL_MM


@dataclass(frozen=True, slots=True)
class ScoreRow:
    """What one cell came to; None where a method has nothing to measure.

    Attributes
    ----------
    o_auroc, p_auroc, o_aupr, p_aupr
        Over the class's samples, and over all their points together; 0…1.
    seconds_per_sample, fit_seconds
        Alignment and scoring of one sample on average; fitting.
    cd, emd, cd_squared, to_surface, from_surface
        Repair template against normal shape, in units of its radius (`CloudDistance`).
    failed_alignments, badly_aligned
        Samples that raised; samples whose normal points lie off the normal surface.
    """

    method: str
    class_name: str
    seed: int
    o_auroc: float | None
    p_auroc: float | None
    o_aupr: float | None
    p_aupr: float | None
    seconds_per_sample: float
    fit_seconds: float
    cd: float | None
    emd: float | None
    cd_squared: float | None
    to_surface: float | None
    from_surface: float | None
    samples: int
    points: int
    failed_alignments: int
    badly_aligned: int | None


@dataclass(frozen=True, slots=True)
class Cell:
    """A piece of work that another process can do alone."""

    method: str
    one: BenchClass
    format: str
    seed: int
    out: Path
    checkpoint: Path | None = None
    paper: PaperOptions | None = None

    @property
    def folder(self) -> Path:
        """Where its samples are kept while it runs."""
        return self.out / "partial" / self.method / self.one.name / str(self.seed)

    @property
    def result_path(self) -> Path:
        """Where its row is kept."""
        return self.out / "cells" / self.method / self.one.name / f"{self.seed}.json"


def finished(cell: Cell) -> ScoreRow | None:
    """The row of a cell that an earlier run finished."""
    if not cell.result_path.is_file():
        return None
    return ScoreRow(**json.loads(cell.result_path.read_text()))


def run_cell(
    cell: Cell,
    progress: Progress = silent,
) -> ScoreRow:
    """Do what is left of a cell and judge it.

    Raises
    ------
    InputError
        If a file of the data set cannot be used.
    """
    done = finished(cell)
    if done is not None:
        return done
    left = [sample for sample in cell.one.test if _load(_path(cell, sample)) is None]
    fit_path = cell.folder / "fit.json"
    if left or not fit_path.is_file():
        started = time.perf_counter()
        data = class_input(cell.one, cell.format)
        method = make_method(cell.method, checkpoint=cell.checkpoint, paper=cell.paper)
        model = method.fit(data, seed=cell.seed, cache=cell.out / "partial" / "templates")
        _write_fit(fit_path, model, time.perf_counter() - started, data.sigma_mm)
        for i, sample in enumerate(left):
            progress(f"{cell.method} {cell.one.name}", float(i), float(len(left)))
            _score(cell, sample, model, data.mm_per_unit)
    row = _judge(cell, json.loads(fit_path.read_text()))
    write_bytes(cell.result_path, json.dumps(asdict(row)).encode(), durable=True)
    shutil.rmtree(cell.folder)
    return row


def _path(cell: Cell, sample: Sample) -> Path:
    return cell.folder / f"{sample.name}.npz"


def _load(path: Path) -> dict[str, np.ndarray] | None:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return None  # not there, or not ours: scored again


def _write_fit(path: Path, model: Model, seconds: float, sigma_mm: float) -> None:
    distance = model.template_distance
    said = {
        "seconds": seconds,
        "sigma_mm": sigma_mm,
        "cd": None if distance is None else distance.chamfer,
        "emd": None if distance is None else distance.emd,
        "cd_squared": None if distance is None else distance.chamfer_squared,
        "to_surface": None if distance is None else distance.to_surface,
        "from_surface": None if distance is None else distance.from_surface,
    }
    if not path.is_file():  # a resumed run keeps the first fit's time
        write_bytes(path, json.dumps(said).encode(), durable=True)


def _score(
    cell: Cell,
    sample: Sample,
    model: Model,
    mm_per_unit: float,
) -> None:
    cloud = sample.load()
    words = [cell.seed, zlib.crc32(cell.one.name.encode()), zlib.crc32(sample.name.encode())]
    rng = np.random.default_rng(words)
    started = time.perf_counter()
    scores = model.score(np.asarray(cloud.points * mm_per_unit), rng)
    seconds = time.perf_counter() - started
    residual = math.nan
    normal = cloud.labels == 0
    if scores.residual_mm is not None and normal.any():
        residual = float(np.median(np.abs(scores.residual_mm[normal])))
    path = _path(cell, sample)
    path.parent.mkdir(parents=True, exist_ok=True)
    with put_in_place(path, durable=True) as draft, draft.open("wb") as stream:
        np.savez(
            stream,
            score=scores.point.astype(np.float32),
            label=cloud.labels.astype(np.int8),
            whole=np.float64(scores.whole),
            seconds=np.float64(seconds),
            residual_mm=np.float64(residual),
            aligned=np.bool_(scores.aligned),
        )


def _judge(cell: Cell, fit: dict[str, float | None]) -> ScoreRow:
    stored = [_load(_path(cell, sample)) for sample in cell.one.test]
    kept = [one for one in stored if one is not None]
    whole = detection(
        np.array([int(sample.anomalous) for sample in cell.one.test]),
        np.array([float(one["whole"]) for one in kept]),
    )
    labels = np.concatenate([one["label"] for one in kept])
    told = labels >= 0  # of the rest nobody has said what they are
    point = detection(labels[told], np.concatenate([one["score"] for one in kept])[told])
    residual = np.array([float(one["residual_mm"]) for one in kept])
    failed = np.array([not bool(one["aligned"]) for one in kept])
    judged = bool(np.isfinite(residual).any() or failed.any())
    limit_mm = max(BAD_ALIGNMENT_SIGMAS * float(fit["sigma_mm"] or 0.0), BAD_ALIGNMENT_MM)
    return ScoreRow(
        method=cell.method,
        class_name=cell.one.name,
        seed=cell.seed,
        **_areas(whole, point),
        seconds_per_sample=float(np.mean([float(one["seconds"]) for one in kept])),
        fit_seconds=float(fit["seconds"] or 0.0),
        cd=fit["cd"],
        emd=fit["emd"],
        cd_squared=fit["cd_squared"],
        to_surface=fit["to_surface"],
        from_surface=fit["from_surface"],
        samples=len(kept),
        points=len(labels),
        failed_alignments=int(failed.sum()),
        badly_aligned=int(((residual > limit_mm) | failed).sum()) if judged else None,
    )


def _areas(whole: Detection, point: Detection) -> dict[str, float | None]:
    def known(value: float) -> float | None:
        return None if math.isnan(value) else value

    return {
        "o_auroc": known(whole.auroc),
        "p_auroc": known(point.auroc),
        "o_aupr": known(whole.aupr),
        "p_aupr": known(point.aupr),
    }
