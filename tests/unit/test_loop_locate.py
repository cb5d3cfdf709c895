"""Where a job prints a part: upright where it may be, however it lies, and as often as it does."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import manifold3d as m3
import numpy as np
import pytest
import trimesh
from jaxtyping import Float
from loop_bench import solid_mesh

from amrepair.deficit import compute_deficit
from amrepair.errors import AlignmentError
from amrepair.frames import Transform, rotation_from_vector
from amrepair.loop.locate import (
    first_layer,
    foot_mm,
    is_upright,
    locate_part,
    locate_parts,
    locate_plate,
    stood,
    stood_plate,
    tops_of,
    walls_moved_mm,
)
from amrepair.loop.looks import plan_stops
from amrepair.loop.outlines import outermost
from amrepair.loop.sites import sites
from amrepair.regions import Label, Region, detect
from amrepair.repair import plan_repair
from amrepair.scans import Scan
from amrepair.template import CutTemplate, MeshSdf, StoodTemplate
from gcode.profiles import load_setup
from gcode.reader import Beads, Job, job_for
from gcode.slicing.job import plan_part
from gcode.writer import write
from tests import analytic
from tests.draws import draws

SETUP = load_setup(process="repair_0.20")
LAYER_MM = 0.2


def wedge() -> m3.Manifold:
    """A block with a step and a corner off: nothing about it is symmetric."""
    block = m3.Manifold.cube((18.0, 12.0, 6.0))
    step = m3.Manifold.cube((7.0, 20.0, 10.0)).translate((11.0, -1.0, 4.0))
    corner = m3.Manifold.cube((9.0, 9.0, 20.0), True).rotate((0, 0, 45)).translate((0.0, 12.0, 0.0))
    return block - step - corner


def job_of(part: m3.Manifold) -> Job:
    return job_for(write(plan_part(part, SETUP).toolpath, SETUP, title="job").text, SETUP.printer)


def pose(turn_deg: tuple[float, float, float], x: float, y: float) -> Float[np.ndarray, "3 4"]:
    """Turned about X, then Y, then Z, and laid onto the bed at a place."""
    solid = wedge().rotate(turn_deg)
    low = solid.bounding_box()[:3]
    about = [rotation_from_vector(np.deg2rad(a) * np.eye(3)[k]) for k, a in enumerate(turn_deg)]
    turn = about[2] @ about[1] @ about[0]
    return np.column_stack([turn, np.array([x, y, 0.0]) - low])


def off_mm(placed: Transform, truth: Float[np.ndarray, "3 4"]) -> float:
    """How far the part's corners lie from where they are."""
    corners = np.asarray(solid_mesh(wedge()).vertices)
    away = placed.apply(corners) - (corners @ truth[:, :3].T + truth[:, 3])
    return float(np.linalg.norm(away, axis=1).max())


@pytest.mark.parametrize("seed", range(2))
def test_a_part_that_fits_in_several_ways_is_taken_for_upright(seed: int) -> None:
    """A block lies as well on its top: it was found so, and cut by layers from the wrong end."""
    size = np.random.default_rng(seed).uniform(1.5, 16.0, 3)
    block = m3.Manifold.cube(tuple(size))
    template = MeshSdf.from_mesh(solid_mesh(block))
    placed = locate_part(job_of(block.translate((100.0, 90.0, 0.0))), template,
                         layer_height_mm=LAYER_MM)  # fmt: skip
    assert placed.rotation[0, 0] > 0.9999
    assert placed.rotation[2, 2] == 1.0
    assert placed.translation_mm == pytest.approx([100.0, 90.0, 0.0], abs=0.05)


