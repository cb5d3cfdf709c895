"""A patch along the job's own lines: what is gone comes back as the job laid it."""

from __future__ import annotations

from dataclasses import replace

import manifold3d as m3
import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Float

from gcode.moves import Extrude
from gcode.profiles import PrintSetup, load_setup
from gcode.slicing.job_lines import JobLines, JobPieces, gathered
from gcode.slicing.layers import LayerGrid
from gcode.slicing.options import DEFAULT_PATCH
from gcode.slicing.patch import PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.surfaces.lines import heights_by_lines, near_lines
from tests.draws import draws

SETUP = load_setup()
PARK = (10.0, 200.0, 20.0)
WIDE_MM, HIGH_MM = 0.45, 0.2
X0, Y0, LONG_MM = 60.0, 60.0, 20.0
TOP_MM = 2.0


def hatch(z_mm: float, count: int = 40, high_mm: float = HIGH_MM) -> JobLines:
    """Lines along X, side by side in Y."""
    y = Y0 + (np.arange(count) + 0.5) * WIDE_MM
    start = np.column_stack([np.full(count, X0), y, np.full(count, z_mm)])
    return JobLines(
        start,
        start + np.array([LONG_MM, 0.0, 0.0]),
        np.full(count, WIDE_MM * high_mm),
        np.full(count, high_mm),
        np.zeros(count, dtype=bool),
    )


def stacked(*layers: JobLines) -> JobLines:
    """Several layers of them."""
    names = ("start_mm", "end_mm", "section_mm2", "height_mm", "rim")
    return JobLines(*(np.concatenate([getattr(one, name) for one in layers]) for name in names))


def field_of(missing: m3.Manifold, top_mm: float = TOP_MM) -> HeightField:
    """What is left of a block without it."""
    block = m3.Manifold.cube((LONG_MM, 40 * WIDE_MM, top_mm)).translate((X0, Y0, 0.0))
    return HeightField.from_manifold(block - missing, 0.1, margin_mm=15.0)


def slab(x: tuple[float, float], lines: tuple[int, int], low_mm: float) -> m3.Manifold:
    """Some lines, from a height up to the top, as long as is said."""
    size = (x[1] - x[0], (lines[1] - lines[0]) * WIDE_MM, TOP_MM - low_mm)
    return m3.Manifold.cube(size).translate((X0 + x[0], Y0 + lines[0] * WIDE_MM, low_mm))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_columns_beside_lines_are_those_that_shapes_hold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, 12, (6, 2))
    end = start + rng.normal(scale=3.0, size=(6, 2)) * rng.integers(0, 2, (6, 1))  # and points
    within = rng.uniform(0.05, 0.8, 6)
    low, cell_mm, (ny, nx) = np.array([1.0, 2.0]), 0.13, (60, 70)
    height = rng.uniform(0, 5, 6)
    where = {"low_mm": low, "cell_mm": cell_mm, "shape": (ny, nx)}
    found = heights_by_lines(start, end, within, height, **where)
    assert np.array_equal(near_lines(start, end, within, **where), found > -np.inf)
    x, y = (low[axis] + (np.arange(n) + 0.5) * cell_mm for axis, n in ((0, nx), (1, ny)))
    middles = shapely.points(*np.meshgrid(x, y))
    truth = np.full((ny, nx), -np.inf)
    for a, b, wide, high in zip(start, end, within, height, strict=True):
        beside = shapely.distance(middles, shapely.LineString([a, b])) <= wide
        truth[beside] = np.maximum(truth[beside], high)
    assert np.mean(found == truth) > 0.999  # but for what lies at the rim to rounding


def patched(
    missing: m3.Manifold, field: HeightField, lines: JobLines, setup: PrintSetup = SETUP
) -> PatchPlan:
    """The patch of it, in mid-job."""
    return slice_patch(
        missing,
        setup,
        as_built=field,
        grid=LayerGrid.from_setup(setup),
        standalone=False,
        start_mm=PARK,
        lines=lines,
    )


def beads_of(plan: PatchPlan) -> Float[np.ndarray, "n 4"]:
    """(n, 4) middles of the pieces of all beads, and their volumes."""
    found = []
    for move in plan.toolpath:
        if isinstance(move, Extrude):
            a, b = move.points_mm[:-1], move.points_mm[1:]
            volume = np.linalg.norm(b - a, axis=1) * move.section_mm2
            found.append(np.column_stack([0.5 * (a + b), volume]))
    return np.concatenate(found)


