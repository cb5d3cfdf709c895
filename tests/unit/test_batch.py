"""A batch: each content once, bad scans as rows, the same table however it was made."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from contextlib import closing
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import batch_workers
import numpy as np
import pytest
from batch_bench import (
    bracket,
    lug,
    results,
    sums_files,
    tables,
    write_scan,
    write_scans,
    write_template,
)
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from amrepair.batch import BatchKind, BatchOptions, run_batch
from amrepair.batch import places as batch_places
from amrepair.batch import pool as batch_pool
from amrepair.batch.cells import UNIT_MM, CellSums, PartCells
from amrepair.batch.entries import Entry, read_entries
from amrepair.batch.executors import make_executor
from amrepair.batch.on_ray import _joined
from amrepair.batch.options import Task, TaskOutcome, TemplateFile, Work
from amrepair.batch.pool import Pool
from amrepair.batch.table import as_parquet, row_of
from amrepair.errors import AmrepairError, InputError, MissingDependencyError
from amrepair.template import open_template
from gcode import whole

DETECT = BatchOptions(BatchKind.DETECT)


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Template, and nine scans with a twin, a bad one and a strange one."""
    here = tmp_path_factory.mktemp("batch")
    write_template(here / "lug.safetensors")
    write_template(here / "bracket.safetensors", bracket())
    scans = write_scans(here / "scans", 7)
    shutil.copy(scans / "00003.ply", scans / "twin-of-3.ply")
    (scans / "bad.ply").write_text("nothing\n")
    (scans / ".hidden.ply").write_text("nothing\n")
    return here


@pytest.fixture(scope="module")
def serial(ready: Path) -> Path:
    out = ready / "serial"
    report = run_batch(
        str(ready / "scans"), options=DETECT, template=ready / "lug.safetensors", out=str(out),
        executor="serial",
    )  # fmt: skip
    assert (report.computed, report.known, report.repeated, report.refused) == (8, 0, 1, 1)
    return out


def rows_of(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO((out / "table.csv").read_text())))


def test_rows_say_what_is_there(serial: Path) -> None:
    rows = {row["name"]: row for row in rows_of(serial)}
    assert list(rows) == sorted(rows)
    pocket = 6.0 * 6.0 * 2.0  # mm³, of the deep ones; points lie 0.7 mm apart
    assert float(rows["00003.ply"]["missing_mm3"]) == pytest.approx(
        pocket, rel=0.15
    )  # points 0.7 mm apart
    assert rows["00003.ply"]["worst_label"] == "missing"
    place = [float(rows["00003.ply"][f"worst_{axis}_mm"]) for axis in "xyz"]
    assert place == pytest.approx([17.0, 13.0, 3.0], abs=0.5)  # the template's own frame
    assert float(rows["00001.ply"]["missing_mm3"]) == 0.0
    twin, first = rows["twin-of-3.ply"], rows["00003.ply"]
    assert {**twin, "name": ""} == {**first, "name": ""}
    assert rows["bad.ply"]["status"] == "refused"
    assert rows["bad.ply"]["sentence"].startswith("bad.ply: not a PLY file")
    assert ".hidden.ply" not in rows


@pytest.mark.slow
def test_spawned_workers_and_a_killed_one_come_to_the_same(
    ready: Path, serial: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    killed: list[int] = []
    handed_out = Pool._hand_out

    def kill_one(self: Pool, queue: Any) -> None:
        handed_out(self, queue)
        busy = [one for one in self._workers if one.task is not None]
        if busy and not killed:
            killed.append(busy[0].process.pid or 0)
            os.kill(killed[0], signal.SIGKILL)

    monkeypatch.setattr(Pool, "_hand_out", kill_one)
    out = ready / "process"
    report = run_batch(
        str(ready / "scans"), options=DETECT, template=ready / "lug.safetensors", out=str(out),
        workers=1,
    )  # fmt: skip
    assert killed
    assert report.computed == 8
    assert tables(out) == tables(serial)
    assert results(out) == results(serial)
    assert sums_files(out) == sums_files(serial)


def test_ray_comes_to_the_same_with_a_worker_killed(ready: Path, serial: Path) -> None:
    pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    from amrepair.batch.on_ray import OnRay

    outcomes = OnRay.outcomes
    killed: list[int] = []

    def kill_one(self: OnRay, tasks: Iterator[Task]) -> Iterator[TaskOutcome]:
        for outcome in outcomes(self, tasks):
            yield outcome
            if not killed:
                killed.extend(_ray_workers()[:1])
                os.kill(killed[0], signal.SIGKILL)

    out = ready / "ray"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OnRay, "outcomes", kill_one)
        run_batch(
            str(ready / "scans"), options=DETECT, template=ready / "lug.safetensors",
            out=str(out), executor="ray", workers=2,
        )  # fmt: skip
    assert killed
    assert tables(out) == tables(serial)
    assert results(out) == results(serial)
    assert sums_files(out) == sums_files(serial)


