"""Whether jobs pass the checker as printer makers' own scripts begin and end them.

    python benchmarks/bench_vendor_jobs.py                # the installed PrusaSlicer's bundles
    python benchmarks/bench_vendor_jobs.py --each         # and why each other one does not
    python benchmarks/bench_vendor_jobs.py --orca FOLDER  # OrcaSlicer's resources/profiles

A block is cut by the installed PrusaSlicer for every preset with a nozzle of 0.4 mm, with that
preset's own print and filament, and judged by its own settings (`gcode check JOB`): whoever prints
such jobs every day must not be told that they are wrong. What the slicer itself refuses is counted
apart.

OrcaSlicer's machines are written as its jobs (`orca_presets`; its profiles of January 2026). Of
what nobody had looked at, 126 of 191 passed of every other vendor's, the checker being tuned on the
rest, and then 44 of the 69 machines that came by August.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import trimesh
from orca_presets import OrcaPrinter, as_orca, orca_printers, prusa_settings

from gcode.check import Policy, find_refusals
from gcode.errors import GcodeError, InputError
from gcode.moves import Program
from gcode.profiles.finding import BUNDLES, find_presets
from gcode.profiles.importers.slicers import read_prusa
from gcode.profiles.own_settings import NO_HOSTS, own_settings

NOZZLE = "0.4"
BLOCK_MM = (12.0, 12.0, 4.0)
# What the command line does not take, or draws pictures.
LEFT_OUT = re.compile(r"compatible_|inherits|default_(print|filament)_profile|thumbnails")


@dataclass(frozen=True, slots=True)
class Case:
    """One printer's job: of which row, its name, what PrusaSlicer cuts it by, and for whom."""

    row: str
    name: str
    config: dict[str, str]
    orca: OrcaPrinter | None = None
    why_not: str = ""


def prusas(bundles: Path) -> Iterator[Case]:
    """Every printer of PrusaSlicer's bundles, and all settings of a job for it."""
    for preset in find_presets():
        if preset.kind != "printers" or preset.path.parent != bundles:
            continue
        text = preset.path.read_text(encoding="utf-8", errors="replace")
        printer = read_prusa(preset.path, text, preset.preset).values
        if printer.get("nozzle_diameter", NOZZLE).split(",")[0] != NOZZLE:
            continue
        made: dict[str, str] = {}
        for what in ("print", "filament"):
            name = printer.get(f"default_{what}_profile", "").split(";")[0].strip('"')
            with suppress(InputError):  # a printer of resin has neither
                made |= read_prusa(preset.path, text, f"{what}:{name}").values
        made |= printer
        kept = {key: v for key, v in made.items() if not LEFT_OUT.match(key)}
        yield Case("PrusaSlicer's", preset.name, kept)


def orcas(profiles: Path) -> Iterator[Case]:
    """Every machine of OrcaSlicer's; Bambu Lab's, which no host drives, apart."""
    for printer in orca_printers(profiles):
        row = "Bambu Lab's" if printer.name.startswith(NO_HOSTS) else "OrcaSlicer's"
        name = f"{printer.vendor}: {printer.name}"
        try:
            yield Case(row, name, prusa_settings(printer, BLOCK_MM), printer)
        except (InputError, ValueError, KeyError, TypeError) as error:
            yield Case(row, name, {}, printer, f"its scripts are not expanded: {error!r}")


def cut(config: dict[str, str], folder: Path, number: int) -> tuple[str | None, str]:
    """The block's job by these settings; None where the slicer refuses, and what it says."""
    program = shutil.which("prusa-slicer")
    if program is None:
        raise SystemExit("prusa-slicer is not on the path; install it")
    ini, gcode = folder / f"{number}.ini", folder / f"{number}.gcode"
    ini.write_text("".join(f"{key} = {value}\n" for key, value in config.items()))
    words = ["--load", str(ini), "--export-gcode", "-o", str(gcode), str(folder / "block.stl")]
    ran = subprocess.run([program, *words], capture_output=True, check=False)
    text = gcode.read_text(errors="replace") if gcode.is_file() else None
    return text, ran.stderr.decode(errors="replace").strip()


def refusals(name: str, text: str) -> list[str]:
    """What the checker has against a job on its own printer."""
    own = own_settings(text, f"{name}.gcode")
    if own is None:
        return ["no settings in it"]
    try:
        setup = own.setup()
    except GcodeError as error:
        return [str(error)]
    other = own.differs_from(setup.printer)
    program = Program(text, setup.printer.dialect)
    judged = setup if own.flow_is_told else setup.melting_all()
    found = find_refusals(program, judged, policy=Policy.DANGER)
    return [*([other] if other else []), *(str(one) for one in found)]


def job_of(case: Case, folder: Path, number: int) -> tuple[str | None, str]:
    """A case's job; None where no slicer cuts it, and why."""
    text, why = (None, case.why_not) if case.why_not else cut(case.config, folder, number)
    if text is not None and case.orca is not None:
        try:
            text = as_orca(text, case.orca, BLOCK_MM)
        except (InputError, ValueError, TypeError) as error:
            return None, repr(error)
    return text, why


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bundles", type=Path, default=Path(BUNDLES[0]))
    parser.add_argument("--orca", type=Path, help="OrcaSlicer's resources/profiles")
    parser.add_argument("--rows", default="", help="only rows that begin so")
    parser.add_argument("--each", action="store_true", help="what speaks against each other one")
    parser.add_argument("--keep", type=Path, help="write the jobs into this folder")
    args = parser.parse_args()
    cases = list(prusas(args.bundles) if args.orca is None else orcas(args.orca))
    cases = [case for case in cases if case.row.startswith(args.rows)]
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(2) as pool:
        folder = Path(name)
        block = trimesh.creation.box(BLOCK_MM)
        block.apply_translation((0.0, 0.0, 0.5 * BLOCK_MM[2]))
        block.export(folder / "block.stl")
        texts = pool.map(lambda job: job_of(job[1], folder, job[0]), enumerate(cases))
        for case, (text, why) in zip(cases, texts, strict=True):
            said = [] if text is None else refusals(case.name, text)
            what = "not cut" if text is None else "refused" if said else "pass"
            counts[case.row, what] += 1
            if args.keep is not None and text is not None:
                file = re.sub(r"[^\w.-]+", "_", case.name)
                (args.keep / f"{file}.gcode").write_text(text)
            if args.each and what != "pass":
                print(f"{case.name}: {what}: {said[0] if said else why}")
    print("| presets | all | pass | refused | not cut by the slicer |")
    print("|---|---|---|---|---|")
    for row in sorted({row for row, _ in counts}):
        cells = (counts[row, key] for key in ("pass", "refused", "not cut"))
        everyone = sum(case.row == row for case in cases)
        print(f"| {row} | {everyone} | {' | '.join(map(str, cells))} |")


if __name__ == "__main__":
    main()
