"""Alignment from any pose: success and seconds over many poses, beside the published method.

Run: python benchmarks/bench_align.py [PART…] [--poses 100] [--first 0] [--peer 0] [--points 200000]
[--view full single]. Scans of 200,000 points, noise 0.05 mm, a ball of 5 mm missing, uneven
density, in random poses: the whole surface (32 sensors) or what one sensor sees. By the truth:

right      within 0.1 mm RMSE, and no other pose said to fit
ambiguous  other poses are said to fit, the true one among them, and they do: by the exact mesh no
           more than 0.5 % of the points are farther off than 0.2 mm than in the true pose
unlisted   the same without the true pose in the list: a round part may turn freely, between those
overcautious  others are said to fit that do not
refused    an error
wrong      anything else: silently wrong

Success is right / (all − ambiguous − unlisted). `--peer N`: KISS-Matcher then GICP, and PAM, on N.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from amrepair.align import align
from amrepair.align.coarse import by_features
from amrepair.bench.synth_views import (
    Rays,
    SeenSurface,
    Shape,
    random_rotation,
    sample_shape,
    sensor_towards,
    sensors_around,
)
from amrepair.errors import AlignmentError
from amrepair.scans import Scan
from amrepair.simulate.part_files import part_names, part_path
from amrepair.template import MeshSdf, load_mesh, load_or_fit
from amrepair.template.port import Template

SIGMA_MM, BALL_MM, GOOD_MM = 0.05, 5.0, 0.1
POOL = 1_200_000
CLEAR_MM, CLEAR_RATIO, JUDGED = 0.2, 0.005, 20_000


def pool_of(shape: Shape, rays: Rays) -> SeenSurface:
    """Points of the surface that any sensor sees."""
    points = sample_shape(shape, POOL, np.random.default_rng(0))
    return points.take(rays.seen(points, sensors_around(shape)))


def scan_of(
    shape: Shape, rays: Rays, pool: SeenSurface, seed: int, count: int, view: str
) -> tuple[Scan, np.ndarray]:
    """A scan in a random pose, and its points where they belong."""
    rng = np.random.default_rng(seed)
    seen = pool
    if view == "single":
        seen = pool.take(rays.seen(pool, sensor_towards(shape, rng.normal(size=3))))
    slope = rng.normal(size=3) / shape.diagonal_mm
    keys = seen.points_mm @ slope + rng.gumbel(size=len(seen.points_mm))
    few = min(count, len(keys) // 2)
    points = seen.points_mm[np.argpartition(-keys, few)[:few]]
    hole = points[int(rng.integers(few))]
    points = points[np.linalg.norm(points - hole, axis=1) > min(BALL_MM, 0.1 * shape.diagonal_mm)]
    points = points + rng.normal(0, SIGMA_MM, points.shape)
    moved = points @ random_rotation(rng).T + rng.normal(0, 100, 3)
    return Scan(moved, SIGMA_MM, "scanner", source=f"scan {seed}"), points


def fits_as_well(exact: MeshSdf, placed: np.ndarray, truth: np.ndarray) -> bool:
    """By the exact mesh: hardly more points off the surface than in the true pose."""
    step = max(1, len(placed) // JUDGED)
    off, usual = (
        float((exact.unsigned_distance(points[::step]) > CLEAR_MM).mean())
        for points in (placed, truth)
    )
    return off - usual <= CLEAR_RATIO


def judge(poses: list[np.ndarray], scan: Scan, truth: np.ndarray, exact: MeshSdf) -> str:
    """One of the words of the module's text."""
    placed = [scan.points_mm @ m[:3, :3].T + m[:3, 3] for m in poses]
    off = [float(np.sqrt(((p - truth) ** 2).sum(axis=1).mean())) for p in placed]
    if len(poses) == 1:
        return "right" if off[0] < GOOD_MM else "wrong"
    others = [p for p, o in zip(placed, off, strict=True) if o >= GOOD_MM]
    if not all(fits_as_well(exact, p, truth) for p in others):
        return "wrong" if min(off) >= GOOD_MM else "overcautious"
    return "ambiguous" if min(off) < GOOD_MM else "unlisted"


