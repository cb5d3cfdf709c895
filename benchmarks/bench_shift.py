"""Layers that lie aside of those below: which are told, by whole jobs of slicers.

    python benchmarks/bench_shift.py --jobs clip:default cup:cura part.stl:two
    python benchmarks/bench_shift.py --by 0 --flow 1 0.5 0 --jobs clip:default  # nothing has moved

The jobs of `bench_clean_jobs.py` (or any STL), printed into the simulated world; from a layer at
some share of their height on, all lies aside by `--by`, in a direction of its own for each case.
One look follows each of `--after` layers, as if it were the first. With `--by 0` nothing moves, but
of the plastic of those layers `--flow` comes out: no shift is to be told. A line of JSON each.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from bench_clean_jobs import NOTHING, judged, mesh_called, scans_of, sliced
from bench_thin_layers import thin

from amrepair.errors import AlignmentError
from amrepair.loop import locate_part, plan_stops
from amrepair.loop.learning import Learning
from amrepair.loop.sites import sites
from amrepair.regions import DefectType
from amrepair.simulate.parameters import DEFAULT_SCANNER, load_world
from amrepair.template import MeshSdf
from gcode.profiles import load_setup
from gcode.reader import Job


def moved(job: Job, first: int, by_mm: np.ndarray) -> Job:
    """The job as it is printed by motors that lost steps before a layer."""
    beads = job.beads
    aside = np.where((beads.layer >= first)[:, None], np.append(by_mm, 0.0), 0.0)
    return replace(
        job, beads=replace(beads, start_mm=beads.start_mm + aside, end_mm=beads.end_mm + aside)
    )


def looks(
    name: str, share: float, by_mm: float, flow: float, args: argparse.Namespace
) -> Iterator[dict[str, Any]]:
    """A row for each look at one print."""
    part, way = name.rsplit(":", 1)
    setup, job = load_setup(), sliced(part, way, args.folder)
    template = MeshSdf.from_mesh(mesh_called(part))
    placed = locate_part(job, template, layer_height_mm=setup.process.layer_height_mm)
    site_at = sites(job, template, placed, setup)
    first = max(1, round(share * len(job.layers)))
    after = [first + more - 1 for more in args.after if first + more < len(job.layers)]
    stops = plan_stops(job, after, final=False)
    case = [args.seed, first, round(100 * by_mm), round(100 * flow)]
    angle = 2.0 * np.pi * np.random.default_rng(case).random()
    by = by_mm * np.array([np.cos(angle), np.sin(angle)])
    printed = moved(job, first, by)
    defects = () if flow >= 1.0 else (thin(job, flow, range(first, len(job.layers))),)
    scans = scans_of(printed, stops, load_world(), args.scanner, args.seed, defects)
    learning = Learning()
    for stop, (seen, pose) in zip(stops, scans, strict=True):
        rng = np.random.default_rng(args.seed)
        row = {"job": name, "first": first, "by_mm": by_mm, "flow": flow, "stop": stop.label}
        row["after"] = (stop.layer_index or 0) - first + 1
        try:
            look = judged(seen, pose, job, site_at(stop), stop, rng=rng, learning=learning)
        except AlignmentError as error:
            look = NOTHING | {"error": str(error)}
        kinds = [region["type"] for region in look["regions"]]
        yield row | {
            "told": str(DefectType.LAYER_SHIFT) in kinds,
            "action": look["action"],
            "repair_mm3": look["repair_mm3"],
            "missing_mm3": look["missing_mm3"],
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", nargs="+", metavar="PART:WAY", required=True)
    parser.add_argument("--by", type=float, nargs="+", default=[0.3, 0.5, 1.0, 2.0, 4.0])
    parser.add_argument("--flow", type=float, nargs="+", default=[1.0])
    parser.add_argument("--at", type=float, nargs="+", default=[0.3, 0.6], help="of the height")
    parser.add_argument("--after", type=int, nargs="+", default=[1, 2, 4, 8], help="layers")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scanner", default=DEFAULT_SCANNER)
    parser.add_argument("--folder", type=Path, default=Path("out/clean-jobs"))
    args = parser.parse_args()
    for name in args.jobs:
        for share, by_mm, flow in itertools.product(args.at, args.by, args.flow):
            for row in looks(name, share, by_mm, flow, args):
                print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
