"""Where a job's own beads put a surface: by volume in overfull layers, else by place."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float
from scipy.ndimage import uniform_filter

from amrepair.errors import TemplateError
from amrepair.frames import rotation_from_vector
from amrepair.template import KeptFills, LaidBeads, LaidOptions, laid_kernels

LAYER_MM, SPACING_MM, LONG_MM = 0.2, 0.45, 30.0
# Cells of 0.2 mm, and grooves averaged over three of them, tell an edge to a tenth of a cell.
CELL_ERROR_MM = 0.03
NO_WANDER = LaidOptions(flow_ratio=0.0)


def laid(
    lines: int, *, fill: float = 1.0, layers: int = 5, options: LaidOptions = NO_WANDER,
    skip: tuple[int, ...] = (), turn_rad: float = 0.0,
) -> LaidBeads:  # fmt: skip
    """Parallel lines along X that fill a wall of `lines` spacings from y = 0, or more than fill."""
    start, end, layer = [], [], []
    for k in range(layers):
        for n in range(lines):
            if n in skip:
                continue
            y, z = (n + 0.5) * SPACING_MM, (k + 1) * LAYER_MM
            start.append((0.0, y, z))
            end.append((LONG_MM, y, z))
            layer.append(k)
    turn = rotation_from_vector(np.array([0.0, 0.0, turn_rad]))
    count = len(layer)
    return LaidBeads.from_beads(
        np.array(start) @ turn.T, np.array(end) @ turn.T,
        np.full(count, fill * SPACING_MM * LAYER_MM), np.full(count, LAYER_MM),
        np.array(layer), options=options,
    )  # fmt: skip


def along_wall(y: float, out: float, z: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places on a wall at y that faces ±Y, and no deviation."""
    x = np.linspace(6.0, 24.0, 40)
    place = np.column_stack([x, np.full(40, y), np.full(40, z)])
    return place, np.tile([0.0, out, 0.0], (40, 1)), np.zeros(40)


def test_what_just_fills_its_room_is_expected_where_the_drawing_is() -> None:
    beads = laid(8)
    for y, out in ((0.0, -1.0), (8 * SPACING_MM, 1.0)):
        low, high = beads.interval(*along_wall(y, out))
        assert np.abs(low).max() < CELL_ERROR_MM
        assert np.abs(high).max() < CELL_ERROR_MM
    top = np.column_stack([np.linspace(6, 24, 40), np.full(40, 1.8), np.full(40, 1.0)])
    low, high = beads.interval(top, np.tile([0.0, 0.0, 1.0], (40, 1)), np.zeros(40))
    assert np.abs(low).max() < 0.1 * LAYER_MM
    assert np.abs(high).max() < 0.1 * LAYER_MM


@pytest.mark.parametrize("fill", [1.04, 1.08])
def test_plastic_without_room_pushes_a_wall_by_its_volume(fill: float) -> None:
    """Either wall may get all of it: excess section over the layer's height."""
    lines = 4
    spare_mm = (fill - 1.0) * lines * SPACING_MM
    for y, out in ((0.0, -1.0), (lines * SPACING_MM, 1.0)):
        offset, tolerance = laid(lines, fill=fill).expected_offset_mm(*along_wall(y, out))
        assert (offset + tolerance).mean() == pytest.approx(spare_mm, abs=CELL_ERROR_MM)
        assert (offset - tolerance).mean() == pytest.approx(0.0, abs=CELL_ERROR_MM)


