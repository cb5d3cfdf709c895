"""The stated rate of false regions, counted: scans of sound parts, real and simulated.

    AMREPAIR_DATA=… python benchmarks/bench_promise.py --out out/promise          # 200 of each
    python benchmarks/bench_promise.py --folder DIR --conf DIR/x.conf --only real # another object
    python benchmarks/bench_promise.py --out DIR --report                         # the tables alone

Every scan goes through the library's own `align` and `detect` in this process. A line of JSON a
scan is kept in the folder of `--out`, and a call goes on after the scans that are there. Printed
are false regions a scan, by kind, beside the stated rate and the interval of 95 % that a Poisson
count leaves (Garwood 1936). A scan that `align` refuses is counted apart, and so is one that it
lays over 0.5 mm off: regions of the test are not judged there. Nor is one over surface of the
reference that no view ever saw, which whoever made it guessed.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import measured_page
import numpy as np
import trimesh
from promise_scans import RealScans, SimulatedScans, Sound
from real_scans import Cases, moved, read_views
from record_scanner import residuals
from recordings import record, save_recording
from scipy.stats import chi2

from amrepair.align import align
from amrepair.deficit import compute_deficit, measured_regions
from amrepair.errors import AmrepairError
from amrepair.frames import Transform, in_box
from amrepair.regions import AnomalyMap, Label, Region, detect
from amrepair.regions.options import RegionOptions
from amrepair.simulate.recording import Recording, load_recording
from amrepair.template import open_template
from amrepair.template.port import Template

Row = dict[str, Any]
OURS = Path(__file__).parents[1] / "examples" / "parts"
PARTS = (
    "frame-guide", "prusa-extruder-idler", "prusa-fan-shroud", "prusa-print-fan-support",
    "prusa-y-belt-idler", "prusa-y-motor-holder", "prusa-z-axis-top",
)  # fmt: skip
ASTRAY_MM = 0.5
MOST_UNSEEN = 0.5  # of the surface that a region takes
SURFACE_STEP_MM = RegionOptions().spacing_mm
SURE = 0.95
IN_PLACE = Transform.identity("build", "template")


def interval(count: int, scans: int) -> tuple[float, float]:
    """The rate's interval that a Poisson count leaves (exact, Garwood 1936)."""
    tail = 0.5 * (1 - SURE)
    low = 0.5 * float(chi2.ppf(tail, 2 * count)) if count else 0.0
    return low / scans, 0.5 * float(chi2.isf(tail, 2 * count + 2)) / scans


def judged(
    sound: Sound,
    template: Template,
    unseen_share: Callable[[np.ndarray], float] = lambda places_mm: 0.0,
) -> Row:
    """Lay one scan and look for regions in it.

    `unseen_share` says how much of some of the reference's surface nobody ever saw. Where that is
    most of what a region takes, what is right is not known: it is told, but not counted.
    """
    row: Row = {"kind": sound.kind, "points": len(sound.scan)}
    began = time.process_time()
    try:
        found = align(sound.scan, template, rng=np.random.default_rng(0))
    except AmrepairError as e:
        return row | {"refused": str(e)[:200]}
    row["align_s"] = round(time.process_time() - began, 2)
    placed = sound.scan.moved(found.template_from_scan)
    truly = moved(sound.scan.points_mm, sound.template_from_scan)
    poses = (found.template_from_scan, *found.symmetric_alternatives)
    off_mm = [
        float(np.sqrt(((pose.apply(sound.scan.points_mm) - truly) ** 2).sum(axis=1).mean()))
        for pose in poses
    ]
    row["off_mm"] = round(min(off_mm), 3)
    began = time.process_time()
    anomaly = detect(placed, template)
    row["detect_s"] = round(time.process_time() - began, 2)
    told = anomaly.regions
    if told:  # as the command line tells them
        deficit = compute_deficit(placed, template, anomaly, build_from_template=IN_PLACE)
        told = measured_regions(anomaly, deficit)
    assert anomaly.noise is not None
    guesses = [unseen_share(_surface_of(region, anomaly)) > MOST_UNSEEN for region in told]
    return row | {
        "false": len(told) - sum(guesses),
        "regions": [
            {
                "label": region.label.name.lower(),
                "volume_mm3": round(region.volume_mm3, 2),
                "area_mm2": round(region.area_mm2, 1),
                "depth_mm": round(region.depth_mm, 2),
                "box_mm": np.round(region.box_mm, 1).tolist(),
                "p": float(f"{region.p_value:.3g}"),
                "guess": guess,
            }
            for region, guess in zip(told, guesses, strict=True)
        ],
        "sigma_mm": round(anomaly.noise.sigma_mm, 4),
        "smallest_mm": [round(depth, 3) for _, depth in anomaly.noise.smallest_mm],
    }