def off_line_mm(beads: Float[np.ndarray, "n 4"]) -> Float[np.ndarray, " n"]:
    """How far each piece lies from the nearest line of the hatch."""
    at = (beads[:, 1] - Y0) / WIDE_MM - 0.5
    return np.asarray(np.abs(at - np.round(at)) * WIDE_MM)


def test_beads_lie_where_the_job_laid_them():
    missing = slab((5.0, 15.0), (10, 16), TOP_MM - 2 * HIGH_MM)
    lines = stacked(*(hatch(z) for z in (TOP_MM - HIGH_MM, TOP_MM)))
    plan = patched(missing, field_of(missing), lines)
    top = beads_of(plan)
    top = top[np.abs(top[:, 2] - TOP_MM) < 1e-6]
    assert off_line_mm(top).max() < 1e-3
    assert {round((y - Y0) / WIDE_MM - 0.5) for y in top[:, 1]} == set(range(10, 16))
    # below, the head has no room beside the walls for all of them: other lines serve there
    assert plan.beads_mm3 == pytest.approx(
        DEFAULT_PATCH.beads.bond_ratio * missing.volume(), rel=0.03
    )
    assert sum(u.volume_mm3 for u in plan.unreachable) < 0.02 * missing.volume()


def test_a_line_that_a_scan_rounded_off_is_laid_whole():
    line = slab((4.0, 16.0), (20, 21), TOP_MM - HIGH_MM)
    wide = slab((3.8, 16.2), (19, 22), TOP_MM - 0.06)  # as a scanner's spot tells it
    field = field_of(wide)
    x, y = field.centres_mm()
    lies = (np.abs(y[:, None] - Y0 - 20.5 * WIDE_MM) < WIDE_MM / 2) & (
        np.abs(x[None, :] - X0 - 10.0) < 6.0
    )
    z_mm = np.where(lies, np.minimum(field.z_mm, TOP_MM - 0.09), field.z_mm)
    field = HeightField(field.origin_mm, field.cell_mm, z_mm, field.seen)
    told = wide + slab((4.0, 16.0), (20, 21), TOP_MM - 0.09)
    lines = hatch(TOP_MM)
    gone = np.array(
        [[[X0 + 4.0, Y0 + 20.5 * WIDE_MM, TOP_MM], [X0 + 16.0, Y0 + 20.5 * WIDE_MM, TOP_MM]]]
    )
    known = JobLines(
        lines.start_mm, lines.end_mm, lines.section_mm2, lines.height_mm, lines.rim, gone
    )
    beads = beads_of(patched(told, field, known))
    assert beads[:, 3].sum() == pytest.approx(
        DEFAULT_PATCH.beads.bond_ratio * line.volume(), rel=0.04
    )
    assert np.abs(beads[:, 1] - Y0 - 20.5 * WIDE_MM).max() < 1e-3


def test_on_a_slope_the_jobs_steps_come_back():
    """The deficit is smooth; what was printed was a staircase, and is one again."""
    steps = 5
    lines = stacked(
        *(hatch(TOP_MM - k * HIGH_MM).some(np.arange(40) < 20 + 4 * k) for k in range(steps))
    )
    wedge = m3.Manifold.cube((40.0, 40.0, 5.0)).rotate(
        (-float(np.degrees(np.arctan(HIGH_MM / (4 * WIDE_MM)))), 0.0, 0.0)
    )
    # the slope goes through the middles of the steps
    smooth = wedge.translate((X0 - 5.0, Y0 + 18 * WIDE_MM, TOP_MM))
    block = m3.Manifold.cube((LONG_MM, 40 * WIDE_MM, TOP_MM)).translate((X0, Y0, 0.0)) - smooth
    low_mm = TOP_MM - steps * HIGH_MM
    floor = m3.Manifold.cube((LONG_MM, 40 * WIDE_MM, low_mm)).translate((X0, Y0, 0.0))
    missing = block - floor
    plan = patched(missing, HeightField.from_manifold(floor, 0.1, margin_mm=15.0), lines)
    beads = beads_of(plan)
    assert off_line_mm(beads).max() < 1e-3
    for k in range(steps):
        mine = beads[np.abs(beads[:, 2] - TOP_MM + k * HIGH_MM) < 1e-6]
        last = int(np.round((mine[:, 1].max() - Y0) / WIDE_MM - 0.5))
        assert last == 20 + 4 * k - 1
    laid = len(lines.rim) * LONG_MM * WIDE_MM * HIGH_MM
    assert plan.beads_mm3 == pytest.approx(DEFAULT_PATCH.beads.bond_ratio * laid, rel=0.03)
    # as much along one line as along the next, however they lie to the columns
    line = np.round((beads[:, 1] - Y0) / WIDE_MM - 0.5).astype(int)
    top = np.abs(beads[:, 2] - TOP_MM) < 1e-6
    by_line = np.bincount(line[top], beads[top, 3])
    assert by_line.max() < 1.05 * by_line.min()


