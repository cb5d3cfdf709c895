"""How fast the simulated world is: metres of path laid per second, rays cast per second.

    python benchmarks/bench_simulate.py [--repeats 5]

The peer in the same run is the plainest honest thing: stamping every step's disc into a height
map with NumPy (no intervals, no conservation), and trimesh's embree rays on the solid's mesh.
"""

from __future__ import annotations

import argparse
import platform
import time
from collections.abc import Callable

import manifold3d as m3
import numpy as np
import trimesh

from amrepair.scans.scanner import ScanRequest
from amrepair.simulate.parameters import ScannerModel
from amrepair.simulate.scanner import (
    SimulatedScanner,
    default_sensors_mm,
    seeded_pose,
)
from amrepair.simulate.world import World
from gcode.firmware.motion import MotionBatch

SPACING_MM, HEIGHT_MM, SIZE_MM, LAYERS = 0.407, 0.2, 30.0, 20
CENTRE = (60.0, 60.0)


def lines() -> MotionBatch:
    """A block of parallel lines, alternating direction by layer."""
    starts, ends = [], []
    for layer in range(LAYERS):
        for line in range(int(SIZE_MM / SPACING_MM)):
            across = 45.0 + (line + 0.5) * SPACING_MM
            a, b = (45.0, 45.0 + SIZE_MM) if line % 2 else (45.0 + SIZE_MM, 45.0)
            z = HEIGHT_MM * (layer + 1)
            starts.append((a, across, z) if layer % 2 else (across, a, z))
            ends.append((b, across, z) if layer % 2 else (across, b, z))
    n = len(starts)
    filament = np.full(n, SIZE_MM * SPACING_MM * HEIGHT_MM / (np.pi / 4 * 1.75**2))
    return MotionBatch(
        np.array(starts), np.array(ends), filament, np.full(n, 50.0), np.arange(n) * 1.0
    )


def stamp(motion: MotionBatch, cell_mm: float, step_mm: float) -> np.ndarray:
    """The peer: a height map, every step's disc raised to the nozzle."""
    height = np.zeros((int(120 / cell_mm), int(120 / cell_mm)))
    half = int(np.ceil(0.2 / cell_mm))
    dy, dx = np.mgrid[-half : half + 1, -half : half + 1]
    near = np.hypot(dx, dy) * cell_mm <= 0.2
    dy, dx = dy[near], dx[near]
    for start, end in zip(motion.start_mm, motion.end_mm, strict=True):
        steps = max(1, int(np.ceil(np.linalg.norm(end - start) / step_mm)))
        t = (np.arange(steps) + 0.5) / steps
        x = ((start[0] + t * (end[0] - start[0])) / cell_mm).astype(int)
        y = ((start[1] + t * (end[1] - start[1])) / cell_mm).astype(int)
        height[y[:, None] + dy, x[:, None] + dx] = end[2]
    return height


def timed(work: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median and half the range, s; one run goes before to warm up."""
    work()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds)), 0.5 * (max(seconds) - min(seconds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    print(f"{platform.platform()}, {platform.processor() or platform.machine()}")
    motion = lines()
    path_m = float(np.linalg.norm(motion.end_mm - motion.start_mm, axis=1).sum()) / 1000
    for cell_mm in (0.15, 0.125, 0.1):
        median, spread = timed(
            lambda c=cell_mm: World((120.0, 120.0), cell_mm=c).deposit(motion), repeats
        )
        print(
            f"deposit, columns {cell_mm} mm: {path_m / median:6.1f} m/s  (± {spread / median:.0%})"
        )
    median, spread = timed(lambda: stamp(motion, 0.125, 0.2), repeats)
    print(
        f"peer, stamped height map 0.125 mm: {path_m / median:6.1f} m/s  (± {spread / median:.0%})"
    )

    solid = m3.Manifold.cube((60, 40, 30)) - m3.Manifold.cylinder(40, 8, 8, 96).translate(
        (30, 20, 5)
    )
    solid = solid.translate((30, 40, 0))
    world = World((120.0, 120.0))
    world.add(solid)
    sensors = default_sensors_mm(CENTRE)
    device = SimulatedScanner(
        world,
        pose=seeded_pose(np.random.default_rng(0), centre_mm=CENTRE),
        sensors_mm=sensors,
        rng=np.random.default_rng(0),
        model=ScannerModel(),
    )
    request = ScanRequest("bench", None, 30.0)
    points = len(device.scan(request))
    median, spread = timed(lambda: device.scan(request), repeats)
    print(
        f"scan: {points} points, {points / median / 1e3:6.0f} k points/s  (± {spread / median:.0%})"
    )
    mesh = solid.to_mesh()
    shape = trimesh.Trimesh(np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts))
    aims = np.random.default_rng(0).uniform((20, 30, 0), (100, 90, 0), (points, 3))
    origins = np.repeat(sensors, int(np.ceil(points / len(sensors))), axis=0)[:points]
    median, spread = timed(lambda: shape.ray.intersects_first(origins, aims - origins), repeats)
    print(f"peer, embree: {points / median / 1e3:6.0f} k rays/s  (± {spread / median:.0%})")


if __name__ == "__main__":
    main()