@pytest.mark.parametrize(
    "turn_deg",
    [
        (180.0, 0.0, 0.0),
        pytest.param((90.0, 0.0, 30.0), marks=pytest.mark.slow),
        pytest.param((0.0, 90.0, 0.0), marks=pytest.mark.slow),
    ],
)
def test_a_part_sliced_lying_in_another_way_is_expected_as_it_lies(
    turn_deg: tuple[float, float, float],
) -> None:
    truth = pose(turn_deg, 90.0, 70.0)
    part = wedge().transform(truth)
    template = MeshSdf.from_mesh(solid_mesh(wedge()))
    placed = locate_parts(job_of(part), template, layer_height_mm=LAYER_MM)
    assert len(placed) == 1
    assert off_mm(placed[0], truth) < 0.15
    assert not is_upright(placed[0])
    expected, build_from_template = stood(template, placed)
    assert (build_from_template.matrix == np.eye(4)).all()
    # what is printed so far, from the bed up, whichever way its file has it
    so_far = part.trim_by_plane((0.0, 0.0, -1.0), -3.0)
    points = trimesh.sample.sample_surface(solid_mesh(so_far), 400, seed=1)[0]
    assert np.abs(CutTemplate(expected, 3.0).distance(np.asarray(points))).max() < 0.15


def test_a_part_stands_on_its_lowest_point_however_small_that_is() -> None:
    # regression: the foot was looked for among points of the surface 1 mm apart; of a bumpy one it
    # was found 0.15 mm too high, so that a clean job was repaired, and given up as clogged
    cone = m3.Manifold.cylinder(0.15, 0.02, 0.3, 12)
    part = m3.Manifold.cube((9.0, 6.0, 2.0)).translate((0.0, 0.0, 0.15)) + cone.translate((4, 2, 0))
    template = MeshSdf.from_mesh(solid_mesh(part))
    placed = locate_part(job_of(part.translate((90.0, 70.0, 0.0))), template,
                         layer_height_mm=LAYER_MM)  # fmt: skip
    assert placed.translation_mm[2] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.slow
def test_every_copy_is_found_in_the_order_in_which_they_are_begun() -> None:
    truths = [pose((0.0, 0.0, turn), x, y) for turn, x, y in
              ((0.0, 60.0, 60.0), (0.0, 81.0, 60.0), (90.0, 60.0, 80.0))]  # fmt: skip
    plate = m3.Manifold.batch_boolean([wedge().transform(t) for t in truths], m3.OpType.Add)
    template = MeshSdf.from_mesh(solid_mesh(wedge()))
    placed = locate_parts(job_of(plate), template, layer_height_mm=LAYER_MM)
    assert len(placed) == 3
    for truth in truths:
        assert min(off_mm(one, truth) for one in placed) < 0.1
    with pytest.raises(AlignmentError, match="prints 3 copies"):
        locate_part(job_of(plate), template, layer_height_mm=LAYER_MM)


@pytest.mark.slow
def test_a_job_without_roles_is_placed_by_what_bounds_its_layers() -> None:
    """regression: Slic3r's jobs name no roles; infill was taken for walls, a skirt for a part."""
    part = wedge().transform(pose((0.0, 0.0, 0.0), 60.0, 60.0))
    part -= m3.Manifold.cylinder(20.0, 2.5, 2.5, 32).translate((65.0, 65.0, -1.0))
    told = write(plan_part(part, SETUP).toolpath, SETUP, title="job").text
    assert ";TYPE:Skirt" in told
    bare = re.sub(r"^;TYPE:.*\n", "", told, flags=re.MULTILINE)
    assert set(job_for(bare, SETUP.printer).beads.roles) == {"unknown"}
    template = MeshSdf.from_mesh(solid_mesh(part.translate((-60.0, -60.0, 0.0))))
    placed = locate_part(job_for(bare, SETUP.printer), template, layer_height_mm=LAYER_MM)
    assert (
        np.abs(placed.matrix[:3] - np.eye(4)[:3] - [[0, 0, 0, 60], [0, 0, 0, 60], [0] * 4]).max()
        < 0.05
    )


HALF_MM = 0.225
SOLID = [8.0 - 2.0 * HALF_MM * k for k in range(18)]  # loops beside each other
SPARSE = [*SOLID[:2], 5.5, 3.5]
BORE = SOLID[14]


