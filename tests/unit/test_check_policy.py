"""Danger stops, taste warns: what is refused in a user's own job, what is told, what is added."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from test_check import FAULTS, GOOD, SETUP, program
from typer.testing import CliRunner

from gcode.check import Policy, check, find_refusals, judge, policy_of
from gcode.cli.app import app
from gcode.cli.judging import waits_for_somebody
from gcode.moves import Program
from gcode.profiles import load_setup

TASTE = {
    "bead too thick": ("X80 E0.7 F1200", "X80 E15 F300", "bead too thick"),
    "melts too much": ("X80 E0.7 F1200", "X80 E3.5 F4000", "melts more"),
    "primes too fast": ("G1 E0.8 F2100", "G1 E20 F600", "melts more"),
    "feed": ("X60 Y60 F6000", "X60 Y60 F30000", "feed of X"),
    "acceleration": ("M83\n", "M83\nM204 S20000\n", "acceleration"),
    "acceleration of an axis": ("M83\n", "M83\nM201 Z5000\n", "limit of Z's acceleration"),
    "speed of an axis": ("M83\n", "M83\nM203 Z9000\n", "limit of Z's speed"),
    "jerk": ("M83\n", "M83\nM205 X90\n", "jerk"),
}
# Told in a user's job, by the names they have among the planted faults; all others can hurt.
TOLD = {
    "feed beyond the machine's", "acceleration", "acceleration of an axis", "jerk",
    "machine limit", "heater left on", "bed left on", "chamber left on", "melts too much",
    "melts too much by a flow factor", "melts too much by a speed factor",
    "pushed faster than it melts", "pushed fast bit by bit", "pushed fast on the spot",
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "said"), TASTE.values(), ids=TASTE.keys())
def test_taste_is_told_in_a_users_job_and_refused_in_ours(old: str, new: str, said: str) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    assert any(said in refusal.what for refusal in find_refusals(program(text), SETUP))
    checked = check(program(text), SETUP, policy=Policy.DANGER)
    (warned,) = checked.report.warnings
    assert said in warned.worst.what
    assert text.splitlines()[warned.worst.line - 1] == warned.worst.text
    assert (checked.report.policy, checked.report.added) == (Policy.DANGER, ())
    assert checked.program.text == text


@pytest.mark.parametrize("name", sorted(set(FAULTS) - TOLD - {"never heated"}))
def test_what_can_hurt_is_refused_in_a_users_job_too(name: str) -> None:
    old, new, said = FAULTS[name]
    new = new.replace("E17", "E25")  # 3.01 mm² along 20 mm
    text = GOOD.replace(old, new, 1)
    if name == "relative mode lost":
        text = text.replace("X80 E0.7", "X80 E120")
    found = find_refusals(program(text), SETUP, policy=Policy.DANGER)
    assert found
    assert said is None or any(said in refusal.what for refusal in found)


def test_a_warning_counts_its_lines_and_tells_the_worst() -> None:
    text = GOOD.replace("G1 X80 E0.7 F1200", "G1 X80 E0.8 F9000\nG1 X60 E0.9\nG1 X80 E0.7")
    (warned,) = check(program(text), SETUP, policy=Policy.DANGER).report.warnings
    assert warned.lines == 3
    assert warned.worst.text == "G1 X60 E0.9"
    assert str(warned).endswith("16.2 mm³/s, limit 11.5 mm³/s; 3 lines do")


OFF = GOOD.replace("M104 S0\nM140 S0\n", "")


def test_heaters_that_a_users_job_leaves_on_are_switched_off_and_that_is_told() -> None:
    """regression: a job that leaves the bed on was refused outright."""
    assert len(find_refusals(program(OFF), SETUP)) == 2
    checked = check(program(OFF), SETUP, policy=Policy.DANGER)
    assert checked.report.added == ("M104 S0", "M140 S0")
    assert checked.program.text == OFF + "M104 S0\nM140 S0\n"
    assert checked.lines(0, 2) == ("; a good program", "G21")
    assert [w.worst.what for w in checked.report.warnings] == [
        "hotend left on at the end, M104 S0 is added",
        "bed left on at the end, M140 S0 is added",
    ]
    assert not find_refusals(checked.program, SETUP)  # now it is as strict as ours
    bed = check(program(GOOD.replace("M140 S0\n", "")), SETUP, policy=Policy.DANGER)
    assert bed.report.added == ("M140 S0",)


@pytest.mark.parametrize("policy", list(Policy))
def test_heaters_are_left_on_where_somebody_asks(policy: Policy) -> None:
    checked = check(program(OFF), SETUP, policy=policy, leave_heaters=True)
    assert checked.program.text == OFF
    assert checked.report.added == ()
    assert len(checked.report.warnings) == 2
    # asked or not, nothing else is let through by it
    hot = program(OFF.replace("M109 S215", "M109 S350"))
    assert judge(hot, SETUP, policy=policy, leave_heaters=True).refusals


def test_programs_of_our_own_are_known_by_what_our_writer_leaves_in_them() -> None:
    import manifold3d as m3

    from gcode.slicing.job import slice_part
    from gcode.writer import write

    box = m3.Manifold.cube((8.0, 8.0, 0.6)).translate((90.0, 90.0, 0.0))
    ours = write(slice_part(box, SETUP), SETUP, title="box")
    assert policy_of(ours) is Policy.STRICT
    assert policy_of(program(GOOD)) is Policy.DANGER
    named = program(GOOD.replace("; a good program", "; ;AMREPAIR:start in a comment"))
    assert policy_of(named) is Policy.DANGER


@pytest.mark.parametrize("pause", ["M0 Click", "m600", " M601", "N7 M25", "M226", "M00", "PAUSE"])
def test_a_job_that_waits_for_somebody_says_so_before_it_begins(pause: str) -> None:
    """A loop stood still at an M0 in mid-job, and not a word said why."""
    text = f"G28\nM104 S0\n{pause} ; colour\nG1 X1\n"
    assert waits_for_somebody(text) == (
        f"line 3 ({pause.strip()!r}) waits for somebody at the printer, and nothing is printed "
        "until then"
    )
    assert waits_for_somebody(2 * text).endswith("; 2 lines do")
    none = "M104 S0\nM01X\nM1000\n;M0\nG1 X1 ; M0\nPAUSE_NEXT\nM117 M0\n"
    assert waits_for_somebody(none) == ""


def test_check_and_send_tell_warnings_and_what_they_add(tmp_path: Path) -> None:
    job, sent = tmp_path / "job.gcode", tmp_path / "sent.gcode"
    job.write_text(OFF.replace("X80 E0.7 F1200", "X80 E0.9 F9000"))
    runner = CliRunner()
    judged = runner.invoke(app, ["check", str(job), "--json"])
    assert judged.exit_code == 0
    found = json.loads(judged.stdout)
    assert (found["ok"], found["policy"], found["added"]) == (
        True, "danger", ["M104 S0", "M140 S0"],
    )  # fmt: skip
    assert found["warnings"][0] == {
        "line": 19, "move": "G1 X80 E0.9 F9000", "what": "melts more than the hotend can",
        "value": "16.2 mm³/s", "limit": "11.5 mm³/s", "lines": 1,
    }  # fmt: skip
    words = ["send", str(job), "--port", f"file:{sent}"]
    done = runner.invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["added"] == ["M104 S0", "M140 S0"]
    assert "warning: line 19" in done.stderr
    assert "M140 S0 is added" in done.stderr
    assert sent.read_text().rstrip().splitlines()[-2:] == ["M104 S0", "M140 S0"]
    left = runner.invoke(app, [*words, "--leave-heaters"])
    assert left.exit_code == 0, left.output
    assert sent.read_text().rstrip().splitlines()[-1] == "M84"


@pytest.mark.skipif("AMREPAIR_DATA" not in os.environ, reason="AMREPAIR_DATA is not set")
@pytest.mark.parametrize(
    ("name", "printer", "warned"),
    [
        ("plant-sign", "ender_3", ()),
        ("prusaslicer-cube", "ender_3", ()),
        pytest.param("screw", "ender_3", (), marks=pytest.mark.slow),
        ("vase", "generic_marlin", ()),
        ("cura_slicer", "creality_k1", ()),
        pytest.param("orca_slicer", "creality_k1_max", (), marks=pytest.mark.slow),
    ],
)
def test_real_jobs_run_on_their_machines(name: str, printer: str, warned: tuple[str, ...]) -> None:
    setup = load_setup(printer).melting_all()
    text = (Path(os.environ["AMREPAIR_DATA"]) / "gcode" / f"{name}.gcode").read_text("utf-8")
    job = Program(text, setup.printer.dialect)
    assert policy_of(job) is Policy.DANGER
    report = check(job, setup, policy=Policy.DANGER).report
    assert tuple(w.worst.what for w in report.warnings) == warned