def _surface_of(region: Region, anomaly: AnomalyMap) -> np.ndarray:
    """(m, 3) the template's surface that is gone in a region's box; all in there if none is."""
    places_mm = anomaly.template_points_mm
    inside = in_box(places_mm, *(region.box_mm + SURFACE_STEP_MM * np.array([[-1.0], [1.0]])))
    gone = inside & (anomaly.template_label == int(Label.MISSING))
    return np.asarray(places_mm[gone if gone.any() else inside])


class Kept:
    """Lines of JSON in a file; a call goes on after those that are there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text().splitlines() if path.is_file() else []
        self.rows: list[Row] = [json.loads(line) for line in lines]

    def add(self, row: Row) -> None:
        """One more line."""
        self.rows.append(row)
        with self.path.open("a") as file:
            file.write(json.dumps(row) + "\n")

    def lacks(self, numbers: Sequence[int]) -> list[int]:
        """Those of some numbers that have no line yet."""
        there = {row["number"] for row in self.rows}
        return [number for number in numbers if number not in there]


def run_real(cases: Cases, kept: Kept, numbers: Sequence[int]) -> None:
    """Every real scan that has no line yet."""
    lacking = kept.lacks(numbers)
    if not lacking:
        return
    cases.truth  # noqa: B018
    template = open_template(cases.part)
    made = RealScans(*cases.source[:2], cases.part, cases.source[2])
    for number in lacking:
        sound = made.made(number)
        row = judged(sound, template, made.unseen_share)
        kept.add({"number": number, "object": cases.name} | row)


def run_simulated(
    parts: list[Path], recording: Recording, kept: Kept, numbers: Sequence[int]
) -> None:
    """Every simulated scan that has no line yet."""
    made, templates = SimulatedScans(parts, recording), dict[Path, Template]()
    for number in kept.lacks(numbers):
        part = made.part_of(number)
        if part not in templates:
            templates[part] = open_template(part)
        row = judged(made.made(number), templates[part])
        kept.add({"number": number, "object": part.stem} | row)


def recording_of(cases: Cases, path: Path) -> Recording:
    """The object's residuals as a scanner of the simulated world, made once."""
    if not path.is_file():
        found = record(residuals(read_views(*cases.source)), source=cases.name)
        save_recording(found, path)
    return load_recording(path)


def usable(parts: Sequence[Path]) -> list[Path]:
    """Those that are closed meshes: their scans are cast against the file's own triangles."""
    return [part for part in parts if trimesh.load_mesh(part).is_watertight]


HEADER = (
    "scans", "judged", "refused", "astray", "with regions", "false regions a scan (95 %)",
    "stated", "missing over 1 mm³",
)  # fmt: skip
PAGE_HEADER = ("scans", "judged", "with regions", "false a scan (95 %)", "largest missing, mm³")


