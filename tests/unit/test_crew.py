"""Work shared out over processes comes back as if nobody had shared it out."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest

from gcode.crew import forks, in_order
from gcode.errors import SliceError, WorkerError

pytestmark = pytest.mark.skipif(forks() == 1 and os.name != "posix", reason="nothing can be forked")


@pytest.mark.parametrize("workers", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 5, 40])
def test_in_order_and_whole(workers: int, count: int) -> None:
    state = np.arange(50)  # what the parent holds, the workers hold

    def ask(k: int) -> int:
        return int(state[k]) ** 2

    assert list(in_order(ask, count, workers=workers)) == [k * k for k in range(count)]


def test_the_work_is_done_elsewhere() -> None:
    first, *others = in_order(lambda _: os.getpid(), 40, workers=2)
    assert first == os.getpid()
    assert first not in others


def test_an_error_is_the_worker_s_own() -> None:
    def ask(k: int) -> int:
        if k > 0:
            raise SliceError(f"layer {k} cannot be sliced")
        return k

    with pytest.raises(SliceError, match="layer 1 cannot be sliced"):
        list(in_order(ask, 40, workers=2))


def test_a_worker_that_is_killed_is_told() -> None:
    def ask(k: int) -> int:
        if k == 20:
            os.kill(os.getpid(), signal.SIGKILL)
        return k

    with pytest.raises(WorkerError, match="ended before its work was done"):
        list(in_order(ask, 40, workers=2))
