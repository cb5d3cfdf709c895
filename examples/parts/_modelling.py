"""What the example parts share: rounded outlines, holes that print, and a deterministic STL."""

from __future__ import annotations

import struct
from pathlib import Path

import manifold3d as m3
import numpy as np

SEGMENTS = 128  # per full circle: a chord error below 0.01 mm at 16 mm radius


def rounded_plate(size_mm: tuple[float, float], height_mm: float, radius_mm: float) -> m3.Manifold:
    """A plate with its corner at the origin and rounded vertical edges."""
    core = m3.CrossSection.square((size_mm[0] - 2 * radius_mm, size_mm[1] - 2 * radius_mm))
    outline = core.offset(radius_mm, m3.JoinType.Round, circular_segments=SEGMENTS)
    return outline.translate((radius_mm, radius_mm)).extrude(height_mm)


def cylinder(radius_mm: float, height_mm: float, top_radius_mm: float | None = None) -> m3.Manifold:
    """A cylinder or cone frustum on the plane z = 0."""
    top_mm = radius_mm if top_radius_mm is None else top_radius_mm
    return m3.Manifold.cylinder(height_mm, radius_mm, top_mm, SEGMENTS)


def teardrop_along_y(radius_mm: float, length_mm: float) -> m3.Manifold:
    """A horizontal hole whose roof rises at 45°, so that it prints without support."""
    angles_rad = np.linspace(np.deg2rad(135), np.deg2rad(405), SEGMENTS, endpoint=True)
    circle = radius_mm * np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
    tip = np.array([[0.0, radius_mm * np.sqrt(2.0)]])
    outline = m3.CrossSection([np.concatenate([circle, tip])])
    return outline.extrude(length_mm).rotate((90, 0, 0)).translate((0, length_mm, 0))


def write_stl(solid: m3.Manifold, path: Path, name: str) -> None:
    """Write binary STL whose bytes depend on the shape alone.

    Triangles start at their lowest corner and are sorted, whatever order the kernel left.
    """
    mesh = solid.to_mesh64()
    # corners are joined on a grid of 0.1 µm, so that STL's float32 tears nothing apart
    exact = np.round(np.asarray(mesh.vert_properties)[:, :3], 4)
    corners, joined = np.unique(exact, axis=0, return_inverse=True)
    faces = joined.ravel()[np.asarray(mesh.tri_verts)]
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    triangles = corners.astype(np.float32)[faces[distinct]]
    first = np.array([min(range(3), key=lambda k, t=t: tuple(t[k])) for t in triangles])
    order = (first[:, None] + np.arange(3)) % 3
    triangles = np.take_along_axis(triangles, order[:, :, None], axis=1)
    triangles = triangles[np.lexsort(triangles.reshape(len(triangles), 9).T[::-1])]
    wide = triangles.astype(np.float64)
    normals = np.cross(wide[:, 1] - wide[:, 0], wide[:, 2] - wide[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    record = np.zeros(
        len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flags", "<u2")]
    )
    record["normal"] = np.round(normals, 6) + 0.0  # + 0.0 turns -0.0 into 0.0
    record["corners"] = triangles + np.float32(0.0)
    path.write_bytes(
        name.encode().ljust(80, b" ") + struct.pack("<I", len(triangles)) + record.tobytes()
    )
