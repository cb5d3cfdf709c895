"""What every command of both programs shares: bars, errors as one sentence, JSON, whole files."""

from __future__ import annotations

import errno
import gc
import json
import logging
import os
import stat
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from gcode.errors import InputError
from gcode.process import INTERRUPTED, interrupted, signals_end_it
from gcode.profiles.names import Kind, list_profiles
from gcode.whole import put_in_place

NOT_WITHIN_TOLERANCE = 3
READER_GONE = 141  # as of a program that SIGPIPE ended: 128 + 13
RATE_DIGITS = 10.0  # from here on a rate is told in whole numbers
COUNTED = 2  # stages of fewer steps are told in per cent alone


# Typer's own, by way of a public name: it has moved between versions.
_UsageError: type[Exception] = typer.BadParameter.__mro__[2]


class ReaderGoneError(Exception):
    """Whoever read what we print has gone (`… | head -1`): nothing failed, nobody listens."""


class _Told(Console):
    """A console that leaves the end of a program to `run`."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        raise ReaderGoneError


# What is told holds names of files and words of firmwares: brackets in it are no markup, and a word
# between colons is no picture.
errors = _Told(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
out = _Told(highlight=False, soft_wrap=True, markup=False, emoji=False)
Command = TypeVar("Command", bound=Callable[..., Any])
_commands: dict[str, list[tuple[str, str, Callable[..., Any]]]] = {}
_json_shown: list[bool] = []  # by the command under way; a failure after it is not told twice
_circles_left: list[bool] = []
_older: dict[Path, tuple[int, int]] = {}  # outputs of the command that are there from before


class _TimeLeft(TimeRemainingColumn):
    """Time left; time spent where nobody can tell how much is left."""

    def render(self, task: Task) -> Text:
        if task.total is not None:
            return super().render(task)
        spent_s = int(task.elapsed or 0.0)
        return Text(f"for {spent_s // 60}:{spent_s % 60:02d}", style="progress.remaining")


class _Rate(ProgressColumn):
    """How many a second, where they are counted."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not task.fields["count"] or not speed:
            return Text("")
        return Text(f"{speed:.1f}/s" if speed < RATE_DIGITS else f"{speed:.0f}/s")


