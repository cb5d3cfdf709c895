"""Layers that came out thin and lie under sound ones: which are told, by whole jobs of slicers.

    python benchmarks/bench_thin_layers.py --jobs ring:cura wedge:slic3r button:two
    python benchmarks/bench_thin_layers.py --flow 1 --jobs ring:cura   # sound: nothing is told

The jobs of `bench_clean_jobs.py` (or any STL: `--jobs part.stl:two`), printed into the simulated
world; in three layers at a third of their height `--flow` of the plastic comes out. One look
follows after each of `--sound` more layers, as if it were the first. A line of JSON each: the
layers that are told, with what they are said to lack, and what they do lack.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from bench_clean_jobs import mesh_called, scans_of, sliced

from amrepair.loop import locate_part, plan_stops
from amrepair.loop.sites import sites
from amrepair.loop.thin_layers import with_covered
from amrepair.repair import plan_repair
from amrepair.simulate.parameters import DEFAULT_SCANNER, load_world
from amrepair.simulate.placed import PlacedDefect
from amrepair.template import MeshSdf
from gcode.profiles import load_setup
from gcode.reader import Job

LAYERS, EVERYWHERE_MM = 3, 500.0


def thin(job: Job, flow: float, layers: range) -> PlacedDefect:
    """Less plastic everywhere in some layers."""
    low, high = job.layers[layers[0]], job.layers[layers[-1]]
    half_mm = 0.5 * low.height_mm
    low_mm, high_mm = low.z_mm - half_mm, high.z_mm + half_mm
    region = [0.0, 0.0, 1.0, 0.0, EVERYWHERE_MM, EVERYWHERE_MM, low_mm, high_mm, flow]
    box = np.array([[0.0, 0.0, low_mm - half_mm], [EVERYWHERE_MM, EVERYWHERE_MM, high_mm]])
    return PlacedDefect("under_extrusion", tuple(layers), np.array([region]), None, None, box)


def looks(name: str, flow: float, sound: list[int], seed: int, folder: Path) -> Iterator[Any]:
    """A row for each look at one job."""
    part, way = name.rsplit(":", 1)
    setup, job = load_setup(), sliced(part, way, folder)
    template = MeshSdf.from_mesh(mesh_called(part))
    placed = locate_part(job, template, layer_height_mm=setup.process.layer_height_mm)
    first = len(job.layers) // 3
    defect = thin(job, flow, range(first, first + LAYERS))
    site_at = sites(job, template, placed, setup)
    stops = plan_stops(job, [defect.layers[-1] + more for more in sound], final=False)
    scans = scans_of(job, stops, load_world(), DEFAULT_SCANNER, seed, (defect,))
    mine = (job.beads.layer >= defect.layers[0]) & (job.beads.layer <= defect.layers[-1])
    for stop, ((scan, _), pose) in zip(stops, scans, strict=True):
        site = site_at(stop)
        plan = plan_repair(
            scan, site, title=name, guess=placed.inverse() @ pose, strict=False,
            interruption=job.state_after(stop.line), rng=np.random.default_rng(seed),
        )  # fmt: skip
        covered = with_covered(plan, job, site.expected, stop).covered
        yield {
            "job": name,
            "stop": stop.label,
            "thin": [defect.layers[0], defect.layers[-1]],
            "told": None if covered is None else [covered.first, covered.last],
            "open_mm3": 0.0 if covered is None else round(covered.piece.volume_mm3, 1),
            "seen_mm3": round(plan.deficit.missing_mm3, 1),
            "lacking_mm3": round((1.0 - flow) * job.beads.subset(mine).volume_mm3, 1),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", nargs="+", metavar="PART:WAY", required=True)
    parser.add_argument("--flow", type=float, default=0.5, help="of the plastic, what comes out")
    parser.add_argument("--sound", nargs="+", type=int, default=[1, 3], help="layers over them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("out/clean-jobs"))
    args = parser.parse_args()
    for name in args.jobs:
        for row in looks(name, args.flow, args.sound, args.seed, args.folder):
            print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
