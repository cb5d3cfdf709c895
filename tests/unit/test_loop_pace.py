"""When the loop looks: fixed layers, heights, and the pace that follows trouble."""

from __future__ import annotations

from pathlib import Path

import manifold3d as m3
import pytest
from loop_bench import Small, scan_of

from amrepair.errors import InputError, LoopError
from amrepair.loop import Tape, plan_stops
from amrepair.loop.pace import Pace, Stops, layers_at
from amrepair.loop.replay import replay
from amrepair.loop.run_folder import Setting, keep
from amrepair.report.folder import RunFolder
from amrepair.scans import Scan, ScanRequest


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made(height_mm=4.0)  # 20 layers


def walk(small: Small, pace: Pace | None, fixed: list[int], troubled: set[int]) -> list[str]:
    """The stops of a run with trouble after some layers."""
    ahead = Stops(small.job, plan_stops(small.job, fixed), pace)
    found = []
    while (stop := ahead.next()) is not None:
        found.append(stop.label)
        ahead.seen(stop, trouble=stop.layer_index in troubled)
    return found


def test_without_a_pace_the_stops_are_those_that_were_asked_for(small: Small) -> None:
    assert walk(small, None, [3, 7], {3}) == ["layer-003", "layer-007", "final"]


def test_clean_looks_come_farther_apart_up_to_a_limit(small: Small) -> None:
    # every 2: 2, then 4, then 8 layers on, and no farther
    assert walk(small, Pace(2), [], set()) == ["layer-001", "layer-005", "layer-013", "final"]


def test_after_trouble_the_next_look_comes_soon(small: Small) -> None:
    assert walk(small, Pace(8), [], {7, 9}) == [
        "layer-007", "layer-009", "layer-011", "layer-015", "final",
    ]  # fmt: skip


def test_trouble_at_a_fixed_stop_hurries_the_pace(small: Small) -> None:
    clean = walk(small, Pace(8), [4], set())
    assert clean == ["layer-004", "layer-007", "final"]
    assert walk(small, Pace(8), [4], {4})[:3] == ["layer-004", "layer-006", "layer-010"]


def test_a_pace_of_no_layers_is_refused() -> None:
    with pytest.raises(LoopError, match="at least one"):
        Pace(0)


def test_a_height_is_the_layer_that_reaches_it(small: Small) -> None:
    tops = [layer.z_mm for layer in small.job.layers]
    assert layers_at(small.job, [tops[0], tops[3], tops[3] + 0.01]) == [0, 3, 4]
    for wrong in (0.0, -1.0, tops[-1] + 0.1, float("nan")):
        with pytest.raises(InputError, match="no layer at z"):
            layers_at(small.job, [wrong])


class Standing:
    """A scanner that sees what should stand at each stop, with a pit after one layer, once."""

    def __init__(self, small: Small, pit_after: int) -> None:
        self.small, self.pit_after, self.asked = small, pit_after, []

    def scan(self, request: ScanRequest) -> Scan:
        small = self.small
        solid = small.part.trim_by_plane((0.0, 0.0, -1.0), -request.z_mm).translate((100, 90, 0))
        if request.layer_index == self.pit_after and request.label not in self.asked:
            pit = m3.Manifold.cube((6.0, 6.0, 5.0))
            solid = solid - pit.translate((105.0, 93.0, request.z_mm - 0.6))
        self.asked.append(request.label)
        return scan_of(solid, seed=len(self.asked))


def test_an_adaptive_run_looks_again_soon_and_is_replayed(small: Small, tmp_path: Path) -> None:
    eye, folder = Standing(small, pit_after=5), tmp_path / "run"
    stops = plan_stops(small.job, [])
    setting = Setting.of(
        small.setup, ("prusa_mk3s", "pla", "repair_0.20"), stops=stops,
        build_from_template=small.placed, build_from_scanner=small.pose, by_beads=False, seed=0,
        adaptive=6,
    )  # fmt: skip
    keep(folder, setting, small.job.program.text, small.template)
    report, _ = small.run(
        folder, eye.scan, stops=stops, pace=Pace(6), tape=Tape(folder),
        look=RunFolder(folder).record,
    )  # fmt: skip
    assert [stop.label for stop in report.by_stop] == [
        "layer-005", "layer-006", "layer-008", "layer-012", "final",
    ]  # fmt: skip
    assert [look.printed for look in report.looks][:2] == [True, False]
    assert not any(look.differences for look in replay(folder))
