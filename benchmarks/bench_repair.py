"""From scan to checked patch, stage by stage, and the template and reader beside plain peers.

    python benchmarks/bench_repair.py [--points 500000] [--rounds 3]

Peers, in the same run: the exact field by Embree (open3d) for the learned template, and a plain
Python tokenizer for the reader. Ratios above 1 say how many times faster ours is.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path

from gcode.process import prepare

prepare()  # as the command lines do

import manifold3d as m3
import numpy as np
import trimesh

from amrepair.frames import Transform
from amrepair.repair import Site, Stopwatch, plan_repair
from amrepair.scans import Scan
from amrepair.template import MeshSdf, fit_template
from gcode.check import find_refusals
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.slicing.job import slice_part
from gcode.slicing.layers import LayerGrid
from gcode.writer import write

BRACKET = Path(__file__).parents[1] / "examples" / "parts" / "bracket.stl"


def median_s(work: Callable[[], object], rounds: int) -> float:
    """Median of `rounds` runs after one that compiles."""
    work()
    spent = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        spent.append(time.perf_counter() - start)
    return statistics.median(spent)


def plain_words(text: str) -> int:
    """What a reader in plain Python does at least: split lines into words and numbers."""
    found = 0
    for line in text.split("\n"):
        command = line.partition(";")[0]
        for word in command.split():
            try:
                float(word[1:])
            except ValueError:
                continue
            found += 1
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=500_000)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    setup = load_setup()
    start = time.perf_counter()
    template = fit_template(BRACKET)
    print(f"fit {time.perf_counter() - start:.1f} s, bias {1e3 * template.bias_mm:.0f} µm")
    exact = MeshSdf.from_mesh(template.mesh)
    rng = np.random.default_rng(0)
    points, faces = trimesh.sample.sample_surface(template.mesh, args.points, seed=0)
    near = np.asarray(points) + rng.normal(size=points.shape) * 0.05
    ours = median_s(lambda: template.distance(near), args.rounds)
    peer = median_s(lambda: exact.distance(near), args.rounds)
    print(f"{args.points} distances: {ours:.2f} s; Embree {peer:.2f} s; ratio {peer / ours:.1f}")

    corner = m3.Manifold.sphere(6.0, 64).translate((40.0, 47.5, 49.2))
    broken = template.solid() - corner
    mesh = broken.to_mesh64()
    part = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    points, faces = trimesh.sample.sample_surface(part, args.points, seed=0)
    seen = part.face_normals[faces][:, 2] > -0.5
    cloud = np.asarray(points)[seen] + rng.normal(size=(int(seen.sum()), 3)) * 0.04
    place = np.array([85.0, 80.0, 0.0])
    scan = Scan(cloud + place, 0.04, "build")
    guess = Transform.from_rotation_translation(
        "template", "build", rotation=np.eye(3), translation_mm=-place
    )
    site = Site(template, setup, LayerGrid.from_setup(setup))
    for k in range(args.rounds + 1):
        watch = Stopwatch()
        plan = plan_repair(scan, site, title="bench", guess=guess, watch=watch)
        if k:
            stages = ", ".join(f"{name} {spent:.2f}" for name, spent in watch.seconds.items())
            print(f"scan to checked patch {sum(watch.seconds.values()):.2f} s: {stages}")
    gone_mm3 = (template.solid() ^ corner).volume()
    print(f"deficit {plan.deficit.missing_mm3:.1f} of {gone_mm3:.1f} mm³")

    solid = template.solid().translate(tuple(place))
    sliced = median_s(lambda: slice_part(solid, setup), args.rounds)
    program = write(slice_part(solid, setup), setup, title="bench")
    lines = program.text.count("\n")
    read = median_s(lambda: read_job(program), args.rounds)
    plain = median_s(lambda: plain_words(program.text), args.rounds)
    judged = median_s(lambda: find_refusals(program, setup), args.rounds)
    print(f"slice a part into {lines} lines: {sliced:.2f} s; check it: {judged:.2f} s")
    print(f"read it: {read:.2f} s; plain Python words {plain:.2f} s; ratio {plain / read:.1f}")


if __name__ == "__main__":
    main()
