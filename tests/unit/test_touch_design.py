"""Where the probe touches, what its touches say, and that the test judges them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parent))
from probe_job import judged, plate, prober, standing

from amrepair.errors import InputError, ScannerError
from amrepair.loop import Stop
from amrepair.loop.probing import PortFeeler
from amrepair.loop.sites import sites
from amrepair.loop.touch_design import (
    DEFAULT_TOUCHES,
    Flats,
    ProbeOptions,
    first_places,
    flats_of,
    next_places,
)
from amrepair.loop.touched import Touches, measured_sigma_mm, scan_of
from amrepair.regions import Label
from amrepair.repair import Site
from amrepair.scans import PROBE, ScanRequest
from amrepair.simulate.run import PreparedRun
from gcode.hosts.file import FilePrinter
from gcode.resumption.standing import standing_field
from gcode.surfaces import HeightField
from tests.draws import draws

LAYER = 9
NONE = np.zeros((0, 3))
TIP_MM, REACH_MM = 0.5, 0.95


@pytest.fixture(scope="module")
def run() -> PreparedRun:
    return plate()


@pytest.fixture(scope="module")
def stop(run: PreparedRun) -> Stop:
    layer = run.job.layers[LAYER]
    return Stop(LAYER, layer.end_line, layer.z_mm)


@pytest.fixture(scope="module")
def site(run: PreparedRun, stop: Stop) -> Site:
    return sites(run.job, run.template, run.build_from_template, run.setup, by_beads=False)(stop)


def square(side_mm: float, *, low_mm: float = 100.0) -> Flats:
    count = round(side_mm / DEFAULT_TOUCHES.cell_mm)
    full = np.ones((count, count))
    return Flats(np.full(2, low_mm), 2.0 * full, 0.2 * full, full.astype(bool))


def cells(flats: Flats) -> np.ndarray:
    return flats.xy_mm(*np.nonzero(flats.may))


@pytest.mark.parametrize("count", [5, 12, 28, 40])
def test_few_places_leave_no_large_disc_untouched(count: int) -> None:
    """Discs that cover a square: no design is below √(A / n π), a hexagonal one is 1.1 over it."""
    flats = square(30.0)
    places = first_places(flats, count, NONE)
    assert len(places) == count
    untouched_mm = cKDTree(places).query(cells(flats))[0].max()
    assert untouched_mm < 1.6 * np.sqrt(900.0 / (count * np.pi))


def test_more_is_touched_where_more_is_laid() -> None:
    """Half of the square has a quarter of the plastic: half as near, weighted."""
    flats = square(30.0)
    flats.worth_mm[:, : flats.worth_mm.shape[1] // 2] *= 0.25
    places = first_places(flats, 40, NONE)
    dense = int((places[:, 0] > 115.0).sum())
    assert 2.2 < dense / (40 - dense) < 5.5  # 4 without rims


def test_what_was_felt_a_layer_ago_is_not_felt_first() -> None:
    flats = square(30.0)
    before = first_places(flats, 20, NONE)
    faded = np.column_stack([before, np.full(len(before), 1.0)])
    again = first_places(flats, 20, faded)
    alone, both = (cKDTree(p).query(cells(flats))[0].max() for p in (before, [*before, *again]))
    assert both < 0.85 * alone
    assert cKDTree(before).query(again)[0].min() > 1.0


def test_touches_close_in_on_what_is_off() -> None:
    """A disc of radius 4: beside each touch in it there are others, until none is off."""
    flats, middle = square(30.0), np.array([113.0, 117.0])
    felt = first_places(flats, 32, NONE)
    for _ in range(12):
        is_off = np.linalg.norm(felt - middle, axis=1) < 4.0
        more = next_places(flats, felt, -0.2 * is_off, is_off, reach_mm=REACH_MM, most=100)
        if not len(more):
            break
        assert cKDTree(felt).query(more)[0].min() > REACH_MM  # none is felt twice
        felt = np.concatenate([felt, more])
    disc = cells(flats)[np.linalg.norm(cells(flats) - middle, axis=1) < 4.0]
    covered = cKDTree(felt).query(disc)[0] <= REACH_MM * 1.25
    assert is_off.any()
    assert covered.mean() > 0.95
    assert len(felt) < 32 + 1.6 * np.pi * (4.0 + 2 * REACH_MM) ** 2 / (1.5 * 3**0.5 * REACH_MM**2)
    assert not len(next_places(flats, felt, -0.2 * is_off, is_off, reach_mm=REACH_MM, most=0))


def test_only_tops_that_the_tip_rests_on_are_touched(run: PreparedRun, stop: Stop) -> None:
    field = standing_field(run.job.beads, stop.line, run.setup.printer)
    flats = flats_of(run.job, stop, run.setup, field)
    box = run.part.bounding_box()
    places = cells(flats)
    assert (places >= np.array(box[:2]) - 0.01).all()
    assert (places <= np.array(box[3:5]) + 0.01).all()
    assert len(places) * DEFAULT_TOUCHES.cell_mm**2 == pytest.approx(600.0, rel=0.02)
    assert np.allclose(flats.top_mm[flats.may], stop.z_mm)


def test_the_head_keeps_clear_of_what_is_higher(run: PreparedRun, stop: Stop) -> None:
    """A wall of 20 mm beside the plate: the fan's duct would hit it."""
    field = standing_field(run.job.beads, stop.line, run.setup.printer)
    box = run.part.bounding_box()
    x_mm = field.origin_mm[0] + (np.arange(field.shape[1]) + 0.5) * field.cell_mm
    z_mm = field.z_mm.copy()
    z_mm[:, (x_mm > box[3] + 15.0) & (x_mm < box[3] + 17.0)] = 20.0
    walled = HeightField(field.origin_mm, field.cell_mm, z_mm, field.seen)
    places = cells(flats_of(run.job, stop, run.setup, walled))
    duct_mm = 30.0  # of the generic head, on that side
    assert len(places) > 0
    assert places[:, 0].max() < box[3] + 15.0 - duct_mm + 1.0
    z_mm[:, (x_mm > box[0] - 3.0) & (x_mm < box[0] - 1.0)] = 20.0
    with pytest.raises(ScannerError, match="would hit"):
        flats_of(run.job, stop, run.setup, HeightField(field.origin_mm, 1.0, z_mm, field.seen))