def outermost_of(
    layers: list[list[float]], *, open_lines: frozenset[float] = frozenset()
) -> list[set[float]]:
    """Which square loops of each layer are outermost; half their sides; some lack a side."""
    corner = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    ring = np.vstack([corner, corner[:1]])
    steps = np.linspace(0.0, 1.0, 9)[:-1]  # a side in eight beads
    sides = [a + step * (b - a) for a, b in pairwise(ring) for step in steps]
    around = np.vstack([*sides, corner[:1]])
    of, layer, ends = [], [], []
    for k, loops_mm in enumerate(layers):
        for half_side_mm in loops_mm:
            path = half_side_mm * around[: 25 if half_side_mm in open_lines else 33]
            ends.append(np.stack([path[:-1], path[1:]]))
            of += [half_side_mm] * (len(path) - 1)
            layer += [k] * (len(path) - 1)
    start, end = np.concatenate(ends, axis=1)
    size, none = np.full(len(of), 0.2), np.zeros(len(of), np.int64)
    beads = Beads(start, end, 0.09 * size / 0.2, 2.25 * size, size, none, np.array(layer), none,
                  ("unknown",))  # fmt: skip
    found = outermost(beads, np.ones(len(of), bool), HALF_MM)
    return [set(np.array(of)[found & (beads.layer == k)].tolist()) for k in range(len(layers))]


def test_a_slit_between_loops_is_no_hole_of_the_part() -> None:
    # regression: of a cone with a bore that Slic3r had cut, loops inside lay at the outside; its
    # walls were said to lie 0.106 mm off the part's, and the job was refused as another part's
    loops_mm = [8.0, 7.55, 6.9, 6.45, 6.0, 5.55, 5.0]  # a slit of 0.2 mm after the second
    assert outermost_of([loops_mm]) == [{8.0, 5.0}]


@pytest.mark.parametrize("bored", [range(8), range(5), range(3, 8)])
def test_infill_in_closed_loops_is_no_wall(bored: range) -> None:
    """regression: what closed loops alone bound was held to be a hole of the part.

    Half of what was taken for outer walls, of a job of Slic3r, was infill up to 3 mm inside, and
    the job was refused as another part's.
    """
    layers = [
        [*(SPARSE if 2 <= k < 6 else SOLID[:13]), *(SOLID[13:15] if k in bored else SOLID[13:])]
        for k in range(8)
    ]
    assert outermost_of(layers) == [{8.0, BORE} if k in bored else {8.0} for k in range(8)]


def test_infill_that_no_top_covers_is_told_by_its_open_lines() -> None:
    layers = [SOLID[:15], SOLID[:15], *[[*SPARSE, *SOLID[13:15]]] * 3]
    assert outermost_of(layers, open_lines=frozenset(SPARSE[2:])) == [{8.0, BORE}] * 5


@pytest.mark.slow
def test_a_job_of_another_part_is_told_as_that() -> None:
    """regression: "the scan the job's walls does not fit its template", with advice for scans."""
    template = MeshSdf.from_mesh(solid_mesh(m3.Manifold.cylinder(9.0, 8.0, 8.0, 48)))
    job = job_of(wedge().transform(pose((0.0, 0.0, 0.0), 60.0, 60.0)))
    with pytest.raises(AlignmentError, match="the job prints another part") as said:
        locate_parts(job, template, layer_height_mm=LAYER_MM)
    assert "scan" not in str(said.value)


@pytest.mark.slow
def test_another_thing_beside_the_part_is_refused_with_its_number() -> None:
    other = m3.Manifold.cylinder(5.0, 8.0, 5.0, 48).translate((110.0, 66.0, 0.0))
    plate = wedge().transform(pose((0.0, 0.0, 0.0), 60.0, 60.0)) + other
    template = MeshSdf.from_mesh(solid_mesh(wedge()))
    with pytest.raises(AlignmentError, match=r"2 things apart .*(first|second) of them"):
        locate_parts(job_of(plate), template, layer_height_mm=LAYER_MM)


def hooked(holed: bool) -> m3.Manifold:
    """A plate that is told from its twin by a hole alone."""
    whole = m3.Manifold.cube((12.0, 9.0, 2.0)) - m3.Manifold.cube((6.0, 4.0, 9.0))
    return whole - m3.Manifold.cylinder(9.0, 1.5, 1.5, 24).translate(
        (9.0, 5.0, -1.0 if holed else 5.0)
    )


