"""Any bytes at all, to either side: an event or a protocol error, nothing else.

Half of the inputs are replies and commands as they should be, half are those bent, cut, joined
and filled with noise. A million by name (`-m slow`), a share in the suite.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_helpers import profile

from gcode.errors import LocalProtocolError
from gcode.firmware import FirmwareCore
from gcode.hosts import supervisor
from gcode.protocol import Link, checksum
from gcode.protocol import events as ev
from gcode.protocol.replies import parse_reply

REPLIES = (
    *(b"ok\n", b"ok N12 P15 B3\n", b"ok T:20.1 /0.0 B:20.0 /0.0 @:0\n", b"ok P15\n"),
    *(b"Resend: 3\nok\n", b"rs N2\n", b"Resend:7\n", b"Resend: 2147483648\n", b"Resend: -1\n"),
    *(b"Error:checksum mismatch, Last Line: 2\n", b"Error:Printer halted. kill() called!\n"),
    *(b"echo:busy: processing\n", b"busy: paused for user\n", b"wait\n", b"start\n", b"!! x\n"),
    *(b" T:200.00 /200.00 B:60.00 /60.00 @:64\n", b"X:1.00 Y:2.00 Z:3.00 E:4.00 Count X:1\n"),
    *(b"FIRMWARE_NAME:Marlin 2.1 PROTOCOL_VERSION:1.0\n", b"Cap:EMERGENCY_PARSER:1\n"),
    *(b"//action:pause\n", b"// Klipper state: Ready\n", b"echo:Unknown command: \"G99*3\"\n"),
    *(b"Error:Thermal Runaway, system stopped!\n", b"echo:SD card ok\n", b"\n", b"\r\n", b"ok"),
)  # fmt: skip
COMMANDS = (
    *(b"G1 X10 Y10 E.5 F600", b"G28", b"G28 X", b"M104 S200", b"M140 S60", b"G92 E0", b"M114"),
    *(b"G2 X5 Y5 I2 J2", b"G3 X5 R-4", b"M110 N4", b"M105", b"M115", b"M155 S2", b"M154 S1"),
    *(b"G91", b"G90", b"G20", b"M83", b"M106 S", b"M204 P", b"M118 E1 x", b"T0", b"M302 P1"),
    *(b"M112", b"M108", b"M410", b"G4 P10", b"M400", b"M109 S50", b"M0", b"G29", b"", b";x"),
)  # fmt: skip
NUMBERS = (b"0", b"-1", b"99999999999999999999", b"1e9", b".", b"--3", b"2147483647", b"nan")


class Fuzzer:
    """Makes inputs; the same seed makes the same."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)

    def bytes(self, corpus: tuple[bytes, ...]) -> bytes:
        """Some words of a corpus, whole or bent."""
        rng = self.rng
        data = b"".join(rng.choices(corpus, k=rng.choice((1, 1, 1, 2, 3))))
        if rng.random() < 0.5:
            return data
        for _ in range(rng.choice((1, 1, 2, 5))):
            data = self._bend(data)
        return data

    def _bend(self, data: bytes) -> bytes:
        rng = self.rng
        at = rng.randrange(len(data) + 1)
        to = min(len(data), at + rng.choice((1, 1, 2, 8)))
        match rng.randrange(7):
            case 0:
                return data[:at] + data[to:]
            case 1:
                return data[:at] + rng.randbytes(rng.choice((1, 2, 9))) + data[to:]
            case 2:
                return (
                    data[:at] + bytes(b ^ (1 << rng.randrange(8)) for b in data[at:to]) + data[to:]
                )
            case 3:
                return data[:to] + data[at:]
            case 4:
                return data[:at] + rng.choice(NUMBERS) + data[to:]
            case 5:
                return (
                    data[:at]
                    + rng.choice((b"\n", b"\r", b"\0", b" ", b"*", b"N", b":"))
                    + data[at:]
                )
            case _:
                return (
                    data[:at] + data[at:to] * rng.choice((2, 2, 2, 2, 2, 2, 50, 5000)) + data[to:]
                )

    def numbered(self, command: bytes, number: int) -> bytes:
        """A command with number and checksum, mostly the right ones."""
        if self.rng.random() < 0.2:
            number += self.rng.choice((-1, 1, 10**12))
        body = b"N%d %b" % (number, command)
        value = checksum(body) ^ (self.rng.random() < 0.1)
        return b"%b*%d" % (body, value)


def fuzz_host(fuzzer: Fuzzer, count: int) -> None:
    """The host's side: events of its own kinds, and only lines that it was given go out."""
    rng, done = fuzzer.rng, 0
    while done < count:
        link = Link(
            rng.choice(("marlin", "marlin", "klipper", "reprap")), window=rng.choice((1, 4))
        )
        now_s = 0.0
        given = {link.dialect.question, *link.hello(now_s).split(b"\n")}
        for _ in range(rng.choice((5, 40))):
            done += 1
            data = fuzzer.bytes(REPLIES)
            now_s += rng.choice((0.0, 0.001, 0.2, 5.0, 70.0))
            events = link.receive(data, now_s) + link.tick(now_s)
            assert all(type(event).__module__ == ev.__name__ for event in events), data
            assert 0 <= link.last_acked <= link.last_sent
            if link.ready and rng.random() < 0.7:
                try:
                    given.update(link.send(f"G1 X{done} ; {done}", now_s).split(b"\n"))
                except LocalProtocolError:
                    assert len(f"{done}") > 90
            if rng.random() < 0.3:  # the fast path: the answers are looked at unparsed
                moves = link.moves(link.prepare([f"G1 X{done}", f"G0 Y{done}"]), 0)
                answered = min(link.oks(fuzzer.bytes(REPLIES), 0), len(moves))
                moves = moves[: answered + link.window]
                given.update(move.rstrip(b"\n") for move in moves)
                link.moves_sent(moves, answered, now_s)
            given_back = link.take_output().split(b"\n")
            assert given.issuperset(given_back), (data, given_back)
            if link.ended:
                assert any(isinstance(e, ev.LinkLost | ev.CommandFailed) for e in events)
                break


