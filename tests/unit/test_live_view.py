"""The live view: who may reach it, what its buttons decide, what it draws."""

from __future__ import annotations

import http.client
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import amrepair
import gcode
from amrepair.cli.app import app
from amrepair.cli.live import ShownRun, shown_as
from amrepair.errors import InputError, MissingDependencyError
from amrepair.loop import Look, Stop
from amrepair.policy.table import Action, Cover, Finding, Situation, decide, judge
from amrepair.regions.anomaly import DefectType
from amrepair.repair import RepairPlan
from amrepair.report import guarded
from amrepair.report.guarded import Guard
from amrepair.report.live import LiveView, deviation_colours
from amrepair.report.operator import Operator, OperatorAnswer
from gcode.errors import LinkError

TOKEN = "0123456789abcdef0123"
WAIT_S = 60.0


def answer_of(ask: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    found: list[Any] = []
    thread = threading.Thread(target=lambda: found.append(ask()), daemon=True)
    thread.start()
    return thread, found


class Watcher:
    """Waits until the operator is in a state, told by its own callback."""

    def __init__(self, operator: Operator) -> None:
        self.operator = operator
        self._changed = threading.Condition()
        operator.changed = self._tell

    def _tell(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def until(self, condition: Callable[[], bool]) -> None:
        with self._changed:
            assert self._changed.wait_for(condition, timeout=WAIT_S)


@pytest.mark.parametrize("verdict", list(OperatorAnswer))
def test_an_answer_is_waited_for(verdict: OperatorAnswer) -> None:
    operator = Operator()
    watcher = Watcher(operator)
    assert operator.decide(verdict) is False  # nobody asked: an early click decides nothing
    thread, found = answer_of(operator.ask)
    watcher.until(lambda: operator.asked)
    assert operator.decide(verdict) is True
    thread.join(WAIT_S)
    assert found == [verdict]
    assert not operator.asked


def test_the_first_click_counts() -> None:
    operator = Operator()
    watcher = Watcher(operator)
    operator.toggle_pause()
    thread, found = answer_of(operator.ask)
    watcher.until(lambda: operator.asked)
    assert operator.decide(OperatorAnswer.SKIP) is True
    assert operator.decide(OperatorAnswer.APPROVE) is False
    operator.toggle_pause()
    thread.join(WAIT_S)
    assert found == [OperatorAnswer.SKIP]


def test_a_pause_holds_the_answer_back_and_reaches_the_printer() -> None:
    said: list[str] = []
    operator = Operator(
        on_pause=lambda: said.append("pause"), on_resume=lambda: said.append("resume")
    )
    watcher = Watcher(operator)
    assert operator.toggle_pause() is True
    thread, found = answer_of(operator.ask)
    watcher.until(lambda: operator.asked)
    operator.decide(OperatorAnswer.APPROVE)
    assert found == []
    assert thread.is_alive()
    assert operator.toggle_pause() is False
    thread.join(WAIT_S)
    assert (found, said) == ([OperatorAnswer.APPROVE], ["pause", "resume"])


def test_closing_the_view_means_skip() -> None:
    operator = Operator()
    watcher = Watcher(operator)
    operator.toggle_pause()
    thread, found = answer_of(operator.ask)
    watcher.until(lambda: operator.asked)
    operator.close()
    thread.join(WAIT_S)
    assert found == [OperatorAnswer.SKIP]
    operator.wait_while_paused()  # returns, too


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "printer.local", "::"])
def test_others_need_a_token(host: str) -> None:
    with pytest.raises(InputError, match="--token"):
        Guard(host, None)
    with pytest.raises(InputError, match="16"):
        Guard(host, "short")
    Guard(host, TOKEN)


@pytest.mark.parametrize(
    ("headers", "passes"),
    [
        ({"Host": "localhost:80"}, True),
        ({"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:80"}, True),
        ({"Host": "[::1]:80"}, True),
        ({"Host": "evil.example:80"}, False),  # a name that was made to point here
        ({"Host": "127.0.0.1:80", "Origin": "http://evil.example"}, False),
        ({"Host": "127.0.0.1:80", "Origin": "http://127.0.0.1:8000"}, False),
        ({"Host": "127.0.0.1:80", "Origin": "null"}, False),
        ({}, False),
    ],
)
def test_on_this_machine_only_its_own_page_passes(headers: dict[str, str], passes: bool) -> None:
    assert (Guard("127.0.0.1", None).refusal("/", headers) == "") is passes


@pytest.mark.parametrize(
    ("path", "cookie", "passes"),
    [
        (f"/?token={TOKEN}", "", True),
        ("/", f"amrepair_token={TOKEN}", True),
        ("/", f"a=b; amrepair_token={TOKEN}", True),
        ("/", "", False),
        ("/?token=", "", False),
        (f"/?token={TOKEN}x", "", False),
        ("/?token=ü", "amrepair_token=ü", False),
    ],
)
def test_elsewhere_the_token_opens(path: str, cookie: str, passes: bool) -> None:
    headers = {"Host": "printer.local:80", "Cookie": cookie}
    assert (Guard("0.0.0.0", TOKEN).refusal(path, headers) == "") is passes


