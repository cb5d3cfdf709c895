"""What the command lines say to people: questions, refusals, what a program will do."""

from __future__ import annotations

import errno
import io
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import manifold3d as m3
import numpy as np
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

import gcode
from amrepair.align.standing import refuse_impossible
from amrepair.cli.app import app
from amrepair.cli.approval import Terminal, confirmed
from amrepair.cli.error_calibration import why_perhaps_not_sound
from amrepair.cli.options import part_pose
from amrepair.cli.repairing import pose_of_job
from amrepair.cli.thermal_log import ThermalLog
from amrepair.errors import AlignmentError, AmrepairError, InputError
from amrepair.policy.table import Action, Situation, decide
from amrepair.regions import DefectType, Label, Region
from amrepair.template import MeshSdf
from gcode.cli import console
from gcode.cli.app import app as gcode_app
from gcode.cli.options import plain_text, program_text
from gcode.cli.words import what_it_does
from gcode.errors import InputError as GcodeInputError
from gcode.errors import LinkError
from gcode.estimate import estimate
from gcode.hosts.port import PrintReport, Temperatures
from gcode.hosts.serial import SerialPrinter
from gcode.moves import Program
from gcode.slicing.job import plan_part
from gcode.writer import write
from tests.unit.loop_bench import solid_mesh

SETUP = gcode.load_setup()
PROGRAM = Program(
    "M140 S60\nM104 S215\nG28 X Y\nM190 S60\nM109 S215\nG90\nM83\nG1 X50 Y50 Z2 F3000\n"
    "G1 X60 Y50 E1.2 F1200\nM104 S0\nM140 S0\n",
    "prusa",
)


@pytest.fixture(scope="module")
def sunk() -> MeshSdf:
    """A part whose file has its foot 15 mm below its origin."""
    return MeshSdf.from_mesh(solid_mesh(m3.Manifold.cube((20.0, 10.0, 8.0)).translate((0, 0, -15))))


@pytest.mark.parametrize("pose", ["100,80,15,0", "100,80,15,90", "5,200,14.5,0", "100,80,17.5,0"])
def test_a_part_on_the_bed_is_let_through(sunk: MeshSdf, pose: str) -> None:
    refuse_impossible(sunk, part_pose(pose), SETUP.printer, said=True)


def test_a_part_in_the_bed_is_told_the_height_that_it_needs(sunk: MeshSdf) -> None:
    with pytest.raises(AlignmentError, match=r"15\.0 mm into the bed.*Z = 15\.000"):
        refuse_impossible(sunk, part_pose("100,80,0,0"), SETUP.printer, said=True)


@pytest.mark.parametrize(("said", "cure"), [(True, "Z = 15"), (False, "--scan-frame unknown")])
def test_a_part_in_the_air_is_refused_unless_it_stands_on_a_fixture(
    sunk: MeshSdf, said: bool, cure: str
) -> None:
    pose = part_pose("100,80,40,0")
    with pytest.raises(AlignmentError, match=rf"foot 25\.0 mm above the bed.*{cure}.*--on-fix"):
        refuse_impossible(sunk, pose, SETUP.printer, said=said)
    refuse_impossible(sunk, pose, SETUP.printer, said=said, raised=True)


@pytest.mark.parametrize("pose", ["245,80,15,0", "-5,80,15,0", "100,80,300,0"])
def test_a_part_beyond_the_printer_is_refused(sunk: MeshSdf, pose: str) -> None:
    with pytest.raises(AlignmentError, match=r"beyond the 250 × 210 × 210"):
        refuse_impossible(sunk, part_pose(pose), SETUP.printer, said=True)


def test_a_scan_in_a_frame_of_its_own_is_asked_for_a_pose(sunk: MeshSdf) -> None:
    with pytest.raises(AlignmentError, match="--scan-frame unknown --part-pose"):
        refuse_impossible(sunk, part_pose("-100,80,15,40"), SETUP.printer, said=False)


