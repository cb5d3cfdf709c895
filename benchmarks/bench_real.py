"""Real range scans: how silent `amrepair detect` is on sound ones, and what it finds of dents.

    AMREPAIR_DATA=… python benchmarks/bench_real.py                     # all of the bunny
    python benchmarks/bench_real.py --folder DIR --conf DIR/x.conf      # another object
    python benchmarks/bench_real.py --only sound views --format json    # a part of it, as JSON
    python benchmarks/bench_real.py --with "--calibration NAME"         # options for detect

Cases are made once from range images and their `.conf` (see `real_scans`), then every scan goes
through `python -m amrepair detect SCAN --template PART --out DIR --json` in a process of its own:
only its JSON, its time and its memory are judged. A region belongs to the dent in whose box at
least half of its own lies; a dent's volume is the sum over what belongs to it and is missing.

Beside it, in the same run, the baseline: local medians against a tolerance, at the true pose, no
noise model (`baseline_regions`). `load` is the sound scan with 470,000 points, for time and memory.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measured_page
import numpy as np
from real_scans import Cases, Dent, Surface, moved, read_points
from real_tables import PAGE_HEADER, Row, page_row, tables
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

LOAD_POINTS = 470_000
LEAST_AREA_MM2, LEAST_MISSING_MM3 = 2.0, 1.0
MARGIN_MM, LEAST_SHARE = 0.5, 0.5  # a region is a dent's where half of its box lies so near to it
# The baseline's own figures: radius of its medians, sites, and tolerance for merged and for views.
BASE_RADIUS_MM, BASE_SITE_MM, BASE_SPREAD, BASE_LEAST = 2.5, 0.6, 1.5, 8
BASE_MERGED_MM, BASE_VIEW_MM, BASE_FAR_MM = 0.15, 0.3, 10.0
KINDS = ("sound", "dents", "views", "load")


@dataclass(frozen=True, slots=True)
class Run:
    """What one process said and took; `result` is None where it refused."""

    result: dict[str, Any] | None
    refused: str
    wall_s: float
    peak_gb: float


@dataclass(frozen=True, slots=True)
class Case:
    """A scan, where it lies (template from scan), and what was taken from it."""

    kind: str
    name: str
    scan: Path
    pose: np.ndarray
    dents: Sequence[Dent]


def cases(made: Cases, kinds: Sequence[str], seeds: int) -> Iterator[Case]:
    """Every scan that is asked for, made where it is not there yet."""
    here = np.eye(4)
    if "sound" in kinds:
        made.truth  # noqa: B018
        yield Case("sound", "sound", made.sound, here, ())
    if "dents" in kinds:
        for seed in range(1, seeds + 1):
            path, dents = made.dents(seed)
            yield Case("dents", f"dents-{seed}", path, here, dents)
    if "views" in kinds:
        for (path, pose), source in zip(
            made.view_poses().items(), made.truth["sources"], strict=True
        ):
            yield Case("view", Path(source).stem, path, pose, ())
    if "load" in kinds:
        yield Case("load", f"{LOAD_POINTS:,} points", made.loaded(LOAD_POINTS), here, ())


def run(command: Sequence[str], limit_s: float) -> Run:
    """One process of amrepair: its JSON, the clock, and the most memory that it held."""
    began = time.perf_counter()
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as complaint:
        process = subprocess.Popen(
            [sys.executable, "-m", "amrepair", *command], stdout=said, stderr=complaint
        )
        status, peak_gb = _waited(process.pid, began + limit_s, process.kill)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall_s = time.perf_counter() - began
        said.seek(0)
        complaint.seek(0)
        text, why = said.read().decode(), complaint.read().decode().strip()
    try:
        result = json.loads(text)
    except json.JSONDecodeError:
        result = None
    if result is None or "error" in result:
        why = why if result is None else result["error"]
        late = f"no answer in {limit_s:g} s; " if wall_s > limit_s else ""
        result, why = None, f"{late}exit {process.returncode}: {why[-300:]}"
    return Run(result, "" if result else why, wall_s, peak_gb)


def _waited(pid: int, until_s: float, kill: Callable[[], None]) -> tuple[int, float]:
    """Exit status of a child, killed where it takes too long, and the most memory that it held.

    Linux counts what a parent held before the child's first instruction as the child's own
    (`ru_maxrss`); the kernel's high-water mark of the running process begins anew.
    """
    peak_gb = 0.0
    while True:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return status, peak_gb
        if time.perf_counter() > until_s:
            kill()
            return os.waitpid(pid, 0)[1], peak_gb
        peak_gb = max(peak_gb, _peak_gb(pid))
        time.sleep(0.02)


def _peak_gb(pid: int) -> float:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return next((int(w.split()[1]) / 1024**2 for w in lines if w.startswith("VmHWM")), 0.0)


def judged(case: Case, found: Run) -> Row:
    """The figures of one case."""
    points = read_points(case.scan)
    row: Row = {
        "kind": case.kind,
        "case": case.name,
        "points": len(points),
        "wall_s": round(found.wall_s, 2),
        "peak_gb": round(found.peak_gb, 2),
        "refused": found.refused,
    }
    if found.result is None:
        return row
    regions = found.result["regions"]
    theirs = [belongs_to(region, case.dents) for region in regions]
    alone = [region for region, dent in zip(regions, theirs, strict=True) if dent is None]
    missing = [r for r in alone if r["label"] == "missing" and r["volume_mm3"] > LEAST_MISSING_MM3]
    pose = np.array(found.result["template_from_scan"])
    off = moved(points, pose) - moved(points, case.pose)
    return row | {
        "false": len(alone),
        "false_2mm2": sum(region["area_mm2"] >= LEAST_AREA_MM2 for region in alone),
        "false_missing_1mm3": len(missing),
        "false_missing_mm3": round(sum(r["volume_mm3"] for r in missing), 2),
        "worst": _largest(alone),
        "off_mm": round(float(np.sqrt((off**2).sum(axis=1).mean())), 3),
        "stages_s": round(sum(found.result["seconds"].values()), 2),
        "dents": [
            told(dent, [r for r, k in zip(regions, theirs, strict=True) if k == number])
            for number, dent in enumerate(case.dents)
        ],
    }


def _largest(regions: Sequence[dict[str, Any]]) -> str:
    if not regions:
        return ""
    most = max(regions, key=lambda region: region["volume_mm3"])
    return f"{most['label']} {most['volume_mm3']:.2f} mm³, {most['area_mm2']:.1f} mm²"


def belongs_to(region: dict[str, Any], dents: Sequence[Dent]) -> int | None:
    """Number of the dent in whose box most of a region's box lies; None where less than half does.

    A region that reaches far beyond a dent says nothing of it: the dent drowns in it.
    """
    low, high = np.array(region["box_mm"], dtype=float).reshape(2, 3)
    size = np.maximum(high - low, 1e-6)
    shares = []
    for dent in dents:
        box = np.array(dent.box_mm) + np.array([[-MARGIN_MM], [MARGIN_MM]])
        common = np.minimum(low + size, box[1]) - np.maximum(low, box[0])
        shares.append(float(np.prod(np.clip(common / size, 0.0, 1.0))))
    if not shares or max(shares) < LEAST_SHARE:
        return None
    return int(np.argmax(shares))


def told(dent: Dent, regions: Sequence[dict[str, Any]]) -> Row:
    """What was found of one dent."""
    mine = [region for region in regions if region["label"] == "missing"]
    volume = sum(region["volume_mm3"] for region in mine)
    return {
        "depth_mm": dent.depth_mm,
        "volume_mm3": round(dent.volume_mm3, 2),
        "one_sided": dent.one_sided,
        "found": bool(mine),
        "parts": len(mine),
        "error": round(volume / dent.volume_mm3 - 1.0, 3) if mine else None,
        "told_depth_mm": max((region["depth_mm"] for region in mine), default=None),
        "excess_parts": len(regions) - len(mine),
    }


def baseline_regions(
    surface: Surface, points: np.ndarray, tolerance_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Sites (n, 3) that stand out, and which region each is of, by local medians alone."""
    value = surface.deviation_mm(points)
    near = np.abs(value) < BASE_FAR_MM
    points, value = points[near], value[near]
    _, cell = np.unique(np.floor(points / BASE_SITE_MM).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    site = np.stack([np.bincount(cell, points[:, k]) / count for k in range(3)], axis=1)
    order = np.argsort(cell, kind="stable")
    median = np.array([np.median(v) for v in np.split(value[order], np.cumsum(count)[:-1])])
    out = np.zeros(len(site), dtype=bool)
    for k, around in enumerate(cKDTree(site).query_ball_point(site, BASE_RADIUS_MM)):
        if len(around) >= BASE_LEAST:
            low, middle, high = np.percentile(median[around], [16, 50, 84])
            out[k] = abs(middle) > tolerance_mm + BASE_SPREAD * (high - low) / 2
    found = site[out]
    if not len(found):
        return found, np.zeros(0, dtype=int)
    pairs = cKDTree(found).query_pairs(BASE_RADIUS_MM, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(found), len(found)))
    return found, connected_components(graph)[1]


