"""What every command of both programs shares: bars, errors as one sentence, JSON, whole files."""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from gcode.errors import InputError
from gcode.profiles.names import Kind, list_profiles

NOT_WITHIN_TOLERANCE = 3
INTERRUPTED = 130
COUNTED = 2  # stages of fewer steps are told in per cent alone
SAY_EVERY_S = 10.0  # how often a log without a terminal hears of progress

errors = Console(stderr=True, highlight=False, soft_wrap=True)
out = Console(highlight=False, soft_wrap=True)


class Bars:
    """A bar for every stage on a terminal; a line now and then where there is none."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._tasks: dict[str, TaskID] = {}
        self._said_s = clock()
        self._bars = Progress(
            TextColumn("{task.description:<24}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TextColumn("{task.fields[count]}"),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=errors,
        )

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` of `stage` is finished."""
        if not errors.is_terminal:
            now_s = self._clock()
            if now_s - self._said_s >= SAY_EVERY_S:
                self._said_s = now_s
                errors.print(f"{stage}: {100 * done / max(total, 1e-9):.0f} %")
            return
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=total, count="")
        count = f"{done:.0f}/{total:.0f}" if total >= COUNTED else ""
        self._bars.update(self._tasks[stage], completed=done, total=total, count=count)

    @contextmanager
    def shown(self) -> Iterator[Bars]:
        """Draw while something runs."""
        if errors.is_terminal:
            with self._bars:
                yield self
        else:
            yield self

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Take the bars away while somebody is asked: they would be drawn over the answer."""
        drawn = self._bars.live.is_started
        if drawn:
            self._bars.stop()
        try:
            yield
        finally:
            if drawn:
                self._bars.start()


def examples(*lines: str) -> str:
    """The end of a command's help: lines that can be typed as they are."""
    return "\n\n".join(["Examples:", *(f"$ {line}" for line in lines)])


def profile_ids(kind: Kind) -> Callable[[str], list[str]]:
    """What a shell offers after `--printer` and the like."""

    def matching(incomplete: str) -> list[str]:
        return [name for name in list_profiles(kind) if name.startswith(incomplete)]

    return matching


def show_json(result: Mapping[str, Any]) -> None:
    """One object on standard output, nothing else there."""
    sys.stdout.write(json.dumps(result, indent=2, ensure_ascii=False) + "\n")


def writable(path: Path) -> None:
    """Refuse an output that cannot be written, before any work is done.

    Raises
    ------
    InputError
        Naming it.
    """
    folder = path.parent
    if path.is_dir():
        why = "it is a folder; name a file in it"
    elif not folder.is_dir():
        why = f"there is no folder {folder}; make it first"
    elif not os.access(folder, os.W_OK):
        why = f"no permission to write in {folder.resolve()}; choose another folder"
    else:
        return
    raise InputError(f"{path} cannot be written: {why}.")


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name, then put it in place.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    writable(path)
    temporary = path.with_name(f".{os.getpid()}-{path.name}")
    try:
        write(temporary)
        temporary.replace(path)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}).") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def signals_end_it() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end what is under way as an interrupt does: by its safe exits.

    One that is ignored (`nohup`) stays so.
    """

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    taken = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.SIG_DFL
    ]
    for number in taken:
        signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)


def run(app: typer.Typer, name: str, known: tuple[type[Exception], ...]) -> None:
    """Run an application; a known error becomes one sentence and its exit code."""
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    sys.exit(_exit_code(app, name, known))  # no error is alive any more, nor what it held


def _exit_code(app: typer.Typer, name: str, known: tuple[type[Exception], ...]) -> int:
    try:
        app(prog_name=name)
    except SystemExit as end:
        if end.code == INTERRUPTED:  # typer ends so on Ctrl+C, without a word
            errors.print(f"{name}: interrupted")
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except known as error:
        style = "bold red" if errors.is_terminal else None
        errors.print(f"{name}: {error}", style=style, markup=False)
        return int(getattr(error, "exit_code", InputError.exit_code))
    except OSError as error:
        errors.print(f"{name}: {in_words(error)}", markup=False)
        return InputError.exit_code
    return 0


def in_words(error: OSError) -> str:
    """What the system refused, and where; a full disk above all."""
    where = f"{error.filename}: " if error.filename else ""
    hint = {
        errno.ENOSPC: "; free some, or write elsewhere",
        errno.EFBIG: "; the limit on the size of files is too low",
        errno.EACCES: "; choose a place that you may write to",
        errno.EROFS: "; choose a place that can be written to",
    }.get(error.errno or 0, "")
    return f"{where}{error.strerror or error}{hint}."
