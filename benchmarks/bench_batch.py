"""What a batch costs beside the same work by hand, on 1 and 2 workers and on Ray.

    python benchmarks/bench_batch.py [--scans 160] [--points 3000] [--out out/bench-batch]

The overhead is measured in one process, where a batch and a loop written by hand take turns over
the same scans, by turns the one first and the other: what else the machine does meets both alike.
Its figure is all processor time of the batch beyond the hand's, table and overview included.

Then every way is run as a command, twice, with a quarter of the scans and with all: the difference
is what scans cost, without what it takes to start. Processor time is of the command and all its
children; Ray's workers are children of nobody, there the batch's own account is given.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from gcode.process import one_thread, prepare

os.environ.update(one_thread())
prepare()

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "unit"))


def by_hand(template: Path) -> Callable[[Path], None]:
    """What anybody would write in a loop."""
    from amrepair.align import align
    from amrepair.deficit import compute_deficit, measured_regions
    from amrepair.frames import Transform
    from amrepair.regions import detect
    from amrepair.scans import read_scan
    from amrepair.template import open_template

    field, here = open_template(template), Transform.identity("build", "template")

    def one(path: Path) -> None:
        scan = read_scan(path, frame="scanner")
        found = align(scan, field, rng=np.random.default_rng(0))
        placed = scan.moved(found.template_from_scan)
        anomaly = detect(placed, field)
        deficit = compute_deficit(placed, field, anomaly, build_from_template=here)
        measured_regions(anomaly, deficit)

    return one


def overhead(folder: Path, template: Path, out: Path) -> dict[str, float]:
    """Processor time of a batch beside the same by hand, scan by scan in one process."""
    from amrepair.batch import BatchKind, BatchOptions, run_batch

    paths, hand = sorted(folder.glob("*.ply")), by_hand(template)
    spent_s: dict[str, list[float]] = {"hand": [], "batch": []}
    began_s = 0.0

    def alone(path: Path) -> None:
        before_s = time.process_time()
        hand(path)
        spent_s["hand"].append(time.process_time() - before_s)

    def turn(stage: str, done: float, total: float) -> None:
        nonlocal began_s
        k = int(done) - 1
        if stage == "scans" and k == len(spent_s["batch"]):
            spent_s["batch"].append(time.process_time() - began_s)
            for path in paths[k : k + 2] if k % 2 == 0 else ():
                alone(path)
        if stage == "scans":
            began_s = time.process_time()

    alone(paths[0])  # kernels are loaded
    spent_s["hand"].clear()
    shutil.rmtree(out, ignore_errors=True)
    run_batch(
        str(folder), options=BatchOptions(BatchKind.DETECT), template=template, out=str(out),
        executor="serial", progress=turn,
    )  # fmt: skip
    end_s = time.process_time() - began_s
    by_hand_s, batch_s = sum(spent_s["hand"]), sum(spent_s["batch"])
    pairs = np.array(spent_s["batch"]) / np.array(spent_s["hand"])
    return {
        "by_hand_ms_a_scan": 1e3 * by_hand_s / len(paths),
        "batch_ms_a_scan": 1e3 * batch_s / len(paths),
        "end_ms": 1e3 * end_s,
        "overhead": (batch_s + end_s) / by_hand_s - 1.0,
        "overhead_median_pair": float(np.median(pairs)) - 1.0,
    }


def cost_of(command: list[str]) -> tuple[float, float]:
    """Seconds of the clock and of processors that a command and its children take."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began_s = time.monotonic()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall_s = time.monotonic() - began_s
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return wall_s, spent


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scans", type=int, default=160)
    parser.add_argument("--points", type=int, default=3_000)
    parser.add_argument("--out", type=Path, default=Path("out/bench-batch"))
    parser.add_argument("--overhead", action="store_true", help="measure that, and no more")
    parser.add_argument("--hand", nargs=2, type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.hand:
        folder, field = asked.hand
        one = by_hand(field)
        for path in sorted(folder.glob("*.ply")):
            one(path)
        return
    from batch_bench import write_scans, write_template

    asked.out.mkdir(parents=True, exist_ok=True)
    template = write_template(asked.out / "lug.safetensors")
    counts = (asked.scans // 4, asked.scans)
    folders = [write_scans(asked.out / f"scans-{n}", n, points=asked.points) for n in counts]
    beside = overhead(folders[1], template, asked.out / "results")
    print({name: round(value, 4) for name, value in beside.items()}, flush=True)
    if asked.overhead:
        return
    ways = {"by hand": None, "serial": ("serial", 1), "process, 1 worker": ("process", 1),
            "process, 2 workers": ("process", 2)}  # fmt: skip
    if importlib.util.find_spec("ray"):
        ways["ray, 2 workers"] = ("ray", 2)
    rows = []
    for name, crew in ways.items():
        costs, told = [], {}
        for folder in folders:
            out = asked.out / "results"
            shutil.rmtree(out, ignore_errors=True)
            command = [sys.executable, "-W", "ignore"]
            if crew is None:
                command += [str(Path(__file__)), "--hand", str(folder), str(template)]
            else:
                command += ["-m", "amrepair", "batch", "detect", str(folder), "--template",
                            str(template), "--out", str(out), "--executor", crew[0],
                            "--workers", str(crew[1])]  # fmt: skip
            costs.append(cost_of(command))
            if crew is not None:
                told = json.loads((out / "batch.json").read_text())["cost"]
        scans = counts[1] - counts[0]
        row = {
            "way": name,
            "wall_s_a_scan": (costs[1][0] - costs[0][0]) / scans,
            "cpu_s_a_scan": (costs[1][1] - costs[0][1]) / scans,
            "start_cpu_s": costs[0][1] - counts[0] * (costs[1][1] - costs[0][1]) / scans,
        }
        if told:
            row |= {
                "worker_cpu_s_a_scan": told["cpu_s"] / counts[1],
                "worker_peak_mb": told["peak_mb"],
                "read_bytes_a_scan": told["read_bytes"] / counts[1],
            }
        rows.append(row)
        print({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}, flush=True)
    kept = sum(p.stat().st_size for p in (asked.out / "results").rglob("*") if p.is_file())
    said = {
        "machine": f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores",
        "scans": counts,
        "points": asked.points,
        "overhead": beside,
        "kept_bytes_a_scan": kept / counts[1],
        "rows": rows,
    }
    (asked.out / "bench.json").write_text(json.dumps(said, indent=2) + "\n")


if __name__ == "__main__":
    main()
