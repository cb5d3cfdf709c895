"""The methods beside each other on a synthetic set, all in one run.

Run: python benchmarks/bench_bench.py PART… [--format real3d-ad] [--methods NAME…] [--seeds 0 1 2]
[--jobs 1] [--out DIR]. Without parts it takes the example parts. Each part becomes a class with
four training clouds, six normal test samples and two of each of the six defects, in random poses.
The default methods need no alignment. A run with --out goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
from pathlib import Path

from amrepair.bench import BENCH_METHODS, SynthOptions, run_bench, synthesize
from amrepair.bench.samples import Format
from amrepair.simulate.part_files import part_names, part_path

DEFAULT_METHODS = ("btf-raw", "btf-fpfh", "patchcore-fpfh", "patchcore-fpfh-raw")


def say(stage: str, done: float, total: float) -> None:
    print(f"  {stage}: {done:.0f} of {total:.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", type=Path)
    parser.add_argument("--format", default=str(Format.SHAPENET), choices=[*Format])
    parser.add_argument("--methods", nargs="+", default=DEFAULT_METHODS, choices=BENCH_METHODS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--points", type=int, default=SynthOptions().points)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path)
    said = parser.parse_args()
    parts = said.parts or [part_path(name) for name in part_names()]
    with tempfile.TemporaryDirectory() as scratch:
        out = said.out or Path(scratch)
        data = out / "data"
        if not (data / "synth.json").is_file():
            options = SynthOptions(points=said.points)
            synthesize(parts, data, said.format, 0, options=options, progress=say)
        report = run_bench(
            data,
            format=said.format,
            methods=said.methods,
            out=out / "results",
            jobs=said.jobs,
            seeds=said.seeds,
            progress=say,
        )
        print(f"{platform.machine()}, {os.cpu_count()} cores, {len(parts)} parts × 6 defects\n")
        print(report.markdown_path.read_text())


if __name__ == "__main__":
    main()
