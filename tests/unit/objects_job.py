"""Jobs of several objects on one plate, labelled as slicers do, and what stands of them."""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d as m3
import numpy as np
import trimesh
from loop_bench import PLACE_MM, solid_mesh

from amrepair.scans import Scan
from gcode.moves import Program
from gcode.profiles import PrintSetup
from gcode.reader import read_job
from gcode.slicing.job import plan_part
from gcode.writer import write

MARKS = {
    "m486": ("M486 S{n}", "M486 S-1"),
    "klipper": ("EXCLUDE_OBJECT_START NAME=BLOCK_{n}", "EXCLUDE_OBJECT_END NAME=BLOCK_{n}"),
}


@dataclass(frozen=True)
class Block:
    """One object: its corner on the plate (of PLACE_MM) and its size, mm."""

    x_mm: float
    y_mm: float
    size_mm: tuple[float, float, float]

    @property
    def solid(self) -> m3.Manifold:
        return m3.Manifold.cube(self.size_mm).translate((self.x_mm, self.y_mm, 0.0))

    def holds(self, xy_mm: np.ndarray, around_mm: float = 1.0) -> np.ndarray:
        low = np.array([self.x_mm, self.y_mm]) + PLACE_MM[:2] - around_mm
        high = low + np.array(self.size_mm[:2]) + 2 * around_mm
        return ((xy_mm >= low) & (xy_mm <= high)).all(axis=-1)


def plate(blocks: list[Block]) -> m3.Manifold:
    return m3.Manifold.batch_boolean([block.solid for block in blocks], m3.OpType.Add)


def labelled(blocks: list[Block], setup: PrintSetup, marks: str = "m486") -> Program:
    """Sliced as one, each object's beads between marks of its own."""
    toolpath = plan_part(plate(blocks).translate(PLACE_MM), setup).toolpath
    program = write(toolpath, setup, title="plate")
    job = read_job(program, dialect=program.dialect)
    middle = 0.5 * (job.beads.start_mm + job.beads.end_mm)[:, :2]
    owner = np.full(len(middle), -1)
    for n, block in enumerate(blocks):
        owner[block.holds(middle)] = n
    lines = program.text.split("\n")
    begins, ends = MARKS[marks]
    before: dict[int, list[str]] = {}
    now = -1
    for line, n in zip(job.beads.line.tolist(), owner.tolist(), strict=True):
        if n != now:
            before.setdefault(line, [])
            before[line] += [ends.format(n=now)] * (now >= 0) + [begins.format(n=n)] * (n >= 0)
            now = n
    if now >= 0:
        before.setdefault(job.footer_start_line, []).append(ends.format(n=now))
    text = [row for k, line in enumerate(lines) for row in (*before.get(k, ()), line)]
    return Program("\n".join(text), program.dialect)


def with_bed(solid: m3.Manifold) -> Scan:
    """A cloud of what stands there and of the bed round it: where nothing is, the bed is seen."""
    bed = m3.Manifold.cube((80.0, 40.0, 1.0)).translate((90.0, 80.0, -1.0))
    mesh, rng = solid_mesh(solid + bed), np.random.default_rng(1)
    points, faces = trimesh.sample.sample_surface(mesh, 40_000, seed=1)
    up = points[:, 2] > -1e-6
    normals = np.asarray(mesh.face_normals)[faces[up]].astype(np.float32).astype(np.float64)
    noisy = np.asarray(points[up]) + rng.normal(scale=0.02, size=(int(up.sum()), 3))
    return Scan(noisy, 0.02, "scanner", normals)
