"""The library: the right part of several, with a confidence; what is not clear is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from amrepair.align import Registration
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import Transform, rotation_from_vector
from amrepair.library import misfit, recognise, template_files
from amrepair.scans import Scan
from amrepair.template import MeshSdf
from amrepair.template.port import Template


def lug(length_mm: float, hole_mm: float) -> MeshSdf:
    """A stepped block without symmetry, with a hole."""
    body = trimesh.creation.box(bounds=((0, 0, 0), (length_mm, 24, 6)))
    foot = trimesh.creation.box(bounds=((0, 0, 0), (9, 24, 15)))
    rib = trimesh.creation.box(bounds=((0, 3, 0), (length_mm - 6, 7, 11)))
    hole = trimesh.creation.cylinder(radius=hole_mm, height=40, sections=48)
    hole.apply_translation((length_mm - 10, 15, 0))
    whole = trimesh.boolean.union([body, foot, rib], engine="manifold")
    return MeshSdf.from_mesh(trimesh.boolean.difference([whole, hole], engine="manifold"))


@pytest.fixture(scope="module")
def parts() -> dict[str, MeshSdf]:
    return {"short": lug(40.0, 3.0), "long": lug(46.0, 3.0), "wide": lug(40.0, 6.0)}


def opened(parts: dict[str, MeshSdf]) -> list[tuple[str, Callable[[], Template]]]:
    return [(name, lambda part=part: part) for name, part in parts.items()]  # type: ignore[misc]


def scan_of(part: MeshSdf, seed: int) -> Scan:
    points = np.asarray(trimesh.sample.sample_surface(part.mesh, 4_000, seed=seed)[0])
    points = points + np.random.default_rng(seed).normal(0, 0.03, points.shape)
    turn = rotation_from_vector(np.array([0.4, -1.0, 1.7]))
    return Scan(points @ turn.T + 30.0, 0.03, "scanner", source="scan.ply")


def test_the_right_part_is_found_with_confidence(parts: dict[str, MeshSdf]) -> None:
    known = {name: parts[name] for name in ("short", "long")}
    found = recognise(scan_of(parts["long"], 1), opened(known))
    assert found.name == "long"
    assert found.template is parts["long"]
    assert found.confidence > 0.5
    assert found.candidates[0].name == "long"
    assert {c.name for c in found.candidates} == set(known)
    assert found.registration.rmse_mm < 0.05


@pytest.mark.slow
def test_a_lost_piece_does_not_make_it_another_part(parts: dict[str, MeshSdf]) -> None:
    whole = scan_of(parts["wide"], 2)
    points = whole.points_mm[np.linalg.norm(whole.points_mm - whole.points_mm[7], axis=1) > 5.0]
    told: list[float] = []
    found = recognise(
        Scan(points, 0.03, "scanner"),
        opened(parts),
        progress=lambda _, done, total: told.append(done / total),
    )
    assert told == sorted(told)
    assert len(told) > 2 * len(parts)  # also while one part is asked, which may take seconds
    assert found.name == "wide"


def test_the_same_part_twice_is_ambiguous(parts: dict[str, MeshSdf]) -> None:
    twice = {"one": parts["short"], "two": parts["short"]}
    with pytest.raises(AlignmentError, match=r"fits (one and two|two and one) alike"):
        recognise(scan_of(parts["short"], 3), opened(twice))


def test_a_part_that_is_not_there_is_refused(parts: dict[str, MeshSdf]) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=25.0)
    alone = {"short": parts["short"]}
    with pytest.raises(AlignmentError, match="fits none of the 1 parts"):
        recognise(Scan(np.asarray(ball.vertices), 0.03, "scanner"), opened(alone))
    with pytest.raises(InputError, match="holds no part"):
        recognise(scan_of(parts["short"], 1), [])


def test_what_fits_the_nearest_part_badly_is_refused(parts: dict[str, MeshSdf]) -> None:
    # the short part with a tower on it: aligned well, and yet another part
    tower = trimesh.creation.box(bounds=((14, 9, 3), (26, 22, 20)))
    other = trimesh.boolean.union([parts["short"].mesh, tower], engine="manifold")
    with pytest.raises(AlignmentError, match="none of the 1 parts of the library well: nearest is"):
        recognise(scan_of(MeshSdf.from_mesh(other), 5), opened({"short": parts["short"]}))


def test_misfit_is_nothing_on_the_part_and_grows_off_it(parts: dict[str, MeshSdf]) -> None:
    part = parts["short"]
    points = np.asarray(trimesh.sample.sample_surface(part.mesh, 20_000, seed=5)[0])
    stay = Registration(
        Transform.identity("template", "scanner"), 0.0, 1.0, np.eye(6), (), "robust", 1
    )
    on = misfit(Scan(points, 0.03, "scanner"), part, stay)
    off = misfit(Scan(points + np.array([0, 0, 0.5]), 0.03, "scanner"), part, stay)
    half = misfit(Scan(points[points[:, 2] > 3], 0.03, "scanner"), part, stay)
    assert on < 0.1  # the gaps between 20,000 points
    assert half < 0.25
    assert off > on + 0.1


def test_a_folder_of_templates(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no template"):
        template_files(tmp_path)
    for name in ("b.stl", "a.safetensors", "a.stl", "notes.txt", ".hidden.stl"):
        (tmp_path / name).write_bytes(b"")
    assert [path.name for path in template_files(tmp_path)] == ["a.safetensors", "b.stl"]
