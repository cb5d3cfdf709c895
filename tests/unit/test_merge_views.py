"""Partial views without a mesh: free space, where a sensor stood, views placed or left out."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import reduce
from pathlib import Path

import numpy as np
import pytest
from manifold3d import Manifold
from typer.testing import CliRunner

from amrepair.bench.synth_views import Rays, Shape, sample_shape
from amrepair.cli.app import app
from amrepair.errors import AlignmentError, InputError
from amrepair.frames import rotation_from_vector
from amrepair.merge.groups import Graph
from amrepair.merge.options import MergeOptions
from amrepair.merge.place import Placement, place
from amrepair.merge.sight import Veil, guess_directions, guessed, told
from amrepair.merge.views import Fit, View, judged
from amrepair.scans import Scan, write_ply
from tests.analytic import box, cylinder, difference, to_trimesh, union

SIGMA_MM = 0.03
FAR_MM = 200.0


@pytest.fixture(scope="module")
def bracket() -> Shape:
    """A plate with a tower and a through hole: no symmetry, every kind of edge."""
    body = union(box((0, 0, 0), (40, 25, 8)), cylinder((30, 15, 4), 6, 14))
    return shape_of(difference(body, cylinder((10, 9, -1), 4, 12)).body)


def shape_of(body: Manifold) -> Shape:
    mesh = to_trimesh(body)
    return Shape(np.array(mesh.vertices), np.array(mesh.faces), np.zeros((len(mesh.faces), 3)))


def view_of(
    shape: Shape,
    towards: tuple[float, float, float],
    seed: int,
    *,
    moves: bool,
    tells: bool = True,
    count: int = 60_000,
) -> tuple[Scan, np.ndarray]:
    """What one sensor sees, in a pose of its own; and (4, 4) scan from part."""
    rng = np.random.default_rng(seed)
    middle = 0.5 * (shape.vertices_mm.min(axis=0) + shape.vertices_mm.max(axis=0))
    sensor = middle + FAR_MM * np.array(towards) / np.linalg.norm(towards)
    cloud = sample_shape(shape, count, rng)
    cloud = cloud.take(Rays(shape).seen(cloud, sensor[None]))
    points = cloud.points_mm + rng.normal(0.0, SIGMA_MM, cloud.points_mm.shape)
    pose = np.eye(4)
    if moves:
        axis = rng.normal(size=3)
        pose[:3, :3] = rotation_from_vector(2.0 * axis / np.linalg.norm(axis))
        pose[:3, 3] = rng.normal(0.0, 60.0, 3)
    sensors = (sensor @ pose[:3, :3].T + pose[:3, 3])[None] if tells else None
    scan = Scan(
        points @ pose[:3, :3].T + pose[:3, 3],
        SIGMA_MM,
        "scanner",
        sensors_mm=sensors,
        sensor_index=np.zeros(len(points), np.int64) if tells else None,
        source=f"view{seed}",
    )
    return scan, pose


def placed(scans: list[Scan]) -> Placement:
    rng = np.random.default_rng(0)
    return place([View.of(scan, rng) for scan in scans], rng)


def farthest_off_mm(found: Placement, poses: list[np.ndarray], shape: Shape) -> float:
    """How far the part's corners lie apart, as the placed scans have them."""
    corners = [
        shape.vertices_mm @ (m @ poses[k])[:3, :3].T + (m @ poses[k])[:3, 3]
        for k, m in found.poses.items()
    ]
    return max(float(np.abs(one - corners[0]).max()) for one in corners)


