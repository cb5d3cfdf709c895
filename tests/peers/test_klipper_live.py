"""Our sender prints on a live Klipper: nobody here wrote what answers, or where it goes."""

from __future__ import annotations

import itertools
import math
import os
import re
import select
import signal
import threading
import tty
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from clogged_block import AMREPAIR, ENVIRONMENT, GCODE, PRUSA_SLICER, command, filament_of, sliced
from link_helpers import Unjudged, program
from live_klipper import Api, LiveKlipper
from peer_harness import process, wait_for
from test_moonraker_agent import Stack
from void_loop import fills_a_void

import gcode.hosts.server as server_host
from gcode.errors import LinkError, PrinterError
from gcode.firmware import FirmwareCore
from gcode.firmware.motion import MotionBatch, MotionFile
from gcode.hosts import LinkLostError, connect
from gcode.hosts.journal import Journal
from gcode.hosts.port import NothingMetError
from gcode.hosts.resume import resume
from gcode.hosts.serial import SerialPrinter
from gcode.moves import Program
from gcode.profiles import load_setup
from gcode.reader import read_job
from gcode.resumption.klipper import TOUCH_MACRO
from tests.gcode_text import FILAMENT_MM2, steps_of

pytestmark = pytest.mark.peers

MOVES = [
    f"G1 X{100 + 40 * math.cos(i / 20):.3f} Y{100 + 40 * math.sin(i / 17):.3f}" for i in range(400)
]
Z_OFFSET_MM = -0.35
PROBE = f"""\
[include klipper_touch.cfg]
[probe]
pin: gpio13
z_offset: {Z_OFFSET_MM}
[force_move]
enable_force_move: True
"""
PRESSURE_ADVANCE = "[extruder]\npressure_advance: 0.05\n"
HEAD = ["G21", "G90", "M83", "G28", "G1 Z5 F300", "G1 F6000"]


def sender(klipper: LiveKlipper) -> SerialPrinter:
    return SerialPrinter(klipper.port, dialect="klipper", supervise=False)


def test_it_goes_where_the_program_says(tmp_path: Path) -> None:
    """By its own account of its tool head: absolute and relative words, G92, retractions, arcs."""
    outline = ",".join(f"[{100 + k / 8},100]" for k in range(800))
    straight = [
        f"EXCLUDE_OBJECT_DEFINE NAME=round CENTER=110,110 POLYGON=[{outline}]",
        *HEAD, "M109 S200", "M400", "G92 E0", "M82", *MOVES[:20], "G1 E3 F600",
        *(f"G1 X{100 + i} Y{90 - i} E{3 + i / 20:.3f} F2400" for i in range(20)),
        "M83", "G1 E-2.5 F1800", "G91", "G1 X-6 Y4 F4000", "G1 Z0.4 F300", "G1 E2.5 F1800",
        "G1 X3 Y1 E0.12 F1200", "G90", "G92 X50 Y60", "G1 X55 Y62.5 E0.2",
    ]  # fmt: skip
    lines = [*straight, "G2 X65 Y62.5 I5 J0 E0.4", "G3 X60 Y57.5 I0 J-5 E0.6", "G92 X120 Y110"]
    told = f"{PRESSURE_ADVANCE}[exclude_object]\n"
    with LiveKlipper(tmp_path, told) as klipper, sender(klipper) as printer:
        assert printer.print(program(lines)).ok
        place = printer.place()
        moved = klipper.moves.take()
    assert (place.x_mm, place.y_mm, place.z_mm) == (120.0, 110.0, 5.4)
    ends = iter(moved.end_mm)
    for end in emulated(straight).end_mm[-44:]:  # from its first move in X and Y on
        assert any(np.allclose(end, at, atol=1e-3) for at in ends), end
    ours = emulated(lines)
    assert moved.end_mm[-1] == pytest.approx(ours.end_mm[-1], abs=1e-3)
    pushed_mm = float(np.nansum(read_job("\n".join(lines), dialect="klipper").moves()[1]))
    assert moved.filament_mm.sum() == pytest.approx(pushed_mm, abs=1e-5)
    assert ours.filament_mm.sum() == pytest.approx(pushed_mm, abs=1e-5)


