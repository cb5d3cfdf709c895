"""Sound scans by number, real and simulated: the same number gives the same scan.

Real ones are made of range images in their given places (see `real_scans`): single views, views
merged, the part of a view on one side of a random plane, thinned or not, as bare clouds or with
their sensors, where the range images tell them. What the reference surface fails to follow is left
out: a region there would be right.

Simulated ones see a mesh from one sensor or from several around it, with independent noise, with
errors that hang together over 2 to 5 mm and have heavy tails, or with a real scanner's residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from real_scans import Placed, Surface, read_views, unfollowed
from scipy.spatial import cKDTree

from amrepair.bench.synth_views import Rays, Shape, look, random_rotation, sensors_around
from amrepair.scans import Scan, read_scan
from amrepair.simulate.recording import Recording
from amrepair.simulate.replay import Replay

THINNED = (1.0, 1.0, 0.5, 0.25)  # how many of its points a scan keeps
MOST_VIEWS = 9
NOISES = ("normal", "lumpy", "recorded")
SENSORS = (1, 1, 6, 14)  # one view, or a whole part
SPACING_MM, MOST_POINTS = (0.35, 0.7), 60_000
KNOT_SHARE = 0.4  # of the length over which errors hang together: so far apart lie their knots
FREEDOMS = 4.0  # of Student's t: its fourth moment is infinite
UNSEEN_MM = 1.0  # so far from any point of any view nobody saw the reference's surface


@dataclass(frozen=True, slots=True)
class Sound:
    """A scan of a sound part, its kind, and where it truly lies."""

    scan: Scan
    kind: str
    template_from_scan: np.ndarray


def _turned(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(4, 4) a random way to lay points: turned about their middle, shifted by up to 0.2 m."""
    pose = np.eye(4)
    pose[:3, :3] = random_rotation(rng)
    pose[:3, 3] = rng.uniform(-200.0, 200.0, 3) - pose[:3, :3] @ points.mean(axis=0)
    return pose


def _laid(
    points: np.ndarray,
    sensors: np.ndarray | None,
    index: np.ndarray,
    rng: np.random.Generator,
    *,
    kind: str,
    edge: np.ndarray | None = None,
) -> Sound:
    """A scan in a frame of its own; `sensors` None: a bare cloud."""
    pose = _turned(points, rng)
    known, index = (None, None) if sensors is None else np.unique(index, return_inverse=True)
    scan = Scan(
        points @ pose[:3, :3].T + pose[:3, 3],
        0.04,
        "scanner",
        sensors_mm=None if known is None else sensors[known] @ pose[:3, :3].T + pose[:3, 3],
        sensor_index=index,
        edge=edge,
        source=kind,
    )
    return Sound(scan, kind, np.linalg.inv(pose))