SHUT_DOWN_LINES = 7
"""A Klipper that has shut down says so to every line, the empty ones of one input as well."""


def fuzz_firmware(fuzzer: Fuzzer, count: int) -> None:
    """The printer's side: answers, and numbers that only rise by one with what it carries out."""
    rng, done = fuzzer.rng, 0
    while done < count:
        executed: list[bytes] = []
        core = FirmwareCore(
            profile(),
            rng.choice(("marlin", "marlin", "prusa", "klipper", "reprap")),
            record=executed.append,
        )
        core.power_up()
        for _ in range(rng.choice((5, 60))):
            done += 1
            data = fuzzer.bytes(COMMANDS)
            if rng.random() < 0.5:
                data = fuzzer.numbered(data, core.last_number + 1)
            core.feed(data + rng.choice((b"\n", b"\n", b"\n", b"", b"\r\n")), 0.0)
            core.run()
            answer = core.take_output()
            assert answer.count(b"\n") < 20_000 + SHUT_DOWN_LINES * data.count(b"\n")
            if core.machine.killed:
                break


def fuzz_small(fuzzer: Fuzzer, count: int) -> None:
    """One line read by itself, and what the supervisor reads."""
    kinds = ev.__name__
    for _ in range(count):
        data = fuzzer.bytes(REPLIES)
        assert type(parse_reply(data)).__module__ == kinds, data
        supervisor._TARGET.findall(data)


def fuzz(count: int, seed: int) -> None:
    fuzzer = Fuzzer(seed)
    fuzz_host(fuzzer, count * 4 // 10)
    fuzz_firmware(fuzzer, count * 4 // 10)
    fuzz_small(fuzzer, count * 2 // 10)


def test_five_thousand_inputs_make_events_and_nothing_else() -> None:
    fuzz(5_000, seed=1)


def test_a_reply_without_end_costs_no_time() -> None:
    """Found by the fuzzer: a line of 24,000 blanks that came in one piece was read by patterns."""
    link = Link()
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    link.send("G1 X1", 0.0)
    for data in (b"ok N1" + b" " * 24_000 + b"\n", b"x" * 5000 + b"\n"):
        (event,) = link.receive(data, 0.1)
        assert isinstance(event, ev.Unrecognised)
        assert len(event.raw) <= 80
    assert isinstance(link.receive(b"ok\n", 0.2)[0], ev.Acknowledged)


@pytest.mark.parametrize(
    "command",
    [
        b"G4 S1e47",
        b"G4 S111111111111111111111",
        b"G1 Xnan",
        b"G1 X1e300",
        b"G1 Einf",
        b"G1 X1 F0",
        b"G1 F-5",
        b"M110 N" + b"4" * 5000,
    ],
)
@pytest.mark.parametrize("after", [b"M400", b"G28", b"G2 X5 Y5 I9999999 J3"])
def test_no_number_keeps_the_emulated_printer_busy_for_ever(command: bytes, after: bytes) -> None:
    """Found by the fuzzer: it told of every two seconds of 10⁴⁷."""
    core = FirmwareCore(profile(), "klipper")  # it takes lines of any length
    core.power_up()
    for line in (b"G28", command, after, b"M114"):
        core.feed(line + b"\n", 0.0)
        core.run()
    assert b"nan" not in core.take_output()


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("part", range(10))
def test_a_million_inputs_make_events_and_nothing_else(part: int) -> None:
    fuzz(100_000, seed=100 + part)


@settings(max_examples=200)
@example(at=[6, 18], letters=[None, None], which=0)
@given(
    at=st.lists(st.integers(0, 34), min_size=2, max_size=2, unique=True),
    letters=st.lists(st.one_of(st.none(), st.sampled_from("aZ0 ;:")), min_size=2, max_size=2),
    which=st.integers(0, 2),
)
def test_a_transmission_error_that_arrives_damaged_ends_no_job(
    at: list[int], letters: list[str | None], which: int
) -> None:
    # regression: "hecksum mismatch, ast Line: 348" of a native Marlin was taken for a fault
    said = (
        "Error:checksum mismatch, Last Line: 348",
        "Error:No Checksum with line number, Last Line: 348",
        "Error:Line Number is not Last Line Number+1, Last Line: 348",
    )[which]
    damaged = list(said)
    for place, letter in zip(at, letters, strict=True):
        damaged[place] = letter or ""
    assert not isinstance(parse_reply("".join(damaged).encode()), ev.CommandFailed)
