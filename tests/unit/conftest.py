"""The files that examples in docstrings and pages find in the folder they run in."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import trimesh

import amrepair
import gcode
from amrepair.scans import Scan, write_ply
from amrepair.template.fit import fit_fast
from amrepair.template.options import FitOptions

PLACE_MM = (100.0, 80.0, 0.0)
SMALL_FIT = FitOptions(cells=64, samples=40_000)


def write_mesh(solid: m3.Manifold, path: Path) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    made = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    made.export(path)
    return made


def shrink_fits(patch: pytest.MonkeyPatch) -> None:
    """The block is flat: a tenth of the work fits it as well."""
    patch.setattr("amrepair.template.fitting.fit_fast", partial(fit_fast, options=SMALL_FIT))


@pytest.fixture
def small_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_fits(monkeypatch)


@pytest.fixture(scope="session")
def example_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A stepped block that lost a corner: meshes, scan, job, template, and a scan of a bare bed."""
    where = tmp_path_factory.mktemp("examples")
    part = m3.Manifold.cube((30.0, 20.0, 6.0))
    part += m3.Manifold.cube((18.0, 20.0, 4.0)).translate((0.0, 0.0, 5.0))
    part -= m3.Manifold.cube((10.0, 10.0, 2.0)).translate((0.0, 12.0, 7.5))
    corner = m3.Manifold.cube((7.0, 8.0, 1.6)).translate((23.0, 0.0, 4.4))
    write_mesh(part, where / "part.stl")
    write_mesh(part.translate(PLACE_MM), where / "placed.stl")
    standing = write_mesh((part - corner).translate(PLACE_MM), where / "standing.stl")
    points, faces = trimesh.sample.sample_surface(standing, 60_000, seed=1)
    normals = np.asarray(standing.face_normals)[faces]
    rng = np.random.default_rng(0)
    noisy = np.asarray(points) + rng.normal(scale=0.03, size=points.shape)
    write_ply(Scan(noisy, 0.03, "build", normals), where / "scan.ply")
    flat = np.column_stack([rng.uniform(0.0, 200.0, (5000, 2)), rng.normal(scale=0.03, size=5000)])
    write_ply(Scan(flat, 0.03, "scanner"), where / "bed.ply")
    setup = gcode.load_setup()
    toolpath = gcode.slice_part(gcode.read_solid(where / "placed.stl"), setup)
    (where / "job.gcode").write_text(gcode.write_program(toolpath, setup, title="job").text)
    with pytest.MonkeyPatch.context() as patch:
        shrink_fits(patch)
        amrepair.fit_template(where / "part.stl").save(where / "part.safetensors")
    return where
