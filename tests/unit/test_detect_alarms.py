"""What detection calls a defect: no more of the noise than it states, the bed not, bulges below."""

from __future__ import annotations

import numpy as np
import pytest

from amrepair.arrays import Points, Values
from amrepair.field.fused import estimate_spacing
from amrepair.regions import Label, detect
from amrepair.regions.error_calibration import NORMAL_BY_BED, NORMAL_NOISE
from amrepair.regions.observation import observed
from amrepair.regions.options import RegionOptions
from amrepair.scans import Scan
from tests.analytic import box, cylinder, difference, sample_surface, sum_of_waves
from tests.draws import draws

SIGMA_MM = 0.05


def alarms(false_alarms: float, scans: int, threshold_mm: float | None) -> float:
    """Regions that a clean scan has on average."""
    part = difference(box((0, 0, 0), (24, 16, 6)), cylinder((12, 8, -1), 4.0, 8.0))
    points = sample_surface(part.body, 0.3, seed=1)[0]
    found = 0
    for seed in range(scans):
        noise = np.random.default_rng(seed).normal(0, SIGMA_MM, points.shape)
        scan = Scan(points + noise, SIGMA_MM, "template")
        options = RegionOptions(false_regions=false_alarms, tolerance_mm=threshold_mm)
        found += len(detect(scan, part, options=options).regions)
    return found / scans


# Nothing systematic is left to the process here: noise alone, so that alarms can be counted.
@pytest.mark.parametrize("stated", draws([3.0, 30.0], 30.0))
def test_noise_raises_no_more_alarms_than_stated(stated: float) -> None:
    assert alarms(stated, 4, 1e-6) <= stated


def test_the_rate_is_what_sets_the_limit() -> None:
    assert alarms(1e-3, 2, 1e-6) == 0.0
    assert alarms(300.0, 2, 1e-6) > 0.0  # so noise can raise alarms, and the limit holds them back
    assert alarms(300.0, 1, None) == 0.0  # the process's allowance is far above this noise


def on_bed(bulge_mm: float, *, seen_from_below: bool) -> Scan:
    """A plate of 40 × 30 × 6 mm whose foot sags in a spot; on a bed unless seen from below."""
    plate = box((0, 0, 0), (40, 30, 6))
    points = sample_surface(plate.body, 0.4, seed=2)[0]
    below = points[:, 2] < 1e-6
    if seen_from_below:
        radius = np.linalg.norm(points[:, :2] - (20, 15), axis=1)
        points[below, 2] -= bulge_mm * np.exp(-((radius[below] / 4.0) ** 2))
    else:
        bed = np.random.default_rng(3).uniform((-15, -15), (55, 45), (30_000, 2))
        outside = (bed < (0, 0)).any(axis=1) | (bed > (40, 30)).any(axis=1)
        flat = np.column_stack([bed[outside], np.full(int(outside.sum()), -0.05)])
        points = np.concatenate([points[~below], flat])
    noise = np.random.default_rng(4).normal(0, SIGMA_MM, points.shape)
    return Scan(points + noise, SIGMA_MM, "template")


@pytest.mark.parametrize("bulge_mm", [0.6, 2.5])
def test_what_bulges_from_the_underside_is_no_bed(bulge_mm: float) -> None:
    # regression: everything at and below the lowest plane was taken for the bed
    plate = box((0, 0, 0), (40, 30, 6))
    scan = on_bed(bulge_mm, seen_from_below=True)
    found = detect(scan, plate)
    assert [region.label for region in found.regions] == [Label.EXCESS]
    assert found.regions[0].depth_mm == pytest.approx(bulge_mm, rel=0.25)
    deep = found.deviation_mm > 0.4
    assert (found.label[deep] == int(Label.EXCESS)).mean() > 0.95
    assert detect(on_bed(0.0, seen_from_below=True), plate).regions == ()


def test_a_bed_around_the_part_is_no_excess() -> None:
    assert detect(on_bed(0.0, seen_from_below=False), box((0, 0, 0), (40, 30, 6))).regions == ()


def with_strays(scan: Scan, count: int, seed: int) -> Scan:
    """The scan, and so many single points in the air over the bed beside the part, not by y 15."""
    rng = np.random.default_rng(seed)
    strays = rng.uniform((-14.0, -14.0, 0.4), (-1.0, 36.0, 1.6), (count, 3))
    strays[strays[:, 1] > 11.0, 1] += 8.0
    return Scan(np.concatenate([scan.points_mm, strays]), SIGMA_MM, "template")