def _ray_workers() -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if words.startswith(b"ray::_Holder"):
                found.append(int(entry.name))
    return found


def test_nothing_is_done_twice(ready: Path, serial: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    shutil.copytree(serial, out)
    before = {p: p.stat().st_mtime_ns for p in (out / "results").glob("*/*")}
    gone = sorted(before)[:4]
    for path in gone:
        path.unlink()
    report = run_batch(
        str(ready / "scans"), options=DETECT, template=ready / "lug.safetensors", out=str(out),
        executor="serial",
    )  # fmt: skip
    left = len({p.stem for p in gone if p.suffix == ".json"})
    assert report.computed == left
    assert report.known == 8 - left
    assert tables(out) == tables(serial)
    kept = [p for p in before if p.stem not in {one.stem for one in gone}]
    assert all(p.stat().st_mtime_ns == before[p] for p in kept)


def test_other_options_are_other_results(ready: Path) -> None:
    template = TemplateFile("lug", "a", ready / "lug.safetensors")
    one, other = (
        Work(DETECT, (template,)),
        Work(BatchOptions(BatchKind.DETECT, seed=1), (template,)),
    )
    changed = Work(DETECT, (TemplateFile("lug", "b", ready / "lug.safetensors"),))
    assert len({work.fingerprint() for work in (one, other, changed)}) == 3


def test_align_and_repair(ready: Path, tmp_path: Path) -> None:
    common = {"template": ready / "lug.safetensors", "executor": "serial"}
    folder = tmp_path / "scans"
    folder.mkdir()
    shutil.copy(ready / "scans" / "00003.ply", folder)
    done = run_batch(
        str(folder), options=BatchOptions(BatchKind.ALIGN), out=str(tmp_path / "a"), **common
    )
    pose = np.array(json.loads(done.rows[0]["template_from_scan"]))
    assert pose[:3, 3] == pytest.approx([-50, -60, 0], abs=0.05)
    done = run_batch(
        str(folder), options=BatchOptions(BatchKind.REPAIR), out=str(tmp_path / "r"), **common
    )
    row = done.rows[0]
    assert row["status"] == "ok", row["sentence"]
    assert row["worst_x_mm"] == pytest.approx(17.0, abs=0.5)  # not the bed's
    program = (tmp_path / "r" / row["gcode"]).read_text()
    assert "G28 X Y" in program
    assert not row["within_tolerance"]


# ---- what many scans say of a place --------------------------------------------------------------


def test_sums_are_the_same_in_any_order(serial: Path) -> None:
    each = [CellSums.from_bytes(data) for data in sums_files(serial).values()]
    forward, backward = each[0], each[-1]
    for one in each[1:]:
        forward += one
    for one in each[-2::-1]:
        backward += one
    assert (forward.table == backward.table).all()


def test_sums_hold_every_volume_where_it_is(ready: Path, serial: Path) -> None:
    cells = PartCells.of(open_template(ready / "lug.safetensors"))
    total = CellSums.zero(len(cells))
    for data in sums_files(serial).values():
        total += CellSums.from_bytes(data)
    told = {row["scan_id"]: float(row["missing_mm3"] or 0) for row in rows_of(serial)}
    assert total.volume_mm3("missing").sum() == pytest.approx(sum(told.values()), abs=1e-5)
    where = np.average(cells.place_mm, axis=0, weights=total.volume_mm3("missing"))
    assert where[:2] == pytest.approx([17.0, 13.0], abs=0.7)
    held = total.volume_mm3("missing") > 0
    outside = np.maximum(np.abs(cells.place_mm[:, :2] - (17, 13)).max(axis=1) - 3.0, 0)
    assert outside[held].max() < 3 * cells.spacing_mm
    assert total.column("seen").max() == 7  # good scans; a twin is one content
    deep = held & (total.column("missing") == 3)
    seen = np.maximum(total.column("seen"), 1)
    mean_mm = UNIT_MM * total.column("deviation") / seen
    assert mean_mm[deep].min() < -0.4
    sound = (total.column("seen") == 7) & (total.column("missing") == 0)
    assert np.abs(mean_mm[sound]).max() < 0.1


@given(
    table=st.lists(
        st.lists(st.integers(-(2**40), 2**40), min_size=7, max_size=7), min_size=1, max_size=5
    ),
    split=st.integers(0, 5),
)
def test_adding_is_exact(table: list[list[int]], split: int) -> None:
    rows = [CellSums(np.array([row], np.int64)) for row in table]
    zero = CellSums.zero(1)
    left = sum(rows[:split], zero)
    right = sum(rows[split:], zero)
    assert (left + right).table[0].tolist() == np.array(table, object).sum(axis=0).tolist()
    assert (CellSums.from_bytes((left + right).to_bytes()).table == (left + right).table).all()


def test_sums_of_another_template_are_refused() -> None:
    with pytest.raises(InputError, match="another template"):
        CellSums.zero(3) + CellSums.zero(4)


# ---- manifests and bad input ---------------------------------------------------------------------


def test_a_manifest_with_missing_files_is_rows(ready: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "monday.csv"
    good = ready / "scans" / "00001.ply"
    manifest.write_text(f"path,time,label\n{good},2026-11-24T10:00:00,mk3\nnone.ply,,\n")
    report = run_batch(
        str(manifest), options=DETECT, template=ready / "lug.safetensors",
        out=str(tmp_path / "out"), executor="serial",
    )  # fmt: skip
    good_row, bad_row = report.rows
    assert (good_row["label"], good_row["time"]) == ("mk3", "2026-11-24T10:00:00")
    assert bad_row["sentence"] == "none.ply: there is no such file"
    assert report.refused == 1
    assert "1 of 2 scans" in report.notes[-1]


def test_json_lines_are_a_manifest_too(tmp_path: Path) -> None:
    path = tmp_path / "list.jsonl"
    path.write_text('{"path": "b.ply", "label": 3}\n\n{"path": "a.ply"}\n')
    assert [(e.name, e.label) for e in read_entries(str(path))] == [("a.ply", ""), ("b.ply", "3")]
    assert read_entries(str(path))[0].uri == str(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "file\nx.ply\n", "has no column 'path'"),
        ("a.csv", "path\n", "names no scan"),
        ("a.csv", "path,time\nx.ply,yesterday\n", "line 2: the time is 'yesterday'"),
        ("a.csv", "path\nx.ply\nx.ply\n", "line 3: x.ply is named in line 2 already"),
        ("a.jsonl", "{\n", "line 1 is no JSON"),
        ("a.jsonl", "[]\n", "line 1 is no JSON object"),
        ("a.jsonl", "{}\n", "line 1 names no path"),
    ],
)
def test_manifests_that_cannot_be_used(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=said):
        read_entries(str(tmp_path / name))


