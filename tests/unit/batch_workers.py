"""Workers that judge nothing and may die; light, since each is a process of its own."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection

from amrepair.batch.options import Task, TaskOutcome, Work


def mortal(pipe: Connection, work: Work) -> None:
    """Dies of scans called bad."""
    pipe.send("ready")
    while (task := pipe.recv()) is not None:
        assert isinstance(task, Task)
        if task.uri == "bad":
            os._exit(9)
        pipe.send(TaskOutcome(task.scan_id, cost={"worker": os.getpid()}))


def stillborn(pipe: Connection, work: Work) -> None:
    """Dies before it is ready."""
    os._exit(7)
