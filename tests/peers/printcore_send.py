"""Prints a file with Printrun's printcore; runs in Printrun's environment.

Run: `python printcore_send.py PORT FILE`; ends with 0 when printcore says that it is done.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from printrun import gcoder
from printrun.printcore import printcore


def main() -> None:
    done, online = threading.Event(), threading.Event()
    threads: list[threading.Thread] = []

    def end() -> None:
        threads.append(threading.current_thread())
        done.set()

    core = printcore()
    core.onlinecb = online.set
    core.endcb = end
    core.connect(sys.argv[1], 115200)
    if not online.wait(20):
        sys.exit("printcore does not come online")
    core.startprint(gcoder.LightGCode(Path(sys.argv[2]).read_text().split("\n")))
    finished = done.wait(60)
    for thread in threads:  # it starts another as it ends, which disconnect() trips over
        thread.join(10)
    core.disconnect()
    if not finished:
        sys.exit("printcore does not finish")


if __name__ == "__main__":
    main()