def test_folders_that_cannot_be_used(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no scan"):
        read_entries(str(tmp_path))
    with pytest.raises(InputError, match="there is no such folder"):
        read_entries(str(tmp_path / "none"))


@pytest.mark.slow
def test_another_part_is_a_row_with_its_sentence(ready: Path, tmp_path: Path) -> None:
    import trimesh

    folder = tmp_path / "scans"
    folder.mkdir()
    ball = trimesh.creation.icosphere(subdivisions=3, radius=14.0)
    ball.apply_translation((0, 0, 14.0))
    write_scan(folder / "ball.ply", ball, 1)
    shutil.copy(ready / "scans" / "00001.ply", folder)
    report = run_batch(
        str(folder), options=DETECT, template=ready / "lug.safetensors",
        out=str(tmp_path / "out"), executor="serial",
    )  # fmt: skip
    assert [row["status"] for row in report.rows] == ["ok", "refused"]
    assert "ball.ply" in report.rows[1]["sentence"]


@pytest.mark.slow
def test_mixed_parts_are_told_apart_and_what_fits_none_is_a_row(
    ready: Path, tmp_path: Path
) -> None:
    """With a folder of templates each scan is held against its own part."""
    import trimesh

    library, folder = tmp_path / "templates", tmp_path / "scans"
    library.mkdir()
    folder.mkdir()
    for part in ("lug", "bracket"):
        shutil.copy(ready / f"{part}.safetensors", library)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=14.0)
    for name, part in (("ball", ball), ("bracket", bracket()), ("lug", lug(2.0))):
        write_scan(folder / f"{name}.ply", part, 1)
    report = run_batch(
        str(folder), options=DETECT, template=library, out=str(tmp_path / "out"),
        executor="serial",
    )  # fmt: skip
    strange, *known = report.rows
    assert [row["template"] for row in known] == ["bracket", "lug"]
    assert all(row["confidence"] > 0.5 for row in known)
    assert [row["missing_mm3"] > 30.0 for row in known] == [False, True]  # the lug's pocket
    assert strange["sentence"].startswith("the scan ball.ply fits none of the 2 parts")
    assert report.refused == 1


