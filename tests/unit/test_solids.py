"""Mesh files as they come: what other slicers take is taken, and nothing of it is lost."""

from __future__ import annotations

import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from gcode.errors import InputError
from gcode.solids import read_closed, read_solid, read_triangles, weld


def test_bodies_that_touch_along_an_edge_stay_apart(tmp_path: Path) -> None:
    """Welding them makes an edge of four faces, which bounds nothing."""
    one, other = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((2.0, 2.0, 2.0))
    other.apply_translation((2.0, 2.0, 0.0))
    path = tmp_path / "touching.3mf"
    trimesh.util.concatenate([one, other]).export(path)
    assert read_solid(path).volume() == pytest.approx(16.0)


def test_a_sliver_without_area_holds_a_surface_together(tmp_path: Path) -> None:
    """Dropped as degenerate, it left a crack."""
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    faces = np.asarray(box.faces).tolist()
    a, b, c = faces.pop(0)
    middle = len(box.vertices)
    vertices = np.vstack([box.vertices, (box.vertices[a] + box.vertices[b]) / 2])
    faces += [[a, middle, c], [middle, b, c], [a, b, middle]]
    path = tmp_path / "sliver.stl"
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    assert read_solid(path).volume() == pytest.approx(64.0)


def test_bodies_that_overlap_count_once(tmp_path: Path) -> None:
    one, other = trimesh.creation.box((2.0, 2.0, 2.0)), trimesh.creation.box((2.0, 2.0, 2.0))
    other.apply_translation((1.0, 0.0, 0.0))
    path = tmp_path / "overlapping.stl"
    trimesh.util.concatenate([one, other]).export(path)
    assert read_solid(path).volume() == pytest.approx(12.0)


def test_a_hole_is_refused(tmp_path: Path) -> None:
    box = trimesh.creation.box((4.0, 4.0, 4.0))
    path = tmp_path / "open.stl"
    trimesh.Trimesh(box.vertices, box.faces[:-1], process=False).export(path)
    with pytest.raises(InputError, match="no closed surface"):
        read_solid(path)


@given(
    places=st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=3, max_size=30),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=50, deadline=None)
