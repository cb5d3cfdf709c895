"""Cases from real range images: a sound merged scan, dents that keep its noise, single views.

A folder of range images (PLY) and a `.conf` file with their poses, as the Stanford range
repository has them, become

- `part.stl`, the closed surface of all views together (Poisson, Kazhdan and Hoppe 2013),
- `sound.ply`, every view in its place,
- `view-NN.ply`, each range image in its own frame,
- `dents-SEED.ply`, the merged scan with dents: a ball is taken from the part, and a point that
  stood in the ball is laid on its wall with the deviation that it had from the part. Noise,
  outliers and errors that hang together stay the scanner's.

What the closed surface itself fails to follow is left out of the merged scans. Everything is in
mm and made anew only where data, seed or this recipe changed: the folder is named by a hash.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import manifold3d as m3
import numpy as np
import open3d as o3d
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

RECIPE = 1  # raise it where cases come out otherwise: kept ones are then not used
POISSON_DEPTH = 9  # cells of 0.3 mm on a part of 150 mm
NORMAL_RADIUS_MM = 2.5
LEAST_FACING = 0.15  # cosine: what a view sees at over 81° is no good for the surface
TURN_TRIAL = 40  # every so many points decide which way round a rotation is written
# Where the median over 2.5 mm is off by over 0.5 mm, the surface does not follow the views.
SITE_MM, UNFOLLOWED_RADIUS_MM, UNFOLLOWED_MM, UNFOLLOWED_MARGIN_MM = 0.6, 2.5, 0.5, 3.0
DEPTHS_MM = (1.0, 1.5, 2.0, 3.0, 4.0, 2.5)
BALL_MM = 5.0  # a dent's ball is this much larger than the dent is deep
APART_MM = 22.0
SEEN_RADIUS_MM, SEEN_POINTS = 2.0, 60  # a dent lies where the scan has so many points
NEAR_MM = 1.5  # farther off is an outlier: it stays where it is
ONE_FACE = 0.3  # cosine between the normals of a face that a ball of 6 to 9 mm meets
TRIES = 2000
GRID_KEYS = ("num_cols", "num_rows")


@dataclass(frozen=True, slots=True)
class RangeImage:
    """Points (n, 3) of one view, mm, sensor frame (Z towards the sensor), and their grid.

    `grid` (rows, cols) has the number of the point that a cell holds, −1 for a gap; None where the
    file has none.
    """

    name: str
    points_mm: np.ndarray
    grid: np.ndarray | None


@dataclass(frozen=True, slots=True)
class Dent:
    """A ball taken from the part: its middle on the surface, what it took, and the box of that.

    `one_sided` says that the ball met one face of the part only: in a fold, or through a thin wall,
    it takes more than a dent of its depth, and what a scan can say of it is less.
    """

    centre_mm: list[float]
    depth_mm: float
    ball_mm: float
    volume_mm3: float
    box_mm: list[list[float]]
    one_sided: bool


@dataclass(frozen=True, slots=True)
class Placed:
    """A view with its pose (4, 4) template from view, its normals, and what it sees well."""

    image: RangeImage
    pose: np.ndarray
    normals: np.ndarray
    facing: np.ndarray

    @property
    def points_mm(self) -> np.ndarray:
        """(n, 3), template frame."""
        return moved(self.image.points_mm, self.pose)


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(n, 3) points by a (4, 4) pose."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def read_range_image(path: Path, unit_mm: float = 1000.0) -> RangeImage:
    """A PLY file's vertices, and its `range_grid` where it has one."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = [line.split() for line in head.decode(errors="replace").splitlines()]
    if b"format ascii" not in head:
        cloud = o3d.io.read_point_cloud(str(path))
        return RangeImage(path.name, np.asarray(cloud.points) * unit_mm, None)
    count = {w[1]: int(w[2]) for w in lines if w[:1] == ["element"] and len(w) == 3}
    size = [int(w[2]) for key in GRID_KEYS for w in lines if w[:2] == ["obj_info", key]]
    rows = body.decode().splitlines()
    n = count["vertex"]
    points = np.loadtxt(rows[:n], usecols=(0, 1, 2), ndmin=2) * unit_mm
    grid = None
    if count.get("range_grid", 0) and len(size) == len(GRID_KEYS):
        cells = [row.split() for row in rows[n : n + count["range_grid"]]]
        flat = np.array([int(cell[1]) if cell[0] != "0" else -1 for cell in cells])
        grid = flat.reshape(size[1], size[0])
    return RangeImage(path.name, points, grid)


def read_poses(conf: Path, unit_mm: float = 1000.0) -> dict[str, np.ndarray]:
    """(4, 4) template from view by file, as the lines `bmesh FILE t q` say it."""
    poses: dict[str, np.ndarray] = {}
    for line in conf.read_text().splitlines():
        words = line.split()
        if len(words) == 9 and words[0] in {"bmesh", "mesh"}:
            pose = np.eye(4)
            # the files' quaternions turn the frame, not the points
            pose[:3, :3] = Rotation.from_quat([float(w) for w in words[5:]]).inv().as_matrix()
            pose[:3, 3] = np.array([float(w) for w in words[2:5]]) * unit_mm
            poses[words[1]] = pose
    return poses


