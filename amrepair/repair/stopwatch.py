"""Seconds by stage of a pipeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Stopwatch:
    """Seconds by stage; stages of the same name add up."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is done inside."""
        start_s = self._clock()
        try:
            yield
        finally:
            spent_s = self._clock() - start_s
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent_s
