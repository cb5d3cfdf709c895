"""The test for regions: silent on sound parts whatever the noise, sure of what is missing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree
from scipy.stats import norm
from scipy.stats import t as student

from amrepair.cli.inspect import _refuse_too_noisy
from amrepair.errors import InputError
from amrepair.field.scales import RANK, WINDOW_FACING, scales_of
from amrepair.regions import Label, detect
from amrepair.regions.detection import judged_scales
from amrepair.regions.error_calibration import NORMAL_NOISE, Calibration, FarOff
from amrepair.regions.error_calibration_fit import calibrated
from amrepair.regions.inspected import Inspected
from amrepair.regions.options import RegionOptions
from amrepair.regions.significance import Tail, as_normal, as_student
from amrepair.regions.significance import tested as levels_of
from amrepair.scans import Scan
from tests.analytic import (
    AnalyticTemplate,
    box,
    cylinder,
    difference,
    noisy_scan_points,
    sample_surface,
    sphere,
    union,
)

BALL_MM, SPACING_MM = 30.0, 0.6


@pytest.fixture(scope="module")
def ball() -> AnalyticTemplate:
    return sphere((0, 0, 0), BALL_MM)


def rough(ball: AnalyticTemplate, seed: int, *, dent_mm: float = 0.0) -> Scan:
    """A scan whose errors hang together over 3 mm, 2 % of which are off by 0.5 mm and more.

    With a dent as wide as deep times four, at the top.
    """
    rng = np.random.default_rng(seed)
    points, normals = sample_surface(ball.body, SPACING_MM, seed=seed)
    knots = rng.normal(size=(6000, 3))
    knots *= BALL_MM / np.linalg.norm(knots, axis=1, keepdims=True)
    lump = rng.standard_normal(len(knots)) * np.where(rng.random(len(knots)) < 0.03, 4.0, 1.0)
    apart, near = cKDTree(knots).query(points, k=8)
    weight = np.exp(-0.5 * (apart / 1.2) ** 2)
    common = (weight * lump[near]).sum(axis=1) / weight.sum(axis=1)
    off = 0.12 * common / common.std() + rng.normal(scale=0.06, size=len(points))
    deep = np.maximum(dent_mm - (points[:, 0] ** 2 + points[:, 1] ** 2) / 12.0, 0.0)
    off -= np.where(points[:, 2] > 0, deep, 0.0)
    return Scan(points + off[:, None] * normals, 0.04, "template")


@pytest.mark.parametrize("seed", range(4))
def test_errors_that_hang_together_raise_no_alarm(ball: AnalyticTemplate, seed: int) -> None:
    """Where normal noise of 0.04 mm is given, as the file says, such a scan contradicts."""
    scan = rough(ball, seed)
    assert detect(scan, ball).regions == ()
    found = detect(scan, ball, calibration=NORMAL_NOISE, pose="told")
    assert (found.regions, found.calibration) == ((), None)
    assert found.told_over_mm(0.2) > 0.0  # of no line that is told as far as it is wide


@pytest.mark.parametrize("lumps", [100, 115, 125])
def test_a_scan_alone_does_not_tell_its_errors_from_what_the_process_left(
    ball: AnalyticTemplate, lumps: int
) -> None:
    # regression: what a process usually leaves was taken off what windows wander by, and the little
    # that was left made errors of a third of a millimetre significant
    options = RegionOptions(process_sigma_mm=0.05)
    assert detect(rough(ball, lumps), ball, options=options).regions == ()


@pytest.mark.parametrize("seed", range(3))
def test_a_dent_among_such_errors_is_found_and_nothing_else(
    ball: AnalyticTemplate, seed: int
) -> None:
    (region,) = detect(rough(ball, seed, dent_mm=1.5), ball).regions
    assert region.label is Label.MISSING
    assert region.box_mm[1, 2] > BALL_MM - 2.5
    assert np.abs(region.box_mm[:, :2]).max() < 6.0
    assert region.p_value < 1e-4


def test_what_the_scan_tells_of_its_noise_is_so(ball: AnalyticTemplate) -> None:
    points, normals = sample_surface(ball.body, 0.3, seed=1)
    rng = np.random.default_rng(1)
    for sigma_mm in (0.02, 0.1):
        noisy = points + rng.normal(scale=sigma_mm, size=(len(points), 1)) * normals
        noise = detect(Scan(noisy, 0.04, "template"), ball).noise
        assert noise is not None
        assert noise.sigma_mm == pytest.approx(sigma_mm, rel=0.25)
        assert noise.source == "this scan"
        areas, depths = np.array(noise.smallest_mm).T
        assert (np.diff(areas) > 0).all()
        assert (depths > 0.16).all()  # nothing within the tolerance is ever shown


def test_too_few_points_take_the_profiles_noise_and_say_so(ball: AnalyticTemplate) -> None:
    points = sample_surface(ball.body, 8.0, seed=1)[0][:20]
    noise = detect(Scan(points, 0.07, "template"), ball).noise
    assert noise is not None
    assert noise.sigma_mm == 0.07
    assert "from the profile's, " in noise.told()
    assert "too few to tell" in noise.told()


def test_a_scan_too_noisy_for_what_is_asked_is_refused_with_what_it_could_show(
    ball: AnalyticTemplate,
) -> None:
    points, normals = sample_surface(ball.body, 0.6, seed=2)
    rng = np.random.default_rng(2)
    noisy = points + rng.normal(scale=0.3, size=(len(points), 1)) * normals
    found = detect(Scan(noisy, 0.04, "template"), ball)
    assert found.noise is not None
    area_mm2, depth_mm = min(found.noise.smallest_mm, key=lambda pair: pair[1])
    with pytest.raises(InputError, match=f"{depth_mm:.2f} mm deep over {area_mm2:.0f} mm²"):
        _refuse_too_noisy(found, 0.9 * depth_mm, Path("noisy.ply"))
    _refuse_too_noisy(found, 1.1 * depth_mm, Path("noisy.ply"))
    _refuse_too_noisy(found, None, Path("noisy.ply"))
    # and it is no empty word: a defect as deep as that all over such a window is found
    deep = np.where(np.linalg.norm(points[:, :2], axis=1) < np.sqrt(area_mm2 / 2), 2.0, 0.0)
    dented = noisy - np.where(points[:, 2] > 0, depth_mm * deep, 0.0)[:, None] * normals
    assert Label.MISSING in {r.label for r in detect(Scan(dented, 0.04, "template"), ball).regions}


def test_as_normal_is_as_rare_as_student_s_t() -> None:
    """Against scipy's own tails: Wallace's approximation, within 3 % from three degrees on."""
    freedom = np.array([3.0, 8.0, 30.0, 300.0, np.inf])
    for value in (0.5, 2.0, 5.0, 15.0):
        t = np.full((2, len(freedom)), value)
        found = as_normal(t, freedom)
        expected = norm.isf(student.sf(value, np.where(np.isfinite(freedom), freedom, 1e12)))
        assert np.allclose(found, expected, rtol=0.03)
        back = [float(as_student(z, freedom)[k]) for k, z in enumerate(found[0])]
        assert np.allclose(back, value, rtol=1e-6)
    assert as_normal(np.array([-np.inf]), freedom[:1])[0] == -np.inf


@pytest.mark.slow
def test_a_small_scan_tells_its_wander_less_surely_than_a_large_one(ball: AnalyticTemplate) -> None:
    """As places 10 mm apart, of which a ball of 30 mm has some 110 and one of 10 mm some 12."""
    small = sphere((0, 0, 0), 10.0)
    points, normals = sample_surface(small.body, SPACING_MM, seed=0)
    points = (
        points + np.random.default_rng(0).normal(scale=0.06, size=len(points))[:, None] * normals
    )
    usual = []
    for scan, part in ((Scan(points, 0.04, "template"), small), (rough(ball, 0), ball)):
        inspected = detect(scan, part).inspected
        assert inspected is not None
        usual.append(float(np.median(levels_of(inspected, RegionOptions(), None)[1].freedom)))
    assert usual[1] > 60.0
    assert usual[0] > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_defect_of_many_pieces_is_not_taken_for_errors_of_the_scan(seed: int) -> None:
    """A comb's six teeth are worn together: on tops and flanks they show in a dozen places."""
    part = box((0.0, 0.0, 0.0), (50.0, 24.0, 7.0))
    teeth = [(2.0 + 5.0 * k, 5.0 + 5.0 * k) for k in range(6)]
    for low_mm, high_mm in teeth:
        part = union(part, box((low_mm, 4.0, 6.5), (high_mm, 10.0, 15.0)))
    tool = box((-5.0, -10.0, 0.0), (55.0, 50.0, 20.0)).body.rotate((12.0, 0.0, 0.0))
    worn = part.body - tool.translate((0.0, 0.0, 13.0))
    points, _ = noisy_scan_points(worn, spacing_mm=0.2, sigma_mm=0.04, seed=seed)
    found = detect(Scan(points, 0.04, "template"), part).regions
    assert {region.label for region in found} == {Label.MISSING}
    for low_mm, high_mm in teeth:
        middle_mm = (0.5 * (low_mm + high_mm), 8.0, 14.9)
        assert any(
            bool(((middle_mm > r.box_mm[0]) & (middle_mm < r.box_mm[1] + 0.2)).all()) for r in found
        )


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_a_rough_break_at_one_place_is_not_taken_for_errors_of_the_scan(seed: int) -> None:
    # regression: two thirds of a ring's middle were gone, and nothing was told; with a point every
    # 0.4 mm and 0.1 mm of noise the break was eight peaks, more than a tail is told from
    ring = difference(cylinder((0.0, 0.0, 0.0), 5.1, 10.0), cylinder((0.0, 0.0, -1.0), 2.6, 12.0))
    rest = ring.body - box((-7.0, -2.0, 3.2), (7.0, 7.0, 7.5)).body
    points, _ = noisy_scan_points(rest, spacing_mm=0.4, sigma_mm=0.1, seed=seed)
    found = detect(Scan(points, 0.1, "template"), ring).regions
    assert {region.label for region in found} == {Label.MISSING}


