"""Whole parts sliced beside other slicers, in one run; what is not installed is left out.

    python benchmarks/bench_slice.py [--part FILE] [--rounds 3]

Solid, 0.2 mm layers, 0.4 mm nozzle, two perimeters, no supports. Peers are the command lines of
PrusaSlicer (`prusa-slicer`) and Slic3r (`slic3r`), with reading and writing; ours is timed with
reading and writing, too, in a process of its own. Ratios above 1 say how many times faster ours
is. Filament is compared by the G-code's own sum.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import trimesh

from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.slicing.layers import mesh_of
from gcode.solids import read_solid

PEBBLE = Path(__file__).parents[1] / "examples" / "parts" / "pebble.stl"
PROCESS = """
inherits = "repair_0.20"
name = "as the peers"
perimeters = 2
skirt_loops = 0
"""


def fine_pebble(path: Path) -> None:
    """Our pebble with sixteen times the triangles, roughened by a hundredth of a millimetre."""
    mesh = trimesh.load_mesh(PEBBLE).subdivide().subdivide()
    rng = np.random.default_rng(0)
    mesh.vertices = mesh.vertices + mesh.vertex_normals * rng.normal(
        scale=0.01, size=(len(mesh.vertices), 1)
    )
    mesh.export(path)


def peers(part: Path, out: Path) -> dict[str, list[str]]:
    """Command lines of what is installed."""
    common = ["--layer-height", "0.2", "--first-layer-height", "0.2", "--perimeters", "2"]
    common += ["--fill-density", "100%", "--nozzle-diameter", "0.4", "--skirts", "0"]
    common += ["--filament-diameter", "1.75", "--output", str(out)]
    lines = {
        "prusa-slicer": ["prusa-slicer", "-g", *common, "--fill-pattern", "rectilinear"],
        "slic3r": ["slic3r", *common, "--fill-pattern", "rectilinear"],
    }
    return {name: [*line, str(part)] for name, line in lines.items() if shutil.which(name)}


def least_s(command: list[str], rounds: int) -> tuple[float, float]:
    """Least of `rounds` runs: by the wall's clock, and of processor time."""
    spent, busy = [], []
    for _ in range(rounds):
        start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, capture_output=True)
        spent.append(time.perf_counter() - start)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(spent), min(busy)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.gcode"
        part = Path(folder) / "part.stl"
        if args.part is None:
            fine_pebble(part)
        else:
            trimesh.load_mesh(args.part).export(part)
        solid = read_solid(part)
        process = Path(folder) / "process.toml"
        process.write_text(PROCESS)
        setup = load_setup(process=process)
        low = np.array(solid.bounding_box()[:3])
        placed = Path(folder) / "placed.stl"
        moved = solid.translate((60.0 - low[0], 60.0 - low[1], -low[2]))
        vertices, faces = mesh_of(moved)
        trimesh.Trimesh(vertices, faces, process=False).export(placed)
        print(f"{len(faces)} triangles, {solid.volume():.0f} mm³")
        ours = [
            sys.executable,
            "-c",
            "from gcode.cli import main; main()",
            "slice",
            str(placed),
            "-o",
            str(out),
        ]
        ours += ["--process", str(process), "--printer", setup.printer.id]
        own_s, own_busy_s = least_s(ours, args.rounds)
        laid = read_job(out.read_text()).beads.volume_mm3
        share = laid / solid.volume()
        print(f"ours: {own_s:.1f} s (processor {own_busy_s:.1f}), {share:.4f} of the volume")
        for name, command in peers(placed, out).items():
            seconds, busy_s = least_s(command, args.rounds)
            theirs = read_job(out.read_text()).beads.volume_mm3
            print(
                f"{name}: {seconds:.1f} s, ratio {seconds / own_s:.2f} "
                f"(processor {busy_s:.1f}, ratio {busy_s / own_busy_s:.2f}), "
                f"{theirs / solid.volume():.4f} of the volume"
            )


if __name__ == "__main__":
    main()
