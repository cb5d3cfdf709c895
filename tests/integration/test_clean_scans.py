"""Whole clean prints: noise, a pose that is off and the steps of real layers are no defect."""

from __future__ import annotations

import os
from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh

from amrepair.deficit import compute_deficit
from amrepair.frames import Transform
from amrepair.regions import detect
from amrepair.scans import Scan
from amrepair.template import load_mesh, load_or_fit
from gcode.solids import as_manifold

OURS = Path(__file__).parents[2] / "examples" / "parts"
DATA = os.environ.get("AMREPAIR_DATA")
PARTS = [pytest.param(OURS / "knob.stl", marks=pytest.mark.slow), OURS / "pebble.stl"]
REAL = sorted((Path(DATA) / "parts").glob("prusa-[a-z]*.stl"))[:10] if DATA else []
NOISE_MM, SPACING_MM, POSE_MM, LAYER_MM = 0.04, 0.25, 0.05, 0.2
IN_PLACE = Transform.identity("build", "template")


def _solid(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    solid = as_manifold(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    assert solid.status() == manifold3d.Error.NoError
    return solid


def _mesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))


def _in_layers(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """What layers make of a part: its sections at the middle of each, drawn up to its top."""
    solid = _solid(mesh)
    low, high = (float(z) for z in mesh.bounds[:, 2])
    layers = []
    for k in range(round((high - low) / LAYER_MM)):
        section = solid.slice(low + (k + 0.5) * LAYER_MM)
        # a little into the next, or faces between them would be left inside
        layers.append(section.extrude(LAYER_MM + 2e-3).translate((0.0, 0.0, low + k * LAYER_MM)))
    return _mesh(manifold3d.Manifold.batch_boolean(layers, manifold3d.OpType.Add))


def _scan(mesh: trimesh.Trimesh, seed: int) -> Scan:
    rng = np.random.default_rng(seed)
    points, _ = trimesh.sample.sample_surface(mesh, int(mesh.area / SPACING_MM**2), seed=seed)
    away = rng.normal(size=3)
    noise = rng.normal(scale=NOISE_MM, size=points.shape)
    points = np.asarray(points) + noise + POSE_MM * away / np.linalg.norm(away)
    return Scan(points, NOISE_MM, "template")


def _has_no_region(path: Path, seed: int) -> None:
    mesh = load_mesh(path)
    template = load_or_fit(mesh)
    layers = _in_layers(mesh)
    scan = _scan(layers, seed)
    anomaly = detect(scan, template)
    assert anomaly.regions == ()
    deficit = compute_deficit(scan, template, anomaly, build_from_template=IN_PLACE)
    assert deficit.regions == ()
    # and it does look: 1 mm of a rim is gone
    low, high = layers.bounds
    tool = manifold3d.Manifold.cube(tuple(high - low)).translate(tuple(high - [4.0, 4.0, 1.0]))
    solid = _solid(layers)
    if (solid ^ tool).volume() > 5.0:
        assert detect(_scan(_mesh(solid - tool), seed), template).regions


@pytest.mark.slow
@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.stem)
def test_a_clean_part_in_layers_has_no_region(path: Path) -> None:
    _has_no_region(path, 0)


@pytest.mark.skipif(DATA is None, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize("path", REAL[:1], ids=lambda path: path.stem)
def test_a_clean_real_part_in_layers_has_no_region(path: Path) -> None:
    _has_no_region(path, 0)


@pytest.mark.slow
@pytest.mark.skipif(DATA is None, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_nor_has_any_other_or_with_other_noise(path: Path, seed: int) -> None:
    _has_no_region(path, seed)
