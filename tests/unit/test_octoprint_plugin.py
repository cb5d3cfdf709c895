"""What OctoPrint's plugin does, on a wire of its own: every line once, in order, whatever comes."""

from __future__ import annotations

import subprocess
import sys
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from amrepair.agent.octoprint.held import AGENT_GONE_S, AHEAD_LINES, HOLD_PATIENCE_S, Held, Refusal

JOB = ["G28", "G1 X1", "G1 X2", "@amrepair scan layer=3 z=0.8", "G1 X3", "G1 X4", "G1 X5"]
LOOK = 4  # the line behind it
REPAIR = [f"G1 Y{k}" for k in range(30)]


class Wire:
    """OctoPrint's queue and its printer: one line at a time, the job's where it is not held."""

    def __init__(self, job: list[str] = JOB) -> None:
        self.deeds: deque[Callable[[], None]] = deque()
        self.now_s = 0.0
        self.held = Held(self, self.deeds.append, lambda: self.now_s)
        self.job, self.next, self.on_hold = job, 0, False
        self.queue: deque[tuple[str, str]] = deque()
        self.executed: list[str] = []
        self.targets = [210.0, 60.0]
        self.cancelled = False

    # as `Server`
    def release(self) -> None:
        self.on_hold = False

    def send(self, line: str, tag: str) -> None:
        self.queue.append((line, tag))

    def heat(self) -> tuple[tuple[float, ...], float]:
        return tuple(self.targets[:-1]), self.targets[-1]

    def cancel(self) -> None:
        self.cancelled = True

    def tell(self, state: dict[str, Any]) -> None:
        assert state["prompt"] is None or state["prompt"]["lines"]

    # what happens
    def byte(self, line: int) -> int:
        return sum(len(text) + 1 for text in self.job[:line])

    def begin(self) -> Wire:
        self.held.began("job.gcode")
        return self.settle()

    def deed(self) -> None:
        if self.deeds:
            self.deeds.popleft()()

    def wire(self) -> None:
        """The next line to the printer."""
        if self.queue:
            line, tag = self.queue.popleft()
            if line.startswith("@amrepair over "):
                self.held.over(line.rpartition(" ")[2])
                return
            self._execute(line)
            if tag:
                self.held.sent(tag)
        elif not self.on_hold and self.next < len(self.job):
            line, self.next = self.job[self.next], self.next + 1
            if line.startswith("@"):
                self.on_hold = self.held.mark(line.partition(" ")[2], self.byte(self.next))
                return
            instead = self.held.instead(self.byte(self.next))
            for command in (line,) if instead is None else instead:
                self._execute(command)

    def _execute(self, line: str) -> None:
        self.executed.append(line)
        for k, names in enumerate((("M104", "M109"), ("M140", "M190"))):
            if line.startswith(names):
                self.targets[k] = float(line.rpartition("S")[2])

    def settle(self) -> Wire:
        for _ in range(2000):
            self.deed()
            self.wire()
        return self

    def said(self) -> list[str]:
        return [row["text"] for row in self.held.state()["said"]]

    def print_lines(self, lines: list[str], send: str = "a") -> None:
        self.held.program(number=7, send=send, lines=lines)


def steps() -> st.SearchStrategy[list[str]]:
    return st.lists(
        st.sampled_from(["deed", "wire", "again", "pause", "go", "yes", "tick", "wrong"]),
        max_size=200,
    )


@settings(max_examples=60, deadline=None)
@given(steps())
def test_whatever_is_interleaved_each_line_is_printed_once_and_none_between(
    steps: list[str],
) -> None:
    wire = Wire().begin()
    wire.held.here("one")
    wire.print_lines(REPAIR)
    for step in steps:
        if step in {"deed", "wire"}:
            getattr(wire, step)()
        elif step == "again":  # the answer was lost
            wire.print_lines(REPAIR)
        elif step in {"pause", "go"}:
            wire.held.pause(value=step == "pause")
        elif step == "yes":
            wire.held.press({"what": "approve", "answer": "yes"})
        elif step == "wrong":
            over = wire.held.state()["program"]["over"]
            with pytest.raises(Refusal):  # nothing goes on in the midst, nor beside the job
                wire.held.press({"what": "pass"})
            if not over:
                with pytest.raises(Refusal, match="something else"):
                    wire.held.program(number=8, send="b", lines=["G1 X99"])
        else:
            wire.held.tick()
        assert len(wire.queue) <= AHEAD_LINES + 2, "a cancelled print stops soon"
    wire.held.pause(value=False)
    wire.settle()
    assert wire.executed == [*JOB[: LOOK - 1], *REPAIR, "M400"]
    assert wire.held.state()["program"]["over"]
    wire.held.go_on()
    wire.settle()
    assert wire.executed == [*JOB[: LOOK - 1], *REPAIR, "M400", *JOB[LOOK:]]


TOUCH = ["G1 Z5", "G38.2 Z2 F120"]


