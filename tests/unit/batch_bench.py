"""A small part and cheap scans of it: what the tests of batches share."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import trimesh

from amrepair.scans import Scan, write_ply
from amrepair.template import fit_template
from amrepair.template.options import FitOptions

PLACE_MM = (50.0, 60.0, 0.0)
POINTS = 3_000


def lug(pocket_mm: float = 0.0) -> trimesh.Trimesh:
    """A stepped block without symmetry; a pocket in its floor, so deep."""
    body = trimesh.creation.box(bounds=((0, 0, 0), (30, 20, 4)))
    foot = trimesh.creation.box(bounds=((0, 0, 0), (7, 20, 6.5)))
    rib = trimesh.creation.box(bounds=((0, 3, 0), (24, 6, 5)))
    whole = trimesh.boolean.union([body, foot, rib], engine="manifold")
    if not pocket_mm:
        return whole
    pocket = trimesh.creation.box(bounds=((14, 10, 4 - pocket_mm), (20, 16, 6)))
    return trimesh.boolean.difference([whole, pocket], engine="manifold")


def write_scan(path: Path, mesh: trimesh.Trimesh, seed: int, points: int = POINTS) -> None:
    """A cloud of the part as it stands on the bed."""
    rng = np.random.default_rng(seed)
    found, faces = trimesh.sample.sample_surface(mesh, points, seed=seed)
    noisy = np.asarray(found) + rng.normal(0.0, 0.02, (points, 3)) + PLACE_MM
    normals = np.asarray(mesh.face_normals)[faces]
    write_ply(Scan(noisy, 0.02, "build", normals, source=path.name), path)


def write_scans(folder: Path, count: int, *, points: int = POINTS) -> Path:
    """Every third part has a pocket."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = [lug(), lug(1.0), lug(2.0)]
    for k in range(count):
        write_scan(folder / f"{k:05d}.ply", parts[(k // 3) % 2 + 1 if k % 3 == 0 else 0], k, points)
    return folder


def bracket() -> trimesh.Trimesh:
    """Another part, of about the lug's size and without symmetry."""
    foot = trimesh.creation.box(bounds=((0, 0, 0), (26, 18, 3)))
    wall = trimesh.creation.box(bounds=((0, 0, 0), (4, 18, 16)))
    rib = trimesh.creation.box(bounds=((0, 2, 0), (14, 5, 9)))
    return trimesh.boolean.union([foot, wall, rib], engine="manifold")


def write_template(path: Path, part: trimesh.Trimesh | None = None) -> Path:
    """Fitted, with a tenth of the work: the parts are flat."""
    mesh = path.with_suffix(".stl")
    (part or lug()).export(mesh)
    fit_template(mesh, fast=FitOptions(cells=64, samples=40_000), seed=0).save(path)
    return path


def tables(out: Path) -> tuple[bytes, bytes]:
    return (out / "table.csv").read_bytes(), (out / "overview.html").read_bytes()


def results(out: Path) -> dict[str, dict[str, object]]:
    """Every kept result, but for what it cost."""
    found = {}
    for path in sorted((out / "results").glob("*/*.json")):
        said = json.loads(path.read_text())
        said.pop("cost")
        found[path.name] = said
    return found


def sums_files(out: Path) -> dict[str, bytes]:
    """The packed sums of every result that has some."""
    found = {name: base64.b64decode(str(said["sums"])) for name, said in results(out).items()}
    return {name: data for name, data in found.items() if data}