def baseline(case: Case, surface: Surface) -> Row:
    """The peer's figures of a case: regions apart from dents, and which dents it finds."""
    merged = case.kind != "view"
    began = time.perf_counter()
    points = moved(read_points(case.scan), case.pose)
    site, region = baseline_regions(surface, points, BASE_MERGED_MM if merged else BASE_VIEW_MM)
    at = [
        np.flatnonzero(np.linalg.norm(site - dent.centre_mm, axis=1) < dent.ball_mm)
        for dent in case.dents
    ]
    theirs = np.unique(region[np.concatenate(at)]) if at else np.zeros(0, dtype=int)
    area = np.bincount(region) * BASE_SITE_MM**2
    alone = np.setdiff1d(np.arange(len(area)), theirs)
    return {
        "base_false": len(alone),
        "base_false_2mm2": int((area[alone] >= LEAST_AREA_MM2).sum()),
        "base_found": [len(sites) > 0 for sites in at],
        "base_s": round(time.perf_counter() - began, 2),
    }


def source(args: argparse.Namespace) -> tuple[Path, Path] | None:
    """Folder and .conf of the range images; None where nobody said where they are."""
    if args.folder is not None:
        found = sorted(args.folder.glob("*.conf"))
        if args.conf is None and len(found) != 1:
            raise SystemExit(f"{args.folder} has {len(found)} .conf files: name one with --conf")
        return args.folder, args.conf or found[0]
    data = os.environ.get("AMREPAIR_DATA")
    if not data:
        return None
    folder = Path(data) / "real" / "bunny"
    return folder, folder / "bun.conf"


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, help="range images (default: the bunny's)")
    parser.add_argument("--conf", type=Path, help="their poses")
    parser.add_argument("--unit-mm", type=float, default=1000.0, help="of the files: metres")
    parser.add_argument("--seeds", type=int, default=10, help="scans with dents")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "amrepair-real")
    parser.add_argument("--with", dest="options", default="", help="options for detect, quoted")
    parser.add_argument("--limit-s", type=float, default=300.0, help="for one scan")
    parser.add_argument("--format", choices=("markdown", "json"), default="markdown")
    measured_page.add_page_option(parser)
    return parser.parse_args()


