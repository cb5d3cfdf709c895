"""Types of defects: surfaces made by formula, at a signal of twice the noise, are told apart."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.frames import Transform
from amrepair.loop import plan_stops
from amrepair.loop.kinds import typed
from amrepair.loop.sites import sites
from amrepair.repair import plan_repair
from amrepair.template import MeshSdf
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.slicing.job import plan_part
from gcode.writer import write

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "bench_kinds.py"


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bench_kinds", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_kinds"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scene(bench: ModuleType):  # type: ignore[no-untyped-def]
    setup = load_setup()
    part = m3.Manifold.cube((*bench.SIZE, 4.0))
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=np.eye(3), translation_mm=np.array([*bench.CORNER, 0.0])
    )
    toolpath = plan_part(part.translate((*bench.CORNER, 0.0)), setup).toolpath
    program = write(toolpath, setup, title="block")
    job = read_job(program, dialect=program.dialect)
    mesh = part.to_mesh64()
    template = MeshSdf.from_mesh(
        trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    )
    stop = plan_stops(job, [bench.LAYER], final=False)[0]
    return job, stop, placed, sites(job, template, placed, setup, by_beads=False)(stop)


def types_of(bench: ModuleType, scene, kind: str, seed: int) -> dict[str, float]:  # type: ignore[no-untyped-def]
    """Volume found by type; at least a crumb for each region."""
    job, stop, placed, site = scene
    pose = Transform.identity("build", "scanner")
    rng = np.random.default_rng([seed, bench.KINDS.index(kind)])
    built = bench.made(kind, job, stop.line, rng)
    scan = bench.scan_of(built, min(0.5 * built.signal_mm, 0.2), rng)
    plan = plan_repair(
        scan, site, title="", guess=placed.inverse() @ pose, strict=False,
        wanted=lambda region: False, rng=np.random.default_rng(seed),
    )  # fmt: skip
    found: dict[str, float] = {}
    for region in typed(plan, job, site, stop.line, pose).deficit.regions:
        assert 0.0 <= region.confidence <= 1.0
        found[str(region.type)] = found.get(str(region.type), 0.0) + region.volume_mm3 + 1e-3
    return found


@pytest.mark.parametrize("kind", ["void", "missing_beads", "layer_shift"])
def test_a_defect_is_told_by_its_surface(bench: ModuleType, scene, kind: str) -> None:  # type: ignore[no-untyped-def]
    found = types_of(bench, scene, kind, 0)
    assert max(found, key=found.__getitem__) == kind


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_nine_of_ten_are_told(bench: ModuleType, scene, seed: int) -> None:  # type: ignore[no-untyped-def]
    right = 0
    for kind in bench.KINDS:
        found = types_of(bench, scene, kind, 100 + seed)
        right += bool(found) and max(found, key=found.__getitem__) == kind
    assert right >= 0.9 * len(bench.KINDS)


def test_a_clean_surface_has_no_type(bench: ModuleType, scene) -> None:  # type: ignore[no-untyped-def]
    job, stop, placed, site = scene
    pose = Transform.identity("build", "scanner")
    scan = bench.scan_of(bench.Built(0.2), 0.05, np.random.default_rng(1))
    plan = plan_repair(scan, site, title="", guess=placed.inverse() @ pose, strict=False)
    assert not typed(plan, job, site, stop.line, pose).deficit.regions
