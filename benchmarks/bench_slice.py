"""Whole parts sliced beside other slicers, in one run; what is not installed is left out.

    python benchmarks/bench_slice.py [--part FILE] [--triangles N] [--rounds 3]

Solid, 0.2 mm layers, 0.4 mm nozzle, two perimeters, no supports. Peers are the command lines of
PrusaSlicer (`prusa-slicer`) and Slic3r (`slic3r`), with reading and writing; ours is timed with
reading and writing, too, in a process of its own, and takes turns with them. Ratios above 1 say how
many times faster ours is, or how much less memory it takes. Memory is the most that the largest
process held, and the most that all of a command's processes held together, what they share counted
once (PSS, in a run of its own). Filament is compared by the G-code's own sum.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from gcode.meshes import mesh_of
from gcode.reader import read_job
from gcode.solids import read_solid

PEBBLE = Path(__file__).parents[1] / "examples" / "parts" / "pebble.stl"
FINE = 146_000  # triangles of our pebble, where nothing else is asked for
ROUGH_MM = 0.01
LOOK_S = 0.02
PEERS = {"prusa-slicer": ["prusa-slicer", "-g"], "slic3r": ["slic3r"]}
# Python keeps what it has compiled, as it does for users.
ENVIRONMENT = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
PROCESS = """
inherits = "repair_0.20"
name = "as the peers"
perimeters = 2
skirt_loops = 0
"""


def fine(solid: Any, triangles: int) -> trimesh.Trimesh:
    """A part with about so many triangles, roughened by a hundredth of a millimetre, as a scan."""
    low_mm, high_mm = 0.01, 10.0
    for _ in range(20):
        longest_mm = float(np.sqrt(low_mm * high_mm))
        finer = solid.refine_to_length(longest_mm)
        if abs(finer.num_tri() - triangles) < 0.01 * triangles:
            break
        if finer.num_tri() > triangles:
            low_mm = longest_mm
        else:
            high_mm = longest_mm
    mesh = trimesh.Trimesh(*mesh_of(finer), process=False)
    rng = np.random.default_rng(0)
    rough = rng.normal(scale=ROUGH_MM, size=(len(mesh.vertices), 1))
    return trimesh.Trimesh(mesh.vertices + mesh.vertex_normals * rough, mesh.faces, process=False)


def peers(part: Path, outs: dict[str, Path]) -> dict[str, list[str]]:
    """Command lines of what is installed."""
    common = ["--layer-height", "0.2", "--first-layer-height", "0.2", "--perimeters", "2"]
    common += ["--fill-density", "100%", "--nozzle-diameter", "0.4", "--skirts", "0"]
    common += ["--filament-diameter", "1.75", "--fill-pattern", "rectilinear"]
    return {
        name: [*begin, *common, "--output", str(outs[name]), str(part)]
        for name, begin in PEERS.items()
        if shutil.which(begin[0])
    }


@dataclass
class Spent:
    """What a command's runs took: by the wall's clock, of processor time, and of memory."""

    wall_s: list[float] = field(default_factory=list)
    busy_s: list[float] = field(default_factory=list)
    largest_mb: float = 0.0
    together_mb: float = 0.0

    def run(self, command: list[str]) -> None:
        """Once more, timed."""
        start = time.perf_counter()
        nowhere = subprocess.DEVNULL
        process = subprocess.Popen(command, stdout=nowhere, stderr=nowhere, env=ENVIRONMENT)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise subprocess.CalledProcessError(process.returncode, command)
        self.wall_s.append(time.perf_counter() - start)
        self.busy_s.append(used.ru_utime + used.ru_stime)

    def weigh(self, command: list[str]) -> None:
        """Once more, looked at all the time, which takes time of its own."""
        nowhere = subprocess.DEVNULL
        with subprocess.Popen(
            command, stdout=nowhere, stderr=nowhere, env=ENVIRONMENT, start_new_session=True
        ) as process:
            while process.poll() is None:
                held = session_of(process.pid)
                peaks = [megabytes(pid, "status", "VmHWM:") for pid in held]
                together_mb = sum(megabytes(pid, "smaps_rollup", "Pss:") for pid in held)
                self.largest_mb = max(self.largest_mb, *peaks, 0.0)
                self.together_mb = max(self.together_mb, together_mb)
                time.sleep(LOOK_S)

    def told(self) -> str:
        """The figures, as medians and in all."""
        return (
            f"{np.median(self.wall_s):.2f} s ({min(self.wall_s):.2f} to {max(self.wall_s):.2f}), "
            f"processor {np.median(self.busy_s):.2f} s, largest process "
            f"{self.largest_mb:.0f} MB, together {self.together_mb:.0f} MB"
        )


def session_of(leader: int) -> list[int]:
    """Processes of a session."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            if int(stat.read_text().rpartition(")")[2].split()[3]) == leader:
                found.append(int(stat.parent.name))
    return found