def test_what_a_program_does_is_said_before_it_is_sent() -> None:
    said = what_it_does(PROGRAM, estimate(PROGRAM, SETUP.printer))
    assert said.startswith("heats the nozzle to 215 °C, heats the bed to 60 °C, homes X and Y but")
    assert "not Z, lays 1 mm of filament at Z 2.00 to 2.00 mm" in said


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no command"),
        (b"; only words\n\n", "no command"),
        (b"GCDE\0\0\1", "cut or damaged"),
        (b"PK\0\0\1", "is no text"),
    ],
)
def test_a_file_without_gcode_passes_no_check(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "job.gcode"
    path.write_bytes(content)
    with pytest.raises(GcodeInputError, match=said):
        program_text(path)


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_a_program_as_editors_leave_it(tmp_path: Path, end: bytes) -> None:
    """Regression: the mark that some put before UTF-8 was refused as a word of the first line."""
    path = tmp_path / "job.gcode"
    path.write_bytes(b"\xef\xbb\xbf" + end.join([b"G28", b"G1 X1 ; \xc3\xbc"]))
    assert program_text(path) == "G28\nG1 X1 ; ü"


def test_a_folder_is_no_text(tmp_path: Path) -> None:
    with pytest.raises(GcodeInputError, match="Is a directory"):
        plain_text(tmp_path)


@pytest.mark.parametrize(("typed", "meant"), [("y\n", True), ("Yes\n", True), ("\n", False),
                                             ("n\n", False), ("what?\n", False)])  # fmt: skip
def test_only_yes_is_yes(monkeypatch: pytest.MonkeyPatch, typed: str, meant: bool) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(typed))
    assert confirmed("Print this repair?") is meant


def test_who_is_asked_hears_why_even_where_no_finding_led_to_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    silent = decide((), Situation(Action.FILL_NOW, laid_nothing=True, seen_twice=True))
    assert Terminal(console.Bars()).to_go_on(silent)
    assert "the nozzle is clogged" in " ".join(capsys.readouterr().err.split())


def test_bars_are_away_while_somebody_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console, "errors", Console(file=io.StringIO(), force_terminal=True))
    bars = console.Bars()
    with bars.shown():
        bars("print", 1.0, 2.0)
        assert bars._bars.live.is_started
        with bars.paused():
            assert not bars._bars.live.is_started
        assert bars._bars.live.is_started
    with bars.paused():  # nothing is drawn yet, or any more
        assert not bars._bars.live.is_started
    assert not bars._bars.live.is_started


def drawn(monkeypatch: pytest.MonkeyPatch, *, terminal: bool) -> tuple[console.Bars, io.StringIO]:
    text = io.StringIO()
    monkeypatch.setattr(console, "errors", Console(file=text, force_terminal=terminal, width=100))
    return console.Bars(), text


def test_bars_tell_stage_count_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bars, text = drawn(monkeypatch, terminal=True)
    with bars.shown():
        bars("check", 500.0, 2000.0)
        with bars.stage("read scan"):
            bars._bars.refresh()
            assert re.search(r"read scan .*for 0:0\d", text.getvalue())  # nobody knows how long
        bars("check", 2000.0, 2000.0)
    assert re.search(r"check .*25 %.* 500/2000", text.getvalue())
    assert re.search(r"read scan .*100 %", text.getvalue())


def test_bars_are_quiet_where_there_is_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    bars, text = drawn(monkeypatch, terminal=False)
    with console.starting(), bars.shown(), bars.stage("read"):
        bars("check", 1.0, 2.0)
    assert text.getvalue() == ""


def test_nobody_there_to_answer_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(InputError, match="--approve auto"):
        confirmed("Print this repair?")


