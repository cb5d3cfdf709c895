"""The fleet: one process a printer, restarted so often and no more; asked, stopped, remembered."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fleet_judges
import numpy as np
import pytest

from amrepair.errors import InputError
from amrepair.fleet.chart import ChartOptions, alarm_ratio, chart, false_alarm_ratio, limit_of
from amrepair.fleet.config import FleetConfig, FleetOptions, PrinterSpec, read_config
from amrepair.fleet.desk import JUDGES, STATUS, Desk, answer, read_note
from amrepair.fleet.history import SAME_HEIGHT_MM, History
from amrepair.fleet.page import Page, metrics
from amrepair.fleet.supervisor import DESK, Command, Fleet, RunState, loop_command

ENTRY = 'name = "{name}"\nport = "{port}"\nscanner = "watch:s"\njob = "j.gcode"\ntemplate = "t.stl"'


def config_file(folder: Path, *printers: tuple[str, str], head: str = "") -> Path:
    tables = [f"[[printer]]\n{ENTRY.format(name=n, port=p)}\n" for n, p in printers]
    path = folder / "fleet.toml"
    path.write_text(head + "\n" + "\n".join(tables))
    return path


def test_a_file_is_read_with_paths_beside_it(tmp_path: Path) -> None:
    path = config_file(tmp_path, ("a", "/dev/a"), head='out = "runs"\nrestarts = 1')
    found = read_config(path)
    assert found.options.out == tmp_path / "runs"
    assert found.options.restarts == 1
    (spec,) = found.printers
    assert (spec.job, spec.scanner) == (tmp_path / "j.gcode", f"watch:{tmp_path / 's'}")


@pytest.mark.parametrize(
    ("key", "said", "meant"),
    [
        ("scanner", "python:camera.py", "python:{}/camera.py"),
        ("scanner", "simulated:motion.bin", "simulated:{}/motion.bin"),
        ("scanner", "probe", "probe"),
        ("printer", "own.toml", "{}/own.toml"),
        ("printer", "prusa_mk3s", "prusa_mk3s"),
    ],
)
def test_whatever_names_a_file_is_beside_it(
    tmp_path: Path, key: str, said: str, meant: str
) -> None:
    # regression: of a scanner's own file and of own profiles it was not, though the page says so
    path = config_file(tmp_path, ("a", "/dev/a"))
    text = re.sub(f"{key} = .*\n", "", path.read_text())
    path.write_text(f'{text}\n{key} = "{said}"\n')
    (spec,) = read_config(path).printers
    assert getattr(spec, key) == meant.format(tmp_path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no printer"),
        ("x = [", "not valid TOML"),
        ("speed = 3\n[[printer]]\n" + ENTRY, "unknown key 'speed'"),
        ("[[printer]]\nname = 'a'", "printer 1: key 'port' is missing"),
        ("[[printer]]\nname = 3", "'name' = 3 is not accepted"),
        ("restarts = -1\n[[printer]]\n" + ENTRY.format(name="a", port="b"),
         "'restarts' = -1 is out of range: it must be at least 0"),
        ("judges = -2\n[[printer]]\n" + ENTRY.format(name="a", port="b"),
         "'judges' = -2 is out of range"),
        ("judged_within_s = 0\n[[printer]]\n" + ENTRY.format(name="a", port="b"),
         "'judged_within_s' = 0 is out of range: it must be more than 0"),
        ("within_s = nan\n[[printer]]\n" + ENTRY.format(name="a", port="b"),
         "'within_s' = nan is not accepted"),
        ("[[printer]]\n" + ENTRY.format(name="../a", port="b"), "becomes a folder"),
        ("[[printer]]\n" + ENTRY.format(name="a", port="b") + "\napprove='yes'",
         "should be 'ask' or 'auto'"),
    ],
)  # fmt: skip
def test_files_that_cannot_be_used(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "fleet.toml").write_text(text)
    with pytest.raises(InputError, match=said):
        read_config(tmp_path / "fleet.toml")


def test_a_port_has_one_printer(tmp_path: Path) -> None:
    (tmp_path / "ttyA").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyA")
    twice = [("a", str(tmp_path / "ttyA")), ("b", str(tmp_path / "by-id"))]
    with pytest.raises(InputError, match="two printers have the port"):
        read_config(config_file(tmp_path, *twice))
    with pytest.raises(InputError, match="two printers have the name a"):
        read_config(config_file(tmp_path, ("a", "/dev/a"), ("a", "/dev/b")))


# ---- questions -----------------------------------------------------------------------------------


def test_a_question_waits_for_its_own_answer(tmp_path: Path) -> None:
    asked: list[int] = []

    def sleep(_: float) -> None:
        note = read_note(tmp_path / STATUS)
        assert note is not None
        asked.append(note["question"]["number"])
        if len(asked) == 1:
            answer(tmp_path, asked[0] - 1, yes=True)  # a late word on an earlier one
        else:
            answer(tmp_path, asked[0], yes=len(asked) == 2)

    desk = Desk(tmp_path, sleep=sleep)
    assert desk.ask("Print?", ["2 mm³ missing"])
    assert len(asked) == 2
    note = read_note(tmp_path / STATUS)
    assert note is not None
    assert note["question"] is None


def test_a_clock_that_is_set_back_silences_no_desk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: until the clock was where it had been, nobody heard how far the print was."""
    desk = Desk(tmp_path)
    desk.progress("print", 1.0, 10.0)
    now_s = time.time() - 3600.0
    monkeypatch.setattr("time.time", lambda: now_s)
    desk.progress("print", 2.0, 10.0)
    assert (read_note(tmp_path / STATUS) or {})["done"] == 2.0


