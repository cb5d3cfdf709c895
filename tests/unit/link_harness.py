"""Joins the protocol machine and the emulated firmware without a port: time is a number.

The harness is the simplest host there can be: it sends when the link is ready, carries bytes both
ways, and lets time pass when nobody has anything to say.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from link_helpers import profile

from gcode.firmware import FirmwareCore, parse_faults
from gcode.protocol import Link, LinkTiming, State
from gcode.protocol import events as ev

STEP_S = 0.01
MAX_ROUNDS = 20_000


@dataclass
class Conversation:
    """A host and a printer; `executed` is what the printer carried out."""

    faults: str = ""
    dialect: str = "marlin"
    firmware: str = "marlin"
    window: int = 1
    seed: int = 0
    advanced_ok: bool = False
    by_moves: bool = False  # plain moves go the fast path
    executed: list[bytes] = field(default_factory=list)
    given: list[str] = field(default_factory=list)  # to the link, in order
    events: list[ev.Event] = field(default_factory=list)
    now_s: float = 0.0
    rounds: int = 0
    asked: int = 0
    written_off: int = 0

    def __post_init__(self) -> None:
        self.core = FirmwareCore(
            profile(),
            self.firmware,
            faults=parse_faults(self.faults),
            seed=self.seed,
            record=self.executed.append,
        )
        if self.advanced_ok:
            self.core.enable_advanced_ok()
        self.core.power_up()
        self.core.take_output()
        self.link = Link(self.dialect, window=self.window, timing=LinkTiming())

    def exchange(self) -> None:
        """Carry what the printer says; if it says nothing, let time pass."""
        self.rounds += 1
        assert self.rounds < MAX_ROUNDS, f"no end: {self.link.state}, {self.events[-12:]}"
        self.core.run(wall_s=self.now_s)
        data = self.core.take_output()
        before = self.now_s
        self.now_s += 0.0005 if data else STEP_S
        heard = self.link.receive(data, self.now_s) if data else []
        if not data:
            deadline_s = self.link.next_deadline_s()
            mute_s = self.core.mute_until_s
            wake_s = min((t for t in (deadline_s, mute_s) if t > before), default=self.now_s)
            if wake_s < float("inf"):
                self.now_s = max(self.now_s, wake_s)
            self.core.feed(b"", self.now_s)
        heard += self.link.tick(self.now_s)
        self.events += heard
        if output := self.link.take_output():
            self.core.feed(output, self.now_s)

    def wait(self) -> None:
        """Until a further line may be sent, or the link has ended."""
        while not self.link.ready and not self.link.ended:
            self.exchange()

    def hello(self) -> None:
        self.core.feed(self.link.hello(self.now_s), self.now_s)
        self.wait()
        self.settle(0.3)

    def settle(self, quiet_s: float) -> None:
        until_s = self.now_s + quiet_s
        while self.now_s < until_s and not self.link.ended:
            self.exchange()

    def send(self, command: str) -> bool:
        self.wait()
        if self.link.ended:
            return False
        self.core.feed(self.link.send(command, self.now_s), self.now_s)
        self.given.append(command)
        return True

    def finish(self) -> bool:
        """Until all is acknowledged and proved by a report that only the last line can cause.

        Every M114 is executed once and reports once: as many reports as questions, or the last
        one has not been received; or a report was garbled, after which only new questions count.
        """
        for _ in range(20):
            if not self.send("M114"):
                return False
            self.asked += 1
            while not self.link.idle and not self.link.ended:
                self.exchange()
            if self.link.ended:
                return False
            if self.reports() - self.written_off >= self.asked:
                self.link.confirm()
                return True
            self.settle(0.3)
            if self.link.dialect.verifies and not self.prove_place():
                return False
            self.asked, self.written_off = 0, self.reports()
        raise AssertionError("M114 is never answered")

    def prove_place(self) -> bool:
        """Have the printer say which line it took last, until that is the last there is."""
        for _ in range(20):
            self.core.feed(self.link.ask_place(self.now_s), self.now_s)
            asked_at = len(self.events)
            while not self.link.idle and not self.link.ended:
                self.exchange()
            if self.link.ended:
                return False
            if any(isinstance(event, ev.Proved) for event in self.events[asked_at:]):
                self.asked, self.written_off = 0, self.reports()
                return True
        raise AssertionError("it never says the last line")

    def reports(self) -> int:
        return sum(isinstance(event, ev.PositionReport) for event in self.events)

    def job(self, lines: list[str]) -> bool:
        """Hello, the lines, the proof; False if the link ended."""
        self.hello()
        if self.link.ended or not self.finish():
            return False
        if self.by_moves:
            return self._send_by_moves(lines) and self.finish()
        for line in lines:
            if not self.send(line):
                return False
        return self.finish()

    def _send_by_moves(self, commands: list[str]) -> bool:
        """As a host does: moves while the answers are plain, one by one where they are not."""
        at = 0
        while at < len(commands):
            self.wait()
            if self.link.ended:
                return False
            lines = self.link.prepare(commands[at:])
            first = at
            if moves := self.link.moves(lines, 0):
                at += self._send_moves(moves)
            else:
                self.core.feed(self.link.send(lines[0], self.now_s), self.now_s)
                at += 1
            self.given += commands[first:at]
        return True

    def _send_moves(self, moves: list[bytes]) -> int:
        written = answered = 0
        data = b""
        while answered < len(moves):
            for move in moves[written : answered + self.window]:
                self.core.feed(move, self.now_s)
                written += 1
            self.core.run(wall_s=self.now_s)
            data = self.core.take_output()
            self.now_s += 0.0005
            count = self.link.oks(data, answered)
            if not 0 < count <= written - answered:
                break
            answered, data = answered + count, b""
        self.link.moves_sent(moves[:written], answered, self.now_s)
        self.events += self.link.receive(data, self.now_s) if data else []
        self.core.feed(self.link.take_output(), self.now_s)
        return written

    @property
    def program(self) -> list[str]:
        """What was executed, the harness's own questions left out."""
        return [line.decode("latin-1") for line in self.executed if line != b"M114"]

    @property
    def lost(self) -> ev.LinkLost | None:
        return next((e for e in self.events if isinstance(e, ev.LinkLost)), None)

    @property
    def state(self) -> State:
        return self.link.state