def ended(monkeypatch: pytest.MonkeyPatch, error: BaseException) -> int:
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.command()
    def go() -> None:
        raise error

    monkeypatch.setattr("sys.argv", ["amrepair"])
    with pytest.raises(SystemExit) as end:
        console.run(app, "amrepair", (AmrepairError,))
    assert isinstance(end.value.code, int)
    return end.value.code


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (KeyboardInterrupt(), 130, "amrepair: interrupted"),
        (InputError("no such thing"), 2, "amrepair: no such thing"),
        # regression: a word between colons was told as a picture
        (InputError("--scanner watch:x: [x] is not there"), 2, "watch:x: [x] is not there"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "No space left on device; free"),
        (PermissionError(errno.EACCES, "Permission denied", "a.npz"), 2, "a.npz: Permission den"),
        (typer.Exit(3), 3, ""),
    ],
)
def test_every_end_has_its_code_and_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: BaseException,
    code: int,
    said: str,
) -> None:
    assert ended(monkeypatch, error) == code
    told = capsys.readouterr().err.strip()
    assert said in told
    assert len(told.splitlines()) == bool(said)


@pytest.mark.parametrize("how", ["fails", "ends", "writes"])
def test_an_output_of_before_is_told_from_this_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    """regression: a program that was refused left an older one of its name, and none told so."""
    path = tmp_path / "rest.gcode"
    path.write_text("G28\n")
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.command()
    def go() -> None:
        console.writable(path)
        if how == "writes":
            console.write_text(path, "G28\n")
        if how == "fails":
            raise InputError("there is no such layer.")

    monkeypatch.setattr("sys.argv", ["amrepair"])
    with pytest.raises(SystemExit):
        console.run(app, "amrepair", (AmrepairError,))
    assert (
        capsys.readouterr().err
        == {
            "fails": f"amrepair: there is no such layer; {path} is an older one, left as before.\n",
            "ends": f"{path} is an older one, left as before.\n",
            "writes": "",
        }[how]
    )


def test_an_interrupt_that_a_library_swallows_is_told_as_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """regression: Ctrl+C while trimesh was loading ended in a traceback and exit code 1."""
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.command()
    def go(pressed: bool = False, fails: bool = False) -> None:
        with console.starting():
            with suppress(KeyboardInterrupt):
                if pressed:
                    signal.raise_signal(signal.SIGINT)
            if fails:
                raise TypeError("unsupported operand: 'ExceptionWrapper'")
        assert not pressed, "it goes on"
        raise TypeError

    for words in (["--pressed"], ["--pressed", "--fails"]):
        monkeypatch.setattr("sys.argv", ["amrepair", *words])
        with pytest.raises(SystemExit) as end:
            console.run(app, "amrepair", (AmrepairError,))
        assert end.value.code == 130
        assert capsys.readouterr().err == "amrepair: interrupted\n"
    monkeypatch.setattr("sys.argv", ["amrepair"])
    with pytest.raises(TypeError):  # a fault of ours is no interrupt
        console.run(app, "amrepair", (AmrepairError,))
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupt_while_libraries_load_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], number: signal.Signals
) -> None:
    """regression: `gcode` ended in a traceback, and where it was told to end without a word."""
    usual = signal.default_int_handler if number is signal.SIGINT else signal.SIG_DFL
    before = signal.signal(number, usual)

    class Pressed:
        def find_spec(self, name: str, *_: object) -> None:
            if name == "gcode.cli.app":
                signal.raise_signal(number)

    monkeypatch.delitem(sys.modules, "gcode.cli.app")
    monkeypatch.delattr(gcode.cli, "app", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Pressed(), *sys.meta_path])
    with pytest.raises(SystemExit) as end:
        gcode.cli.main()
    signal.signal(number, before)
    assert end.value.code == 130
    assert capsys.readouterr().err == "gcode: interrupted\n"


def test_an_interrupted_print_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """regression: it said "interrupted" alone."""
    done: list[str] = []

    class Interrupted(SerialPrinter):
        def __init__(self, *_: object, **__: object) -> None: ...
        def connect(self) -> None: ...
        def abort(self) -> None:
            done.append("abort")

        def close(self) -> None:
            done.append("close")

        def print(self, *_: object, **__: object) -> PrintReport:
            raise KeyboardInterrupt

    job = tmp_path / "job.gcode"
    job.write_text("G28\nM104 S0\n")
    monkeypatch.setattr("gcode.hosts.connect", Interrupted)
    run = CliRunner().invoke(gcode_app, ["send", str(job), "--port", "/dev/ttyACM0"])
    assert run.exit_code == 130
    assert done == ["abort", "close"]
    assert "the same command goes on with --resume" in " ".join(run.stderr.split())


