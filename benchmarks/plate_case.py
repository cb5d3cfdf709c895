"""A real plate with parts on it (line laser on a robot): its bow is told, what stands on it stays.

Run: AMREPAIR_DATA=FOLDER python benchmarks/plate_case.py [--tolerance-mm 0.15 0.3] [--json FILE]

The template is what a user would have, a box of the plate's own size; the scan lies in it by the
plane that most of its points share. Before and after the nuisance is taken out: local medians of
the bare plate, and the regions that a plain rule finds (median over 2.5 mm beyond the tolerance
and 1.5 times the local spread), so that the figures do not depend on the detector.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from amrepair.align import align
from amrepair.errors import AmrepairError
from amrepair.observe import Nuisance, fit_nuisance
from amrepair.scans import read_scan
from amrepair.template.mesh_sdf import MeshSdf

THICKNESS_MM = 10.0
ON_PLANE_MM = 1.0
RADIUS_MM, CELL_MM, SPREAD, LEAST = 2.5, 0.6, 1.5, 8
STANDS_MM = 2.0  # what is higher stands on the plate; what is as deep is the wall of a bore
FAR_MM = 30.0  # fliers: twice what stands highest would be too near


@dataclass(frozen=True)
class Sites:
    """Medians of the deviation by cells of 0.6 mm, box frame."""

    place_mm: np.ndarray
    normal: np.ndarray
    deviation_mm: np.ndarray
    neighbours: list[list[int]]

    def local(self, value_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Median and half the 16-84 % range over the radius."""
        middle, half = np.zeros(len(value_mm)), np.full(len(value_mm), np.inf)
        for k, near in enumerate(self.neighbours):
            if len(near) >= LEAST:
                low, middle[k], high = np.percentile(value_mm[near], [16, 50, 84])
                half[k] = (high - low) / 2
        return middle, half

    def regions(self, value_mm: np.ndarray, tolerance_mm: float) -> list[np.ndarray]:
        middle, half = self.local(value_mm)
        at = np.flatnonzero(np.abs(middle) > tolerance_mm + SPREAD * half)
        pairs = cKDTree(self.place_mm[at]).query_pairs(RADIUS_MM, output_type="ndarray")
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(at), len(at)))
        of = connected_components(graph)[1]
        return [at[of == k] for k in range(int(of.max(initial=-1)) + 1)]