class Bars:
    """A bar for every stage on a terminal; nothing where there is none."""

    def __init__(self) -> None:
        self._tasks: dict[str, TaskID] = {}
        self._bars = Progress(
            TextColumn("{task.description:<24}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[share]:>5}"),
            TextColumn("{task.fields[count]}"),
            _Rate(),
            _TimeLeft(elapsed_when_finished=True),
            console=errors,
        )

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` of `stage` is finished."""
        if not errors.is_terminal:
            return
        uncounted = total < COUNTED
        known = None if uncounted and done <= 0 else total  # a bar that swings until more is known
        if stage not in self._tasks:
            self._tasks[stage] = self._bars.add_task(stage, total=known, count="", share="")
        self._bars.update(
            self._tasks[stage],
            completed=done,
            total=known,
            count="" if uncounted else f"{done:.0f}/{total:.0f}",
            share="" if known is None else f"{100 * done / max(total, 1e-9):.0f} %",
        )

    @contextmanager
    def shown(self) -> Iterator[Bars]:
        """Draw while something runs."""
        if errors.is_terminal:
            with self._bars:
                yield self
        else:
            yield self

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """A bar that swings while something runs that does not tell how far it is."""
        self(name, 0.0, 1.0)
        yield
        self(name, 1.0, 1.0)

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


@contextmanager
def starting() -> Iterator[None]:
    """Say so while libraries load: from a cold disk that takes seconds.

    An interrupt that one of them swallows (trimesh) comes after it.
    """
    with errors.status("loading") if errors.is_terminal else nullcontext():
        yield
    if interrupted():
        raise KeyboardInterrupt


def application(name: str, about: str, package: ModuleType) -> typer.Typer:
    """A program with `--version`, which tells its help where nothing else is said."""
    app = typer.Typer(name=name, help=about, no_args_is_help=True, pretty_exceptions_enable=False)

    def told(asked: bool) -> bool:
        if asked:
            out.print(f"{name} {package.__version__}")
            raise typer.Exit
        return asked

    said: bool = typer.Option(
        False, "--version", callback=told, is_eager=True, help="Show the version."
    )

    @app.callback()
    def root(version: bool = said) -> None:
        """Options before a command."""

    return app


def examples(*lines: str) -> str:
    """The end of a command's help: lines that can be typed as they are."""
    return "\n\n".join(["Examples:", *(f"$ {line}" for line in lines)])


def command(name: str, *lines: str) -> Callable[[Command], Command]:
    """A function as the command of that name, with examples at the end of its help; see `add`."""

    def kept(function: Command) -> Command:
        of_module = _commands.setdefault(function.__module__, [])
        of_module.append((name, examples(*lines), function))
        return function

    return kept


def add(app: typer.Typer, *modules: ModuleType) -> None:
    """Add the commands of some modules, in their order."""
    for module in modules:
        for name, epilog, function in _commands[module.__name__]:
            app.command(name, epilog=epilog)(function)


def profile_ids(kind: Kind) -> Callable[[str], list[str]]:
    """What a shell offers after `--printer` and the like."""

    def matching(incomplete: str) -> list[str]:
        return [name for name in list_profiles(kind) if name.startswith(incomplete)]

    return matching


def show_json(result: Mapping[str, Any]) -> None:
    """One object on standard output, nothing else there."""
    _json_shown.append(True)
    try:
        sys.stdout.write(json.dumps(result, indent=2, ensure_ascii=False) + "\n")
        sys.stdout.flush()
    except BrokenPipeError as error:
        raise ReaderGoneError from error


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
        if path.is_file():
            _older.setdefault(path, _mark(path))
        return
    raise InputError(f"{path} cannot be written: {why}.")


def _mark(path: Path) -> tuple[int, int]:
    """What differs once a file was written anew, or is gone."""
    try:
        now = path.stat()
    except OSError:
        return 0, 0
    return now.st_ino, now.st_mtime_ns


def _left_as_they_were() -> str:
    """What is to be told of outputs that are there from before, and may be taken for this one's."""
    left = [str(path) for path, mark in _older.items() if _mark(path) == mark]
    if not left:
        return ""
    ones = "is an older one" if len(left) == 1 else "are older ones"
    return f"{' and '.join(left)} {ones}, left as before"


def write_text(path: Path, text: str) -> None:
    """Write a text, as `write_whole` does."""
    write_whole(path, lambda draft: draft.write_text(text, encoding="utf-8"))


def write_whole(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file under another name, then put it in place.

    Raises
    ------
    InputError
        If it cannot be written.
    """
    writable(path)
    try:
        with put_in_place(path) as draft:
            write(draft)
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror}).") from error


@contextmanager
def interrupts_as_such() -> Iterator[None]:
    """Within it an interrupt is one wherever it comes: compiled code makes an error of it."""
    try:
        yield
    except SystemError as error:
        cause = error.__cause__
        while isinstance(cause, SystemError):
            cause = cause.__cause__
        if isinstance(cause, KeyboardInterrupt):
            raise cause from None
        raise


def run(app: typer.Typer, name: str, known: tuple[type[Exception], ...]) -> None:
    """Run an application; a known error becomes one sentence and its exit code.

    With `--json` the sentence is one object on standard output, too: `error` and `exit_code`.
    """
    for stream in ("stdout", "stderr"):  # closed by the shell (`>&-`): Python has None there
        if getattr(sys, stream) is None:
            setattr(sys, stream, Path(os.devnull).open("w"))  # noqa: SIM115  until the end
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    for library in ("trimesh", "tifffile"):  # they log tracebacks; what is wrong we tell once
        logging.getLogger(library).setLevel(logging.CRITICAL)
    with signals_end_it():
        code = _exit_code(app, name, known)
    if _circles_left:
        gc.freeze()
    sys.exit(code)  # no error is alive any more, nor what it held


def leave_circles() -> None:
    """Have Python end without a look for objects that hold each other.

    It would look twice through all that is loaded, for 0.3 s after a command has done its work.
    What holds memory of C++ libraries must be in no such circle: they would complain.
    """
    _circles_left.append(True)


def _exit_code(app: typer.Typer, name: str, known: tuple[type[Exception], ...]) -> int:
    _json_shown.clear()
    _older.clear()
    piped = _is_pipe()
    try:
        code = _ended(app, name, known)
        sys.stdout.flush()
    except (ReaderGoneError, BrokenPipeError):
        code = READER_GONE
    if code == READER_GONE or (piped and not _is_pipe()):  # help sends the rest nowhere by itself
        _send_nowhere()
        return READER_GONE
    return code


def _ended(app: typer.Typer, name: str, known: tuple[type[Exception], ...]) -> int:
    try:
        code = app(prog_name=name, standalone_mode=False)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except typer.Abort:
        code = INTERRUPTED
    except _UsageError as error:
        return _misused(error)
    except known as error:
        style = "bold red" if errors.is_terminal else None
        return _failed(f"{name}: {error}", int(getattr(error, "exit_code", 2)), style)
    except BrokenPipeError:
        raise
    except OSError as error:
        return _failed(f"{name}: {in_words(error)}", InputError.exit_code)
    except Exception:
        # of an interrupt in compiled code, or while a library loads that swallows it (trimesh)
        if not interrupted():
            raise
        code = INTERRUPTED
    if code == INTERRUPTED:  # typer ends so on Ctrl+C, without a word
        return _failed(f"{name}: interrupted", code)
    if left := _left_as_they_were():
        errors.print(f"{left}.")
    return code if isinstance(code, int) else 0


def _misused(error: Exception) -> int:
    """Words that no command understands, in one sentence; help where a group was called alone."""
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        error.show()  # type: ignore[attr-defined]
        return InputError.exit_code
    said = " ".join(error.format_message().split()).rstrip(".")  # type: ignore[attr-defined]
    where = context.command_path if context is not None else ""
    hint = f"; '{where} --help' shows what it takes" if where else ""
    return _failed(f"{where}: {said[:1].lower()}{said[1:]}{hint}.", InputError.exit_code)


def _failed(sentence: str, code: int, style: str | None = None) -> int:
    """Tell of a failure once for people and, where it was asked for, once for programs."""
    if left := _left_as_they_were():
        sentence = f"{sentence.rstrip('.')}; {left}."
    errors.print(sentence, style=style)
    if "--json" in sys.argv[1:] and not _json_shown:
        show_json({"error": sentence, "exit_code": code})
    return code


def _is_pipe() -> bool:
    try:
        return stat.S_ISFIFO(os.fstat(sys.stdout.fileno()).st_mode)
    except (OSError, ValueError, AttributeError):  # no file, closed, or none at all
        return False


def _send_nowhere() -> None:
    """What is still to be written out has no reader; the end of Python must not trip over it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


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
