"""Objects that a job prints one after another: whose turn it is, and what the head keeps off."""

from __future__ import annotations

from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
from loop_bench import Scripted, Thermal
from turns_job import SETUP, InTurn, Tower, copies, hits, in_turn, seen

from amrepair.errors import InputError
from amrepair.loop import LoopReport, Stop, plan_stops, run_loop, travel
from amrepair.loop.locate import locate_parts
from amrepair.loop.marked_stops import marked_stops
from amrepair.loop.objects import is_laid
from amrepair.loop.pace import Pace, Stops, layers_at, layers_every
from amrepair.loop.sequential_objects import finished_at, template_of
from amrepair.loop.sites import sites
from amrepair.policy import Action
from amrepair.postprocess import LooksAsked, mark
from amrepair.scans import Scan, ScanRequest
from gcode.check import check
from gcode.check.sweep import deepest_of_moves
from gcode.errors import CheckRefusedError
from gcode.reader import job_for
from gcode.resumption.head import state_at_rest
from gcode.resumption.resume_at import resume_at
from tests.draws import draws

# The tall one stands between the low one and the park, at X 10, Y 200, Z 20.
TALL, LOW = Tower(92.0, 112.0, (16.0, 16.0, 25.0)), Tower(178.0, 46.0, (16.0, 14.0, 3.0))


@pytest.fixture(scope="module")
def both() -> InTurn:
    return InTurn.of([TALL, LOW])


@pytest.fixture(scope="module")
def three() -> InTurn:
    return copies((16.0, 12.0, 4.0), [(60.0, 60.0), (130.0, 60.0), (60.0, 130.0)])


# ---- what a layer is, and what a height names


def test_each_object_has_its_turn_and_its_end(three: InTurn) -> None:
    job = three.job
    assert [(t.first_layer, t.end_layer) for t in job.turns] == [(0, 20), (20, 40), (40, 60)]
    stops = plan_stops(job, [4, 19, 24, 59])
    labels = ["layer-004", "final-1", "layer-024", "final-2", "final-3"]
    assert [stop.label for stop in stops] == labels
    for stop, turn in zip(stops, (0, 0, 1, 1, 2), strict=True):
        assert job.turn_at(stop.line).index == turn
        (last,) = job.beads.line[job.beads.line < stop.line][-1:]
        assert job.beads.end_mm[job.beads.line == last][-1, 2] == pytest.approx(stop.z_mm)


def test_a_job_that_prints_all_at_once_has_one_turn_and_one_end(both: InTurn) -> None:
    alone = InTurn.of([LOW]).job
    assert len(alone.turns) == 1
    assert [stop.label for stop in plan_stops(alone, [3])] == ["layer-003", "final"]


def test_looks_come_in_every_object_and_not_beside_its_end(three: InTurn) -> None:
    assert layers_every(three.job, 9) == [8, 17, 28, 37, 48, 57]
    assert layers_every(three.job, 20) == []  # that is the end's
    assert layers_at(three.job, [1.0]) == [4, 24, 44]
    with pytest.raises(InputError, match="the job is 4 mm high"):
        layers_at(three.job, [4.3])


def test_a_height_is_looked_at_where_objects_reach_it(both: InTurn) -> None:
    assert layers_at(both.job, [2.0, 10.0]) == [9, 134, 49]


def test_the_pace_begins_anew_with_every_object(three: InTurn) -> None:
    ahead = Stops(three.job, plan_stops(three.job, []), Pace(4))
    found = []
    while (stop := ahead.next()) is not None:
        found.append(stop.label)
        ahead.seen(stop, trouble=False)
    each = [["layer-003", "layer-011"], ["layer-023", "layer-031"], ["layer-043", "layer-051"]]
    assert found == [x for k, own in enumerate(each, 1) for x in (*own, f"final-{k}")]


@pytest.mark.slow
def test_every_copy_is_found_where_its_turn_prints_it(three: InTurn) -> None:
    (part, *_) = getattr(three.template, "parts")  # noqa: B009 - of the port nobody knows it
    placed = locate_parts(three.job, part, layer_height_mm=0.2)
    low = [pose.apply(np.zeros((1, 3)))[0] for pose in placed]
    wanted = [[tower.x_mm, tower.y_mm, 0.0] for tower in three.towers]
    assert np.abs(np.array(low) - wanted).max() < 0.1  # of a bead of 0.45 mm


@pytest.mark.parametrize("made", ["both", "three"])
def test_a_turn_is_judged_by_what_it_prints_alone(
    made: str, request: pytest.FixtureRequest
) -> None:
    job: InTurn = request.getfixturevalue(made)
    for turn, tower in zip(job.job.turns, job.towers, strict=True):
        own = template_of(job.template, job.placed, job.job, turn)
        assert own.bounds_mm == pytest.approx(
            np.array([[*tower.box_mm[:2], 0.0], [*tower.box_mm[2:], tower.size_mm[2]]]), abs=1e-6
        )