def test_nobody_answers_where_the_supervisor_has_gone(tmp_path: Path) -> None:
    parents = iter([10, 10, 1])
    desk = Desk(tmp_path, sleep=lambda _: None, parent=lambda: next(parents))
    with pytest.raises(InputError, match="supervisor has ended"):
        desk.ask("Print?", [])


# ---- processes -----------------------------------------------------------------------------------

CHILD = """
import os, signal, sys, time
sys.path[:0] = [{root!r}]
from pathlib import Path
from amrepair.fleet.desk import Desk
folder = Path({folder!r})
with (folder / "starts").open("a") as log:
    log.write("resume\\n" if {going_on} else "begin\\n")
desk = Desk(folder / "desk")
def end(*_):
    (folder / "heaters").write_text("off")
    os._exit(130)
signal.signal(signal.SIGTERM, end)
{body}
"""


def fake(body: str | Callable[[PrinterSpec], str]) -> Command:
    """A printer's process that does what its body says."""

    def command(spec: PrinterSpec, folder: Path, going_on: bool) -> list[str]:
        said = body if isinstance(body, str) else body(spec)
        text = CHILD.format(
            root=str(Path(__file__).parents[2]), folder=str(folder), going_on=going_on, body=said
        )
        return [sys.executable, "-c", text, str(folder / DESK)]

    return command


def spec_of(name: str, **more: Any) -> PrinterSpec:
    return PrinterSpec(name=name, port=f"/dev/{name}", scanner="watch:x", **more)


def fleet_of(tmp_path: Path, names: str, command: Command, **options: Any) -> Fleet:
    specs = tuple(
        spec_of(name, job=Path("j.gcode"), template=Path("t.stl")) for name in names.split()
    )
    told = FleetOptions(out=tmp_path / "out", **options)
    return Fleet(FleetConfig(options=told, printers=specs), command=command)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("amrepair.fleet.supervisor.BACK_OFF_S", 0.0)


def until(fleet: Fleet, true: Callable[[], object]) -> None:
    end_s = time.monotonic() + 60.0
    while not true():
        fleet.step()
        assert time.monotonic() < end_s, fleet.told()
        time.sleep(0.02)


@pytest.fixture
def ended() -> Iterator[list[Fleet]]:
    fleets: list[Fleet] = []
    yield fleets
    for one in fleets:
        one.end()


def states(fleet: Fleet) -> list[str]:
    return [row["state"] for row in fleet.told()]


