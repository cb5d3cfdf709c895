"""The names at the top of both packages: pinned, light to import, each with a running example."""

from __future__ import annotations

import ast
import doctest
import importlib
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import manifold3d as m3
import numpy as np
import pytest
import trimesh

import amrepair
import gcode
from amrepair.scans import Scan, write_ply

# A name that goes, goes with a new major version; one that comes, comes with a new minor one.
NAMES = {
    "amrepair": {
        "AmrepairError", "RepairPlan", "Scan", "Scanner", "Site", "Transform", "align_scan",
        "detect_defects", "fit_template", "open_template", "plan_repair", "read_scan", "run_loop",
    },
    "gcode": {
        "CheckedProgram", "GcodeError", "HeightField", "Program", "check_program", "connect",
        "estimate_program", "load_setup", "read_job", "read_solid", "slice_part", "slice_patch",
        "write_program",
    },
}  # fmt: skip
HEAVY = {"numpy", "torch", "open3d", "scipy", "trimesh", "numba", "plotly", "pydantic"}
PLACE_MM = (100.0, 80.0, 0.0)


def write_mesh(solid: m3.Manifold, path: Path) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    made = trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    made.export(path)
    return made


@pytest.fixture(scope="module", autouse=True)
def small_fits() -> Iterator[None]:
    """The block is flat: a tenth of the work fits it as well."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {"GRID_CELLS": 64, "SAMPLES": 40_000, "STEPS": 30}.items():
            patch.setattr(f"amrepair.template.fit.{name}", value)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the examples find in the folder they run in: a stepped block that lost a corner."""
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
    seen = normals[:, 2] > -0.5
    noise = np.random.default_rng(0).normal(scale=0.03, size=points.shape)
    noisy = np.asarray(points) + noise
    write_ply(Scan(noisy[seen], 0.03, "build", normals[seen]), where / "scan.ply")
    setup = gcode.load_setup()
    toolpath = gcode.slice_part(gcode.read_solid(where / "placed.stl"), setup)
    (where / "job.gcode").write_text(gcode.write_program(toolpath, setup, title="job").text)
    amrepair.fit_template(where / "part.stl").save(where / "part.safetensors")
    return where


@pytest.mark.parametrize("package", [amrepair, gcode], ids=["amrepair", "gcode"])
def test_the_names_are_these(package: ModuleType) -> None:
    name = package.__name__
    assert set(package.__all__) == NAMES[name] == set(package._HOMES)
    assert NAMES[name] <= set(dir(package))
    for one in NAMES[name]:
        assert getattr(package, one) is not None
    with pytest.raises(AttributeError, match="nonsense"):
        _ = package.nonsense
    assert (Path(str(package.__file__)).parent / "py.typed").is_file()


@pytest.mark.parametrize("package", [amrepair, gcode], ids=["amrepair", "gcode"])
def test_type_checkers_see_what_is_loaded(package: ModuleType) -> None:
    """The imports under TYPE_CHECKING and the table of homes say the same."""
    tree = ast.parse(Path(str(package.__file__)).read_text(encoding="utf-8"))
    told = {
        alias.asname or alias.name: (node.module, alias.name)
        for branch in ast.walk(tree)
        if isinstance(branch, ast.If)
        for node in branch.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert told == package._HOMES


def test_importing_loads_nothing_heavy() -> None:
    code = "import sys, json, amrepair, gcode; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not HEAVY & set(json.loads(done.stdout))


def test_from_scan_to_program_neither_torch_nor_open3d_is_loaded() -> None:
    code = (
        "import sys, amrepair, gcode\n"
        "for package in (amrepair, gcode):\n"
        "    for name in package.__all__: getattr(package, name)\n"
        "assert not {'torch', 'open3d'} & set(sys.modules), 'loaded too early'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def examples() -> list[str]:
    return [
        "amrepair",
        "gcode",
        *(f"amrepair.{name}" for name in sorted(NAMES["amrepair"])),
        *(f"gcode.{name}" for name in sorted(NAMES["gcode"])),
    ]


@pytest.mark.parametrize("name", examples())
def test_its_example_runs(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package, _, attribute = name.partition(".")
    module = importlib.import_module(package)
    thing = getattr(module, attribute) if attribute else module
    monkeypatch.chdir(folder)
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    found = doctest.DocTestParser().get_doctest(thing.__doc__ or "", {}, name, None, None)
    assert found.examples, f"{name} has no example"
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    said: list[str] = []
    result = doctest.DocTestRunner(optionflags=flags).run(found, out=said.append)
    assert result.failed == 0, "".join(said)


def test_ten_lines_go_from_a_scan_to_a_program() -> None:
    lines = doctest.DocTestParser().get_examples(amrepair.__doc__ or "")
    assert len(lines) <= 10
