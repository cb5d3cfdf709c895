"""Nuisances against analytic truth: found where they are, absent where they are not, and told."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import analytic
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from amrepair.errors import InputError
from amrepair.observe import Nuisance, fit_nuisance
from amrepair.observe.cells import gather, independent_share
from tests.draws import draws

SPACING_MM = 1.0
CORRELATION_MM = 2.0
NOISE_MM = 0.04  # as much again hangs together over CORRELATION_MM
TOLERANCE_MM = 0.15
Move = Callable[[np.ndarray], np.ndarray]


def correlated_noise(place_mm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """White noise and a smooth field whose correlation falls over CORRELATION_MM."""
    waves = rng.normal(0, 1 / CORRELATION_MM, (3, 400))
    phase = rng.uniform(0, 2 * np.pi, 400)
    smooth = analytic.sum_of_waves(place_mm, waves, phase) * np.sqrt(2 / 400)
    return NOISE_MM * (smooth + rng.normal(0, 1, len(place_mm)))


class Seen:
    """Sites of a template whose part was moved by `move`, by the template's own exact distance."""

    def __init__(
        self, template: analytic.AnalyticTemplate, move: Move, *, seed: int = 1, up: bool = False
    ) -> None:
        place_mm, facing = analytic.sample_surface(template.body, SPACING_MM, seed=seed)
        if up:
            place_mm, facing = place_mm[facing[:, 2] > 0.9], facing[facing[:, 2] > 0.9]
        self.noise_mm = correlated_noise(place_mm, np.random.default_rng(seed))
        moved_mm = place_mm + move(place_mm)
        self.true_mm, self.normal = template.distance_and_gradient(moved_mm)
        self.place_mm = moved_mm - self.true_mm[:, None] * self.normal  # the template's surface
        self.deviation_mm = self.true_mm + self.noise_mm
        # at edges the nearest place of the template may lie on another face than the point
        same = np.sum(self.normal * facing, axis=1) > 0.9999
        self.away_from_edges = same & (
            np.abs(self.true_mm - np.sum(facing * move(place_mm), axis=1)) < 0.005
        )
        assert self.away_from_edges.mean() > 0.9

    def fit(self, **more: object) -> Nuisance:
        return fit_nuisance(
            self.place_mm,
            self.normal,
            self.deviation_mm,
            np.ones(len(self.place_mm)),
            tolerance_mm=TOLERANCE_MM,
            correlation_mm=CORRELATION_MM,
            **more,  # type: ignore[arg-type]
        )

    def left_mm(self, found: Nuisance) -> np.ndarray:
        """True deviation that stays, away from edges."""
        left_mm = self.true_mm - found.removed_mm(self.place_mm, self.normal)
        return np.asarray(left_mm[self.away_from_edges])


def still(place_mm: np.ndarray) -> np.ndarray:
    return np.zeros_like(place_mm)


def scaled(ratio: float) -> Move:
    return lambda p: ratio * (p - p.mean(axis=0))


def bowed(sag_mm: float, length_mm: float) -> Move:
    """The middle of the first axis lies `sag_mm` lower than its ends: pure bending."""

    def move(p: np.ndarray) -> np.ndarray:
        curvature = 4 * sag_mm / length_mm**2
        z = p[:, 2] - (p[:, 2].min() + p[:, 2].max()) / 2
        along = -2 * curvature * p[:, 0] * z
        return np.column_stack([along, np.zeros(len(p)), curvature * p[:, 0] ** 2])

    return move


SPHERE = analytic.sphere((3.0, 4.0, 20.0), 20.0)
BOX = analytic.box((-30.0, -20.0, 0.0), (30.0, 20.0, 24.0))
PLATE = analytic.box((-75.0, -50.0, 0.0), (75.0, 50.0, 5.0))
BAR = analytic.box((-60.0, -8.0, 0.0), (60.0, 8.0, 8.0))