@pytest.mark.usefixtures("quick")
def test_ends_are_told_and_only_a_death_is_begun_again(tmp_path: Path, ended: list[Fleet]) -> None:
    bodies = {
        "good": "sys.exit(0)",
        "beyond": "sys.exit(3)",
        "link": 'print(\'{"error": "the cable is out"}\'); sys.exit(4)',
        "dies": "os.kill(os.getpid(), 9)",
        "once": "p = folder / 'x'\nif p.exists(): sys.exit(0)\np.touch(); os._exit(1)",
    }
    fleet = fleet_of(
        tmp_path, " ".join(bodies), fake(lambda spec: bodies[spec.name]), restarts=2
    )  # fmt: skip
    ended.append(fleet)
    until(fleet, lambda: fleet.over)
    assert states(fleet) == [
        RunState.DONE,
        RunState.BEYOND,
        RunState.FAILED,
        RunState.FAILED,
        RunState.DONE,
    ]
    rows = {row["name"]: row for row in fleet.told()}
    assert rows["link"]["sentence"] == "the cable is out"
    assert "ended by signal 9, after 2 restarts" in rows["dies"]["sentence"]
    starts = {
        name: len((tmp_path / "out" / name / "starts").read_text().splitlines()) for name in bodies
    }
    assert starts == {"good": 1, "beyond": 1, "link": 1, "dies": 3, "once": 2}


def test_a_question_is_answered_once_and_a_run_is_stopped(
    tmp_path: Path, ended: list[Fleet]
) -> None:
    body = "yes = desk.ask('Print?', ['a void'])\n(folder / 'said').write_text(str(yes))\n"
    fleet = fleet_of(tmp_path, "a b", fake(body + "time.sleep(60)"))
    ended.append(fleet)
    until(fleet, lambda: states(fleet) == [RunState.ASKS, RunState.ASKS])
    number = fleet.told()[0]["question"]["number"]
    assert not fleet.do("a", "approve", number - 1)
    assert not fleet.do("none", "stop")
    assert fleet.do("a", "approve", number)
    said = tmp_path / "out" / "a" / "said"
    until(fleet, lambda: said.exists() and said.read_text())
    assert said.read_text() == "True"
    assert not fleet.do("a", "skip", number)
    assert fleet.do("b", "stop")
    until(fleet, lambda: fleet.told()[1]["state"] == RunState.STOPPED)
    assert (tmp_path / "out" / "b" / "heaters").read_text() == "off"
    told = fleet.told()[1]["sentence"]
    assert told == "stopped; nothing was said of its heaters: see that they are off"
    fleet.end()
    assert states(fleet) == [RunState.STOPPED, RunState.STOPPED]
    assert (tmp_path / "out" / "a" / "heaters").read_text() == "off"


@pytest.mark.usefixtures("quick")
def test_what_is_said_of_heaters_is_what_the_run_said_last(
    tmp_path: Path, ended: list[Fleet]
) -> None:
    """Regression: a run that was stopped, or died, had its 'heaters off' whatever it had said."""
    bodies = {
        "off": "print('printer: heaters off (the printer reports targets of 0)', file=sys.stderr)",
        "lost": "print('printer: HEATERS COULD NOT BE REACHED (x)', file=sys.stderr)",
    }
    fleet = fleet_of(
        tmp_path, "off lost", fake(lambda spec: bodies[spec.name] + "; sys.exit(130)")
    )  # fmt: skip
    ended.append(fleet)
    until(fleet, lambda: fleet.over)
    rows = {row["name"]: row["sentence"] for row in fleet.told()}
    assert rows["off"] == "stopped; heaters off (the printer reports targets of 0)"
    assert rows["lost"] == "stopped; HEATERS COULD NOT BE REACHED (x)"


def test_a_stuck_question_ends_its_run(tmp_path: Path, ended: list[Fleet]) -> None:
    fleet = fleet_of(tmp_path, "a", fake("desk.ask('Print?', [])"), answer_within_s=0.5)
    ended.append(fleet)
    until(fleet, lambda: fleet.over)
    assert states(fleet) == [RunState.STOPPED]
    assert "nobody answered" in fleet.told()[0]["sentence"]
    assert (tmp_path / "out" / "a" / "heaters").read_text() == "off"


