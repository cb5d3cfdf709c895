"""Lines made ready many at once are those made one by one; moves in a run are moves sent singly."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcode.errors import LocalProtocolError
from gcode.protocol import LINK_DIALECTS, Link, WireLine, WireLines
from gcode.protocol import events as ev
from gcode.protocol.lines import wire_line

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
    made = WireLines(first, commands, LINK_DIALECTS[dialect])
    assert list(made) == [
        one_by_one(first + i, command, dialect) for i, command in enumerate(commands)
    ]


@given(st.lists(st.sampled_from(PLAIN), min_size=1, max_size=30), st.sampled_from((1, 996)))
def test_plain_commands_take_the_short_way_to_the_same_bytes(
    commands: list[str], first: int
) -> None:
    marlin = LINK_DIALECTS["marlin"]
    assert list(WireLines(first, commands, marlin)) == [
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


def test_moves_that_follow_one_another_may_be_written_at_once() -> None:
    link = greeted()
    lines = link.prepare(["G1 X1", "G0 X2", "M105", "G1 X3", "G28", "G1 X4"])
    assert link.moves(lines, 0) == [lines[0].data, lines[1].data]  # type: ignore[union-attr]
    assert link.moves(lines, 1) == []  # its number is not the next one
    link.moves_sent(link.moves(lines, 0), 2, 1.0)
    assert (link.last_sent, link.last_acked, link.idle) == (2, 2, True)
    assert link.moves(lines, 2) == []  # no move
    for index in (2, 3, 4):
        link.send(lines[index], 1.0)
        link.receive(b"ok\n", 1.0)
    assert len(link.moves(lines, 5)) == 1


@pytest.mark.parametrize("odd", ODD)
def test_moves_among_which_one_is_odd_go_one_by_one(odd: str) -> None:
    link = greeted()
    assert link.moves(link.prepare(["G1 X1", odd, "G1 X2"]), 0) == []


def test_the_short_way_is_closed_while_anything_is_in_doubt() -> None:
    link = greeted()
    link.receive(b"o", 0.0)  # half a reply
    assert not link.moves(link.prepare(["G1 X1"]), 0)
    link = greeted(window=4)
    link.send("G1 X1", 0.0)
    assert not link.moves(link.prepare(["G1 X2"]), 0)  # one is under way
    link.receive(b"Resend: 1\n", 0.0)  # its ok is still to come, and acknowledges nothing
    assert not link.moves(link.prepare(["G1 X2"]), 0)
    link = greeted()
    link.send("G1 X1", 0.0)
    link.receive(b"Resend: 9\n", 0.0)  # never sent: an ok that comes with it belongs to it
    link.give_up("the cable was pulled")
    assert not link.moves(link.prepare(["G1 X2"]), 0)


@pytest.mark.parametrize(
    ("data", "count"),
    [
        (b"ok\n", 1),
        (b"ok\nok\n", 2),
        (b"ok N3 P15 B3\nok N4 P14 B2\n", 2),
        (b"ok N4 P15 B3\n", 0),  # its number is not the next one
        (b"ok N3 P15 B3\nok\n", 0),
        (b"ok\r\n", 0),
        (b"ok\nok", 0),
        (b"ok T:20\n", 0),
        (b"\nok", 0),
        (b"k\n", 0),
        (b"\n", 0),
        (b"", 0),
    ],
)
def test_only_acknowledgements_and_nothing_else_count(data: bytes, count: int) -> None:
    link = greeted()
    link.send("G1 X1", 0.0)
    link.receive(b"ok\n", 0.0)
    assert link.oks(data, 1) == count  # line 2 is answered, 3 is next


@pytest.mark.parametrize("answered", [0, 1, 2, 3])
@pytest.mark.parametrize("window", [1, 2, 4])
def test_both_ways_leave_the_same_link_behind(answered: int, window: int) -> None:
    commands = ["G1 X1", "G1 X2", "G1 X3"]
    short, long = greeted(window), greeted(window)
    lines = short.prepare(commands)
    written = short.moves(lines, 0)[: answered + window]
    short.moves_sent(written, answered, 5.0)
    for index in range(len(written)):
        if index >= window:
            assert long.receive(b"ok\n", 5.0) == [ev.Acknowledged(index - window + 1)]
        long.send(lines[index], 5.0)
    for index in range(max(len(written) - window, 0), answered):
        assert long.receive(b"ok\n", 5.0) == [ev.Acknowledged(index + 1)]
    assert short.ready == long.ready
    for _ in range(2):
        assert (short.state, short.last_sent, short.last_acked) == (
            long.state,
            long.last_sent,
            long.last_acked,
        )
        assert short.next_deadline_s() == long.next_deadline_s()
        ends = [(link.receive(b"Resend: 1\n", 6.0), link.tick(7.0)) for link in (short, long)]
        assert ends[0] == ends[1]
        assert short.take_output() == long.take_output()


def test_an_emergency_stop_in_the_middle_of_moves_stays_one() -> None:
    link = greeted()
    written = link.moves(link.prepare(["G1 X1", "G1 X2"]), 0)
    link.give_up("an emergency stop was asked for")
    link.moves_sent(written, 1, 5.0)
    assert (link.ended, link.last_sent, link.last_acked) == (True, 2, 1)
    with pytest.raises(LocalProtocolError, match="lost"):
        link.send("G1 X3", 5.0)
