"""Our own method on a small data set of ours: it tells broken from whole."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.align.options import PUBLISHED_PAM, RELEASED_PAM
from amrepair.bench.house import repair_distance
from amrepair.bench.method import ClassInput
from amrepair.bench.options import DEFAULT_HOUSE
from amrepair.bench.paper import BENCH_PAPER, make_pam_aligner, pam_options
from amrepair.bench.runner import run_bench
from amrepair.bench.samples import Format
from amrepair.bench.synth import SynthOptions, synthesize
from amrepair.errors import InputError
from amrepair.frames import rotation_from_vector
from amrepair.template import MeshSdf

PARTS = Path(__file__).parents[2] / "examples" / "parts"
KNOB, BRACKET = PARTS / "knob.stl", PARTS / "bracket.stl"


@pytest.mark.slow
def test_pasdf_finds_defects_on_a_synthetic_set(tmp_path: Path) -> None:
    options = SynthOptions(train=1, normal=2, per_defect=1, points=4000)
    data = synthesize([KNOB], tmp_path / "set", "anomaly-shapenet", 0, options=options)
    report = run_bench(
        data, format="anomaly-shapenet", methods=["pasdf"], out=tmp_path / "out", seeds=[0]
    )
    (row,) = json.loads(report.json_path.read_text())["rows"]
    assert row["p_auroc"] > 0.8
    assert row["o_auroc"] > 0.6
    assert row["cd"] is not None


@pytest.mark.slow
def test_the_published_system_runs_by_name_and_says_what_was_shortened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    quick = replace(PUBLISHED_PAM, ransac_iterations=20_000, threshold=1.0)
    monkeypatch.setattr("amrepair.bench.paper.TARGET_POINTS", 5_000)
    monkeypatch.setattr("amrepair.bench.paper.pam_options", lambda format: quick)
    coarse = replace(DEFAULT_HOUSE, surface_spacing_mm=2.0)
    monkeypatch.setattr("amrepair.bench.house.DEFAULT_HOUSE", coarse)
    options = SynthOptions(train=1, normal=1, per_defect=1, points=5000)
    data = synthesize([BRACKET], tmp_path / "set", "anomaly-shapenet", 0, options=options)
    short = replace(BENCH_PAPER, epochs=16, batch=256, rate=1e-3, dropout=0.0, width=128)
    report = run_bench(
        data,
        format="anomaly-shapenet",
        methods=["pasdf-paper", "btf-raw+pam"],
        out=tmp_path / "out",
        seeds=[0],
        paper=short,
    )
    said = json.loads(report.json_path.read_text())
    rows = {row["method"]: row for row in said["rows"]}
    assert set(rows) == {"pasdf-paper", "btf-raw+pam"}
    # a few dozen steps and a lenient alignment: better than a coin is all that is asked
    assert rows["pasdf-paper"]["p_auroc"] > 0.55
    assert rows["pasdf-paper"]["to_surface"] > 0
    assert rows["btf-raw+pam"]["badly_aligned"] is not None
    assert said["paper_recipe"]["epochs"] == 16
    assert "epochs 16 instead of 2000" in report.markdown_path.read_text()
    with pytest.raises(InputError, match="another recipe"):
        run_bench(
            data,
            format="anomaly-shapenet",
            methods=["pasdf-paper"],
            out=tmp_path / "out",
            seeds=[0],
            paper=replace(short, epochs=17),
        )


def ball(radius_mm: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=radius_mm)


@pytest.mark.slow
def test_repair_is_measured_to_the_surface_beside_the_sampling_floor() -> None:
    data = ClassInput("ball", Format.SHAPENET, (np.zeros((1, 3)),), ball(15.0), 0.1, 1.0)
    rng = np.random.default_rng(0)
    same = repair_distance(MeshSdf.from_mesh(ball(15.0)), data, rng)
    larger = repair_distance(MeshSdf.from_mesh(ball(15.15)), data, rng)
    assert same is not None
    assert larger is not None
    # the same surface, sampled twice: Chamfer says 0.01 radii, point to surface nearly nothing
    assert same.chamfer > 0.005
    assert same.to_surface == pytest.approx(0.0, abs=2e-4)
    assert larger.to_surface == pytest.approx(0.01, abs=3e-4)
    assert larger.from_surface == pytest.approx(0.01, abs=3e-4)


@pytest.mark.slow
def test_pam_brings_a_cloud_onto_its_class() -> None:
    part = trimesh.load(KNOB, force="mesh")
    part.apply_scale(100.0 / float(np.linalg.norm(part.extents)))
    points = np.asarray(trimesh.sample.sample_surface(part, 6000, seed=1)[0])
    data = ClassInput("knob", Format.SHAPENET, (points,), part, 0.05, 1.0)
    place = make_pam_aligner(data, 0, Path())
    turn = rotation_from_vector(np.array([0.5, 1.0, -1.5]))
    placed, residual = place(points @ turn.T + 20.0, np.random.default_rng(0))
    assert placed.shape == points.shape
    assert np.median(residual) < 1.0
    # single views have nothing near most of the template: only the directed loss can end there
    assert pam_options(Format.SHAPENET) == PUBLISHED_PAM
    # the released configuration of that set (config_files/test_Real3D_AD.yaml: cd_threshold)
    assert pam_options(Format.REAL3D) == replace(RELEASED_PAM, threshold=1.8)
