"""Detection on what was left out, source by source: small, partly smooth defects of six kinds.

Run: python benchmarks/bench_sources.py [--source NAME FILE…] [--method pasdf] [--normal 12]
[--defects 3] [--points 12000] [--clouds-alone] [--out DIR].

A source is a house that draws its parts its own way: parts of one are alike, so that a share of
them held back says little. Without --source it takes those of AMREPAIR_DATA/parts. Each part
becomes a class of Anomaly-ShapeNet's layout: four training clouds, noise 0.05 % of the diagonal, a
third of the samples single views; defects as wide as 1 % of the diagonal (other kinds as much
smaller than usual), half of them smooth. With --clouds-alone no class has a mesh: the template
comes from its training clouds.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from measured_page import table

from amrepair.bench import BENCH_METHODS, SynthOptions, run_bench, synthesize
from amrepair.bench.cells import ScoreRow
from amrepair.bench.samples import Format

SOURCES = {
    "Prusa i3": (
        "prusa-fan-shroud.stl",
        "prusa-y-motor-holder.stl",
        "prusa-endstop-block.stl",
        "prusa-extruder-idler.stl",
    ),
    "compas_slicer": ("bunny.stl", "distorted-vase.stl"),
    "pyslm": ("frame-guide.stl",),
    "trimesh": ("featuretype.stl",),
    "3DBenchy": ("3dbenchy.3mf",),
}
SMALLEST, SMOOTH = 0.01, 0.5
HEADER = ("source", "classes", "O", "O, worst", "P", "P, worst", "badly aligned", "s a sample")


def judged(
    name: str, parts: Sequence[Path], method: str, options: SynthOptions, out: Path
) -> tuple[object, ...]:
    """A row of the table: mean and worst class of a source."""
    data = out / "data" / name.replace(" ", "-")
    if not (data / "synth.json").is_file():
        synthesize(parts, data, str(Format.SHAPENET), 0, options=options)
    report = run_bench(
        data, format=str(Format.SHAPENET), methods=[method], out=out / "results" / name, seeds=[0]
    )
    return name, len(parts), *figures(report.rows)


def figures(rows: Sequence[ScoreRow]) -> tuple[object, ...]:
    """O and P, mean and worst, in %; samples laid badly; seconds a sample."""
    whole, point = (np.array([getattr(row, key) for row in rows]) for key in ("o_auroc", "p_auroc"))
    told = [f"{100 * value:.1f}" for one in (whole, point) for value in (one.mean(), one.min())]
    badly = sum(row.badly_aligned or 0 for row in rows)
    samples = sum(row.samples for row in rows)
    seconds = float(np.mean([row.seconds_per_sample for row in rows]))
    return *told, f"{badly} of {samples}", f"{seconds:.2f}"


def sources(said: Sequence[Sequence[str]] | None) -> Mapping[str, list[Path]]:
    """Sources by name, as said, or those of AMREPAIR_DATA."""
    if said:
        return {name: [Path(part) for part in parts] for name, *parts in said}
    folder = Path(os.environ["AMREPAIR_DATA"]) / "parts"
    return {name: [folder / part for part in parts] for name, parts in SOURCES.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", nargs="+", action="append", metavar="NAME FILE")
    parser.add_argument("--method", default="pasdf", choices=BENCH_METHODS)
    parser.add_argument("--normal", type=int, default=12)
    parser.add_argument("--defects", type=int, default=3, help="of each kind")
    parser.add_argument("--points", type=int, default=SynthOptions().points)
    parser.add_argument("--clouds-alone", action="store_true")
    parser.add_argument("--out", type=Path)
    said = parser.parse_args()
    options = SynthOptions(
        normal=said.normal,
        per_defect=said.defects,
        points=said.points,
        smallest_ratio=SMALLEST,
        smooth_ratio=SMOOTH,
        mesh=not said.clouds_alone,
    )
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n", flush=True)
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for name, parts in sources(said.source).items():
            row = judged(name, parts, said.method, options, said.out or Path(scratch))
            if said.clouds_alone:
                row = (f"{row[0]}, clouds alone", *row[1:])
            rows.append(row)
            print(table(HEADER, rows), "\n", flush=True)


if __name__ == "__main__":
    main()