@pytest.mark.parametrize("order", [(0, 1), pytest.param((1, 0), marks=pytest.mark.slow)])
def test_each_thing_of_a_plate_is_of_the_template_that_it_fits(order: tuple[int, int]) -> None:
    """A job of two parts was refused: "loop over a job that prints copies of one part"."""
    parts = [hooked(holed=True), hooked(holed=False)]
    templates = [MeshSdf.from_mesh(solid_mesh(parts[k])) for k in order]
    places = [(60.0, 60.0), (80.0, 60.0), (60.0, 80.0)]  # the second part twice
    plate = m3.Manifold.batch_boolean(
        [parts[k].translate((*at, 0.0)) for k, at in zip((0, 1, 1), places, strict=True)],
        m3.OpType.Add,
    )
    found = locate_plate(job_of(plate), templates, layer_height_mm=LAYER_MM)
    told = {tuple(np.round(one.pose.translation_mm[:2])): order[one.which] for one in found}
    assert told == dict(zip(places, (0, 1, 1), strict=True))
    template, placed = stood_plate(templates, found)
    corners = np.concatenate([np.asarray(solid_mesh(plate).vertices)])
    assert np.abs(template.distance(placed.inverse().apply(corners))).max() < 0.06
    assert template.solid().volume() == pytest.approx(plate.volume(), rel=1e-3)


@pytest.mark.slow
def test_a_low_part_is_found_upright_whatever_its_tops_and_bottoms_hide() -> None:
    """A washer of 0.4 mm was refused: its walls lie nearer to a flat than half a bead, and were
    held to lie 0.1 mm off. Of plates of 0.4 and 2 mm the walls told a tilt of 0.8 degrees.
    """
    washer = m3.Manifold.cylinder(0.4, 3.8, 3.8, 64) - m3.Manifold.cylinder(3.0, 1.75, 1.75, 64)
    plate = hooked(holed=False)
    for part in (washer, plate, plate.scale((1.0, 1.0, 0.2))):
        template = MeshSdf.from_mesh(solid_mesh(part))
        job = job_of(part.translate((80.0, 60.0, 0.0)))
        placed = locate_part(job, template, layer_height_mm=LAYER_MM)
        assert placed.rotation[2, 2] == 1.0
        assert placed.translation_mm == pytest.approx([80.0, 60.0, 0.0], abs=0.05)


def test_a_thing_that_is_of_no_template_is_told() -> None:
    other = hooked(holed=True).translate((60.0, 60.0, 0.0))
    block = m3.Manifold.cylinder(6.0, 4.0, 3.0, 40).translate((84.0, 64.0, 0.0))
    templates = [MeshSdf.from_mesh(solid_mesh(hooked(holed=k))) for k in (True, False)]
    with pytest.raises(AlignmentError, match=r"2 things apart .* of them fits none of the 2"):
        locate_plate(job_of(other + block), templates, layer_height_mm=LAYER_MM)
    two = [templates[0], MeshSdf.from_mesh(solid_mesh(other + block))]
    with pytest.raises(AlignmentError, match="second of 2 templates is of 2 bodies"):
        locate_plate(job_of(other + block), two, layer_height_mm=LAYER_MM)


def test_a_pit_in_the_second_copy_is_found_there() -> None:
    truths = [pose((0.0, 0.0, 0.0), 60.0, 60.0), pose((0.0, 0.0, 90.0), 90.0, 60.0)]
    copies = [wedge().transform(t) for t in truths]
    template = StoodTemplate.of(
        MeshSdf.from_mesh(solid_mesh(wedge())),
        tuple(Transform("build", "template", np.vstack([t, [0, 0, 0, 1.0]])) for t in truths),
    )
    x0, y0, _, x1, _, z1 = copies[1].bounding_box()
    pit = m3.Manifold.cube((3.0, 3.0, 4.0), True).translate((0.5 * (x0 + x1), y0 + 3.0, z1))
    lost = pit ^ copies[1]
    sensors = np.array([[60.0, 0.0, 300.0], [100.0, 150.0, 300.0], [-60.0, 80.0, 250.0],
                        [240.0, 80.0, 250.0]])  # fmt: skip
    points, who = analytic.ray_scan(
        copies[0] + (copies[1] - pit), sensors, spacing_mm=0.25, sigma_mm=0.03, seed=2
    )
    scan = Scan(points, 0.03, "template", None, sensors, who)
    here = Transform.identity("build", "template")
    found = compute_deficit(scan, template, detect(scan, template), build_from_template=here)
    assert lost.volume() > 5.0
    assert found.missing_mm3 == pytest.approx(lost.volume(), rel=0.12)
    assert (found.missing ^ lost).volume() > 0.85 * lost.volume()