@pytest.mark.parametrize("template", [SPHERE, BOX], ids=["sphere", "box"])
@pytest.mark.parametrize("ratio", [-0.007, 0.012])
def test_a_part_of_another_size_is_told_by_its_percent(
    template: analytic.AnalyticTemplate, ratio: float
) -> None:
    seen = Seen(template, scaled(ratio))
    found = seen.fit()
    assert found.scale_ratio == pytest.approx(ratio, abs=0.0006)
    assert found.supported == ("scale",)
    word = "small" if ratio < 0 else "large"
    assert found.told() == (f"The part is {100 * abs(ratio):.1f} % {word} (prior 0.3 %).",)
    assert np.abs(seen.left_mm(found)).max() < 0.03  # the noise of the fit, and its second order


def test_what_lies_within_the_prior_is_removed_and_not_told() -> None:
    seen = Seen(BOX, scaled(-0.004))
    found = seen.fit()
    assert found.scale_ratio == pytest.approx(-0.004, abs=0.0006)
    assert found.told() == ()
    assert np.abs(seen.left_mm(found)).max() < 0.02


@pytest.mark.parametrize(
    ("template", "length_mm", "up"),
    [(PLATE, 150.0, True), (PLATE, 150.0, False), (BAR, 120.0, False)],
    ids=["one side of a plate", "a whole plate", "a bar"],
)
def test_a_bow_is_told_in_millimetres_over_its_length(
    template: analytic.AnalyticTemplate, length_mm: float, up: bool
) -> None:
    seen = Seen(template, bowed(0.6, length_mm), up=up)
    found = seen.fit()
    assert abs(found.bow_mm[1]) == pytest.approx(0.6, abs=0.04)
    assert found.supported == ("bow",)
    (told,) = found.told()
    said = re.fullmatch(r"It is bent by (\S+) mm over (\S+) mm \(prior 0.1 mm\)\.", told)
    assert said is not None, told
    assert float(said[1]) == pytest.approx(0.6, abs=0.06)
    assert float(said[2]) == pytest.approx(length_mm, abs=2)
    assert np.abs(seen.left_mm(found)).max() < 0.04


def test_scale_bow_and_pose_are_found_together() -> None:
    turn = Rotation.from_rotvec([0.002, -0.001, 0.003]).as_matrix()

    def move(p: np.ndarray) -> np.ndarray:
        bent = p + bowed(0.4, 150.0)(p) + scaled(-0.008)(p)
        return bent @ turn.T + np.array([0.1, -0.15, 0.1]) - p

    seen = Seen(PLATE, move)
    found = seen.fit()
    assert found.scale_ratio == pytest.approx(-0.008, abs=0.0005)
    assert abs(found.bow_mm[1]) == pytest.approx(0.4, abs=0.04)
    assert found.twist[3:] == pytest.approx([0.002, -0.001, 0.003], abs=0.0005)
    assert np.abs(seen.left_mm(found)).max() < 0.05


@pytest.mark.parametrize(
    "template",
    draws([SPHERE, BOX, PLATE, BAR], BAR),
    ids=["sphere", "box", "plate", "bar"],
)
def test_noise_alone_is_taken_for_nothing(template: analytic.AnalyticTemplate) -> None:
    wrong = 0
    for seed in range(8):
        seen = Seen(template, still, seed=seed)
        found = seen.fit()
        wrong += bool(found.supported)
        assert np.abs(found.removed_mm(seen.place_mm, seen.normal)).max() < 0.04
        assert found.told() == ()
    assert wrong <= 2  # at 1 % a term, more would not be chance


def dent(p: np.ndarray) -> np.ndarray:
    """2 mm deep, 14 mm wide, in the top's middle, where a bow would have its own."""
    return -2.0 * np.maximum(1 - np.hypot(p[:, 0], p[:, 1]) ** 2 / 49, 0) * (p[:, 2] > 23)


def corner(p: np.ndarray) -> np.ndarray:
    """A tenth of the surface lies 3 mm too low."""
    return -3.0 * ((p[:, 0] > 12) & (p[:, 1] > 4) & (p[:, 2] > 8))


