"""Commands as people and scripts call them: in this process, or each in one of its own.

Such a process is forked from one where the libraries are loaded already: loading them anew takes
three seconds of processor time a call, which is longer than what most calls do.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import json
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# Reads a call a line, and answers with how its process ended; loads first what argv[1] says.
SERVER = """
import gc, importlib, json, os, signal, sys, warnings
from os import fork  # which is gone where the system is to be like Windows
from signal import alarm
exec(sys.argv[1])
gc.freeze()
for line in sys.stdin:
    argv, environ, out, err, seconds, quiet = json.loads(line)
    child = fork()
    if not child:
        alarm(seconds)
        for path, number in ((os.devnull, 0), (out, 1), (err, 2)):
            os.dup2(os.open(path, os.O_RDWR), number)
        os.environ.clear()
        os.environ.update(environ)
        if quiet:
            warnings.simplefilter("ignore")
        sys.argv = argv
        importlib.import_module(argv[0] + ".cli").main()
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


LOADED = """
for name in ("amrepair.cli.app", "gcode.cli.app", "amrepair.repair", "amrepair.simulate"):
    importlib.import_module(name)
"""
LIKE_WINDOWS = "from tests import like_windows; like_windows.prepare()"


@functools.cache
def _server(first: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SERVER, first],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


def call(
    *words: str | Path,
    program: str = "amrepair",
    seconds: int = 280,
    quiet: bool = False,
    windows: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Run `amrepair` or `gcode` from the repository's root.

    One call at a time. A process that runs for more than so many seconds is killed: exit code −14.

    Parameters
    ----------
    quiet
        Without Python's warnings.
    windows
        Without what Python lacks on Windows (`tests/like_windows.py`).
    """
    server = _server(LIKE_WINDOWS if windows else LOADED)
    argv = [program, *map(str, words)]
    assert server.stdin is not None
    assert server.stdout is not None
    with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
        asked = [argv, dict(os.environ), out.name, err.name, seconds, quiet]
        server.stdin.write(json.dumps(asked) + "\n")
        server.stdin.flush()
        code = int(server.stdout.readline())
        return subprocess.CompletedProcess(argv, code, out.read(), err.read())


def here(*words: str | Path, program: str = "amrepair") -> subprocess.CompletedProcess[str]:
    """Run `amrepair` or `gcode` in this process: where what is loaded, and how, does not matter."""
    main = importlib.import_module(f"{program}.cli").main
    return ended([program, *map(str, words)], main)


def ended(argv: list[str], main: Callable[[], object]) -> subprocess.CompletedProcess[str]:
    """How `main` ends in this process, called by a command line with the program's name first."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        pytest.MonkeyPatch.context() as patch,
        warnings.catch_warnings(action="ignore"),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        patch.setattr(sys, "argv", argv)
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    return subprocess.CompletedProcess(argv, code, out.getvalue(), err.getvalue())
