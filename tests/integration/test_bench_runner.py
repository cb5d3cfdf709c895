"""The runner: its files, its figures against a straight computation, kills, jobs."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.bench import SynthOptions, run_bench, synthesize
from amrepair.bench.cells import Cell, run_cell
from amrepair.bench.dataset import open_dataset
from amrepair.bench.method import class_input
from amrepair.bench.metrics import detection
from amrepair.bench.registry import make_method
from amrepair.bench.tables import in_short
from amrepair.errors import InputError
from gcode.whole import left_behind

ROOT = Path(__file__).parents[2]
LAYOUT = "real3d-ad"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    parts = []
    for name, extents in (("block", (30, 20, 10)), ("plate", (40, 30, 6))):
        trimesh.creation.box(extents=extents).export(folder / f"{name}.stl")
        parts.append(folder / f"{name}.stl")
    options = SynthOptions(train=2, normal=3, per_defect=1, points=1500)
    return synthesize(parts, folder / "set", LAYOUT, 0, options=options)


def without_times(row: object) -> object:
    return replace(row, seconds_per_sample=0.0, fit_seconds=0.0)  # type: ignore[type-var]


@pytest.mark.slow
def test_figures_are_those_of_a_straight_computation(dataset: Path, tmp_path: Path) -> None:
    report = run_bench(dataset, format=LAYOUT, methods=["btf-raw"], out=tmp_path, seeds=[4])
    (block, _) = open_dataset(dataset, LAYOUT).classes
    data = class_input(block, open_dataset(dataset, LAYOUT).format)
    model = make_method("btf-raw").fit(data, seed=4, cache=tmp_path)
    rng = np.random.default_rng(0)  # draws nothing below 20,000 points but an order
    clouds = [sample.load() for sample in block.test]
    scores = [model.score(cloud.points * data.mm_per_unit, rng) for cloud in clouds]
    labels = np.concatenate([cloud.labels for cloud in clouds])
    points = np.concatenate([score.point for score in scores])
    whole = np.array([score.whole for score in scores])
    truth = np.array([int(sample.anomalous) for sample in block.test])
    row, _ = report.rows
    # scores are kept in single precision: ties may fall the other way
    by_point, by_object = detection(labels, points), detection(truth, whole)
    assert row.p_auroc == pytest.approx(by_point.auroc, abs=1e-4)
    assert row.p_aupr == pytest.approx(by_point.aupr, abs=1e-3)
    assert (row.o_auroc, row.o_aupr) == (by_object.auroc, by_object.aupr)
    assert (row.samples, row.points) == (9, len(labels))
    assert row.cd is None
    assert row.badly_aligned is None


def test_files_and_keys(dataset: Path, tmp_path: Path) -> None:
    report = run_bench(
        dataset, format=LAYOUT, methods=["btf-raw", "btf-raw"], out=tmp_path, seeds=[0, 1]
    )
    said = json.loads(report.json_path.read_text())
    assert (said["complete"], said["synthetic"], said["seeds"]) == (True, True, [0, 1])
    wanted = {"o_auroc", "p_auroc", "o_aupr", "p_aupr", "seconds_per_sample", "cd", "emd"}
    assert len(said["rows"]) == 2 * 2
    assert all(wanted | {"method", "class", "seed"} <= set(row) for row in said["rows"])
    (mean,) = said["means"]
    by_seed = [
        np.mean([row["p_auroc"] for row in said["rows"] if row["seed"] == seed]) for seed in (0, 1)
    ]
    assert mean["p_auroc"]["mean"] == pytest.approx(np.mean(by_seed))
    assert mean["p_auroc"]["spread"] == pytest.approx(np.std(by_seed, ddof=1))
    assert mean["published_o_auroc"] == 0.635
    with report.csv_path.open() as stream:
        table = list(csv.DictReader(stream))
    assert [(r["method"], r["class"], r["seed"]) for r in table] == [
        ("btf-raw", name, seed) for name in ("block", "plate") for seed in "01"
    ]
    assert float(table[0]["p_auroc"]) == said["rows"][0]["p_auroc"]
    text = report.markdown_path.read_text()
    assert "| btf-raw |" in text
    assert "63.5 / 57.1" in text  # published, beside ours
    assert "not on this synthetic set" in text
    p_auroc = f"P-AUROC {100 * np.mean(by_seed):.1f} ± {100 * np.std(by_seed, ddof=1):.1f}, "
    assert in_short(report.rows).startswith("btf-raw: O-AUROC ")
    assert p_auroc in in_short(report.rows)
    assert not (tmp_path / "partial").exists()


class StoppedError(Exception):
    """Stands for a kill."""


def test_an_interrupted_cell_scores_only_what_is_left(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from amrepair.bench.baselines import BankModel

    calls = {"n": 0}
    original = BankModel.score

    def failing(self: BankModel, points_mm: np.ndarray, rng: np.random.Generator) -> object:
        calls["n"] += 1
        if calls["n"] == 4:
            raise StoppedError
        return original(self, points_mm, rng)

    data = open_dataset(dataset, LAYOUT)
    cell = Cell("btf-raw", data.classes[0], data.format, 0, tmp_path / "a")
    monkeypatch.setattr(BankModel, "score", failing)
    with pytest.raises(StoppedError):
        run_cell(cell)
    kept = sorted(cell.folder.glob("*.npz"))
    assert len(kept) == 3
    kept[0].write_bytes(kept[0].read_bytes()[:100])  # a torn file is not trusted
    row = run_cell(cell)
    assert calls["n"] == 4 + (9 - 3) + 1
    whole = run_cell(replace(cell, out=tmp_path / "b"))
    assert without_times(row) == without_times(whole)
    before = calls["n"]
    assert run_cell(cell) == row  # finished: nothing is done again
    assert calls["n"] == before


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_results(dataset: Path, tmp_path: Path) -> None:
    script = (
        "import sys; from pathlib import Path; from amrepair.bench import run_bench\n"
        f"run_bench(Path({str(dataset)!r}), format={LAYOUT!r}, methods=['patchcore-fpfh'], "
        f"out=Path({str(tmp_path / 'out')!r}), seeds=[0])\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", script], env=environment, cwd=ROOT)
    limit = time.monotonic() + 60
    partial = tmp_path / "out" / "partial"
    while not list(partial.rglob("*.npz")) and process.poll() is None:
        assert time.monotonic() < limit
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.wait()
    (tmp_path / "out" / f".{process.pid}-{process.pid}-results.csv").write_text("half a li")
    resumed = run_bench(
        dataset, format=LAYOUT, methods=["patchcore-fpfh"], out=tmp_path / "out", seeds=[0]
    )
    assert not list(left_behind(tmp_path / "out"))
    fresh = run_bench(
        dataset, format=LAYOUT, methods=["patchcore-fpfh"], out=tmp_path / "fresh", seeds=[0]
    )
    assert [without_times(row) for row in resumed.rows] == [
        without_times(row) for row in fresh.rows
    ]


@pytest.mark.slow
def test_jobs_change_nothing_but_time(dataset: Path, tmp_path: Path) -> None:
    one = run_bench(dataset, format=LAYOUT, methods=["btf-raw"], out=tmp_path / "1", seeds=[0, 1])
    two = run_bench(
        dataset, format=LAYOUT, methods=["btf-raw"], out=tmp_path / "2", seeds=[0, 1], jobs=2
    )
    assert [without_times(row) for row in one.rows] == [without_times(row) for row in two.rows]


def test_what_cannot_be_run_is_refused(dataset: Path, tmp_path: Path) -> None:
    def run(**change: object) -> None:
        said = {"format": LAYOUT, "methods": ["btf-raw"], "out": tmp_path / "out", "seeds": [0]}
        run_bench(dataset, **{**said, **change})  # type: ignore[arg-type]

    with pytest.raises(InputError, match="method 'xyz' is unknown"):
        run(methods=["btf-raw", "xyz"])
    with pytest.raises(InputError, match="at least one job"):
        run(jobs=0)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text('{"format": "another"}')
    with pytest.raises(InputError, match="another data set"):
        run()


def test_a_corrupt_cloud_stops_the_run_and_names_the_file(dataset: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(dataset, tmp_path / "set")
    bad = sorted((tmp_path / "set" / "block" / "test").glob("*good*.pcd"))[-1]
    bad.write_bytes(bad.read_bytes()[:-50])
    with pytest.raises(InputError, match=bad.name):
        run_bench(
            tmp_path / "set", format=LAYOUT, methods=["btf-raw"], out=tmp_path / "out", seeds=[0]
        )
    assert list((tmp_path / "out" / "partial").rglob("*.npz"))  # what was done is kept
