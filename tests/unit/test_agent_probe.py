"""The agent beside a small Moonraker, with the printer's own probe as its scanner."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from agent_bench import PRINTER, TOP_MM, Bench, Killed, Killer, Ready, made_ready

from amrepair.cli import running
from amrepair.cli.scanners import open_scanner
from amrepair.errors import InputError
from gcode.errors import GcodeError, LinkError
from gcode.firmware.contact import ProbeContact
from gcode.profiles import load_setup
from gcode.surfaces import HeightField

MET_MM = 0.02  # five standard deviations of one touch, and a cell of the field's edge


class ProbeBench(Bench):
    """A printer whose nozzle feels what stands there.

    Attributes
    ----------
    felt
        By touch: where, and the height met or None.
    dead
        The probe never triggers.
    """

    def __init__(self, ready: Ready, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        super().__init__(ready, folder, monkeypatch)
        monkeypatch.setattr(running, "open_scanner", open_scanner)
        self.klipper.feel = self._feel
        self.felt: list[tuple[float, float, float | None]] = []
        self.dead = False
        probe = load_setup(*PRINTER).printer.feeler
        self._contacts = [
            ProbeContact.of(probe, HeightField.from_manifold(solid, 0.1, margin_mm=2.0), seed=1)
            for solid in (ready.broken, ready.whole)
        ]

    def _feel(self, depth_mm: float, speed_mm_s: float) -> float | None:
        modes = self.klipper.modes
        assert modes.hotend_c == 0, "never hot"
        x_mm, y_mm = modes.position_mm["X"], modes.position_mm["Y"]
        true_mm = self.klipper.z_mm + self.klipper.shift_mm
        mended = any(event.get("kind") == "repair" for event in self.events())
        met_mm = self._contacts[mended].met_at_mm(x_mm, y_mm)
        way_mm = None if self.dead or met_mm is None else true_mm - met_mm
        if way_mm is not None and way_mm > depth_mm:
            way_mm = None
        self.felt.append((x_mm, y_mm, None if way_mm is None else met_mm))
        return way_mm


def pushed(lines: list[str]) -> float:
    """Filament of lines, mm, all of them relative."""
    found = (re.match(r"G1 .*E(-?[\d.]+)", line) for line in lines)
    return sum(float(match.group(1)) for match in found if match is not None)


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Ready:
    return made_ready(tmp_path_factory.mktemp("agent"))


@pytest.fixture
def bench(
    ready: Ready,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[ProbeBench]:
    made = ProbeBench(ready, tmp_path, monkeypatch)
    with made.fake:
        yield made


def run(bench: ProbeBench) -> None:
    bench.agent(said={"scanner": "probe", "approve": "auto", "scan_timeout_s": 1.0,
                      "sound": (), "seed": 0})  # fmt: skip


@pytest.fixture(scope="module")
def undisturbed(
    ready: Ready,
    tmp_path_factory: pytest.TempPathFactory,
) -> ProbeBench:
    with pytest.MonkeyPatch.context() as patch:
        made = ProbeBench(ready, tmp_path_factory.mktemp("whole"), patch)
        with made.fake:
            run(made)
    return made


@pytest.mark.slow
def test_a_void_is_touched_and_filled(undisturbed: ProbeBench, ready: Ready) -> None:
    assert undisturbed.klipper.print_state == "complete"
    assert "missing (a void)" in undisturbed.told()
    looks = [event for event in undisturbed.events() if event["event"] == "look"]
    assert [look["printed"] for look in looks] == [True, False]
    job = [line for line in ready.text.split("\n") if line and line[0] in "GMT"]
    rest = iter(undisturbed.executed())
    assert all(line in rest for line in job), "every line of the job, in its order"
    heights = [met for _, _, met in undisturbed.felt if met is not None]
    assert len(heights) == len(undisturbed.felt)
    told = [z for event in undisturbed.events() for z in event.get("met_mm", [])]
    assert told == pytest.approx(heights, abs=1e-4), "told in the job's coordinates"
    low = [met for met in heights if met < TOP_MM - 0.5]
    assert len(low) > 3


@pytest.mark.parametrize(
    ("step", "reaches"), [(4, True), pytest.param(4, False, marks=pytest.mark.slow)]
)
def test_killed_in_the_midst_of_touches_it_goes_on(
    bench: ProbeBench,
    monkeypatch: pytest.MonkeyPatch,
    step: int,
    reaches: bool,
) -> None:
    """Steps: park, cold, then one a touch."""
    killer = Killer(monkeypatch, step, reaches=reaches)
    with pytest.raises(Killed):
        run(bench)
    assert len(bench.felt) == 1 + reaches
    assert bench.klipper.modes.hotend_c == 0
    killer.dead = False
    run(bench)
    assert bench.klipper.print_state == "complete"
    assert "gone on with" in bench.told()
    rest = iter(bench.executed())
    assert all(line in rest for line in bench.ready.text.split("\n") if line and line[0] in "GMT")
    (folder,) = (bench.folder / "runs").iterdir()
    repair = (folder / "repair-1.gcode").read_text()
    once = pushed(bench.ready.text.split("\n")) + pushed(repair.split("\n"))
    assert pushed(bench.executed()) == pytest.approx(once, abs=1e-4), "nothing is laid twice"


def test_a_probe_that_meets_nothing_ends_the_looks(bench: ProbeBench) -> None:
    """Lifted, heaters off, one sentence; whoever lets it go on has it hot again."""
    bench.dead = True
    ended: list[str] = []

    def press(text: str) -> None:
        if "footer_button Cancel the print" in text:
            heat, z_mm = bench.klipper.modes, bench.klipper.z_mm + bench.klipper.shift_mm
            ended.append(f"{heat.hotend_c:g} {heat.bed_c:g} {bench.klipper.print_state}")
            assert z_mm > TOP_MM + 3.0
            assert bench.klipper.shift_mm == pytest.approx(0.0, abs=1e-9)
            bench.klipper.run_script("AMREPAIR_RESUME")

    bench.answers = press
    run(bench)
    assert ended == ["0 0 paused"]
    assert len(bench.felt) == 1
    assert "no more looks at this print: Nothing was felt within 3 mm" in bench.told()
    assert bench.klipper.print_state == "complete"
    back = bench.executed()[bench.executed().index("M140 S0") :]
    assert {"M190 S60", "M109 S210"} <= set(back)


def test_what_cannot_touch_is_refused_at_once(bench: ProbeBench) -> None:
    del bench.klipper.variables["AMREPAIR_TOUCH"]
    with pytest.raises(LinkError, match=r"has no macro AMREPAIR_TOUCH.*--klipper-macro FILE"):
        run(bench)
    with pytest.raises(InputError, match="--scanner is 'prob'"):
        bench.agent(said={"scanner": "prob"})


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"named": ("voron", "pla", "repair_0.20")}, "Unknown printer profile"),
        ({"named": ("voron_2_4", "pla", "repair_0.20")}, "probe"),
        ({"named": (None, "wax", "repair_0.20")}, "Unknown material profile"),
        ({"calibration": Path("none.json")}, r"none\.json"),
        ({"template": Path(__file__)}, "a part ends in one of"),
    ],
)
def test_what_no_print_could_be_served_with_is_refused_before_one_begins(
    bench: ProbeBench, changed: dict[str, Any], said: str
) -> None:
    with pytest.raises((InputError, GcodeError), match=said):
        bench.agent(said={"scanner": "probe"}, **changed)
    assert not bench.told()
