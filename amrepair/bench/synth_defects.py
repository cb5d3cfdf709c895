"""The six defects of the data sets, made on a solid: where the surface changed is known exactly.

Bulge, concavity, hole, break and crack are booleans: each triangle knows which solid it came
from. Bend, and bulges and concavities that run out smoothly, move vertices: each knows how far.
Sizes follow the part's diagonal, depths the material that is there. It makes shapes; `synth_views`
looks at them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import manifold3d as m3
import numpy as np
from jaxtyping import Float

from amrepair.arrays import Values, Vector, Vertices
from amrepair.bench.options import DEFAULT_MAKING
from amrepair.bench.synth_views import Rays, SeenSurface, Shape, sample_shape, sensors_around
from amrepair.errors import InputError
from gcode.meshes import mesh_of
from gcode.solids import as_manifold, is_valid

# The face of a tool: a change without measure, above every limit of visibility.
NEW_SURFACE_MM = 1e9


class SynthDefect(StrEnum):
    """Words as in Anomaly-ShapeNet."""

    BULGE = "bulge"
    CONCAVITY = "concavity"
    HOLE = "hole"
    BREAK = "break"
    BEND = "bend"
    CRACK = "crack"


@dataclass(frozen=True, slots=True)
class Seed:
    """Where a defect sits: a point that can be seen, its normal, the material below it."""

    point_mm: Vector
    normal: Vector
    thickness_mm: float


@dataclass(frozen=True, slots=True)
class Part:
    """A normal part, ready to be damaged."""

    solid: Any  # manifold3d.Manifold, marked as original
    shape: Shape
    seeds: SeenSurface
    thickness_mm: Values

    @property
    def diagonal_mm(self) -> float:
        """Diagonal of the bounding box."""
        return self.shape.diagonal_mm


def make_part(vertices_mm: Vertices, faces: np.ndarray, rng: np.random.Generator) -> Part:
    """A part from a closed mesh; seeds are surface points that some sensor sees."""
    solid = as_manifold(vertices_mm, faces).as_original()
    shape = Shape(vertices_mm, faces, np.zeros((len(faces), 3)))
    rays = Rays(shape)
    points = sample_shape(shape, DEFAULT_MAKING.seed_points, rng)
    seen = points.take(rays.seen(points, sensors_around(shape)))
    if len(seen.points_mm) == 0:
        raise InputError("no point of the part can be seen from outside; is it inside out?")
    return Part(solid, shape, seen, rays.thickness_mm(seen))


@dataclass(frozen=True, slots=True)
class Size:
    """How large a defect is made, and whether it has an edge.

    Attributes
    ----------
    scale
        Of the usual size: at 1 bulges are 8 to 16 % of the part's diagonal wide.
    smooth
        Bulges and concavities run out into the surface, without an edge.
    """

    scale: float = 1.0
    smooth: bool = False


USUAL = Size()


def damage(part: Part, defect: SynthDefect, rng: np.random.Generator, size: Size = USUAL) -> Shape:
    """The part with one defect.

    Raises
    ------
    InputError
        If no place on the part takes this defect.
    """
    make = _MAKERS[defect]
    for _ in range(DEFAULT_MAKING.attempts):
        i = int(rng.integers(len(part.thickness_mm)))
        seed = Seed(part.seeds.points_mm[i], part.seeds.normals[i], float(part.thickness_mm[i]))
        shape = make(part, seed, rng, size)
        if shape is not None and (shape.change_mm > 0).any():
            return shape
    raise InputError(
        f"no place for a {defect} was found on the part in {DEFAULT_MAKING.attempts} tries; "
        "it may be too thin: leave the part out"
    )


def _frame(seed: Seed, rng: np.random.Generator) -> Float[np.ndarray, "3 4"]:
    """Local to part coordinates: z along the normal, x turned at random."""
    u = np.cross(seed.normal, rng.normal(size=3))
    u /= np.linalg.norm(u)
    return np.stack([u, np.cross(seed.normal, u), seed.normal, seed.point_mm], axis=1)


def _waves(rng: np.random.Generator, frequency: float) -> Callable[[np.ndarray], np.ndarray]:
    """A smooth random function of (n, 3) points, about −1…1: a few plane waves."""
    k = frequency * rng.normal(size=(DEFAULT_MAKING.waves, 3))
    phase = rng.uniform(0, 2 * np.pi, DEFAULT_MAKING.waves)
    return lambda x: np.sin(x @ k.T + phase).mean(axis=1) * 2.0


def _lump(radius_mm: float, height_mm: float, rng: np.random.Generator) -> Any:
    """An uneven ellipsoid about the origin."""
    wave = _waves(rng, 1.2)
    stretch = rng.uniform(0.75, 1.3)
    ball = m3.Manifold.sphere(1.0, 72).warp_batch(lambda x: x * (1 + 0.12 * wave(x))[:, None])
    return ball.scale((radius_mm * stretch, radius_mm / stretch, height_mm))


def _result(part: Part, solid: Any) -> Shape | None:
    """Shape of a boolean's result: triangles that are not the part's own are new surface."""
    if not is_valid(solid):
        return None
    mesh = solid.to_mesh64()
    vertices, faces = mesh_of(solid)
    runs = np.asarray(mesh.run_index, dtype=np.int64) // 3
    origin = np.repeat(np.asarray(mesh.run_original_id), np.diff(runs))
    new = origin != part.solid.original_id()
    change = np.where(new[:, None], NEW_SURFACE_MM, 0.0) * np.ones((1, 3))
    return Shape(vertices, faces, change)


def _bulge(part: Part, seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    radius_mm = size.scale * rng.uniform(*DEFAULT_MAKING.bulge_ratio) * part.diagonal_mm
    height_mm = rng.uniform(0.35, 0.7) * radius_mm
    if size.smooth:
        return _swelling(part, seed, radius_mm, height_mm)
    if seed.thickness_mm < DEFAULT_MAKING.least_thickness_ratio * part.diagonal_mm:
        return None
    # The lump's lower half stays inside the material, or the far side would bulge, too.
    floor_mm = min(height_mm, 0.9 * seed.thickness_mm)
    dome = _lump(radius_mm, height_mm, rng).trim_by_plane((0.0, 0.0, 1.0), -floor_mm)
    return _result(part, part.solid + dome.transform(_frame(seed, rng)).as_original())


def _concavity(part: Part, seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    radius_mm = size.scale * rng.uniform(*DEFAULT_MAKING.bulge_ratio) * part.diagonal_mm
    depth_mm = min(rng.uniform(0.35, 0.7) * radius_mm, 0.6 * seed.thickness_mm)
    if depth_mm < DEFAULT_MAKING.least_depth_ratio * part.diagonal_mm:
        return None
    if size.smooth:
        return _swelling(part, seed, radius_mm, -depth_mm)
    lump = _lump(radius_mm, depth_mm, rng).transform(_frame(seed, rng))
    return _result(part, part.solid - lump.as_original())


def _swelling(part: Part, seed: Seed, radius_mm: float, height_mm: float) -> Shape | None:
    """The surface moved along a seed's normal by a bump without an edge: h (1 − ρ²/r²)².

    What faces away from the normal stays: the far side of a wall is none of the bump.
    """
    edge_mm = (
        max(radius_mm, DEFAULT_MAKING.least_smooth_ratio * part.diagonal_mm)
        / DEFAULT_MAKING.smooth_edges
    )
    vertices, faces = mesh_of(part.solid.refine_to_length(edge_mm))
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = np.zeros((len(vertices), 3))
    for corner in range(3):
        np.add.at(facing, faces[:, corner], across)
    offset = vertices - seed.point_mm
    inside = (np.linalg.norm(offset, axis=1) < radius_mm) & (facing @ seed.normal > 0)
    share = np.where(inside, 1.0 - (offset**2).sum(axis=1) / radius_mm**2, 0.0)
    shift_mm = height_mm * share**2
    if np.abs(shift_mm).max() < 0.5 * abs(height_mm):
        return None  # no vertex lies near the seed
    return Shape(vertices + shift_mm[:, None] * seed.normal, faces, np.abs(shift_mm)[faces])


def _hole(part: Part, seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    radius_mm = size.scale * rng.uniform(0.02, 0.045) * part.diagonal_mm
    if seed.thickness_mm < DEFAULT_MAKING.least_thickness_ratio * part.diagonal_mm:
        return None
    # The hole goes through thin walls and is blind in thick ones.
    depth_mm = min(1.1 * seed.thickness_mm, 0.12 * part.diagonal_mm)
    wave = _waves(rng, 1.2)
    tool = m3.Manifold.cylinder(1.0, 1.0, 1.0, 48).translate((0.0, 0.0, -1.0))
    tool = tool.scale((radius_mm, radius_mm, depth_mm))
    tool = tool + m3.Manifold.cylinder(radius_mm, radius_mm, radius_mm, 48)
    tool = tool.refine_to_length(radius_mm / 3).warp_batch(
        lambda x: x * (1 + 0.12 * wave(x / radius_mm))[:, None] * (1, 1, 0) + x * (0, 0, 1)
    )
    return _result(part, part.solid - tool.transform(_frame(seed, rng)).as_original())


def _crack(part: Part, seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    diagonal_mm = part.diagonal_mm
    depth_mm = min(size.scale * rng.uniform(0.03, 0.06) * diagonal_mm, 0.7 * seed.thickness_mm)
    if depth_mm < DEFAULT_MAKING.least_depth_ratio * diagonal_mm:
        return None
    length_mm = size.scale * rng.uniform(0.12, 0.25) * diagonal_mm
    width_mm = size.scale * rng.uniform(0.012, 0.02) * diagonal_mm
    knots = 9
    x = np.linspace(-0.5, 0.5, knots) * length_mm
    y = rng.uniform(-0.05, 0.05, knots) * length_mm
    half = 0.5 * width_mm * np.sin(np.linspace(0.12, np.pi - 0.12, knots))
    outline = np.concatenate(
        [np.stack([x, y - half], axis=1), np.stack([x, y + half], axis=1)[::-1]]
    )
    section = m3.CrossSection([outline])
    # This is a zigzag slit. It reaches above the seed so as to clear a curved surface.
    # Its width falls to a third at the bottom, so that its walls can be seen.
    blade = section.extrude(depth_mm + width_mm, scale_top=(0.9, 0.3))
    blade = blade.rotate((180.0, 0.0, 0.0)).translate((0.0, 0.0, width_mm))
    blade = blade.transform(_frame(seed, rng))
    return _result(part, part.solid - blade.as_original())


def _break(part: Part, _seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    """Everything beyond a rough plane is gone: 3 to 12 % of the volume."""
    diagonal_mm = part.diagonal_mm
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    share = size.scale**2 * rng.uniform(0.03, 0.12)  # an edge breaks off as its square
    height = part.shape.vertices_mm @ normal
    low, high = float(height.min()), float(height.max())
    volume = part.solid.volume()
    for _ in range(20):
        middle = (low + high) / 2
        beyond = part.solid.trim_by_plane(tuple(normal), middle).volume()
        low, high = (middle, high) if beyond > share * volume else (low, middle)
    centre = part.shape.vertices_mm.mean(axis=0)
    on_plane = centre + (high - centre @ normal) * normal
    wave = _waves(rng, 1.0 / (0.05 * diagonal_mm))
    rough_mm = 0.006 * size.scale * diagonal_mm
    block = m3.Manifold.cube((3 * diagonal_mm,) * 3, True).translate((0, 0, 1.5 * diagonal_mm))

    def roughen(x: np.ndarray) -> np.ndarray:
        """Move the block's lower face, which is the fracture, along z."""
        lift_mm = np.where(x[:, 2] < 1e-9, wave(x) * rough_mm, 0.0)
        return x + lift_mm[:, None] * (0, 0, 1)

    sheet = block.refine(96).warp_batch(roughen)
    frame = _frame(Seed(on_plane, normal, 0.0), rng)
    left = part.solid - sheet.transform(frame).as_original()
    if not is_valid(left):
        return None
    # Splinters are dropped; whole bodies of a part in several pieces stay.
    kept = [
        body for body in left.decompose() if body.volume() > DEFAULT_MAKING.splinter_ratio * volume
    ]
    return _result(part, m3.Manifold.compose(kept)) if kept else None


