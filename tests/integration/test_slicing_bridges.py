"""Patches over air: parts on two legs, whose columns are known without any of our own code."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import manifold3d as m3
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from amrepair.loop.sites import lines_of_job
from amrepair.simulate.world import World
from gcode.check import JobBridges, find_refusals
from gcode.moves import ModalState, Program, SetFan
from gcode.profiles import PrintSetup, load_setup
from gcode.reader import job_for
from gcode.slicing.job import plan_part
from gcode.slicing.job_lines import JobLines
from gcode.slicing.layers import LayerGrid
from gcode.slicing.patch import LeftCause, PatchPlan, slice_patch
from gcode.surfaces import HeightField
from gcode.writer import write
from tests.draws import draws
from tests.gcode_text import beads_of, points_of, steps_of
from tests.integration.test_slicing_patch import motion_of

SETUP = load_setup()
LIMIT_MM = SETUP.material.max_bridge_mm
PARK = (10.0, 200.0, 20.0)
HOT = ModalState(PARK, 0.0, True, False, 50.0, 1.0, (210.0,), 60.0)
FOOT_MM, WIDE_MM, LEG_MM, MIDDLE = 7.0, 6.0, 4.0, (75.0, 75.0)
HOLD_MM = 0.9  # no bead ends farther over air than two lines' widths


@dataclass(frozen=True)
class OnLegs:
    """A plate on two legs, turned about its middle, of which the plate is gone."""

    gap_mm: float
    plate_mm: float = 1.0
    turned_deg: float = 0.0

    def _box(self, x0: float, x1: float, z0: float, z1: float) -> m3.Manifold:
        box = m3.Manifold.cube((x1 - x0, WIDE_MM, z1 - z0)).translate((x0, -0.5 * WIDE_MM, z0))
        return box.rotate((0.0, 0.0, self.turned_deg)).translate((*MIDDLE, 0.0))

    @property
    def legs(self) -> m3.Manifold:
        half = 0.5 * self.gap_mm
        left = self._box(-half - LEG_MM, -half, 0.0, FOOT_MM)
        return left + self._box(half, half + LEG_MM, 0.0, FOOT_MM)

    @property
    def plate(self) -> m3.Manifold:
        far = 0.5 * self.gap_mm + LEG_MM
        return self._box(-far, far, FOOT_MM, FOOT_MM + self.plate_mm)

    def over_air_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """How far places are from the nearest leg; 0 over one."""
        turn = np.radians(self.turned_deg)
        across = np.array([np.cos(turn), np.sin(turn)])
        return 0.5 * self.gap_mm - np.abs((points_mm[:, :2] - MIDDLE) @ across)

    def planned(
        self, setup: PrintSetup = SETUP, lines: JobLines | None = None
    ) -> tuple[PatchPlan, Program, HeightField]:
        field = HeightField.from_manifold(self.legs, 0.1, margin_mm=8.0)
        grid = LayerGrid.from_setup(setup)
        plan = slice_patch(
            self.plate,
            setup,
            as_built=field,
            grid=grid,
            standalone=False,
            start_mm=PARK,
            lines=lines,
        )
        program = write(plan.toolpath, setup, title="legs", resume=HOT, restore=False)
        return plan, program, field

    def job_lines(self, solid: m3.Manifold | None = None) -> JobLines:
        """What our own slicer lays for the whole part, or for another."""
        solid = self.legs + self.plate if solid is None else solid
        job = job_for(write(plan_part(solid, SETUP).toolpath, SETUP, title="job"), SETUP.printer)
        return lines_of_job(job, job.beads.layer >= 0, SETUP)


def strands_of(program: Program) -> list[np.ndarray]:
    steps = [step for step in steps_of(program.text, PARK) if step.role == "Bridge infill"]
    return [points_of(bead) for bead in beads_of(steps)]


def first_pass_of(program: Program) -> list[np.ndarray]:
    steps = steps_of(program.text, PARK)
    lowest = min(step.end_mm[2] for step in steps if step.is_bead)
    beads = [points_of(bead) for bead in beads_of(steps)]
    return [bead for bead in beads if bead[0, 2] < lowest + 0.05]


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    gap_mm=st.floats(2.0, LIMIT_MM + 6.0),
    plate_mm=st.floats(0.4, 1.0),
    turned_deg=st.floats(0.0, 90.0),
)
def test_strands_end_on_legs_and_nothing_else_is_in_the_air(
    gap_mm: float, plate_mm: float, turned_deg: float
) -> None:
    part = OnLegs(gap_mm, plate_mm, turned_deg)
    _, program, field = part.planned()
    for bead in first_pass_of(program):
        out_mm = part.over_air_mm(bead)
        # every end lies on a leg, or hangs beside one by a line's width
        assert max(out_mm[0], out_mm[-1]) <= HOLD_MM
        if out_mm.max() <= HOLD_MM:
            continue
        steps = np.diff(bead[:, :2], axis=0)
        along = steps / np.hypot(*steps.T)[:, None]
        on_air = (out_mm[:-1] > 0) & (out_mm[1:] > 0)
        assert (along[on_air] @ along[on_air][0] > 0.999).all(), "a strand over air is straight"
        assert np.hypot(*steps[on_air].T).sum() <= LIMIT_MM + 0.2
    assert not find_refusals(program, SETUP, as_built=field, initial=HOT, patch=True)


@pytest.mark.parametrize("turned_deg", draws([0.0, 33.0], 33.0))
def test_a_plate_between_legs_is_filled_in_the_world(turned_deg: float) -> None:
    # before there were bridges: 0.52 of it, and nothing over the middle
    part = OnLegs(12.0, 1.4, turned_deg)
    plan, _, _ = part.planned()
    world, whole = World((200.0, 200.0)), World((200.0, 200.0))
    whole.add(part.legs + part.plate)
    world.add(part.legs)
    gone = whole.snapshot()
    gone = gone.minus(world.snapshot(gone.window))
    world.deposit(motion_of(plan.toolpath))
    after = world.snapshot(gone.window)
    assert gone.common(after).volume_mm3 >= 0.91 * gone.volume_mm3
    # what strands sag by, 0.1 mm in the middle, lies below
    assert after.minus(whole.snapshot(gone.window)).volume_mm3 <= 0.12 * gone.volume_mm3


def test_the_next_pass_fills_what_strands_sag_by() -> None:
    part = OnLegs(16.0)
    sections = {}
    for sag_per_mm in (0.0, 0.001):
        material = SETUP.material.model_copy(update={"bridge_sag_per_mm": sag_per_mm})
        plan, _, _ = part.planned(replace(SETUP, material=material))
        sections[sag_per_mm] = plan.beads_mm3
    # a parabola is two thirds as high on average as in its middle, over the gap
    more_mm3 = 2 / 3 * 0.001 * 16.0**2 * 16.0 * WIDE_MM
    assert sections[0.001] - sections[0.0] == pytest.approx(more_mm3, rel=0.15)


@pytest.mark.slow
def test_a_span_too_long_is_told_with_its_length_and_volume() -> None:
    part = OnLegs(34.0)
    plan, _, _ = part.planned()
    [left] = [u for u in plan.unprintable if "bridge" in u.reason]
    assert left.reason == "a bridge over it would be too long: 34 mm, limit 20 mm"
    # beads step out from both legs by a line's width a pass
    assert 0.6 * 34.0 * WIDE_MM < left.volume_mm3 < 34.0 * WIDE_MM
    drawn = {each.cause: each.volume_mm3 for each in plan.left}
    assert drawn[LeftCause.TOO_LONG] == pytest.approx(left.volume_mm3, rel=0.02)


@pytest.mark.parametrize("gap_mm", draws([16.0, 26.0], 16.0))
def test_of_a_job_s_own_lines_none_hangs_from_one_end(gap_mm: float) -> None:
    # its lines at 45 degrees span 1.4 times the gap, and turn over the air
    part = OnLegs(gap_mm)
    plan, program, field = part.planned(lines=replace(part.job_lines(), bridges=None))
    assert not find_refusals(program, SETUP, as_built=field, initial=HOT, patch=True)
    for bead in first_pass_of(program):
        out_mm = part.over_air_mm(bead)
        if out_mm.max() > HOLD_MM:
            assert max(out_mm[0], out_mm[-1]) <= HOLD_MM
    filled = plan.reachable_mm3 / part.plate.volume()
    assert filled > 0.95 if gap_mm < LIMIT_MM else filled < 0.7


# of 34 mm they sag by 0.6 mm in the middle: the plate is 1 mm thick
@pytest.mark.parametrize(("gap_mm", "least"), draws([(26.0, 0.95), (34.0, 0.8)], (26.0, 0.95)))
def test_what_the_job_spans_a_repair_may_span(gap_mm: float, least: float) -> None:
    # regression: over 34 mm, which the job itself had bridged, 0.43 was laid and 0.41 filled
    part = OnLegs(gap_mm)
    lines = part.job_lines()
    assert isinstance(lines.bridges, JobBridges)
    assert lines.bridges.longest_mm() == pytest.approx(gap_mm, abs=0.3)
    plan, program, field = part.planned(lines=lines)
    assert plan.reachable_mm3 > least * part.plate.volume()
    assert not find_refusals(program, SETUP, as_built=field, initial=HOT, patch=lines.bridges)
    # whoever does not know the job knows the material's limit alone
    said = find_refusals(program, SETUP, as_built=field, initial=HOT, patch=True)
    assert {refusal.what for refusal in said} == {"bridge too long"}


@settings(max_examples=8, deadline=None)
@given(gap_mm=st.floats(3.0, 40.0), turned_deg=st.floats(0.0, 90.0))
def test_a_job_s_spans_are_told_by_its_motions_alone(gap_mm: float, turned_deg: float) -> None:
    # walls of three layers, and one line from the middle of one over air to that of the other
    half = 0.5 * gap_mm
    turn = np.radians(turned_deg)
    along = np.array([np.cos(turn), np.sin(turn)])
    across = np.array([-along[1], along[0]])
    starts, ends = [], []
    for z_mm in np.arange(0.2, 4.1, 0.2):
        for off_mm in np.arange(-half - 2.0, -half - 0.2, 0.4):
            for side in (-1.0, 1.0):
                middle = MIDDLE + side * off_mm * along
                starts.append([*(middle - 3.0 * across), z_mm])
                ends.append([*(middle + 3.0 * across), z_mm])
    starts.append([*(MIDDLE - (half + 1.0) * along), 4.2])
    ends.append([*(MIDDLE + (half + 1.0) * along), 4.2])
    start, end = np.array(starts), np.array(ends)
    section = np.full(len(start), 0.08)
    whole = JobBridges(start, end, section, 0.4)
    # from rim to rim: a bead's middle lies so far inside its own wall
    assert whole.longest_mm() == pytest.approx(gap_mm, abs=0.7) or gap_mm < 3.2
    assert JobBridges(start[:-1], end[:-1], section[:-1], 0.4).longest_mm() == 0.0
    # an end over air is no span
    end[-1, :2] = MIDDLE
    assert JobBridges(start, end, section, 0.4).longest_mm() == 0.0


def test_a_thin_strand_held_at_one_end_reaches_its_floor() -> None:
    # regression: beyond the last line that it crosses a sparse line drooped onto the one two
    # layers below it, and left its own place empty: of a void found late 0.68 was filled
    x, y = MIDDLE
    wall = m3.Manifold.cube((16.0, 0.4, 5.0)).translate((x - 8.0, y - 0.2, 0.0))
    across = [m3.Manifold.cube((0.4, 8.0, 5.2)).translate((x + at, y - 4.0, 0.0)) for at in (-3, 3)]
    standing = wall + across[0] + across[1]
    gone = m3.Manifold.cube((11.0, 0.4, 0.2)).translate((x - 5.5, y - 0.2, 5.2))
    start = np.array(
        [[x - 8, y, 5.0], [x - 2.8, y - 4, 5.2], [x + 3.2, y - 4, 5.2], [x - 5.5, y, 5.4]]
    )
    end = np.array(
        [[x + 8, y, 5.0], [x - 2.8, y + 4, 5.2], [x + 3.2, y + 4, 5.2], [x + 5.5, y, 5.4]]
    )
    height = np.full(4, 0.2)
    lines = JobLines(start, end, 0.4 * height, height, np.zeros(4, dtype=bool))
    plan = slice_patch(
        gone, SETUP, as_built=HeightField.from_manifold(standing, 0.1, margin_mm=8.0),
        grid=LayerGrid.from_setup(SETUP), standalone=False, start_mm=PARK, lines=lines,
    )  # fmt: skip
    by_place: dict[bool, list[float]] = {True: [], False: []}
    for move in plan.toolpath.extrusions:
        long_mm = np.hypot(*np.diff(move.points_mm[:, :2], axis=0).T)
        off_mm = np.abs(0.5 * (move.points_mm[1:, 0] + move.points_mm[:-1, 0]) - x)
        for inside in by_place:
            where = (off_mm < 2.5) if inside else (off_mm > 3.9) & (off_mm < 5.0)
            by_place[inside] += list(np.broadcast_to(move.section_mm2, long_mm.shape)[where])
    assert np.mean(by_place[True]) == pytest.approx(0.4 * 0.2, rel=0.1)
    assert np.mean(by_place[False]) == pytest.approx(0.4 * 0.4, rel=0.15)


def test_strands_lie_as_the_profile_says() -> None:
    setup = load_setup(material="abs")
    plan, program, _ = OnLegs(8.0).planned(setup)
    fans = [move.ratio for move in plan.toolpath if isinstance(move, SetFan)]
    assert fans == [0.15, 0.25, 0.15]
    steps = steps_of(program.text, PARK)
    fastest = {step.feed_mm_s for step in steps if step.is_bead and step.role == "Bridge infill"}
    assert setup.process.bridge_speed_mm_s in {round(speed, 3) for speed in fastest}


def test_strands_hold_on_nothing_that_fell() -> None:
    # regression: they were anchored on beads that lay on a floor 2 mm below them
    wall = m3.Manifold.cube((44.0, 5.0, 14.0)).translate((55.0, 70.0, 0.0))
    wall -= m3.Manifold.cube((14.0, 5.0, 7.0)).translate((70.0, 70.0, 3.0))
    # 3 mm of shoulder beside the window, and walls over it that keep the head off them
    cut = m3.Manifold.cube((20.0, 5.0, 9.0)).translate((67.0, 70.0, 10.0)) ^ wall
    field = HeightField.from_manifold(wall - cut, 0.1, margin_mm=8.0)
    plan = slice_patch(
        cut, SETUP, as_built=field, grid=LayerGrid.from_setup(SETUP), standalone=False,
        start_mm=PARK,
    )  # fmt: skip
    program = write(plan.toolpath, SETUP, title="lintel", resume=HOT, restore=False)
    assert not [strand for strand in strands_of(program) if np.ptp(strand[:, 0]) > 5.0]
    assert not find_refusals(program, SETUP, as_built=field, initial=HOT, patch=True)


def test_the_checker_knows_a_bridge_by_itself() -> None:
    part = OnLegs(14.0)
    _, program, field = part.planned()

    def said(of: Program, setup: PrintSetup = SETUP) -> set[str]:
        return {r.what for r in find_refusals(of, setup, as_built=field, initial=HOT, patch=True)}

    assert said(program) == set()
    # the same spans, of a material that bears less
    short = SETUP.material.model_copy(update={"max_bridge_mm": 13.0})
    assert said(program, replace(SETUP, material=short)) == {"bridge too long"}
    # it is asked of patches alone: a job's slicer knows its own bridges
    assert not find_refusals(program, replace(SETUP, material=short), as_built=field, initial=HOT)
    # a strand that ends in the middle: some of its moves lay nothing
    lines = program.text.splitlines()
    strand = lines.index(";TYPE:Bridge infill")
    laid = [k for k in range(strand, len(lines)) if re.match(r"G1 X.* E[\d.]+", lines[k])]
    for k in laid[15:20]:
        lines[k] = re.sub(r" E[\d.]+", "", lines[k])
    assert said(Program("\n".join(lines) + "\n", program.dialect)) == {
        "strand over air that ends on nothing"
    }


@pytest.mark.slow
def test_along_a_jobs_lines_a_slot_is_begun_where_the_head_first_gets_in() -> None:
    # regression: where that is one of the job's own heights no line found a hold there, nor any
    # above it: declared 0.03 of a slot of which the head reaches 0.22
    block = m3.Manifold.cube((14.0, 24.0, 6.0)).translate((60.0, 60.0, 0.0))
    slot = m3.Manifold.cube((2.5, 16.0, 3.0)).translate((65.0, 64.0, 3.0))
    job = job_for(write(plan_part(block, SETUP).toolpath, SETUP, title="job"), SETUP.printer)
    lines = lines_of_job(job, job.beads.layer >= 0, SETUP)
    field = HeightField.from_manifold(block - slot, 0.1, margin_mm=8.0)
    grid = LayerGrid.from_setup(SETUP)
    plan = slice_patch(
        slot, SETUP, as_built=field, grid=grid, standalone=False, start_mm=PARK, lines=lines
    )
    program = write(plan.toolpath, SETUP, title="slot", resume=HOT, restore=False)
    assert plan.reachable_mm3 > 0.18 * slot.volume()
    assert not find_refusals(program, SETUP, as_built=field, initial=HOT, patch=lines.bridges)