def test_what_a_killed_supervisor_left_running_is_not_begun_twice(
    tmp_path: Path, ended: list[Fleet]
) -> None:
    command = fake("time.sleep(60)")
    first = fleet_of(tmp_path, "a", command)
    ended.append(first)
    status = tmp_path / "out" / "a" / DESK / STATUS
    until(first, lambda: read_note(status))
    second = fleet_of(tmp_path, "a", command)  # as after a kill of the first
    for _ in range(5):
        second.step()
    assert states(second) == [RunState.ORPHAN]
    assert (tmp_path / "out" / "a" / "starts").read_text() == "begin\n"
    assert second.do("a", "stop")
    heaters = tmp_path / "out" / "a" / "heaters"
    end_s = time.monotonic() + 30.0
    while not heaters.exists() or not heaters.read_text():
        assert time.monotonic() < end_s
        time.sleep(0.02)


def test_a_run_that_is_over_is_not_printed_again(tmp_path: Path) -> None:
    tape = tmp_path / "out" / "a" / "run.jsonl"
    tape.parent.mkdir(parents=True)
    tape.write_text('{"event": "send", "time_s": 1}\n{"event": "end", "stopped": ""}\n')
    fleet = fleet_of(tmp_path, "a", fake("sys.exit(0)"))
    for _ in range(3):
        fleet.step()
    assert states(fleet) == [RunState.DONE]
    assert not fleet.do("a", "resume")
    assert not (tape.parent / "starts").exists()


def test_two_supervisors_do_not_share_a_folder(tmp_path: Path) -> None:
    one, other = (fleet_of(tmp_path, "a", fake("")) for _ in range(2))
    with one.alone(), pytest.raises(InputError, match="another fleet works"), other.alone():
        pass


def test_printers_may_ask_judges_as_long_as_the_supervisor_is_there(
    tmp_path: Path, ended: list[Fleet], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("amrepair.fleet.judges.serve", fleet_judges.idle)
    body = "(folder / 'threads').write_text(os.environ['NUMBA_NUM_THREADS'])\ntime.sleep(60)"
    fleet = fleet_of(tmp_path, "a b", fake(body), judges=2, judged_within_s=7.0, restarts=0)
    ended.append(fleet)
    notes = [tmp_path / "out" / name / DESK / JUDGES for name in "ab"]
    with fleet.alone():
        said = [read_note(note) for note in notes]
        assert said[0] == said[1]
        assert said[0] is not None
        assert said[0]["within_s"] == 7.0
        assert Path(said[0]["address"]).is_socket()
        threads = tmp_path / "out" / "a" / "threads"
        until(fleet, lambda: threads.exists() and threads.read_text())
        assert threads.read_text() == "1"  # as the judges have: the same bits
        assert fleet._judges is not None
        os.kill(fleet._judges.processes[0], signal.SIGKILL)
        until(fleet, lambda: fleet.notes)
        assert "each printer's process judges its own scans" in fleet.notes[0]
        assert not any(note.exists() for note in notes)
        assert states(fleet) == [RunState.RUNS, RunState.RUNS]
    again = fleet_of(tmp_path, "a b", fake(body), judges=1)
    with again.alone():
        assert all(note.exists() for note in notes)
    assert not any(note.exists() for note in notes)
    with fleet_of(tmp_path, "a b", fake(body), judges=0).alone():
        assert not any(note.exists() for note in notes)


def test_the_command_of_a_printer_is_understood(tmp_path: Path) -> None:
    import typer

    from amrepair.cli.app import app

    spec = spec_of("a", job=Path("j"), template=Path("t"), every=3, at_layer=(4, 9))
    command = typer.main.get_command(app).commands["loop"]  # type: ignore[attr-defined]
    for going_on in (False, True):
        words = loop_command(spec, tmp_path, going_on)
        context = command.make_context("loop", words[4:])
        assert context.params["desk"] == tmp_path / DESK
        assert context.params["port"] == "/dev/a"
    assert context.params["resume"] == tmp_path


# ---- the page ------------------------------------------------------------------------------------


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Page, Fleet]]:
    fleet = fleet_of(tmp_path, "a", fake("desk.ask('Print?', ['<b>void</b>'])\nsys.exit(0)"))
    history = History(tmp_path / "history.sqlite")
    page = Page(fleet, history, host="127.0.0.1", port=0, token=None)
    yield page, fleet
    page.close()
    fleet.end()
    history.close()