@pytest.mark.parametrize("seed", range(3))
def test_points_that_stray_in_the_air_are_no_surface(seed: int) -> None:
    # regression: a laser line's strays fell into one wide window by and by, and were 20 mm³ of
    # excess beside a sound part
    plate, bare = box((0, 0, 0), (40, 30, 6)), on_bed(0.0, seen_from_below=False)
    strayed = with_strays(bare, 27, seed)
    assert detect(strayed, plate, calibration=NORMAL_NOISE).regions == ()
    # a crumb of 1.5 mm among them is one
    turn, up = np.random.default_rng(seed).uniform((0, 0), (2 * np.pi, 1), (60, 2)).T
    flat = np.sqrt(1.0 - up**2)
    crumb = 0.75 * np.column_stack([flat * np.cos(turn), flat * np.sin(turn), up]) + (-7, 15, 0.2)
    both = Scan(np.concatenate([strayed.points_mm, crumb]), SIGMA_MM, "template")
    (found,) = detect(both, plate, calibration=NORMAL_NOISE).regions
    assert (np.abs(found.box_mm.mean(axis=0)[:2] - (-7, 15)) < 1.0).all()


def beside_it(low_mm: float) -> np.ndarray:
    """(n, 3) another plate on the bed, 20 mm wide, whose near side lies at x = 40 + `low_mm`."""
    shown, normals = sample_surface(box((0, 0, 0), (20, 30, 6)).body, 0.4, seed=5)
    return shown[normals[:, 2] > -0.5] + (40.0 + low_mm, 0.0, 0.0)


@pytest.mark.parametrize("away_mm", [2.0, 8.0])
def test_a_copy_beside_the_part_is_another_piece(away_mm: float) -> None:
    # regression: of a copy 10 mm away the near side was 87 mm³ of excess, 12 mm deep, as far as
    # excess is looked for
    plate, bare = box((0, 0, 0), (40, 30, 6)), on_bed(0.0, seen_from_below=False)
    two = np.concatenate([bare.points_mm, beside_it(away_mm)])
    assert detect(Scan(two, SIGMA_MM, "template"), plate).regions == ()


def test_what_touches_the_part_is_excess_however_far_it_goes_on() -> None:
    plate, bare = box((0, 0, 0), (40, 30, 6)), on_bed(0.0, seen_from_below=False)
    grown = np.concatenate([bare.points_mm, beside_it(0.0)])
    (found,) = detect(Scan(grown, SIGMA_MM, "template"), plate).regions
    assert found.label == Label.EXCESS
    assert found.box_mm[1, 0] > 50.0


def strand(noise_mm: float, high_mm: float, seed: int) -> Scan:
    """A plate of 24 × 20 × 3 mm over which a strand 0.8 mm wide and 12 mm long lies askew."""
    rng = np.random.default_rng(seed)
    plate = box((0, 0, 0), (24, 20, 3))
    points, normals = sample_surface(plate.body, 0.25, seed=seed)
    angle = rng.uniform(0, np.pi)
    along = np.array([np.cos(angle), np.sin(angle)])
    from_middle = points[:, :2] - (12, 10)
    beside = from_middle @ (-along[1], along[0]) / 0.4
    on = (normals[:, 2] > 0.9) & (np.abs(from_middle @ along) < 6.0)
    points[on, 2] += high_mm * np.sqrt(np.maximum(1 - beside[on] ** 2, 0.0))
    points += rng.normal(0, noise_mm, (len(points), 1)) * normals
    return Scan(points, noise_mm, "template", normals)


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))]
)
def test_a_strand_is_told_at_twice_the_noise(seed: int) -> None:
    # regression: averaged over a window wider than itself it was lost in every fourth scan
    plate = box((0, 0, 0), (24, 20, 3))
    bare = detect(strand(0.2, 0.0, seed), plate, calibration=NORMAL_NOISE)
    assert bare.regions == ()
    # regression: of cells that noise fills in two layers the pose heard the fuller layer alone, and
    # laid the plate 0.08 mm, six standard errors, too high
    assert bare.nuisance is not None
    assert abs(bare.nuisance.twist[2]) < 3.0 * np.sqrt(bare.nuisance.covariance[2, 2])
    found = detect(strand(0.2, 0.5, seed), plate, calibration=NORMAL_NOISE).regions
    assert {region.label for region in found} == {Label.EXCESS}
    boxes = np.array([region.box_mm for region in found])
    middle = 0.5 * (boxes[:, 0].min(axis=0) + boxes[:, 1].max(axis=0))
    assert np.abs(middle[:2] - (12, 10)).max() < 1.5
    assert np.linalg.norm(np.ptp(boxes.reshape(-1, 3), axis=0)[:2]) > 8.0


