"""Layers that lie aside of those below: told from layers that are thin, gone, chipped, or sound."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from amrepair.loop.layer_shift import ShiftOptions, Walls, layer_shift
from gcode.moves import Program
from gcode.reader import Job, read_job
from tests.draws import draws

LAYERS, HIGH_MM, WIDE_MM, SIDE_MM = 16, 0.2, 0.45, 20.0
NOISE_MM = 0.06
CORNER = np.array([50.0, 50.0])


def text_of_box(side_mm: float = SIDE_MM) -> str:
    """A wall of one bead around lines 4 mm apart, on a floor of two full layers."""
    text = ["G21", "G90", "M82", "G92 E0"]
    e_mm, per_mm = 0.0, WIDE_MM * HIGH_MM / (np.pi / 4 * 1.75**2)
    for layer in range(LAYERS):
        text += [";LAYER_CHANGE", f"G1 Z{HIGH_MM * (layer + 1):.3f} F600"]
        apart = WIDE_MM if layer < 2 else 4.0
        lines = [((x, 0.0), (x, side_mm)) for x in np.arange(0.5, side_mm, apart)]
        corners = [(0.0, 0.0), (side_mm, 0.0), (side_mm, side_mm), (0.0, side_mm), (0.0, 0.0)]
        for start, end in [*lines, *itertools.pairwise(corners)]:
            (x0, y0), (x1, y1) = np.add(start, CORNER), np.add(end, CORNER)
            e_mm += per_mm * float(np.hypot(x1 - x0, y1 - y0))
            text += [f"G1 X{x0:.3f} Y{y0:.3f} F6000", f"G1 X{x1:.3f} Y{y1:.3f} E{e_mm:.5f} F1200"]
    return "\n".join(text) + "\n"


@pytest.fixture(scope="module")
def box() -> tuple[Job, int]:
    text = text_of_box()
    return read_job(Program(text, "marlin"), dialect="marlin"), len(text.splitlines())


def seen_from_above(
    job: Job,
    top_of: Callable[[np.ndarray, int], np.ndarray],
    moved: Callable[[int], np.ndarray] = lambda layer: np.zeros(2),
) -> np.ndarray:
    """Points over the box and the bed around it; `top_of` says how high a layer's beads end."""
    rng, beads = np.random.default_rng(3), job.beads
    xy = rng.uniform(CORNER - 5.0, CORNER + SIDE_MM + 5.0, (9_000, 2))
    z = np.zeros(len(xy))
    for layer in range(LAYERS):
        pick = beads.layer == layer
        a, b = (ends[pick, :2] + moved(layer) for ends in (beads.start_mm, beads.end_mm))
        way = b - a
        share = np.einsum("pnk,nk->pn", xy[:, None] - a, way) / (way**2).sum(axis=1)
        foot = a + np.clip(share, 0.0, 1.0)[..., None] * way
        over = (np.linalg.norm(xy[:, None] - foot, axis=2) < 0.5 * WIDE_MM).any(axis=1)
        z = np.where(over, np.maximum(z, top_of(xy, layer)), z)
    return np.column_stack([xy, z + rng.normal(0.0, 0.03, len(z))])


def whole(xy: np.ndarray, layer: int) -> np.ndarray:
    return np.full(len(xy), HIGH_MM * (layer + 1))


def walls_of(
    off_mm: Callable[[np.ndarray, np.ndarray], np.ndarray],
    seen: slice = slice(None),
    high_mm: float = HIGH_MM * LAYERS - 0.5,
    side_mm: float = SIDE_MM,
) -> Walls:
    """Walls, of which some sides are seen up to a height, off by a function of places and ways."""
    rng, ways = np.random.default_rng(4), np.array([(1, 0), (-1, 0), (0, 1), (0, -1)], float)[seen]
    out = np.repeat(ways, 400, axis=0)
    along = rng.uniform(-0.5, 0.5, (len(out), 1)) * side_mm * out[:, ::-1]
    xy = CORNER + 0.5 * side_mm * (1.0 + out) + along
    place = np.column_stack([xy, rng.uniform(0.8, high_mm, len(xy))])
    return Walls(place, off_mm(place, out) + rng.normal(0.0, 0.05, len(out)), out, 0.13)


