"""The commands `amrepair loop` and `batch`, as far as they are wiring: how they end."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from amrepair.cli import running
from amrepair.cli.app import app
from amrepair.cli.live import NoView
from amrepair.errors import AmrepairError, ScannerError
from amrepair.loop import Tape
from amrepair.repair import Stopwatch
from gcode.cli import console


@pytest.fixture(params=[signal.SIGTERM, signal.SIGHUP])
def number(request: pytest.FixtureRequest) -> Iterator[signal.Signals]:
    """A signal that ends a program, whatever these tests were started under (nohup)."""
    before = signal.signal(request.param, signal.SIG_DFL)
    yield request.param
    signal.signal(request.param, before)


def test_a_loop_that_is_told_to_end_takes_its_safe_exits(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """regression: it was killed on the spot, without a word, where no fleet supervised it."""

    def printed(*_: Any, **__: Any) -> None:
        signal.raise_signal(number)
        pytest.fail("it goes on")

    setting = SimpleNamespace(approve="auto", title="a job", scanner="probe")
    monkeypatch.setattr(running, "gone_on_with", lambda *_: SimpleNamespace(setting=setting))
    monkeypatch.setattr(running, "_printed", printed)
    monkeypatch.setattr("sys.argv", ["amrepair", "loop", "--resume", "run"])
    with pytest.raises(SystemExit) as end:
        console.run(app, "amrepair", (AmrepairError,))
    assert end.value.code == 130
    assert capsys.readouterr().err == "amrepair: interrupted\n"
    assert signal.getsignal(number) is signal.SIG_DFL


def test_an_interrupted_batch_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """regression: it said "interrupted" alone."""

    def judging(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("amrepair.batch.run_batch", judging)
    words = ["batch", "detect", str(tmp_path), "--template", "part.stl", "--out", "out/batch"]
    run = CliRunner().invoke(app, words)
    assert run.exit_code == 130
    assert "kept in out/batch; the same command goes on with it." in " ".join(run.stderr.split())


@pytest.mark.parametrize("printed", [True, False])
def test_a_run_that_a_scanner_ends_says_how_to_go_on(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    printed: bool,
) -> None:
    """regression: it said what was wrong alone, as if the print were lost."""

    def silent(*_: Any, **__: Any) -> None:
        raise ScannerError("scans: no usable scan")

    folder = tmp_path / "my run"
    folder.mkdir()
    if printed:
        (folder / "run.jsonl").write_text('{"event": "send"}\n')
    monkeypatch.setattr(running, "_machine", lambda _: SimpleNamespace(close=lambda: None))
    monkeypatch.setattr(running, "print_run", silent)
    begun: Any = SimpleNamespace(folder=SimpleNamespace(path=folder), tape=Tape())
    how: dict[str, Any] = {"view": False, "going_on": False, "pose": False, "desk": None}
    with pytest.raises(ScannerError):
        running._printed(begun, NoView(), Stopwatch(), console.Bars(), **how)
    told = f"When that is mended, go on with: amrepair loop --resume '{folder}'\n"
    assert capsys.readouterr().err == (told if printed else "")


def test_an_interrupt_in_compiled_code_says_how_to_go_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """regression: numba makes a SystemError of it, which ended in a traceback and exit code 1."""
    closed: list[bool] = []

    def judging(*_: Any, **__: Any) -> None:
        inner = SystemError("_numba_unpickle returned a result with an exception set")
        inner.__cause__ = KeyboardInterrupt()
        raise SystemError("CPUDispatcher returned a result with an exception set") from inner

    machine = SimpleNamespace(close=lambda: closed.append(True))
    monkeypatch.setattr(running, "_machine", lambda _: machine)
    monkeypatch.setattr(running, "print_run", judging)
    begun: Any = SimpleNamespace(folder=SimpleNamespace(path="out/loop"), tape=Tape())
    how: dict[str, Any] = {"view": False, "going_on": False, "pose": False, "desk": None}
    with pytest.raises(KeyboardInterrupt):
        running._printed(begun, NoView(), Stopwatch(), console.Bars(), **how)
    assert "go on with: amrepair loop --resume out/loop" in capsys.readouterr().err
    assert closed
