"""Evidence: what the scan says about any point in space, empty or solid, and by how much.

Rays decide where sensors are known; elsewhere the nearest scanned surface does. Where neither
speaks the answer is "solid": unseen is never called missing. It labels nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.faces import Faces, SurfacePlanes, find_faces
from amrepair.field.fused import Surfels
from amrepair.field.near import has_near
from amrepair.field.options import EvidenceOptions
from amrepair.frames import unit_vectors
from amrepair.observe.rays import RangeImage, clearances
from amrepair.scans import Scan
from amrepair.template.port import Template

# "Solid, as far as anybody knows": a clearance well below every threshold.
SOLID_MM = -5.0


@dataclass(frozen=True, slots=True)
class Evidence:
    """Surfels, their outward planes where they left the template, and range images.

    Attributes
    ----------
    surfels
        The condensed scan, template frame.
    off
        (s,) surfels that lie off the template (labelled missing or excess).
    normal
        (s, 3) outward unit normals where `off`; zero elsewhere (the template's field serves).
    images
        Range images, one per sensor; empty where sensors are unknown.
    options
        That it was gathered with.
    faces
        What the scan says around defects where no rays tell; None where there are, or no defect.
    """

    surfels: Surfels
    off: Mask
    normal: Points
    images: tuple[RangeImage, ...]
    options: EvidenceOptions
    faces: Faces | None = None

    @property
    def spacing_mm(self) -> float:
        """Mean distance between neighbouring points of the scan."""
        return self.surfels.spacing_mm

    @property
    def has_rays(self) -> bool:
        """Whether sensors are known."""
        return bool(self.images)

    def clearance(
        self, points_mm: Points, f_mm: Values, most_mm: float = np.inf
    ) -> tuple[Values, Values]:
        """How far each point lies outside the as-built part: best estimate, and a cautious one.

        Positive is empty. `f_mm` is the template's distance at the points; how much farther than
        `most_mm` it is need not be told.
        """
        if not self.has_rays:
            near = self._by_surface(points_mm, f_mm, most_mm)
            return near, near
        best, least = clearances(self.images, points_mm, SOLID_MM)
        return self._sharpened(points_mm, f_mm, best), least

    def cautious(self, points_mm: Points, f_mm: Values, most_mm: float = np.inf) -> Values:
        """The cautious half of `clearance`, which costs the less."""
        if not self.has_rays:
            return self._by_surface(points_mm, f_mm, most_mm)
        return clearances(self.images, points_mm, SOLID_MM)[1]

    def rays_say(self, points_mm: Points) -> Values:
        """The best estimate of `clearance` by rays alone; cheap, and noisy by a pixel."""
        return clearances(self.images, points_mm, SOLID_MM)[0]

    def _by_surface(self, points_mm: Points, f_mm: Values, most_mm: float) -> Values:
        """What the scanned surface says where there are no rays."""
        if self.faces is not None:
            return self.faces.clearance(points_mm, f_mm, most_mm)
        return self.surface_clearance(points_mm, f_mm)

    def _sharpened(self, points_mm: Points, f_mm: Values, best_mm: Values) -> Values:
        """What the rays say, as far as a pixel allows corrected by the scanned surface.

        The emptiest of several noisy images lies too deep, and beside a silhouette every pixel is
        a step of its own: means and planes over cells know better where the surface is, the rays
        on which side of it a point lies.
        """
        step_mm = max(image.step_mm for image in self.images)
        limit_mm = self.options.sharp_steps * step_mm
        ask = np.flatnonzero(np.abs(best_mm) < limit_mm + self.options.sharp_mm)
        if len(ask) == 0:
            return best_mm
        surface = self.surface_clearance(points_mm[ask], f_mm[ask])
        low, high = best_mm[ask] - limit_mm, best_mm[ask] + limit_mm
        known = surface > SOLID_MM
        sharp = best_mm.copy()
        sharp[ask[known]] = np.clip(surface, low, high)[known]
        return sharp

    def surface_clearance(self, points_mm: Points, f_mm: Values) -> Values:
        """Signed distance to the scanned surface itself (no rays), positive outside."""
        s, options = self.surfels, self.options
        planes = SurfacePlanes(s.place_mm, s.deviation_mm, self.off, self.normal, s.tree)
        near = planes.nearest(points_mm, f_mm, options.neighbours, s.cell_mm)
        # beside, not above: the nearest plane does not reach there
        reach_mm = options.sideways_cells * s.cell_mm + options.sideways_per_height * near.height_mm
        beside = self.off[near.index] & (near.sideways_mm > reach_mm)
        return np.where(beside, SOLID_MM, near.value_mm)


def gather(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Mask,
    images: tuple[RangeImage, ...],
    *,
    threshold_mm: float,
    options: EvidenceOptions,
) -> Evidence:
    """Collect the evidence of a scan whose off-template surfels and range images are known."""
    off = off | _strips(template, surfels, off, options)
    if images and off.any():
        off |= _seen_from_within(template, surfels, off, options)
    normal = np.zeros((len(surfels), 3))
    which = np.flatnonzero(off)
    faces = None
    facing = surfels.toward_sensors(which)
    if facing is not None:
        normal[which] = _toward(surfels.planes(which), facing)
        surfels = surfels.halves_joined(which, normal[which])
    elif len(which):
        surface = template.surface_points(max(options.patch_mm, surfels.spacing_mm))
        faces = find_faces(
            scan, template, surfels, off, surface, threshold_mm=threshold_mm, options=options
        )
        nearest = faces.planes.tree.nearest_one(surfels.place_mm[which])
        normal[which] = _toward(surfels.planes(which), faces.planes.normal[nearest])
    return Evidence(surfels, off, normal, images, options, faces)


def with_stubs(evidence: Evidence, gone_mm: Points, labelled: Bool[np.ndarray, " s"]) -> Evidence:
    """The same evidence, knowing the tops of what is left of walls one bead wide.

    Such a top lies inside the template, yet nearer to its side than any limit: where template
    beside it is gone it is a surface of its own, and faces the sensors.
    """
    s, options = evidence.surfels, evidence.options
    near = has_near(s.place_mm, gone_mm, options.stub_cells * s.cell_mm)
    which = np.flatnonzero(near & ~labelled & ~evidence.off & (s.deviation_mm < -options.stub_mm))
    facing = s.toward_sensors(which)
    if facing is None or not len(which):
        return evidence
    off, normal = evidence.off.copy(), evidence.normal.copy()
    off[which] = True
    normal[which] = unit_vectors(facing)
    return replace(evidence, off=off, normal=normal)


def _toward(planes: Points, guide: Points) -> Points:
    """Planes turned to the side of their guides."""
    sign = np.where((planes * guide).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(planes * sign[:, None])


def _seen_from_within(
    template: Template, surfels: Surfels, off: Mask, options: EvidenceOptions
) -> Mask:
    """Surfels along the template's surface that were seen through the template.

    A sheet that is left on the bed lies within noise of the template's underside, yet its upper
    side was seen from above: it faces the other way, and what lies over it is empty.
    """
    found, which = np.zeros_like(off), np.flatnonzero(~off)
    facing = surfels.toward_sensors(which)
    assert facing is not None
    gradient = _outward(template, surfels, which)
    # few are: planes cost more than all the rest
    which = which[(unit_vectors(facing) * gradient).sum(axis=1) < options.back_cosine]
    found[which] = _along_template(template, surfels, which) > options.faces.strip_cosine
    return found


def _strips(template: Template, surfels: Surfels, off: Mask, options: EvidenceOptions) -> Mask:
    """Surfels beside off-template ones whose plane crosses the template's surface.

    The broken end of a thin wall lies at f ≈ 0 along both rims, yet it is no part of the
    template's surface: its plane says so.
    """
    near = off.copy()
    for _ in range(2):
        touched = surfels.table[near]
        near[touched[touched >= 0]] = True
    which = np.flatnonzero(near & ~off & (surfels.deviation_mm < 0))
    strips = np.zeros_like(off)
    strips[which] = _along_template(template, surfels, which) < options.faces.strip_cosine
    return strips


def _outward(template: Template, surfels: Surfels, which: Numbers) -> Points:
    """(q, 3) which way the template's surface faces at some surfels."""
    return unit_vectors(template.distance_and_gradient(surfels.place_mm[which])[1])


def _along_template(template: Template, surfels: Surfels, which: Numbers) -> Values:
    """(q,) cosine between the template's surface and surfels' planes: 1 along it, 0 across it."""
    outward = _outward(template, surfels, which)
    return np.asarray(np.abs((outward * surfels.planes(which)).sum(axis=1)))
