"""Partial views of parts onto each other, without a mesh: how many are placed, and how far off.

    python benchmarks/bench_views.py PART… [--ring 6] [--below 2] [--untold] [--noise-mm 0.04]
    python benchmarks/bench_views.py --real FOLDER/POSES.conf [--seeds 3]

A ring of views as from a turntable, and some from below; each in a random pose of its own, with or
without the sensor's place. Off is the root mean square of a view's points from where they belong.
Held: for each view the standard deviation that is said of it across its surface, where that is
largest, and by how much it truly is off across its surface, at most, from the view held best.
Real views are a folder's, whose file of poses is the truth as far as its makers knew it: templates
are fitted from the bare views and with the poses told, each in a process of its own. Since the
makers' registration errs too, it is also told how far apart the surfaces of two views lie, as we
place them and as they did.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

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
from amrepair.merge.told import of_views, read_poses
from amrepair.merge.views import View
from amrepair.scans import Scan, read_scan
from amrepair.template import load_mesh

WRONG_MM = 0.3
SIGMAS = 3.0
HEAD_ON, SAME_FACE = 0.6, 0.9  # cosines: of incidence, and of two normals
PATCH_MM, PATCH_POINTS = 6.0, 20
Made = list[tuple[Scan, np.ndarray]]


def main() -> None:
    """One line for each part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", type=Path)
    parser.add_argument("--real", nargs="*", type=Path, default=[], help="files of poses")
    parser.add_argument("--seeds", type=int, default=1, help="of real views")
    parser.add_argument("--ring", type=int, default=6)
    parser.add_argument("--below", type=int, default=2)
    parser.add_argument("--untold", action="store_true", help="without the sensors' places")
    parser.add_argument("--noise-mm", type=float, default=0.04)
    parser.add_argument("--points", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for poses in options.real:
        real(poses, options.seeds)
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


def real(poses: Path, seeds: int) -> None:
    """Templates of a folder's views, without and with the poses that its makers found."""
    told = read_poses(poses)
    files = [path for name in told if (path := poses.parent / name).is_file()]
    scans = [read_scan(path, frame="scanner") for path in files]
    unit_mm = 1000.0 if max(np.ptp(scan.points_mm, axis=0).max() for scan in scans) < 1.0 else 1.0
    scans = [Scan(unit_mm * s.points_mm, s.sigma_mm, "scanner", source=s.source) for s in scans]
    views = [View.of(scan, np.random.default_rng(0)) for scan in scans]
    truth = of_views(told, views, unit_mm)
    theirs = apart_mm(views, truth)
    made = [(scan, np.linalg.inv(truth[k])) for k, scan in enumerate(scans)]
    for words in ([], ["--poses", str(poses)]):
        for seed in range(seeds):
            found, wall_s, cpu_s = fitted(files, words, seed)
            if isinstance(found, str):
                said = f"refused: {found}"
            else:
                off = off_mm(made, Placement(found, 0.0))
                said = (
                    f"{len(off)} of {len(made)} placed, {np.median(off):.3f} mm off in the median, "
                    f"{off.max():.3f} mm at most; seen head-on by two, surfaces lie "
                    f"{apart_mm(views, found):.4f} mm apart in the median (as their makers placed "
                    f"them {theirs:.4f})"
                )
            print(
                f"{poses.parent.name}, {'poses told' if words else 'bare'}, seed {seed}: {said}; "
                f"{wall_s:.0f} s, {cpu_s:.0f} s of processor time",
                flush=True,
            )


def apart_mm(views: list[View], poses: dict[int, np.ndarray]) -> float:
    """Median height of one view's surface over another's, where both saw it head-on.

    Means over patches: noise averages out, and what registration leaves, and scanners bend, stays.
    """
    means = []
    for k, r in itertools.permutations(poses, 2):
        view, other = views[k], views[r]
        pose = np.linalg.inv(poses[r]) @ poses[k]
        clear = view.incidence > HEAD_ON
        points = moved(view.surface.points_mm[clear], pose)
        away, index = other.surface.tree.query(points, distance_upper_bound=other.spacing_mm)
        near = np.flatnonzero(np.isfinite(away))
        index = index[near]
        turned = view.surface.normals[clear][near] @ pose[:3, :3].T
        same = (turned * other.surface.normals[index]).sum(axis=1) > SAME_FACE
        same &= other.incidence[index] > HEAD_ON
        near, index = near[same], index[same]
        offset = points[near] - other.surface.points_mm[index]
        height = (offset * other.surface.normals[index]).sum(axis=1)
        cell = np.floor(points[near] / PATCH_MM).astype(np.int64)
        _, patch, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        mean = np.bincount(patch.ravel(), weights=height) / count
        means.append(np.abs(mean[count >= PATCH_POINTS]))
    return float(np.median(np.concatenate(means)))


def fitted(
    files: list[Path], words: list[str], seed: int
) -> tuple[dict[int, np.ndarray] | str, float, float]:
    """Poses by number as `template fit` finds them, or why not; seconds, and of the processor."""
    with tempfile.TemporaryDirectory() as scratch:
        out = ["-o", f"{scratch}/t.safetensors", "--json", "--seed", str(seed)]
        command = [sys.executable, "-m", "amrepair", "template", "fit", *map(str, files)]
        wall, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run([*command, *words, *out], capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall = time.perf_counter() - wall
    cpu_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    if done.returncode:
        return done.stderr.strip().splitlines()[-1], wall, cpu_s
    told = json.loads(done.stdout)["scans"]
    return {k: np.array(s["pose"]) for k, s in enumerate(told) if s["pose"]}, wall, cpu_s


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
    """(k,) of each placed view, in the frame in which all together lie nearest to the truth."""
    here, there, whose = [], [], []
    for k, pose in found.poses.items():
        scan, from_part = made[k]
        points = scan.points_mm[::40]
        here.append(moved(points, pose))
        there.append(moved(points, np.linalg.inv(from_part)))
        whose += [k] * len(points)
    one, other = np.concatenate(here), np.concatenate(there)
    turn = Rotation.align_vectors(one - one.mean(axis=0), other - other.mean(axis=0))[0]
    truth = turn.apply(other - other.mean(axis=0)) + one.mean(axis=0)
    squares = ((one - truth) ** 2).sum(axis=1)
    number = np.array(whose)
    return np.array([np.sqrt(squares[number == k].mean()) for k in found.poses])


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