def test_a_strand_that_the_job_lays_is_nothing_too_much() -> None:
    # regression: narrow parts of what a support leaves beside a part were told as strands, though
    # nothing that is seen on a support is evidence of the part
    plate, lies = box((0, 0, 0), (24, 20, 3)), strand(0.02, 0.5, 0)

    def as_laid(place_mm: Points, deviation_mm: Values) -> Values:
        return np.maximum(deviation_mm, 0.0)

    assert detect(lies, plate, calibration=NORMAL_NOISE).regions != ()
    assert detect(lies, plate, calibration=NORMAL_NOISE, off_by_job=as_laid).regions == ()


@pytest.mark.parametrize(("gone_mm", "floor_mm"), [(0.3, 10.0), (5.0, 10.0), (5.0, 3.0)])
def test_a_ray_past_an_edge_counts_by_how_deep_it_passed_not_how_far_it_saw(
    gone_mm: float, floor_mm: float
) -> None:
    # regression: a part 0.1 mm too short lacked as much as the floor lies below its edge
    plate = box((0, 0, 0), (12, 10, 4))
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-4, 12, 0.1), np.arange(0.05, 10, 0.1)))
    high = np.where(x < gone_mm, -floor_mm, 4.0)
    points = np.column_stack([x, y, high])
    sensor = np.array([[6.0, 5.0, 3000.0]])
    scan = Scan(
        points, 0.01, "template", sensors_mm=sensor,
        sensor_index=np.zeros(len(points), np.int64),
    )  # fmt: skip
    seen = observed(scan, plate, RegionOptions(), None, None, ())
    side = np.abs(seen.surface_mm[seen.crossed.which, 0]) < 1e-6
    assert side.sum() > 20
    # a pixel holds 0.1 mm, and its neighbours are asked too
    assert seen.crossed.depth_mm[side].max() < gone_mm + 0.05
    assert np.median(seen.crossed.depth_mm[side]) > gone_mm - 0.35


def bar_on_bed(curl_mm: float, low_mm: float, dent_mm: float, seed: int) -> Scan:
    """A bar of 120 × 24 × 8 mm whose ends curl up, or whose top is low, on a bed; maybe a dent."""
    points = sample_surface(box((0, 0, 0), (120, 24, 8)).body, 0.4, seed=2)[0]
    points = points[points[:, 2] > 1e-6]
    top = points[:, 2] > 8.0 - 1e-6
    radius = np.linalg.norm(points[:, :2] - (100, 12), axis=1)
    points[:, 2] += curl_mm * ((points[:, 0] - 60.0) / 60.0) ** 2
    points[top, 2] -= low_mm + dent_mm * (radius[top] < 4.0)
    bed = np.random.default_rng(3).uniform((-15, -15), (135, 39), (30_000, 2))
    outside = (bed < (0, 0)).any(axis=1) | (bed > (120, 24)).any(axis=1)
    flat = np.column_stack([bed[outside], np.full(int(outside.sum()), -0.05)])
    points = np.concatenate([points, flat])
    noise = np.random.default_rng(seed).normal(0, SIGMA_MM, points.shape)
    return Scan(points + noise, SIGMA_MM, "template")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_ends_that_curl_are_nothing_too_much_and_a_layer_that_lacks_is_missing(seed: int) -> None:
    # regression: the ends of a clean plate of 158 mm, which had curled by 0.15 mm, were told as
    # 76 mm³ too much in a job's last look; a pose, which would explain them, would also have taken
    # out a whole layer that is not there
    bar = box((0, 0, 0), (120, 24, 8))

    def found(scan: Scan) -> list[Label]:
        anomaly = detect(scan, bar, calibration=NORMAL_NOISE, pose="stands")
        return [region.label for region in anomaly.regions]

    assert found(bar_on_bed(0.25, 0.0, 0.0, seed)) == []
    assert found(bar_on_bed(0.25, 0.0, 0.8, seed)) == [Label.MISSING]
    assert Label.MISSING in found(bar_on_bed(0.0, 0.3, 0.0, seed))
    told = detect(bar_on_bed(0.25, 0.0, 0.0, seed), bar, calibration=NORMAL_NOISE, pose="told")
    assert {region.label for region in told.regions} == {Label.EXCESS}