def test_the_field_of_copies_is_the_least_of_theirs() -> None:
    rng = np.random.default_rng(0)
    one = MeshSdf.from_mesh(solid_mesh(wedge()))
    truths = [pose((0.0, 0.0, 0.0), 0.0, 0.0), pose((90.0, 0.0, 20.0), 25.0, 3.0)]
    placed = tuple(Transform("build", "template", np.vstack([t, [0, 0, 0, 1.0]])) for t in truths)
    stands = StoodTemplate.of(one, placed)
    points = rng.uniform([-10, -10, -5], [60, 30, 15], (3_000, 3))
    each = np.stack([one.distance(pose.inverse().apply(points)) for pose in placed])
    distance, gradient = stands.distance_and_gradient(points)
    assert distance == pytest.approx(each.min(axis=0), abs=1e-9)
    assert np.linalg.norm(gradient, axis=1) == pytest.approx(1.0, abs=1e-6)
    ahead = stands.distance(points + 1e-5 * gradient)
    smooth = np.abs(each[0] - each[1]) > 1.0  # not midway between the two
    assert np.median(np.abs((ahead - distance)[smooth] / 1e-5 - 1.0)) < 1e-3
    assert stands.distance(stands.surface_points(0.7)[0]) == pytest.approx(0.0, abs=1e-6)
    assert stands.solid().volume() == pytest.approx(2 * wedge().volume(), rel=1e-6)


@pytest.mark.slow
def test_a_skirt_is_nothing_too_much() -> None:
    """At the finished part, which its template judges, 0.6 mm of skirt was too much."""
    truth = pose((0.0, 0.0, 0.0), 60.0, 60.0)
    part = wedge().transform(truth)
    ring = m3.Manifold.cube((26.0, 20.0, 0.6)) - m3.Manifold.cube(
        (25.0, 19.0, 2.0), True
    ).translate((13.0, 10.0, 0.0))
    ring = ring.translate((56.0, 56.0, 0.0))
    job = job_of(part + ring)
    beads = job.beads
    middle = 0.5 * (beads.start_mm + beads.end_mm)[:, :2]
    around = ((middle < [59.5, 59.5]) | (middle > [78.5, 72.5])).any(axis=1)
    roles = (*beads.roles, "Skirt")
    job = replace(job, beads=replace(
        beads, roles=roles, role=np.where(around, len(beads.roles), beads.role)
    ))  # fmt: skip
    template = MeshSdf.from_mesh(solid_mesh(wedge()))
    placed = locate_part(job, template, layer_height_mm=LAYER_MM)
    site = sites(job, template, placed, SETUP)(plan_stops(job, [])[-1])
    sensors = np.array([[0.0, 0.0, 300.0], [150.0, 150.0, 300.0], [-60.0, 80.0, 250.0]])
    bed = m3.Manifold.cube((80.0, 80.0, 1.0)).translate((30.0, 30.0, -1.0))
    points, who = analytic.ray_scan(
        part + ring + bed, sensors, spacing_mm=0.25, sigma_mm=0.03, seed=3
    )
    scan = Scan(points, 0.03, "build", None, sensors, who)
    guess = Transform("template", "build", placed.inverse().matrix)
    bare = plan_repair(scan, replace(site, beside=None), title="x", guess=guess, strict=False)
    assert bare.deficit.excess_mm3 > 20.0
    plan = plan_repair(scan, site, title="x", guess=guess, strict=False)
    assert not plan.anomaly.regions
    assert not plan.deficit.regions


