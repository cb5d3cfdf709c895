"""The agent beside a real Moonraker, the emulated firmware behind it: a slicer's job, mended."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from clogged_block import (
    AMREPAIR,
    CLOG_MM,
    ENVIRONMENT,
    GCODE,
    PRUSA_SLICER,
    command,
    events,
    judge,
    sliced,
)
from peer_harness import HERE, MOONRAKER, Web, end, free_port, peer, process, wait_for

pytestmark = pytest.mark.peers

AUTHORIZATION = """\
[authorization]
trusted_clients:
  127.0.0.1
"""


class Stack:
    """An emulated printer, Klipper's stand-in with our macros, Moonraker."""

    def __init__(self, folder: Path, keep: ExitStack) -> None:
        self.folder, self.keep = folder, keep
        self.motion, self.port = folder / "motion.bin", free_port()
        self.klippy, self.own = folder / "klippy.sock", folder / "moonraker.sock"
        for name in ("config", "gcodes", "logs", "database"):
            (folder / name).mkdir()
        text = MOONRAKER.format(port=self.port, klippy=self.klippy) + AUTHORIZATION
        (folder / "config" / "moonraker.conf").write_text(text)
        self.url = f"http://127.0.0.1:{self.port}"
        self.web = Web(self.url, "")

    def start(self, macros: Path) -> None:
        link = self.folder / "printer"
        self._keep("emulator", sys.executable, "-m", "gcode", "emulate", "--accelerated",
                   "--firmware", "klipper", "--printer", "generic_klipper", "--link", link,
                   "--motion", self.motion)  # fmt: skip
        wait_for("the emulated printer", link.exists, self.folder / "emulator.log")
        self._keep("klippy", sys.executable, HERE / "klippy_macros.py", self.klippy,
                   self.folder / "gcodes", macros, link, *CLOG_MM)  # fmt: skip
        self.start_moonraker()

    def start_moonraker(self) -> None:
        self.moonraker = self._keep("moonraker", peer("moonraker"), "-m", "moonraker", "-d",
                                    self.folder, "-u", self.own)  # fmt: skip

        def ready() -> bool:
            info = self.web.get("/server/info").get("result", {})
            return bool(info.get("klippy_state") == "ready")

        wait_for("Moonraker is ready", ready, self.folder / "moonraker.log")

    def _keep(self, name: str, *command: Any) -> subprocess.Popen[bytes]:
        words = [str(word) for word in command]
        return self.keep.enter_context(process(*words, log=self.folder / f"{name}.log"))

    def agent(self, *more: str, scanner: str = "") -> subprocess.Popen[bytes]:
        return self._keep(
            "agent", *AMREPAIR, "agent", "--moonraker", self.url, "--template",
            self.folder / "block.stl", "--scanner", scanner or f"simulated:{self.motion}",
            "--printer", "generic_klipper", "--material", "pla", "--out", self.folder / "runs",
            "--once", *more,
        )  # fmt: skip

    def upload(self, job: Path) -> None:
        """As a slicer does that sends a job and has it printed."""
        with job.open("rb") as file:
            answer = self.web.http.post(
                "/server/files/upload", files={"file": (job.name, file)}, data={"print": "true"}
            )
        assert answer.status_code == 201, answer.text

    def said(self) -> str:
        return (self.folder / "agent.log").read_text()

    def console(self) -> str:
        """What Mainsail, Fluidd and KlipperScreen show of the printer's console."""
        store = self.web.get("/server/gcode_store?count=1000")["result"]["gcode_store"]
        return "\n".join(str(row["message"]) for row in store)

    def state(self) -> str:
        found = self.web.get("/printer/objects/query?print_stats")
        return str(found.get("result", {}).get("status", {}).get("print_stats", {}).get("state"))


@pytest.fixture
def stack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stack]:
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    with ExitStack() as keep:
        found = Stack(tmp_path, keep)
        yield found
        found.web.http.close()


