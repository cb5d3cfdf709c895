"""Lines made ready many at once are the lines made one by one; a plain ok is a plain ok."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcode.errors import LocalProtocolError
from gcode.protocol import LINK_DIALECTS, Link, State, WireLine
from gcode.protocol import events as ev
from gcode.protocol.lines import wire_line, wire_lines

PLAIN = ("G1 X1.5 Y2", "G0 F600", "M109 S200", "G28", "M117 hello", "PRINT_START BED=60")
ODD = ("G1 X1 ;c", " G1 X1", "G1 X1 ", "", ";c", "M117 M110", "M110 N4", "G1\nG2", "M117 é", "G1\t")
LONG = ("M117 " + "x" * 120, "G1 " + "X1 " * 40)


def one_by_one(number: int, command: str, dialect: str) -> WireLine | str:
    try:
        return wire_line(number, command, LINK_DIALECTS[dialect])
    except LocalProtocolError:
        return command


@given(
    commands=st.lists(st.sampled_from((*PLAIN * 8, *ODD, *LONG)), min_size=1, max_size=30),
    first=st.sampled_from((1, 8, 95, 9_995, 99_999_990)),
    dialect=st.sampled_from(sorted(LINK_DIALECTS)),
)
def test_many_at_once_are_those_made_one_by_one(
    commands: list[str], first: int, dialect: str
) -> None:
    made = wire_lines(first, commands, LINK_DIALECTS[dialect])
    assert made == [one_by_one(first + i, command, dialect) for i, command in enumerate(commands)]


@given(st.lists(st.sampled_from(PLAIN), min_size=1, max_size=30), st.sampled_from((1, 996)))
def test_plain_commands_take_the_short_way_to_the_same_bytes(
    commands: list[str], first: int
) -> None:
    marlin = LINK_DIALECTS["marlin"]
    assert wire_lines(first, commands, marlin) == [
        wire_line(first + i, command, marlin) for i, command in enumerate(commands)
    ]


def greeted(window: int = 1) -> Link:
    link = Link(window=window)
    link.hello(0.0)
    link.receive(b"ok\n", 0.0)
    return link


def test_a_line_made_ready_is_numbered_anew_where_another_came_between() -> None:
    link = greeted()
    first, second = link.prepare(["G1 X1", "G1 X2"])
    assert link.send(first, 0.0).startswith(b"N1 G1 X1*")
    link.receive(b"ok\n", 0.0)
    assert link.send("M105", 0.0).startswith(b"N2 M105*")
    link.receive(b"ok\n", 0.0)
    assert link.send(second, 0.0).startswith(b"N3 G1 X2*")


def test_what_cannot_be_carried_is_refused_when_its_turn_comes() -> None:
    link = greeted()
    first, second = link.prepare(["G1 X1", "M110 N7"])
    link.send(first, 0.0)
    link.receive(b"ok\n", 0.0)
    with pytest.raises(LocalProtocolError, match="renumbers"):
        link.send(second, 0.0)
    assert link.idle


@pytest.mark.parametrize("data", [b"ok\r\n", b"ok N1\n", b"ok\nok\n", b"k\n", b"", b"wait\n"])
def test_only_a_plain_ok_takes_the_short_way(data: bytes) -> None:
    link = greeted()
    link.send("G1 X1", 0.0)
    assert not link.receive_ok(data)
    assert (link.state, link.last_acked) == (State.WAITING, 0)


def test_the_short_way_is_closed_while_anything_is_in_doubt() -> None:
    link = greeted()
    line = link.send("G1 X1", 0.0)
    link.receive(b"o", 0.0)  # half a reply
    assert not link.receive_ok(b"ok\n")
    link = greeted(window=4)
    link.send("G1 X1", 0.0)
    link.send("G1 X2", 0.0)
    assert not link.receive_ok(b"ok\n")  # of two lines under way, which?
    link = greeted()
    link.send("G1 X1", 0.0)
    link.receive(b"Resend: 1\n", 0.0)  # its ok is still to come, and acknowledges nothing
    assert not link.receive_ok(b"ok\n")
    link = greeted()
    link.send("G1 X1", 0.0)
    link.tick(link.next_deadline_s())
    assert link.take_output() == line
    assert not link.receive_ok(b"ok\n")  # sent twice: the other copy may earn a stale request


def test_both_ways_leave_the_same_link_behind() -> None:
    short, long = greeted(), greeted()
    for link in (short, long):
        link.send("G1 X1", 0.0)
    assert short.receive_ok(b"ok\n")
    assert long.receive(b"ok\r\n", 0.0) == [ev.Acknowledged(1)]
    for link in (short, long):
        assert (link.state, link.last_acked, link.ready) == (State.IDLE, 1, True)
        assert link.next_deadline_s() == float("inf")
        assert link.send("G1 X2", 1.0).startswith(b"N2 ")
        assert link.next_deadline_s() == 1.0 + link.timing.silence_s