def test_a_sound_part_with_defects_is_doubted() -> None:
    """regression: what it has was learned in silence, and no longer told of other scans."""
    chip = Region(Label.MISSING, DefectType.CHIP, 60.0, 30.0, 4.11, np.zeros((2, 3)))
    blob = replace(chip, label=Label.EXCESS, type=DefectType.BLOB, depth_mm=1.0)
    assert why_perhaps_not_sound("a.ply", ()) is None
    said = why_perhaps_not_sound("a.ply", (blob, chip))
    assert said is not None
    assert said.startswith("a.ply shows 2 regions")
    assert "the deepest missing, by 4.11 mm: all of this" in said


def test_with_json_a_failure_is_one_object_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.command()
    def go(as_json: bool = typer.Option(False, "--json"), told: bool = False) -> None:
        if told:
            console.show_json({"ok": False})
        raise InputError("no such thing")

    for words in (["--json"], ["--json", "--told"]):
        monkeypatch.setattr("sys.argv", ["amrepair", *words])
        with pytest.raises(SystemExit) as end:
            console.run(app, "amrepair", (AmrepairError,))
        assert end.value.code == 2
        out, err = capsys.readouterr()
        assert err.strip() == "amrepair: no such thing"
        failure = {"error": "amrepair: no such thing", "exit_code": 2}
        assert json.loads(out) == ({"ok": False} if "--told" in words else failure)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--nonsense", "gcode: no such option: --nonsense; 'gcode --help' shows what it takes."),
        ("check", "gcode check: missing argument 'file'; 'gcode check --help' shows"),
        ("resume-at a.gcode --layer x -o b", "gcode resume-at: invalid value for '--layer'"),
        ("emulat", "gcode: no such command 'emulat'"),
    ],
)
def test_a_usage_error_is_one_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: str, said: str
) -> None:
    monkeypatch.setattr("sys.argv", ["gcode", *words.split(), "--json"])
    with pytest.raises(SystemExit) as end:
        console.run(gcode_app, "gcode", (GcodeInputError,))
    out, err = capsys.readouterr()
    assert end.value.code == 2
    assert err.startswith(said)
    assert len(err.strip().splitlines()) == 1
    assert json.loads(out) == {"error": err.strip(), "exit_code": 2}