def fetch(port: int, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    link = http.client.HTTPConnection("127.0.0.1", port, timeout=WAIT_S)
    try:
        link.request("GET", path, headers=headers)
        answer = link.getresponse()
        if answer.status != 101:
            answer.read()
        return answer
    finally:
        if link.sock is not None:
            link.sock.close()
        link.close()


HANDSHAKE = {
    "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
}  # fmt: skip


def test_the_server_really_asks_the_guard() -> None:
    server = guarded.start(title="test", token=TOKEN)
    try:
        port = server.get_port()
        assert server.get_host() == "127.0.0.1"
        assert fetch(port).status == 403
        assert fetch(port, **HANDSHAKE).status == 403
        answer = fetch(port, f"/?token={TOKEN}")
        assert (answer.status, answer.headers["Location"]) == (302, "/")
        cookie = answer.headers["Set-Cookie"]
        assert "HttpOnly" in cookie
        assert "SameSite=Strict" in cookie
        opened = cookie.split(";")[0]
        assert fetch(port, Cookie=opened).status == 200
        assert fetch(port, Cookie=opened, **HANDSHAKE).status == 101
        assert fetch(port, Cookie=opened, Origin="http://evil.example", **HANDSHAKE).status == 403
    finally:
        server.stop()


def test_a_viser_that_cannot_be_guarded_serves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    import viser

    stopped: list[bool] = []

    class Other:
        def __init__(self, **options: object) -> None:
            """Serves in some other way."""

        def stop(self) -> None:
            stopped.append(True)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(MissingDependencyError, match="cannot guard"):
        guarded.start(title="test")
    assert stopped == [True]


def test_colours_say_missing_and_too_much() -> None:
    missing, agrees, excess = deviation_colours(np.array([-9.0, 0.0, 9.0]), 1.0).astype(int)
    assert missing[2] > missing[0] + 60
    assert excess[0] > excess[2] + 60
    assert np.ptp(agrees) < 12


@pytest.fixture(scope="module")
def plan(example_files: Path) -> RepairPlan:
    site = amrepair.Site.of_part(
        amrepair.open_template(example_files / "part.safetensors"), gcode.load_setup()
    )
    scan = amrepair.read_scan(example_files / "scan.ply", frame="build")
    return amrepair.plan_repair(scan, site, title="repair")


@pytest.fixture
def view() -> Iterator[LiveView]:
    shown = LiveView(title="test", operator=Operator())
    yield shown
    shown.close()


def test_buttons_are_dead_until_a_question_is_asked(view: LiveView, plan: RepairPlan) -> None:
    operator = view._operator
    assert operator is not None
    assert view._approve.disabled
    waiting = threading.Event()
    drawn = operator.changed
    operator.changed = lambda: (drawn(), waiting.set())  # type: ignore[func-returns-value]
    thread, found = answer_of(lambda: view.approve(plan))
    assert waiting.wait(WAIT_S)
    assert not view._approve.disabled
    assert re.search(
        r"missing: (8[89]|9\d)\.\d mm³ in 1 region, at X 12\d\.\d to 130\.0, ", view._found.content
    )
    assert re.search(r"left out: 1\d\.\d mm³: the nozzle would touch", view._found.content)
    assert {"scan", "missing", "repair"} <= set(view._handles)
    operator.decide(OperatorAnswer.APPROVE)
    thread.join(WAIT_S)
    assert found == [True]
    assert view._approve.disabled


def test_no_button_shares_the_page_with_the_world(monkeypatch: pytest.MonkeyPatch) -> None:
    # regression: viser's own button asks a public server for an address of this very page
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr("viser.GuiApi.configure_theme", lambda _, **theme: asked.append(theme))
    shown = LiveView(title="test")
    shown._dress(dark=True)
    shown.close()
    assert [theme["show_share_button"] for theme in asked] == [False, False]
    assert [theme["dark_mode"] for theme in asked] == [False, True]


def test_a_phone_sees_the_whole_part(view: LiveView) -> None:
    # regression: on a window higher than wide the part lay beyond both sides
    corners = np.array([[0.0, 0, 0], [30, 0, 0], [0, 20, 0], [0, 0, 9]])
    view.show_mesh("part", corners, np.array([[0, 1, 2], [0, 1, 3]]), (1, 2, 3))
    first = view.server.initial_camera
    for aspect, farther in ((0.5, 2.0), (1.6, 1.0)):
        camera = SimpleNamespace(aspect=aspect, position=first.position, look_at=first.look_at)
        view._stand_back(SimpleNamespace(camera=camera))
        assert np.allclose(camera.look_at, first.look_at)
        away_mm = np.linalg.norm(np.subtract(camera.position, camera.look_at))
        before_mm = np.linalg.norm(np.subtract(first.position, first.look_at))
        assert away_mm == pytest.approx(farther * before_mm)


def test_a_look_is_told_with_its_decision(view: LiveView, plan: RepairPlan) -> None:
    finding = Finding(
        "missing", DefectType.CHIP, 0.9, 89.0, 89.0, 4.0, 9.0, 1.0, Cover.NOTHING, 0.0,
        ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
    )  # fmt: skip
    decision = decide([judge(finding)], Situation(Action.FILL_NOW))
    view.record(Look(3, Stop(11, 0, 2.4), plan.scan, plan, decision, printed=True))
    told = view._found.content
    assert told.startswith("**Layer 11, scan 3: fill now**")
    assert "- The patch has passed the checker." in told
    assert "- Chip, 89.0 mm³ missing: fill now; a bead fits, and the nozzle reaches it." in told


def test_a_pause_before_there_is_a_printer_holds_the_run_at_once(view: LiveView) -> None:
    """Regression: it was said to rest, and printed."""
    operator = view._operator
    assert operator is not None
    watcher = Watcher(operator)
    shown, said = ShownRun(view, operator, ask=False), list[str]()
    operator.toggle_pause()

    def go() -> bool:
        shown.drives(lambda: said.append("pause"), lambda: said.append("resume"))
        said.append("print")
        return shown.to_print(None)  # type: ignore[arg-type]  # nobody is asked

    thread, found = answer_of(go)
    watcher.until(lambda: operator.paused)
    thread.join(0.05)
    assert (said, found) == ([], [])
    operator.toggle_pause()
    thread.join(WAIT_S)
    assert (sorted(said), found) == (["print", "resume"], [True])


def test_a_printer_that_does_not_pause_is_told_on_the_page(view: LiveView) -> None:
    """Such as OctoPrint between two prints; the error was lost in a thread of the page's."""
    operator = view._operator
    assert operator is not None

    def refuse() -> None:
        raise LinkError("OctoPrint does not pause (it does not print).")

    operator.on_pause = operator.on_resume = refuse
    view._toggle_pause(operator)
    assert operator.paused
    assert view._pause.label == "Go on"
    assert "rests before its next part**, but the printer: OctoPrint" in view._stage.content
    view._toggle_pause(operator)
    assert not operator.paused
    assert "goes on**, but the printer: OctoPrint" in view._stage.content


def test_the_part_grows_with_the_print(view: LiveView, example_files: Path) -> None:
    job = gcode.read_job((example_files / "job.gcode").read_text(), dialect="prusa")
    view.show_job(job)
    handles = [handle for _, handle in view._job_steps]
    heard: list[str] = []
    told = view.watching(lambda stage, done, total: heard.append(stage))
    total = float(job.program.text.count("\n"))
    shown = []
    for share in (0.0, 0.5, 1.0):
        told("print", share * total, total)
        shown.append(sum(handle.visible for handle in handles))
    assert shown[0] == 0
    assert 0 < shown[1] < len(handles)
    assert shown[2] == len(handles)
    assert heard == ["print"] * 3


@pytest.mark.parametrize("name", ["scan.ply", "part.stl", "part.safetensors", "job.gcode"])
def test_files_of_every_kind_are_shown(view: LiveView, example_files: Path, name: str) -> None:
    shown_as(example_files / name)(view)
    drawn = set(view._handles) | ({name} if view._job_steps else set())
    assert name in drawn


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["view", "nothing.ply"], "no such file"),
        (["view", __file__], "cannot be shown"),
        (["view", "KNOB", "--host", "0.0.0.0"], "--token"),
        (["view", "KNOB", "--host", "0.0.0.0", "--token", "short"], "at least 16"),
    ],
)
def test_bad_views_are_refused(words: list[str], said: str) -> None:
    knob = str(Path(__file__).parents[2] / "examples" / "parts" / "knob.stl")
    done = CliRunner().invoke(app, [knob if word == "KNOB" else word for word in words])
    assert isinstance(done.exception, InputError)
    assert said in str(done.exception)


def test_nothing_but_our_own_words_on_standard_output(capfd: pytest.CaptureFixture[str]) -> None:
    """viser prints by itself; with --json that would spoil the one object."""
    LiveView(title="test").close()
    assert capfd.readouterr().out == ""


def test_a_view_that_is_closed_no_longer_draws(plan: RepairPlan) -> None:
    view = LiveView(title="test", operator=Operator())
    thread, found = answer_of(lambda: view.approve(plan))
    assert view._operator is not None
    Watcher(view._operator).until(lambda: view._operator is not None and view._operator.asked)
    view.close()
    thread.join(WAIT_S)
    assert found == [False]
    told = view.watching(lambda stage, done, total: None)
    told("print", 1.0, 2.0)  # a warning would be an error here
    assert view.approve(plan) is False