NO_WALLS = Walls(np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)), 0.13)
STANDS = walls_of(lambda place, out: np.zeros(len(out)))


@pytest.mark.parametrize(
    ("by_mm", "layers"),
    draws(
        [((0.5, 0.0), 1), ((0.0, -1.0), 2), ((-2.0, 2.0), 4), ((4.0, 0.0), 1), ((0.3, 0.3), 2)],
        *(((-2.0, 2.0), 4), ((0.3, 0.3), 2)),
    ),
)
def test_layers_that_lie_aside_are_told_at_once(
    box: tuple[Job, int], by_mm: tuple[float, float], layers: int
) -> None:
    # regression: a layer that had just shifted was low along its planned path, was told as
    # under-extruded until walls showed it 8 to 12 layers later, and was 'repaired' with more
    job, line = box
    first = LAYERS - layers
    moved = np.array(by_mm)
    cloud = seen_from_above(job, whole, lambda layer: moved * (layer >= first))
    low = walls_of(lambda place, out: np.zeros(len(out)), high_mm=HIGH_MM * first - 0.3)
    found = layer_shift(cloud, low, NOISE_MM, job, line)
    assert found is not None
    assert abs(found.layer - first) <= 1
    assert np.abs(np.array(found.by_mm) - by_mm).max() < 0.16  # a bead's edge is found so well


@pytest.mark.parametrize("by_mm", [(0.7, 0.7), (0.0, -2.0)])
def test_the_layers_of_a_slim_part_are_told_by_few_patches(by_mm: tuple[float, float]) -> None:
    # regression: of a clip 10 mm wide shifts of 1 to 4 mm were "repaired", since no more than a
    # score of patches told them, however clearly
    job = read_job(Program(text := text_of_box(6.0), "marlin"), dialect="marlin")
    first = LAYERS - 2
    cloud = seen_from_above(job, whole, lambda layer: np.array(by_mm) * (layer >= first))
    low = walls_of(
        lambda place, out: np.zeros(len(out)), high_mm=HIGH_MM * first - 0.3, side_mm=6.0
    )
    found = layer_shift(cloud, low, NOISE_MM, job, len(text.splitlines()))
    assert found is not None
    assert abs(found.layer - first) <= 1
    assert np.abs(np.array(found.by_mm) - by_mm).max() < 0.16


@pytest.mark.slow
def test_layers_are_no_farther_aside_than_views_are(box: tuple[Job, int]) -> None:
    # regression: of fins seen by a scanner whose views differ by 0.09 mm, as a real one's do, a
    # shift of 0.3 mm was told
    job, line = box
    cloud = seen_from_above(job, whole, lambda layer: np.array([0.35, 0.0]) * (layer >= 14))
    low = walls_of(lambda place, out: np.zeros(len(out)), high_mm=HIGH_MM * 14 - 0.3)
    assert layer_shift(cloud, low, NOISE_MM, job, line, between_views_mm=0.02) is not None
    assert layer_shift(cloud, low, NOISE_MM, job, line, between_views_mm=0.09) is None


@pytest.mark.parametrize(
    ("share", "layers"),
    draws(itertools.product([0.5, 0.0, 0.8, 1.0], [1, 4]), (0.0, 4), (0.5, 1), (0.8, 4)),
)
def test_layers_that_are_thin_or_gone_are_no_shift(
    box: tuple[Job, int], share: float, layers: int
) -> None:
    job, line = box
    first = LAYERS - layers

    def thin(xy: np.ndarray, layer: int) -> np.ndarray:
        full = np.full(len(xy), HIGH_MM * (layer + 1))
        return full - (1.0 - share) * HIGH_MM * max(layer + 1 - first, 0)

    assert layer_shift(seen_from_above(job, thin), STANDS, NOISE_MM, job, line) is None


