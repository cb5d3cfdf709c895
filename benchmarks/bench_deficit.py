"""From template and scan to deficit: time of each stage on 500,000 points, beside a plain boolean.

Run: python benchmarks/bench_deficit.py [--runs 5]. The peer is the classic way without a
distance field: manifold3d's template minus the (true, noise-free) as-built mesh: what one would
pay for the boolean alone, given a perfect reconstruction for nothing.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import manifold3d
import numpy as np
import trimesh

from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.regions import detect
from amrepair.scans import Scan
from amrepair.template.mesh_sdf import MeshSdf

POINTS = 500_000
SIGMA_MM = 0.04


def timed(work: Callable[[], object], runs: int) -> tuple[float, float]:
    """Median and spread (max − min), seconds, after one warm-up."""
    work()
    seconds = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds), max(seconds) - min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args().runs
    stl = Path(__file__).parents[1] / "examples" / "parts" / "bracket.stl"
    mesh = trimesh.load(stl, force="mesh")
    body = manifold3d.Manifold(
        manifold3d.Mesh64(
            np.array(mesh.vertices, np.float64), np.array(mesh.faces, dtype=np.uint64)
        )
    )
    corner = np.asarray(mesh.bounds)[1]
    cut = manifold3d.Manifold.cube((16, 16, 16), True).translate(corner)
    built = body - cut
    out = built.to_mesh64()
    shape = trimesh.Trimesh(np.asarray(out.vert_properties)[:, :3], np.asarray(out.tri_verts))
    points, face = trimesh.sample.sample_surface(shape, POINTS, seed=0)
    noise = np.random.default_rng(0).normal(0, SIGMA_MM, len(points))
    scan = Scan(
        np.asarray(points + noise[:, None] * shape.face_normals[face]), SIGMA_MM, "template"
    )
    template = MeshSdf.from_mesh(mesh)
    pose = Transform.identity("build", "template")
    anomaly = detect(scan, template)
    deficit = compute_deficit(scan, template, anomaly, build_from_template=pose)
    true_mm3 = (body - built).volume()
    print(f"{platform.processor() or platform.machine()}, {POINTS} points, {runs} runs")
    print(f"missing: true {true_mm3:.1f} mm3, found {deficit.missing_mm3:.1f} mm3")

    def peer() -> float:
        return float((body - built).volume())

    stages: dict[str, Callable[[], object]] = {
        "detect": lambda: detect(scan, template),
        "deficit": lambda: compute_deficit(scan, template, anomaly, build_from_template=pose),
        "peer: boolean of perfect meshes": peer,
    }
    for name, work in stages.items():
        median_s, spread_s = timed(work, runs)
        print(f"{name:32s} {median_s:6.3f} s  spread {spread_s:.3f} s")


if __name__ == "__main__":
    main()