def _bend(part: Part, seed: Seed, rng: np.random.Generator, size: Size) -> Shape | None:
    """The smaller end is bent about an axis across the part's longest direction."""
    diagonal_mm = part.diagonal_mm
    fine = part.solid.refine_to_length(diagonal_mm / 60)
    vertices, faces = mesh_of(fine)
    # Shares are of the surface and not of vertices, which crowd where the mesh is fine.
    surface = sample_shape(part.shape, DEFAULT_MAKING.bend_points, rng).points_mm
    middle = surface.mean(axis=0)
    axes = np.linalg.svd((surface - middle).T @ (surface - middle))[0]
    along = axes[:, 0] * (1 if rng.random() < 0.5 else -1)
    turn = rng.uniform(0, 2 * np.pi)
    side = np.cos(turn) * axes[:, 1] + np.sin(turn) * axes[:, 2]
    u, v = (vertices - middle) @ along, (vertices - middle) @ side
    start = float(np.quantile((surface - middle) @ along, rng.uniform(0.55, 0.75)))
    angle_rad = size.scale * np.deg2rad(rng.uniform(5.0, 10.0))
    zone_mm = 0.08 * diagonal_mm
    # The line v = 0 is bent exactly: an arc of length `zone`, then straight on.
    reach = np.maximum(u - start, 0.0)
    phi = angle_rad * np.minimum(reach / zone_mm, 1.0)
    radius_mm = zone_mm / angle_rad
    beyond = np.maximum(reach - zone_mm, 0.0)
    new_u = start + (radius_mm - v) * np.sin(phi) + beyond * np.cos(phi)
    new_v = radius_mm - (radius_mm - v) * np.cos(phi) + beyond * np.sin(phi)
    moved = np.where(reach > 0, 1.0, 0.0)
    shift = moved[:, None] * ((new_u - u)[:, None] * along + (new_v - v)[:, None] * side)
    change = np.linalg.norm(shift, axis=1)
    return Shape(vertices + shift, faces, change[faces])


_MAKERS: dict[SynthDefect, Callable[[Part, Seed, np.random.Generator, Size], Shape | None]] = {
    SynthDefect.BULGE: _bulge,
    SynthDefect.CONCAVITY: _concavity,
    SynthDefect.HOLE: _hole,
    SynthDefect.BREAK: _break,
    SynthDefect.BEND: _bend,
    SynthDefect.CRACK: _crack,
}