@pytest.mark.slow
def test_a_template_that_fits_none_is_told_and_is_no_success(ready: Path, tmp_path: Path) -> None:
    from amrepair.cli.app import app

    (tmp_path / "scans").mkdir()
    shutil.copy(ready / "scans" / "00001.ply", tmp_path / "scans")
    words = ["batch", "align", str(tmp_path / "scans"), "--out", str(tmp_path / "out")]
    words += ["--template", str(ready / "bracket.safetensors"), "--executor", "serial"]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("OMP", "NUMBA", "MKL", "OPENBLAS"):
            patch.setenv(f"{name}_NUM_THREADS", "1")
        done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    (row,) = rows_of(tmp_path / "out")
    assert row["status"] == "refused"
    assert "00001.ply" in row["sentence"]
    assert "1 of 1 scans have a sentence instead of figures" in " ".join(done.output.split())


def test_a_full_disk_is_one_sentence_and_what_is_done_stays(
    ready: Path, serial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    real, written = os.fsync, []

    def full(descriptor: int) -> None:
        written.append(descriptor)
        if len(written) > 9:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(descriptor)

    common = {"options": DETECT, "template": ready / "lug.safetensors", "executor": "serial"}
    with monkeypatch.context() as patch:
        patch.setattr(whole.os, "fsync", full)
        with pytest.raises(InputError, match=r"No space left.*results of 9 scans are kept"):
            run_batch(str(ready / "scans"), out=str(out), **common)
    done = results(out)
    assert 0 < len(done) < 8
    assert not list(out.rglob(".*.json"))
    report = run_batch(str(ready / "scans"), out=str(out), **common)
    assert report.known == len(done)
    assert tables(out) == tables(serial)


def test_two_batches_do_not_work_in_one_folder(ready: Path, tmp_path: Path) -> None:
    with (
        batch_places.Folder(tmp_path).alone(),
        pytest.raises(InputError, match="another batch works in"),
    ):
        run_batch(
            str(ready / "scans"), options=DETECT, template=ready / "lug.safetensors",
            out=str(tmp_path),
        )  # fmt: skip


def test_a_task_that_kills_its_workers_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each attempt has a worker of its own, and the other tasks are done all the same."""
    monkeypatch.setattr(batch_pool, "_serve", batch_workers.mortal)
    tasks = [Task(f"{k}", "bad" if k == 1 else "good", "") for k in range(4)]
    with closing(Pool(Work(DETECT, ()), workers=2)) as pool:
        said = {one.scan_id: one for one in pool.outcomes(iter(tasks))}
        workers = pool.processes
    assert sorted(said) == ["0", "1", "2", "3"]
    assert said["1"].sentence.startswith("{scan} ended its worker 3 times (out of memory?)")
    assert not said["1"].lasting
    assert all(not said[k].sentence for k in "023")
    assert not any(Path(f"/proc/{one}").exists() for one in workers)


def test_workers_that_cannot_begin_are_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch_pool, "_serve", batch_workers.stillborn)
    with (
        closing(Pool(Work(DETECT, ()), workers=1)) as pool,
        pytest.raises(AmrepairError, match=r"3 workers died .* code 7"),
    ):
        list(pool.outcomes(iter([Task("0", "good", "")])))


def test_executors_that_cannot_be_had(monkeypatch: pytest.MonkeyPatch) -> None:
    work = Work(DETECT, ())
    with pytest.raises(InputError, match="one of process, serial, ray"):
        make_executor("threads", work)
    with pytest.raises(InputError, match="--address belongs to --executor ray"):
        make_executor("serial", work, address="auto")
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'amrepair\[ray\]'"):
        make_executor("ray", work)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("Version mismatch: The cluster was started with:\n Ray: 2.9.0"),
         "runs another version of Ray .*here Ray 2.60.*The cluster was started with: Ray: 2.9.0"),
        (ConnectionError("Could not find any running Ray instance"),
         "Ray cannot be used at head:6379 .*Could not find any"),
    ],
)  # fmt: skip
def test_a_cluster_that_cannot_be_used_is_one_sentence(error: Exception, said: str) -> None:
    def init(**_: object) -> None:
        raise error

    with pytest.raises(InputError, match=said):
        _joined(SimpleNamespace(init=init, __version__="2.60.0"), "head:6379", None)


# ---- table, page, command ------------------------------------------------------------------------


def test_parquet_is_the_table_or_a_word(serial: Path) -> None:
    rows = [row_of(Entry("a", "a"), "", {}, "{scan} is bad")]
    data = as_parquet(rows, BatchKind.DETECT)
    if data is None:
        assert "table.parquet is not written" in (serial / "batch.json").read_text()
        pytest.skip("the extra 'batch' is not installed")
    import pyarrow.parquet as pq

    table = pq.read_table(io.BytesIO(data))
    assert table.column("sentence").to_pylist() == ["a is bad"]
    whole = pq.read_table(serial / "table.parquet")
    assert whole.column("name").to_pylist() == [row["name"] for row in rows_of(serial)]
    missing = [float(row["missing_mm3"]) if row["missing_mm3"] else None for row in rows_of(serial)]
    assert whole.column("missing_mm3").to_pylist() == missing


def test_the_overview_fetches_nothing_and_names_the_worst(serial: Path) -> None:
    page = (serial / "overview.html").read_text()
    assert "default-src 'none'" in page
    assert "<script" not in page
    assert "http" not in page.replace("http-equiv", "")
    worst = page[page.index("The worst") :]
    assert worst.index("00003.ply") < worst.index("00000.ply")  # the deeper one first
    assert "not a PLY file" in page

    class Balanced(HTMLParser):
        depth = 0

        def handle_starttag(self, tag: str, attrs: object) -> None:
            self.depth += tag not in {"meta", "rect"}

        def handle_endtag(self, tag: str) -> None:
            self.depth -= tag not in {"meta", "rect"}

        def handle_startendtag(self, tag: str, attrs: object) -> None: ...

    parser = Balanced()
    parser.feed(page)
    assert parser.depth == 0


def test_the_command_tells_and_goes_on(ready: Path, serial: Path, tmp_path: Path) -> None:
    from amrepair.cli.app import app

    out = tmp_path / "out"
    shutil.copytree(serial, out)
    words = ["batch", "detect", str(ready / "scans"), "--template", str(ready / "lug.safetensors")]
    with pytest.MonkeyPatch.context() as patch:
        for name in ("OMP", "NUMBA", "MKL", "OPENBLAS"):
            patch.setenv(f"{name}_NUM_THREADS", "1")
        done = CliRunner().invoke(app, [*words, "--out", str(out), "--executor", "serial"])
        assert done.exit_code == 0, done.output
        assert "9 scans: 0 judged now, 8 known before, 1 of the same bytes" in done.output
        (tmp_path / "bad").mkdir()
        (tmp_path / "bad" / "a.ply").write_text("no")
        words[2] = str(tmp_path / "bad")
        done = CliRunner().invoke(
            app, [*words, "--out", str(tmp_path / "b"), "--executor", "serial"]
        )
    assert done.exit_code == 2


def test_stores_are_read_and_written(ready: Path, serial: Path) -> None:
    """In memory here; against a server of S3's kind where one is installed."""
    fsspec = pytest.importorskip("fsspec", reason="the extra 'store' is not installed")
    memory = fsspec.filesystem("memory")
    memory.put(str(ready / "scans"), "/lab/scans", recursive=True)
    run_batch(
        "memory://lab/scans", options=DETECT, template=ready / "lug.safetensors",
        out="memory://lab/out", executor="serial",
    )  # fmt: skip
    assert memory.cat_file("/lab/out/table.csv") == tables(serial)[0]
    again = run_batch(
        "memory://lab/scans", options=DETECT, template=ready / "lug.safetensors",
        out="memory://lab/out", executor="serial",
    )  # fmt: skip
    assert (again.computed, again.known) == (0, 8)