def crossing(z_mm: float) -> JobLines:
    """Lines along Y, 3 mm apart: sparse infill under a line along X."""
    x = X0 + np.arange(1.0, LONG_MM, 3.0)
    start = np.column_stack([x, np.full(len(x), Y0), np.full(len(x), z_mm)])
    same = np.full(len(x), HIGH_MM)
    end = start + np.array([0.0, 40 * WIDE_MM, 0.0])
    return JobLines(start, end, WIDE_MM * same, same, np.zeros(len(x), dtype=bool))


def bars(z_mm: float, high_mm: float) -> m3.Manifold:
    """What `crossing` is when laid, so high as is said."""
    each = m3.Manifold.cube((WIDE_MM, 40 * WIDE_MM, HIGH_MM)).translate(
        (-0.5 * WIDE_MM, Y0, high_mm - HIGH_MM)
    )
    places = crossing(z_mm).start_mm[:, 0]
    return m3.Manifold.batch_boolean([each.translate((x, 0.0, 0.0)) for x in places], m3.OpType.Add)


@pytest.mark.parametrize("rounded_mm", [0.0, 0.08])
def test_over_open_cells_a_line_gets_what_the_job_laid_there(rounded_mm: float) -> None:
    # regression: the gap down to the next line but one was filled, 1.6 times the line's plastic,
    # and what a scanner's spot had rounded off the lines below was laid onto them
    below_mm = TOP_MM - HIGH_MM
    lower = m3.Manifold.cube((LONG_MM, 40 * WIDE_MM, below_mm - HIGH_MM)).translate((X0, Y0, 0.0))
    stands = lower + bars(below_mm, below_mm - rounded_mm)
    missing = slab((4.0, 16.0), (20, 21), TOP_MM - HIGH_MM) + (
        bars(below_mm, below_mm) ^ slab((4.0, 16.0), (20, 21), below_mm - rounded_mm)
    )
    one = np.arange(40) == 20
    field = HeightField.from_manifold(stands, 0.1, margin_mm=15.0)
    plan = patched(missing, field, stacked(crossing(below_mm), hatch(TOP_MM).some(one)))
    assert set(beads_of(plan)[:, 2].round(3)) == {TOP_MM}
    laid = 12.0 * WIDE_MM * HIGH_MM
    assert plan.beads_mm3 == pytest.approx(DEFAULT_PATCH.beads.bond_ratio * laid, rel=0.12)


@pytest.mark.parametrize("high_mm", draws([0.1, 0.12, 0.15, 0.2], 0.1, 0.2))
def test_what_is_gone_of_many_thin_layers_is_filled_from_the_floor_up(high_mm: float) -> None:
    # regression: where the next layer's bead is as thick as two layers, each layer of a hole left
    # its own to the next one; of a chip through 17 layers of 0.1 mm a lid alone was laid
    process = SETUP.process.model_copy(
        update={"layer_height_mm": high_mm, "first_layer_height_mm": high_mm}
    )
    layers = round(TOP_MM / high_mm)
    top_mm = layers * high_mm
    size = (12.0, 20 * WIDE_MM, 0.5 * top_mm)
    missing = m3.Manifold.cube(size).translate((X0 + 4.0, Y0 + 10 * WIDE_MM, 0.5 * top_mm))
    missing -= (
        m3.Manifold.cube((40.0, 40.0, 5.0))
        .rotate((0.0, 4.0, 0.0))
        .translate((X0, Y0, -5.0 + 0.5 * top_mm + 1.0))
    )
    plan = patched(
        missing,
        field_of(missing, top_mm),
        stacked(*(hatch((k + 1) * high_mm, high_mm=high_mm) for k in range(layers))),
        replace(SETUP, process=process),
    )
    assert plan.beads_mm3 > 0.85 * missing.volume()