@pytest.mark.slow
def test_a_part_on_a_raft_stands_where_its_beads_begin() -> None:
    """Such jobs were refused; with the raft's top taken for the bed every look was 0.5 mm off."""
    foot_mm = 0.6
    truth = pose((0.0, 0.0, 0.0), 60.0, 60.0)
    part = wedge().transform(truth).translate((0.0, 0.0, foot_mm))
    raft = m3.Manifold.cube((28.0, 22.0, 0.4)).translate((55.0, 55.0, 0.0))
    job = job_of(part + raft)
    beads = job.beads
    under = beads.start_mm[:, 2] < foot_mm
    job = replace(job, beads=replace(
        beads, roles=(*beads.roles, "Support material"),
        role=np.where(under, len(beads.roles), beads.role),
    ))  # fmt: skip
    template = MeshSdf.from_mesh(solid_mesh(wedge()))
    placed = locate_part(job, template, layer_height_mm=LAYER_MM)
    assert placed.apply(np.zeros((1, 3)))[0, 2] == pytest.approx(foot_mm, abs=1e-6)
    stops = plan_stops(job, [0, 1, 12])
    assert [stop.layer_index for stop in stops] == [12, None]  # none in the raft
    expected = sites(job, template, placed, SETUP)
    sensors = np.array([[0.0, 0.0, 300.0], [150.0, 150.0, 300.0], [-60.0, 80.0, 250.0]])
    bed = m3.Manifold.cube((80.0, 80.0, 1.0)).translate((30.0, 30.0, -1.0))
    guess = Transform("template", "build", placed.inverse().matrix)
    for stop in stops:
        so_far = part.trim_by_plane((0.0, 0.0, -1.0), -stop.z_mm)
        pit = m3.Manifold.cube((3.0, 3.0, 2.0), True).translate((64.0, 64.0, stop.z_mm))
        for gone in (m3.Manifold(),) if stop.layer_index is None else (pit,):
            points, who = analytic.ray_scan(
                (so_far - gone) + raft + bed, sensors, spacing_mm=0.25, sigma_mm=0.03, seed=5
            )
            scan = Scan(points, 0.03, "build", None, sensors, who)
            plan = plan_repair(scan, expected(stop), title="x", guess=guess, strict=False)
            away = plan.registration.template_from_scan @ placed
            assert np.abs(away.matrix - np.eye(4)).max() < 0.03
            assert plan.deficit.missing_mm3 == pytest.approx((so_far ^ gone).volume(), rel=0.12)
            assert not plan.too_much


@pytest.mark.slow
@pytest.mark.parametrize("seeds", draws([range(4, 5), range(4, 7)], range(4, 5)), ids=len)
def test_what_layers_round_up_of_a_flat_top_is_nothing_too_much(seeds: range) -> None:
    """A clean job of PrusaSlicer ended with 37 mm³ too much: its tops lay 0.05 mm over the drawing.

    Ridges of 0.1 mm came on top, which alone are allowed for.
    """
    corner = m3.Manifold.cube((6.0, 4.0, 20.0)).translate((14.0, 9.0, -1.0))

    def high(top_mm: float) -> m3.Manifold:
        return (m3.Manifold.cube((18.0, 12.0, top_mm)) - corner).translate((60.0, 60.0, 0.0))

    job = job_of(high(5.2))  # as slicers of whole layers make it of 5.12
    assert job.layers[-1].z_mm == pytest.approx(5.2)
    template = MeshSdf.from_mesh(solid_mesh(high(5.12)))
    placed = Transform.identity("build", "template")
    site = sites(job, template, placed, SETUP)(plan_stops(job, [])[-1])
    guess = Transform("template", "build", placed.inverse().matrix)
    sensors = np.array([[0.0, 0.0, 300.0], [150.0, 150.0, 300.0], [-60.0, 80.0, 250.0]])
    bed = m3.Manifold.cube((60.0, 60.0, 1.0)).translate((40.0, 40.0, -1.0))

    def found(stands: m3.Manifold, laid: bool, seed: int = 4) -> tuple[Region, ...]:
        points, who = analytic.ray_scan(
            stands + bed, sensors, spacing_mm=0.25, sigma_mm=0.03, seed=seed
        )
        scan = Scan(points, 0.03, "build", None, sensors, who)
        here = site if laid else replace(site, laid=None)
        plan = plan_repair(scan, here, title="x", guess=guess, strict=False)
        return plan.deficit.regions

    assert Label.EXCESS in {region.label for region in found(high(5.32), laid=False)}
    assert not found(high(5.32), laid=True)
    # beside a blob the ridges are none, either: 9 to 38 mm³ in up to eleven pieces, before
    blob = m3.Manifold.cube((4.0, 4.0, 1.0)).translate((64.0, 64.0, 4.6))
    for seed in seeds:
        (much,) = found(high(5.3) + blob, laid=True, seed=seed)
        assert much.label is Label.EXCESS
        # half a cell's width of the ridges around it, 0.18 mm high, hangs together with it
        assert much.volume_mm3 == pytest.approx(16.0 * (5.6 - 5.12), rel=0.13)


