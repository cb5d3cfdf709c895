"""One sender a printer: whoever comes second is refused, and nobody leaves files behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gcode.errors import LinkError, PortBusyError
from gcode.hosts import lock as lock_module
from gcode.hosts.journal import default_path
from gcode.hosts.lock import PortLock
from gcode.locks import try_lock

PORT = "/dev/ttyTEST"


def test_a_lock_given_back_leaves_no_file(tmp_path: Path) -> None:
    # regression: every run of the tests left hundreds in the temporary folder
    lock = PortLock(PORT, folder=tmp_path)
    lock.acquire()
    assert len(list(tmp_path.iterdir())) == 1
    lock.release()
    assert not list(tmp_path.iterdir())
    lock.release()  # harmless


def test_the_second_is_refused_and_its_refusal_changes_nothing(tmp_path: Path) -> None:
    first, second, third = (PortLock(PORT, folder=tmp_path) for _ in range(3))
    first.acquire()
    for late in (second, third):
        with pytest.raises(PortBusyError, match=f"process {os.getpid()}"):
            late.acquire()
        late.release()
    first.release()
    second.acquire()
    second.release()


@pytest.mark.parametrize("name", ["tty", "./tty", "link", "sub/../link"])
def test_a_printer_has_one_lock_by_whatever_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: a relative path was another printer, and two senders shared it."""
    (tmp_path / "sub").mkdir()
    (tmp_path / "tty").touch()
    (tmp_path / "link").symlink_to("tty")
    monkeypatch.chdir(tmp_path)
    first = PortLock(str(tmp_path / "tty"), folder=tmp_path / "sub")
    first.acquire()
    with pytest.raises(PortBusyError):
        PortLock(name, folder=tmp_path / "sub").acquire()
    first.release()
    assert default_path("tty") == default_path(str(tmp_path / "tty")) != default_path("link")


def test_who_opened_the_file_before_it_was_removed_does_not_share_the_printer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The race of removing lock files: a lock on a file without a name keeps nobody out."""
    first, second, third = (PortLock(PORT, folder=tmp_path) for _ in range(3))
    first.acquire()

    def late(fd: int) -> bool:
        monkeypatch.setattr(lock_module, "try_lock", try_lock)
        first.release()  # between the second's open and its lock
        third.acquire()
        return try_lock(fd)  # succeeds: nobody else has the removed file open

    monkeypatch.setattr(lock_module, "try_lock", late)
    with pytest.raises(PortBusyError):
        second.acquire()
    third.release()
    assert not list(tmp_path.iterdir())


def test_a_killed_holder_leaves_its_file_to_the_next(tmp_path: Path) -> None:
    code = (
        "import os, sys, pathlib\n"
        "from gcode.hosts.lock import PortLock\n"
        f"PortLock({PORT!r}, folder=pathlib.Path(sys.argv[1])).acquire()\n"
        "os.kill(os.getpid(), 9)\n"
    )
    root = str(Path(__file__).parent.parent.parent)
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], cwd=root, check=False)
    assert len(list(tmp_path.iterdir())) == 1
    lock = PortLock(PORT, folder=tmp_path)
    lock.acquire()
    lock.release()
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_opened_is_one_sentence(tmp_path: Path) -> None:
    lock = PortLock(PORT, folder=tmp_path / "missing")
    with pytest.raises(LinkError, match="cannot be used"):
        lock.acquire()