def main() -> None:
    """Every case, then the tables (or a line of JSON for each)."""
    args = arguments()
    where = source(args)
    if where is None:
        print("skipped: set AMREPAIR_DATA, or name range images with --folder and --conf")
        return
    made = Cases(*where, args.cache, args.unit_mm)
    made.truth  # noqa: B018
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as out:
        # a mesh is fitted once and kept: not a part of anybody's time
        first = next(iter(made.view_poses()))
        fitted = run(["align", str(first), "--template", str(made.part), "--json"], args.limit_s)
        for case in cases(made, args.only, args.seeds):
            command = ["detect", str(case.scan), "--template", str(made.part), "--out", out]
            found = run([*command, "--json", *shlex.split(args.options)], args.limit_s)
            row = {"object": made.name} | judged(case, found) | baseline(case, made.surface)
            rows.append(row)
            if args.format == "json":
                print(json.dumps(row), flush=True)
            else:
                print(f"{case.name}: {row['wall_s']} s", file=sys.stderr, flush=True)
    if args.format == "markdown":
        told = made.truth
        print(
            f"{made.name}: {told['points']:,} points in {len(told['views'])} views, "
            f"{told['points_left_out']:,} left out, deviation (MAD) "
            f"{told['deviation_mad_mm']:.3f} mm, {told['over_half_mm']:.1%} over 0.5 mm; template "
            f"{fitted.wall_s:.0f} s; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
            f"Python {platform.python_version()}; cases in {made.folder}\n"
        )
        print(tables(rows))
    if args.page:
        measured_page.write_rows("bench_real", PAGE_HEADER, [page_row(rows, made.name)])


if __name__ == "__main__":
    main()
