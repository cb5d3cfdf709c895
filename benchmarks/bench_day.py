"""A day of prints, one after another, in accelerated time: what is left behind by each.

    python benchmarks/bench_day.py --prints 20

A small part is printed again and again by one process: through the serial adapter on an emulated
printer, with its wire log, record, scans, report data and journal of looks, a void broken into
every print and repaired. After each print: resident memory of this process (after a collection of
garbage) and the most of it since the last print's end, open files, threads, child processes. Exits
with 1 where a file, a thread or a child is left, or where memory, or the most of it, grows by more
than `--most-mb-a-print` from the first quarter on.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import statistics
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from gcode.process import prepare

prepare()  # as the command lines do

import manifold3d as m3
import numpy as np
import trimesh

from amrepair.loop import Tape
from amrepair.report import report_of_loop
from amrepair.report.collect import loop_result
from amrepair.report.folder import RunFolder
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.run import prepare_run, simulate_run
from amrepair.template import MeshSdf
from gcode.profiles import load_setup

SIZE_MM = (16.0, 12.0, 2.4)
DEFECT = "void:diameter=5,layers=3,wall=1.5"


def left_behind() -> dict[str, int]:
    """What this process holds."""
    gc.collect()
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    resident_kb, most_kb = (int(status[what].split()[0]) for what in ("VmRSS", "VmHWM"))
    Path("/proc/self/clear_refs").write_text("5")  # proc(5): the most is counted anew
    here = str(os.getpid())
    children = Path(f"/proc/self/task/{here}/children").read_text().split()
    return {
        "rss_kb": resident_kb,
        "most_kb": most_kb,
        "files": sum(1 for _ in Path("/proc/self/fd").iterdir()),
        "threads": threading.active_count(),
        "system_threads": sum(1 for _ in Path("/proc/self/task").iterdir()),
        "children": len(children),
    }


def one_print(template: MeshSdf, seed: int, folder: Path) -> dict[str, Any]:
    """Print, break, mend, tell."""
    began = time.perf_counter()
    setup = load_setup()
    prepared = prepare_run(template, setup, [parse_defect(DEFECT)], title="day", seed=seed)
    kept = RunFolder(folder)
    run = simulate_run(
        prepared,
        wire_log=folder / "wire.log",
        record=kept.record,
        begun=lambda pose, printer: Tape(folder),
    )
    ratio = run.repaired_ratio
    result = loop_result(
        run.report, repaired_ratio=ratio, gcode=None, seed=seed, seconds={}, setup=setup
    )
    report_of_loop(run.report, result, title="day", setup=setup, expected=prepared.part)
    return {
        "repaired": None if ratio is None else round(ratio, 3),
        "repairs": result["iterations"],
        "clock_s": round(run.printer_clock_s),
        "seconds": round(time.perf_counter() - began, 1),
    }


def day(prints: int) -> list[dict[str, Any]]:
    """So many prints in a row; what each came to and left."""
    solid = m3.Manifold.cube(SIZE_MM).to_mesh64()
    mesh = trimesh.Trimesh(np.array(solid.vert_properties)[:, :3], np.array(solid.tri_verts))
    template = MeshSdf.from_mesh(mesh)
    rows = []
    for number in range(prints):
        with tempfile.TemporaryDirectory() as folder:
            row = one_print(template, number, Path(folder))
        rows.append({"print": number + 1, **row, **left_behind()})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def verdict(rows: list[dict[str, Any]], most_kb: float) -> list[str]:
    """What is wrong, in words; nothing where all is well."""
    wrong = []
    settled = rows[len(rows) // 4 :]  # caches, compiled code and arenas have their size by then
    for what in ("files", "threads", "children"):
        if settled[-1][what] > settled[0][what]:
            wrong.append(f"{what}: {settled[0][what]} became {settled[-1][what]}")
    x = np.array([row["print"] for row in settled], float)
    for what, words in (("rss_kb", "memory"), ("most_kb", "the most memory")):
        y = np.array([row[what] for row in settled], float)
        a_print_kb = float(np.polyfit(x, y, 1)[0]) if len(x) > 1 else 0.0
        print(f"{words} {y[0] / 1024:.1f} to {y[-1] / 1024:.1f} MB, {a_print_kb:.0f} kB a print")
        if a_print_kb > most_kb:
            wrong.append(f"{words} grows by {a_print_kb:.0f} kB a print")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--prints", type=int, default=20)
    parser.add_argument("--most-mb-a-print", type=float, default=1.0)
    args = parser.parse_args()
    rows = day(args.prints)
    hours = sum(row["clock_s"] for row in rows) / 3600
    print(
        f"{len(rows)} prints, {hours:.1f} h of the printer's clock in "
        f"{sum(row['seconds'] for row in rows):.0f} s, median repaired "
        f"{statistics.median(row['repaired'] for row in rows):.3f}"
    )
    wrong = verdict(rows, 1024 * args.most_mb_a_print)
    sys.exit("; ".join(wrong) if wrong else 0)


if __name__ == "__main__":
    main()