def test_a_first_layer_over_a_gap_is_pressed_down_by_the_next() -> None:
    """Cura lays it 0.22 mm too high over its raft: its next one was of no height at all."""
    heights = [0.3, 0.45, 0.65, 1.15, 1.13, *np.arange(1.33, 3.0, 0.2)]
    lines = ["M83", "G92 E0"]
    for k, z_mm in enumerate(heights):
        lines += [f";LAYER:{k - 3}", f";TYPE:{'SUPPORT' if k < 3 else 'WALL-OUTER'}"]
        lines += [f"G0 X20 Y20 Z{z_mm:.2f} F6000", "G1 X60 E2 F1200", "G1 Y60 E2"]
    job = job_for("G28\nG90\n" + "\n".join(lines) + "\n", SETUP.printer)
    assert first_layer(job) == 3
    assert [layer.height_mm for layer in job.layers[4:6]] == pytest.approx([0.2, 0.2])
    tops_mm = tops_of(job)
    assert tops_mm[3] == pytest.approx(0.93)
    assert (np.diff(tops_mm) > 0.0).all()
    assert foot_mm(job) == pytest.approx(0.73)


@pytest.mark.parametrize(("tilt_deg", "upright"), [(0.33, True), (1.0, False), (90.0, False)])
def test_a_tilt_that_walls_do_not_tell_is_none(tilt_deg: float, upright: bool) -> None:
    """regression: a panel clip, 6 mm low and drawn at Z −126 mm, was cut 0.7 mm aside."""
    tilted = rotation_from_vector(np.deg2rad([tilt_deg, 0.0, 0.0]))
    placed = Transform.from_rotation_translation(
        "build", "template", rotation=tilted, translation_mm=np.array([107.5, 122.5, 126.0])
    )
    assert is_upright(placed) == upright