def test_what_is_finished_stands_there_and_is_its_own(both: InTurn) -> None:
    first, second = both.job.turns
    assert finished_at(both.job, first, SETUP) is None
    finished = finished_at(both.job, second, SETUP)
    assert finished is not None
    assert finished.standing.top_mm == pytest.approx(25.0)
    corner, beside, here = [92.0, 112.0], [120.0, 100.0], [178.0, 46.0]
    assert finished.own(np.array([corner, beside, here, [-999.0, 0.0]])).tolist() == [
        True, True, False, False,
    ]  # fmt: skip


# ---- what the head keeps off


def parked_at(both: InTurn, layer: int) -> tuple[list[str], list[str], Stop]:
    """The way to the park after a layer of the low one, without and with what is finished."""
    (stop,) = plan_stops(both.job, [layer], final=False)
    state = state_at_rest(both.job, stop.line)
    finished = finished_at(both.job, both.job.turns[1], SETUP)
    assert finished is not None
    naive, _ = travel.park(SETUP, state)
    over, parked = travel.park(SETUP, state, finished.standing)
    back = travel.way_back(SETUP, state, parked, finished.standing)
    here = "G1 X{:.3f} Y{:.3f} Z{:.3f}".format(*state.position_mm)
    whole = [here, *over.program.lines(), *(line for one in back for line in one.program.lines())]
    return [here, *naive.program.lines()], whole, stop


def test_the_way_to_the_park_never_crosses_a_finished_neighbour(both: InTurn) -> None:
    naive, over, _ = parked_at(both, 129)  # 1 mm up
    assert any("nozzle" in hit for hit in hits(naive, TALL, SETUP))  # over the layer alone: 20 mm
    assert hits(over, TALL, SETUP) == []
    # first up, then aside, the same way back
    moved = [line for line in over[1:] if line.startswith("G1 ") and set("XYZ") & set(line)]
    assert [bool(set("XY") & set(line.split(" F")[0][2:])) for line in moved][:2] == [False, True]


def test_the_checker_refuses_the_way_that_is_lifted_over_the_layer_alone(both: InTurn) -> None:
    stop = parked_at(both, 129)[2]
    state = state_at_rest(both.job, stop.line)
    finished = finished_at(both.job, both.job.turns[1], SETUP)
    assert finished is not None
    naive, _ = travel.park(SETUP, state)
    with pytest.raises(CheckRefusedError, match=r"the nozzle .* hits what stands there"):
        check(naive.program, SETUP, as_built=finished.standing, initial=state)


def test_where_nothing_goes_over_it_a_look_is_refused_in_a_sentence(both: InTurn) -> None:
    stop = parked_at(both, 129)[2]
    finished = finished_at(both.job, both.job.turns[1], SETUP)
    assert finished is not None
    standing = finished.standing.raised(np.where(finished.standing.z_mm > 0, 209.0, 0.0))
    with pytest.raises(InputError, match=r"209.0 mm high .* no room to go over it"):
        travel.park(SETUP, state_at_rest(both.job, stop.line), standing)


def test_a_job_that_leads_the_head_through_what_is_finished_is_refused(both: InTurn) -> None:
    near = InTurn.of([Tower(92.0, 112.0, (16.0, 16.0, 25.0)), Tower(120.0, 112.0, (9.0, 9.0, 1.0))])
    with pytest.raises(InputError, match=r"one after the other.*the (duct|carriage).*too deep"):
        sites(near.job, near.template, near.placed, SETUP)
    low = InTurn.of([TALL, LOW], over_mm=-5.0)  # on its way from the one to the other
    with pytest.raises(InputError, match=r"one after the other.*the \w+ .*too deep"):
        sites(low.job, low.template, low.placed, SETUP)
    sites(both.job, both.template, both.placed, SETUP)


def test_layers_that_fall_back_over_the_same_place_are_no_objects_in_turn() -> None:
    twice = InTurn.of([LOW, Tower(180.0, 47.0, (9.0, 9.0, 1.0))])
    with pytest.raises(InputError):
        finished_at(twice.job, twice.job.turns[1], SETUP)


# ---- the run


