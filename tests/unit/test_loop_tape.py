"""The tape: whole lines only, in order, and a question that ended a run is asked anew."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from amrepair.errors import InputError, LoopError
from amrepair.loop import pick_up as picking
from amrepair.loop.tape import TAPE, Sent, Tape, TapeEndsError, read_events
from gcode.progress import Progress


def test_what_was_written_comes_back_in_order(tmp_path: Path) -> None:
    tape = Tape(tmp_path, clock=lambda: 7.0)
    tape.write("send", kind="job", first=0, end=9)
    tape.write("sent", ok=True)
    assert tape.live
    tape.close()
    again = Tape(tmp_path)
    assert not again.live
    assert again.next("send") == {
        "event": "send", "time_s": 7.0, "kind": "job", "first": 0, "end": 9,
    }  # fmt: skip
    with pytest.raises(LoopError, match="has 'sent' where this run comes to 'look'"):
        again.next("look")
    assert again.next("sent") is not None
    assert again.next("look") is None


@pytest.mark.parametrize("cut", [1, 5, 30])
def test_a_line_that_a_kill_cut_short_was_never_begun(tmp_path: Path, cut: int) -> None:
    tape = Tape(tmp_path)
    tape.write("send", kind="job")
    tape.write("send", kind="park")
    tape.close()
    path = tmp_path / TAPE
    path.write_bytes(path.read_bytes()[:-cut])
    assert [event["kind"] for event in read_events(tmp_path)] == ["job"]
    after = Tape(tmp_path)
    after.write("send", kind="park")
    after.close()
    assert [event["kind"] for event in read_events(tmp_path)] == ["job", "park"]


def test_a_replay_ends_with_the_tape_and_writes_nothing(tmp_path: Path) -> None:
    recorded = Tape(tmp_path)
    recorded.write("send", kind="job")
    recorded.write("look", look=1, stop="layer-003")
    tape = Tape(tmp_path, only_read=True)
    assert tape.next_stop() == "layer-003"
    tape.next("look")
    tape.write("send", kind="park")
    assert tape.next_stop() is None
    with pytest.raises(TapeEndsError):
        tape.next("look")
    assert len(read_events(tmp_path)) == 2


def test_a_run_that_a_question_ended_looks_anew(tmp_path: Path) -> None:
    tape = Tape(tmp_path)
    for event in ("send", "sent", "look"):
        tape.write(event, look=1)
    tape.write("end", stopped="pause and ask: warp")
    tape.close()
    again = Tape(tmp_path)
    again.reopen()
    assert [again.next(event) is not None for event in ("send", "sent", "look")] == [
        True, True, False,
    ]  # fmt: skip
    again.write("look", look=1)
    assert [event["event"] for event in read_events(tmp_path)] == ["send", "sent", "look"]


def test_a_run_that_is_over_is_over(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no record"):
        Tape(tmp_path).reopen()
    tape = Tape(tmp_path)
    tape.write("end", stopped="")
    tape.close()
    for _ in range(2):  # nobody keeps it
        with pytest.raises(InputError, match="printed to its end"):
            Tape(tmp_path).reopen()


def test_a_file_of_somebody_elses_is_refused(tmp_path: Path) -> None:
    (tmp_path / TAPE).write_text("[1, 2]\nnonsense\n")
    with pytest.raises(InputError, match="no record"):
        Tape(tmp_path)


def test_without_a_path_nothing_is_remembered() -> None:
    tape = Tape()
    tape.write("send", kind="job")
    assert tape.live
    assert tape.next("send") is None


@pytest.mark.parametrize(
    ("sent", "told"),
    [
        # of the last 100 lines 40 are left
        ([("a", True), ("b", False)], [(60.0, 100.0), (100.0, 100.0)]),
        # regression: lines of a part that was printed before were told as those of the next one
        ([("a", True), ("b", True)], []),
        ([("b", False), ("a", False)], []),
    ],
)
def test_a_resumed_run_tells_of_the_part_that_is_under_way(
    monkeypatch: pytest.MonkeyPatch, sent: list[tuple[str, bool]], told: list[tuple[float, float]]
) -> None:
    def resumed(*_: object, progress: Progress, **__: object) -> None:
        for done in (0.0, 40.0):
            progress("printing", done, 40.0)

    monkeypatch.setattr(picking, "resume", resumed)
    journal: Any = SimpleNamespace(latest=lambda: SimpleNamespace(program_sha256="b"))
    serial: Any = SimpleNamespace(port="/dev/ttyACM0")
    parts: list[Any] = []
    for name, done in sent:
        checked: Any = SimpleNamespace(program=SimpleNamespace(sha256=name))
        parts.append(Sent("job", checked, 300, 400, done))
    heard: list[tuple[float, float]] = []
    picking._by_journal(
        serial, journal, parts, lambda _, done, total: heard.append((done, total)),
        release_c=40.0, pose_confirmed=False,
    )  # fmt: skip
    assert heard == told


def test_two_commands_are_never_at_one_run(tmp_path: Path) -> None:
    """Regression: both wrote into one record, and the later took the earlier one's job away."""
    first = Tape(tmp_path)
    first.hold(anew=True)
    first.write("send", kind="job")
    for other in (lambda: Tape(tmp_path).hold(anew=True), lambda: Tape(tmp_path).reopen()):
        with pytest.raises(InputError, match="another command is at the run in"):
            other()
    assert [e["event"] for e in read_events(tmp_path)] == ["send"]
    first.close()
    again = Tape(tmp_path)
    again.reopen()
    assert again.next("send") is not None
    again.close()
    anew = Tape(tmp_path)
    anew.hold(anew=True)
    assert anew.live
    assert read_events(tmp_path) == []
    anew.close()


def test_a_disk_that_takes_half_a_line_has_not_taken_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a nearly full disk took a part without a word, and what came after was lost."""
    tape, room, write = Tape(tmp_path), [10], os.write
    tape.write("send", kind="job")

    def nearly_full(fd: int, data: bytes) -> int:
        if not room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(fd, data[: room.pop()])

    with monkeypatch.context() as patch:
        patch.setattr("os.write", nearly_full)
        with pytest.raises(LoopError, match=r"run\.jsonl cannot be written \(No space left"):
            tape.write("sent")
    assert [e["event"] for e in read_events(tmp_path)] == ["send"]
    tape.write("sent")
    assert [e["event"] for e in read_events(tmp_path)] == ["send", "sent"]
    tape.close()
