"""What the loop does with each decision: on a small job, a file for a printer, scans by script."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import loop_bench
import numpy as np
import pytest
from loop_bench import LAYER, Small, Thermal, scan_of

from amrepair.errors import LoopError, ScannerError
from amrepair.frames import Transform
from amrepair.loop import Action, Stop, Tape
from amrepair.loop.tape import read_events
from amrepair.policy.limits import exceeded
from amrepair.repair import Site
from amrepair.scans import Scan
from gcode.errors import LinkError
from gcode.hosts.port import PrintReport
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import read_job


@pytest.fixture(scope="module")
def small() -> Small:
    return Small.made()


def laid_mm3(lines: list[str], small: Small) -> dict[float, float]:
    """Plastic by height, as the sent lines have it."""
    job = read_job(Program("\n".join(lines) + "\n", "prusa"), dialect="prusa")
    beads = job.beads
    length = np.linalg.norm(beads.end_mm - beads.start_mm, axis=1)
    z = np.round(beads.end_mm[:, 2], 3)
    return {float(h): float((length * beads.section_mm2)[z == h].sum()) for h in np.unique(z)}


def to_its_end(small: Small, sent: list[str]) -> bool:
    """Whether the job's last bead was sent; its words may be those of another layer's, too."""
    lines = small.job.program.text.splitlines()
    last = [line for line in lines if line.startswith("G1 X") and " E" in line][-1]
    return sent.count(last) >= lines.count(last)


@pytest.mark.slow
def test_a_low_rise_makes_the_next_layer_thinner_there(small: Small, tmp_path: Path) -> None:
    bump = small.block(-0.05, 0.19)  # 0.03 mm over what a layer may leave
    report, sent = small.run(tmp_path, lambda n: scan_of(small.standing + bump, count=15_000))
    (look,) = report.looks
    assert look.decision.action is Action.LOWER_NEXT
    assert {v.row for v in look.decision.changes_next} == {"F6"}
    laid, planned = laid_mm3(sent, small), laid_mm3(small.job.program.text.splitlines(), small)
    above = round(small.job.layers[LAYER + 1].z_mm, 3)
    found_mm3 = look.plan.deficit.excess_mm3
    assert found_mm3 > 3.0
    assert planned[above] - laid[above] == pytest.approx(found_mm3, rel=0.25)
    for height, volume in planned.items():
        if height != above:
            assert laid[height] == pytest.approx(volume, rel=1e-6)


def test_a_thin_gap_is_left_to_the_next_layer_which_carries_it(tmp_path: Path) -> None:
    small = Small.made("repair_0.30", 2.4)
    gap = small.block(-0.2, 0.5, size_mm=7.0)
    report, sent = small.run(tmp_path, lambda n: scan_of(small.standing - gap))
    (look,) = report.looks
    assert look.decision.action is Action.FILL_WITH_NEXT, look.decision.to_json()
    assert not report.repair_prints
    laid, planned = laid_mm3(sent, small), laid_mm3(small.job.program.text.splitlines(), small)
    above = round(small.job.layers[LAYER + 1].z_mm, 3)
    # a bead carries no more than the printer's section allows: most of it, and never more
    assert 0.5 < (laid[above] - planned[above]) / look.plan.deficit.missing_mm3 < 1.05


def test_what_the_head_would_hit_ends_the_run_before_the_next_move(
    small: Small, tmp_path: Path
) -> None:
    tower = small.block(-0.1, 1.5, size_mm=3.0)
    report, sent = small.run(
        tmp_path, lambda n: scan_of(small.standing + tower), tape=Tape(tmp_path)
    )
    assert report.stopped.startswith("pause and ask: blob: the head would hit it")
    assert not report.within_tolerance
    (verdict,) = [v for v in report.looks[0].decision.verdicts if v.row == "F4"]
    assert verdict.finding.hit_mm > 0.8
    job_lines = small.job.program.text.splitlines()
    after = [
        line for line in job_lines[small.job.layers[LAYER].end_line :] if line.startswith("G1 X")
    ]
    assert after[0] not in sent[-60:]
    assert sent[-1] == "heaters off"
    assert read_events(tmp_path)[-1]["stopped"] == report.stopped


def test_somebody_may_say_go_on(small: Small, tmp_path: Path) -> None:
    tower = small.block(-0.1, 1.5, size_mm=3.0)
    asked = []

    def ask(decision: object) -> bool:
        asked.append(decision)
        return True

    report, sent = small.run(tmp_path, lambda n: scan_of(small.standing + tower), ask=ask)
    assert len(asked) == 1
    assert not report.stopped
    assert sum(line == "M107" for line in sent) >= 1
    assert to_its_end(small, sent)


LIMITS = [(5.0, 1e4, 0.0), (1e4, 1.0, 0.0), (1e4, 1e4, 0.999)]  # of volume, time, reach


@pytest.mark.parametrize(
    ("limits", "said"),
    list(zip(LIMITS, ["is missing", "takes", "the nozzle reaches"], strict=True)),
)
def test_each_limit_of_a_profile_is_told(limits: tuple[float, float, float], said: str) -> None:
    names = ("unasked_max_mm3", "unasked_max_s", "unasked_min_reachable_ratio")
    told = load_setup().process.model_copy(update=dict(zip(names, limits, strict=True)))
    found = exceeded(told, missing_mm3=30.0, print_time_s=60.0, unreachable_mm3=3.0)
    assert said in found
    assert "the profile" in found
    assert exceeded(told, missing_mm3=4.0, print_time_s=0.5, unreachable_mm3=0.0) == ""


@pytest.mark.parametrize(
    "limits",
    [*(pytest.param(limits, marks=pytest.mark.slow) for limits in LIMITS[:2]), LIMITS[2]],
    ids=["volume", "time", "reach"],
)
def test_unasked_only_within_the_profile_s_limits(
    small: Small, tmp_path: Path, limits: tuple[float, float, float]
) -> None:
    pocket = small.block(-0.6, 0.5)
    names = ("unasked_max_mm3", "unasked_max_s", "unasked_min_reachable_ratio")
    told = small.setup.process.model_copy(update=dict(zip(names, limits, strict=True)))
    report, _ = small.run(tmp_path, lambda n: scan_of(small.standing - pocket), limits=told)
    assert report.stopped.startswith("pause and ask: ")
    assert "the profile" in report.stopped
    assert report.looks[0].decision.row == "S8"
    assert not report.repair_prints


def test_within_the_limits_it_prints_unasked(small: Small, tmp_path: Path) -> None:
    pocket = small.block(-0.6, 0.5)
    report, _ = small.run(
        tmp_path,
        lambda n: scan_of(small.standing - pocket if n == 1 else small.standing),
        limits=small.setup.process,
    )
    assert not report.stopped
    assert [look.decision.action for look in report.looks] == [Action.FILL_NOW, Action.GO_ON]
    assert report.looks[0].plan.deficit.regions[0].type == "void"


def test_a_part_that_came_off_ends_the_run(small: Small, tmp_path: Path) -> None:
    moved = Transform.from_rotation_translation(
        "scanner", "scanner", rotation=np.eye(3), translation_mm=np.array([2.0, -1.2, 0.0])
    )
    report, sent = small.run(tmp_path, lambda n: scan_of(small.standing).moved(moved))
    assert report.stopped.startswith("stop: detached")
    assert not report.repair_prints
    assert sent[-1] == "heaters off"


def silent(n: int) -> Scan:
    raise ScannerError("nothing new in the folder")


def test_a_silent_scanner_does_not_cost_the_print(small: Small, tmp_path: Path) -> None:
    told: list[str] = []
    report, sent = small.run(
        tmp_path, silent, silent_stops=1, tape=Tape(tmp_path),
        progress=lambda stage, *_: told.append(stage),
    )  # fmt: skip
    assert told.count(f"no look at layer-{LAYER:03d}") == 1  # regression: it was passed in silence
    assert [stop.label for stop in report.passed] == [f"layer-{LAYER:03d}"]
    assert not report.looks
    assert not report.within_tolerance
    assert to_its_end(small, sent)
    assert [e["event"] for e in read_events(tmp_path)].count("no_look") == 1


def test_a_scanner_that_is_gone_ends_the_run(small: Small, tmp_path: Path) -> None:
    with pytest.raises(ScannerError, match="nothing new"):
        small.run(tmp_path, silent)
    assert not to_its_end(small, (tmp_path / "sent.gcode").read_text().splitlines())


@pytest.mark.parametrize("on_a_cable", [True, False])
def test_a_run_that_is_interrupted_leaves_the_printer_safe_whatever_it_is_at(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_a_cable: bool
) -> None:
    """regression: on a cable the nozzle stayed in the part, and heaters on until they were hot."""
    told: list[str] = []

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    does: dict[str, Any] = {
        "print": interrupted,
        "heaters_off": lambda _: told.append("heaters off"),
    }
    if on_a_cable:
        does["make_safe"] = lambda _: told.append("safe")
    # a class of its own: whether one makes safe is asked once, and remembered
    monkeypatch.setattr(loop_bench, "Thermal", type("Interrupted", (Thermal,), does))
    with pytest.raises(KeyboardInterrupt):
        small.run(tmp_path, silent)
    # on a cable before anybody waits, and at the end, where a link that is safe does nothing more
    assert told == (["safe", "safe"] if on_a_cable else ["heaters off"])


@pytest.mark.parametrize(("nth", "kind"), [(2, "park"), (3, "repair"), (4, "back")])
def test_who_cancels_at_the_printer_ends_the_run_whatever_is_printed(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, nth: int, kind: str
) -> None:
    """Regression: cancelled in a repair or on a way, the run looked again and printed on."""
    prints, plain = list[PrintReport](), Thermal.print

    def cancelled(printer: Thermal, *given: Any, **named: Any) -> PrintReport:
        report = plain(printer, *given, **named)
        prints.append(replace(report, ok=len(prints) + 1 != nth))
        return prints[-1]

    monkeypatch.setattr(Thermal, "print", cancelled)
    pocket = small.block(-0.6, 0.5)
    with pytest.raises(LoopError, match=f"^the {kind} was stopped at its line"):
        small.run(
            tmp_path,
            lambda n: scan_of(small.standing - pocket if n == 1 else small.standing),
            limits=small.setup.process,
        )
    assert len(prints) == nth


def test_an_interrupt_waits_for_nothing_that_is_made_beside_the_print(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: the nozzle stayed in the part, hot, until what the next look needs was made."""
    safe, made_safe_first = threading.Event(), list[bool]()

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    def slow(stop: Stop) -> Site:
        made_safe_first.append(safe.wait(5.0))
        raise LoopError("nobody needs it any more")

    monkeypatch.setattr(Thermal, "print", interrupted)
    monkeypatch.setattr(Thermal, "make_safe", lambda _: safe.set(), raising=False)
    monkeypatch.setattr(loop_bench, "sites", lambda *_, **__: slow)
    with pytest.raises(KeyboardInterrupt):
        small.run(tmp_path, silent)
    assert made_safe_first == [True]