def test_welding_joins_what_trimesh_joins(places: list[tuple[int, int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = np.array(places, dtype=np.float64) / 3.0
    vertices = np.repeat(grid, 2, axis=0) + rng.choice([0.0, 1e-12, -0.0], (2 * len(grid), 3))
    faces = rng.integers(0, len(vertices), (len(grid), 3))
    ours, ours_faces = weld(vertices, faces, 8)
    peer = trimesh.Trimesh(vertices, faces, process=False)
    peer.merge_vertices(merge_tex=True, merge_norm=True)
    np.testing.assert_allclose(ours[ours_faces], vertices[faces], atol=1e-11)
    assert len(ours) == len(np.unique(np.asarray(peer.faces)))
    assert (
        ours_faces == _by_first_use(np.asarray(peer.faces), np.asarray(peer.vertices), ours)
    ).all()


def _by_first_use(faces: np.ndarray, vertices: np.ndarray, ours: np.ndarray) -> np.ndarray:
    """The peer's faces, with our numbers of the same places."""
    number = {tuple(np.round(v, 8) + 0.0): k for k, v in enumerate(ours)}
    return np.array([[number[tuple(np.round(vertices[v], 8) + 0.0)] for v in f] for f in faces])


def test_places_of_one_slot_stay_two() -> None:
    """So many that a table of any size has several in each slot."""
    rng = np.random.default_rng(0)
    vertices = rng.integers(-40, 40, (50_000, 3)).astype(np.float64)
    faces = np.arange(len(vertices) // 3 * 3).reshape(-1, 3)
    joined, new = weld(vertices, faces, 8)
    np.testing.assert_array_equal(joined[new], vertices[faces])
    assert len(joined) == len(np.unique(vertices[faces.ravel()], axis=0))


def test_a_binary_stl_file_is_read_as_trimesh_reads_it(tmp_path: Path) -> None:
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2, 3.0).export(path)
    vertices, faces = read_triangles(path)
    peer = trimesh.load_mesh(path, process=False)
    np.testing.assert_array_equal(vertices[faces], peer.triangles)


def test_an_stl_file_of_text_is_read(tmp_path: Path) -> None:
    path = tmp_path / "box.stl"
    trimesh.creation.box((2.0, 3.0, 4.0)).export(path, file_type="stl_ascii")
    assert read_solid(path).volume() == pytest.approx(24.0)


def built(path: Path, item: str, unit: str = "", more: str = "") -> Path:
    """A 3MF file of one cube of 10, used once, and more objects."""
    cube = trimesh.creation.box((10.0, 10.0, 10.0))
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in cube.vertices)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in cube.faces)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    model = (
        f'<model {unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02">'
        f'<resources><object id="1">{mesh}</object>{more}</resources><build>{item}</build></model>'
    )
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("3D/3dmodel.model", model)
    return path


USED = '<item objectid="1"/>'
MOVED = '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 2 0 0"/>'
MIRRORED = '<item objectid="1" transform="-1 0 0 0 1 0 0 0 1 2 0 0"/>'


@pytest.mark.parametrize(
    ("item", "unit", "box_mm"),
    [
        (USED, "", (-5.0, 5.0)),
        (MOVED, 'unit="inch"', (-76.2, 177.8)),
        (USED, 'unit="centimeter"', (-50.0, 50.0)),
        (MIRRORED, "", (-3.0, 7.0)),  # regression: was inside out
    ],
)
def test_3mf_units_and_mirrored_uses(
    tmp_path: Path, item: str, unit: str, box_mm: tuple[float, float]
) -> None:
    """regression: lengths in inches and metres were millimetres."""
    solid = read_solid(built(tmp_path / "cube.3mf", item, unit))
    assert solid.volume() > 0
    assert solid.bounding_box()[::3] == pytest.approx(box_mm)


NESTED = (
    '<object id="2"><components>'
    '<component objectid="1" transform="0 1 0 -1 0 0 0 0 1 20 0 0"/></components></object>'
)


@pytest.mark.parametrize(
    ("item", "middle_mm"),
    [
        # a quarter turn takes the component's shift along x to y
        ('<item objectid="2" transform="0 1 0 -1 0 0 0 0 1 0 0 7"/>', (0.0, 20.0, 7.0)),
        ("", (20.0, 0.0, 0.0)),  # nothing says what is built: what nothing else uses
    ],
    ids=["turned", "not built"],
)
def test_3mf_components_are_laid_in_their_object_and_that_in_the_build(
    tmp_path: Path, item: str, middle_mm: tuple[float, float, float]
) -> None:
    solid = read_solid(built(tmp_path / "cube.3mf", item, more=NESTED))
    assert solid.volume() == pytest.approx(1000.0)
    box = np.array(solid.bounding_box()).reshape(2, 3)
    assert box.mean(axis=0) == pytest.approx(middle_mm, abs=1e-9)


def test_3mf_of_an_unknown_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unit is 'ell'; 3MF knows micron"):
        read_solid(built(tmp_path / "cube.3mf", USED, 'unit="ell"'))


def test_a_3mf_file_may_have_a_directory_of_zip64(tmp_path: Path) -> None:
    """regression: Microsoft's programs write one into small files too; they were refused."""
    plain = built(tmp_path / "plain.3mf", USED).read_bytes()
    at = plain.rfind(b"PK\x05\x06")
    count, size, start = (
        int.from_bytes(plain[at + a : at + b], "little") for a, b in ((10, 12), (12, 16), (16, 20))
    )
    record = struct.pack("<4sQHHLLQQQQ", b"PK\x06\x06", 44, 45, 45, 0, 0, count, count, size, start)
    locator = struct.pack("<4sLQL", b"PK\x06\x07", 0, at, 1)
    end = plain[at : at + 8] + b"\xff" * 12 + plain[at + 20 :]
    path = tmp_path / "zip64.3mf"
    path.write_bytes(plain[:at] + record + locator + end)
    assert read_solid(path).volume() == pytest.approx(1000.0)
    path.write_bytes(plain[:at] + end)  # nothing tells how large the directory is
    with pytest.raises(InputError, match="its directory takes 4294967295 bytes"):
        read_solid(path)


def test_a_mesh_that_is_inside_out_is_turned(tmp_path: Path) -> None:
    box = trimesh.creation.box((10.0, 10.0, 10.0))
    box.invert()
    box.export(tmp_path / "box.stl")
    assert read_solid(tmp_path / "box.stl").volume() == pytest.approx(1000.0)
    assert read_closed(tmp_path / "box.stl").volume() == pytest.approx(1000.0)