def run(made: InTurn, folder: Path, scans: object, stops: tuple[Stop, ...]) -> tuple[
    LoopReport, list[str]
]:  # fmt: skip
    printer = Thermal(folder / "sent.gcode")
    printer.connect()
    try:
        report = run_loop(
            made.job, made.checked, printer, Scripted(scans, by_request=True),  # type: ignore[arg-type]
            sites(made.job, made.template, made.placed, made.setup, by_beads=False),
            stops=stops,
        )  # fmt: skip
    finally:
        printer.close()
    return report, (folder / "sent.gcode").read_text().splitlines()


@pytest.mark.parametrize(
    "broken",
    draws([None, "layer-004", "final-2", "layer-024", "layer-044"], "layer-004"),
)
def test_a_void_is_filled_in_its_own_object_and_nowhere_else(
    three: InTurn, tmp_path: Path, broken: str | None
) -> None:
    stops = plan_stops(three.job, [4, 24, 44])
    looked: list[str] = []

    def scans(request: ScanRequest) -> Scan:
        stop = next(one for one in stops if one.label == request.label)
        solid = three.standing(stop)
        if request.label == broken and broken not in looked:
            tower = three.towers[three.job.turn_at(stop.line).index]
            hole = m3.Manifold.cube((6.0, 5.0, 9.0))
            solid -= hole.translate((tower.x_mm + 5.0, tower.y_mm + 4.0, stop.z_mm - 0.6))
        looked.append(request.label)
        return seen(solid, 1 + len(looked))

    report, sent = run(three, tmp_path, scans, stops)
    assert report.stopped == ""
    labels = [stop.label for stop in stops]
    if broken is not None:
        labels.insert(labels.index(broken), broken)
    assert looked == labels
    printed = [look for look in report.looks if look.printed]
    assert [look.stop.label for look in printed] == [broken] * (broken is not None)
    if not printed:
        return
    patch = printed[0].plan.patch
    assert patch is not None
    assert patch.beads_mm3 == pytest.approx(6.0 * 5.0 * 0.6, rel=0.25)
    others = {look.decision.action for look in report.looks if not look.printed}
    assert others == {Action.GO_ON}
    # on all ways to looks, repairs and back the head clears what is finished by then
    turn = three.job.turn_at(printed[0].stop.line).index
    begins = sent.index(next(line for line in sent if line.startswith("; repair of")))
    for tower in three.towers[:turn]:
        assert hits(sent[begins - 30 :], tower, SETUP) == []


def test_a_run_keeps_the_head_off_what_is_finished_on_every_way_it_sends(
    both: InTurn, tmp_path: Path
) -> None:
    """Repair and all: the tall one stands between the low one and the park."""
    stops = plan_stops(both.job, [129], final=False)
    looked: list[int] = []

    def scans(request: ScanRequest) -> Scan:
        solid = both.standing(stops[0])
        if not looked:
            solid -= m3.Manifold.cube((6.0, 5.0, 9.0)).translate((182.0, 50.0, stops[0].z_mm - 0.6))
        looked.append(1)
        return seen(solid, len(looked))

    report, sent = run(both, tmp_path, scans, stops)
    assert [look.printed for look in report.looks] == [True, False]
    turn = both.job.turns[1]
    begun = sent.index("; printing object tower_1")
    assert sum("park for a scan" in line for line in sent[begun:]) == 1
    assert turn.index == 1
    assert hits(sent[begun:], TALL, SETUP) == []


@pytest.mark.parametrize("more_mm", draws([0.0, 4.0], 4.0))
def test_what_a_scan_shows_of_a_finished_one_keeps_the_head_off_too(
    tmp_path: Path, more_mm: float
) -> None:
    """Planned it goes just under the carriage; what stands out of it does not."""
    made = InTurn.of(
        [Tower(100.0, 100.0, (12.0, 12.0, 19.8)), Tower(138.0, 100.0, (14.0, 12.0, 3.0))]
    )
    stops = plan_stops(made.job, [108], final=False)
    looked: list[int] = []

    def scans(request: ScanRequest) -> Scan:
        solid = made.standing(stops[0])
        if more_mm:
            solid += m3.Manifold.cube((12.0, 12.0, 19.8 + more_mm)).translate((100.0, 100.0, 0.0))
        if not any(looked):
            solid -= m3.Manifold.cube((4.0, 5.0, 9.0)).translate(
                (139.5, 103.0, stops[0].z_mm - 0.6)
            )
        looked.append(more_mm == 0.0)
        return seen(solid, len(looked))

    report, _ = run(made, tmp_path, scans, stops)
    patch = report.looks[0].plan.patch
    assert patch is not None
    if more_mm == 0.0:
        assert report.looks[0].printed
        assert patch.beads_mm3 == pytest.approx(4.0 * 5.0 * 0.6, rel=0.25)
        return
    assert not any(look.printed for look in report.looks)
    assert patch.beads_mm3 == 0.0
    assert "the carriage would touch what stands beside it" in patch.unreachable[0].reason
    # its own excess is none of the one under way
    assert {look.plan.deficit.excess_mm3 for look in report.looks} == {0.0}