def flat(value_mm: np.ndarray, cell_mm: float) -> Inspected:
    """A square face, seen as well everywhere, whose cells have these values."""
    n, count = len(value_mm), value_mm.size
    across, along = np.meshgrid(np.arange(n) * cell_mm, np.arange(n) * cell_mm, indexing="ij")
    return Inspected(
        cells=count, cell_mm=cell_mm,
        place_mm=np.column_stack([across.ravel(), along.ravel(), np.zeros(count)]),
        normal=np.tile([0.0, 0.0, 1.0], (count, 1)), value_mm=value_mm.ravel(),
        weight=np.full(count, 4.0), tolerance_mm=np.full((2, count), 0.2),
        facing=np.ones(count), pose_mm=np.zeros(count),
    )  # fmt: skip


@pytest.mark.parametrize("deep_mm", [0.3, 0.4])
def test_what_stands_out_of_a_rough_break_is_its_own_and_no_error_of_the_scan(
    deep_mm: float,
) -> None:
    # regression: two crests in the break itself counted as errors elsewhere, so that it was the
    # tail it was held against: nothing was told of one in twelve such breaks on a clean face
    rng = np.random.default_rng(2)
    value_mm = rng.normal(0.0, 0.04, (120, 120))
    rough_mm = ndimage.gaussian_filter(rng.normal(size=(16, 16)), 1.0) * 0.3 / 0.28
    value_mm[30:46, 30:46] += rough_mm - deep_mm
    levels = levels_of(flat(value_mm, 0.5), RegionOptions(), None)
    assert any(level.rejected[0].any() for level in levels)


