"""OctoPrint with our plugin, the emulated firmware as its printer: a slicer's job, mended."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clogged_block import (
    AMREPAIR,
    CLOG_MM,
    ENVIRONMENT,
    PRUSA_SLICER,
    events,
    filament_of,
    judge,
    sliced,
)
from octoprint_server import KEY, octoprint
from peer_harness import HERE, Web, end, free_port, process, wait_for

from gcode.firmware.motion import MotionFile
from gcode.moves import Program
from gcode.reader import read_job
from tests.integration.browser import Watched, launched, why_not

pytestmark = [
    pytest.mark.peers,
    pytest.mark.timeout(900),
    pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here"),
]
PATIENCE_MS = 60_000.0
QUESTION = "Print this repair?"


class Stack:
    """An emulated printer, OctoPrint with our plugin, an agent."""

    def __init__(
        self,
        folder: Path,
        keep: ExitStack,
        clog_mm: tuple[float, ...] = CLOG_MM,
        printer: str = "ender_3",
        scanner: str = "",
    ) -> None:
        self.folder, self.keep, self.clog_mm = folder, keep, clog_mm
        self.printer, self.scanner = printer, scanner or f"simulated:{folder / 'motion.bin'}"
        self.motion, self.port, self.link = folder / "motion.bin", free_port(), folder / "printer"
        self.url = f"http://127.0.0.1:{self.port}"
        self.web = Web(self.url, KEY)
        self.key = folder / "key"
        self.key.write_text(KEY)
        self.key.chmod(0o600)
        self._keep("emulator", sys.executable, "-m", "gcode", "emulate", "--accelerated",
                   "--firmware", "marlin", "--printer", self.printer, "--link", self.link,
                   "--motion", self.motion)  # fmt: skip
        wait_for("the emulated printer", self.link.exists, folder / "emulator.log")
        self.start_octoprint()

    def start_octoprint(self) -> None:
        clog = (HERE / "clogged_plugin.py").read_text().replace("BOX = ()", f"BOX = {self.clog_mm}")
        self.server = self.keep.enter_context(
            octoprint(
                self.folder, str(self.link), number=self.port, plugins={"clogged.py": clog}
            )
        ).running  # fmt: skip

    def _keep(self, name: str, *command: Any) -> subprocess.Popen[bytes]:
        words = [str(word) for word in command]
        return self.keep.enter_context(process(*words, log=self.folder / f"{name}.log"))

    def words(self, url: str) -> list[str]:
        return [
            *AMREPAIR, "agent", "--octoprint", url, "--api-key-file", str(self.key), "--template",
            str(self.folder / "block.stl"), "--scanner", self.scanner, "--printer",
            self.printer, "--material", "pla", "--out", str(self.folder / "runs"), "--view-port",
            "0", "--once",
        ]  # fmt: skip

    def agent(self, *more: str) -> subprocess.Popen[bytes]:
        began = self._keep("agent", *self.words(self.url), *more)
        wait_for("the agent", lambda: self.state()["agent"], self.log)
        return began

    @property
    def log(self) -> Path:
        return self.folder / "agent.log"

    def upload(self, job: Path) -> None:
        """As a slicer does that sends a job and has it printed."""
        with job.open("rb") as file:
            answer = self.web.http.post(
                "/api/files/local", files={"file": (job.name, file)}, data={"print": "true"}
            )
        assert answer.status_code == 201, answer.text

    def state(self) -> dict[str, Any]:
        return self.web.get("/plugin/amrepair/state") or {"agent": False, "print": None}

    def said(self) -> str:
        return self.log.read_text()

    def tab(self) -> str:
        return "\n".join(row["text"] for row in self.state()["said"])

    def command(self, line: str) -> None:
        answer = self.web.http.post("/api/printer/command", json={"command": line})
        assert answer.status_code == 204, answer.text


def ended(agent: subprocess.Popen[bytes], stack: Stack, *, code: int = 0) -> None:
    """The agent has ended by itself, and says how."""
    wait_for("the agent's end", lambda: agent.poll() is not None, stack.log, 200.0)
    assert agent.returncode == code, stack.said()


@pytest.fixture
def stack(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Iterator[Stack]:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    with ExitStack() as keep:
        found = Stack(tmp_path, keep, **getattr(request, "param", {}))
        yield found
        found.web.http.close()


def test_from_the_slicer_to_a_mended_print(stack: Stack) -> None:
    job = sliced(stack.folder, flavour="marlin2", reads="octoprint")
    stack.command("@amrepair scan layer=3 z=0.8")
    told = "nothing is being printed, so there is nothing to look at"
    wait_for("a sentence", lambda: told in stack.tab(), stack.folder / "octoprint.log")
    agent = stack.agent("--approve", "auto")
    stack.upload(job)
    ended(agent, stack)
    assert re.search(r"missing \(a void.*\)\. Printed", stack.said())
    assert "Nothing is missing any more" in stack.tab()
    judge(stack.motion, job, "@amrepair")
    assert stack.state()["print"]["ended"] == "done"


class Tab:
    """Our tab in OctoPrint's page, as a person sees it."""

    def __init__(self, browser: Any, url: str) -> None:
        self.watched = Watched(browser, url, viewport={"width": 1280, "height": 1000})
        self.page = self.watched.page
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.locator("#navbar_login").get_by_text("me").first.wait_for()
        name, more = "#tab_plugin_amrepair_link a", "#tabs .dropdown-toggle"
        self.page.locator(f"{name}:visible, {more}:visible").first.wait_for()
        if not self.page.locator(name).is_visible():  # more tabs than have room
            self.page.locator(more).click()
        self.page.locator(name).click()
        self.prompt = self.page.locator("#amrepair_prompt")

    def button(self, label: str) -> Any:
        return self.prompt.get_by_role("button", name=label, exact=True)


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_approved_in_the_tab_and_killed_and_nothing_is_printed_twice(stack: Stack) -> None:
    job = sliced(stack.folder, flavour="marlin2", reads="octoprint")
    with launched() as browser:
        tab = Tab(browser, stack.url)
        agent = stack.agent()
        stack.upload(job)
        tab.prompt.get_by_text(QUESTION).wait_for()
        assert "missing" in tab.prompt.inner_text()
        # the live page, under OctoPrint's own address
        live = tab.page.frame_locator("#amrepair_page")
        live.get_by_role("button", name="Pause").wait_for()
        live.get_by_text(QUESTION).first.wait_for()
        if os.environ.get("AMREPAIR_PICTURES"):
            tab.page.screenshot(path=Path(os.environ["AMREPAIR_PICTURES"]) / "octoprint-tab.png")
        second = subprocess.run(
            stack.words(stack.url.replace("127.0.0.1", "localhost")), capture_output=True,
            text=True, check=False, timeout=100, env=ENVIRONMENT,
        )  # fmt: skip
        assert second.returncode == 4, second.stderr
        assert "another agent named 'amrepair' serves the printer" in second.stderr
        end(agent)
        agent = stack.agent()
        tab.button("Yes").wait_for()
        wait_for("the run", lambda: "is gone on with" in stack.said(), stack.log)
        wait_for("asked again", lambda: stack.said().count(QUESTION) == 2, stack.log)
        tab.button("Yes").click()
        wait_for("the repair", lambda: any(e.get("kind") == "repair" for e in events(stack.folder)),
                 stack.log)  # fmt: skip
        end(agent)
        agent = stack.agent()
        ended(agent, stack)
        tab.page.get_by_text("Nothing is missing any more").wait_for()
        assert not [said for said in tab.watched.complaints if "amrepair" in said]
    judge(stack.motion, job, "@amrepair")
    assert stack.state()["print"]["ended"] == "done"