def asked(url: str, *, body: object = None, headers: dict[str, str] | None = None) -> Any:
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(url, data, headers or {})
    try:
        with urllib.request.urlopen(request, timeout=10) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        with error:
            return error.code, error.read().decode()


def test_the_page_answers_and_is_guarded(served: tuple[Page, Fleet]) -> None:
    page, fleet = served
    until(fleet, lambda: states(fleet) == [RunState.ASKS])
    status, text = asked(page.url)
    assert status == 200
    assert "http://" not in text
    assert "innerHTML" not in text
    row = json.loads(asked(page.url + "state.json")[1])["printers"][0]
    assert row["question"]["lines"] == ["<b>void</b>"]
    button = page.url + "printers/a/approve"
    number = {"number": row["question"]["number"]}
    assert asked(button, body=number, headers={"Origin": "http://evil.example"})[0] == 403
    assert asked(button, body=number, headers={"Host": "evil.example"})[0] == 403
    assert asked(button, body=[])[0] == 400
    assert asked(page.url + "printers/a/explode", body={})[0] == 404
    assert asked(page.url + "nothing")[0] == 404
    assert asked(button, body={"number": 1})[0] == 409
    assert asked(button, body=number)[0] == 200
    until(fleet, lambda: fleet.over)
    assert states(fleet) == [RunState.DONE]
    said = asked(page.url + "metrics")[1]
    assert 'amrepair_printer_state{printer="a",state="done"} 1' in said.splitlines()


def test_off_this_machine_a_token_is_needed(tmp_path: Path) -> None:
    fleet, history = fleet_of(tmp_path, "a", fake("")), History(tmp_path / "h.sqlite")
    with pytest.raises(InputError, match="give --token"):
        Page(fleet, history, host="0.0.0.0", port=0, token=None)
    page = Page(fleet, history, host="127.0.0.1", port=0, token="0123456789abcdef0123")
    base = page.url.partition("?")[0]
    assert asked(base + "state.json")[0] == 403
    assert asked(base + "printers/a/stop", body={})[0] == 403
    cookie = {"Cookie": "amrepair_token=0123456789abcdef0123"}
    assert asked(base + "state.json", headers=cookie)[0] == 200
    page.close()
    history.close()


def test_metrics_are_prometheus_text() -> None:
    printers = [{"name": 'a"b\\', "state": RunState.ASKS, "question": {}, "restarts": 2,
                 "judged": {"shared": 3, "itself": 1, "why": "it was late"}}]  # fmt: skip
    history = [
        {"printer": "a", "part": "p", "runs": 1, "looks": 2, "repairs": 1, "missing_mm3": 2.5,
         "excess_mm3": 0.0}
    ]  # fmt: skip
    lines = metrics(printers, history).splitlines()
    sample = re.compile(r'amrepair_\w+\{(\w+="([^"\\]|\\.)*",?)+\} -?[0-9.e+]+')
    for line in lines:
        assert line.startswith(("# HELP ", "# TYPE ")) or sample.fullmatch(line), line
    assert 'amrepair_restarts_total{printer="a\\"b\\\\"} 2' in lines
    assert 'amrepair_missing_mm3_total{printer="a",part="p"} 2.5' in lines
    assert 'amrepair_judged_total{printer="a\\"b\\\\",by="shared"} 3' in lines
    assert 'amrepair_judged_total{printer="a\\"b\\\\",by="itself"} 1' in lines
    assert len([line for line in lines if line.endswith(" 1") and "state=" in line]) == 1


# ---- history and chart ---------------------------------------------------------------------------


