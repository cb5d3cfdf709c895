"""The agent beside a small Moonraker: what it prints, asks, refuses, and does after a kill."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from agent_bench import (
    LAYER_MM,
    LOOK_LAYER,
    PRINTER,
    TOP_MM,
    Bench,
    Killed,
    Killer,
    Ready,
    made_ready,
)
from loop_bench import scan_of
from small_klipper import CommandError, SmallKlipper

from amrepair.agent import MACROS, shipped
from amrepair.agent.shipped import UNIT
from amrepair.loop.marked_stops import marked_stops
from amrepair.loop.travel import park
from amrepair.postprocess import LooksAsked, mark
from gcode.check import check
from gcode.errors import PortBusyError, PrinterError
from gcode.hosts import PrintReport
from gcode.hosts.moonraker_job import KlipperJob
from gcode.hosts.secret import VARIABLES, ApiKey
from gcode.hosts.web import Address
from gcode.moves import Program
from gcode.process import signals_end_it
from gcode.profiles import load_setup
from gcode.reader import job_for, read_job
from gcode.resumption.head import filament_back_mm, state_at_rest


@pytest.fixture(scope="module")
def ready(tmp_path_factory: pytest.TempPathFactory) -> Ready:
    return made_ready(tmp_path_factory.mktemp("agent"))


@pytest.fixture
def bench(ready: Ready, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    made = Bench(ready, tmp_path, monkeypatch)
    with made.fake:
        yield made


@pytest.fixture(scope="module")
def undisturbed(ready: Ready, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What is executed where nobody is killed: found, repaired, gone on with."""
    with pytest.MonkeyPatch.context() as patch:
        made = Bench(ready, tmp_path_factory.mktemp("whole"), patch)
        with made.fake:
            made.agent()
            steps = [s for s in made.fake.scripts if s.startswith("_AMREPAIR_STEP")]
            assert len(steps) == STEPS, len(steps)
    assert made.klipper.print_state == "complete"
    assert re.search(r"27\.\d mm³ missing \(a void\)", made.told())
    looks = [event for event in made.events() if event["event"] == "look"]
    assert [look["printed"] for look in looks] == [True, False]
    return made.executed()


STEPS = 28  # park, 26 of the repair, the way back, the modes


def test_a_void_is_found_repaired_and_the_print_goes_on(
    ready: Ready, undisturbed: list[str]
) -> None:
    job = [line for line in ready.text.split("\n") if line and line[0] in "GMT"]
    rest = iter(undisturbed)
    assert all(line in rest for line in job), "every line of the job, in its order"
    more = len(undisturbed) - len(job)
    assert 500 < more < 2000, "and the repair between them"


@pytest.mark.parametrize(
    ("step", "reaches"),
    [
        (17, True),
        *(
            pytest.param(step, reaches, marks=pytest.mark.slow)
            for step in (1, 17, STEPS - 1)
            for reaches in (False, True)
            if (step, reaches) != (17, True)
        ),
    ],
)
def test_an_agent_that_was_killed_goes_on_and_nothing_is_printed_twice(
    bench: Bench, undisturbed: list[str], monkeypatch: pytest.MonkeyPatch, step: int, reaches: bool
) -> None:
    killer = Killer(monkeypatch, step, reaches=reaches)
    with pytest.raises(Killed):
        bench.agent()
    assert bench.klipper.print_state == "paused"
    killer.dead = False
    bench.agent()
    assert bench.klipper.print_state == "complete"
    assert bench.executed() == undisturbed
    assert "gone on with" in bench.told()


@pytest.mark.slow
def test_an_agent_that_is_asked_to_end_leaves_klippers_print_alone(bench: Bench) -> None:
    """As systemd does it, while Klipper prints; started again it goes on."""
    bench.scans = [scan_of(bench.ready.whole)]
    bench.klipper.pause_s = 0.001
    ended: list[str] = []

    def stop(text: str) -> None:
        if "is followed" in text and not ended:
            ended.append(text)
            while bench.klipper.modes.position_mm.get("Z", 0.0) < LAYER_MM:
                time.sleep(0.001)
            bench.klipper.pause_s = 1.0  # else it reaches its look before a busy machine tells us
            os.kill(os.getpid(), signal.SIGTERM)

    bench.answers = stop
    with pytest.raises(KeyboardInterrupt), signals_end_it():
        bench.agent()
    assert bench.klipper.print_state == "printing"
    bench.klipper.pause_s = 0.001
    assert bench.klipper.modes.hotend_c > 200
    bench.agent()
    assert bench.klipper.print_state == "complete"
    assert [e["printed"] for e in bench.events() if e["event"] == "look"] == [False]