def test_a_supported_bead_gives_way_by_half_its_width_and_a_free_strand_by_all_of_it() -> None:
    fill, lines = 1.5, 8  # as a bridge's strands are laid; 1.8 mm of it would find no room
    width_mm = fill * SPACING_MM
    _, held = laid(lines, fill=fill).interval(*along_wall(0.0, -1.0))
    _, free = laid(lines, fill=fill, layers=1).interval(*along_wall(0.0, -1.0, z=0.1))
    over_mm = 0.5 * (width_mm - SPACING_MM)  # the outermost bead's own edge
    assert np.abs(held - over_mm - 0.5 * width_mm).max() < 0.1
    # the first layer lies on the bed; a layer over nothing does not
    assert np.abs(free - over_mm - 0.5 * width_mm).max() < 0.1
    bridge = laid(lines, fill=fill, layers=2)
    gap = LaidBeads.from_beads(
        np.concatenate([bridge.start_mm[:1] - [0, 20, 0], bridge.start_mm[8:]]),
        np.concatenate([bridge.end_mm[:1] - [0, 20, 0], bridge.end_mm[8:]]),
        bridge.section_mm2[7:], bridge.height_mm[7:], np.array([0] + [1] * 8), options=NO_WANDER,
    )  # fmt: skip
    _, hung = gap.interval(*along_wall(0.0, -1.0, z=0.3))
    assert hung.min() > held.max() + 0.3 * width_mm


def test_open_infill_pushes_no_wall() -> None:
    skip = tuple(n for n in range(2, 30) if n % 6)
    low, high = laid(32, fill=1.0, skip=skip).interval(*along_wall(0.0, -1.0))
    assert np.abs(high).max() < CELL_ERROR_MM
    assert np.abs(low).max() < CELL_ERROR_MM


@pytest.mark.parametrize("drawn_mm", [0.91, 1.0, 1.09])
def test_a_top_lies_where_its_layer_was_rounded_to(drawn_mm: float) -> None:
    """A slicer cuts in the middle of layers: tops of 0.91 to 1.09 mm are all printed to 1.0."""
    seen = np.column_stack([np.linspace(6, 24, 40), np.full(40, 1.8), np.full(40, 1.0)])
    deviation = np.full(40, 1.0 - drawn_mm)
    low, high = laid(8).interval(seen, np.tile([0.0, 0.0, 1.0], (40, 1)), deviation)
    assert low == pytest.approx(1.0 - drawn_mm, abs=0.02)
    assert high == pytest.approx(1.0 - drawn_mm, abs=0.02)


def test_what_the_job_leaves_out_is_expected_to_be_missing() -> None:
    low, _ = laid(8, skip=(0, 1)).interval(*along_wall(0.0, -1.0))
    assert low == pytest.approx(-2 * SPACING_MM, abs=0.15)
    # a thin line of its own is there, all the same
    thin = laid(1, fill=0.5).interval(*along_wall(0.25 * SPACING_MM, -1.0))
    assert np.abs(thin[0]).max() < 0.15
    # a fin beside the part that is thinner than a bead: nothing of it is laid
    low, _ = laid(8).interval(*along_wall(10.0, -1.0))
    assert (low == -NO_WANDER.reach_mm).all()


def test_the_expectation_turns_with_the_job() -> None:
    place, normal, deviation = along_wall(4 * SPACING_MM, 1.0)
    turn = rotation_from_vector(np.array([0.0, 0.0, 0.6]))
    one = laid(4, fill=1.06).interval(place, normal, deviation)
    other = laid(4, fill=1.06, turn_rad=0.6).interval(place @ turn.T, normal @ turn.T, deviation)
    for a, b in zip(one, other, strict=True):
        assert np.abs(a - b).max() < 2 * CELL_ERROR_MM


def test_the_surface_is_where_the_deviation_says_not_where_the_point_is() -> None:
    place, normal, zero = along_wall(4 * SPACING_MM, 1.0)
    beads = laid(4, fill=1.06)
    far: Float[np.ndarray, " n"] = np.full(len(place), 0.4)
    near_off = (
        beads.interval(place, normal, zero),
        beads.interval(place + 0.4 * normal, normal, far),
    )
    for near, off in zip(*near_off, strict=True):
        assert np.abs(near - off).max() < 1e-9


def test_no_beads_are_refused() -> None:
    none = np.empty((0, 3))
    with pytest.raises(TemplateError, match="no beads"):
        LaidBeads.from_beads(none, none, np.empty(0), np.empty(0), np.empty(0, np.int64))