@pytest.mark.parametrize(("deep_mm", "told"), [(0.45, False), (1.5, True)])
def test_errors_on_one_side_tell_of_those_on_the_other(deep_mm: float, told: bool) -> None:
    # regression: a side with fewer than six peaks was taken for one without outliers, whatever the
    # other side and narrower windows showed
    rng = np.random.default_rng(0)
    n, cell_mm = 120, 0.5
    value_mm = rng.normal(0.0, 0.1, (n, n))
    places = rng.permutation(25)[:13]
    for k, high_mm in zip(places, [-deep_mm, *np.linspace(0.25, 0.45, 12)], strict=True):
        row, column = 4 + 24 * (k // 5), 4 + 24 * (k % 5)
        value_mm[row : row + 4, column : column + 4] += high_mm
    inspected = flat(value_mm, cell_mm)
    missing = [level.rejected[0].any() for level in levels_of(inspected, RegionOptions(), None)[1:]]
    assert any(missing) is told


def test_few_peaks_tell_a_tail_less_surely_than_many() -> None:
    """By hand: of one peak in a scan, Lomax's tail falls to 0.05 at m k (20^(1/k) − 1)."""
    few, many = (Tail(1.0, 0.5, 1.0, told_by) for told_by in (6.0, 1e6))
    assert few.exceeded_by(0.05) == pytest.approx(1.0 + 0.5 * 6 * (20 ** (1 / 6) - 1))
    assert many.exceeded_by(0.05) == pytest.approx(1.0 + 0.5 * np.log(20), rel=1e-4)
    for tail in (few, many):
        z = np.array([tail.exceeded_by(0.01)])
        assert np.exp(tail.log_expected(z)[0]) == pytest.approx(0.01)


@pytest.mark.slow
@pytest.mark.parametrize("told_by", [6, 30])
def test_what_few_places_tell_to_lie_far_off_is_exceeded_as_often_as_it_says(told_by: int) -> None:
    """Depths of normal errors, their spread estimated from so few: 400,000 draws of it."""
    rng = np.random.default_rng(0)
    spread_mm = np.sqrt(np.square(rng.normal(0.0, 0.3, (400_000, told_by))).mean(axis=1))
    for expected in (0.5, 0.02):
        # a scan has three such places: of one in three, so many exceed what is to be exceeded
        limit_mm = [FarOff(float(s), 3.0, told_by).exceeded_by(expected) for s in spread_mm[:400]]
        per_mm = limit_mm[0] / float(spread_mm[0])
        assert limit_mm == pytest.approx((per_mm * spread_mm[:400]).tolist())
        new_mm = np.abs(rng.normal(0.0, 0.3, spread_mm.shape))
        assert 3.0 * (new_mm > per_mm * spread_mm).mean() == pytest.approx(expected, rel=0.1)
        at = FarOff(0.3, 3.0, told_by)
        limit = np.array([at.exceeded_by(expected)])
        assert np.exp(at.log_expected(limit)[0]) == pytest.approx(expected)
    assert FarOff(0.3, 0.01, told_by).exceeded_by(0.02) == 0.0  # there are fewer at all
    assert FarOff(0.0, 0.0, 0.0).exceeded_by(0.02) == 0.0


def test_what_is_seen_more_aslant_than_anything_that_told_errs_the_more() -> None:
    """Half of a plane is seen squarely, half at a third of that: the calibration knows the half."""
    rng = np.random.default_rng(0)
    across, along = np.meshgrid(np.arange(60) * 0.5, np.arange(60) * 0.5, indexing="ij")
    place_mm = np.column_stack([across.ravel(), along.ravel(), np.zeros(across.size)])
    n = len(place_mm)
    aslant = place_mm[:, 0] > 15.0
    options = RegionOptions(process_sigma_mm=0.0)
    inspected = Inspected(
        cells=n, cell_mm=0.5, place_mm=place_mm, normal=np.tile([0.0, 0.0, 1.0], (n, 1)),
        value_mm=rng.normal(0.0, 0.01, n), weight=np.full(n, 4.0),
        tolerance_mm=np.full((2, n), 0.2), facing=np.where(aslant, 0.3, 0.9), pose_mm=np.zeros(n),
    )  # fmt: skip
    known = Calibration("bench", 1, (1.5,), ((0.1,),), ((50.0,),), facing=0.9)
    for level in levels_of(inspected, options, known)[1:2]:
        far = level.scale.place_mm[:, 0] - 15.0
        squarely = level.errors.common_mm[far < -5.0]
        assert squarely == pytest.approx(0.1, rel=0.02)
        assert level.errors.common_mm[far > 5.0] == pytest.approx(0.3, rel=0.02)


def test_windows_are_what_a_plain_loop_makes_of_them() -> None:
    """Medians, third lowest and highest of every window, by brute force."""
    part = cylinder((0, 0, 0), 6.0, 5.0)
    place, normal = sample_surface(part.body, 0.6, seed=3)
    value = np.random.default_rng(3).normal(size=len(place))
    first = scales_of(place, normal, value, np.ones(len(place)), cell_mm=0.8, widest_mm=5.0)[0]
    cell = np.floor((place - place.min(axis=0)) / 0.8).astype(int)
    of = first.of_base
    index = np.zeros((len(first), 3), int)
    index[of] = cell
    for k in range(0, len(first), 37):
        beside = (np.abs(index - index[k]) <= 1).all(axis=1)
        off = first.value_mm * np.sign(first.value_mm[k]) > 0.5 * 0.8
        alike = (first.normal @ first.normal[k] > WINDOW_FACING) | (off & off[k])
        beside &= alike | (np.arange(len(first)) == k)
        ranked = np.sort(first.value_mm[beside])
        assert first.count[k] == len(ranked)
        observed = np.repeat(first.value_mm[beside], first.weight[beside].astype(int))
        assert first.median_mm[k] == pytest.approx(np.median(observed))
        if len(ranked) >= RANK:
            assert first.low_mm[k] == ranked[RANK - 1]
            assert first.high_mm[k] == ranked[-RANK]


def test_scales_do_not_mix_the_sides_of_a_thin_wall() -> None:
    wall = box((0, 0, 0), (20, 1.0, 20))
    place, normal = sample_surface(wall.body, 0.4, seed=2)
    value = np.where(place[:, 1] > 0.5, -0.3, 0.0)
    for scale in scales_of(place, normal, value, np.ones(len(place)), cell_mm=0.8, widest_mm=10.0):
        front = scale.normal[:, 1] > 0.9
        back = scale.normal[:, 1] < -0.9
        assert scale.median_mm[front] == pytest.approx(-0.3)
        assert scale.median_mm[back] == pytest.approx(0.0)


@pytest.mark.slow
def test_a_calibration_is_kept_by_name_and_read_again(
    ball: AnalyticTemplate, tmp_path: Path
) -> None:
    sound = [judged_scales(detect(rough(ball, seed), ball)) for seed in (11, 12, 13)]
    learned = calibrated("bench", sound, RegionOptions())
    learned.save(tmp_path)
    again = Calibration.load("bench", tmp_path)
    assert again == learned
    assert again.scans == 3
    assert 0.01 < again.wander_mm[0][0] < 0.2
    assert detect(rough(ball, 14), ball, calibration=again).regions == ()
    (region,) = detect(rough(ball, 15, dent_mm=1.5), ball, calibration=again).regions
    assert region.label is Label.MISSING


def test_a_calibration_that_is_not_there_names_those_that_are(tmp_path: Path) -> None:
    (tmp_path / "bench.json").write_text("{}")
    # regression: the command that is shown could not be typed
    with pytest.raises(InputError, match="--template FILE --name 'my desk''"):
        Calibration.load("my desk", tmp_path)
    with pytest.raises(InputError, match=r"no calibration is named 'desk'.*there are bench"):
        Calibration.load("desk", tmp_path)
    # regression: it said ('version') alone
    with pytest.raises(InputError, match=r"cannot be read \(it has no 'version'\); make it again"):
        Calibration.load("bench", tmp_path)
    (tmp_path / "bench.json").write_text(json.dumps({"version": 99}))
    with pytest.raises(InputError, match="another version"):
        Calibration.load("bench", tmp_path)
    for name in ("", "../x", ".x"):
        with pytest.raises(InputError, match="plain word"):
            Calibration.load(name, tmp_path)


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="false regions"):
        RegionOptions(false_regions=0.0)
    with pytest.raises(InputError, match="tolerance"):
        RegionOptions(tolerance_mm=-1.0)


