"""Evidence: whether a scan shows a point in space to be empty or solid, and by how much.

Rays decide where sensors are known; elsewhere the nearest scanned surface does, and so where a
sensor looked and no ray ended: scans seldom hold the bed. Where neither tells anything the answer
is "solid", so that unseen is never called missing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from amrepair.arrays import Mask, Numbers, Points, Values
from amrepair.field.faces import Faces, SurfacePlanes, find_faces
from amrepair.field.fused import Surfels
from amrepair.field.groups import group_points
from amrepair.field.near import has_near
from amrepair.field.options import EvidenceOptions
from amrepair.frames import unit_vectors
from amrepair.observe.rays import RangeImage, clearances
from amrepair.observe.unmet import UnmetRays
from amrepair.scans import Scan
from amrepair.template.port import Template

# The clearance of an unseen point: solid, well below every threshold.
SOLID_MM = -5.0


@dataclass(frozen=True, slots=True)
class Evidence:
    """What a scan tells of space: surfels, their planes where they left the template, and rays.

    Attributes
    ----------
    surfels
        The condensed scan, template frame.
    off
        (s,) whether a surfel lies off the template, on broken or additional surface.
    normal
        (s, 3) outward unit normals of surfels that are `off`; zero elsewhere, where the template's
        own normals serve.
    images
        Range images, one for each sensor; empty where sensors are not known.
    options
        The options it was gathered with.
    faces
        The scanned faces around defects, which decide where there are no rays; None where there
        is no defect, or rays ended wherever a sensor looked.
    unmet
        Rays that met nothing, where there are such and `faces` are asked about them.
    """

    surfels: Surfels
    off: Mask
    normal: Points
    images: tuple[RangeImage, ...]
    options: EvidenceOptions
    faces: Faces | None = None
    unmet: UnmetRays | None = None

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
        """How far each point lies outside the as-built part: a best and a cautious estimate.

        Positive means empty. `f_mm` is the template's distance at the points. Clearances beyond
        `most_mm` need not be exact.
        """
        if not self.has_rays:
            near = self._by_surface(points_mm, f_mm, most_mm)
            return near, near
        best, least = clearances(self.images, points_mm, SOLID_MM)
        best = self._sharpened(points_mm, f_mm, best)
        if self.unmet is None:
            return best, least
        told = self._left_through(points_mm, f_mm, least, most_mm)
        return np.maximum(best, told), np.maximum(least, told)

    def cautious(self, points_mm: Points, f_mm: Values, most_mm: float = np.inf) -> Values:
        """The cautious estimate of `clearance` alone, which is cheaper."""
        if not self.has_rays:
            return self._by_surface(points_mm, f_mm, most_mm)
        least = clearances(self.images, points_mm, SOLID_MM)[1]
        if self.unmet is None:
            return least
        return np.maximum(least, self._left_through(points_mm, f_mm, least, most_mm))

    def _left_through(
        self, points_mm: Points, f_mm: Values, least_mm: Values, most_mm: float
    ) -> Values:
        """The clearance by faces of what no ray crossed that ended, but some that met nothing.

        Of all else nothing is said.
        """
        assert self.faces is not None
        assert self.unmet is not None
        told = np.full(len(points_mm), SOLID_MM)
        ask = np.flatnonzero((least_mm <= 0.0) & (f_mm < 0.0))
        ask = ask[self.unmet.left_through(points_mm[ask])]
        told[ask] = self.faces.clearance(points_mm[ask], f_mm[ask], most_mm)
        return told

    def rays_say(self, points_mm: Points) -> Values:
        """The best estimate of `clearance` by rays alone; cheap, and noisy by a pixel."""
        return clearances(self.images, points_mm, SOLID_MM)[0]

    def _by_surface(self, points_mm: Points, f_mm: Values, most_mm: float) -> Values:
        """The clearance by the scanned surface, where there are no rays."""
        if self.faces is not None:
            return self.faces.clearance(points_mm, f_mm, most_mm)
        return self.surface_clearance(points_mm, f_mm)

    def _sharpened(self, points_mm: Points, f_mm: Values, best_mm: Values) -> Values:
        """The clearance by rays, corrected by the scanned surface within a pixel's uncertainty.

        Rays know on which side of the surface a point lies, while averages over cells know better
        where the surface is: the emptiest of several noisy images lies too deep, and beside a
        silhouette every pixel is a step.
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

    def broken_clearance(self, points_mm: Points, f_mm: Values) -> Values:
        """How far points lie above the nearest broken surface, whose planes go on beyond its rim.

        NaN where none lies over or under the point.
        """
        options, planes, spacing_mm = self.options.faces, self._planes, self.surfels.cell_mm
        if self.faces is not None and not self.has_rays:
            planes, spacing_mm = self.faces.planes, self.faces.spacing_mm
        if not planes.off.any():
            return np.full(len(points_mm), np.nan)
        near = planes.broken.nearest(points_mm, f_mm, options.neighbours, 2 * spacing_mm)
        beside_mm = (
            options.beside_spacings * spacing_mm + options.beside_per_height * near.height_mm
        )
        return np.where(near.sideways_mm > beside_mm, np.nan, near.value_mm)

    @property
    def _planes(self) -> SurfacePlanes:
        s = self.surfels
        return SurfacePlanes(s.place_mm, s.deviation_mm, self.off, self.normal, s.tree)

    def surface_clearance(self, points_mm: Points, f_mm: Values) -> Values:
        """Signed distance to the scanned surface itself (no rays), positive outside."""
        s, options = self.surfels, self.options
        near = self._planes.nearest(points_mm, f_mm, options.neighbours, s.cell_mm)
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
    faces, unmet = None, None
    if len(which):
        surface = template.surface_points(max(options.patch_mm, surfels.spacing_mm))
        if not images or _is_open(surface, surfels, off, images, options):
            faces = find_faces(
                scan, template, surfels, off, surface, threshold_mm=threshold_mm, options=options
            )
            if images:
                stands_mm = np.concatenate([faces.occupancy.standing_mm, surfels.place_mm])
                unmet = UnmetRays.of(images, stands_mm, faces.occupancy.voxel_mm)
    facing = surfels.toward_sensors(which)
    if facing is not None:
        normal[which] = _toward(surfels.planes(which), facing)
        surfels = surfels.halves_joined(which, normal[which])
    elif faces is not None:
        nearest = faces.planes.tree.nearest_one(surfels.place_mm[which])
        normal[which] = _toward(surfels.planes(which), faces.planes.normal[nearest])
    return Evidence(surfels, off, normal, images, options, faces, unmet)


