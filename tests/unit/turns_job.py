"""Blocks that a job prints one after another, as slicers do, and what stands of them."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, replace

import manifold3d as m3
import numpy as np
import trimesh
from loop_bench import solid_mesh
from objects_job import Block

from amrepair.frames import Transform
from amrepair.loop.locate import stood
from amrepair.loop.looks import Stop
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from amrepair.template.port import Template
from gcode.check import CheckedProgram, Policy, check
from gcode.moves import Program
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import Job, job_for

LAYER_MM, LINE_MM, FILAMENT_MM2 = 0.2, 0.45, np.pi * 1.75**2 / 4
POINTS_MM2 = 16.0
HEAD = "M140 S60\nM190 S60\nM104 S215\nM109 S215\nG28\nG90\nM83\nG92 E0\nG1 Z5 F600\n"
SETUP = load_setup("prusa_mk3s", "pla", "repair_0.20")


@dataclass(frozen=True)
class Tower(Block):
    """A block whose corner lies on the bed."""

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        wide, deep, _ = self.size_mm
        return self.x_mm, self.y_mm, self.x_mm + wide, self.y_mm + deep

    def lines(self, number: int) -> list[str]:
        """All of its layers: a perimeter, and lines side by side within it."""
        x0, y0, x1, y1 = self.box_mm
        per_mm = LAYER_MM * LINE_MM / FILAMENT_MM2
        out = [f"; printing object tower_{number}", f"G1 X{x0 + 0.225} Y{y0 + 0.225} F7800"]
        for k in range(1, round(self.size_mm[2] / LAYER_MM) + 1):
            z_mm = k * LAYER_MM
            out += [";LAYER_CHANGE", f";Z:{z_mm:.3f}", f";HEIGHT:{LAYER_MM}"]
            out += [f"G1 Z{z_mm:.3f} F600", ";TYPE:External perimeter", f";WIDTH:{LINE_MM}"]
            a, b, c, d = x0 + 0.225, y0 + 0.225, x1 - 0.225, y1 - 0.225
            ring = [(a, b), (c, b), (c, d), (a, d), (a, b)]
            rows = np.arange(b + LINE_MM, d - 0.5 * LINE_MM, LINE_MM)
            inside = [((a, y), (c, y))[:: 1 if j % 2 else -1] for j, y in enumerate(rows)]
            out += _chain(ring, per_mm)
            out += [";TYPE:Solid infill", f"G1 X{inside[0][0][0]:.3f} Y{inside[0][0][1]:.3f} F7800"]
            for line in inside:
                out += [f"G1 X{line[0][0]:.3f} Y{line[0][1]:.3f} F7800", *_chain(line, per_mm)]
        return [*out, f"; stop printing object tower_{number}"]


def _chain(points: list[tuple[float, float]] | tuple[tuple[float, float], ...],
           per_mm: float) -> list[str]:  # fmt: skip
    return [
        f"G1 X{x:.3f} Y{y:.3f} E{np.hypot(x - u, y - v) * per_mm:.5f} F1200"
        for (u, v), (x, y) in itertools.pairwise(points)
    ]


def in_turn(towers: list[Tower], *, over_mm: float = 1.0) -> str:
    """A job that prints one after another, and goes `over_mm` above the highest between them."""
    lines, high_mm = HEAD.splitlines(), 0.0
    for number, tower in enumerate(towers):
        lines += ["G1 E-0.8 F2100", f"G1 Z{high_mm + over_mm:.3f} F600"] * (number > 0)
        body = tower.lines(number)
        lines += [*body[:2], *["G1 E0.8 F2100"] * (number > 0), *body[2:]]
        high_mm = max(high_mm, tower.size_mm[2])
    return "\n".join([*lines, "G1 E-0.8 F2100", f"G1 Z{high_mm + 5:.3f}", "M104 S0", "M140 S0", ""])


@dataclass(frozen=True)
class InTurn:
    """Such a job, ready to be printed, with the template of all of it."""

    towers: list[Tower]
    job: Job
    checked: CheckedProgram
    template: Template
    placed: Transform
    setup: PrintSetup = SETUP

    @classmethod
    def of(cls, towers: list[Tower], **named: float) -> InTurn:
        program = Program(in_turn(towers, **named), SETUP.printer.dialect)
        checked = check(program, SETUP, policy=Policy.DANGER)
        whole = m3.Manifold.batch_boolean([tower.solid for tower in towers], m3.OpType.Add)
        job = job_for(checked.program, SETUP.printer)
        here = Transform.identity("build", "template")
        return cls(towers, job, checked, MeshSdf.from_mesh(solid_mesh(whole)), here)

    def standing(self, stop: Stop) -> m3.Manifold:
        """What should stand at a stop: what is finished, and the one under way up to its layer."""
        turn = self.job.turn_at(stop.line).index
        done = [tower.solid for tower in self.towers[:turn]]
        cut = self.towers[turn].solid.trim_by_plane((0.0, 0.0, -1.0), -stop.z_mm)
        return m3.Manifold.batch_boolean([*done, cut], m3.OpType.Add)


def seen(solid: m3.Manifold, seed: int) -> Scan:
    """A cloud of all that stands there, as dense on each as one of a part alone."""
    mesh, rng = solid_mesh(solid), np.random.default_rng(seed)
    points, faces = trimesh.sample.sample_surface(mesh, int(POINTS_MM2 * mesh.area), seed=seed)
    noisy = np.asarray(points) + rng.normal(scale=0.02, size=points.shape)
    normals = np.asarray(mesh.face_normals)[faces].astype(np.float32).astype(np.float64)
    return Scan(noisy, 0.02, "scanner", normals)


def copies(size_mm: tuple[float, float, float], at_mm: list[tuple[float, float]]) -> InTurn:
    """Copies of one block, with the template of one, stood as often as it is printed."""
    made = InTurn.of([Tower(x, y, size_mm) for x, y in at_mm])
    one = MeshSdf.from_mesh(solid_mesh(m3.Manifold.cube(size_mm)))
    poses = tuple(
        Transform.from_rotation_translation(
            "build", "template", rotation=np.eye(3), translation_mm=np.array([x, y, 0.0])
        )
        for x, y in at_mm
    )
    template, placed = stood(one, poses)
    return replace(made, template=template, placed=placed)


_WORD = re.compile(r"([XYZ])(-?\d*\.?\d+)")


def hits(lines: list[str], tower: Tower, setup: PrintSetup) -> list[str]:
    """Lines on which a box around some part of the head comes into a tower that stands there.

    By its own reading of the text, absolute moves alone; and by steps of half a millimetre.
    """
    x0, y0, x1, y1 = tower.box_mm
    at, found = np.full(3, np.nan), []
    for line in lines:
        code = line.split(";")[0]
        if not re.match(r"G[01]\b", code):
            continue
        to = at.copy()
        for axis, value in _WORD.findall(code):
            to["XYZ".index(axis)] = float(value)
        steps = 2 + int(2 * np.nan_to_num(np.linalg.norm(to - at)))
        way = at + np.linspace(0.0, 1.0, steps)[:, None] * (to - at)
        for part in setup.printer.head:
            corners = np.array(part.polygon_mm)
            (a, b), (c, d) = corners.min(axis=0), corners.max(axis=0)
            over = (way[:, 0] + c > x0) & (way[:, 0] + a < x1)
            over &= (way[:, 1] + d > y0) & (way[:, 1] + b < y1)
            if (over & (way[:, 2] + part.z_from_mm < tower.size_mm[2] - 0.05)).any():
                found.append(f"{line}: {part.part}")
        at = to
    return found
