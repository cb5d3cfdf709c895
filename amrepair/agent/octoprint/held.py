"""What the plugin knows and does, whatever OctoPrint it sits in: no I/O, no clock of its own.

A job is held where it is marked, and nothing of it is sent until it is let go on. A program that
is printed meanwhile is handed over whole, sent a few lines ahead of the wire, and counted. Calls
come from OctoPrint's threads, which hold its locks; so nothing of OctoPrint is called from here
but through `later`, a queue that one thread works off.
"""

from __future__ import annotations

import re
import threading
import uuid
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Any, Protocol, runtime_checkable

AHEAD_LINES = 8
"""Lines that OctoPrint has before it has sent them: a cancelled print stops within so many."""
AGENT_GONE_S = 6.0
"""Three times what an agent is silent."""
HOLD_PATIENCE_S = 600.0
SAFE_COMMANDS = ("M104 S0", "M140 S0", "M107")
KEPT = 20  # messages and calls
_SCAN = re.compile(r"scan\s+layer=(\d+)\s+z=([\d.]+)\s*$")
WAITS = "Waiting for a look. Where nothing happens, 'amrepair agent' does not run."


class Refusal(Exception):  # noqa: N818 - what it is
    """One sentence, and the status of the answer that carries it."""

    def __init__(self, sentence: str, status: int = 409) -> None:
        super().__init__(sentence)
        self.status = status


@runtime_checkable
class Server(Protocol):
    """OctoPrint, as far as it is driven; called by `later`'s thread only, but for `heat`."""

    def release(self) -> None:
        """Let the job go on."""

    def send(self, line: str, tag: str) -> None:
        """Have a line sent in its turn; `tag` comes back once it is on the wire."""

    def heat(self) -> tuple[tuple[float, ...], float]:
        """What the hotend of each head, and the bed, are set to, °C."""

    def cancel(self) -> None:
        """Cancel the print."""

    def tell(self, state: dict[str, Any]) -> None:
        """Push the state to whoever listens."""


@dataclass(slots=True)
class Print:
    """A print of OctoPrint's.

    Attributes
    ----------
    byte
        Behind the look that it rests at.
    touched
        Something was printed there.
    behind
        The file's lines that end here or before are left out.
    edits
        By the byte that they begin with, in order: bytes of the file, and what is sent in the place
        of the commands there, with the last of them.
    """

    path: str
    id: str
    ended: str = ""
    rests: bool = False
    touched: bool = False
    byte: int = 0
    layer: int = 0
    z_mm: float = 0.0
    behind: int = 0
    edits: tuple[tuple[int, int, tuple[str, ...]], ...] = ()


@dataclass(slots=True)
class Program:
    """Lines that are printed at a look.

    Attributes
    ----------
    touches
        The last of them is a touch, which a cold nozzle makes: it is not heated for it.
    wrong
        What the firmware said against a touch.
    """

    number: int
    send: str
    lines: tuple[str, ...]
    then: Callable[[], None] | None = None
    fed: int = 0
    done: int = 0
    over: bool = False
    touches: bool = False
    wrong: str = ""


@dataclass(slots=True)
class Shown:
    """What the tab shows."""

    doing: str = ""
    said: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=KEPT))
    prompt: dict[str, Any] | None = None


def _either_c(first: Sequence[float], other: Sequence[float]) -> tuple[float, ...]:
    """By head, what one tells of it, or else the other."""
    return tuple(a or b for a, b in zip_longest(first, other, fillvalue=0.0))


def _heated_again(was_c: Sequence[float], now_c: Sequence[float]) -> tuple[str, ...]:
    """Lines that heat each head that was on and is off."""
    pairs = enumerate(zip_longest(was_c, now_c, fillvalue=0.0))
    off = [k for k, (was, now) in pairs if was and not now]
    if max(len(was_c), len(now_c)) < 2:
        return tuple(f"M109 S{was_c[k]:g}" for k in off)
    return tuple(f"{heat} T{k} S{was_c[k]:g}" for heat in ("M104", "M109") for k in off)


