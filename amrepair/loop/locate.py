"""Where the part stands in a job: its template registered to the job's own beads.

It reads the job, not the bed: nothing is measured here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from amrepair.align import align
from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.scans import Scan
from amrepair.template.port import Template
from gcode.reader import Job

# Names of the outermost bead: PrusaSlicer and SuperSlicer, OrcaSlicer and Bambu, Cura.
OUTER_WALLS = frozenset({"external perimeter", "overhang perimeter", "outer wall", "wall-outer"})
WALL_STEP_MM = 0.8


@dataclass(frozen=True, slots=True)
class _Inset:
    """A template shrunk by `depth_mm` (`Template`, as far as an alignment asks it)."""

    whole: Template
    depth_mm: float

    @property
    def bounds_mm(self) -> Float[np.ndarray, "2 3"]:
        return self.whole.bounds_mm

    @property
    def bias_mm(self) -> float:
        return self.whole.bias_mm

    def distance(self, points_mm: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        return self.whole.distance(points_mm) + self.depth_mm

    def distance_and_gradient(
        self, points_mm: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        distance, gradient = self.whole.distance_and_gradient(points_mm)
        return distance + self.depth_mm, gradient

    def below_z(self, z_mm: float) -> Template:
        return self.whole.below_z(z_mm)

    def surface_points(
        self, spacing_mm: float
    ) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        points, normals = self.whole.surface_points(spacing_mm)
        return points - self.depth_mm * normals, normals

    def solid(self) -> object:
        return self.whole.solid()


def locate_part(job: Job, template: Template, *, layer_height_mm: float) -> Transform:
    """Where the part stands in a job: its template registered to the job's own beads.

    The centre lines of the outer walls lie half a bead inside the part, so they are registered to
    that level of its field (idea 12 of the design).

    Returns
    -------
    Transform
        build from template.

    Raises
    ------
    AlignmentError
        If the job's walls do not fit the template to half a layer: it is another part, another
        scale, or more than one copy.
    """
    beads = job.beads
    outer = [k for k, name in enumerate(beads.roles) if name.lower() in OUTER_WALLS]
    pick = (beads.layer >= 0) & (np.isin(beads.role, outer) if outer else True)
    start, end = beads.start_mm[pick], beads.end_mm[pick]
    height_mm = beads.height_mm[pick]
    # half of what a bead stands for: its own rounded width is a little more
    half_mm = float(np.median(0.5 * beads.section_mm2[pick] / np.maximum(height_mm, 1e-6)))
    lengths = np.linalg.norm(end - start, axis=1)
    count = np.maximum(1, np.ceil(lengths / WALL_STEP_MM).astype(np.int64))
    owner = np.repeat(np.arange(len(count)), count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    points = start[owner] + (end - start)[owner] * ((step + 0.5) / count[owner])[:, None]
    points[:, 2] -= 0.5 * height_mm[owner]
    scan = Scan(points, 0.05, "build", source="the job's walls")
    found = align(scan, _Inset(template, half_mm))
    off_mm = float(
        np.median(np.abs(template.distance(found.template_from_scan.apply(points)) + half_mm))
    )
    if off_mm > 0.5 * layer_height_mm:
        raise AlignmentError(
            f"the job's walls lie {off_mm:.3f} mm off the template, the limit is half a layer "
            f"({0.5 * layer_height_mm:g} mm); is it this part, at this scale, in one copy?"
        )
    return _on_bed(found.template_from_scan.inverse(), template, layer_height_mm)


def _on_bed(placed: Transform, template: Template, layer_height_mm: float) -> Transform:
    """The pose with the part's lowest point on the bed: walls tell height the least."""
    surface, _ = template.surface_points(1.0)
    low_mm = float(placed.apply(surface)[:, 2].min())
    if abs(low_mm) > layer_height_mm:
        raise AlignmentError(
            f"the part found in the job stands {low_mm:.2f} mm off the bed, the limit is a layer "
            f"({layer_height_mm:g} mm); jobs with a raft cannot be repaired yet"
        )
    matrix = placed.matrix.copy()
    matrix[2, 3] -= low_mm
    return Transform(placed.target, placed.source, matrix)
