"""Layers that came out thin under sound ones: their walls tell, and what they lack is offered."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest

from amrepair.errors import AlignmentError
from amrepair.frames import Transform
from amrepair.loop import Stop
from amrepair.loop.afterwards import afterwards
from amrepair.loop.looks import Look, left_well
from amrepair.loop.sites import sites
from amrepair.loop.thin_layers import DEFAULT_THIN, _on_part, thin_layers, with_covered
from amrepair.policy import Action
from amrepair.regions import DefectType, Label, Region
from amrepair.repair import RepairPlan
from amrepair.template import MeshSdf
from tests.unit.loop_bench import PLACE_MM, SIZE_MM, Small, scan_of, solid_mesh

THIN, LAST = range(8, 11), 14
WIDTH_MM, LAYER_MM = 0.45, 0.2


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made(height_mm=4.0)


def stop_after(small: Small, layer: int) -> Stop:
    return Stop(layer, small.job.layers[layer].end_line, small.job.layers[layer].z_mm)


def half_flow() -> m3.Manifold:
    """What stands there where some layers had half of their plastic: their beads are half as wide.

    Where the walls are looked at: what else they lack lies inside.
    """
    off = 0.5 * 0.5 * WIDTH_MM
    whole = m3.Manifold.cube((*SIZE_MM[:2], LAYER_MM * (LAST + 1)))
    high = (LAYER_MM * len(THIN),)
    low_mm = LAYER_MM * THIN[0]
    band = m3.Manifold.cube((*SIZE_MM[:2], *high)).translate((0.0, 0.0, low_mm))
    core = m3.Manifold.cube((SIZE_MM[0] - 2.0 * off, SIZE_MM[1] - 2.0 * off, *high))
    return (whole - (band - core.translate((off, off, low_mm)))).translate(PLACE_MM)


def walls(
    small: Small, in_mm: dict[int, float], seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the walls, how far out they lie, and which way is out there."""
    rng = np.random.default_rng(seed)
    count = 4_000
    place = np.column_stack([rng.random((count, 2)), np.zeros(count)]) * (*SIZE_MM[:2], 1.0)
    place[:, 2] = rng.random(count) * LAYER_MM * (LAST + 1)
    side = rng.integers(4, size=count)
    outward = np.eye(3)[side // 2] * (2 * (side % 2) - 1)[:, None]
    on = np.arange(count), side // 2
    place[on] = (side % 2) * np.array(SIZE_MM)[side // 2]
    layer = (place[:, 2] / LAYER_MM).astype(int)
    deviation = -np.array([in_mm.get(k, 0.0) for k in layer]) + rng.normal(scale=0.03, size=count)
    return place + np.array(PLACE_MM), deviation, outward


@pytest.mark.parametrize("seed", range(3))
def test_walls_tell_which_layers_are_thin_and_by_what_share(small: Small, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sound = {layer: rng.normal(scale=0.01) for layer in range(LAST + 1)}
    thin = {layer: sound[layer] + 0.25 * WIDTH_MM for layer in THIN}
    found = thin_layers(*walls(small, sound | thin, seed), small.job, stop_after(small, LAST))
    assert found is not None
    assert (found.first, found.last) == (THIN[0], THIN[-1])
    assert found.lacking == pytest.approx(0.5, abs=4.0 * found.sigma)


@pytest.mark.parametrize("seed", range(4))
def test_layers_of_a_sound_job_differ_and_tell_nothing(small: Small, seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    sound = {layer: rng.normal(scale=0.02) for layer in range(LAST + 1)}
    assert thin_layers(*walls(small, sound, seed), small.job, stop_after(small, LAST)) is None


@pytest.mark.parametrize("bulging", [range(5, LAST + 1), range(2, 10)])
def test_sound_layers_beside_some_that_bulge_are_not_thin(small: Small, bulging: range) -> None:
    # regression: of a sound cone whose solid layers had more plastic than room, those beside them
    # that stood where they should were told to lack two fifths, and four of six looks halted
    out = dict.fromkeys(bulging, -0.09)
    assert thin_layers(*walls(small, out, 0), small.job, stop_after(small, LAST)) is None


def test_a_notch_in_one_wall_is_no_thin_layer(small: Small) -> None:
    place, deviation, outward = walls(small, {}, 0)
    notch = (outward[:, 0] > 0.5) & (place[:, 2] > 1.6) & (place[:, 2] < 2.2)
    deviation = deviation - 0.2 * notch
    assert thin_layers(place, deviation, outward, small.job, stop_after(small, LAST)) is None


@pytest.fixture(scope="module")
def last(small: Small, tmp_path_factory: pytest.TempPathFactory) -> Look:
    folder, stop = tmp_path_factory.mktemp("thin") / "run", stop_after(small, LAST)
    report, _ = small.run(folder, lambda request: scan_of(half_flow()), stops=[stop])
    return report.looks[-1]


def test_what_they_lack_is_offered_to_be_printed_again(small: Small, last: Look) -> None:
    # regression: half the plastic in three layers under four sound ones was 'nothing to decide'
    stop = last.stop
    assert last.decision.action is Action.OFFER
    # regression: that nobody took the offer left the print "within tolerance"
    assert not left_well([last], last.plan.deficit.missing_mm3)
    reprint, leave = last.decision.ways
    assert reprint.layer in (THIN[0] - 1, THIN[0])
    lacking_mm3 = 0.5 * len(THIN) * LAYER_MM * SIZE_MM[0] * SIZE_MM[1]
    # of the band its edges are seen, too: as points lie on both sides of them, it seems shallower
    assert 0.6 * lacking_mm3 < leave.left_mm3 < 1.1 * lacking_mm3
    assert "of the plastic, by how far their walls stand in" in last.decision.reason
    seen = replace(last, stop=stop_after(small, THIN[-1] + 1))
    site = sites(small.job, small.template, small.placed, small.setup)(stop)
    bare = replace(last.plan, covered=None)

    def again(look: Look) -> RepairPlan:
        return with_covered(bare, small.job, site.expected, stop, [look])

    assert again(seen).covered is None  # an earlier look has told of them
    unseen = replace(seen, plan=bare)
    assert again(unseen).covered is not None
    from_above = replace(unseen, stop=stop_after(small, THIN[-1]))
    assert again(from_above).covered is None  # an earlier look has seen their tops


def test_of_a_finished_part_they_are_told_too(small: Small, last: Look) -> None:
    plan = replace(last.plan, covered=None)
    job = small.job
    cut = replace(
        job, layers=job.layers[: LAST + 1], beads=job.beads.subset(job.beads.layer <= LAST)
    )
    whole = m3.Manifold.cube((*SIZE_MM[:2], LAYER_MM * (LAST + 1)))
    part = MeshSdf.from_mesh(solid_mesh(whole))
    late = afterwards(plan, cut, part, small.setup, command="gcode resume-at JOB")
    assert late.told[0].startswith(f"layers {THIN[0]} to {THIN[-1]} lack about")
    assert late.ways[-1].name == "leave"


def test_the_floor_of_a_large_notch_is_no_thin_layer(small: Small, last: Look) -> None:
    # regression: of a camera's mount that had lost its upper third but for two ears, the layers at
    # the notch's floor were told to lack 35 % of their plastic, with 0 mm3 open inside
    stop, floor_mm = stop_after(small, LAST), 9 * LAYER_MM
    site = sites(small.job, small.template, small.placed, small.setup)(stop)
    wall_mm = walls(small, {}, 0)[0]
    floor = np.random.default_rng(1).random((8_000, 3)) * (*SIZE_MM[:2], 0.0) + PLACE_MM
    floor[:, 2] += floor_mm + np.random.default_rng(2).normal(scale=0.08, size=len(floor))
    place_mm = np.concatenate([wall_mm[wall_mm[:, 2] < floor_mm], floor])
    anomaly = replace(
        last.plan.anomaly,
        points_mm=last.plan.build_from_template.inverse().apply(place_mm),
        deviation_mm=site.expected.distance(small.placed.inverse().apply(place_mm)),
        score=np.zeros(len(place_mm)),
        label=np.zeros(len(place_mm), np.int64),
    )
    box_mm = np.array([[0.0, 0.0, floor_mm], [*SIZE_MM[:2], 3.0]]) + PLACE_MM
    notch = Region(Label.MISSING, DefectType.CHIP, 230.0, 200.0, 3.0 - floor_mm, box_mm)
    plan = replace(
        last.plan, covered=None, anomaly=anomaly, deficit=replace(last.plan.deficit, regions=())
    )
    deficit = replace(plan.deficit, regions=(notch,))
    found = thin_layers(*_on_part(plan, site.expected, DEFAULT_THIN), small.job, stop)
    assert found is not None  # not knowing of the notch
    seen = replace(plan, deficit=deficit)
    assert thin_layers(*_on_part(seen, site.expected, DEFAULT_THIN), small.job, stop) is None
    assert with_covered(seen, small.job, site.expected, stop).covered is None


@pytest.mark.parametrize("looked_for", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_job_of_another_part_is_told_and_asked_for_nothing(
    small: Small, last: Look, monkeypatch: pytest.MonkeyPatch, looked_for: bool
) -> None:
    # regression: a mount was repaired with --job of another part, 6 mm high, without a word
    plan = replace(last.plan, covered=None)
    other = MeshSdf.from_mesh(solid_mesh(m3.Manifold.cylinder(4.0, 9.0, 2.0)))

    def located(*_: object, **__: object) -> tuple[Transform, ...]:
        raise AlignmentError("the job prints another part")  # as it does after four seconds

    if not looked_for:
        monkeypatch.setattr("amrepair.loop.afterwards.locate_parts", located)
    late = afterwards(plan, small.job, other, small.setup, command="gcode resume-at JOB")
    assert late.covered == ""
    assert "prints another part" in late.told[-1]
    assert "only the heights of its layers" in late.told[-1]
