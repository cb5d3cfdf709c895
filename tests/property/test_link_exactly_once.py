"""Whatever goes wrong on the wire: executed exactly once and in order, or stopped and said so."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent.parent / "unit"))
from link_harness import Conversation

from gcode.protocol import Link
from gcode.protocol import events as ev

# Faults after which a firmware that verifies can always be brought on.
MENDABLE = (
    "lose_ok",
    "garble_ok",
    "double_ok",
    "corrupt_in",
    "drop_in",
    "noise_in",
    "noise_out",
    "corrupt_out",
    "resend_storm",
    "resend_gone",
    "resend_without_ok",
    "silence s=3",
    "busy s=30",
    "runout s=5",
)
UNNUMBERED = (
    "lose_ok",
    "garble_ok",
    "double_ok",
    "drop_in",
    "noise_out",
    "corrupt_out",
    "silence s=3",
    "busy s=30",
    "corrupt_in",
)
ENDING = ("reset", "silent_reset", "thermal_runaway", "dead")


OTHERS = (
    *("G28 X", "G4 P700", "M400", "M105", "M106 S128", "M117 hours", "M109 S40", "M140 S30"),
    *(
        "G92 E0",
        "M83",
        "M82",
        "G1 X5",
        "G0 Y7 F3000",
        "M118 E1 here",
        "M204 P900",
        "G2 X9 Y9 I2 J2",
    ),
)


QUESTIONS = (b"M105", b"M114")


def program(count: int) -> list[str]:
    return [f"G1 X{i % 180} Y{i * 7 % 180} F6000" for i in range(count)]


def programs() -> st.SearchStrategy[list[str]]:
    """Moves, all different, and whatever else programs hold in between."""
    one = st.sampled_from((None,) * 24 + OTHERS)
    return st.lists(one, min_size=8, max_size=45).map(
        lambda drawn: [
            other or move for other, move in zip(drawn, program(len(drawn)), strict=True)
        ]
    )


def fault_scripts(kinds: tuple[str, ...]) -> st.SearchStrategy[str]:
    one = st.tuples(st.integers(5, 45), st.sampled_from(kinds)).map(lambda f: f"line {f[0]} {f[1]}")
    many = st.tuples(st.integers(3, 20), st.sampled_from(kinds[:8])).map(
        lambda f: f"every {f[0]} {f[1]}"
    )
    always = st.sampled_from(["", "always resend_without_ok"])
    return st.tuples(st.lists(one, max_size=8), st.lists(many, max_size=2), always).map(
        lambda parts: "\n".join([*parts[0], *parts[1], parts[2]])
    )


@settings(max_examples=75)
@given(
    lines=programs(),
    faults=fault_scripts(MENDABLE),
    seed=st.integers(0, 99),
    window=st.sampled_from([1, 1, 4]),
    advanced=st.booleans(),
    by_moves=st.booleans(),
)
def test_every_command_runs_once_and_in_order(
    lines: list[str], faults: str, seed: int, window: int, advanced: bool, by_moves: bool
) -> None:
    talk = Conversation(faults, window=window, seed=seed, advanced_ok=advanced, by_moves=by_moves)
    assert talk.job(lines), talk.lost
    assert talk.program == lines


@settings(max_examples=75)
@given(
    lines=programs(),
    faults=fault_scripts(MENDABLE),
    end=st.tuples(st.integers(5, 40), st.sampled_from(ENDING)),
    seed=st.integers(0, 99),
    window=st.sampled_from([1, 4]),
    by_moves=st.booleans(),
)
def test_where_it_cannot_go_on_it_stops_and_names_the_true_interval(
    lines: list[str],
    faults: str,
    end: tuple[int, str],
    seed: int,
    window: int,
    by_moves: bool,
) -> None:
    script = faults + f"\nline {end[0]} {end[1]}"
    talk = Conversation(script, window=window, seed=seed, by_moves=by_moves)
    done = talk.job(lines)
    executed = talk.program
    assert executed == lines[: len(executed)]  # a prefix: in order, none twice
    if done:
        assert executed == lines
    elif talk.lost is not None:
        assert len(executed) <= talk.lost.last_sent
    else:
        assert any(isinstance(e, ev.CommandFailed) and e.fatal for e in talk.events)


@settings(max_examples=80)
@given(
    lines=programs().map(lambda lines: ["G1 X1 F600", *lines]),
    faults=fault_scripts(UNNUMBERED),
    end=st.tuples(st.integers(5, 45), st.sampled_from(("lose_ok", *ENDING))),
    firmware=st.sampled_from(["klipper", "reprap"]),
    seed=st.integers(0, 99),
    by_moves=st.booleans(),
)
def test_without_numbers_it_stops_and_names_the_true_interval(
    lines: list[str],
    faults: str,
    end: tuple[int, str],
    firmware: str,
    seed: int,
    by_moves: bool,
) -> None:
    """Nothing is sent twice: what cannot be asked for ends the link, between what it says."""
    script = faults + f"\nline {end[0]} {end[1]}"
    if firmware == "klipper":  # nothing is lost on the way through a pseudo-terminal
        faults = faults.replace("drop_in", "lose_ok")
        script = faults + f"\nline {end[0] + 4} {end[1]}"  # after the first move, or it is at zero
    talk = Conversation(script, dialect=firmware, firmware=firmware, seed=seed, by_moves=by_moves)
    lines = [line for line in lines if line != "M105"]  # that is the hello of one of them
    done = talk.job(["G28", *lines])
    executed = [line.decode("latin-1") for line in talk.executed if line not in QUESTIONS]
    if "corrupt_in" in faults:  # carried out as it came: no firmware of these can tell
        assert len(executed) <= talk.link.last_sent
        return
    given = [line for line in talk.given if line != "M114"]
    assert executed == given[: len(executed)]
    if done:
        assert executed == given
    elif talk.lost is not None:
        acked, sent = (
            sum(line != "M114" for line in talk.given[:number])
            for number in (talk.lost.last_acked, talk.lost.last_sent)
        )
        assert acked <= len(executed) <= sent
    else:
        assert any(isinstance(e, ev.CommandFailed) and e.fatal for e in talk.events)


def _through_a_damaged_wire(
    firmware: str, seed: int, *, count: int, window: int = 1, by_moves: bool = False
) -> Conversation:
    """Print beads through a wire that damages one byte in 200 each way; what came of it."""
    talk = Conversation(
        "always damage s=0.005",
        dialect=firmware,
        firmware=firmware,
        window=window,
        seed=seed,
        by_moves=by_moves,
    )
    lines = ["G28", "M83"]
    lines += [
        f"G1 X{i % 180} Y{i * 7 % 180} E{0.02 + i % 7 * 0.01:.3f} F6000" for i in range(count)
    ]
    assert talk.job(lines), talk.lost
    talk.core.drain()
    executed = [line.decode() for line in talk.executed if line not in QUESTIONS]
    assert executed == lines  # once and in order
    filament_mm = sum(talk.core.machine.planner.executed[6::9])
    assert filament_mm == pytest.approx(sum(0.02 + i % 7 * 0.01 for i in range(count)), abs=1e-6)
    assert talk.core.wire is not None
    assert talk.core.wire.damaged > count / 200  # of an ok's 3 bytes, and of a line's 30
    return talk


@pytest.mark.parametrize("firmware", ["marlin", "prusa", "klipper"])
@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_byte_in_200_loses_nothing_and_prints_nothing_twice(
    firmware: str, seed: int
) -> None:
    _through_a_damaged_wire(firmware, seed, count=300)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("firmware", ["marlin", "prusa", "klipper"])
@pytest.mark.parametrize(("window", "by_moves"), [(1, False), (1, True), (4, True)])
def test_a_damaged_byte_in_200_on_200_wires(firmware: str, window: int, by_moves: bool) -> None:
    if firmware == "klipper":
        window = 1  # as it is asked its questions
    for seed in range(200):
        _through_a_damaged_wire(firmware, seed, count=1000, window=window, by_moves=by_moves)


@settings(max_examples=60)
@given(
    chunks=st.lists(
        st.one_of(
            st.binary(max_size=40),
            st.sampled_from(
                [b"ok\n", b"Resend: 3\n", b"rs 2\n", b"start\n", b"wait\n", b"Error:x\n", b"!! a\n"]
            ),
        ),
        max_size=30,
    ),
    window=st.sampled_from([1, 4]),
)
def test_any_bytes_to_the_host_make_events(chunks: list[bytes], window: int) -> None:
    link = Link(window=window)
    link.hello(0.0)
    now_s = 0.0
    for chunk in chunks:
        now_s += 0.05
        events = link.receive(chunk, now_s) + link.tick(now_s)
        assert all(type(event).__module__ == ev.__name__ for event in events)
        link.take_output()
        if link.ready:
            link.send("G1 X1", now_s)
        assert 0 <= link.last_acked <= link.last_sent


@settings(max_examples=60)
@example(chunks=[b"AMREPAIR_TOUCH"], firmware="klipper")
@given(
    chunks=st.lists(st.binary(max_size=60), max_size=20),
    firmware=st.sampled_from(["marlin", "prusa", "klipper", "reprap"]),
)
def test_any_bytes_to_the_firmware_make_answers(chunks: list[bytes], firmware: str) -> None:
    talk = Conversation(firmware=firmware)
    for chunk in chunks:
        talk.core.feed(chunk + b"\n", 0.0)
        talk.core.run()
        talk.core.take_output()