@pytest.mark.parametrize("deep_mm", draws([0.5, 2.0, 6.0], 0.5))
def test_what_broke_off_one_side_is_no_shift(box: tuple[Job, int], deep_mm: float) -> None:
    # where the layers were moved, what is gone on one side stands out on the other
    job, line = box

    def chipped(xy: np.ndarray, layer: int) -> np.ndarray:
        gone = (xy[:, 0] < CORNER[0] + deep_mm) & (layer > LAYERS - 5)
        return np.where(gone, 0.0, HIGH_MM * (layer + 1))

    cloud = seen_from_above(job, chipped)
    broken = walls_of(lambda place, out: np.where(
        (out[:, 0] < 0.0) & (place[:, 2] > HIGH_MM * (LAYERS - 4)), -deep_mm, 0.0))  # fmt: skip
    assert layer_shift(cloud, broken, NOISE_MM, job, line) is None
    assert layer_shift(cloud, NO_WALLS, NOISE_MM, job, line) is None


@pytest.mark.parametrize("sides", draws([1, 4], 1))
def test_walls_tell_where_tops_are_as_they_should_be(box: tuple[Job, int], sides: int) -> None:
    # many layers later nothing but walls shows where the lower ones lie
    job, line = box
    above_mm, aside_mm = HIGH_MM * 8, np.array([0.6, 0.0])
    walls = walls_of(
        lambda place, out: np.where(place[:, 2] > above_mm, out @ aside_mm, 0.0), slice(sides)
    )
    cloud = seen_from_above(job, whole, lambda layer: aside_mm * (layer >= 8))
    found = layer_shift(cloud, walls, NOISE_MM, job, line, regions=False)
    assert found is not None
    assert abs(found.layer - 8) <= 1


def alike_in_patches(place: np.ndarray, seed: int) -> np.ndarray:
    """Errors of 0.3 mm that are the same all over a patch of 2 mm."""
    cell = np.floor((place - np.append(CORNER, 0.0)) / 2.0 + 1e-9)  # a face lies on its border
    _, number = np.unique(cell, axis=0, return_inverse=True)
    of_cell = np.random.default_rng(seed).normal(0.0, 0.3, number.max() + 1)
    return np.asarray(of_cell[number.reshape(-1)])


@pytest.mark.parametrize("draw", draws(range(14, 18), 17))
def test_points_that_err_alike_are_one_observation(box: tuple[Job, int], draw: int) -> None:
    # of as many observations as there are points, the last one's p-value is 1e-130
    job, line = box
    walls = walls_of(lambda place, out: alike_in_patches(place, draw))
    assert layer_shift(seen_from_above(job, whole), walls, NOISE_MM, job, line) is None


def test_a_few_points_of_one_place_tell_no_shift(box: tuple[Job, int]) -> None:
    # regression: of a belt idler's top two walls were seen, and five points of a chip in a third
    job, line = box
    walls = walls_of(lambda place, out: np.zeros(len(out)))
    walls.deviation_mm[:5] -= 0.9
    found = layer_shift(seen_from_above(job, whole), walls, NOISE_MM, job, line, regions=True)
    assert found is None


def test_a_look_that_tells_too_little_tells_nothing(box: tuple[Job, int]) -> None:
    job, line = box
    cloud = seen_from_above(job, whole)
    assert layer_shift(cloud[:0], NO_WALLS, NOISE_MM, job, line) is None
    assert layer_shift(cloud, STANDS, NOISE_MM, job, 0) is None
    few = ShiftOptions(least_patches=10_000)
    assert layer_shift(cloud, STANDS, NOISE_MM, job, line, few) is None


def test_a_shift_is_told_with_size_axis_and_layer(box: tuple[Job, int]) -> None:
    job, line = box
    cloud = seen_from_above(job, whole, lambda layer: np.array([0.0, -1.0]) * (layer >= 13))
    found = layer_shift(cloud, STANDS, NOISE_MM, job, line)
    assert found is not None
    assert found.told() == "from layer 13 on it lies aside of what is below, -1.0 mm in Y"
    assert found.size_mm == pytest.approx(1.0, abs=0.1)
    assert found.p_value < 1e-3
    assert found.confidence > 0.9
