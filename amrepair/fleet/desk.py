"""Where a printer's process and whoever supervises it leave each other notes: files in a folder.

`status.json` says what the process does and asks, `answer.json` answers the question of its number,
`judges.json` says which shared processes there are to detect.
Files outlive either side, and neither side waits for the other but where it asks.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from amrepair.errors import InputError
from gcode.whole import put_in_place

STATUS, ANSWER = "status.json", "answer.json"
# Where scans may be sent to be judged, and how long to wait: the supervisor's word.
JUDGES = "judges.json"
DESK_POLL_S = 0.2
# So often at most is progress written: a page is looked at once a second.
TELL_S = 0.5


class Desk:
    """The process's side.

    Parameters
    ----------
    folder
        Is made where it is not there.
    parent
        Who is asked: whether that is still there.
    """

    def __init__(
        self,
        folder: Path,
        *,
        sleep: Callable[[float], None] = time.sleep,
        parent: Callable[[], int] = os.getppid,
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self._sleep, self._parent = folder, sleep, parent
        self._asker = parent()
        self._said: dict[str, Any] = {"pid": os.getpid(), "stage": "starting", "question": None}
        self._number = int(1000 * time.time())  # never one of an earlier process
        self._told_s = 0.0
        (folder / ANSWER).unlink(missing_ok=True)
        self._tell()

    def progress(self, stage: str, done: float, total: float) -> None:
        """Say how far it is."""
        new_stage = stage != self._said["stage"]
        self._said |= {"stage": stage, "done": done, "total": total}
        if new_stage or abs(time.time() - self._told_s) >= TELL_S:  # a clock may be set back
            self._tell()

    def ask(self, question: str, lines: Sequence[str]) -> bool:
        """Ask, and wait for the answer.

        Raises
        ------
        InputError
            If whoever started this process has gone: nobody can answer.
        """
        self._number += 1
        asked = {"number": self._number, "text": question, "lines": list(lines)}
        self._said["question"] = {**asked, "since_s": time.time()}
        self._tell()
        try:
            while True:
                answer = read_note(self.folder / ANSWER)
                if answer is not None and answer.get("number") == self._number:
                    return bool(answer.get("yes"))
                if self._parent() != self._asker:
                    raise InputError(
                        "nobody answers: the fleet's supervisor has ended; start 'amrepair fleet' "
                        "again, it goes on with this run"
                    )
                self._sleep(DESK_POLL_S)
        finally:
            self._said["question"] = None
            self._tell()

    def judged(self, why: str) -> None:
        """Count a scan that was judged: by shared processes, or, with a reason, by this one."""
        counts = dict(self._said.get("judged") or {"shared": 0, "itself": 0})
        counts["itself" if why else "shared"] += 1
        self._said["judged"] = counts | {"why": why}
        self._tell()

    def _tell(self) -> None:
        self._told_s = time.time()
        write_note(self.folder / STATUS, {**self._said, "time_s": self._told_s})


def answer(folder: Path, number: int, *, yes: bool) -> None:
    """The other side's word on a question."""
    write_note(folder / ANSWER, {"number": number, "yes": yes})


def write_note(path: Path, said: dict[str, Any]) -> None:
    """Whole or not at all."""
    with put_in_place(path) as draft:
        draft.write_text(json.dumps(said), encoding="utf-8")


def read_note(path: Path) -> dict[str, Any] | None:
    """What a note says; None where there is none."""
    try:
        said = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return said if isinstance(said, dict) else None