def test_a_finished_one_close_by_is_neither_too_much_nor_laid_on(tmp_path: Path) -> None:
    """Eight millimetres off, just under the heater's block, and printed 0.5 mm higher than it was
    planned: it was judged at its own end."""
    made = InTurn.of([Tower(100.0, 100.0, (16.0, 12.0, 3.8)), Tower(124.0, 100.0, (9.0, 9.0, 3.0))])
    stops = plan_stops(made.job, [23])
    higher = m3.Manifold.cube((16.0, 12.0, 4.3)).translate((100.0, 100.0, 0.0))

    def scans(request: ScanRequest) -> Scan:
        (stop,) = (one for one in stops if one.label == request.label)
        first = made.job.turn_at(stop.line).index == 0
        return seen(made.standing(stop) + (m3.Manifold() if first else higher), 3)

    report, _ = run(made, tmp_path, scans, stops)
    assert [look.stop.label for look in report.looks] == ["final-1", "layer-023", "final-2"]
    assert {look.decision.action for look in report.looks} == {Action.GO_ON}
    assert [look.plan.deficit.excess_mm3 for look in report.looks] == [0.0, 0.0, 0.0]


def test_an_object_that_was_given_up_is_not_looked_at_any_more(three: InTurn) -> None:
    job = three.job
    (end, *_) = (stop for stop in plan_stops(job, []) if stop.label == "final-2")
    assert is_laid(job, end)
    turn = job.turns[1]
    gone = (job.beads.layer > turn.first_layer + 3) & (job.beads.layer < turn.end_layer)
    left = type(job)(**{n: getattr(job, n) for n in job.__slots__} | {
        "beads": job.beads.subset(~gone)})  # fmt: skip
    assert not is_laid(left, end)
    assert is_laid(left, plan_stops(job, [])[-1])


def test_the_head_s_depth_is_told_by_move_and_part(both: InTurn) -> None:
    finished = finished_at(both.job, both.job.turns[1], SETUP)
    assert finished is not None
    start = np.array([[50.0, 120.0, 15.0], [50.0, 120.0, 26.0]])
    end = start + np.array([100.0, 0.0, 0.0])
    deep_mm, parts = deepest_of_moves(start, end, SETUP.printer, finished.standing)
    assert deep_mm[0] == pytest.approx(25.0 - 15.0 - 0.2, abs=1e-6)
    assert parts[0].is_tip
    assert deep_mm[1] <= 0


# ---- what other commands make of it


def test_marks_are_in_every_object_and_lifted_over_what_is_finished(both: InTurn) -> None:
    text = in_turn([TALL, LOW])
    marked = mark(text, "towers.gcode", "klipper", LooksAsked(every=10))
    job = job_for(marked.text, SETUP.printer)
    stops = marked_stops(job, "towers.gcode")
    assert [stop.label for stop in stops][-2:] == ["layer-134", "final-2"]
    assert "final-1" in [stop.label for stop in stops]
    for stop in stops:
        turn = job.turn_at(stop.line)
        high_mm = max((layer.z_mm for layer in job.layers[: turn.first_layer]), default=0.0)
        assert job.state_after(stop.line).position_mm[2] > high_mm + 1.0
    # the job goes on where it was, as fast as it was, and lays the same
    plain, lines = text.split("\n"), marked.text.split("\n")
    assert [line for line in plain if line.startswith("G1 X")] == [
        line for line in lines if line.startswith("G1 X")
    ]
    before = job_for(text, SETUP.printer)
    assert np.abs(job.beads.end_mm - before.beads.end_mm).max() < 1e-9


def test_a_job_that_shifts_its_z_is_not_marked() -> None:
    text = in_turn([TALL, LOW]).replace("G92 E0", "G92 E0\nG92 Z5.1")
    with pytest.raises(InputError, match=r"G92 Z5.1.*how high a pause"):
        mark(text, "towers.gcode", "marlin", LooksAsked(every=10))


def test_a_layer_names_where_a_job_goes_on_and_what_is_finished_stands_there(both: InTurn) -> None:
    found = resume_at(both.checked.program, SETUP, layer=130)
    assert found.standing.top_mm == pytest.approx(25.0)
    assert found.layer.z_mm == pytest.approx(1.2)
    lines = list(found.checked.program.lines())
    assert hits(lines[: lines.index(";LAYER_CHANGE") + 20], TALL, SETUP) == []
    with pytest.raises(Exception, match="one object after another"):
        resume_at(both.checked.program, SETUP, z_mm=1.0)