def worn_top(p: np.ndarray) -> np.ndarray:
    """0.5 mm off 30 % of the top, at one end."""
    return -0.5 * ((p[:, 2] > 23.9) & (p[:, 0] > 12))


def thick_top(p: np.ndarray) -> np.ndarray:
    """Half of the top lies 0.6 mm too high: 12 % of the surface."""
    return 0.6 * ((p[:, 2] > 23.9) & (p[:, 1] > 0))


def test_a_worn_end_of_a_bowed_plate_is_no_bow() -> None:
    seen = Seen(PLATE, bowed(0.6, 150.0), up=True)
    gone_mm = -1.0 * (seen.place_mm[:, 0] > 30)
    seen.deviation_mm = seen.deviation_mm + gone_mm
    assert (gone_mm < 0).mean() == pytest.approx(0.3, abs=0.02)
    assert np.abs(seen.left_mm(seen.fit())).max() < 0.08  # a bow and a tilt would hide 0.75 mm


@pytest.mark.parametrize("defect", [dent, corner, worn_top, thick_top])
@pytest.mark.parametrize("ratio", draws([0.0, -0.007], -0.007))
def test_defects_keep_their_depth(defect: Move, ratio: float) -> None:
    seen = Seen(BOX, scaled(ratio))
    gone_mm = defect(seen.place_mm)
    assert (np.abs(gone_mm) > 0).mean() > 0.005
    seen.deviation_mm = seen.deviation_mm + gone_mm
    found = seen.fit()
    assert np.abs(seen.left_mm(found)).max() < 0.04  # a quarter of the tolerance
    assert found.scale_ratio == pytest.approx(ratio, abs=0.0008)
    assert found.bow_mm == pytest.approx(np.zeros(4), abs=0.03)


def test_a_block_on_a_third_of_a_plate_keeps_its_height_and_the_bow_is_found() -> None:
    seen = Seen(PLATE, bowed(0.6, 150.0), up=True)
    on = (np.abs(seen.place_mm[:, 0] + 5) < 45) & (np.abs(seen.place_mm[:, 1]) < 28)
    assert on.mean() > 0.3
    seen.deviation_mm = seen.deviation_mm + 11.0 * on
    found = seen.fit()
    assert abs(found.bow_mm[1]) == pytest.approx(0.6, abs=0.05)
    left_mm = seen.deviation_mm - seen.noise_mm - found.removed_mm(seen.place_mm, seen.normal)
    assert left_mm[on] == pytest.approx(11.0, abs=0.08)
    assert np.percentile(np.abs(left_mm[~on]), 99) < 0.08


@pytest.mark.parametrize("gone_mm", draws([1.0, 1.6, 3.0], 1.6))
def test_a_plate_that_stopped_early_is_not_bent(gone_mm: float) -> None:
    # regression: of a flat part that stands on its bed most of what is seen lies too low, and was
    # taken for noise of 0.4 mm and a bow of 0.7 mm
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0.5, 53), np.arange(0.5, 30)))
    tops = np.column_stack([x, y, np.full(len(x), 8.0)])[(x // 10) % 2 == 0]
    along, up = (each.ravel() for each in np.meshgrid(np.arange(0.5, 53), np.arange(0.5, 6)))
    walls = [np.column_stack([along, np.full(len(along), at), up]) for at in (0.0, 30.0)]
    place_mm = np.concatenate([tops, *walls])
    normal = np.repeat([[0, 0, 1.0], [0, -1.0, 0], [0, 1.0, 0]], list(map(len, (tops, *walls))), 0)
    deviation_mm = np.where(normal[:, 2] > 0.0, -gone_mm, 0.0)
    deviation_mm += correlated_noise(place_mm, np.random.default_rng(2))
    found = fit_nuisance(
        place_mm, normal, deviation_mm, np.ones(len(place_mm)), tolerance_mm=TOLERANCE_MM,
        correlation_mm=CORRELATION_MM, pose_known=True,
    )  # fmt: skip
    assert not found.bow_mm.any()
    assert found.sigma_mm < TOLERANCE_MM


def test_views_are_told_apart() -> None:
    seen = Seen(BOX, scaled(-0.007))
    rng = np.random.default_rng(3)
    view = np.argmax(
        seen.normal @ np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]]).T
        + rng.uniform(0, 2.5, (len(seen.normal), 4)),
        axis=1,
    )  # each sees its side, and they overlap
    offset_mm = np.array([0.0, 0.3, -0.1, 0.0])
    seen.deviation_mm = seen.deviation_mm + offset_mm[view]
    found = seen.fit(view=view)
    assert found.view_offset_mm - np.median(found.view_offset_mm) == pytest.approx(
        offset_mm - np.median(offset_mm), abs=0.03
    )
    assert found.scale_ratio == pytest.approx(-0.007, abs=0.002)
    assert "View 2 lies 0.3" in " ".join(found.told())
    assert "small" in " ".join(found.told())
    wrong_mm = found.removed_mm(seen.place_mm, seen.normal, view) - seen.true_mm - offset_mm[view]
    assert np.percentile(np.abs(wrong_mm), 99) < 0.03
    two = view < 2
    pair = fit_nuisance(
        seen.place_mm[two], seen.normal[two], seen.deviation_mm[two], np.ones(int(two.sum())),
        view=view[two], tolerance_mm=TOLERANCE_MM, correlation_mm=CORRELATION_MM,
    )  # fmt: skip
    assert any(said.startswith("View 2 lies 0.") and "view 1" in said for said in pair.told())