@pytest.mark.parametrize("moved_mm", draws([-0.15, 0.0, 0.1], 0.0, 0.1))
def test_a_job_whose_walls_are_moved_is_the_part_s(moved_mm: float) -> None:
    """regression: 'XY size compensation' of 0.1 mm made it another part, or one that lacks it."""
    outline = m3.CrossSection([[(0.0, 0.0), (18.0, 0.0), (18.0, 5.0), (7.0, 12.0), (0.0, 12.0)]])
    part = outline.extrude(5.0)
    laid = outline.offset(moved_mm, m3.JoinType.Miter).extrude(5.0).translate((100.0, 90.0, 0.0))
    job = job_of(laid)
    template = MeshSdf.from_mesh(solid_mesh(part))
    placed = locate_part(job, template, layer_height_mm=LAYER_MM)
    assert off_mm_of(placed, (100.0, 90.0, 0.0), part) < 0.05
    assert walls_moved_mm(job, template, placed) == pytest.approx(abs(moved_mm), abs=0.035)
    final = sites(job, template, placed, SETUP)(plan_stops(job, [])[-1])
    assert (final.planned is not None) == (moved_mm != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("moved_mm", draws([0.0, -0.1], 0.0))
def test_walls_of_a_slope_lie_half_a_bead_in_along_their_layer(moved_mm: float) -> None:
    """regression: a dome's were told moved by 0.1 mm, and its flanks not looked at in the end."""
    foot = m3.CrossSection.circle(9.0, 48)
    part = foot.extrude(1.0) + foot.extrude(4.7, scale_top=(0.3, 0.3)).translate((0.0, 0.0, 0.9))
    less = foot.offset(moved_mm)
    laid = less.extrude(1.0) + less.extrude(
        4.7, scale_top=((2.7 + moved_mm) / (9.0 + moved_mm),) * 2
    ).translate((0.0, 0.0, 0.9))
    job = job_of(laid.translate((100.0, 90.0, 0.0)))
    template = MeshSdf.from_mesh(solid_mesh(part))
    placed = locate_part(job, template, layer_height_mm=LAYER_MM)
    assert walls_moved_mm(job, template, placed) == pytest.approx(abs(moved_mm), abs=0.035)
    final = sites(job, template, placed, SETUP)(plan_stops(job, [])[-1])
    assert (final.planned is not None) == (moved_mm != 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("stretch", draws([-0.01, 0.015], -0.01))
def test_a_job_that_is_stretched_for_what_shrinks_is_the_part_s(stretch: float) -> None:
    """regression: 0.5 % of a part of 60 mm made it another part, or laid it aside by as much."""
    outline = m3.CrossSection([[(0.0, 0.0), (60.0, 0.0), (60.0, 9.0), (20.0, 30.0), (0.0, 30.0)]])
    part = outline.extrude(2.0)
    longer = 1.0 + stretch
    middle_mm = np.array([30.0, 15.0])
    at_mm = np.array([90.0, 80.0]) - stretch * middle_mm
    job = job_of(part.scale((longer, longer, 1.0)).translate((*at_mm, 0.0)))
    placed = locate_part(job, MeshSdf.from_mesh(solid_mesh(part)), layer_height_mm=LAYER_MM)
    assert off_mm_of(placed, (90.0, 80.0, 0.0), part) < 0.15


def roughened(job: Job, off_mm: float, seed: int) -> Job:
    """The same job with a fuzzy skin: every 0.8 mm its walls are aside by up to so much."""
    beads, rng = job.beads, np.random.default_rng(seed)
    way = beads.end_mm - beads.start_mm
    length_mm = np.linalg.norm(way, axis=1)
    pieces = np.ceil(length_mm / 0.8).astype(np.int64)
    owner = np.repeat(np.arange(len(beads)), pieces)
    k = np.arange(len(owner)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    across = np.column_stack([-way[:, 1], way[:, 0]]) / np.maximum(length_mm, 1e-9)[:, None]
    ends = [
        beads.start_mm[owner] + (way / pieces[:, None])[owner] * (k + d)[:, None] for d in (0, 1)
    ]
    aside = rng.uniform(-off_mm, off_mm, len(owner) + 1)
    for end, by_mm in zip(ends, (aside[:-1], aside[1:]), strict=True):
        end[:, :2] += by_mm[:, None] * across[owner]
    told = {
        name: getattr(beads, name)[owner]
        for name in ("section_mm2", "width_mm", "height_mm", "role", "layer", "line")
    }
    return replace(job, beads=replace(beads, start_mm=ends[0], end_mm=ends[1], **told))


@pytest.mark.parametrize("seed", range(2))
def test_a_job_with_a_fuzzy_skin_is_the_part_s(seed: int) -> None:
    """regression: seven of eight figures with PrusaSlicer's fuzzy skin were other parts."""
    job = roughened(job_of(wedge().translate((100.0, 90.0, 0.0))), 0.3, seed)
    placed = locate_part(job, MeshSdf.from_mesh(solid_mesh(wedge())), layer_height_mm=LAYER_MM)
    assert off_mm_of(placed, (100.0, 90.0, 0.0), wedge()) < 0.1


@pytest.mark.parametrize("stretch", [0.04])
def test_a_job_at_another_scale_is_another_part_s(stretch: float) -> None:
    part = m3.Manifold.cube((50.0, 20.0, 2.0)) + m3.Manifold.cube((10.0, 35.0, 2.0))
    job = job_of(part.scale((1.0 + stretch, 1.0 + stretch, 1.0)).translate((60.0, 60.0, 0.0)))
    with pytest.raises(AlignmentError, match=r"at (this|its) scale"):
        locate_part(job, MeshSdf.from_mesh(solid_mesh(part)), layer_height_mm=LAYER_MM)


def off_mm_of(placed: Transform, at_mm: tuple[float, ...], part: m3.Manifold) -> float:
    corners = np.asarray(solid_mesh(part).vertices)
    return float(np.linalg.norm(placed.apply(corners) - corners - at_mm, axis=1).max())