def write_tape(folder: Path, began_s: float, missing_mm3: list[float], *, over: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    events: list[dict[str, Any]] = [{"event": "send", "time_s": began_s}]
    for number, value in enumerate(missing_mm3):
        events.append(
            {"event": "look", "time_s": began_s + number, "look": number, "stop": f"layer-{number}",
             "z_mm": 2.0 + SAME_HEIGHT_MM * number, "missing_mm3": value, "excess_mm3": 0.5,
             "printed": value > 1.0}
        )  # fmt: skip
    if over:
        events.append({"event": "end", "time_s": began_s + 99, "stopped": ""})
    (folder / "run.jsonl").write_text("".join(json.dumps(e) + "\n" for e in events))


def test_a_look_is_kept_once(tmp_path: Path) -> None:
    history = History(tmp_path / "h.sqlite")
    for n in (1, 3, 3):
        write_tape(tmp_path / "run", 100.0, [0.0, 2.0, 0.5][:n], over=n == 3)
        history.take("a", "part", tmp_path / "run", "runs")
    write_tape(tmp_path / "run", 200.0, [1.5], over=True)
    history.take("a", "part", tmp_path / "run", "done")
    history.close()
    history = History(tmp_path / "h.sqlite")
    (row,) = history.by_printer()
    assert row == {
        "printer": "a", "part": "part", "runs": 2, "looks": 4, "repairs": 2, "missing_mm3": 4.0,
        "excess_mm3": 2.0,
    }  # fmt: skip
    assert [(one.low_mm, len(one.values_mm3)) for one in history.lessons()] == [
        (0.0, 2), (5.0, 1), (10.0, 1),
    ]  # fmt: skip
    history.close()


def test_a_printer_that_lacks_more_at_one_height_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    history = History(tmp_path / "h.sqlite")
    for run in range(45):
        low, high = (float(rng.exponential()) for _ in range(2))
        write_tape(tmp_path / "r", 1e9 + 1e5 * run, [low, high + 5.0 * (run >= 30)], over=True)
        history.take("mk3", "part", tmp_path / "r", "done")
    lessons = [one for one in history.lessons() if one.told()]
    history.close()
    assert [(one.printer, one.low_mm) for one in lessons] == [("mk3", 5.0)]
    assert lessons[0].chart.since in range(28, 33)  # it began at run 30
    assert "mk3 under-extrudes between 5 and 10 mm since" in lessons[0].told()


@pytest.mark.parametrize("shape", ["normal", "mostly nothing"])
def test_false_alarms_are_as_rare_as_stated(shape: str) -> None:
    """By simulation, with errors of two kinds; ties make alarms rarer, never more frequent."""
    options = ChartOptions()
    rng = np.random.default_rng(11)
    trials = 3_000
    values = rng.normal(size=(trials, options.baseline + options.looks))
    if shape == "mostly nothing":
        values = np.maximum(values - 1.0, 0.0) ** 3
    alarms = sum(chart(list(one), options).alarm_at is not None for one in values)
    stated = false_alarm_ratio(limit_of(options), options)
    assert stated <= options.false_alarm
    spread = 4.0 * np.sqrt(stated / trials)
    if shape == "normal":
        assert abs(alarms / trials - stated) < spread
    else:
        assert alarms / trials < stated + spread
    assert false_alarm_ratio(limit_of(options) - 1, options) > options.false_alarm


def test_a_change_is_found_soon() -> None:
    options = ChartOptions()
    rng = np.random.default_rng(12)
    waits = []
    for _ in range(200):
        values = rng.exponential(size=options.baseline + 200)
        values[options.baseline :] += 5.0
        found = chart(list(values), options).alarm_at
        waits.append(np.inf if found is None else found - options.baseline)
    assert np.median(waits) < 10
    assert np.mean(np.isfinite(waits)) > 0.95  # a baseline with two rare values hides it


def test_the_chance_of_an_alarm_is_that_of_the_walk() -> None:
    """Against every sequence of few looks, counted out."""
    options = ChartOptions(looks=9)
    limit, p = 5, 0.3
    total = 0.0
    for bits in range(2**9):
        hits = [(bits >> k) & 1 for k in range(9)]
        level, alarm = 0, False
        for hit in hits:
            level = max(0, level + (options.up if hit else -1))
            alarm = alarm or level >= limit
        total += alarm * p ** sum(hits) * (1 - p) ** (9 - sum(hits))
    assert alarm_ratio(np.array([p]), limit, options)[0] == pytest.approx(total, rel=1e-12)


def test_before_the_baseline_there_is_no_chart() -> None:
    found = chart([1.0] * 5)
    assert np.isnan(found.level_mm3)
    assert found.alarm_at is None