def wavering(points_mm: np.ndarray, sigma_mm: float, length_mm: float, seed: int) -> np.ndarray:
    """(n,) errors that hang together over a length, as a real scanner's do."""
    rng = np.random.default_rng(seed)
    ways = rng.normal(0.0, 1.0 / length_mm, (200, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, 200)
    return sigma_mm * np.sqrt(2.0 / 200.0) * sum_of_waves(points_mm, ways.T, phase)


@pytest.mark.parametrize("seed", range(2))
def test_a_bed_that_a_real_scanner_sees_is_no_excess(seed: int) -> None:
    # regression: with the recorded noise of a real scanner, points of the bed that stood out of
    # its band were up to 24 mm³ too much beside a sound part; a lump on the bed is
    plate, scan = box((0, 0, 0), (40, 30, 6)), on_bed(0.0, seen_from_below=False)
    points = scan.points_mm.copy()
    low, rng = points[:, 2] < 0.3, np.random.default_rng(seed)
    tail = np.where(rng.random(len(points)) < 0.02, rng.uniform(-0.9, 0.9, len(points)), 0.0)
    points[low, 2] += (wavering(points, 0.1, 4.0, seed) + tail)[low]
    assert detect(Scan(points, SIGMA_MM, "template"), plate, calibration=NORMAL_NOISE).regions == ()
    lump = sample_surface(box((-9, 12, 0), (-5, 16, 2)).body, 0.3, seed=1)[0]
    both = Scan(np.concatenate([points, lump]), SIGMA_MM, "template")
    found = detect(both, plate, calibration=NORMAL_NOISE).regions
    assert {region.label for region in found} == {Label.EXCESS}
    assert all((np.abs(r.box_mm.mean(axis=0)[:2] - (-7, 14)) < 2.0).all() for r in found)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_noise_that_is_not_normal_says_so_itself(seed: int) -> None:
    # regression: looks of a job are judged by normal noise until its first layers have told more;
    # with a real scanner's errors each showed 20 to 60 regions, so that no layer was ever clean
    plate = box((0, 0, 0), (60, 40, 6))
    points = sample_surface(plate.body, 0.3, seed=2)[0]
    white = np.random.default_rng(seed).normal(0.0, 0.03, points.shape)
    quiet = detect(Scan(points + white, 0.03, "template"), plate, calibration=NORMAL_NOISE)
    assert (quiet.regions, quiet.calibration, quiet.told_over_mm(0.1)) == ((), NORMAL_NOISE, 0.0)
    _, gradient = plate.distance_and_gradient(points)
    errors = wavering(points, 0.12, 2.0, seed)[:, None] * gradient
    loud = detect(Scan(points + white + errors, 0.03, "template"), plate, calibration=NORMAL_NOISE)
    assert (loud.calibration, loud.told_over_mm(0.1)) == (None, np.inf)
    assert len(loud.regions) <= 1


@pytest.mark.slow
def test_strands_that_hang_are_no_errors_where_the_bed_shows_none() -> None:
    # regression: strands of an infill laid with half of their plastic lie too low, and hang out
    # below where they were planned: low and high in a dozen places, they were taken for errors of
    # the scanner, though the bed beside the part showed none
    plate = box((0, 0, 0), (60, 40, 6))
    points = sample_surface(plate.body, 0.3, seed=2)[0]
    white = np.random.default_rng(0).normal(0.0, 0.03, points.shape)
    off = np.zeros(len(points))
    for k, x in enumerate(np.linspace(6.0, 54.0, 9)):
        top, bottom = points[:, 2] > 5.9, points[:, 2] < 0.1
        near = (np.abs(points[:, 0] - x) < 1.2) & (np.abs(points[:, 1] - 8.0 - 3.0 * k) < 2.0)
        off += np.where(near & (top | bottom), np.where(top, -0.35, 0.35), 0.0)
    _, gradient = plate.distance_and_gradient(points)
    scan = Scan(points + white + off[:, None] * gradient, 0.03, "template")
    taken_for_errors = detect(scan, plate, calibration=NORMAL_NOISE)
    told = detect(scan, plate, calibration=NORMAL_BY_BED)
    assert taken_for_errors.calibration is None
    assert told.calibration is NORMAL_BY_BED
    low = [region for region in told.regions if region.label is Label.MISSING]
    assert len(low) == 9


def test_strays_in_the_air_are_no_area() -> None:
    # regression: each of a scan's strays in mid-air (up to one point in fifty) counted as a square
    # millimetre of surface, so that cells were twice as wide and strays filled them: the loop ended
    # seven of ten clean jobs, for blobs of 50 to 300 mm³ in the air
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(0.0, 30.0, (40_000, 2)), np.zeros(40_000)])
    bare_mm = estimate_spacing(plane)
    strays = rng.uniform((-5.0, -5.0, 0.0), (35.0, 35.0, 20.0), (800, 3))
    assert estimate_spacing(np.concatenate([plane, strays])) == pytest.approx(bare_mm, rel=0.05)
