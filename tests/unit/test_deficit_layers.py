"""Deficits of a layer just printed, in the simulated scanner's eyes: thin, wide, up to walls."""

from __future__ import annotations

import manifold3d as m3
import numpy as np
import pytest
import trimesh

from amrepair.deficit import Deficit, compute_deficit
from amrepair.frames import Transform
from amrepair.policy import DEFAULT_POLICY
from amrepair.policy.acceptance import Piece, worth_mending
from amrepair.regions import detect
from amrepair.scans import ScanRequest
from amrepair.simulate.parameters import load_world
from amrepair.simulate.scanner import ScannerPose, SimulatedScanner, default_sensors_mm
from amrepair.simulate.world import World
from amrepair.template import CutTemplate, MeshSdf

TOP_MM = 4.0
WHOLE = m3.Manifold.cube((24.0, 18.0, 8.0)).translate((18.0, 21.0, 0.0))
PRINTED = WHOLE.trim_by_plane((0.0, 0.0, -1.0), -TOP_MM)
PLACE = Transform.identity("template", "scanner")


@pytest.fixture(scope="module")
def template() -> MeshSdf:
    mesh = WHOLE.to_mesh()
    return MeshSdf.from_mesh(
        trimesh.Trimesh(np.array(mesh.vert_properties)[:, :3], np.array(mesh.tri_verts))
    )


def deficit_of(template: MeshSdf, standing: m3.Manifold, seed: int = 0) -> Deficit:
    world = World((60.0, 60.0))
    world.add(standing)
    pose = Transform.identity("build", "scanner")
    scanner = SimulatedScanner(
        world,
        pose=ScannerPose(pose, pose),
        sensors_mm=default_sensors_mm((30.0, 30.0)),
        rng=np.random.default_rng(seed),
    )
    scan = scanner.scan(ScanRequest("test", 19, TOP_MM)).moved(PLACE)
    layer = CutTemplate(template, TOP_MM)
    anomaly = detect(scan, layer, top_z_mm=TOP_MM)
    return compute_deficit(
        scan,
        layer,
        anomaly,
        build_from_template=Transform.identity("build", "template"),
        printed_z_mm=TOP_MM,
    )


@pytest.mark.slow
def test_a_layer_too_low_is_missing_by_its_depth_and_no_more_beside_walls(
    template: MeshSdf,
) -> None:
    # regression: beside every wall a pixel's width of it was called missing, and the emptiest of
    # five noisy images set the depth: 14 % too much
    low = WHOLE.trim_by_plane((0.0, 0.0, -1.0), -(TOP_MM - 0.3))
    found = deficit_of(template, low)
    assert found.missing_mm3 == pytest.approx((PRINTED - low).volume(), rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_half_a_layer_that_lacks_everywhere_is_missing_whole(template: MeshSdf, seed: int) -> None:
    # regression: at half of a 0.2 mm layer, the limit of a window as wide as a bead, chance decided
    low = WHOLE.trim_by_plane((0.0, 0.0, -1.0), -(TOP_MM - 0.09))
    found = deficit_of(template, low, seed)
    assert found.missing_mm3 == pytest.approx((PRINTED - low).volume(), rel=0.08)


def test_a_strip_one_layer_deep_and_four_beads_wide_is_found_to_its_ends(
    template: MeshSdf,
) -> None:
    # regression: 0.2 mm is hardly more than the limit of a finished part's surfaces
    strip = m3.Manifold.cube((12.0, 1.65, 0.2)).translate((24.0, 29.0, TOP_MM - 0.2))
    found = deficit_of(template, PRINTED - strip)
    assert found.missing_mm3 == pytest.approx(strip.volume(), rel=0.2)
    inside = (found.missing ^ strip).volume()
    assert inside > 0.8 * strip.volume()


def test_reflections_near_what_stands_out_are_no_part_of_it(template: MeshSdf) -> None:
    # regression: a point in mid-air beside a ridge was a blob that the head would hit, and where
    # a tall ridge stood on a thin part, there was excess in the bed below it
    thin_mm = 0.8
    part = WHOLE.trim_by_plane((0.0, 0.0, -1.0), -thin_mm)
    ridge = m3.Manifold.cube((6.0, 6.0, 1.4)).translate((22.0, 25.0, thin_mm))
    world = World((60.0, 60.0))
    world.add(part + ridge)
    pose = Transform.identity("build", "scanner")
    scanner = SimulatedScanner(
        world,
        pose=ScannerPose(pose, pose),
        sensors_mm=default_sensors_mm((30.0, 30.0)),
        rng=np.random.default_rng(0),
        model=load_world().scanner().model_copy(update={"outlier_ratio": 0.005}),
    )
    scan = scanner.scan(ScanRequest("test", 3, thin_mm)).moved(PLACE)
    layer = CutTemplate(template, thin_mm)
    found = compute_deficit(
        scan,
        layer,
        detect(scan, layer, top_z_mm=thin_mm),
        build_from_template=Transform.identity("build", "template"),
        printed_z_mm=thin_mm,
    )
    assert found.excess.bounding_box()[2] > -0.01
    assert found.excess_mm3 == pytest.approx(ridge.volume(), rel=0.1)
    around = ridge.minkowski_sum(m3.Manifold.cube((0.8, 0.8, 0.8), True))
    assert (found.excess - around).volume() < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_a_layer_as_it_should_be_lacks_nothing(template: MeshSdf, seed: int) -> None:
    assert deficit_of(template, PRINTED, seed).missing_mm3 == 0.0


def test_pieces_side_by_side_are_one_defect_and_crumbs_join_nothing() -> None:
    def piece(x_mm: float, volume_mm3: float) -> Piece:
        box_mm = np.array([[x_mm, 0.0, 0.0], [x_mm + 1.0, 1.0, 0.2]])
        return Piece(box_mm, volume_mm3, skipped=False)

    share = 0.4 * DEFAULT_POLICY.least_mm3
    kept = worth_mending([piece(x_mm, share) for x_mm in (0.0, 1.5, 3.0, 20.0)])
    assert kept.tolist() == [True, True, True, False]
    assert not worth_mending([piece(0.1 * k, 0.03) for k in range(100)]).any()


def test_lines_gone_here_and_there_are_one_defect_and_a_rough_layer_is_none() -> None:
    # regression: four lines of 3.5 mm gone in as many tabs were not filled in their own layer;
    # eleven crumbs of a clean one (0.9 mm³ in all) nearly were
    def apart(volumes_mm3: list[float], *, skipped: bool) -> list[Piece]:
        boxes = (np.array([[5.0 * k, 0.0, 0.0], [5.0 * k + 3.0, 0.4, 0.2]]) for k in range(11))
        return [Piece(*each, skipped) for each in zip(boxes, volumes_mm3, strict=False)]

    tabs, rough = [0.33, 0.29, 0.18, 0.17], [0.14] * 11
    assert worth_mending(apart(tabs, skipped=True)).all()
    assert not worth_mending(apart(tabs, skipped=False)).any()
    assert not worth_mending(apart(rough, skipped=True)).any()