def test_heaters_that_cannot_be_reached_at_the_end_are_told(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: a run that a decision ended said 'heaters off', and nobody had heard of it."""

    def unreachable(_: Thermal) -> None:
        raise LinkError("the port failed")

    monkeypatch.setattr(Thermal, "heaters_off", unreachable)
    away = Transform.from_rotation_translation(
        "scanner", "scanner", rotation=np.eye(3), translation_mm=np.array([40.0, 0.0, 0.0])
    )
    report, _ = small.run(tmp_path, lambda n: scan_of(small.standing).moved(away))
    assert report.stopped
    assert "HEATERS COULD NOT BE REACHED (the port failed): switch the printer off" in caplog.text


def test_a_scan_that_does_not_fit_is_taken_again_before_the_run_ends(
    small: Small, tmp_path: Path
) -> None:
    away = Transform.from_rotation_translation(
        "scanner", "scanner", rotation=np.eye(3), translation_mm=np.array([40.0, 0.0, 0.0])
    )
    taken = []

    def scans(n: int) -> Scan:
        taken.append(n)
        return scan_of(small.standing).moved(away) if n == 1 else scan_of(small.standing)

    report, _ = small.run(tmp_path / "once", scans)
    assert taken == [1, 2]
    assert not report.stopped
    report, sent = small.run(tmp_path / "gone", lambda n: scan_of(small.standing).moved(away))
    assert report.stopped.startswith("stop: twice the scan did not fit")
    assert sent[-1] == "heaters off"