def test_what_a_sensor_saw_through_is_free() -> None:
    """A ball of 10 mm: before it and beside it free, on it and behind it not."""
    shape = shape_of(Manifold.sphere(10.0, 128))
    scan, _ = view_of(shape, (0.0, 0.0, 1.0), 0, moves=False)
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    looks = told(scan.points_mm, scan.sensors_mm, scan.sensor_index)
    rng = np.random.default_rng(1)
    places = rng.uniform(-16.0, 16.0, (20_000, 3))
    # the ray from the sensor, against the ball: the truth
    way = places - scan.sensors_mm[0]
    length = np.linalg.norm(way, axis=1)
    along = -(scan.sensors_mm[0] * way).sum(axis=1) / length
    passes = np.linalg.norm(scan.sensors_mm[0] + (along / length)[:, None] * way, axis=1)
    enters = along - np.sqrt(np.maximum(100.0 - passes**2, 0.0))
    free = (passes > 10.0) | (length < enters)
    found = looks.free(places, 1.0)
    # the sensor sees no more than 80° of incidence: the rim, 1 - sin 80° of the radius
    assert not (found & ~free & (passes < 9.8)).any()
    # a pixel's and the tolerance's width away; towards the rim the ball falls off too steeply
    clear = (passes > 12.5) | ((passes < 7.0) & (length < enters - 3.0))
    assert found[free & clear].all()


def test_surface_edge_on_to_a_ray_contradicts_nothing() -> None:
    shape = shape_of(Manifold.cube((20.0, 20.0, 4.0)))
    scan, _ = view_of(shape, (0.0, 0.0, 1.0), 0, moves=False)
    assert scan.sensors_mm is not None
    assert scan.sensor_index is not None
    looks = told(scan.points_mm, scan.sensors_mm, scan.sensor_index)
    above = np.array([[10.0, 10.0, 8.0]])
    assert looks.free(above, 0.5, np.array([[0.0, 0.0, 1.0]])).all()
    assert not looks.free(above, 0.5, np.array([[1.0, 0.0, 0.0]])).any()