PROBE = {"printer": "generic_marlin", "scanner": "probe"}


@pytest.mark.parametrize("stack", [PROBE], indirect=True)
def test_the_printers_own_probe_finds_it_and_is_killed_in_the_midst_of_it(stack: Stack) -> None:
    """What the emulated nozzle feels is what it has laid itself, by G38.2."""
    job = sliced(stack.folder, flavour="marlin2", reads="octoprint")
    agent = stack.agent("--approve", "auto")
    stack.upload(job)
    begun = lambda: any(e.get("kind") == "touch" for e in events(stack.folder))  # noqa: E731
    wait_for("touches", begun, stack.log)
    end(agent)
    agent = stack.agent("--approve", "auto")
    ended(agent, stack)
    assert "is gone on with" in stack.said()
    assert re.search(r"missing \(a void.*\)\. Printed", stack.said())
    assert "Nothing is missing any more" in stack.tab()
    judge(stack.motion, job, "@amrepair", within=0.7)  # a tip feels no hole's edges
    assert stack.state()["print"]["ended"] == "done"


@pytest.mark.parametrize(
    "stack", [{**PROBE, "clog_mm": (*CLOG_MM[:2], 0.5, *CLOG_MM[3:])}], indirect=True
)
def test_a_touch_that_meets_nothing_ends_the_looks_and_not_the_print(stack: Stack) -> None:
    """A hole deeper than a touch may go: OctoPrint does not cancel for the firmware's error."""
    job = sliced(stack.folder, flavour="marlin2", reads="octoprint")
    agent = stack.agent("--approve", "auto")
    stack.upload(job)
    told = "no more looks at this print: Nothing was felt down to Z2 mm"
    wait_for("the sentence", lambda: told in stack.tab(), stack.log, 100.0)

    def off() -> bool:
        heat = stack.web.get("/api/printer").get("temperature", {})
        return all(heat.get(name, {}).get("target") == 0.0 for name in ("tool0", "bed"))

    wait_for("heaters are off", off, stack.log)
    assert "Failed to reach target" in stack.said()
    assert MotionFile(stack.motion).take().end_mm[-1, 2] > 3.0, "lifted"
    wait_for("the question", lambda: stack.state()["prompt"], stack.log)
    answer = stack.web.http.post("/plugin/amrepair/press", json={"what": "go on"})
    assert answer.status_code == 200, answer.text
    ended(agent, stack, code=4)
    assert stack.state()["print"]["ended"] == "done"
    lines = job.read_text().split("\n")
    first = next(k for k, line in enumerate(lines) if line.startswith("@amrepair"))
    batch = MotionFile(stack.motion).take()
    above = (batch.end_mm[:, 2] > 3.15) & (np.hypot(*(batch.end_mm - batch.start_mm)[:, :2].T) > 0)
    planned = [line for line in lines[first:] if re.match(r"G1 (X|Y).*E", line)]
    assert float(batch.filament_mm[above].sum()) == pytest.approx(filament_of(planned), rel=1e-4)