@pytest.mark.slow
def test_moonraker_goes_away_in_a_repair(bench: Bench, undisturbed: list[str]) -> None:
    """The answers to two steps are lost with the socket: one was carried out, one not."""
    run_script, lost = bench.klipper.run_script, []

    def cut(script: str) -> None:
        if script.startswith("_AMREPAIR_STEP") and len(lost) < 2:
            lost.append(script)
            if len(lost) == 1:
                run_script(script)
            bench.fake.server.drop_sockets()
            if len(lost) == 2:
                return
        else:
            run_script(script)

    bench.klipper.run_script = cut  # type: ignore[method-assign]
    bench.agent()
    assert len(lost) == 2
    assert bench.executed() == undisturbed


@pytest.mark.slow
def test_it_asks_on_the_printers_screens(bench: Bench, undisturbed: list[str]) -> None:
    buttons: list[str] = []

    def press(text: str) -> None:
        if "footer_button Yes" in text:
            buttons.append(text.split("|")[1])
        elif text == "// action:prompt_show" and buttons:
            bench.klipper.run_script("AMREPAIR_STATUS")
            bench.klipper.run_script("AMREPAIR_APPROVE ANSWER=no QUESTION=99")
            bench.klipper.run_script("AMREPAIR_APPROVE ANSWER=perhaps")
            bench.klipper.run_script(buttons.pop())

    bench.answers = press
    bench.agent("ask")
    assert bench.executed() == undisturbed
    told = bench.told()
    assert "action:prompt_text Print this repair?" in told
    assert re.search(r"action:prompt_text missing: 27\.\d mm³ in 1 region", told)
    assert "a question waits." in told
    assert "no question waits for this answer." in told
    assert "ANSWER is yes or no." in told


@pytest.mark.slow
def test_no_is_no(bench: Bench, ready: Ready) -> None:
    def press(text: str) -> None:
        if text == "// action:prompt_show" and "Print this repair?" in bench.told():
            bench.klipper.run_script("AMREPAIR_APPROVE ANSWER=no")

    bench.answers = press
    assert bench.agent("ask") == 3, "not within tolerance"
    assert bench.klipper.print_state == "complete"
    assert not [event for event in bench.events() if event.get("kind") == "repair"]


def test_a_part_that_moved_ends_the_looks_and_the_heaters(bench: Bench) -> None:
    """Nothing goes on until somebody has decided; then its later looks hold nothing up."""
    looks = LooksAsked(at_z_mm=(TOP_MM, TOP_MM + LAYER_MM), final=False)
    twice = mark(bench.ready.plain, "job.gcode", "klipper", looks)
    assert [place.layer for place in twice.places] == [LOOK_LAYER, LOOK_LAYER + 1]
    (bench.folder / "gcodes" / "small_pla.gcode").write_text(twice.text)
    moved = bench.ready.whole.translate((6.0, 0.0, 0.0))
    bench.scans = [scan_of(moved), scan_of(moved)]
    ended, said = list[str](), list[str]()

    def press(text: str) -> None:
        said.append(text)
        if "footer_button Cancel the print" in text:
            heat = bench.klipper.modes
            ended.append(f"{heat.hotend_c:g} {heat.bed_c:g} {bench.klipper.print_state}")
            time.sleep(0.3)  # six times as long as from look to look: it is left alone
            assert bench.klipper.print_state == "paused"
            bench.klipper.run_script("AMREPAIR_RESUME")

    bench.answers = press
    assert bench.agent() == 4
    assert ended == ["0 0 paused"], "heaters are off and the print rests"
    assert any("It rests. Heaters are off." in text for text in said)
    assert "no more looks at this print" in bench.told()
    assert bench.klipper.print_state == "complete", "somebody let it go on"
    back = bench.executed()[bench.executed().index("M140 S0") :]
    assert back[1:4] == ["M107", "M190 S60", "M109 S210"]


@pytest.mark.slow
def test_somebody_resumes_in_the_midst_of_a_repair(bench: Bench) -> None:
    """Nothing of the repair comes between the job's own lines."""
    carried, seen = bench.klipper.run_script, []

    def resumed(script: str) -> None:
        carried(script)
        if script.startswith("_AMREPAIR_STEP"):
            seen.append(len(bench.klipper.executed))
            if len(seen) == 3:
                bench.klipper.pause_s = 0.002
                carried("RESUME")

    bench.klipper.run_script = resumed  # type: ignore[method-assign]
    bench.agent()
    assert len(seen) == 3
    assert "the print goes on" in bench.told()
    assert "M104 S0" not in bench.executed()[seen[2] : seen[2] + 5], "its heaters are left alone"
    assert bench.klipper.print_state == "complete"


