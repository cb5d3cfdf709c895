"""Whether jobs pass the checker as printer makers' own scripts begin and end them.

    python benchmarks/bench_vendor_jobs.py                # the installed PrusaSlicer's bundles
    python benchmarks/bench_vendor_jobs.py --each         # and why each other one does not

A block is cut by the installed PrusaSlicer for every preset with a nozzle of 0.4 mm, with that
preset's own print and filament, and judged by its own settings (`gcode check JOB`): whoever prints
such jobs every day must not be told that they are wrong. Presets for several heads at once, and
what the slicer itself refuses, are counted apart.
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
from pathlib import Path

import trimesh

from gcode.check import Policy, find_refusals
from gcode.errors import InputError
from gcode.moves import Program
from gcode.profiles.finding import BUNDLES, find_presets
from gcode.profiles.importers.slicers import read_prusa
from gcode.profiles.own_settings import own_settings

NOZZLE = "0.4"
BLOCK_MM = (12.0, 12.0, 4.0)
# What the command line does not take, or draws pictures.
LEFT_OUT = re.compile(r"compatible_|inherits|default_(print|filament)_profile|thumbnails")
SEVERAL_HEADS = re.compile(r"another tool|change of tool|hotend of another tool")


def configurations(bundles: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Every printer's name, and all settings of a job for it."""
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
        yield preset.name, {key: v for key, v in made.items() if not LEFT_OUT.match(key)}


def cut(config: dict[str, str], folder: Path, number: int) -> str | None:
    """The block's job by these settings; None where the slicer refuses."""
    program = shutil.which("prusa-slicer")
    if program is None:
        raise SystemExit("prusa-slicer is not on the path; install it")
    ini, gcode = folder / f"{number}.ini", folder / f"{number}.gcode"
    ini.write_text("".join(f"{key} = {value}\n" for key, value in config.items()))
    words = ["--load", str(ini), "--export-gcode", "-o", str(gcode), str(folder / "block.stl")]
    subprocess.run([program, *words], capture_output=True, check=False)
    return gcode.read_text(errors="replace") if gcode.is_file() else None


def refusals(name: str, text: str) -> list[str]:
    """What the checker has against a job on its own printer."""
    own = own_settings(text, f"{name}.gcode")
    if own is None:
        return ["no settings in it"]
    setup = own.setup()
    other = own.differs_from(setup.printer)
    program = Program(text, setup.printer.dialect)
    judged = setup if own.flow_is_told else setup.melting_all()
    found = find_refusals(program, judged, policy=Policy.DANGER)
    return [*([other] if other else []), *(str(one) for one in found)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bundles", type=Path, default=Path(BUNDLES[0]))
    parser.add_argument("--each", action="store_true", help="what speaks against each other one")
    args = parser.parse_args()
    jobs = list(configurations(args.bundles))
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(2) as pool:
        folder = Path(name)
        block = trimesh.creation.box(BLOCK_MM)
        block.apply_translation((0.0, 0.0, 0.5 * BLOCK_MM[2]))
        block.export(folder / "block.stl")
        texts = pool.map(lambda job: cut(job[1][1], folder, job[0]), enumerate(jobs))
        for (printer, _), text in zip(jobs, texts, strict=True):
            said = [] if text is None else refusals(printer, text)
            heads = any(SEVERAL_HEADS.search(one) for one in said)
            what = "refused" if said else "pass"
            counts["not cut" if text is None else "several heads" if heads else what] += 1
            if args.each and said:
                print(f"{printer}: {said[0]}")
    print("| presets | pass | refused | several heads | not cut by the slicer |")
    print("|---|---|---|---|---|")
    row = (counts[key] for key in ("pass", "refused", "several heads", "not cut"))
    print(f"| {len(jobs)} | {' | '.join(map(str, row))} |")


if __name__ == "__main__":
    main()
