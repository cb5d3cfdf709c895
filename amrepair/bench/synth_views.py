"""What a scanner sees of a shape: visible points, uneven density, noise, a random pose.

A view is a set of sensors: many around the part (a full scan) or one. Points that no sensor sees
(cavities, the far side) are not in the cloud. It knows nothing of defects beyond carrying along
how far each point was moved by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from amrepair.arrays import Faces, Mask, Points, Values, Vector, Vertices
from amrepair.bench.options import DEFAULT_VIEWING
from amrepair.device import open3d
from amrepair.errors import InputError
from amrepair.frames import diagonal, rotation_of_quaternion, spread_directions
from amrepair.template.surface import triangle_areas_normals


@dataclass(frozen=True, slots=True)
class Shape:
    """A closed surface, and how far each corner was moved by a defect.

    Attributes
    ----------
    vertices_mm, faces
        (v, 3), (f, 3).
    change_mm
        (f, 3) by face corner: 0 where the shape is normal.
    """

    vertices_mm: Vertices
    faces: Faces
    change_mm: Float[np.ndarray, "f 3"]

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the bounding box."""
        return diagonal(self.vertices_mm)


@dataclass(frozen=True, slots=True)
class SeenSurface:
    """Points on a shape: (n, 3) points, (n, 3) outward normals, (n,) change."""

    points_mm: Points
    normals: Points
    change_mm: Values

    def take(self, chosen: Int[np.ndarray, " k"] | Mask) -> SeenSurface:
        """Some of the points."""
        return SeenSurface(self.points_mm[chosen], self.normals[chosen], self.change_mm[chosen])


class Rays:
    """Ray casting against a shape (Embree, single precision)."""

    def __init__(self, shape: Shape) -> None:
        o3d = open3d()
        self._tensor = o3d.core.Tensor
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(shape.vertices_mm.astype(np.float32)),
            self._tensor(shape.faces.astype(np.uint32)),
        )
        self._lift_mm = 1e-4 * shape.diagonal_mm

    def _pack(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([origins, directions], axis=1).astype(np.float32))

    def thickness_mm(self, surface: SeenSurface) -> Values:
        """(n,) how far the material goes straight below each point."""
        start = surface.points_mm - self._lift_mm * surface.normals
        hit = self._scene.cast_rays(self._pack(start, -surface.normals))["t_hit"].numpy()
        return hit.astype(np.float64) + self._lift_mm

    def seen(self, surface: SeenSurface, sensors_mm: Float[np.ndarray, "k 3"]) -> Mask:
        """(n,) whether any sensor sees the point."""
        found = np.zeros(len(surface.points_mm), dtype=bool)
        start = surface.points_mm + self._lift_mm * surface.normals
        for sensor in sensors_mm:
            to_sensor = sensor - start
            distance = np.linalg.norm(to_sensor, axis=1)
            least_cosine = np.cos(np.deg2rad(DEFAULT_VIEWING.most_incidence_deg))
            facing = (to_sensor * surface.normals).sum(axis=1) > least_cosine * distance
            ask = np.flatnonzero(facing & ~found)
            if len(ask):
                rays = self._pack(start[ask], to_sensor[ask] / distance[ask, None])
                found[ask] = ~self._scene.test_occlusions(rays).numpy()
        return found


def sample_shape(shape: Shape, count: int, rng: np.random.Generator) -> SeenSurface:
    """Random points, evenly by area."""
    areas, normals = triangle_areas_normals(shape.vertices_mm, shape.faces)
    cumulative = np.cumsum(areas)
    face = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    face = np.minimum(face, len(areas) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    corners = shape.vertices_mm[shape.faces[face]]
    return SeenSurface(
        points_mm=np.einsum("nk,nkd->nd", weights, corners),
        normals=normals[face],
        change_mm=(weights * shape.change_mm[face]).sum(axis=1),
    )


def sensors_around(shape: Shape, count: int = DEFAULT_VIEWING.sensors) -> Float[np.ndarray, "k 3"]:
    """(k, 3) sensors on a Fibonacci sphere about the part."""
    ways = spread_directions(count)
    return _centre(shape) + DEFAULT_VIEWING.distance_ratio * shape.diagonal_mm * ways


def sensor_towards(shape: Shape, direction: Vector) -> Float[np.ndarray, "1 3"]:
    """(1, 3) one sensor in that direction from the part's centre."""
    unit = direction / np.linalg.norm(direction)
    return (_centre(shape) + DEFAULT_VIEWING.distance_ratio * shape.diagonal_mm * unit)[None, :]


def _centre(shape: Shape) -> Vector:
    low, high = shape.vertices_mm.min(axis=0), shape.vertices_mm.max(axis=0)
    return (low + high) / 2


def look(
    shape: Shape,
    rays: Rays,
    *,
    sensors_mm: Float[np.ndarray, "k 3"],
    count: int,
    sigma_mm: float,
    rng: np.random.Generator,
) -> SeenSurface:
    """`count` visible points of uneven density, with isotropic noise.

    Raises
    ------
    InputError
        If the sensors see next to nothing.
    """
    gradient = rng.normal(size=3)
    gradient *= (
        rng.uniform(0, DEFAULT_VIEWING.density_log) / np.linalg.norm(gradient) / shape.diagonal_mm
    )
    seen: list[SeenSurface] = []
    for _ in range(DEFAULT_VIEWING.rounds):
        candidates = sample_shape(shape, DEFAULT_VIEWING.candidates * count, rng)
        seen.append(candidates.take(rays.seen(candidates, sensors_mm)))
        if sum(len(part.points_mm) for part in seen) >= 2 * count:
            break
    pool = SeenSurface(
        np.concatenate([part.points_mm for part in seen]),
        np.concatenate([part.normals for part in seen]),
        np.concatenate([part.change_mm for part in seen]),
    )
    if len(pool.points_mm) < count:
        raise InputError(
            f"the view sees {len(pool.points_mm)} of {count} points wanted; ask for fewer points"
        )
    # Gumbel top-k: a weighted sample without replacement (Efraimidis and Spirakis 2006)
    log_weight = (pool.points_mm - _centre(shape)) @ gradient
    keys = log_weight + rng.gumbel(size=len(log_weight))
    chosen = pool.take(rng.permutation(np.argpartition(-keys, count - 1)[:count]))
    noisy = chosen.points_mm + rng.normal(0.0, sigma_mm, chosen.points_mm.shape)
    return SeenSurface(noisy, chosen.normals, chosen.change_mm)


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Uniform over all rotations (a normalised Gaussian quaternion)."""
    return rotation_of_quaternion((q := rng.normal(size=4)) / np.linalg.norm(q))