def test_what_views_share_on_a_ball_is_its_size() -> None:
    seen = Seen(SPHERE, scaled(-0.007))
    view = (seen.normal[:, 0] > 0).astype(np.int64)
    found = seen.fit(view=view)
    assert found.supported == ("scale",)
    assert found.scale_ratio == pytest.approx(-0.007, abs=0.0006)


def test_one_side_seen_by_one_view_is_explained_by_the_sum() -> None:
    seen = Seen(PLATE, lambda p: np.tile([0.0, 0.0, 0.12], (len(p), 1)), up=True)
    found = seen.fit(view=np.zeros(len(seen.place_mm), np.int64))
    assert np.abs(seen.left_mm(found)).max() < 0.02
    assert found.view_offset_mm.shape == (1,)


@pytest.mark.slow
def test_a_part_laid_elsewhere_answers_the_same() -> None:
    seen = Seen(PLATE, lambda p: bowed(0.6, 150.0)(p) + scaled(-0.006)(p))
    found = seen.fit()
    turn = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix()
    shift_mm = np.array([500.0, -80.0, 33.0])
    place_mm, normal = seen.place_mm @ turn.T + shift_mm, seen.normal @ turn.T
    again = fit_nuisance(
        place_mm, normal, seen.deviation_mm, np.ones(len(normal)),
        tolerance_mm=TOLERANCE_MM, correlation_mm=CORRELATION_MM,
    )  # fmt: skip
    # cells lie otherwise in the turned part: they differ by the noise of the fit, no more
    assert again.removed_mm(place_mm, normal) == pytest.approx(
        found.removed_mm(seen.place_mm, seen.normal), abs=0.03
    )
    assert again.scale_ratio == pytest.approx(found.scale_ratio, abs=3e-4)
    assert np.abs(again.bow_mm) == pytest.approx(np.abs(found.bow_mm), abs=0.02)
    assert again.frame.half_extent_mm == pytest.approx(found.frame.half_extent_mm, abs=1.0)


@pytest.mark.slow
def test_the_standard_error_is_as_large_as_the_error() -> None:
    off = []
    for seed in range(12):
        found = Seen(BOX, scaled(-0.007), seed=seed).fit()
        off.append((found.scale_ratio + 0.007) / np.sqrt(found.covariance[6, 6]))
    assert 0.3 < np.sqrt(np.mean(np.square(off))) < 2.0  # 1 in truth; twelve draws and blocks