def test_layers_that_are_laid_are_counted_once_for_all_looks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What earlier looks counted is not counted again, and says the same; memory has its bound."""
    counted: list[int] = []
    count = laid_kernels.plastic
    monkeypatch.setattr(laid_kernels, "plastic", lambda *told: counted.append(1) or count(*told))
    place = along_wall(8 * SPACING_MM, 1.0, z=0.9)
    five, ten = laid(8, fill=1.1), laid(8, fill=1.1, layers=10)
    fresh = ten.interval(*place)
    five.interval(*place)
    before = len(counted)
    again = replace(ten, kept=five.kept).interval(*place)
    assert len(counted) - before == 1  # the layer over the place, which the first look lacked
    assert np.array_equal(fresh, again)
    elsewhere = pickle.loads(pickle.dumps(replace(ten, kept=five.kept)))
    assert np.array_equal(fresh, elsewhere.interval(*place))
    small = replace(ten, kept=KeptFills(most_bytes=0))
    assert np.array_equal(fresh, small.interval(*place))
    before = len(counted)
    small.interval(*place)
    assert len(counted) > before


def skin_over_cells(layers: int) -> LaidBeads:
    """A frame of solid layers with a gap 12 mm wide along X, and so many layers of skin over it."""
    beads = laid(40, layers=5 + layers)
    y, z = beads.start_mm[:, 1], beads.start_mm[:, 2]
    layer = np.round(z / LAYER_MM).astype(np.int64) - 1
    keep = (layer >= 5) | (y < 3.0) | (y > 15.0)
    return LaidBeads.from_beads(
        beads.start_mm[keep], beads.end_mm[keep], beads.section_mm2[keep], beads.height_mm[keep],
        layer[keep], options=NO_WANDER,
    )  # fmt: skip


@pytest.mark.parametrize(("layers", "sinks"), [(1, False), (2, True), (4, True), (5, False)])
@pytest.mark.parametrize("low_mm", [0.0, 0.06, 0.2])
def test_the_first_layers_of_a_skin_lie_as_low_over_open_cells_as_most_of_it_does(
    layers: int, sinks: bool, low_mm: float
) -> None:
    """At most by what the strands below them are rounder than their layer."""
    beads = skin_over_cells(layers)
    top_mm = (5 + layers) * LAYER_MM
    y = np.array([1.5, *np.linspace(5.0, 13.0, 9), 16.5])
    gap = (y > 3.0) & (y < 15.0)
    deviation_mm = np.where(gap, -low_mm, 0.0)
    deviation_mm[1:4] = -0.3  # a third of the skin is gone: it does not say how low the rest lies
    place = np.column_stack([np.full_like(y, 15.0), y, top_mm + deviation_mm])
    lower = beads.sunk_mm(place, np.tile([0.0, 0.0, 1.0], (len(y), 1)), deviation_mm, gap)
    round_mm = 2.0 * np.sqrt(SPACING_MM * LAYER_MM / np.pi) - LAYER_MM
    expected = min(round_mm, 0.5 * LAYER_MM, low_mm) if sinks else 0.0
    assert lower[gap] == pytest.approx(expected)
    assert not lower[~gap].any()
    assert not beads.sunk_mm(place, np.tile([0.0, 1.0, 0.0], (len(y), 1)), deviation_mm, gap).any()


def test_the_highest_layers_are_kept_where_memory_is_short() -> None:
    """Looks at one layer after another make the newest alone; a walk over all makes the lower."""
    job = laid(8, fill=1.1, layers=10)
    ones = [job._filled(k, slice(int(job.first[k]), int(job.first[k + 1]))) for k in range(3)]
    kept = KeptFills(most_bytes=2 * ones[0].bytes)
    for k in (0, 1, 2):
        kept.get((k, 1), lambda k=k: ones[k])
    made: list[int] = []
    for k in (0, 1, 2):
        kept.get((k, 1), lambda k=k: made.append(k) or ones[k])
    assert made == [0]


@pytest.mark.parametrize("shape", [(40, 31), (2, 9), (7, 1)])
@pytest.mark.parametrize("over", [1, 3, 5])
def test_cells_are_averaged_as_by_scipy(shape: tuple[int, int], over: int) -> None:
    field = np.random.default_rng(over).random(shape)
    expected = uniform_filter(field, over, mode="constant").astype(np.float32)
    np.testing.assert_array_equal(laid_kernels.averaged(field, over), expected)