def ours(scan: Scan, template: Template, seed: int) -> list[np.ndarray]:
    found = align(scan, template, rng=np.random.default_rng(seed))
    return [found.template_from_scan.matrix, *(t.matrix for t in found.symmetric_alternatives)]


def kiss_gicp(scan: Scan, template: Template, seed: int) -> list[np.ndarray]:
    """KISS-Matcher at 0.012 of the diagonal, then GICP."""
    import small_gicp

    diagonal_mm = float(np.linalg.norm(np.ptp(template.bounds_mm, axis=0)))
    surface = template.surface_points(0.006 * diagonal_mm)[0]
    guess = next(by_features(scan.points_mm, surface, diagonal_mm), None)
    if guess is None:
        raise AlignmentError("no match")
    answer = small_gicp.align(
        surface,
        scan.points_mm,
        init_T_target_source=guess,
        downsampling_resolution=0.006 * diagonal_mm,
        max_correspondence_distance=0.02 * diagonal_mm,
    )
    return [np.array(answer.T_target_source)]


def pam(scan: Scan, template: Template, seed: int) -> list[np.ndarray]:
    found = align(scan, template, method="paper", rng=np.random.default_rng(seed))
    return [found.template_from_scan.matrix]


METHODS: dict[str, Callable[[Scan, Template, int], list[np.ndarray]]] = {
    "robust": ours,
    "KISS-Matcher + GICP": kiss_gicp,
    "PAM": pam,
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", type=Path)
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--peer", type=int, default=0)
    parser.add_argument("--points", type=int, default=200_000)
    parser.add_argument("--view", nargs="+", default=["full", "single"])
    said = parser.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    print(
        "| part, view | method | right | ambiguous | unlisted | overcautious | refused | wrong "
        "| success | median s | least s | median s of processor |"
    )
    print("|---" * 12 + "|")
    for part in said.parts or [part_path(name) for name in part_names()]:
        mesh = load_mesh(part)
        exact, template = MeshSdf.from_mesh(mesh), load_or_fit(part)
        shape = Shape(np.array(mesh.vertices), np.array(mesh.faces), np.zeros((len(mesh.faces), 3)))
        rays = Rays(shape)
        pool = pool_of(shape, rays)
        for view in said.view:
            for name, method in METHODS.items():
                count = said.poses if name == "robust" else said.peer
                seeds = range(said.first, said.first + count)
                if count:
                    scans = (scan_of(shape, rays, pool, s, said.points, view) for s in seeds)
                    rows = measure(method, template, exact, zip(seeds, scans, strict=True))
                    print(f"| {part.stem}, {view} | {name} {rows}", flush=True)
    print(f"\nload at the end {os.getloadavg()[0]:.1f}")


def measure(
    method: Callable[[Scan, Template, int], list[np.ndarray]],
    template: Template,
    exact: MeshSdf,
    scans: Iterable[tuple[int, tuple[Scan, np.ndarray]]],
) -> str:
    """The rest of a row."""
    found, spent, worked = Counter[str](), [], []
    for seed, (scan, truth) in scans:
        start, began = time.perf_counter(), time.process_time()
        try:
            poses = method(scan, template, seed)
        except AlignmentError:
            poses = []
        spent.append(time.perf_counter() - start)
        worked.append(time.process_time() - began)
        word = judge(poses, scan, truth, exact) if poses else "refused"
        if word in {"refused", "wrong", "overcautious"} and method is ours:
            print(f"  seed {seed}: {word}", flush=True)
        found[word] += 1
    determined = len(spent) - found["ambiguous"] - found["unlisted"]
    success = f"{found['right'] / determined:.1%} of {determined}" if determined else "–"
    words = ("right", "ambiguous", "unlisted", "overcautious", "refused", "wrong")
    return (
        f"| {' | '.join(str(found[word]) for word in words)} | {success} "
        f"| {np.median(spent):.2f} | {np.min(spent):.2f} | {np.median(worked):.2f} |"
    )


if __name__ == "__main__":
    main()