def begin(stack: Stack, *more: str, scanner: str = "") -> tuple[Path, subprocess.Popen[bytes]]:
    """The user's four commands: slice, mark, macros, agent; and the job is sent to be printed."""
    job = sliced(stack.folder, flavour="klipper", reads="klipper")
    macros = stack.folder / "amrepair.cfg"
    command(*AMREPAIR, "agent", "--macros", macros)
    if scanner == "probe":
        touch = stack.folder / "klipper_touch.cfg"
        command(*GCODE, "touch", "--klipper-macro", touch)
        macros.write_text(macros.read_text() + touch.read_text())
    stack.start(macros)
    agent = stack.agent(*more, scanner=scanner)
    log = stack.folder / "agent.log"
    wait_for("the agent", lambda: log.exists() and "the agent is here" in stack.said(), log)
    stack.upload(job)
    return job, agent


@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_from_the_slicer_to_a_mended_print_in_four_commands(stack: Stack) -> None:
    job, agent = begin(stack, "--approve", "auto")
    assert agent.wait(timeout=400) == 0, stack.said()
    assert re.search(r"missing \(a void.*\)\. Printed", stack.said())
    assert "Nothing is missing any more" in stack.console()
    judge(stack.motion, job, "AMREPAIR_SCAN")
    assert stack.state() == "complete"


@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_the_printers_own_probe_finds_it_and_is_killed_in_the_midst_of_it(stack: Stack) -> None:
    """What the emulated nozzle feels is what it has laid itself, by Klipper's own macro."""
    job, agent = begin(stack, "--approve", "auto", scanner="probe")
    log = stack.folder / "agent.log"
    touched = "amrepair: touched at z="
    wait_for("a few touches", lambda: stack.console().count(touched) > 5, log, 100.0)
    end(agent)
    agent = stack.agent("--approve", "auto", scanner="probe")
    assert agent.wait(timeout=400) == 0, stack.said()
    assert "gone on with" in stack.said()
    assert re.search(r"missing \(a void.*\)\. Printed", stack.said())
    assert "Nothing is missing any more" in stack.console()
    judge(stack.motion, job, "AMREPAIR_SCAN", within=0.7)  # a tip feels no hole's edges
    assert stack.state() == "complete"


@pytest.mark.skipif(PRUSA_SLICER is None, reason="PrusaSlicer is not installed here")
def test_asked_and_killed_and_the_server_killed_and_nothing_is_printed_twice(stack: Stack) -> None:
    job, agent = begin(stack)
    log = stack.folder / "agent.log"
    question = "action:prompt_text Print this repair?"
    wait_for("the question", lambda: question in stack.console(), log, 100.0)
    second = subprocess.run(
        [*AMREPAIR, "agent", "--moonraker", stack.url.replace("127.0.0.1", "localhost"),
         "--template", str(stack.folder / "block.stl"), "--scanner", f"watch:{stack.folder}"],
        capture_output=True, text=True, check=False, timeout=100, env=ENVIRONMENT,
    )  # fmt: skip
    assert second.returncode == 4
    assert "another agent named 'amrepair' serves the printer" in second.stderr
    end(agent)
    end(stack.moonraker)
    stack.start_moonraker()
    agent = stack.agent()
    wait_for("the question again", lambda: question in stack.console(), log, 100.0)
    (yes,) = set(re.findall(r"Yes\|(.*?)\|primary", stack.console()))
    stack.web.http.post("/printer/gcode/script", json={"script": yes}, timeout=60.0)
    wait_for(
        "the repair", lambda: any(e.get("kind") == "repair" for e in events(stack.folder)), log
    )
    end(agent)
    agent = stack.agent()
    assert agent.wait(timeout=400) == 0, stack.said()
    assert "gone on with" in stack.said()
    judge(stack.motion, job, "AMREPAIR_SCAN")
    assert stack.state() == "complete"
