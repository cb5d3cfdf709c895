"""What the examples share: a folder to write to, and a scan of a solid that we broke ourselves."""

from __future__ import annotations

import argparse
from pathlib import Path

import manifold3d as m3
import numpy as np
import trimesh

from amrepair import Scan

PARTS = Path(__file__).parent / "parts"


def out_folder(description: str | None) -> Path:
    """The folder named by --out, made where it is not there."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--out", type=Path, default=Path("out/examples"), help="Folder to write.")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def mesh_of(solid: m3.Manifold) -> trimesh.Trimesh:
    """A solid as a mesh."""
    mesh = solid.to_mesh64()
    vertices = np.array(mesh.vert_properties)[:, :3]
    return trimesh.Trimesh(vertices, np.array(mesh.tri_verts), process=False)


def scan_of(
    solid: m3.Manifold,
    *,
    frame: str,
    count: int = 80_000,
    seed: int = 0,
    underside: bool = False,
) -> Scan:
    """What a scanner all around and above would measure, noise 0.03 mm; below only if asked."""
    mesh = mesh_of(solid)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = np.asarray(mesh.face_normals)[faces]
    seen = (normals[:, 2] > -0.5) | underside
    noise = np.random.default_rng(seed).normal(scale=0.03, size=points.shape)
    return Scan((np.asarray(points) + noise)[seen], 0.03, frame, normals[seen], source="example")