def _is_open(
    surface: tuple[Points, Points],
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    images: tuple[RangeImage, ...],
    options: EvidenceOptions,
) -> bool:
    """Whether sensors looked at surface that nothing tells of, which begins at broken surface.

    No point lies on it, and no ray that ended passed it.
    """
    places_mm, normals = surface
    bare = ~has_near(places_mm, surfels.place_mm, options.stub_cells * surfels.cell_mm)
    places_mm, normals = places_mm[bare], normals[bare]
    together = np.concatenate([places_mm, surfels.place_mm[off]])
    group = group_points(together, reach_mm=(options.stub_cells + 1.0) * surfels.cell_mm)
    quiet = clearances(images, places_mm, SOLID_MM)[1] <= 0.0
    quiet &= np.isin(group[: len(places_mm)], group[len(places_mm) :])
    places_mm, normals = places_mm[quiet], normals[quiet]
    looked = np.zeros(len(places_mm), bool)
    for image in images:
        facing = ((image.sensor_mm - places_mm) * normals).sum(axis=1) > 0.0
        looked |= facing & UnmetRays.of((image,), places_mm[:0], 0.0).left_through(places_mm)
    return bool(looked.sum() > options.faces.plane_points)


def with_stubs(evidence: Evidence, gone_mm: Points, labelled: Bool[np.ndarray, " s"]) -> Evidence:
    """The same evidence, with the tops of broken walls one bead wide counted as broken surface.

    Such a top lies inside the template, but nearer to the wall's side than any threshold. Where
    template surface beside it is gone (`gone_mm`), it is a surface of its own and faces the
    sensors.
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
    """Normals of planes, turned to the side of their guides."""
    sign = np.where((planes * guide).sum(axis=1) < 0, -1.0, 1.0)
    return np.asarray(planes * sign[:, None])


def _seen_from_within(
    template: Template, surfels: Surfels, off: Mask, options: EvidenceOptions
) -> Mask:
    """(s,) surfels along the template's surface that a sensor saw from inside the template.

    A thin sheet that is left on the bed lies within noise of the template's underside. But a sensor
    above saw it, so it is the sheet's upper side, and what lies over it is empty.
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
    """(s,) surfels beside off-template ones whose plane crosses the template's surface.

    The broken end of a thin wall lies at f ≈ 0 along both rims. Its plane tells that it is no part
    of the template's surface.
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
    """(q, 3) outward normals of the template's surface at some surfels."""
    return unit_vectors(template.distance_and_gradient(surfels.place_mm[which])[1])


def _along_template(template: Template, surfels: Surfels, which: Numbers) -> Values:
    """(q,) cosine between the template's surface and surfels' planes: 1 along it, 0 across it."""
    outward = _outward(template, surfels, which)
    return np.asarray(np.abs((outward * surfels.planes(which)).sum(axis=1)))
