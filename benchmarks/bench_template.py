"""Templates beside their peers, in one run: fit, accuracy, queries, extraction, and from scans.

Run: python benchmarks/bench_template.py [PART] [--skip paper scans] [--scan-points 200000]
[--paper-steps 1000]. Peers: the paper's network (batch 8,192, rate 5e-4, so that it finishes), the
bare 128³ grid of exact distances, the full grid for extraction, and Poisson reconstruction of the
same placed scans. Errors are against the CAD's exact field; each figure is one run.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from skimage.measure import marching_cubes

from amrepair.frames import rotation_from_vector
from amrepair.merge import fit_from_scans
from amrepair.scans import Scan
from amrepair.simulate.part_files import part_path
from amrepair.template import MeshSdf, extract_mesh, load_mesh
from amrepair.template.fit import fit_fast
from amrepair.template.grid import Grid, GridSdf
from amrepair.template.paper import PUBLISHED_NETWORK, fit_paper
from amrepair.template.port import Template

OFFSETS_MM = (0.05, 0.2, 0.5, 2.0, 5.0)
SIGMA_MM = 0.03


def timed(work: Callable[[], object]) -> tuple[object, float]:
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def micrometres(error_mm: np.ndarray) -> str:
    return f"{1e3 * error_mm.mean():.1f} / {1e3 * np.quantile(error_mm, 0.99):.0f}"


def surface_of(mesh: trimesh.Trimesh, count: int = 100_000) -> tuple[np.ndarray, np.ndarray]:
    points, face = trimesh.sample.sample_surface(mesh, count, seed=12)
    return np.asarray(points), np.asarray(mesh.face_normals)[face]


def two_way(made: trimesh.Trimesh, exact: MeshSdf) -> str:
    """Mean and 99th percentile, µm: from the made mesh to the CAD, and back."""
    made.metadata["notes"] = ()
    forth = exact.unsigned_distance(surface_of(made)[0])
    back = MeshSdf.from_mesh(made).unsigned_distance(surface_of(exact.mesh)[0])
    return f"{micrometres(forth)} and {micrometres(back)}"


def accuracy(name: str, template: Template, exact: MeshSdf, seconds: float) -> None:
    points, normals = surface_of(exact.mesh)
    print(f"| {name} | {seconds:.1f} | {micrometres(np.abs(template.distance(points)))} |", end="")
    for offset_mm in OFFSETS_MM:
        away = np.concatenate([points + offset_mm * normals, points - offset_mm * normals])
        print(f" {micrometres(np.abs(template.distance(away) - exact.distance(away)))} |", end="")
    print(flush=True)


def fits(exact: MeshSdf, steps: int) -> dict[str, Template]:
    print("\nFit from CAD: seconds; error µm mean / p99 on the surface, and ± offset from it\n")
    print("| template | s | 0 | " + " | ".join(f"±{o:g} mm" for o in OFFSETS_MM) + " |")
    print("|---" * (3 + len(OFFSETS_MM)) + "|")
    made: dict[str, Template] = {}
    template, seconds = timed(lambda: fit_fast(exact))
    assert isinstance(template, GridSdf)
    made["fast"] = template
    accuracy("fast", template, exact, seconds)
    grid = template.grid
    bare = Grid.bare(grid.origin_mm, grid.cell_mm, grid.base)
    accuracy("its coarse grid alone", replace(template, grid=bare), exact, float("nan"))
    if steps:
        options = replace(PUBLISHED_NETWORK, batch=8_192, rate=5e-4, epochs=steps // 2, dropout=0.0)
        network, seconds = timed(lambda: fit_paper(exact, options=options, device="cpu"))
        made["paper"] = network  # type: ignore[assignment]
        accuracy(f"paper, {steps} steps of 8,192", made["paper"], exact, seconds)
    return made


def queries(made: dict[str, Template], exact: MeshSdf) -> None:
    rng = np.random.default_rng(0)
    low, high = exact.bounds_mm
    near = surface_of(exact.mesh, 500_000)[0] + rng.normal(0, 0.3, (500_000, 3))
    points = np.concatenate([near, rng.uniform(low - 5, high + 5, (500_000, 3))])
    print("\nA million points, half of them near the surface: median of three, s\n")
    for name, template in {**made, "exact": exact}.items():
        rounds = 1 if name == "paper" else 3
        spent = [timed(lambda t=template: t.distance(points))[1] for _ in range(rounds)]
        print(f"- {name}: {np.median(spent):.2f}", flush=True)


def extraction(template: Template, exact: MeshSdf, voxel_mm: float = 0.2) -> None:
    print(f"\nMesh of the template, {voxel_mm} mm\n")
    mesh, seconds = timed(lambda: extract_mesh(template, voxel_mm))
    assert isinstance(mesh, trimesh.Trimesh)
    print(f"- narrow band: {seconds:.2f} s, {two_way(mesh, exact)} µm to the CAD and back")

    def full() -> trimesh.Trimesh:
        low, high = exact.bounds_mm
        axes = [np.arange(low[a] - 0.4, high[a] + 0.4, voxel_mm) for a in range(3)]
        plane = np.stack(np.meshgrid(axes[1], axes[2], indexing="ij"), -1).reshape(-1, 2)
        rows = [
            template.distance(np.column_stack([np.full(len(plane), x), plane])) for x in axes[0]
        ]
        field = np.array(rows).reshape(*map(len, axes))
        vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(voxel_mm,) * 3)
        return trimesh.Trimesh(vertices, faces, process=False)

    print(f"- full grid: {timed(full)[1]:.2f} s", flush=True)


def scans_of(exact: MeshSdf, count: int, points: int) -> list[Scan]:
    made = []
    for k in range(count):
        rng = np.random.default_rng(k)
        cloud = np.asarray(trimesh.sample.sample_surface(exact.mesh, points, seed=k)[0])
        cloud = cloud + rng.normal(0, SIGMA_MM, cloud.shape)
        axis = rng.normal(size=3)
        turn = rotation_from_vector(2.5 * (k > 0) * axis / np.linalg.norm(axis))
        made.append(
            Scan(cloud @ turn.T + 50 * (k > 0) * rng.normal(size=3), 0.04, "scanner", source=str(k))
        )
    return made


def from_scans(exact: MeshSdf, points: int) -> None:
    scans = scans_of(exact, 4, points)
    print(f"\nFrom 4 scans of {points:,} points, noise {1e3 * SIGMA_MM:.0f} µm, no mesh\n")
    made, seconds = timed(lambda: fit_from_scans(scans))
    template, fused = made.template, made.fused.mesh  # type: ignore[attr-defined]
    on = np.abs(template.distance(surface_of(exact.mesh)[0]))
    print(f"- merged: {seconds:.1f} s; field on the true surface {micrometres(on)} µm;")
    print(f"  fused mesh to the CAD and back {two_way(fused, exact)} µm", flush=True)
    from amrepair.merge.cloud import outward, planes, spacing_of
    from amrepair.merge.fuse import _poisson

    placed = np.concatenate(
        [s.points_mm @ m[:3, :3].T + m[:3, 3] for s, m in zip(scans, made.poses, strict=True)]  # type: ignore[attr-defined]
    )
    spacing_mm = spacing_of(placed)
    plane = planes(placed, spacing_mm)
    normals = outward(placed, plane.normals, spacing_mm, plane.sigma_mm)
    poisson, seconds = timed(lambda: _poisson(placed, normals).mesh)
    assert isinstance(poisson, trimesh.Trimesh)
    print(f"- Poisson, depth 8, of the same placed points: {seconds:.1f} s, without placing;")
    print(f"  to the CAD and back {two_way(poisson, exact)} µm", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", type=Path, default=part_path("bracket"))
    parser.add_argument("--skip", nargs="*", default=[], choices=["paper", "scans", "fits"])
    parser.add_argument("--scan-points", type=int, default=200_000)
    parser.add_argument("--paper-steps", type=int, default=1_000)
    said = parser.parse_args()
    exact = MeshSdf.from_mesh(load_mesh(said.part))
    load = os.getloadavg()[0]
    print(f"{said.part.name}, {platform.machine()}, {os.cpu_count()} cores, load {load:.1f}")
    if "fits" not in said.skip:
        made = fits(exact, 0 if "paper" in said.skip else said.paper_steps)
        queries(made, exact)
        extraction(made["fast"], exact)
    if "scans" not in said.skip:
        from_scans(exact, said.scan_points)
    print(f"\nload at the end {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
