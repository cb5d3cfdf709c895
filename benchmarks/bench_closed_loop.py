"""The closed loop's table: additive defects × parts × seeds, judged by the simulated world's truth.

    AMREPAIR_DATA=… python benchmarks/bench_closed_loop.py --next 10   # run ten cases not yet run
    python benchmarks/bench_closed_loop.py --case knob void 2          # run one
    python benchmarks/bench_closed_loop.py --table                     # what there is so far

Results are lines of JSON in `--results`, one per case, so the table can be made in pieces. Three
parts are ours, three real (named by `AMREPAIR_DATA`); they are scaled so that a case takes seconds
to a minute. Truth is the world against a reference printed by the same motion without the defect.

A look follows the last layer of a defect, as if it had been found late; `--each` takes one after
each of its layers (`amrepair loop --every 1`), where what fell is not yet covered.

`--scanner recorded:FILE` looks with the noise of a real scanner (`record_scanner.py` makes FILE).

The loop prints on the emulated firmware, fed in this process, and the job ends where the defect has
been repaired: a case takes a tenth of the time. `--wire` prints all of it through the serial
adapter and a pseudo-terminal; figures differ by no more than what wandering flow makes of them.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gcode.process import prepare

prepare()  # as the command lines do

import measured_page

from amrepair.loop import LoopOptions, LoopReport, Stop, plan_stops, run_loop
from amrepair.loop.sites import sites
from amrepair.policy import PolicyOptions
from amrepair.simulate.defects import parse_defect
from amrepair.simulate.parameters import DEFAULT_SCANNER, load_world
from amrepair.simulate.run import PreparedRun, prepare_run, set_stage, simulate_run
from amrepair.simulate.stage import DefectTruth
from amrepair.template import load_mesh, load_or_fit
from gcode.firmware import FirmwareCore, MotionBatch
from gcode.hosts.file import FilePrinter
from gcode.hosts.port import PrintableProgram, PrintReport
from gcode.profiles import load_setup
from gcode.progress import Progress, silent

OURS = Path(__file__).parents[1] / "examples" / "parts"
# name: file, factor
PARTS: dict[str, tuple[str, float]] = {
    "bracket": ("bracket.stl", 0.6),
    "knob": ("knob.stl", 1.0),
    "pebble": ("pebble.stl", 1.0),
    "extruder-idler": ("prusa-extruder-idler.stl", 1.0),
    "y-belt-idler": ("prusa-y-belt-idler.stl", 0.8),
    "y-rod-holder": ("prusa-y-rod-holder.stl", 1.0),
}
DEFECTS = ("void", "missing_beads", "under_extrusion", "chip")
SEEDS = (0, 1, 2)
POLICY = PolicyOptions(most_passes=2)
Case = tuple[str, str, int]


def cases(parts: Sequence[str]) -> list[Case]:
    """Every case, one seed of all before the next seed of any."""
    return [(part, kind, seed) for seed in SEEDS for part in parts for kind in DEFECTS]


def part_file(name: str) -> Path:
    """Where a part lies.

    Raises
    ------
    SystemExit
        If it is a real part and nobody said where those are.
    """
    file = PARTS[name][0]
    if (OURS / file).is_file():
        return OURS / file
    data = os.environ.get("AMREPAIR_DATA")
    if not data:
        raise SystemExit(f"{name} is a real part: set AMREPAIR_DATA, or leave it out with --parts")
    return Path(data) / "parts" / file


class CorePrinter(FilePrinter):
    """The emulated firmware without a wire; of the job it prints no more than up to `last`."""

    def __init__(self, prepared: PreparedRun, last: Stop) -> None:
        super().__init__(Path(os.devnull))
        profile = prepared.setup.printer
        self._core = FirmwareCore(profile, profile.dialect)
        self._core.power_up(silent=True)
        self._job, self._last_line = prepared.checked, last.line

    def connect(self) -> None:
        """Nothing is to be opened."""

    def close(self) -> None:
        """Nothing is to be closed."""

    def print(
        self,
        checked: PrintableProgram,
        *,
        lines: range | None = None,
        progress: Progress = silent,
    ) -> PrintReport:
        """Carry out a program, or a part of it."""
        first, end = (lines.start, lines.stop) if lines else (0, checked.program.text.count("\n"))
        if checked is not self._job or first < self._last_line:
            for line in checked.lines(first, end):
                command = line.partition(";")[0].strip()
                if command:
                    self._core.feed(command.encode() + b"\n")
                    self._core.run()
                    self._core.take_output()
        return PrintReport(True, end - first, 0, 0, 0, 0, 0.0, end, (0.0, 0.0, 0.0), first)

    def take_motion(self) -> MotionBatch:
        """What was executed since the last call."""
        self._core.feed(b"M400\n")
        self._core.run()
        self._core.take_output()
        executed = self._core.machine.planner.executed
        motion = MotionBatch.from_bytes(executed.tobytes())
        del executed[:]
        return motion


def stops_of(prepared: PreparedRun, *, each: bool) -> tuple[Stop, ...]:
    """Where the loop looks: after the defect's last layer, or after each of its layers."""
    defect = prepared.defects[0]
    if each and defect.layers:
        return plan_stops(prepared.job, defect.layers, final=False)
    return (next(stop for stop in prepared.stops if stop.layer_index == defect.last_layer),)


