"""Evidence: what the scan says about any point in space, empty or solid, and by how much.

Rays decide where sensors are known; elsewhere the nearest scanned surface does. Where neither
speaks the answer is "solid": unseen is never called missing. It labels nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from amrepair.detect import surfel_kernels as kernels
from amrepair.detect.rays import RangeImage, range_images
from amrepair.detect.surfels import Surfels
from amrepair.scans import Scan
from amrepair.template.port import Template

# A plane fitted to a void's floor speaks for what lies above it, not for what lies beside it:
# sideways by one cell plus this many times the height.
SIDEWAYS_PER_HEIGHT = 1.0
NEIGHBOURS = 4
# Planes more than 40° off the template's own slope are another surface.
STRIP_COSINE = 0.77
# "Solid, as far as anybody knows": a clearance well below every threshold.
SOLID_MM = -5.0
# A sign vector needs this mean agreement with the template before file normals are believed.
NORMAL_AGREEMENT = 0.5


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
    """

    surfels: Surfels
    off: Bool[np.ndarray, " s"]
    normal: Float[np.ndarray, "s 3"]
    images: tuple[RangeImage, ...]
    tree: cKDTree

    @property
    def has_rays(self) -> bool:
        """Whether sensors are known."""
        return bool(self.images)

    def clearance(
        self, points_mm: Float[np.ndarray, "n 3"], f_mm: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """How far each point lies outside the as-built part: best estimate, and a cautious one.

        Positive is empty. `f_mm` is the template's distance at the points.
        """
        if self.has_rays:
            best = np.full(len(points_mm), -np.inf)
            least = np.full(len(points_mm), -np.inf)
            for image in self.images:
                seen, cautious = image.clearance(points_mm)
                best = np.maximum(best, seen)
                least = np.maximum(least, cautious)
            return np.maximum(best, SOLID_MM), np.maximum(least, SOLID_MM)
        near = self.surface_clearance(points_mm, f_mm)
        return near, near

    def surface_clearance(
        self, points_mm: Float[np.ndarray, "n 3"], f_mm: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Signed distance to the scanned surface itself (no rays), positive outside.

        A surfel on the template answers f(x) − f(surfel): exact on curves and edges. One off the
        template answers with its own plane.
        """
        s = self.surfels
        if len(s) == 0:
            return np.full(len(points_mm), SOLID_MM)
        k = min(NEIGHBOURS, len(s))
        distance, index = self.tree.query(points_mm, k=k, workers=2)
        distance, index = distance.reshape(-1, k), index.reshape(-1, k)
        offset = points_mm[:, None, :] - s.place_mm[index]
        plane = (offset * self.normal[index]).sum(axis=2)
        field = f_mm[:, None] - s.deviation_mm[index]
        value = np.where(self.off[index], plane, field)
        weight = np.exp(-(distance**2 - distance[:, :1] ** 2) / s.cell_mm**2)
        best = (weight * value).sum(axis=1) / weight.sum(axis=1)
        # beside, not above: the nearest plane does not reach there
        height = plane[:, 0]
        sideways = np.sqrt(np.maximum(distance[:, 0] ** 2 - height**2, 0.0))
        beside = self.off[index[:, 0]] & (
            sideways > 1.5 * s.cell_mm + SIDEWAYS_PER_HEIGHT * np.abs(height)
        )
        best = np.where(beside, SOLID_MM, best)
        return self._beyond_rims(points_mm, f_mm, distance[:, 0], self.off[index[:, 0]], best)

    def _beyond_rims(
        self,
        points_mm: Float[np.ndarray, "n 3"],
        f_mm: Float[np.ndarray, " n"],
        distance_mm: Float[np.ndarray, " n"],
        nearest_off: Bool[np.ndarray, " n"],
        best_mm: Float[np.ndarray, " n"],
    ) -> Float[np.ndarray, " n"]:
        """Mend the answers beyond a convex rim, where a surfel on the template is nearest.

        Material under a scanned face lies |f| below it. What lies farther from the nearest
        surfel than that is not under it: the broken face that meets it at the rim decides.
        """
        s = self.surfels
        off = np.flatnonzero(self.off)
        ask = np.flatnonzero(
            ~nearest_off & (f_mm < 0) & (distance_mm > 1.3 * np.abs(f_mm) + 1.5 * s.cell_mm)
        )
        if len(off) == 0 or len(ask) == 0:
            return best_mm
        reach, which = cKDTree(s.place_mm[off]).query(points_mm[ask], workers=2)
        which = off[which]
        height = ((points_mm[ask] - s.place_mm[which]) * self.normal[which]).sum(axis=1)
        meets = reach <= distance_mm[ask] + 1.5 * s.cell_mm
        mended = best_mm.copy()
        mended[ask] = np.where(meets & (height > 0), height, best_mm[ask])
        return mended


def gather(
    scan: Scan, template: Template, surfels: Surfels, off: Bool[np.ndarray, " s"]
) -> Evidence:
    """Collect the evidence of a scan whose off-template surfels are known."""
    off = off | _strips(template, surfels, off)
    normal = np.zeros((len(surfels), 3))
    which = np.flatnonzero(off)
    if len(which):
        normal[which] = _outward(scan, template, surfels, off, which)
    return Evidence(
        surfels=surfels,
        off=off,
        normal=normal,
        images=range_images(scan, spacing_mm=surfels.spacing_mm),
        tree=cKDTree(surfels.place_mm, compact_nodes=False, balanced_tree=False),
    )


def _strips(
    template: Template, surfels: Surfels, off: Bool[np.ndarray, " s"]
) -> Bool[np.ndarray, " s"]:
    """Surfels beside off-template ones whose plane crosses the template's surface.

    The broken end of a thin wall lies at f ≈ 0 along both rims, yet it is no part of the
    template's surface: its plane says so.
    """
    near = off.copy()
    for _ in range(2):
        touched = surfels.table[near]
        near[touched[touched >= 0]] = True
    which = np.flatnonzero(near & ~off)
    strips = np.zeros_like(off)
    if len(which):
        gradient = template.distance_and_gradient(surfels.place_mm[which])[1]
        gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
        along = np.abs((gradient * surfels.planes(which)).sum(axis=1))
        strips[which] = (along < STRIP_COSINE) & (surfels.deviation_mm[which] < 0)
    return strips


def _outward(
    scan: Scan,
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    which: Int[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"]:
    """Outward normals of the surfels in `which`: by sensors, file, or looking about."""
    planes = surfels.planes(which)
    guide: Float[np.ndarray, "q 3"] | None = None
    if scan.sensors_mm is not None and scan.sensor_index is not None:
        to_sensor = scan.sensors_mm[scan.sensor_index] - scan.points_mm
        guide = surfels.mean_of(to_sensor)[which]
    elif scan.normals is not None:
        guide = _file_normals(scan.normals, template, surfels, off, which)
    if guide is None:
        guide = _open_side(template, surfels, off, which, planes)
    sign = np.where((planes * guide).sum(axis=1) < 0, -1.0, 1.0)
    return planes * sign[:, None]


def _file_normals(
    normals: Float[np.ndarray, "n 3"],
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    which: Int[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"] | None:
    """The file's normals, turned outward as a whole; None where they contradict the template."""
    mean = surfels.mean_of(normals)
    on = np.flatnonzero(~off)[:: max(1, int((~off).sum()) // 5000)]
    if len(on) == 0:
        return mean[which]
    expected = template.distance_and_gradient(surfels.place_mm[on])[1]
    agreement = float(np.median((expected * mean[on]).sum(axis=1)))
    if abs(agreement) < NORMAL_AGREEMENT:
        return None
    return mean[which] * np.sign(agreement)


def _open_side(
    template: Template,
    surfels: Surfels,
    off: Bool[np.ndarray, " s"],
    which: Int[np.ndarray, " q"],
    planes: Float[np.ndarray, "q 3"],
) -> Float[np.ndarray, "q 3"]:
    """Vectors toward the open side, by rays from each surfel to what the scan knows around it."""
    cell_mm = surfels.cell_mm
    low = template.bounds_mm[0] - 3 * cell_mm
    shape = np.ceil((template.bounds_mm[1] - low) / cell_mm).astype(int) + 4
    grid = np.full(tuple(shape), -1, np.int32)
    index = np.floor((surfels.place_mm - low) / cell_mm).astype(int)
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    # on-template surfels last, so that they win a shared cell: their side is known for sure
    for chosen in (np.flatnonzero(inside & off), np.flatnonzero(inside & ~off)):
        grid[tuple(index[chosen].T)] = chosen
    outward = np.zeros((len(surfels), 3))
    on = np.flatnonzero(inside & ~off)
    outward[on] = template.distance_and_gradient(surfels.place_mm[on])[1]
    votes = kernels.open_votes(
        surfels.place_mm[which], planes, _directions(), grid, low, cell_mm, outward
    )
    spread = np.zeros((len(surfels), 3))
    spread[which] = votes
    for _ in range(3):  # a floor is decided as a whole, not cell by cell
        spread = kernels.neighbour_sums(surfels.table, spread)
        spread /= np.maximum(np.linalg.norm(spread, axis=1, keepdims=True), 1e-12)
        spread[~off] = 0.0
    return spread[which]


def _directions() -> Float[np.ndarray, "k 3"]:
    """64 directions spread evenly (Fibonacci sphere)."""
    k = np.arange(64) + 0.5
    z = 1 - 2 * k / 64
    angle = np.pi * (1 + 5**0.5) * k
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