class Held:
    """The plugin's state.

    Parameters
    ----------
    server
        OctoPrint.
    later
        Takes what is to be done, in order, in a thread of its own.
    clock
        Seconds, any origin.
    patience_s
        A nozzle that waits so long at a look is switched off; the bed, too, where no agent is.
    """

    def __init__(
        self,
        server: Server,
        later: Callable[[Callable[[], None]], None],
        clock: Callable[[], float],
        *,
        patience_s: Callable[[], float] = lambda: HOLD_PATIENCE_S,
    ) -> None:
        self._server, self._later, self._clock, self._patience_s = server, later, clock, patience_s
        self._lock = threading.RLock()
        self._print: Print | None = None
        self._program: Program | None = None
        self._paused = False
        self._way_back: tuple[str, ...] = ()
        self._heat: tuple[tuple[float, ...], float] = ((), 0.0)
        self._agent, self._seen_s, self.page = "", float("-inf"), ""
        self._active_s = clock()
        self._shown = Shown()
        self._calls: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._number = 0

    # ------------------------------------------------------------------ what it tells

    def state(self) -> dict[str, Any]:
        """All that browser and agent are told."""
        with self._lock:
            one, program = self._print, self._program
            return {
                "agent": self._agent_there(),
                "page": bool(self.page) and self._agent_there(),
                "print": None if one is None else {
                    "path": one.path, "id": one.id, "ended": one.ended, "rests": one.rests,
                    "byte": one.byte, "layer": one.layer, "z_mm": one.z_mm,
                },
                "program": None if program is None else {
                    "number": program.number, "done": program.done, "over": program.over,
                    "total": len(program.lines), "paused": self._paused, "wrong": program.wrong,
                },
                "heat": {"hotends": list(self._heat[0]), "bed": self._heat[1]},
                "doing": self._shown.doing,
                "said": list(self._shown.said),
                "prompt": self._shown.prompt,
                "calls": list(self._calls),
            }  # fmt: skip

    def _agent_there(self) -> bool:
        return self._clock() - self._seen_s < AGENT_GONE_S

    def _push(self) -> None:
        self._later(lambda: self._server.tell(self.state()))

    def say(self, text: str, *, wrong: bool = False) -> None:
        """One sentence, in the tab and on the printer's display."""
        with self._lock:
            self._shown.said.append({"text": text, "wrong": wrong})
        self._push()

    def show(self, what: str, said: dict[str, Any]) -> None:
        """What the agent has shown: doing, say, prompt or end_prompt."""
        with self._lock:
            self._active_s = self._clock()
            if what == "doing":
                self._shown.doing = str(said["text"])
            elif what == "prompt":
                self._shown.prompt = {"lines": said["lines"], "buttons": said["buttons"]}
            elif what == "end_prompt":
                self._shown.prompt = None
        if what == "say":
            self.say(str(said["text"]), wrong=bool(said.get("wrong")))
        self._push()

    # ------------------------------------------------------------------ OctoPrint's print

    def began(self, path: str) -> None:
        """OctoPrint has begun a print."""
        with self._lock:
            self._print = Print(path, uuid.uuid4().hex[:8])
            self._let_go()
            self._heat = ((), 0.0)
        self._push()

    def ended(self, how: str) -> None:
        """It is over: done, cancelled, or a fault in words."""
        with self._lock:
            one = self._print
            if one is None or one.ended:
                return
            one.ended, rested = how, one.rests
            one.rests = False
            self._let_go()
        if rested:
            self._later(self._server.release)
            self._say_safe(f"the print was ended at its look ({how})")
        self._push()

    def _let_go(self) -> None:
        self._program, self._paused, self._way_back = None, False, ()
        self._shown.prompt = None

    def left_behind(self) -> None:
        """OctoPrint was restarted while a job rested: that print is over."""
        self._say_safe("OctoPrint was restarted while a print rested at its look: it is over")

    def _say_safe(self, why: str) -> None:
        for line in (*SAFE_COMMANDS, *self._heads_off()):
            self._send(line)
        self.say(f"{why}; heaters are switched off.", wrong=True)

    def _heads_off(self) -> tuple[str, ...]:
        """Of several heads the word for the hotend means the one that is chosen."""
        count = len(self._server.heat()[0])
        return tuple(f"M104 T{k} S0" for k in range(count) if count > 1)

    def _send(self, line: str, tag: str = "") -> None:
        self._later(lambda: self._server.send(line, tag))

    @property
    def rests(self) -> bool:
        """Whether a job is held."""
        with self._lock:
            return self._print is not None and self._print.rests

    def mark(self, parameters: str, byte: int | None) -> bool:
        """Take `@amrepair …`; returns whether the job is to be held now.

        Parameters
        ----------
        byte
            Of the job's file, behind the line; None where it does not come from the job.
        """
        word, _, rest = parameters.strip().partition(" ")
        if word in {"status", "approve"}:
            answer = rest.strip().lower() or "yes"
            if word == "approve" and answer not in {"yes", "no"}:
                self.say("@amrepair approve: the answer is yes or no.", wrong=True)
            else:
                self._hand_on({"what": word, "answer": answer, "question": 0})
            return False
        with self._lock:
            one, found = self._print, _SCAN.match(parameters.strip())
            why = ""
            if one is None or one.ended:
                why = "nothing is being printed, so there is nothing to look at"
            elif byte is None or found is None:
                why = (
                    "in the middle of a layer nothing can be judged; put looks into the job by "
                    "'amrepair postprocess'"
                )
            if one is not None and found is not None and byte is not None and not why:
                one.rests, one.touched, one.byte = True, False, byte
                one.layer, one.z_mm = int(found.group(1)), float(found.group(2))
                self._active_s = self._clock()
                passes = {"label": "Go on without a look", "call": {"what": "pass"}}
                self._shown.prompt = {"lines": [WAITS], "buttons": [passes]}
        if why:
            self.say(f"@amrepair scan: {why}.", wrong=True)
        self._push()
        return not why

    def passed_by(self) -> None:
        """OctoPrint would not hold the job."""
        with self._lock:
            if self._print is not None:
                self._print.rests = False
            self._shown.prompt = None
        self.say("OctoPrint is busy and did not hold the job: no look here.", wrong=True)

    def instead(self, byte: int) -> tuple[str, ...] | None:
        """What is sent in the place of the job's command that ends at this byte; None: itself.

        It was printed by us in another way, or what is left of the job was written anew.
        """
        one = self._print
        if one is None:
            return None
        if byte <= one.behind:
            return ()
        k = bisect_left(one.edits, (byte,)) - 1  # the last that begins before it
        if k < 0 or byte > one.edits[k][1]:
            return None
        _, end, commands = one.edits[k]
        return commands if byte == end else ()

    # ------------------------------------------------------------------ the agent

    def here(self, agent: str, page: str = "") -> None:
        """An agent says that it is there.

        Raises
        ------
        Refusal
            If another is.
        """
        with self._lock:
            if agent != self._agent and self._agent_there():
                raise Refusal("another agent serves this printer", 423)
            new = agent != self._agent or not self._agent_there() or page != self.page
            self._agent, self._seen_s, self.page = agent, self._clock(), page
        if new:
            self._push()

    def program(
        self, *, number: int, send: str, lines: Sequence[str], touches: bool = False
    ) -> None:
        """Print lines at the look; told twice, they are printed once.

        Raises
        ------
        Refusal
            If the job does not rest, or other lines are under way.
        """
        with self._lock:
            one, under_way = self._print, self._program
            if under_way is not None and under_way.send == send:
                return
            if one is None or not one.rests:
                raise Refusal("the print goes on or has ended; nothing is printed at its look")
            if under_way is not None and not under_way.over:
                raise Refusal("something else is being printed at this look")
            one.touched = True
        warm = self._heating(hotend=not touches)
        self._print_lines(Program(number, send, (*warm, *lines), touches=touches))

    def _print_lines(self, program: Program) -> None:
        with self._lock:
            self._program, self._active_s = program, self._clock()
        self._later(self._feed)
        self._push()

    def _heating(self, *, hotend: bool = True) -> tuple[str, ...]:
        """What heats again what was switched off here; a hotend that is not is kept in mind."""
        with self._lock:
            was_c, bed_c = self._heat
            self._heat = (() if hotend else was_c, 0.0)
        now = self._server.heat()
        bed = (f"M190 S{bed_c:g}",) if bed_c and not now[1] else ()
        return (*bed, *(_heated_again(was_c, now[0]) if hotend else ()))

    def _feed(self) -> None:
        """Hand some lines to OctoPrint; in `later`'s thread, so in order."""
        with self._lock:
            one = self._program
            if one is None or self._paused or one.over:
                return
            first, one.fed = one.fed, min(one.done + AHEAD_LINES, len(one.lines))
            batch, closes = one.lines[first : one.fed], first < one.fed == len(one.lines)
        for k, line in enumerate(batch, start=first + 1):
            self._server.send(line, f"{one.send}:{k}")
        if closes:
            self._server.send("M400", "")
            self._server.send(f"@amrepair over {one.send}", "")

    def sent(self, tag: str) -> None:
        """A line is on the wire: those before it are acknowledged."""
        send, _, count = tag.partition(":")
        with self._lock:
            one = self._program
            if one is None or one.send != send:
                return
            one.done = max(one.done, int(count))
        self._later(self._feed)

    def over(self, send: str) -> None:
        """All lines are acknowledged and all their moves are made."""
        with self._lock:
            one = self._program
            if one is None or one.send != send or one.over:
                return
            one.done, one.over, self._active_s = len(one.lines), True, self._clock()
            then = one.then
        if then is not None:
            self._later(then)
        self._push()

    def wrong(self, text: str) -> bool:
        """The firmware says that something is wrong; whether that is a touch's, and ours to tell.

        It met nothing, or is not known: OctoPrint would cancel the print for it.
        """
        with self._lock:
            one = self._program
            if one is None or not one.touches or one.over:
                return False
            one.wrong = one.wrong or text
        return True

    def pause(self, *, value: bool) -> None:
        """Hold back what is printed at the look, or go on with it."""
        with self._lock:
            self._paused = value
        self._later(self._feed)
        self._push()

    def off(self, *, hotends: Sequence[float] = (), bed: float = 0.0) -> None:
        """Switch heaters off; what they were set to is kept for whoever goes on.

        Parameters
        ----------
        hotends, bed
            What they were set to as the job came to rest, °C, where they are off now.
        """
        with self._lock:
            self._heat = (_either_c(self._heat[0], hotends), self._heat[1] or bed)
        self._switch_off(bed=True)

    def _switch_off(self, *, bed: bool) -> None:
        hotends_c, bed_c = self._server.heat()
        with self._lock:
            was = self._heat
            self._heat = (_either_c(hotends_c, was[0]), (bed_c if bed else 0.0) or was[1])
        for line in (*(SAFE_COMMANDS if bed else SAFE_COMMANDS[:1]), *self._heads_off()):
            self._send(line)
        self._push()

    def leave(self, lines: Sequence[str]) -> None:
        """What leads back to the job, should somebody let it go on without the agent."""
        with self._lock:
            self._way_back = tuple(lines)

    def forget(self) -> None:
        """A new run begins.

        Raises
        ------
        Refusal
            If an earlier one has left the nozzle beside the job.
        """
        with self._lock:
            if self._print is not None and self._print.rests and self._print.touched:
                raise Refusal(
                    "an earlier run has left the nozzle beside the job; start the agent with that "
                    "run's --out, or cancel the print"
                )
            self._program = None

    def go_on(self, *, behind: int = 0, edits: Sequence[Sequence[Any]] = ()) -> None:
        """Let the job go on, without its lines up to byte `behind`.

        Parameters
        ----------
        edits
            What is sent from now on in the place of what: `Print.edits`.

        Raises
        ------
        Refusal
            If it does not rest.
        """
        with self._lock:
            if self._print is None or not self._print.rests:
                raise Refusal("the print does not rest at a look")
            self._print.behind = behind
            self._print.edits = tuple(
                (int(first), int(end), tuple(map(str, commands))) for first, end, commands in edits
            )
        self._warm_then_release(())

    def _warm_then_release(self, lines: Sequence[str]) -> None:
        first = (*self._heating(), *lines)
        if not first:
            self._release()
            return
        self._print_lines(Program(0, uuid.uuid4().hex, first, then=self._release))

    def _release(self) -> None:
        with self._lock:
            if self._print is None or not self._print.rests:
                return
            self._print.rests = False
            self._way_back = ()
            self._shown.prompt = None
        self._later(self._server.release)
        self._push()

    # ------------------------------------------------------------------ people

    def press(self, call: dict[str, Any]) -> None:
        """A button of the tab.

        Raises
        ------
        Refusal
            If it cannot be done now.
        """
        what = call.get("what")
        with self._lock:
            self._active_s = self._clock()
            one, way_back, program = self._print, self._way_back, self._program
            rests = one is not None and one.rests
            touched = one is not None and one.touched
        if what == "cancel":
            self._later(self._server.cancel)
        elif what in {"pass", "go on"}:
            if not rests:
                raise Refusal("the print does not rest at a look")
            if program is not None and not program.over:
                raise Refusal("something is being printed at this look; wait for it, or cancel")
            if touched and not way_back:
                raise Refusal(
                    "the nozzle has left the job: start 'amrepair agent' again, which goes on with "
                    "it, or cancel the print"
                )
            self._warm_then_release(way_back)
        elif what in {"approve", "status"}:
            self._hand_on(call)
        else:
            raise Refusal(f"there is no such button: {what!r}")

    def _hand_on(self, call: dict[str, Any]) -> None:
        """To the agent; said where none is there to hear it."""
        with self._lock:
            there = self._agent_there()
            if there:
                self._number += 1
                self._calls.append({**call, "number": self._number})
        if there:
            self._push()
        else:
            self.say("'amrepair agent' does not run: nobody hears this.", wrong=True)

    def tick(self) -> None:
        """Now and then: a nozzle does not wait hot for ever, and an agent that went is missed."""
        with self._lock:
            one, program = self._print, self._program
            waits = one is not None and one.rests and (program is None or program.over)
            late = self._clock() - self._active_s > self._patience_s()
            there = self._agent_there()
        if not waits or not late:
            return
        hotends_c, bed_c = self._server.heat()
        if any(hotends_c) or (bed_c and not there):
            self._switch_off(bed=not there)
            what = "the nozzle is" if there else "heaters are"
            self.say(f"nothing was done at this look for {self._patience_s():g} s: {what} "
                     "switched off, and heated again for whoever goes on.")  # fmt: skip