def run_without_wire(
    prepared: PreparedRun, *, each: bool, scanner: str = DEFAULT_SCANNER
) -> tuple[LoopReport, DefectTruth]:
    """The loop up to the last stop at which the defect is seen."""
    stops = stops_of(prepared, each=each)
    printer = CorePrinter(prepared, stops[-1])
    stage = set_stage(prepared, printer.take_motion, scanner=scanner)
    report = run_loop(
        prepared.job,
        prepared.checked,
        printer,
        stage,
        sites(
            prepared.job,
            prepared.template,
            prepared.build_from_template,
            prepared.setup,
            by_beads=prepared.by_beads,
        ),
        stops=stops,
        options=LoopOptions(policy=POLICY, seed=prepared.seed),
    )
    stage.finish(measure=True)  # a layer whose flow was changed is printed after the last look
    return report, stage.truth[0]


def run_case(
    case: Case, process: str, *, wire: bool, each: bool = False, scanner: str = DEFAULT_SCANNER
) -> dict[str, Any]:
    """Print, break and mend one part; what became of it."""
    part, kind, seed = case
    began = time.perf_counter()
    mesh = load_mesh(part_file(part))
    mesh.apply_scale(PARTS[part][1])
    setup = load_setup(process=process)
    prepared = prepare_run(load_or_fit(mesh), setup, [parse_defect(kind)], title=part, seed=seed)
    if wire:
        run = simulate_run(prepared, policy=POLICY, scanner=scanner)
        report, truth = run.report, run.truth[0]
    else:
        report, truth = run_without_wire(prepared, each=each, scanner=scanner)
    return (
        {"part": part, "defect": kind, "seed": seed, "process": process, "scanner": scanner}
        | figures(report, truth, prepared.defects[0].layers)
        | {"seconds": round(time.perf_counter() - began, 1)}
    )


def figures(report: LoopReport, truth: DefectTruth, layers: Sequence[int]) -> dict[str, Any]:
    """What the table needs of one run with one defect in some layers."""
    looks, elsewhere = [], []
    for look in report.looks:
        here = look.stop.label == truth.label or look.stop.layer_index in layers
        (looks if here else elsewhere).append(look)
    first = {look.stop.label: look.plan for look in reversed(looks)}.values()
    passes = Counter(look.stop.label for look in looks if look.printed)
    return {
        "missing_mm3": round(truth.missing_mm3, 2),
        "deficit_mm3": round(sum(plan.deficit.missing_mm3 for plan in first), 2),
        "beads_mm3": round(
            sum(k.plan.patch.beads_mm3 for k in looks if k.printed and k.plan.patch), 2
        ),
        "unreachable_mm3": round(sum(plan.unreachable_mm3 for plan in first), 2),
        "filled_ratio": round(truth.filled_mm3 / truth.missing_mm3, 4),
        "added_ratio": round(truth.added_mm3 / truth.missing_mm3, 4),
        "surface_ratio": round(truth.surface_ratio, 4),
        "iterations": max(passes.values(), default=0),
        "elsewhere": sum(look.printed for look in elsewhere),
        "refused": "; ".join(plan.refused for plan in first if plan.refused),
        "ended": report.stopped,
    }


PAGE_HEADER = (
    "defect", "cases", "filled, mean", "worst", "surface, mean", "worst", "added, mean", "worst",
    "repairs, most",
)  # fmt: skip


def page_rows(rows: list[dict[str, Any]]) -> list[tuple[object, ...]]:
    """By defect and in all."""
    told: list[tuple[object, ...]] = []
    for kind in (*DEFECTS, "all"):
        mine = [row for row in rows if kind in {row["defect"], "all"}]
        if not mine:
            continue
        values = {
            key: [row[key] for row in mine]
            for key in ("filled_ratio", "surface_ratio", "added_ratio", "iterations")
        }
        mean = {key: statistics.fmean(found) for key, found in values.items()}
        worst = {
            "filled_ratio": min(values["filled_ratio"]),
            "surface_ratio": min(values["surface_ratio"]),
            "added_ratio": max(values["added_ratio"]),
        }
        figures = [f"{value:.3f}" for key in worst for value in (mean[key], worst[key])]
        told.append((kind, len(mine), *figures, max(values["iterations"])))
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--next", type=int, default=0, help="how many cases not yet run")
    parser.add_argument("--case", nargs=3, metavar=("PART", "DEFECT", "SEED"))
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--process", default="repair_0.20")
    parser.add_argument("--results", type=Path, default=Path("out/closed-loop.jsonl"))
    parser.add_argument("--each", action="store_true", help="a look after each layer of a defect")
    parser.add_argument("--wire", action="store_true", help="through the serial adapter, all of it")
    parser.add_argument("--scanner", default=DEFAULT_SCANNER, help="of the world, or recorded:FILE")
    parser.add_argument("--table", action="store_true")
    measured_page.add_page_option(parser)
    args = parser.parse_args()
    load_world().scanner(args.scanner)  # refused before any work
    args.results.parent.mkdir(parents=True, exist_ok=True)
    text = args.results.read_text() if args.results.is_file() else ""
    rows = [json.loads(line) for line in text.splitlines()]
    rows = [row for row in rows if row.get("scanner", DEFAULT_SCANNER) == args.scanner]
    done = {(row["part"], row["defect"], row["seed"]) for row in rows}
    todo = [case for case in cases(args.parts) if case not in done][: args.next]
    if args.case:
        todo = [(args.case[0], args.case[1], int(args.case[2]))]
    for case in todo:
        row = run_case(case, args.process, wire=args.wire, each=args.each, scanner=args.scanner)
        rows.append(row)
        with args.results.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(json.dumps(row), flush=True)
    told = page_rows([row for row in rows if row["part"] in args.parts])
    if args.table:
        print(measured_page.table(PAGE_HEADER, told))
    if args.page:
        measured_page.write_rows("bench_closed_loop", PAGE_HEADER, told)


if __name__ == "__main__":
    main()