def lay_flat(points_mm: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points with the plate's top in z = 0 along x and y, and the plate's size."""
    best, most = np.zeros(4), 0
    for _ in range(300):
        a, b, c = points_mm[rng.integers(len(points_mm), size=3)]
        normal = np.cross(b - a, c - a)
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        count = int((np.abs((points_mm - a) @ normal) < ON_PLANE_MM / 2).sum())
        if count > most:
            best, most = np.r_[normal, normal @ a], count
    on = np.abs(points_mm @ best[:3] - best[3]) < ON_PLANE_MM
    centre_mm = points_mm[on].mean(axis=0)
    axes = np.linalg.eigh(np.cov((points_mm[on] - centre_mm).T))[1][:, ::-1]
    axes[:, 2] *= np.sign(axes[2, 2])  # the sensor looked from above
    axes[:, 0] = np.cross(axes[:, 1], axes[:, 2])
    flat = (points_mm - centre_mm) @ axes
    sizes = {}
    for degrees in np.arange(-45, 45, 0.5):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = flat[on][:, :2] @ np.array([[c, -s], [s, c]])
        low, high = np.percentile(turned, [1, 99], axis=0)
        sizes[float(np.prod(high - low))] = (c, s, low, high)
    c, s, low, high = sizes[min(sizes)]
    flat[:, :2] = flat[:, :2] @ np.array([[c, -s], [s, c]]) - (low + high) / 2
    return flat, (high - low) / 0.98


def gather(flat_mm: np.ndarray, template: MeshSdf) -> Sites:
    deviation_mm, normal = template.distance_and_gradient(flat_mm)
    keep = np.abs(deviation_mm) < FAR_MM
    place_mm, normal, deviation_mm = flat_mm[keep], normal[keep], deviation_mm[keep]
    _, cell = np.unique(np.floor(place_mm / CELL_MM).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    order = np.argsort(cell, kind="stable")
    medians = [np.median(x) for x in np.split(deviation_mm[order], np.cumsum(count)[:-1])]
    mean = [
        np.stack([np.bincount(cell, x[:, k]) / count for k in range(3)], 1)
        for x in (place_mm, normal)
    ]
    site, facing = mean
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    near = cKDTree(site).query_ball_point(site, RADIUS_MM)
    return Sites(site, facing, np.array(medians), list(near))


def correlation_mm(sites: Sites, value_mm: np.ndarray, bare: np.ndarray) -> float:
    """Distance at which the correlation of what is left on the bare plate falls to 1/e."""
    at = np.flatnonzero(bare & (np.abs(value_mm) < 4 * np.median(np.abs(value_mm[bare]))))
    tree = cKDTree(sites.place_mm[at])
    pair = tree.query_pairs(15.0, output_type="ndarray")
    rng = np.random.default_rng(0)
    pair = pair[rng.integers(len(pair), size=min(len(pair), 400_000))]
    apart = np.linalg.norm(sites.place_mm[at[pair[:, 0]]] - sites.place_mm[at[pair[:, 1]]], axis=1)
    off = value_mm[at] - value_mm[at].mean()
    product = off[pair[:, 0]] * off[pair[:, 1]] / off.var()
    lag = np.floor(apart / 0.5).astype(int)
    curve = np.bincount(lag, product) / np.maximum(np.bincount(lag), 1)
    below = np.flatnonzero(curve[1:] < np.exp(-1)) + 1
    return float((below[0] + 0.5) * 0.5) if len(below) else 15.0


def told_unit(path: Path, template: MeshSdf) -> str:
    """What `align` says to the file as it is, in metres."""
    try:
        align(read_scan(path, frame="scanner"), template)
    except AmrepairError as error:
        return str(error)
    return "nothing: it was taken for millimetres"


def quantiles(value_mm: np.ndarray) -> dict[str, float]:
    return {f"{q} %": round(float(np.percentile(value_mm, q)), 3) for q in (50, 90, 95, 99)}


def judge(sites: Sites, found: Nuisance, tolerance_mm: float) -> dict[str, object]:
    left_mm = sites.deviation_mm - found.removed_mm(sites.place_mm, sites.normal)
    stands = sites.deviation_mm > STANDS_MM
    bare = ~stands
    result: dict[str, object] = {}
    for name, value_mm in (("before", sites.deviation_mm), ("after", left_mm)):
        middle = np.abs(sites.local(value_mm)[0])
        regions = sites.regions(value_mm, tolerance_mm)
        height_mm = np.array([np.median(value_mm[r]) for r in regions])
        on_bare = [r for r, h in zip(regions, height_mm, strict=True) if abs(h) < STANDS_MM]
        off = sites.place_mm[np.concatenate([*on_bare, np.flatnonzero(stands)])]
        clear = bare & (cKDTree(off).query(sites.place_mm)[0] > RADIUS_MM)
        result[name] = {
            "local_medians_mm": quantiles(middle[bare]),
            "local_medians_outside_regions_mm": quantiles(middle[clear]),
            "regions_standing": int((height_mm >= STANDS_MM).sum()),
            "regions_in_bores": int((height_mm <= -STANDS_MM).sum()),
            "regions_on_bare_plate": [
                {
                    "area_mm2": round(len(r) * CELL_MM**2, 1),
                    "at_mm": np.round(np.median(sites.place_mm[r], axis=0), 1).tolist(),
                    "deviation_mm": round(float(np.median(value_mm[r])), 2),
                }
                for r in on_bare
            ],
        }
    ring = cKDTree(sites.place_mm[stands][:, :2]).query(sites.place_mm[:, :2])[0]
    beside = bare & (ring > 2) & (ring < 12)
    result["height_above_the_plate_beside_it_mm"] = {
        name: round(float(np.median(value[stands]) - np.median(value[beside])), 3)
        for name, value in (("before", sites.deviation_mm), ("after", left_mm))
    }
    return result


def case(folder: Path, tolerances_mm: list[float]) -> dict[str, object]:
    """Everything that is told about the plate, as plain numbers."""
    path = folder / "real" / "plate" / "plate.xyz"
    flat_mm, size_mm = lay_flat(1000.0 * np.loadtxt(path)[:, :3], np.random.default_rng(0))
    box = trimesh.creation.box((*size_mm, THICKNESS_MM))
    box.apply_translation((0, 0, -THICKNESS_MM / 2))
    template = MeshSdf.from_mesh(box)
    sites = gather(flat_mm, template)
    said: dict[str, object] = {"unit": told_unit(path, template), "size_mm": size_mm.tolist()}
    weight = np.ones(len(sites.place_mm))
    for tolerance_mm in tolerances_mm:
        length_mm = RADIUS_MM
        for _ in range(2):  # the correlation is that of what the fit leaves
            start = time.perf_counter()
            found = fit_nuisance(
                sites.place_mm, sites.normal, sites.deviation_mm, weight,
                tolerance_mm=tolerance_mm, correlation_mm=length_mm,
            )  # fmt: skip
            seconds = time.perf_counter() - start
            left_mm = sites.deviation_mm - found.removed_mm(sites.place_mm, sites.normal)
            used_mm, length_mm = length_mm, correlation_mm(sites, left_mm, left_mm < STANDS_MM)
        said[f"tolerance {tolerance_mm} mm"] = {
            "correlation_mm": used_mm,
            "seconds": round(seconds, 2),
            "nuisance": found.to_json(),
            **judge(sites, found, tolerance_mm),
        }
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tolerance-mm", type=float, nargs="+", default=[0.15, 0.3])
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    said = case(Path(os.environ["AMREPAIR_DATA"]), arguments.tolerance_mm)
    text = json.dumps(said, indent=1, ensure_ascii=False)
    print(text)
    if arguments.json:
        arguments.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