@given(share=st.floats(0.3, 3.0), true=st.floats(0.002, 0.05), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None)
def test_repeated_touches_tell_the_noise(share: float, true: float, seed: int) -> None:
    """Between the profile's word and the measurement, the nearer to this the more there are."""
    rng = np.random.default_rng(seed)
    few, many = (measured_sigma_mm(rng.normal(3.0, true, n), share * true) for n in (4, 2000))
    assert many == pytest.approx(true, rel=0.1)
    assert 0.7 * share * true <= few <= max(share, 3.0) * true
    assert measured_sigma_mm(np.array([3.0]), share * true) == pytest.approx(share * true)


@pytest.mark.parametrize("radius_mm", draws([1.5, 2.5, 4.0], 1.5))
def test_the_rim_of_a_hole_is_told_without_bias(radius_mm: float) -> None:
    """A flat finds a hole smaller by its radius all round; said of touches that is made good."""
    flats, ratios = square(20.0), []
    for seed in range(12):
        middle = 110.0 + np.random.default_rng(seed).uniform(-1.0, 1.0, 2)
        x, y = np.meshgrid(*[np.arange(-5, 6) * 1.6] * 2)
        places = np.array([110.0, 110.0]) + np.column_stack([x.ravel(), y.ravel()])
        away = np.linalg.norm(places - middle, axis=1)
        z_mm = np.where(away < radius_mm - TIP_MM, 1.8, 2.0)  # the flat is all within
        touches = Touches(np.column_stack([places, z_mm]), np.full(len(places), 2.0), 0.01)
        scan = scan_of(touches, flats, tip_radius_mm=TIP_MM, reach_mm=REACH_MM, source="")
        grid = scan.points_mm[: len(scan) - len(places)]
        ratios.append(
            DEFAULT_TOUCHES.cell_mm**2 * (grid[:, 2] < 1.9).sum() / (np.pi * radius_mm**2)
        )
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.12)