def test_a_touch_is_cold_and_what_the_firmware_says_against_it_is_ours() -> None:
    """OctoPrint would cancel the print for "Failed to reach target"."""
    wire = Wire().begin()
    wire.targets = [0.0, 60.0]  # cooled for the touches
    wire.held.off(hotends=[210.0])  # somebody ended the agent
    wire.settle()
    assert not wire.held.wrong("Thermal Runaway"), "no touch is under way"
    wire.held.program(number=7, send="a", lines=TOUCH, touches=True)
    assert wire.held.wrong("Failed to reach target")
    wire.settle()
    told = wire.held.state()["program"]
    assert (told["over"], told["wrong"]) == (True, "Failed to reach target")
    assert not wire.held.wrong("Thermal Runaway"), "it is over"
    assert wire.executed[-5:] == ["M107", "M190 S60", *TOUCH, "M400"], "the bed alone is heated"
    wire.held.program(number=8, send="b", lines=["G1 X1 E1"])
    wire.settle()
    assert wire.executed[-3:] == ["M109 S210", "G1 X1 E1", "M400"]


def test_lines_that_were_printed_in_another_way_are_left_out() -> None:
    wire = Wire().begin()
    wire.held.go_on(behind=wire.byte(LOOK + 2))
    wire.settle()
    assert wire.executed == [*JOB[: LOOK - 1], *JOB[LOOK + 2 :]]


def test_a_print_that_is_cancelled_in_a_repair_sends_no_more_and_is_safe() -> None:
    wire = Wire().begin()
    wire.print_lines(REPAIR)
    for _ in range(12):
        wire.deed()
        wire.wire()
    done = wire.executed.count("G1 Y1")
    wire.held.ended("cancelled")
    wire.job = []
    wire.settle()
    printed = [line for line in wire.executed if line.startswith("G1 Y")]
    assert done == 1
    assert len(printed) < len(REPAIR), "the rest is dropped"
    assert wire.targets == [0.0, 0.0]
    assert not wire.on_hold, "OctoPrint can end the print"
    with pytest.raises(Refusal, match="goes on or has ended"):
        wire.print_lines(REPAIR, "b")


def test_nobody_comes_and_the_heaters_go_off_and_on_again() -> None:
    wire = Wire().begin()
    wire.now_s = HOLD_PATIENCE_S + 1
    wire.held.tick()
    wire.settle()
    assert wire.targets == [0.0, 0.0]
    assert "nothing was done at this look for 600 s" in wire.said()[-1]
    wire.held.press({"what": "pass"})
    wire.settle()
    at = wire.executed.index("M190 S60")
    assert wire.executed[at:] == ["M190 S60", "M109 S210", "M400", *JOB[LOOK:]]


def test_an_agent_that_asks_keeps_the_bed_and_not_the_nozzle() -> None:
    wire = Wire().begin()
    wire.now_s = HOLD_PATIENCE_S + 1
    wire.held.here("one")
    wire.held.tick()
    wire.settle()
    assert wire.targets == [0.0, 60.0]
    wire.print_lines(["G1 Y1"])
    wire.settle()
    assert wire.executed[-3:] == ["M109 S210", "G1 Y1", "M400"]


def test_looks_that_were_ended_leave_a_way_back() -> None:
    wire = Wire().begin()
    wire.print_lines(["G1 Z50"])
    wire.settle()
    wire.held.off()
    wire.settle()
    with pytest.raises(Refusal, match="the nozzle has left the job: start 'amrepair agent' again"):
        wire.held.press({"what": "go on"})
    wire.held.leave(["G1 Z1"])
    wire.held.press({"what": "go on"})
    wire.settle()
    back = ["M190 S60", "M109 S210", "G1 Z1", "M400"]
    assert wire.executed[-len(back) - 3 :] == [*back, *JOB[LOOK:]]


def test_a_new_run_does_not_begin_beside_the_job() -> None:
    wire = Wire().begin()
    wire.held.forget()
    wire.print_lines(["G1 Z50"])
    with pytest.raises(Refusal, match="an earlier run has left the nozzle beside the job"):
        wire.held.forget()


def test_two_agents_on_one_printer() -> None:
    wire = Wire().begin()
    wire.held.here("one")
    with pytest.raises(Refusal, match="another agent serves this printer") as refused:
        wire.held.here("two")
    assert refused.value.status == 423
    wire.now_s += AGENT_GONE_S + 0.1
    wire.held.here("two")


@pytest.mark.parametrize(
    ("asked", "byte", "printing", "told"),
    [
        ("scan layer=3 z=0.8", 50, False, "nothing is being printed, so there is nothing to look"),
        ("scan layer=3 z=0.8", None, True, "in the middle of a layer nothing can be judged"),
        ("scan", 50, True, "put looks into the job by 'amrepair postprocess'"),
        ("approve perhaps", 50, True, "the answer is yes or no"),
        ("approve yes", 50, True, "'amrepair agent' does not run: nobody hears this"),
    ],
)
def test_what_is_asked_at_the_wrong_time_is_one_sentence(
    asked: str, byte: int | None, printing: bool, told: str
) -> None:
    wire = Wire()
    if printing:
        wire.held.began("job.gcode")
    assert not wire.held.mark(asked, byte)
    assert len(wire.said()) == 1
    assert told in wire.said()[0]


def test_a_restarted_octoprint_says_so_and_switches_off() -> None:
    wire = Wire(job=[])
    wire.held.left_behind()
    wire.settle()
    assert wire.targets == [0.0, 0.0]
    assert wire.said() == [
        "OctoPrint was restarted while a print rested at its look: it is over; heaters are "
        "switched off."
    ]


def test_it_needs_nothing_but_python() -> None:
    """OctoPrint's own environment has none of ours."""
    code = (
        "import sys, amrepair.agent.octoprint, amrepair.agent.octoprint.held\n"
        "heavy = {'numpy', 'torch', 'open3d', 'httpx', 'jaxtyping', 'beartype', 'rich', 'typer'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
