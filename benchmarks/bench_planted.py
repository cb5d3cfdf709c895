"""What is still found where nothing is claimed: blobs and pits planted on clean sliced jobs.

    python benchmarks/bench_planted.py --high 0.6 --jobs clip:gyroid ring:solid

The jobs of `bench_clean_jobs.py`, printed to their end; then three discs of 2.5 mm are laid on
places of walls and tops drawn at random, and three sunk into them, `--high` mm each, and one final
look is judged with what the job's own path leaves (`Site.laid`), and without. A line of JSON each:
volumes found at the planted places, true volumes, and what was claimed elsewhere.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
from bench_clean import motion_of
from bench_clean_jobs import CENTRE_MM, mesh_called, sliced

from amrepair.frames import Transform
from amrepair.loop import locate_part, plan_stops
from amrepair.loop.sites import sites
from amrepair.regions import Label
from amrepair.repair import RepairPlan, Site, plan_repair
from amrepair.scans import ScanRequest
from amrepair.simulate.flow import noisy_flow
from amrepair.simulate.parameters import load_world
from amrepair.simulate.scanner import SimulatedScanner, default_sensors_mm, seeded_pose
from amrepair.simulate.world import World
from amrepair.template import MeshSdf
from gcode.profiles import load_setup
from gcode.reader import Job

RADIUS_MM, APART_MM, ABOVE_BED_MM, COUNT = 1.25, 8.0, 2.5, 6
AROUND_MM = 1.0  # a region's box is met by what was planted so far beside it


def printed(job: Job, seed: int) -> World:
    """A job in the shipped world, cold; it neither shrinks nor curls, so that truth stays put."""
    told = load_world()
    high = job.beads.start_mm.max(axis=0)
    world = World(
        (float(high[0]) + 20.0, float(high[1]) + 20.0), cell_mm=told.columns_mm, bead=told.bead
    )
    rng = np.random.default_rng([seed, 3])
    world.deposit(noisy_flow(motion_of(job, 0, len(job.layers) - 1), rng, told.flow))
    return world


def places(
    template: MeshSdf, placed: Transform, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and outward directions, build frame, on walls and tops, apart from each other."""
    points, normals = template.surface_points(0.5)
    points, normals = placed.apply(points), placed.rotate(normals)
    seen = np.flatnonzero((points[:, 2] > ABOVE_BED_MM) & (normals[:, 2] > -0.1))
    chosen: list[int] = []
    for k in rng.permutation(seen):
        if all(np.linalg.norm(points[k] - points[j]) > APART_MM for j in chosen):
            chosen.append(int(k))
        if len(chosen) == COUNT:
            break
    return [(points[k], normals[k]) for k in chosen]


def plant(world: World, where: Sequence[tuple[np.ndarray, np.ndarray]], high_mm: float) -> None:
    """Every other one is a blob, the rest are pits."""
    for k, (place, out) in enumerate(where):
        side = np.cross(out, [0.3, 0.5, 0.81])
        side /= np.linalg.norm(side)
        pose = np.column_stack([side, np.cross(out, side), out, place])
        disc = m3.Manifold.cylinder(2 * high_mm, RADIUS_MM, RADIUS_MM, 24, True).transform(pose)
        if k % 2 == 0:
            world.add(disc)
        else:
            world.remove(disc)


def figures(plan: RepairPlan, where: Sequence[tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """Volumes found at the places, blobs first, and what was claimed elsewhere."""
    found, elsewhere = np.zeros(len(where)), {Label.MISSING: 0.0, Label.EXCESS: 0.0}
    for region in plan.deficit.regions:
        low, high = region.box_mm + np.array([[-AROUND_MM], [AROUND_MM]])
        mine = [
            k
            for k, (place, _) in enumerate(where)
            if (k % 2 == 0) == (region.label is Label.EXCESS)
            and bool(((place > low) & (place < high)).all())
        ]
        if mine:
            found[mine[0]] += region.volume_mm3
        else:
            elsewhere[region.label] += region.volume_mm3
    return {
        "blobs_mm3": np.round(found[::2], 2).tolist(),
        "pits_mm3": np.round(found[1::2], 2).tolist(),
        "else_missing_mm3": round(elsewhere[Label.MISSING], 2),
        "else_excess_mm3": round(elsewhere[Label.EXCESS], 2),
    }


def run_job(name: str, high_mm: float, seed: int, folder: Path) -> list[dict[str, Any]]:
    """One print, judged both ways."""
    part, way = name.rsplit(":", 1)
    setup, job = load_setup(), sliced(part, way, folder)
    template = MeshSdf.from_mesh(mesh_called(part))
    placed = locate_part(job, template, layer_height_mm=setup.process.layer_height_mm)
    world, rng = printed(job, seed), np.random.default_rng([seed, 5])
    where = places(template, placed, rng)
    plant(world, where, high_mm)
    model = load_world().scanner()
    pose = seeded_pose(rng, centre_mm=CENTRE_MM, model=model)
    sensors = default_sensors_mm(CENTRE_MM, distance_mm=300.0, oblique=model.oblique_views)
    scanner = SimulatedScanner(world, pose=pose, sensors_mm=sensors, rng=rng, model=model)
    (stop,) = plan_stops(job, [])
    scan = scanner.scan(ScanRequest(stop.label, None, stop.z_mm))
    site = sites(job, template, placed, setup)(stop)

    def judged(by: Site) -> RepairPlan:
        return plan_repair(
            scan, by, title=name, guess=placed.inverse() @ scanner.build_from_scanner,
            strict=False, interruption=job.state_after(stop.line), rng=np.random.default_rng(seed),
        )  # fmt: skip

    true = {"true_mm3": round(float(np.pi) * RADIUS_MM**2 * high_mm, 2)}
    return [
        {"job": name, "laid": how, **figures(judged(by), where), **true}
        for how, by in (("with", site), ("without", replace(site, laid=None)))
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", nargs="+", metavar="PART:WAY", required=True)
    parser.add_argument("--high", type=float, default=0.6, help="of a blob, and depth of a pit, mm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("out/clean-jobs"))
    args = parser.parse_args()
    for name in args.jobs:
        for row in run_job(name, args.high, args.seed, args.folder):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