def test_of_what_was_not_touched_nothing_is_said(run: PreparedRun, stop: Stop, site: Site) -> None:
    """A hole between the touches: unknown, and so not missing."""
    field = standing(run, stop, rough_mm=0.005, seed=0)
    scanner, feeler = prober(run, field)
    judged(scanner, run, site, stop)
    felt = np.concatenate(feeler.asked_mm)
    box = run.part.bounding_box()
    middle = 0.5 * np.array([box[0] + box[3], box[1] + box[4]])
    grid = middle + np.stack(np.meshgrid(*[np.arange(-7, 7.1, 0.25)] * 2), -1).reshape(-1, 2)
    far = grid[int(np.argmax(cKDTree(felt).query(grid)[0]))] - middle
    hidden = standing(run, stop, (*far, 1.4, 0.4), rough_mm=0.005, seed=0)
    scanner, feeler = prober(run, hidden)
    plan = judged(scanner, run, site, stop)
    assert plan.deficit.missing_mm3 == 0.0
    assert plan.deficit.unseen_area_mm2 > 300.0
    scan = scanner.scan(ScanRequest("layer-010", LAYER, stop.z_mm))
    near_mm = cKDTree(np.concatenate(feeler.asked_mm)).query(scan.points_mm[:, :2])[0]
    assert near_mm.max() <= REACH_MM + 1e-9
    assert scan.frame == PROBE


def clean_regions(run: PreparedRun, site: Site, stop: Stop, seeds: range) -> int:
    count = 0
    for seed in seeds:
        field = standing(run, stop, rough_mm=0.01, seed=seed)
        plan = judged(prober(run, field, seed=seed)[0], run, site, stop)
        count += len(plan.anomaly.regions)
    return count


@pytest.mark.slow
def test_sound_layers_raise_nothing(run: PreparedRun, stop: Stop, site: Site) -> None:
    assert clean_regions(run, site, stop, range(6)) == 0


@pytest.mark.slow
def test_sound_layers_raise_nothing_over_many_seeds(
    run: PreparedRun, stop: Stop, site: Site
) -> None:
    """0.05 regions a scan are promised: of 200, no more than 10 and three standard deviations."""
    assert clean_regions(run, site, stop, range(10, 210)) <= 19


@pytest.mark.parametrize(
    ("x_mm", "y_mm", "depth_mm"), draws([(3.0, 2.0, 0.2), (-8.0, -3.5, 0.4)], (3.0, 2.0, 0.2))
)
def test_a_void_is_found_by_sixty_touches_and_measured(
    run: PreparedRun, stop: Stop, site: Site, x_mm: float, y_mm: float, depth_mm: float
) -> None:
    radius_mm = 3.0
    field = standing(run, stop, (x_mm, y_mm, radius_mm, depth_mm), rough_mm=0.005, seed=1)
    scanner, _ = prober(run, field)
    plan = judged(scanner, run, site, stop)
    assert scanner.felt[0].touches <= ProbeOptions().most
    (region,) = plan.to_fill
    truth_mm3 = np.pi * radius_mm**2 * depth_mm
    assert region.label is Label.MISSING
    (found,) = plan.anomaly.regions
    assert found.p_value < 0.01
    assert region.volume_mm3 == pytest.approx(truth_mm3, rel=0.3)
    assert plan.checked is not None
    assert not plan.refused


def test_only_the_printers_own_port_answers(run: PreparedRun, tmp_path: Path) -> None:
    printer = FilePrinter(tmp_path / "out.gcode")
    with pytest.raises(InputError, match="needs the printer's own port"):
        PortFeeler(printer, run.setup)
