"""Commands as people and scripts call them, each in a process of its own.

That process is forked from one where the libraries are loaded already: loading them anew takes
three seconds of processor time a call, which is longer than what most calls do.
"""

from __future__ import annotations

import functools
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Reads a call a line, and answers with how its process ended.
SERVER = """
import gc, importlib, json, os, signal, sys, warnings
for name in ("amrepair.cli.app", "gcode.cli.app", "amrepair.repair", "amrepair.simulate"):
    importlib.import_module(name)
gc.freeze()
for line in sys.stdin:
    argv, environ, out, err, seconds, quiet = json.loads(line)
    child = os.fork()
    if not child:
        signal.alarm(seconds)
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


@functools.cache
def _server() -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )


def call(
    *words: str | Path, program: str = "amrepair", seconds: int = 280, quiet: bool = False
) -> subprocess.CompletedProcess[str]:
    """Run `amrepair` or `gcode` from the repository's root; `quiet`: without Python's warnings.

    One call at a time. A process that runs for more than so many seconds is killed: exit code −14.
    """
    server, argv = _server(), [program, *map(str, words)]
    assert server.stdin is not None
    assert server.stdout is not None
    with tempfile.NamedTemporaryFile("r") as out, tempfile.NamedTemporaryFile("r") as err:
        asked = [argv, dict(os.environ), out.name, err.name, seconds, quiet]
        server.stdin.write(json.dumps(asked) + "\n")
        server.stdin.flush()
        code = int(server.stdout.readline())
        return subprocess.CompletedProcess(argv, code, out.read(), err.read())