def megabytes(pid: int, file: str, name: str) -> float:
    """A figure of a process's in /proc; 0 where it has ended, and has no memory any more."""
    with contextlib.suppress(OSError, IndexError):
        text = Path(f"/proc/{pid}/{file}").read_text()
        return int(text.partition(name)[2].split()[0]) / 1024
    return 0.0


def placed_part(args: argparse.Namespace, path: Path) -> Any:
    """Write what is sliced, away from the bed's corner; returns it as a solid."""
    solid = read_solid(PEBBLE if args.part is None else args.part)
    low = np.array(solid.bounding_box()[:3])
    solid = solid.translate((60.0 - low[0], 60.0 - low[1], -low[2]))
    if args.triangles or args.part is None:
        mesh = fine(solid, args.triangles or FINE)
        mesh.vertices[:, 2] -= mesh.vertices[:, 2].min()
    else:
        mesh = trimesh.Trimesh(*mesh_of(solid), process=False)
    mesh.export(path)
    return read_solid(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--part", type=Path)
    parser.add_argument("--triangles", type=int, help="refined to so many, and roughened")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        placed = Path(folder) / "placed.stl"
        solid = placed_part(args, placed)
        process = Path(folder) / "process.toml"
        process.write_text(PROCESS)
        outs = {"ours": Path(folder) / "ours.gcode"}
        commands = {
            "ours": [sys.executable, "-m", "gcode", "slice", str(placed), "-o", str(outs["ours"]),
                     "--process", str(process)],
        }  # fmt: skip
        for name in PEERS:
            outs[name] = Path(folder) / f"{name}.gcode"
        commands |= peers(placed, outs)
        load = os.getloadavg()[0]
        print(f"{solid.num_tri()} triangles, {solid.volume():.0f} mm³; load {load:.1f}, "
              f"{len(os.sched_getaffinity(0))} cores")  # fmt: skip
        for name in PEERS:
            if name not in commands:
                print(f"{name}: not installed, skipped")
        spent = {name: Spent() for name in commands}
        for _ in range(args.rounds):
            for name, command in commands.items():
                spent[name].run(command)
        for name, command in commands.items():
            spent[name].weigh(command)
            laid = read_job(outs[name].read_text()).beads.volume_mm3
            print(f"{name}: {spent[name].told()}, {laid / solid.volume():.4f} of the volume")
        for name in commands:
            if name != "ours":
                print(f"{name} over ours: {ratios(spent[name], spent['ours'])}")


def ratios(theirs: Spent, ours: Spent) -> str:
    """How many times what ours takes, turn by turn: the medians."""
    wall = np.median(np.divide(theirs.wall_s, ours.wall_s))
    busy = np.median(np.divide(theirs.busy_s, ours.busy_s))
    return (
        f"wall {wall:.2f}, processor {busy:.2f}, largest process "
        f"{theirs.largest_mb / ours.largest_mb:.2f}, "
        f"together {theirs.together_mb / ours.together_mb:.2f}"
    )


if __name__ == "__main__":
    main()
