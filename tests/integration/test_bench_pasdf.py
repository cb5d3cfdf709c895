"""Our own method on a small data set of ours: it tells broken from whole."""

from __future__ import annotations

import json
from pathlib import Path

from amrepair.bench.runner import run_bench
from amrepair.bench.synth import SynthOptions, synthesize

KNOB = Path(__file__).parents[2] / "examples" / "parts" / "knob.stl"


def test_pasdf_finds_defects_on_a_synthetic_set(tmp_path: Path) -> None:
    options = SynthOptions(train=2, normal=2, per_defect=1, points=6000)
    data = synthesize([KNOB], tmp_path / "set", "anomaly-shapenet", 0, options=options)
    report = run_bench(
        data, format="anomaly-shapenet", methods=["pasdf"], out=tmp_path / "out", seeds=[0]
    )
    (row,) = json.loads(report.json_path.read_text())["rows"]
    assert row["p_auroc"] > 0.8
    assert row["o_auroc"] > 0.6
    assert row["cd"] is not None
