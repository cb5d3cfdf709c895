"""Plain moves by the fast way: whatever ends it, what was sent and answered is right."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from link_helpers import profile

from gcode.firmware import EmulatedPrinterProcess
from gcode.hosts import fast_path
from gcode.hosts.fast_path import MOST_S, Exchange, waiting
from gcode.hosts.serial import SerialPrinter

MOVES = [b"N%d G1 X1*1\n" % number for number in range(10, 20)]


class Port:
    """Answers from a script; an exception in it is raised, None is silence."""

    def __init__(self, *answers: bytes | Exception | None, takes: list[int] | None = None) -> None:
        self.answers = list(answers)
        self.takes = takes or []
        self.written = b""
        self.most_under_way = self.answered = 0
        self.now_s = 0.0

    def write(self, fd: int, data: bytes) -> int:
        taken = self.takes.pop(0) if self.takes else len(data)
        if taken < 0:
            raise BlockingIOError
        self.written += data[:taken]
        under_way = self.written.count(b"\n") - self.answered
        self.most_under_way = max(self.most_under_way, under_way)
        return taken

    def read(self, fd: int, size: int) -> bytes:
        answer = self.answers.pop(0) if self.answers else None
        if isinstance(answer, Exception):
            raise answer
        if answer is None:  # nothing came in time
            return b""
        self.answered += answer.count(b"ok")
        return answer

    def clock(self) -> float:
        self.now_s += 0.01
        return self.now_s

    def exchange(self, *, window: int = 1, most_bytes: int = 120) -> Exchange:
        return Exchange(
            0,
            clock=self.clock,
            oks=lambda data, answered: data.count(b"\n") * (data == b"ok\n" * data.count(b"\n")),
            asked_to_stop=lambda: False,
            window=window,
            most_bytes=most_bytes,
        )


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[[Port], Port]:
    def plug_in(port: Port) -> Port:
        monkeypatch.setattr(fast_path, "os", SimpleNamespace(write=port.write, read=port.read))
        return port

    return plug_in


@pytest.mark.parametrize("window", [1, 4])
@pytest.mark.parametrize(
    ("end", "answer"),
    [
        (b"Resend: 12\nok\n", b"Resend: 12\nok\n"),
        (b"ok T:20\n", b"ok T:20\n"),
        (b"", None),  # the port was closed
        (b"ok\n" * 5, b"ok\n" * 5),  # more than is under way
        (None, None),
        (BlockingIOError(), None),  # another thread has switched the waiting off
    ],
)
def test_anything_odd_ends_it_and_is_handed_on(
    at: Callable[[Port], Port], window: int, end: bytes | Exception | None, answer: bytes | None
) -> None:
    port = at(Port(b"ok\n", b"ok\n", end))
    exchange = port.exchange(window=window)
    exchange.run(MOVES)
    assert (len(exchange.sent_s), len(exchange.answered_s)) == (2 + window, 2)
    assert (exchange.answer, exchange.rest) == (answer, b"")
    assert port.written == b"".join(MOVES[: 2 + window])


@pytest.mark.parametrize("window", [1, 4])
def test_a_port_that_fails_leaves_the_count_behind(at: Callable[[Port], Port], window: int) -> None:
    exchange = at(Port(b"ok\n", OSError(5, "gone"))).exchange(window=window)
    with pytest.raises(OSError, match="gone"):
        exchange.run(MOVES)
    assert (len(exchange.sent_s), len(exchange.answered_s)) == (1 + window, 1)


@pytest.mark.parametrize("taken", [3, 0, -1])
def test_what_a_full_port_does_not_take_is_kept(at: Callable[[Port], Port], taken: int) -> None:
    size = len(MOVES[0])
    port = at(Port(b"ok\n", takes=[size, taken]))
    exchange = port.exchange()
    exchange.run(MOVES)
    assert port.written + exchange.rest == MOVES[0] + MOVES[1]
    assert (len(exchange.sent_s), len(exchange.answered_s)) == (2, 1)


def test_no_more_is_under_way_than_window_and_buffer_allow(at: Callable[[Port], Port]) -> None:
    port = at(Port(*[b"ok\n", b"ok\nok\n"] * 4))
    exchange = port.exchange(window=4)
    exchange.run(MOVES)
    assert port.most_under_way == 4
    assert (len(exchange.sent_s), len(exchange.answered_s)) == (10, 10)
    port = at(Port(*[b"ok\n"] * 10))
    port.exchange(window=9, most_bytes=2 * len(MOVES[0])).run(MOVES)
    assert port.most_under_way == 2


@pytest.mark.parametrize("window", [1, 4])
def test_it_ends_in_time_with_nothing_under_way(at: Callable[[Port], Port], window: int) -> None:
    port = at(Port(*[b"ok\n"] * 200))
    exchange = port.exchange(window=window)
    exchange.run(MOVES * 20)
    assert MOST_S <= port.now_s < MOST_S + 0.1
    assert 0 < len(exchange.sent_s) == len(exchange.answered_s) < 200


@pytest.mark.parametrize("window", [1, 4])
def test_who_asks_to_stop_waits_for_no_further_move(
    at: Callable[[Port], Port], window: int
) -> None:
    port = at(Port(*[b"ok\n"] * 20))
    exchange = port.exchange(window=window)
    exchange.asked_to_stop = lambda: port.answered >= 2
    exchange.run(MOVES)
    assert len(exchange.sent_s) == len(exchange.answered_s) == 1 + window


def test_a_read_waits_half_a_second_and_no_longer() -> None:
    """On a real pseudo-terminal: for an answer that comes, and for one that does not."""
    with (
        EmulatedPrinterProcess(printer=profile()) as emulator,
        SerialPrinter(emulator.port, supervise=False) as printer,
    ):
        fd = printer._fd
        assert not os.get_blocking(fd)
        with pytest.raises(BlockingIOError):  # not as if the port were closed
            os.read(fd, 10)
        with waiting(fd):
            os.write(fd, b"M118 there\n")
            assert os.read(fd, 10).startswith(b"there")
            while os.read(fd, 10):
                pass
            start_s = time.monotonic()
            assert os.read(fd, 10) == b""
        assert 0.3 < time.monotonic() - start_s < 20.0
        assert not os.get_blocking(fd)