SECOND_MM = (104.0, 113.0, 0.5, 116.0, 123.0, 3.05)
"""The second of two blocks of 12 x 10 x 3 mm, but for its first two layers."""


@pytest.mark.parametrize("stack", [{"clog_mm": SECOND_MM}], indirect=True)
def test_one_of_two_objects_is_given_up_and_the_other_goes_on(stack: Stack) -> None:
    """OctoPrint reads on in its file; what it sends is what was checked, lifted past the stump."""
    job = sliced(
        stack.folder, flavour="marlin2", reads="octoprint", size_mm=(12.0, 10.0, 3.0),
        at_mm=("1.2", "2.2"), copies=2,
    )  # fmt: skip
    agent = stack.agent("--approve", "auto")
    stack.upload(job)
    wait_for("it is given up", lambda: any(e.get("kind") == "rest" for e in events(stack.folder)),
             stack.log)  # fmt: skip
    end(agent)
    agent = stack.agent("--approve", "auto")
    ended(agent, stack, code=3)
    assert "Given up, so that the other objects could go on" in stack.said()
    assert stack.state()["print"]["ended"] == "done"
    batch = MotionFile(stack.motion).take()
    middle = 0.5 * (batch.start_mm + batch.end_mm)
    level = np.hypot(*(batch.end_mm - batch.start_mm)[:, :2].T) > 0  # beads, not retractions
    second = ((middle > SECOND_MM[:3]) & (middle < SECOND_MM[3:])).all(axis=1)
    assert not float(batch.filament_mm[second & level].sum())
    first = middle[:, 1] < 110.0
    above = level & first & (middle[:, 2] > 1.3)
    planned = read_job(Program(job.read_text(), "marlin"), dialect="marlin")
    beads = planned.beads
    wanted = beads.end_mm[:, 2] > 1.3
    wanted &= beads.end_mm[:, 1] < 110.0
    section = np.pi / 4 * 1.75**2
    long = np.linalg.norm(beads.end_mm - beads.start_mm, axis=1)
    assert float(batch.filament_mm[above].sum()) * section == pytest.approx(
        float((long * beads.section_mm2)[wanted].sum()), rel=1e-3
    )


def test_octoprint_is_killed_at_a_look(stack: Stack) -> None:
    """Its print is over: nothing more is sent, the heaters are switched off, and both sides say."""
    job = sliced(stack.folder, flavour="marlin2", reads="octoprint")
    agent = stack.agent()
    stack.upload(job)
    wait_for("the question", lambda: QUESTION in stack.said(), stack.log)
    assert stack.web.get("/api/printer")["temperature"]["tool0"]["target"] == 210.0
    printed = stack.motion.stat().st_size
    end(stack.server)
    stack.start_octoprint()
    told = "OctoPrint was restarted while a print rested at its look"
    wait_for("a sentence", lambda: told in stack.tab(), stack.folder / "octoprint.log")
    wait_for("the agent's word", lambda: "no more looks at this print" in stack.said(), stack.log)

    def off() -> bool:
        heat = stack.web.get("/api/printer").get("temperature", {})
        return all(heat.get(name, {}).get("target") == 0.0 for name in ("tool0", "bed"))

    wait_for("heaters are off", off, stack.folder / "octoprint.log")
    assert stack.motion.stat().st_size == printed
    end(agent)