@pytest.mark.slow
def test_the_promise_of_false_regions_holds_within_a_factor_of_three(
    ball: AnalyticTemplate,
) -> None:
    """0.05 are promised; 200 sound scans each of normal and of lumpy errors."""
    normal = 0
    for seed in range(200):
        points, _ = noisy_scan_points(ball.body, spacing_mm=0.6, sigma_mm=0.1, seed=seed)
        options = RegionOptions(tolerance_mm=0.02)
        normal += len(detect(Scan(points, 0.1, "template"), ball, options=options).regions)
    lumpy = sum(len(detect(rough(ball, seed), ball).regions) for seed in range(200))
    assert normal <= 0.15 * 200
    assert lumpy <= 0.15 * 200


def test_a_scan_too_sparse_to_be_judged_says_so_and_is_refused(ball: AnalyticTemplate) -> None:
    """Regression: a point every 3 mm, and "0 regions" was said of a dent 4 mm deep."""
    hollow = box((-6, -6, BALL_MM - 4), (6, 6, BALL_MM + 1))
    judged = []
    for spacing_mm in (3.2, 0.8):
        points = sample_surface(ball.body - hollow.body, spacing_mm, seed=3)[0]
        found = detect(Scan(points, 0.04, "template"), ball)
        assert found.noise is not None
        judged.append((found.noise.judged_share, len(found.regions), " ".join(found.told())))
        if found.noise.too_sparse:
            with pytest.raises(InputError, match="scan more finely"):
                _refuse_too_noisy(found, 2.0, Path("sparse.ply"))
        _refuse_too_noisy(found, None, Path("sparse.ply"))
    sparse, dense = judged
    assert sparse[0] < 0.5
    assert "of the points could be judged" in sparse[2]
    assert dense[0] > 0.95
    assert dense[1] == 1
    assert "could be judged" not in dense[2]