def test_without_lines_there_it_draws_its_own():
    missing = slab((5.0, 15.0), (10, 16), TOP_MM - 2 * HIGH_MM)
    elsewhere = hatch(0.4)
    field = field_of(missing)
    with_them, without = (
        patched(missing, field, lines) for lines in (elsewhere, elsewhere.some(elsewhere.rim))
    )
    assert with_them.beads_mm3 == pytest.approx(without.beads_mm3)


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.0, 1.2), min_size=1, max_size=12),
    st.integers(0, 2**31 - 1),
)
def test_gathering_moves_plastic_and_makes_none(shares, seed):
    n = len(shares)
    rng = np.random.default_rng(seed)
    own = rng.uniform(0.02, 0.09, n)
    volume = np.array(shares) * own
    middles = np.column_stack([np.arange(n) * 0.4, rng.integers(0, 3, n) * 0.45])
    job = JobPieces(own, 0.2, 0.225, np.zeros(n, dtype=bool), np.zeros((1, 1), dtype=bool))
    out, met = gathered(volume, np.full(n, 0.2), job, np.ones(n), middles, 0.45)
    assert out.sum() == pytest.approx(met.sum())  # whoever gave has what was given laid for it
    assert (met <= volume + 1e-12).all()
    assert (met >= -1e-12).all()
    assert out.sum() <= volume.sum() + 1e-12
    assert volume.sum() - out.sum() <= DEFAULT_PATCH.lines.nothing * own.sum() + 1e-12
    assert (out <= np.maximum(volume, own) + 1e-12).all()
    lot = np.array(shares) >= DEFAULT_PATCH.lines.little
    assert (
        out[lot] >= np.where(volume < DEFAULT_PATCH.lines.nothing * own, 0.0, volume)[lot] - 1e-12
    ).all()


def test_a_gone_line_gets_its_own_where_it_stands_out_and_not_in_a_thin_layer():
    """A spot rounds off what is gone; where all lines lack a half, rays run over each of them."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(12) * 0.4, np.arange(7) * 0.45))
    own, middles = np.full(len(x), 0.08), np.column_stack([x, y])
    lacks_half, line = np.full(len(x), 0.5), np.isclose(y, 3 * 0.45)

    def laid(shares: np.ndarray, gone: np.ndarray) -> np.ndarray:
        job = JobPieces(own, 0.2, 0.225, gone, np.zeros((1, 1), dtype=bool))
        return gathered(shares * own, np.full(len(x), 0.1), job, np.ones(len(x)), middles, 0.45)[0]

    one = laid(np.where(line, 0.6, 0.1), line)
    beside = np.isclose(np.abs(y - 3 * 0.45), 0.45)
    assert one[line] == pytest.approx(own[line])
    assert not one[beside].any()
    thin = laid(lacks_half, line)
    assert thin == pytest.approx(lacks_half * own)


@pytest.mark.parametrize(("lines", "low_mm"), [((10, 16), 0.4), ((10, 20), 0.6)])
def test_what_is_given_up_under_a_line_is_not_declared_as_reached(
    lines: tuple[int, int], low_mm: float
) -> None:
    # regression: a job's line laid over a slot's mouth counted as if all below it were filled
    missing = slab((3.0, 17.0), lines, low_mm)
    job = stacked(*(hatch(z) for z in np.arange(1, 11) * HIGH_MM))
    plan = patched(missing, field_of(missing), job)
    assert plan.reachable_mm3 < 0.7 * missing.volume()  # the nozzle's cone does not get down
    # reached is what plastic is laid for, and what is left is told whole
    assert plan.reachable_mm3 == pytest.approx(
        plan.beads_mm3 / DEFAULT_PATCH.beads.bond_ratio, rel=0.08
    )
    left_mm3 = sum(piece.volume_mm3 for piece in (*plan.unreachable, *plan.unprintable))
    assert left_mm3 == pytest.approx(missing.volume() - plan.reachable_mm3, rel=0.02)
