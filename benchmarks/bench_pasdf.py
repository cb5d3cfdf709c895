"""Alignment and detection beside their peers, in one run.

Run: python benchmarks/bench_pasdf.py [--align 10] [--views 10] [--parts NAME…] [--defects 1]
[--normal 3] [--paper NAME=VALUE…] [--out DIR]. Alignment: scans of 200,000 points in random poses,
noise 0.05 mm, a ball of 5 mm missing, the whole surface or what one sensor sees; success is an RMSE
under 0.1 mm to the true pose. Detection: a synthetic set, `pasdf`, `pasdf-paper` (shortened) and
`patchcore-fpfh+pam`, with the repair template's distances. Zero of anything skips it.
"""

from __future__ import annotations

import argparse
import os
import platform
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from amrepair.align import align
from amrepair.bench import SynthOptions, run_bench, synthesize
from amrepair.bench.paper import BENCH_PAPER
from amrepair.cli.options import with_settings
from amrepair.errors import AlignmentError
from amrepair.frames import rotation_from_vector
from amrepair.scans import Scan
from amrepair.simulate.part_files import part_names, part_path
from amrepair.template import MeshSdf, load_mesh, load_or_fit
from amrepair.template.paper import NETWORK_VARIANTS

POINTS, SIGMA_MM, BALL_MM, GOOD_MM = 200_000, 0.05, 5.0, 0.1
METHODS = ("pasdf", "pasdf-paper", "patchcore-fpfh+pam")


def random_turn(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return rotation_from_vector(rng.uniform(0, np.pi) * axis / np.linalg.norm(axis))


def seen_from(points: np.ndarray, exact: MeshSdf, rng: np.random.Generator) -> np.ndarray:
    """Points with a free line to a sensor 300 mm away, somewhere."""
    way = rng.normal(size=3)
    sensor = exact.bounds_mm.mean(axis=0) + 300.0 * way / np.linalg.norm(way)
    to_sensor = sensor - points
    to_sensor /= np.linalg.norm(to_sensor, axis=1, keepdims=True)
    blocked = exact.mesh.ray.intersects_any(points + 0.02 * to_sensor, to_sensor)
    return points[~blocked]


def scan_of(exact: MeshSdf, seed: int, *, view: bool) -> tuple[Scan, np.ndarray]:
    """A scan in a random pose, and its points where they belong."""
    rng = np.random.default_rng(seed)
    count = POINTS * (3 if view else 1)
    points = np.asarray(trimesh.sample.sample_surface(exact.mesh, count, seed=seed)[0])
    if view:
        points = seen_from(points, exact, rng)[:POINTS]
    points = points[
        np.linalg.norm(points - points[int(rng.integers(len(points)))], axis=1) > BALL_MM
    ]
    points = points + rng.normal(0, SIGMA_MM, points.shape)
    moved = points @ random_turn(rng).T + rng.normal(0, 100, 3)
    return Scan(moved, SIGMA_MM, "scanner", source=f"scan {seed}"), points


def alignment(part: Path, scans: int, view: bool) -> None:
    exact = MeshSdf.from_mesh(load_mesh(part))
    template = load_or_fit(part)
    made = [scan_of(exact, seed, view=view) for seed in range(scans)]
    for method in ("robust", "paper"):
        good, refused, ambiguous, spent = 0, 0, 0, []
        for seed, (scan, truth) in enumerate(made):
            start = time.perf_counter()
            try:
                found = align(scan, template, method=method, rng=np.random.default_rng(seed))
            except AlignmentError:
                refused += 1
            else:
                poses = [found.template_from_scan, *found.symmetric_alternatives]
                ambiguous += len(poses) > 1
                off = found.template_from_scan.apply(scan.points_mm) - truth
                good += float(np.sqrt((off**2).sum(axis=1).mean())) < GOOD_MM
            spent.append(time.perf_counter() - start)
        print(
            f"| {part.stem}, {'one view' if view else 'whole'} | {method} | {good} of {scans} "
            f"| {refused} | {scans - good - refused} | {ambiguous} | {np.median(spent):.1f} "
            f"| {np.max(spent):.1f} |",
            flush=True,
        )


def say(stage: str, done: float, total: float) -> None:
    print(f"  {stage}: {done:.0f} of {total:.0f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--align", type=int, default=10)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument(
        "--parts", nargs="+", type=Path, default=[part_path(n) for n in part_names()]
    )
    parser.add_argument("--defects", type=int, default=1)
    parser.add_argument("--normal", type=int, default=3)
    parser.add_argument("--smallest", type=float, help="width of the smallest, of the diagonal")
    parser.add_argument("--smooth", type=float, default=0.0, help="share without an edge")
    parser.add_argument("--points", type=int, default=SynthOptions().points)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--paper", nargs="*")
    parser.add_argument("--out", type=Path)
    said = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    if said.align or said.views:
        print("| scans | method | within 0.1 mm | refused | wrong | ambiguous | median s | max s |")
        print("|---|---|---|---|---|---|---|---|")
    for part in said.parts[:2]:
        for count, view in ((said.align, False), (said.views, True)):
            if count:
                alignment(part, count, view)
    if said.defects:
        with tempfile.TemporaryDirectory() as scratch:
            out = said.out or Path(scratch)
            options = SynthOptions(
                normal=said.normal,
                per_defect=said.defects,
                points=said.points,
                smallest_ratio=said.smallest,
                smooth_ratio=said.smooth,
            )
            data = out / "data"
            if not (data / "synth.json").is_file():
                synthesize(said.parts, data, "anomaly-shapenet", 0, options=options)
            recipe = with_settings(
                {"bench": BENCH_PAPER, **NETWORK_VARIANTS}, said.paper, "--paper"
            )
            report = run_bench(
                data,
                format="anomaly-shapenet",
                methods=said.methods,
                out=out / "results",
                seeds=said.seeds,
                paper=recipe,
                progress=say,
            )
            print(report.markdown_path.read_text())
    print(f"\nload at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