@pytest.mark.slow
def test_klipper_restarts_while_the_print_rests(bench: Bench) -> None:
    carried, steps = bench.klipper.run_script, []

    def restarted(script: str) -> None:
        if script.startswith("_AMREPAIR_STEP"):
            steps.append(script)
            if len(steps) == 3:
                bench.klipper.reset()
                bench.fake.server.drop_sockets()
                return
        carried(script)

    bench.klipper.run_script = restarted  # type: ignore[method-assign]
    bench.agent()
    done = len(bench.klipper.executed)
    assert "no more looks at this print" in bench.told()
    assert bench.klipper.executed[done:] == []
    assert len(steps) == 3, "nothing more of the repair is sent to a printer that forgot its place"


def test_a_klipper_that_shuts_down_in_a_repair_is_not_asked_to_go_on(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    """regression: its print still calls itself paused, so "Heat and go on" was offered."""
    carried, steps = bench.klipper.run_script, []

    def shut_down(script: str) -> None:
        if script.startswith("_AMREPAIR_STEP"):
            steps.append(script)
            if len(steps) == 3:
                bench.klipper.shut_down = (
                    "MCU 'mcu' shutdown: Timer too close\nOnce the underlying issue is corrected, "
                    'use the\n"FIRMWARE_RESTART" command\nPrinter is shutdown'
                )
        carried(script)

    bench.klipper.run_script = shut_down  # type: ignore[method-assign]
    assert bench.agent() == 4
    assert bench.klipper.print_state == "paused"
    told = capsys.readouterr().err
    assert re.search(r"no more looks at this print: .* Timer too close\.$", told, re.MULTILINE)
    assert not any("Heat and go on" in script for script in bench.fake.scripts)
    assert "M140 S0" not in bench.executed()


def test_what_is_asked_at_the_wrong_time_is_one_sentence(ready: Ready, tmp_path: Path) -> None:
    klipper = SmallKlipper(tmp_path, shipped(MACROS))
    (tmp_path / "job.gcode").write_text("G28\nAMREPAIR_SCAN\n" + "G1 X1\n" * 5)
    klipper.run_script("AMREPAIR_SCAN LAYER=3")
    assert klipper.said == [
        "!! AMREPAIR_SCAN: nothing is being printed, so there is nothing to look at."
    ]
    klipper.run_script("SDCARD_PRINT_FILE FILENAME=job.gcode")
    worker = klipper.worker
    if worker is not None:
        worker.join()
    assert "in the middle of a layer nothing can be judged" in klipper.said[-1]
    assert klipper.print_state == "complete", "the print was not stopped for it"
    with pytest.raises(CommandError, match="line 1 was to follow, and line 1"):
        klipper.run_script("_AMREPAIR_STEP PROGRAM=5 FROM=0 TO=9")


def test_a_second_agent_is_refused(bench: Bench) -> None:
    bench.fake.agent_there = True
    with pytest.raises(PortBusyError, match="another agent named 'amrepair' serves the printer"):
        bench.agent()


@pytest.mark.parametrize("trouble", ["no look", "no part"])
def test_a_print_that_cannot_be_looked_at_is_printed(
    bench: Bench, trouble: str, tmp_path: Path
) -> None:
    """One sentence; and a look that nobody can take holds nothing up."""
    path = bench.folder / "gcodes" / "small_pla.gcode"
    if trouble == "no look":
        path.write_text(bench.ready.text.replace(";AMREPAIR_LOOK", ";look"))
        assert bench.agent() == 2
        assert "has no looks in it, name 'amrepair postprocess'" in bench.told()
    else:
        (tmp_path / "parts").mkdir()
        assert bench.agent(template=tmp_path / "parts") == 2
        assert "no part in" in bench.told()
    assert bench.klipper.print_state == "complete"
    assert not [line for line in bench.klipper.said if "Traceback" in line]


@pytest.fixture
def followed(bench: Bench) -> Iterator[KlipperJob]:
    """A port on a job that somebody has begun."""
    printer = KlipperJob(Address.parse(f"moonraker+{bench.fake.url}"), ApiKey(""))
    printer.connect()
    bench.klipper.pause_s = 0.001
    bench.fake.start("small_pla.gcode")
    printer.follow("small_pla.gcode", bench.ready.text.encode())
    setup = load_setup(*PRINTER)
    printer.serve(check(job_for(bench.ready.text, setup.printer).program, setup))
    yield printer
    printer.close()


def test_a_pause_of_the_users_own_is_no_look(bench: Bench, followed: KlipperJob) -> None:
    setup = load_setup(*PRINTER)
    job = job_for(bench.ready.text, setup.printer)
    (look,) = marked_stops(job, "job")
    until_s = time.monotonic() + 10.0
    while bench.klipper.modes.position_mm.get("Z", 0.0) < LAYER_MM:  # it lays its first beads
        assert time.monotonic() < until_s
        time.sleep(0.001)
    bench.klipper.run_script("PAUSE")
    done: list[PrintReport] = []
    checked = check(job.program, setup)
    printing = threading.Thread(
        target=lambda: done.append(followed.print(checked, lines=range(look.line)))
    )
    printing.start()
    printing.join(0.5)
    assert printing.is_alive(), "it waits for whoever has paused it"
    bench.klipper.run_script("RESUME")
    printing.join(20.0)
    (report,) = done
    assert (report.ok, report.next_line) == (True, look.line)
    assert followed.rests_at_look()


def test_a_layer_that_was_printed_by_us_is_left_out(bench: Bench, followed: KlipperJob) -> None:
    """Klipper goes on behind it, from where our own program has ended."""
    setup = load_setup(*PRINTER)
    job = job_for(bench.ready.text, setup.printer)
    checked = check(job.program, setup)
    (look,) = marked_stops(job, "job")
    followed.print(checked, lines=range(look.line))
    own, parked = park(setup, state_at_rest(job, look.line))
    followed.print(own)
    before = len(bench.klipper.executed)
    behind = job.layers[LOOK_LAYER + 1].end_line
    followed.print(checked, lines=range(behind, bench.ready.text.count("\n")))
    after = [line for line in bench.klipper.executed[before:] if line != "M400"]
    x_mm, y_mm, z_mm = parked.position_mm
    assert after[2:4] == [f"G1 X{x_mm:.3f} Y{y_mm:.3f} F6000", f"G1 Z{z_mm:.3f} F600"]
    lines = bench.ready.text.split("\n")[behind:]
    wanted = [line.partition(";")[0].strip() for line in lines if line and line[0] in "GMT"]
    assert after[-len(wanted) :] == wanted
    assert len(after) - len(wanted) < 10, "and nothing of the layer before"


def test_nothing_is_printed_once_the_motors_were_let_go(bench: Bench, followed: KlipperJob) -> None:
    setup = load_setup(*PRINTER)
    job = job_for(bench.ready.text, setup.printer)
    (look,) = marked_stops(job, "job")
    followed.print(check(job.program, setup), lines=range(look.line))
    bench.klipper.homed = ""  # Klipper's idle_timeout
    own, _ = park(setup, state_at_rest(job, look.line))
    before = len(bench.klipper.executed)
    with pytest.raises(PrinterError, match="the motors were let go while the print rested"):
        followed.print(own)
    assert len(bench.klipper.executed) == before


USERS_PAUSE = """\
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
  BASE_PAUSE
  M83
  G1 E-1 F2100

[gcode_macro RESUME]
rename_existing: BASE_RESUME
gcode:
  M83
  G1 E1 F2100
  BASE_RESUME
"""


@pytest.mark.slow
def test_what_the_user_s_pause_pulls_back_is_not_lacking_in_the_repair(bench: Bench) -> None:
    """Mainsail's and Fluidd's macros pull 1 mm: a patch lacked 2.4 mm³, and a blob was left."""
    klipper = bench.klipper
    klipper._config.read_string(USERS_PAUSE)
    klipper.reset()
    klipper.cmd_BASE_PAUSE, klipper.cmd_BASE_RESUME = klipper.cmd_PAUSE, klipper.cmd_RESUME
    bench.agent()
    assert klipper.print_state == "complete"
    text = "\n".join(bench.executed()) + "\n"
    assert text.count("G1 E-1 F2100") == text.count("G1 E1 F2100") == 1
    job = read_job(Program(text, "klipper"))
    steps_mm, pushed_mm, _ = job.moves()
    back_mm = filament_back_mm(job)
    start = next(k for k, line in enumerate(text.split("\n")) if line == "G1 E-1 F2100")
    goes = np.hypot(*np.nan_to_num(steps_mm[:, :2]).T) > 0.0
    later = np.arange(len(goes)) > start
    laid = later & goes & (pushed_mm > 0.0)
    assert laid.sum() > 500
    assert back_mm[:-1][laid].max() < 1e-3  # every bead by a nozzle that is full
    still = later & ~goes & (pushed_mm > 0.0)
    assert (pushed_mm - back_mm[:-1])[still].max() < 1e-3  # and nothing in one place


def test_the_unit_names_the_variable_that_is_read() -> None:
    """Regression: it named one that nothing reads, and the key was missing."""
    named = re.search(r"asks for one: (\w+)=", shipped(UNIT))
    assert named is not None
    assert named[1] == VARIABLES["moonraker"]