def test_what_a_face_edge_on_hides_was_not_seen_through() -> None:
    """A ray that met such a face came back from nowhere, as one that met nothing does."""
    grid = np.stack(np.meshgrid(*2 * [np.linspace(-10, 10, 81)]), axis=-1).reshape(-1, 2)
    floor = np.column_stack([grid, np.zeros(len(grid))])
    looks = told(floor, np.array([[0.0, 0.0, 200.0]]), np.zeros(len(floor), np.int64))
    # a wall that leans as the rays do: from 0.125 to 0.12 of the depth, 1.4° off them
    y, t = np.meshgrid(np.linspace(-5, 5, 41), np.linspace(0, 1, 161))
    wall = np.column_stack([20 + 4 * t.ravel(), y.ravel(), 40 * (1 - t.ravel())])
    outward = np.tile(np.array([1.0, 0.0, 0.1]) / np.hypot(1.0, 0.1), (len(wall), 1))
    behind, beside, before = (26.8, 0.0, -20.0), (44.0, 0.0, -20.0), (18.3, 0.0, 50.0)
    places, level = np.array([behind, beside, before]), np.tile([0.0, 0.0, 1.0], (3, 1))
    turn = rotation_from_vector(np.array([0.3, -0.2, 0.5]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, (5.0, -3.0, 8.0)
    veil = Veil(wall @ turn.T + pose[:3, 3], outward @ turn.T, pose)
    assert looks.free(places, 0.5, level).all()
    assert looks.free(places, 0.5, level, veil).tolist() == [False, True, True]
    facing = Veil(veil.points_mm, np.tile(turn[:, 2], (len(wall), 1)), pose)
    # a face that such a ray would have seen hides nothing: it is itself contradicted
    assert looks.free(places, 0.5, level, facing).all()


def views_at(shape: Shape, *ways: tuple[float, float, float], count: int = 60_000) -> list[View]:
    """Views of told sensors, all in the part's frame."""
    rng = np.random.default_rng(0)
    return [
        View.of(view_of(shape, way, k, moves=False, count=count)[0], rng)
        for k, way in enumerate(ways)
    ]


def judged_pair(views: list[View], i: int, j: int, pose: np.ndarray) -> Fit:
    return judged(views, {i: np.eye(4)}, {j: np.eye(4)}, pose, MergeOptions())


def test_true_poses_contradict_nothing_behind_a_wall_seen_edge_on() -> None:
    """A wall on a plate, from above and outside at 7°, and from within: floor behind it is hid."""
    shape = shape_of(union(box((0, 0, 0), (30, 20, 3)), box((0, 0, 0), (30, 1, 43))).body)
    views = views_at(shape, (0.05, -0.12, 1.0), (0.1, 0.6, 1.2))
    here = judged_pair(views, 0, 1, np.eye(4))
    # 0.033 where the wall itself, that no ray came back from, hid nothing
    assert here.against <= here.beside < 0.01
    # a plate that hangs in mid-air hides no more than itself
    lifted = np.eye(4)
    lifted[2, 3] = 10.0
    assert judged_pair(views, 0, 1, lifted).beside > 0.2


def test_the_next_step_of_a_stair_is_no_contradiction() -> None:
    """Steps lower than what pairs reach: the nearest seen surface may be the next one's."""
    steps = [box((0, 0, 0), (20, 1.5 * (n + 1), 0.4 * (12 - n))) for n in range(12)]
    shape = shape_of(reduce(union, steps).body)
    views = views_at(shape, (0.1, 0.3, 0.9), (0.2, -1.0, 0.4))
    # 0.11 of surface was beside a step's edge, whatever lay below; a spacing's width of it is left
    assert judged_pair(views, 0, 1, np.eye(4)).beside < 0.05


def graph_of(views: list[View], poses: dict[tuple[int, int], list[np.ndarray]]) -> Graph:
    """With what pairs propose, all views apart."""
    size_mm = max(view.size_mm for view in views)
    graph = Graph(views, size_mm, MergeOptions())
    graph.groups = [{k: np.eye(4)} for k in range(len(views))]
    for (i, j), ways in poses.items():
        graph.pairs[i, j] = [judged_pair(views, i, j, pose) for pose in ways]
    graph.grow(lambda *_: None)
    return graph


@pytest.mark.slow
def test_a_wrong_pair_is_outvoted_by_the_cycle(bracket: Shape) -> None:
    """Three views about a corner; between two of them the only proposal is a wrong pose."""
    views = views_at(bracket, (1.0, 0.2, 0.7), (0.4, 1.0, 0.7), (0.9, 0.7, 0.5), count=30_000)
    wrong = np.eye(4)
    wrong[:3, :3] = rotation_from_vector(np.array([0.0, 0.0, 1.2]))
    graph = graph_of(views, {(0, 1): [wrong], (0, 2): [np.eye(4)], (1, 2): [np.eye(4)]})
    assert [set(group) for group in graph.groups] == [{0, 1, 2}]
    poses = graph.groups[0]
    assert np.abs(np.linalg.inv(poses[0]) @ poses[1] - np.eye(4)).max() < 0.2


@pytest.mark.slow
def test_groups_that_share_too_little_stay_apart_and_both_are_told() -> None:
    """Two views from below fit each other best of all, and share hardly an edge with the rest."""
    body = union(box((0, 0, 0), (40, 25, 3)), cylinder((30, 15, 2), 6, 14))
    shape = shape_of(difference(body, cylinder((10, 9, -1), 4, 12)).body)
    above = [(0.4, 0.1, 1.0), (-0.2, 0.4, 1.0), (-0.1, -0.4, 1.0)]
    views = views_at(shape, *above, (0.02, 0.05, -1.0), (0.0, 0.05, -1.0), count=30_000)
    pairs = {(i, j): [np.eye(4)] for i, j in itertools.combinations(range(5), 2)}
    graph = graph_of(views, pairs)
    assert sorted(map(sorted, graph.groups)) == [[0, 1, 2], [3, 4]]
    said = graph.why_not(graph.ways(graph.groups[0], graph.groups[1]))
    assert "lies on the others with" in said


@pytest.mark.parametrize(
    "towards",
    [
        (1.0, 0.4, 0.8),
        pytest.param((-0.6, 1.0, 0.5), marks=pytest.mark.slow),
        pytest.param((0.3, -1.0, -0.7), marks=pytest.mark.slow),
    ],
)
def test_where_a_sensor_stood_is_among_the_guesses(
    bracket: Shape, towards: tuple[float, float, float]
) -> None:
    scan, _ = view_of(bracket, towards, 3, moves=False, count=24_000)
    guess = guess_directions(scan.points_mm[:8_000])
    truth = np.array(towards) / np.linalg.norm(towards)
    # the guesses are the outermost of those that pass: the truth lies among them, not at them
    assert (guess @ truth).max() > np.cos(np.radians(25.0))
    assert guess.mean(axis=0) @ truth > 0.7
    looks = guessed(scan.points_mm, guess)
    # where nobody told the place, what the part hides is never free
    inside = np.random.default_rng(0).uniform((16, 3, 1), (38, 22, 7), (200, 3))
    assert not looks.free(inside, 0.5).any()


@pytest.mark.slow
def test_a_whole_scan_is_no_view(bracket: Shape) -> None:
    points = sample_shape(bracket, 8_000, np.random.default_rng(0)).points_mm
    assert len(guess_directions(points)) == 0


def test_normals_turn_to_the_sensor_that_saw_them(bracket: Shape) -> None:
    rng = np.random.default_rng(0)
    cloud = sample_shape(bracket, 40_000, rng)
    sensors = np.array([[20.0, 12.0, 200.0], [20.0, 12.0, -200.0]])
    seen = [cloud.take(Rays(bracket).seen(cloud, sensor[None])) for sensor in sensors]
    points = np.concatenate([s.points_mm for s in seen])
    truth = np.concatenate([s.normals for s in seen])
    index = np.repeat([0, 1], [len(s.points_mm) for s in seen])
    view = View.of(Scan(points, SIGMA_MM, "scanner", sensors_mm=sensors, sensor_index=index), rng)
    order = np.unique(points, axis=0, return_index=True)[1]
    right = (view.surface.normals * truth[order]).sum(axis=1) > 0.0
    assert right[view.sure].mean() > 0.99


@pytest.mark.slow
def test_views_that_share_little_find_each_other(bracket: Shape) -> None:
    """A ring and one from below: neighbours share a third, the last the sides alone."""
    ways = [(1.0, 0.2, 0.7), (-0.4, 1.0, 0.7), (-0.5, -1.0, 0.7), (0.8, 0.5, -0.6)]
    made = [view_of(bracket, way, k, moves=True) for k, way in enumerate(ways)]
    found = placed([scan for scan, _ in made])
    assert set(found.poses) == {0, 1, 2, 3}
    poses = [pose for _, pose in made]
    # edges and curves alone hold the last along the plate's normal: no level face is seen by both
    assert found.slacks[3].sigma_mm > max(found.slacks[k].sigma_mm for k in range(3))
    normal = found.poses[0][:3, :3] @ poses[0][:3, 2]
    assert abs(found.slacks[3].axis @ normal) > 0.95
    assert farthest_off_mm(found, poses, bracket) < 3.0 * found.slacks[3].sigma_mm
    above = replace(found, poses={k: found.poses[k] for k in range(3)})
    assert farthest_off_mm(above, poses, bracket) < 0.05


@pytest.mark.slow
def test_views_of_untold_sensors_that_may_hide_are_refused_with_what_helps(bracket: Shape) -> None:
    """Without the sensors' places a view may hide under the plate, and nothing speaks against it.

    So the views are refused with what helps, and it helps.
    """
    ways = [(1.0, 0.2, 0.7), (0.4, 1.0, 0.7), (-0.8, 0.8, 0.7), (-0.8, -0.7, 0.7), (0.3, -1, 0.7)]
    made = [view_of(bracket, way, k, moves=True, tells=False) for k, way in enumerate(ways)]
    poses = [pose for _, pose in made]
    with pytest.raises(AlignmentError, match=r"more than one way.*--sensor-at"):
        placed([scan for scan, _ in made])
    told = [view_of(bracket, way, k, moves=True)[0] for k, way in enumerate(ways)]
    found = placed(told)
    assert set(found.poses) == set(range(5))
    assert farthest_off_mm(found, poses, bracket) < 0.15


@pytest.mark.slow
def test_views_that_fit_in_more_than_one_way_are_refused_with_advice() -> None:
    """A ring of equal sides: every view fits on every other as well as beside it."""
    shape = shape_of(Manifold.cylinder(12.0, 10.0, 10.0, 6))
    made = [
        view_of(shape, (np.cos(a), np.sin(a), 0.8), k, moves=True) for k, a in enumerate((0.0, 2.0))
    ]
    with pytest.raises(AlignmentError, match=r"more than one way.*--sensor-at.*one frame.*mesh"):
        placed([scan for scan, _ in made])


@pytest.mark.slow
def test_views_in_one_frame_stay_as_they_came() -> None:
    """The same ring, exported in one frame: nothing to find, and no pose mistaken."""
    shape = shape_of(Manifold.cylinder(12.0, 10.0, 10.0, 6))
    angles = (0.0, 1.6, 3.1, 4.7)
    made = [
        view_of(shape, (np.cos(a), np.sin(a), 0.8), k, moves=False) for k, a in enumerate(angles)
    ]
    found = placed([scan for scan, _ in made])
    assert set(found.poses) == {0, 1, 2, 3}
    assert farthest_off_mm(found, [pose for _, pose in made], shape) < 0.1


@pytest.mark.slow
def test_a_round_part_that_turned_before_a_fixed_sensor_is_not_taken_as_it_came() -> None:
    """All views lie on each other and contradict nothing; the sensor never moved."""
    shape = shape_of(Manifold.cylinder(12.0, 10.0, 10.0, 6))
    one, _ = view_of(shape, (1.0, 0.0, 0.8), 0, moves=False)
    two, _ = view_of(shape, (1.0, 0.0, 0.8), 1, moves=False)
    with pytest.raises(AlignmentError, match="more than one way"):
        placed([one, two])


def test_sensor_at_is_given_once_or_for_each(tmp_path: Path, bracket: Shape) -> None:
    paths = []
    for k in range(3):
        scan, _ = view_of(bracket, (1.0, 0.2, 0.7), k, moves=False)
        paths.append(str(tmp_path / f"v{k}.ply"))
        write_ply(scan, Path(paths[-1]))
    call = ["template", "fit", *paths, "-o", str(tmp_path / "t.safetensors")]
    answer = CliRunner().invoke(app, [*call, "--sensor-at", "0,0,1", "--sensor-at", "0,0,2"])
    assert isinstance(answer.exception, InputError)
    assert "2 times for 3 scans" in str(answer.exception)


def test_a_join_that_was_wrong_is_undone(bracket: Shape) -> None:
    """Regression: two halves of a smooth part, one of them wrong in itself, never became one."""
    ways = [(1.0, 0.3, 1.2), (-0.4, 1.0, 1.1), (-1.0, -0.5, 1.0), (0.5, -1.0, 1.2)]
    rng = np.random.default_rng(0)
    scans = [view_of(bracket, way, k, moves=False, count=16_000)[0] for k, way in enumerate(ways)]
    views = [View.of(scan, rng) for scan in scans]
    options = MergeOptions()
    graph = Graph(views, max(view.size_mm for view in views), options)
    true = np.eye(4)
    for i, j in itertools.combinations(range(4), 2):
        graph.add((i, j), [judged(views, {i: true}, {j: true}, true, options)])
        graph.searched.add((i, j))
    turned = np.eye(4)
    turned[:3, :3] = rotation_from_vector(np.array([0.0, 0.0, 0.6]))
    wrong = judged(views, {2: true}, {3: true}, turned, options)
    graph.groups = [{0: true, 1: true}, {2: true}, {3: true}]
    graph.join(1, 2, wrong)
    graph.grow(lambda *_: None)
    assert [sorted(group) for group in graph.groups] == [[0, 1, 2, 3]]
    for pose in graph.groups[0].values():
        there = np.linalg.inv(graph.groups[0][0]) @ pose
        assert np.abs(there - true).max() < 0.3  # mm; and a turn of 0.6 rad is more, too