def rows_of(rows: Sequence[Row], stated: float) -> list[tuple[object, ...]]:
    """False regions a scan by kind, beside what is stated."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        for name in ("all", row["kind"].split(" of ")[0], row["object"]):
            groups.setdefault(name, []).append(row)
    told: list[tuple[object, ...]] = []
    for name, group in groups.items():
        refused = sum("refused" in row for row in group)
        laid = [row for row in group if "refused" not in row]
        fair = [row for row in laid if row["off_mm"] <= ASTRAY_MM]
        if not fair:
            continue
        missing = missing_of(fair)
        worst = f"{len(missing)}, largest {max(missing):.0f} mm³" if missing else "0"
        hit = sum(row["false"] > 0 for row in fair)
        told.append(
            (name, len(fair), refused, len(laid) - len(fair), hit, rate(fair), f"{stated:g}", worst)
        )
    return told


def rate(rows: Sequence[Row]) -> str:
    """False regions a scan, and the interval of 95 %."""
    false = sum(row["false"] for row in rows)
    low, high = interval(false, len(rows))
    return f"{false / len(rows):.3f} ({low:.3f} to {high:.3f})"


def missing_of(rows: Sequence[Row]) -> list[float]:
    """Volumes over 1 mm³ that are said to be missing."""
    regions = [
        region
        for row in rows
        for region in row["regions"]
        if region["label"] == "missing" and not region.get("guess")
    ]
    return [region["volume_mm3"] for region in regions if region["volume_mm3"] > 1.0]


def page_rows(rows: Sequence[Row], name: str) -> list[tuple[object, ...]]:
    """Of all scans of an object, or of simulated ones, and of each kind of them."""
    laid = [row for row in rows if row.get("off_mm", np.inf) <= ASTRAY_MM]
    groups: dict[str, list[Row]] = {name: laid}
    for row in laid:
        groups.setdefault(f"{name}, {row['kind'].split(',')[0]}", []).append(row)
    return [
        (
            name,
            len(fair),
            sum(row["false"] > 0 for row in fair),
            rate(fair),
            f"{max(missing_of(fair), default=0.0):.0f}",
        )
        for name, fair in groups.items()
        if fair
    ]


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, help="range images (default: the bunny's)")
    parser.add_argument("--conf", type=Path, help="their poses")
    parser.add_argument("--unit-mm", type=float, default=1000.0, help="of the files: metres")
    parser.add_argument("--scans", type=int, default=200, help="of each kind")
    parser.add_argument("--only", nargs="+", choices=("real", "simulated"))
    parser.add_argument("--out", type=Path, default=Path("out/promise"), help="lines of JSON")
    parser.add_argument("--cache", type=Path, default=Path(tempfile.gettempdir()) / "amrepair-real")
    parser.add_argument("--report", action="store_true", help="the tables of what is there alone")
    measured_page.add_page_option(parser)
    return parser.parse_args()


def main() -> None:
    """Every scan that has no line yet, then the tables."""
    args = arguments()
    data = os.environ.get("AMREPAIR_DATA")
    if args.folder is None and data is None:
        print("skipped: set AMREPAIR_DATA, or name range images with --folder and --conf")
        return
    folder = args.folder or Path(str(data)) / "real" / "bunny"
    cases = Cases(folder, args.conf or folder / "bun.conf", args.cache, args.unit_mm)
    stated, numbers = RegionOptions().false_regions, range(args.scans)
    for kind in args.only or ("real", "simulated"):
        kept = Kept(args.out / f"{kind if kind == 'simulated' else cases.name}.jsonl")
        if not args.report and kind == "real":
            run_real(cases, kept, numbers)
        elif not args.report:
            parts = sorted(OURS.glob("*.stl"))
            if data is not None:
                parts += [Path(data) / "parts" / f"{name}.stl" for name in PARTS]
            recording = recording_of(cases, args.out / f"{cases.name}.npz")
            run_simulated(usable(parts), recording, kept, numbers)
        table = measured_page.table(HEADER, rows_of(kept.rows, stated))
        print(f"\n{kind}, {kept.path}\n\n{table}")
        if args.page:
            named = page_rows(kept.rows, kind if kind == "simulated" else cases.name)
            measured_page.write_rows("bench_promise", PAGE_HEADER, named)


if __name__ == "__main__":
    main()