def read_views(folder: Path, conf: Path, unit_mm: float = 1000.0) -> list[Placed]:
    """Every view of a `.conf` file that is there, in its place.

    Some rotations stand in these files the other way round: the way that lays a view nearer to
    those before it is taken.
    """
    placed: list[Placed] = []
    for name, pose in read_poses(conf, unit_mm).items():
        if not (folder / name).is_file():
            continue
        image = read_range_image(folder / name, unit_mm)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(image.points_mm))
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(NORMAL_RADIUS_MM, 30))
        cloud.orient_normals_to_align_with_direction([0, 0, 1])
        normals = np.asarray(cloud.normals)
        if placed:
            tree = cKDTree(np.vstack([view.points_mm for view in placed]))
            other = pose.copy()
            other[:3, :3] = pose[:3, :3].T
            few = image.points_mm[::TURN_TRIAL]
            off = [np.median(tree.query(moved(few, way))[0]) for way in (pose, other)]
            pose = other if off[1] < off[0] else pose  # noqa: PLW2901
        facing = normals[:, 2] > LEAST_FACING
        placed.append(Placed(image, pose, normals @ pose[:3, :3].T, facing))
    if not placed:
        raise SystemExit(f"{conf} names no view that lies in {folder}: another --folder?")
    return placed


def closed_surface(views: list[Placed]) -> trimesh.Trimesh:
    """The surface of all views, closed where none looked."""
    keep = np.concatenate([view.facing for view in views])
    cloud = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(np.vstack([view.points_mm for view in views])[keep])
    )
    cloud.normals = o3d.utility.Vector3dVector(np.vstack([view.normals for view in views])[keep])
    # one thread: with more of them the surface is not the same twice
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=POISSON_DEPTH, scale=1.3, n_threads=1
    )
    whole = trimesh.Trimesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles))
    bodies = whole.split(only_watertight=True)
    if not len(bodies):
        raise SystemExit("these views have no closed surface: too few, or badly placed")
    body = max(bodies, key=lambda found: abs(found.volume))
    if body.volume < 0:
        body.invert()
    return body


