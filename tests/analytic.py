"""Templates with analytic distance: the truth that detection and deficits are tested against."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field

import manifold3d
import numpy as np
import trimesh
from jaxtyping import Float

Points = Float[np.ndarray, "n 3"]
Field = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class AnalyticTemplate:
    """The whole `Template` port over a field and its solid (the solid must be the field's)."""

    field: Field
    body: manifold3d.Manifold
    bias_mm: float = 0.0
    _cache: dict[float, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @property
    def bounds_mm(self) -> Float[np.ndarray, "2 3"]:
        return np.asarray(self.body.bounding_box(), float).reshape(2, 3)

    def distance(self, points_mm: Points) -> Float[np.ndarray, " n"]:
        return self.field(np.asarray(points_mm, float))

    def distance_and_gradient(self, points_mm: Points) -> tuple[np.ndarray, np.ndarray]:
        h = 1e-4
        asked = np.asarray(points_mm, float)
        beside = [asked + way * h * axis for way in (1.0, -1.0) for axis in np.eye(3)]
        found = self.field(np.concatenate([asked, *beside])).reshape(7, -1)
        return found[0], (found[1:4] - found[4:7]).T / (2 * h)

    def surface_points(self, spacing_mm: float) -> tuple[np.ndarray, np.ndarray]:
        if spacing_mm not in self._cache:
            self._cache[spacing_mm] = sample_surface(self.body, spacing_mm, seed=1)
        return self._cache[spacing_mm]

    def solid(self) -> manifold3d.Manifold:
        return self.body


def sum_of_waves(
    places_mm: np.ndarray, waves: np.ndarray, phase: np.ndarray
) -> Float[np.ndarray, " n"]:
    """(n,) sums of cosines of the phases that (d, w) `waves` have at (n, d) places.

    In single precision, six digits of each: four times as fast, and noise in all that follows.
    """
    at = (places_mm @ waves + phase).astype(np.float32)
    return np.cos(at).sum(axis=1, dtype=np.float64)


def to_trimesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts, np.int64), process=False
    )


def sample_surface(
    solid: manifold3d.Manifold, spacing_mm: float, *, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """About one point per spacing², and its outward normal."""
    mesh = to_trimesh(solid)
    count = int(mesh.area / spacing_mm**2)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=seed)
    return np.asarray(points, float), np.asarray(mesh.face_normals[face], float)


def box_field(low: tuple[float, float, float], high: tuple[float, float, float]) -> Field:
    centre = (np.array(low) + np.array(high)) / 2
    half = (np.array(high) - np.array(low)) / 2

    def f(p: np.ndarray) -> np.ndarray:
        over = np.subtract(p.T, centre[:, None], order="C")
        np.abs(over, out=over)
        return _outside_of(np.subtract(over, half[:, None], out=over))

    return f


def _outside_of(over: np.ndarray) -> np.ndarray:
    """(n,) distance to a box or cylinder whose faces are `over` (k, n) mm behind; row by row.

    numpy reduces a short last axis a hundred times as slowly as it adds rows.
    """
    within = np.minimum(functools.reduce(np.maximum, over), 0)
    beyond = np.maximum(over, 0, out=over)
    np.multiply(beyond, beyond, out=beyond)
    found = np.sqrt(functools.reduce(np.add, beyond))
    return np.add(found, within, out=found)


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> AnalyticTemplate:
    size = np.array(high) - np.array(low)
    return AnalyticTemplate(
        box_field(low, high), manifold3d.Manifold.cube(tuple(size)).translate(low)
    )


def sphere(centre: tuple[float, float, float], radius: float) -> AnalyticTemplate:
    return AnalyticTemplate(
        lambda p: np.linalg.norm(p - np.array(centre), axis=1) - radius,
        manifold3d.Manifold.sphere(radius, 256).translate(centre),
    )


def cylinder(base: tuple[float, float, float], radius: float, height: float) -> AnalyticTemplate:
    """Upright, `base` the middle of its foot."""

    def f(p: np.ndarray) -> np.ndarray:
        radial = np.hypot(p[:, 0] - base[0], p[:, 1] - base[1]) - radius
        axial = np.abs(p[:, 2] - base[2] - height / 2) - height / 2
        return _outside_of(np.stack([radial, axial]))

    return AnalyticTemplate(
        f, manifold3d.Manifold.cylinder(height, radius, radius, 256).translate(base)
    )


def union(a: AnalyticTemplate, b: AnalyticTemplate) -> AnalyticTemplate:
    """Exact outside, a bound inside near where they meet."""
    return AnalyticTemplate(lambda p: np.minimum(a.field(p), b.field(p)), a.body + b.body)


def difference(a: AnalyticTemplate, b: AnalyticTemplate) -> AnalyticTemplate:
    return AnalyticTemplate(lambda p: np.maximum(a.field(p), -b.field(p)), a.body - b.body)


def noisy_scan_points(
    solid: manifold3d.Manifold, *, spacing_mm: float, sigma_mm: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Points of a whole-part scan with noise along the normal, and the true normals."""
    points, normals = sample_surface(solid, spacing_mm, seed=seed)
    noise = np.random.default_rng(seed + 1000).normal(0, sigma_mm, len(points))
    return points + noise[:, None] * normals, normals


def ray_scan(
    solid: manifold3d.Manifold,
    sensors_mm: np.ndarray,
    *,
    spacing_mm: float,
    sigma_mm: float,
    seed: int,
    bed_z_mm: float | None = 0.0,
    margin_mm: float = 8.0,
) -> tuple[np.ndarray, np.ndarray]:
    """(points, sensor index): rays from each sensor through a grid over the part's top plane."""
    mesh = to_trimesh(solid)
    low, high = mesh.bounds
    rng = np.random.default_rng(seed)
    found, who = [], []
    for k, sensor in enumerate(np.asarray(sensors_mm, float)):
        xs = np.arange(low[0] - margin_mm, high[0] + margin_mm, spacing_mm)
        ys = np.arange(low[1] - margin_mm, high[1] + margin_mm, spacing_mm)
        target = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
        aim = np.column_stack([target, np.full(len(target), low[2])])
        ray = aim - sensor
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        start = np.repeat(sensor[None], len(ray), 0)
        place, index, _ = mesh.ray.intersects_location(start, ray, multiple_hits=False)
        range_mm = np.full(len(ray), np.inf)
        range_mm[index] = np.linalg.norm(place - sensor, axis=1)
        if bed_z_mm is not None:
            range_mm = np.minimum(range_mm, (bed_z_mm - sensor[2]) / ray[:, 2])
        hit = np.isfinite(range_mm)
        range_mm = range_mm[hit] + rng.normal(0, sigma_mm, int(hit.sum()))
        found.append(sensor + ray[hit] * range_mm[:, None])
        who.append(np.full(int(hit.sum()), k))
    return np.concatenate(found), np.concatenate(who).astype(np.int64)