def emulated(lines: list[str]) -> MotionBatch:
    """What the emulated Klipper makes of it."""
    core = FirmwareCore(load_setup("generic_klipper").printer, "klipper")
    for line in lines:
        core.feed(line.encode() + b"\n")
        core.run()
    core.drain()
    return MotionBatch.from_bytes(core.machine.planner.executed.tobytes())


def test_an_interrupt_leaves_its_heaters_off(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with LiveKlipper(tmp_path) as klipper:
        printer = sender(klipper)
        timer = threading.Timer(8.0, lambda: os.kill(os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt), printer:
            printer.print(program([*HEAD[:3], "M104 S80", *HEAD[3:], *MOVES, *MOVES]))
        with Api(klipper.socket) as api:
            target_c = api.query(extruder=["target"])["extruder"]["target"]
    assert "printer: heaters off (the printer reports targets of 0), nozzle lifted" in caplog.text
    assert target_c == 0.0


@pytest.mark.parametrize(
    ("does", "error", "said", "heaters"),
    [
        ("emergency_stop", PrinterError, "Klipper has shut down: Shutdown due to webhooks request",
         "the printer has stopped (Shutdown due to webhooks request)"),
        ("gcode/firmware_restart", LinkError, "Must home axis first|started anew",
         "heaters off (the printer reports targets of 0)"),
        ("the board dies", PrinterError, "Klipper has shut down: Lost communication with MCU",
         "the printer has stopped (Lost communication with MCU"),
        ("klippy dies", LinkLostError, "the port", "HEATERS COULD NOT BE REACHED"),
    ],
)  # fmt: skip
def test_what_ends_a_job_is_told(
    does: str, error: type[LinkError], said: str, heaters: str, tmp_path: Path
) -> None:
    with LiveKlipper(tmp_path) as klipper:

        def end_it() -> None:
            if does == "klippy dies":
                klipper.klippy.kill()
            elif does == "the board dies":
                klipper.board.kill()
            else:
                with Api(klipper.socket) as api:
                    api.call(does)

        printer = sender(klipper)
        printer.connect()
        timer = threading.Timer(8.0, end_it)
        timer.start()
        with pytest.raises(error, match=said):
            printer.print(program([*HEAD[:3], "M104 S80", *HEAD[3:], *MOVES, *MOVES]))
        timer.join()
        assert any(heaters in note for note in printer.notes), printer.notes
        with pytest.raises(LinkError):
            printer.temperatures()
        printer.close()


def place_of(move: str) -> list[float]:
    return [float(word[1:]) for word in move.split()[1:]]


def test_what_a_shutdown_loses_is_not_called_executed(tmp_path: Path) -> None:
    """It acknowledges what it has planned, seconds ahead; a job so ended is not gone on with."""
    job = program([*HEAD, *(f"{move} F3000" for move in MOVES), "M84"])
    stopped_at: list[list[float]] = []
    journal = Journal(tmp_path / "journal.sqlite")

    def refused() -> str:
        again = SerialPrinter(klipper.port, dialect="klipper", supervise=False, journal=journal)
        with pytest.raises(LinkError) as caught:
            resume(again, job, release_c=40.0)
        again.close()
        return str(caught.value)

    with LiveKlipper(tmp_path) as klipper:

        def stop() -> None:
            with Api(klipper.socket) as api:
                told = api.query(motion_report=["live_position"])["motion_report"]
                stopped_at.append(told["live_position"][:2])
                api.call("emergency_stop")

        timer = threading.Timer(12.0, stop)
        timer.start()
        sending = SerialPrinter(klipper.port, dialect="klipper", supervise=False, journal=journal)
        with pytest.raises(PrinterError, match="has shut down") as caught, sending:
            sending.print(job)
        timer.join()
        assert "executed is 0 (up to 1000 acknowledged after it may have been" in str(caught.value)
        latest = journal.latest()
        assert latest is not None
        assert latest.phase == "forgotten"
        away = [math.dist(place_of(move), stopped_at[0]) for move in MOVES]
        assert away.index(min(away)) + 5 < latest.reserved - len(HEAD), "these it has acknowledged"
        assert "Shutdown due to webhooks request" in refused()
        with Api(klipper.socket) as api:
            api.call("gcode/firmware_restart")
        wait_for("it is there again", klipper.is_ready, klipper.log)
        for home in (False, True):
            if home:
                with sender(klipper) as printer:
                    printer.command("G28")
            assert re.search("stopped or started anew.*lines up to 0 are executed", refused())


@pytest.mark.parametrize("line", ["G20", "G1 X500", "G1 X50 F0", "G2 X50 Y50 R60", "G1 E60"])
def test_what_it_refuses_ends_the_job(line: str, tmp_path: Path) -> None:
    with LiveKlipper(tmp_path) as klipper:
        printer = sender(klipper)
        with pytest.raises(PrinterError, match="reports a fault"), printer:
            printer.print(program([*HEAD, "M104 S250", line, "G1 X2 Y2"]))
        with sender(klipper) as again:
            assert again.temperatures().hotend_target_c == 0.0
            assert again.position_mm()[:2] != (2.0, 2.0)


def test_the_emulated_one_answers_as_it_does(tmp_path: Path) -> None:
    """Refused moves above all: what is said, and where it is and in which modes afterwards."""
    lines = [
        "G1 X5", "G28", "G1 X50 Y50 Z5 F6000", "M400", "G1 X500 F9000", "M114", "G91", "G1 X-100",
        "M114", "G1 Y2", "G90", "M83", "G1 X60 E2", "M114", "G1 E-1", "M82", "G92 E3", "G1 X251 E9",
        "M114", "G1 Z-50", "G2 X60 Y60 R20", "G91", "G2 X6 Y6 I3 J3", "G90", "M114", "T0", "T1",
        "P0", "M9999 X1", "foo BAR=1", "g1 x40 f9000", "M400", "M114", "G20", "M0", "M108", "M302",
        "M155 S1", "M203 X3", "M410", "G29", "", "M84 S30", "G1 X3", "M112", "G1 X4", "M114", "",
    ]  # fmt: skip
    core = FirmwareCore(load_setup("generic_klipper").printer, "klipper")
    with LiveKlipper(tmp_path) as klipper, Path(klipper.port).open("r+b", buffering=0) as port:
        tty.setraw(port)
        for line in lines:
            data = line.encode() + b"\n"
            core.feed(data)
            core.run()
            port.write(data)
            said = b""
            while not re.search(rb"^ok\b.*\n", said, re.MULTILINE):
                assert select.select([port], [], [], 30.0)[0], line
                said += port.read(4096)
            assert said == core.take_output(), line


@pytest.mark.parametrize("at_mm", [1.0, -1.0])
def test_it_feels_what_stands_there_or_that_nothing_does(
    at_mm: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Our macro around its PROBE, which the pin ends in the midst of the way, or nothing does."""
    monkeypatch.setenv("FELT_STEPS", str(round(at_mm * 50)))
    (tmp_path / "klipper_touch.cfg").write_text(TOUCH_MACRO)
    lines = ["G28", "G90", "G1 X100 Y100 Z3 F600", "AMREPAIR_TOUCH DEPTH=2.5 SPEED=2"]
    touches = Unjudged(Program("\n".join(lines), "klipper"))
    with LiveKlipper(tmp_path, PROBE) as klipper, sender(klipper) as printer:
        if at_mm < 0.5:
            with pytest.raises(NothingMetError, match="No trigger"):
                printer.touch(touches, range(4))
            assert printer.position_mm()[2] == pytest.approx(3.0 - 2.5 + 5.0, abs=1e-3)  # lifted
        else:
            met_mm = printer.touch(touches, range(4))
            assert met_mm == pytest.approx(at_mm - Z_OFFSET_MM, abs=0.05)  # 0.02 mm a step
            assert printer.position_mm()[2] == pytest.approx(at_mm, abs=0.1)
        printer.command("G1 Z5 F600")
        assert printer.place().z_mm == 5.0
        moved = klipper.moves.take()
    assert moved.end_mm[-1][2] == pytest.approx(5.0, abs=0.05)


@pytest.mark.timeout(600)
def test_a_job_whose_sender_was_killed_goes_on_and_lays_every_bead_once(tmp_path: Path) -> None:
    part, job = tmp_path / "block.stl", tmp_path / "block.gcode"
    trimesh.creation.box((12.0, 10.0, 1.2)).export(part)
    printer = ("--printer", "generic_klipper")
    command(*GCODE, "slice", part, "-o", job, *printer)
    with LiveKlipper(tmp_path) as klipper, Api(klipper.socket) as api:
        to_it = ("--port", klipper.port, *printer, "--journal", tmp_path / "journal.sqlite")
        sending = (*GCODE, "send", job, *to_it)
        log = tmp_path / "send.log"
        with process(*sending, log=log) as sender_process:
            half_mm = sum(step.e_mm for step in steps_of(job.read_text()) if step.e_mm > 0) / 2

            def state() -> dict[str, Any]:
                return api.query(toolhead=["position"], extruder=["target"], heater_bed=["target"])

            wait_for("half of it", lambda: state()["toolhead"]["position"][3] > half_mm, log, 300.0)
            sender_process.kill()

        def is_off() -> bool:
            return state()["extruder"]["target"] == state()["heater_bed"]["target"] == 0.0

        wait_for("the supervisor", is_off, log)
        command(*sending, "--resume")
        moved = klipper.moves.take()
    beads = [step for step in steps_of(job.read_text()) if step.is_bead]
    lays = np.hypot(*(moved.end_mm - moved.start_mm)[:, :2].T) > 0
    assert moved.filament_mm[lays].sum() == pytest.approx(sum(b.e_mm for b in beads), abs=1e-3)
    ends = iter(moved.end_mm[lays & (moved.filament_mm > 0)])
    for bead in beads:
        assert any(np.allclose(bead.end_mm, at, atol=1e-3) for at in ends), bead


@pytest.mark.timeout(900)  # it moves in real time
def test_a_void_is_found_and_filled(tmp_path: Path) -> None:
    setup = load_setup("generic_klipper", process="repair_0.20")
    with LiveKlipper(tmp_path) as klipper:
        fills_a_void(
            setup, klipper.port, klipper.moves.take,
            dialect="klipper", baud=250000, wire_log=tmp_path / "wire.log",
        )  # fmt: skip


CLOG = np.array([[106.0, 107.0, 0.5], [112.0, 112.0, 1.25]])
LOOK_MM = 1.2


class Clogged(LiveKlipper):
    """Its beads come to nothing within a box until it rests; what it moves is written to a file."""

    def __enter__(self) -> Clogged:
        super().__enter__()
        self._ended = threading.Event()
        self._writer = threading.Thread(target=self._write, daemon=True)
        self._writer.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._ended.set()
        self._writer.join()
        super().__exit__(*error)

    def _write(self) -> None:
        clogged = True
        with Api(self.socket) as api, (self.folder / "motion.bin").open("ab") as file:
            while not self._ended.is_set():
                rests = api.query(pause_resume=["is_paused"])["pause_resume"]["is_paused"]
                moved = self.moves.take(settle_s=2.0 if clogged and rests else 0.3)
                for row in pieces(moved, clogged=clogged):
                    file.write(np.array(row, dtype=np.float64).tobytes())
                file.flush()
                clogged = clogged and not rests


def pieces(moved: MotionBatch, *, clogged: bool) -> Iterator[list[float]]:
    """Rows of a motion file; beads in pieces of a millimetre, each laid or not."""
    for start, end, e_mm, speed, time_s in zip(
        moved.start_mm, moved.end_mm, moved.filament_mm, moved.speed_mm_s, moved.time_s, strict=True
    ):
        steps = max(1, round(float(np.hypot(*(end - start)[:2])))) if e_mm > 0 else 1
        for a, b in itertools.pairwise(np.linspace(start, end, steps + 1)):
            stuck = clogged and bool(((CLOG[0] <= b) & (b <= CLOG[1])).all())
            yield [*a, *b, 0.0 if stuck else e_mm / steps, speed, time_s]


class LiveStack(Stack):
    """A live Klipper with our macros, a real Moonraker before it."""

    def start(self, macros: Path) -> None:
        self.printer = self.keep.enter_context(Clogged(self.folder, f"[include {macros}]\n"))
        self.start_moonraker()


def test_an_unknown_command_is_told_through_moonraker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_host, "require_checked", lambda checked: None)
    lines = ["G28", "G1 X50 Y50 F6000", "M900 K0.1", "T0", "M900 K0.2", *MOVES[:20]]
    with ExitStack() as keep:
        stack = LiveStack(tmp_path, keep)
        stack.start(Path("/dev/null"))
        printer = keep.enter_context(connect(f"moonraker+{stack.url}", dialect="klipper"))
        report = printer.print(program(lines))
        stack.web.http.close()
    assert report.ok
    assert report.warnings == ('// Unknown command:"M900"', '// Unknown command:"T0"')


@pytest.mark.timeout(900)
@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_the_agent_mends_a_slicers_job_through_moonraker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As users have it: a job from their slicer, Moonraker, Klipper with our macros, the agent."""
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    with ExitStack() as keep:
        stack = LiveStack(tmp_path, keep)
        job = sliced(
            tmp_path, flavour="klipper", reads="klipper", size_mm=(14.0, 12.0, 2.0),
            at_mm=(f"{LOOK_MM:g}",),
        )  # fmt: skip
        macros = tmp_path / "amrepair.cfg"
        command(*AMREPAIR, "agent", "--macros", macros)
        stack.start(macros)
        agent = stack.agent("--approve", "auto")
        log = tmp_path / "agent.log"
        wait_for("the agent", lambda: log.exists() and "the agent is here" in stack.said(), log)
        stack.upload(job)
        assert agent.wait(timeout=700) == 0, stack.said()
        assert re.search(r"missing \(a void.*\)\. Printed", stack.said())
        assert "Nothing is missing any more" in stack.console()
        wait_for("the job's end", lambda: stack.state() == "complete", log, 300.0)
        with Api(stack.klippy) as api:
            said = api.query(extruder=["target"], heater_bed=["target"])
        stack.web.http.close()
    assert [heater["target"] for heater in said.values()] == [0.0, 0.0]
    batch = MotionFile(tmp_path / "motion.bin").take()
    laid = np.hypot(*(batch.end_mm - batch.start_mm)[:, :2].T) > 0
    inside = ((batch.end_mm >= CLOG[0]) & (batch.end_mm <= CLOG[1])).all(axis=1) & laid
    filled_mm3 = float(batch.filament_mm[inside].sum()) * FILAMENT_MM2
    assert filled_mm3 == pytest.approx(30.0 * 0.8, rel=0.3)  # four layers
    above = laid & (batch.end_mm[:, 2] > LOOK_MM + 0.15)
    lines = job.read_text().split("\n")
    first = next(k for k, line in enumerate(lines) if line.startswith("AMREPAIR_SCAN"))
    planned = [line for line in lines[first:] if re.match(r"G1 (X|Y).*E", line)]
    assert float(batch.filament_mm[above].sum()) == pytest.approx(filament_of(planned), rel=1e-4)