class Surface:
    """A closed mesh that answers signed distance (negative inside) and the thickness of walls."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.mesh = mesh
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor(mesh.faces.astype(np.uint32)),
        )

    @cached_property
    def solid(self) -> m3.Manifold:
        """The same as a solid."""
        vertices, faces = self.mesh.vertices, self.mesh.faces
        return m3.Manifold(m3.Mesh(vertices.astype(np.float32), faces.astype(np.uint32)))

    def deviation_mm(self, points: np.ndarray) -> np.ndarray:
        """(n,) signed distance."""
        asked = o3d.core.Tensor(points.astype(np.float32))
        return np.asarray(self._scene.compute_signed_distance(asked).numpy(), dtype=float)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) outward normals of the nearest places of the surface."""
        asked = o3d.core.Tensor(points.astype(np.float32))
        faces = self._scene.compute_closest_points(asked)["primitive_ids"].numpy()
        return np.asarray(self.mesh.face_normals[faces])

    def wall_mm(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(n,) how thick the part is below points of its surface."""
        rays = np.hstack([points - 0.05 * normals, -normals]).astype(np.float32)
        return np.asarray(self._scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy())


def unfollowed(points: np.ndarray, deviation_mm: np.ndarray) -> np.ndarray:
    """(n,) where the surface does not follow what the views say, with a margin."""
    _, cell = np.unique(np.floor(points / SITE_MM).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell)
    site = np.stack([np.bincount(cell, points[:, k]) / count for k in range(3)], axis=1)
    value = np.bincount(cell, deviation_mm) / count
    near = cKDTree(site).query_ball_point(site, UNFOLLOWED_RADIUS_MM)
    off = np.array([abs(np.median(value[i])) > UNFOLLOWED_MM for i in near])[cell]
    if not off.any():
        return off
    away, _ = cKDTree(points[off]).query(points, distance_upper_bound=UNFOLLOWED_MARGIN_MM)
    return np.asarray(away < UNFOLLOWED_MARGIN_MM)


def planted(
    surface: Surface, points: np.ndarray, deviation_mm: np.ndarray, seed: int
) -> tuple[np.ndarray, list[Dent]]:
    """The merged scan with a dent of each depth, and the dents."""
    rng = np.random.default_rng(seed)
    site, face = trimesh.sample.sample_surface(surface.mesh, 20000, seed=seed)
    normal = surface.mesh.face_normals[face]
    wall_mm, out, dents = surface.wall_mm(site, normal), points.copy(), list[Dent]()
    seen = cKDTree(points).query_ball_point(site, SEEN_RADIUS_MM, return_length=True)
    seen, standing = np.flatnonzero(seen > SEEN_POINTS), surface.solid
    for depth in DEPTHS_MM:
        ball_mm = BALL_MM + depth
        for _ in range(TRIES):
            i = rng.choice(seen)
            apart = all(np.linalg.norm(site[i] - d.centre_mm) > APART_MM for d in dents)
            if wall_mm[i] > 2 * depth + 3 and apart:
                break
        else:
            continue  # no room for one this deep
        centre = site[i] + normal[i] * BALL_MM
        ball = m3.Manifold.sphere(ball_mm, 96).translate(centre.tolist())
        lost, standing = standing ^ ball, standing - ball
        near = (np.linalg.norm(out - centre, axis=1) < ball_mm) & (deviation_mm < NEAR_MM)
        ray = out[near] - centre
        ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-6)
        out[near] = centre + ray * (ball_mm - deviation_mm[near, None])
        box = np.array(lost.bounding_box()).reshape(2, 3).tolist()
        met = normal[np.linalg.norm(site - centre, axis=1) < ball_mm]
        one_sided = bool((met @ normal[i] > ONE_FACE).all())
        dents.append(Dent(site[i].tolist(), depth, ball_mm, float(lost.volume()), box, one_sided))
    return out, dents


class Cases:
    """The cases of one object, kept in a folder below `cache`."""

    def __init__(self, folder: Path, conf: Path, cache: Path, unit_mm: float = 1000.0) -> None:
        names = [name for name in read_poses(conf) if (folder / name).is_file()]
        told = hashlib.sha256(f"{RECIPE} {unit_mm} ".encode() + conf.read_bytes())
        for name in names:
            told.update((folder / name).read_bytes())
        self.name = conf.stem
        self.folder = cache / f"{conf.stem}-{told.hexdigest()[:12]}"
        self.source = (folder, conf, unit_mm)
        self.folder.mkdir(parents=True, exist_ok=True)

    @property
    def part(self) -> Path:
        """The closed surface."""
        return self.folder / "part.stl"

    @cached_property
    def surface(self) -> Surface:
        """The closed surface, loaded."""
        return Surface(trimesh.load_mesh(self.part))

    @cached_property
    def truth(self) -> dict[str, Any]:
        """What was made: views with their poses, points left out; made first where it is not."""
        path = self.folder / "truth.json"
        if not path.is_file():
            self._make()
        return dict(json.loads(path.read_text()))

    @property
    def sound(self) -> Path:
        """The merged scan."""
        return self.folder / "sound.ply"

    def view_poses(self) -> dict[Path, np.ndarray]:
        """(4, 4) template from view, by the view's file."""
        return {self.folder / name: np.array(pose) for name, pose in self.truth["views"].items()}

    def dents(self, seed: int) -> tuple[Path, list[Dent]]:
        """The merged scan with dents, and what they are."""
        path, told = self.folder / f"dents-{seed}.ply", self.folder / f"dents-{seed}.json"
        if not told.is_file():
            points = read_points(self.sound)
            broken, dents = planted(self.surface, points, self.surface.deviation_mm(points), seed)
            write_points(path, broken)
            told.write_text(json.dumps([asdict(dent) for dent in dents]))
        return path, [Dent(**dent) for dent in json.loads(told.read_text())]

    def loaded(self, count: int) -> Path:
        """The sound scan with as many points as told: fewer, or points between neighbours more."""
        path = self.folder / f"loaded-{count}.ply"
        if not path.is_file():
            points, rng = read_points(self.sound), np.random.default_rng(0)
            if count > len(points):
                lacking = rng.choice(len(points), count - len(points))
                _, near = cKDTree(points).query(points[lacking], k=2)
                points = np.vstack([points, 0.5 * (points[lacking] + points[near[:, 1]])])
            write_points(path, points[rng.permutation(len(points))[:count]])
        return path

    def _make(self) -> None:
        folder, conf, unit_mm = self.source
        views = read_views(folder, conf, unit_mm)
        closed_surface(views).export(self.part)
        points = np.vstack([view.points_mm for view in views])
        deviation_mm = self.surface.deviation_mm(points)
        bad = unfollowed(points, deviation_mm)
        write_points(self.sound, points[~bad])
        poses = {}
        for k, view in enumerate(views):
            write_points(self.folder / f"view-{k:02d}.ply", view.image.points_mm)
            poses[f"view-{k:02d}.ply"] = view.pose.tolist()
        truth = {
            "views": poses,
            "sources": [view.image.name for view in views],
            "points": len(points),
            "points_left_out": int(bad.sum()),
            "deviation_mad_mm": float(np.median(np.abs(deviation_mm))),
            "over_half_mm": float((np.abs(deviation_mm) > UNFOLLOWED_MM).mean()),
        }
        (self.folder / "truth.json").write_text(json.dumps(truth))


def write_points(path: Path, points: np.ndarray) -> None:
    """A binary PLY file."""
    o3d.io.write_point_cloud(str(path), o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))


def read_points(path: Path) -> np.ndarray:
    """(n, 3) of a PLY file."""
    return np.asarray(o3d.io.read_point_cloud(str(path)).points)