@pytest.mark.parametrize(
    "words", ["profiles show prusa_mk3s", "profiles list", "--help", "check none.gcode --json"]
)
def test_a_reader_that_has_gone_ends_it_quietly(words: str) -> None:
    """Such as `gcode … | head -1`: no traceback, and the code that a shell gives for SIGPIPE."""
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes, "wb") as pipe:
        done = subprocess.run(
            [sys.executable, "-c", "from gcode.cli import main; main()", *words.split()],
            stdout=pipe, stderr=subprocess.PIPE, text=True, timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == console.READER_GONE
    said = [line for line in done.stderr.splitlines() if "cannot be read" not in line]
    assert said == []


@pytest.mark.parametrize(("bed_c", "names"), [(60.0, ["hotend", "bed"]), (None, ["hotend"])])
def test_a_run_knows_how_warm_it_was(bed_c: float | None, names: list[str]) -> None:
    clock, hotend_c = iter([100.0, 103.0, 110.0]), iter([205.0, 210.0])
    log = ThermalLog(lambda: Temperatures(next(hotend_c), 215.0, bed_c, bed_c), lambda: next(clock))
    log.note()
    log.note()
    series = log.series()
    assert [one.name for one in series] == names
    assert series[0].time_s.tolist() == [3.0, 10.0]
    assert series[0].measured_c.tolist() == [205.0, 210.0]
    assert series[0].target_c is not None
    assert series[0].target_c.tolist() == [215.0, 215.0]


def test_what_the_journal_noted_lies_between_the_looks() -> None:
    # regression: two points of a run of hours, as many as it had looks
    clock = iter([1000.0, 1003.0, 1010.0])
    log = ThermalLog(lambda: Temperatures(210.0, 215.0, 60.0, 60.0), lambda: next(clock))
    log.note()
    log.note()
    noted = [(900.0, 20.0, 20.0), (1001.0, 150.0, 40.0), (1005.0, 214.0, None)]
    hotend, bed = log.series(noted)
    assert hotend.time_s.tolist() == [1.0, 3.0, 5.0, 10.0]  # nothing of an earlier run
    assert hotend.measured_c.tolist() == [150.0, 210.0, 214.0, 210.0]
    assert hotend.target_c is not None
    assert hotend.target_c[[1, 3]].tolist() == [215.0, 215.0]
    assert np.isnan(hotend.target_c[[0, 2]]).all()  # nobody asked
    assert bed.measured_c.tolist() == [40.0, 60.0, 60.0]


def test_a_printer_without_temperatures_stops_no_run() -> None:
    def silent() -> Temperatures:
        raise LinkError("it is a file and has no temperatures.")

    log = ThermalLog(silent)
    log.note()
    assert log.series() == ()


@pytest.mark.parametrize(
    ("name", "why"), [(".", "it is a folder"), ("none/a.gcode", "there is no folder"), ("a.g", "")]
)
def test_an_output_is_refused_with_the_reason(tmp_path: Path, name: str, why: str) -> None:
    if not why:
        console.writable(tmp_path / name)
        return
    with pytest.raises(GcodeInputError, match=why):
        console.writable(tmp_path / name)


def test_a_job_tells_what_to_type_as_the_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solid = m3.Manifold.cube((16.0, 12.0, 1.0)) + m3.Manifold.cube((6.0, 4.0, 2.0))
    template = MeshSdf.from_mesh(solid_mesh(solid))
    monkeypatch.setattr("amrepair.template.open_template", lambda path, **_: template)
    job, part = tmp_path / "job.gcode", tmp_path / "part.stl"
    path = plan_part(solid.rotate((0, 0, 90)).translate((100.0, 90.0, 0.0)), SETUP).toolpath
    job.write_text(write(path, SETUP, title="L").text)
    words = re.search(r"--part-pose (\S+): say so", pose_of_job(job, part, SETUP))
    assert words is not None
    told = [float(word) for word in words.group(1).split(",")]
    assert told == pytest.approx([100.0, 90.0, 0.0, 90.0], abs=0.1)
    assert "--job" in pose_of_job(None, part, SETUP)
    part.write_text("no job")
    assert "does not tell" in pose_of_job(part, part, SETUP)


def test_a_program_that_lays_nothing_is_told_too() -> None:
    """Homing and heating are no print job; they are sent all the same."""
    said = what_it_does(Program("G28\nM140 S60\nG1 X10 F600\n", "prusa"), None)
    assert said == "heats the bed to 60 °C, homes X, Y and Z, lays no filament"


@pytest.mark.parametrize("shown", [console.out, console.errors], ids=["out", "errors"])
def test_brackets_are_told_as_they_are(shown: Console) -> None:
    """A file part[left].gcode was told as part.gcode, where a command forgot to say so."""
    with shown.capture() as told:
        shown.print("part[left].gcode: nothing speaks against it")
    assert told.get() == "part[left].gcode: nothing speaks against it\n"


def test_calibrating_two_things_at_once_is_refused() -> None:
    # regression: --scan was ignored beside --sound
    words = ["calibrate", "--sound", "a.ply", "--scan", "b.ply", "--job", "c.gcode"]
    found = CliRunner().invoke(app, words)
    assert isinstance(found.exception, InputError)
    assert str(found.exception).startswith("--scan and --job find where the scanner hangs")
