"""Files are there whole or not at all, whatever becomes of who writes them."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from gcode import whole
from gcode.whole import left_behind, put_in_place, write_bytes


def test_a_failed_write_leaves_what_was_there_and_no_more(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("before")

    def fail() -> None:
        with put_in_place(path) as draft:
            draft.write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["a.json"]  # noqa: PTH208
    with put_in_place(path) as draft:
        assert draft.suffix == ".json"  # writers choose their format by it
        draft.write_text("after")
        assert path.read_text() == "before"
    assert path.read_text() == "after"


@pytest.mark.parametrize("durable", [False, True])
def test_durable_is_on_the_disk_before_it_is_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, durable: bool
) -> None:
    path, synced = tmp_path / "new" / "a", []

    def fsync(descriptor: int) -> None:
        synced.append((os.readlink(f"/proc/self/fd/{descriptor}"), path.exists()))  # noqa: PTH115

    monkeypatch.setattr(whole.os, "fsync", fsync)
    write_bytes(path, b"1", durable=durable)
    assert path.read_bytes() == b"1"
    if not durable:
        assert not synced
        return
    (file, before), (folder, after) = synced
    assert (before, after) == (False, True)
    assert Path(file).parent == Path(folder) == path.parent


def test_a_full_disk_leaves_nothing_half(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fsync(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(whole.os, "fsync", fsync)
    with pytest.raises(OSError, match="No space left"):
        write_bytes(tmp_path / "a", b"1", durable=True)
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_was_writing_is_found(tmp_path: Path) -> None:
    text = (
        "import os, sys; from pathlib import Path; from gcode.whole import put_in_place\n"
        "with put_in_place(Path(sys.argv[1])) as draft:\n"
        "    draft.write_text('half'); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run(
        [sys.executable, "-c", text, str(tmp_path / "a")],
        check=False, cwd=Path(__file__).parents[2],
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL
    (tmp_path / ".hidden").touch()
    (tmp_path / ".2-b").touch()
    assert [path.read_text() for path in left_behind(tmp_path)] == ["half"]


def test_threads_write_one_file_each_in_its_own_way(tmp_path: Path) -> None:
    path, begun = tmp_path / "a", threading.Barrier(2)

    def write(word: str) -> None:
        with put_in_place(path) as draft:
            draft.write_text(word)
            begun.wait(30)

    threads = [threading.Thread(target=write, args=(word,)) for word in ("one", "other")]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert path.read_text() in ("one", "other")
    assert os.listdir(tmp_path) == ["a"]  # noqa: PTH208
