"""Partial views of parts onto each other, without a mesh: how many are placed, and how far off.

    python benchmarks/bench_views.py PART… [--ring 6] [--below 2] [--untold] [--noise-mm 0.04]

A ring of views as from a turntable, and some from below; each in a random pose of its own, with or
without the sensor's place. Off is the root mean square of a view's points from where they belong.
Held: for each view the standard deviation that is said of it across its surface, where that is
largest, and by how much it truly is off across its surface, at most, from the view held best.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from amrepair.bench.synth_views import (
    Rays,
    Shape,
    random_rotation,
    sample_shape,
    sensor_towards,
)
from amrepair.errors import AlignmentError
from amrepair.frames import moved
from amrepair.merge.place import Placement, place
from amrepair.merge.views import View
from amrepair.scans import Scan
from amrepair.template import load_mesh

WRONG_MM = 0.3
SIGMAS = 3.0
Made = list[tuple[Scan, np.ndarray]]


def main() -> None:
    """One line for each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="+", type=Path)
    parser.add_argument("--ring", type=int, default=6)
    parser.add_argument("--below", type=int, default=2)
    parser.add_argument("--untold", action="store_true", help="without the sensors' places")
    parser.add_argument("--noise-mm", type=float, default=0.04)
    parser.add_argument("--points", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    ratios: list[float] = []
    for part in options.parts:
        made = views(part, options)
        rng = np.random.default_rng(options.seed)
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            seen = [View.of(scan, rng) for scan, _ in made]
            found = place(seen, rng)
        except AlignmentError as error:
            said = f"refused: {error}"
        else:
            off = off_mm(made, found)
            verdict = "WRONG" if off.max() > WRONG_MM else "right"
            said = f"{len(off)} of {len(made)} placed, {verdict}, off {off.round(3).tolist()} mm"
            held = held_mm(made, seen, found)
            ratios += [true / sigma for sigma, true in held if sigma > 0.0]
            said += "; held " + ", ".join(f"{sigma:.3f}/{true:.3f}" for sigma, true in held)
            said += "".join(f"; {made[k][0].source} {why}" for k, why in found.left_out.items())
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        print(f"{part.stem}: {said}; {wall:.0f} s, {cpu:.0f} s of processor time", flush=True)
    if ratios:
        share = float((np.array(ratios) <= SIGMAS).mean())
        print(f"{share:.1%} of {len(ratios)} views within {SIGMAS:g} sigma, most {max(ratios):.1f}")


def views(part: Path, options: argparse.Namespace) -> Made:
    """Scans, and (4, 4) scan from part."""
    mesh = load_mesh(part)
    faces = np.array(mesh.faces)
    shape = Shape(np.array(mesh.vertices), faces, np.zeros((len(faces), 3)))
    rays, turn = Rays(shape), np.random.default_rng(options.seed)
    made: Made = []
    for count, height in ((options.ring, 0.7), (options.below, -0.8)):
        first = turn.uniform(0.0, 2.0 * np.pi)
        for k in range(count):
            angle = first + 2.0 * np.pi * k / count
            rng = np.random.default_rng(1000 * options.seed + len(made))
            sensor = sensor_towards(shape, np.array([np.cos(angle), np.sin(angle), height]))
            cloud = sample_shape(shape, 8 * options.points, rng)
            points = cloud.take(rays.seen(cloud, sensor)).points_mm
            points = points[rng.permutation(len(points))[: options.points]]
            points = points + rng.normal(0.0, options.noise_mm, points.shape)
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = random_rotation(rng), rng.normal(0.0, 100.0, 3)
            told = None if options.untold else moved(sensor, pose)
            index = None if options.untold else np.zeros(len(points), np.int64)
            scan = Scan(moved(points, pose), options.noise_mm, "scanner", sensors_mm=told,
                        sensor_index=index, source=f"view{len(made)}")  # fmt: skip
            made.append((scan, pose))
    return made


def off_mm(made: Made, found: Placement) -> np.ndarray:
    """(k,) of each placed view; in the frame of the one that most others agree with."""
    every = []
    for home, base in found.poses.items():
        common_from_part = base @ made[home][1]
        row = []
        for k, pose in found.poses.items():
            scan, from_part = made[k]
            points = scan.points_mm[::40]
            truth = moved(points, common_from_part @ np.linalg.inv(from_part))
            squares = ((moved(points, pose) - truth) ** 2).sum(axis=1)
            row.append(float(np.sqrt(squares.mean())))
        every.append(row)
    table = np.array(every)
    return np.asarray(table[int(np.argmin(np.median(table, axis=1)))])


def held_mm(made: Made, views: list[View], found: Placement) -> list[tuple[float, float]]:
    """Of each placed view, what is said of it and what is true, across its surface."""
    home = min(found.slacks, key=lambda k: float(np.trace(found.slacks[k].covariance)))
    common_from_part = found.poses[home] @ made[home][1]
    told = []
    for k, pose in found.poses.items():
        surface = views[k].surface
        points, normals = surface.points_mm[::40], surface.normals[::40]
        truth = moved(points, common_from_part @ np.linalg.inv(made[k][1]))
        across = ((moved(points, pose) - truth) * (normals @ pose[:3, :3].T)).sum(axis=1)
        said = 0.0 if k == home else found.slacks[k].sigma_mm
        told.append((said, float(np.abs(across).max())))
    return told


if __name__ == "__main__":
    main()