class RealScans:
    """Sound scans of an object that range images show."""

    def __init__(self, folder: Path, conf: Path, part: Path, unit_mm: float = 1000.0) -> None:
        self.views: list[Placed] = read_views(folder, conf, unit_mm)
        surface = Surface(trimesh.load_mesh(part))
        points = np.vstack([view.points_mm for view in self.views])
        off = unfollowed(points, surface.deviation_mm(points))
        self._off = np.split(off, np.cumsum([len(v.points_mm) for v in self.views])[:-1])
        self._followed = cKDTree(points[~off])
        self._seen = []
        for view in self.views:
            as_read = read_scan(folder / view.image.name, frame="scanner")
            # rays that are parallel from column to column: one sensor so far away sees the same
            sensor = None
            if as_read.sensors_mm is not None:
                sensor = view.pose[:3, :3] @ (as_read.sensors_mm.mean(axis=0) * unit_mm)
                sensor = sensor + view.pose[:3, 3]
            edge = as_read.edge if as_read.edge is not None else np.zeros(len(as_read), np.uint8)
            self._seen.append((sensor, edge))

    def unseen_share(self, places_mm: np.ndarray) -> float:
        """How much of some of the reference's surface no view ever saw: there it is a guess.

        A ray that passes through a guess says that it is wrong, not that material is missing.
        """
        apart_mm, _ = self._followed.query(places_mm, distance_upper_bound=UNSEEN_MM)
        return float(np.isinf(apart_mm).mean())

    def made(self, number: int) -> Sound:
        """The scan of a number."""
        rng = np.random.default_rng([number, 30])
        kind = ("view", "merged", "half")[number % 3]
        count = int(rng.integers(2, min(MOST_VIEWS, len(self.views)) + 1))
        chosen = rng.choice(len(self.views), count, replace=False)
        if kind != "merged":
            count, chosen = 1, np.array([(number // 3) % len(self.views)])
        share, bare = rng.choice(THINNED), rng.random() < 0.5
        bare = bare or any(self._seen[k][0] is None for k in chosen)
        clouds, edges = [], []
        for k in chosen:
            keep = ~self._off[k] & (rng.random(len(self._off[k])) < share)
            points = self.views[k].points_mm[keep]
            edge = self._seen[k][1][keep]
            if kind == "half":
                side = (points - np.median(points, axis=0)) @ rng.normal(size=3)
                inside = side > np.quantile(side, rng.uniform(0.3, 0.6))
                points, edge = points[inside], edge[inside]
            clouds.append(points)
            edges.append(edge)
        told = f"{kind}{'' if bare else ', sensors'}, {count} of {share:g}"
        return _laid(
            np.vstack(clouds),
            None if bare else np.stack([self._seen[k][0] for k in chosen]),
            np.repeat(np.arange(count), [len(cloud) for cloud in clouds]),
            rng,
            kind=told,
            edge=None if bare else np.concatenate(edges),
        )


class SimulatedScans:
    """Sound scans of meshes."""

    def __init__(self, parts: list[Path], recording: Recording) -> None:
        self.parts = parts
        self._replay = Replay(recording)

    @cached_property
    def _shapes(self) -> dict[Path, tuple[Shape, Rays, float]]:
        return {}

    def _shape(self, part: Path) -> tuple[Shape, Rays, float]:
        if part not in self._shapes:
            mesh = trimesh.load_mesh(part)
            vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
            shape = Shape(vertices, faces, np.zeros(faces.shape))
            self._shapes[part] = shape, Rays(shape), float(mesh.area)
        return self._shapes[part]

    def part_of(self, number: int) -> Path:
        """Which part a number shows."""
        return self.parts[number % len(self.parts)]

    def made(self, number: int) -> Sound:
        """The scan of a number."""
        rng = np.random.default_rng([number, 31])
        shape, rays, area_mm2 = self._shape(self.part_of(number))
        noise = NOISES[(number // len(self.parts)) % len(NOISES)]
        count, bare = int(rng.choice(SENSORS)), rng.random() < 0.5
        turn = random_rotation(rng)
        middle = shape.vertices_mm.mean(axis=0)
        sensors = (sensors_around(shape, count) - middle) @ turn.T + middle
        share = 0.35 if count == 1 else 0.9 / count  # of the surface that a view has for its own
        points_each = min(area_mm2 * share / rng.uniform(*SPACING_MM) ** 2, MOST_POINTS / count)
        lumps = Lumps.drawn(shape, rng)
        clouds = []
        for sensor in sensors:
            seen = look(
                shape, rays, sensors_mm=sensor[None], count=int(points_each), sigma_mm=0.0, rng=rng
            )
            clouds.append(self._measured(noise, seen.points_mm, seen.normals, sensor, lumps, rng))
        index = np.repeat(np.arange(count), [len(cloud) for cloud in clouds])
        told = f"{noise}{'' if bare else ', sensors'}, {count}"
        return _laid(np.vstack(clouds), None if bare else sensors, index, rng, kind=told)

    def _measured(
        self,
        noise: str,
        points: np.ndarray,
        normals: np.ndarray,
        sensor: np.ndarray,
        lumps: Lumps,
        rng: np.random.Generator,
    ) -> np.ndarray:
        """Points with the errors of one view."""
        if noise == "recorded":
            apart_mm = cKDTree(points).query(points[::50], k=2)[0][:, 1]
            return points + self._replay.errors_mm(
                points, normals, sensor, spacing_mm=float(np.median(apart_mm)), rng=rng
            )
        white = rng.normal(scale=lumps.white_mm, size=(len(points), 1))
        common = lumps.at(points)[:, None] if noise == "lumpy" else 0.0
        return points + (white + common) * normals


@dataclass(frozen=True, slots=True)
class Lumps:
    """Errors that hang together: heavy-tailed values at knots, blended by a Gaussian."""

    knots_mm: np.ndarray
    value_mm: np.ndarray
    length_mm: float
    white_mm: float

    @classmethod
    def drawn(cls, shape: Shape, rng: np.random.Generator) -> Lumps:
        """Of a length of 2 to 5 mm and a size of 0.04 to 0.12 mm."""
        length_mm = float(rng.uniform(2.0, 5.0))
        mesh = trimesh.Trimesh(shape.vertices_mm, shape.faces, process=False)
        count = int(mesh.area / (KNOT_SHARE * length_mm) ** 2) + 16
        knots, _ = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))
        value = rng.standard_t(FREEDOMS, count)
        made = cls(np.asarray(knots), value, length_mm, float(rng.uniform(0.03, 0.08)))
        value = value * rng.uniform(0.04, 0.12) / float(np.std(made.at(made.knots_mm)))
        return cls(made.knots_mm, value, length_mm, made.white_mm)

    def at(self, points: np.ndarray) -> np.ndarray:
        """(n,) the common error of points."""
        apart, near = cKDTree(self.knots_mm).query(points, k=12)
        weight = np.exp(-0.5 * (apart / (0.5 * self.length_mm)) ** 2) + 1e-12
        return np.asarray((weight * self.value_mm[near]).sum(axis=1) / weight.sum(axis=1))