def test_the_result_is_plain_numbers() -> None:
    found = Seen(BOX, scaled(-0.007)).fit()
    said = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert said["told"] == list(found.told())
    assert said["scale_ratio"] == found.scale_ratio


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_sites_do_not_break_it(count: int) -> None:
    place_mm = np.arange(3.0 * count).reshape(count, 3)
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    found = fit_nuisance(
        place_mm, normal, np.full(count, 0.05), np.ones(count), tolerance_mm=0.1, correlation_mm=1.0
    )
    assert found.supported == ()
    assert np.abs(found.removed_mm(place_mm, normal)).max() < 0.1


def test_a_part_that_may_not_deviate_at_all_is_refused() -> None:
    one = np.ones(4)
    with pytest.raises(InputError, match="must be above zero"):
        fit_nuisance(np.eye(4, 3), np.eye(4, 3), one, one, tolerance_mm=0.0, correlation_mm=1.0)


@pytest.mark.slow
def test_a_real_plate_is_told_to_be_bent_and_what_stands_on_it_keeps_its_height(
    data_dir: Path,
) -> None:
    if not (data_dir / "real" / "plate" / "plate.xyz").is_file():
        pytest.skip("the scan of the plate is not among the data")
    source = Path(__file__).parents[2] / "benchmarks" / "plate_case.py"
    spec = importlib.util.spec_from_file_location("plate_case", source)
    assert spec is not None
    assert spec.loader is not None
    plate_case = importlib.util.module_from_spec(spec)
    sys.modules["plate_case"] = plate_case
    spec.loader.exec_module(plate_case)
    said = plate_case.case(data_dir, [0.3])
    assert "metres" in said["unit"]
    found = said["tolerance 0.3 mm"]
    assert 0.2 < found["nuisance"]["flatness_mm"] < 0.32
    assert any("It is bent by 0.2" in told for told in found["nuisance"]["told"])
    middle = {name: found[name]["local_medians_mm"]["50 %"] for name in ("before", "after")}
    assert middle["after"] < middle["before"] / 2
    (sink,) = found["after"]["regions_on_bare_plate"]  # it is there: 0.5 mm deep round a pit
    assert sink["deviation_mm"] == pytest.approx(-0.55, abs=0.1)
    height_mm = found["height_above_the_plate_beside_it_mm"]
    assert height_mm["after"] == pytest.approx(height_mm["before"], abs=0.1)


@pytest.mark.parametrize(("weight", "said"), [((1, 1), 1.5), ((1, 3), 2.0), ((3, 1), 1.0)])
def test_a_cell_says_the_middle_of_its_sites(weight: tuple[int, int], said: float) -> None:
    """The lower of two made every part 0.02 mm smaller than it was."""
    place_mm = np.array([[0.1, 0.1, 0.0], [0.2, 0.1, 0.0], [5.1, 0.1, 0.0], [5.2, 0.1, 0.0]])
    cells = gather(
        place_mm,
        np.tile([0.0, 0.0, 1.0], (4, 1)),
        np.array([2.0, 1.0, 12.0, 11.0]),
        np.array([*weight[::-1], *weight[::-1]], float),
        np.zeros(4, np.int64),
        side_mm=1.0,
        correlation_mm=0.0,
    )
    assert cells.deviation_mm == pytest.approx([said, 10 + said])
    assert cells.share == pytest.approx([1.0, 1.0])


def test_a_crowd_counts_for_its_area_and_not_for_its_number() -> None:
    rng = np.random.default_rng(5)
    place_mm = np.column_stack([rng.uniform(0, 100, (6_000, 2)), np.zeros(6_000)])
    view = np.zeros(6_000, np.int64)
    dense = independent_share(place_mm, view, 2.0).sum()
    thin = independent_share(place_mm[:3_000], view[:3_000], 2.0).sum()
    expected = 100**2 / (2 * np.pi * 2.0**2)  # the integral of exp(−r/L) over the plane is 2πL²
    assert dense == pytest.approx(expected, rel=0.35)  # cut off at 3 L, and at the edges
    assert dense / thin < 1.1
    two = independent_share(np.r_[place_mm, place_mm], np.repeat([0, 1], 6_000), 2.0)
    assert two.sum() == pytest.approx(2 * dense)  # another view's errors are its own
