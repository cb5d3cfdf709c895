"""Templates from scans and libraries of templates, as a user calls them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.frames import rotation_from_vector
from amrepair.scans import Scan, write_ply
from amrepair.template import LearnedSdf, MeshSdf, load_mesh, load_template
from tests.commands import ROOT, here

pytestmark = pytest.mark.slow  # a minute of work

PARTS = ROOT / "examples" / "parts"


def write_scan(path: Path, part: str, seed: int, turn: float) -> Path:
    mesh = load_mesh(PARTS / f"{part}.stl")
    points = np.asarray(trimesh.sample.sample_surface(mesh, 30_000, seed=seed)[0])
    points = points + np.random.default_rng(seed).normal(0, 0.03, points.shape)
    rotation = rotation_from_vector(turn * np.array([0.3, -0.8, 0.5]))
    write_ply(Scan(points @ rotation.T + 20 * turn, 0.03, "scanner"), path)
    return path


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One part learned from scans, one from its mesh."""
    folder = tmp_path_factory.mktemp("library")
    scans = [write_scan(folder / f"{k}.ply", "bracket", k, 2.0 * k) for k in range(3)]
    done = here("template", "fit", *scans, "-o", folder / "bracket.safetensors")
    assert done.returncode == 0, done.stderr
    assert "3 of 3 scans merged" in done.stderr
    for scan in scans:
        scan.unlink()
    done = here("template", "fit", PARTS / "pebble.stl", "-o", folder / "pebble.safetensors")
    assert done.returncode == 0, done.stderr
    return folder


def test_a_template_from_scan_files_is_the_part(library: Path) -> None:
    template = load_template(library / "bracket.safetensors")
    assert isinstance(template, LearnedSdf)
    # the template's frame is the first scan's, which was not turned
    exact = MeshSdf.from_mesh(load_mesh(PARTS / "bracket.stl"))
    points = np.asarray(trimesh.sample.sample_surface(exact.mesh, 30_000, seed=9)[0])
    assert np.abs(template.distance(points)).mean() < 0.03


def test_the_right_template_of_a_folder_is_taken(library: Path, tmp_path: Path) -> None:
    scan = write_scan(tmp_path / "scan.ply", "bracket", 7, 1.0)
    done = here("align", scan, "--template", library, "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["template"] == "bracket"
    assert said["confidence"] > 0.5
    assert set(said["candidates"]) == {"bracket", "pebble"}
    assert said["rmse_mm"] < 0.1


def test_the_published_alignment_on_the_command_line(library: Path, tmp_path: Path) -> None:
    scan = write_scan(tmp_path / "scan.ply", "bracket", 8, 0.0)
    template = library / "bracket.safetensors"
    words = ["align", scan, "--template", template, "--json", "--method", "paper"]
    done = here(*words, "--pam", "ransac=off", "--pam", "variant=code")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["method"] == "paper"
    assert np.abs(np.array(said["template_from_scan"]) - np.eye(4)).max() < 0.5
    done = here("align", scan, "--template", template, "--pam", "icp=off")
    assert done.returncode == 2
    assert "--pam belongs to --method paper" in done.stderr


def test_the_mesh_of_a_template_is_written_and_told(library: Path, tmp_path: Path) -> None:
    output = tmp_path / "pebble.stl"
    done = here("template", "mesh", library / "pebble.safetensors", "-o", output)
    assert done.returncode == 0, done.stderr
    made, part = trimesh.load(output), trimesh.load(PARTS / "pebble.stl")
    assert made.is_watertight
    assert made.volume == pytest.approx(part.volume, rel=0.005)
    assert f"{len(made.faces):,} triangles" in done.stdout
    assert "closed" in done.stdout
