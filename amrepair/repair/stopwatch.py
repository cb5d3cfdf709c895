"""Seconds by stage of a pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class Stopwatch:
    """Seconds by stage; stages of the same name add up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what is done inside."""
        start_s = time.monotonic()
        try:
            yield
        finally:
            spent_s = time.monotonic() - start_s
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent_s

    def rounded_s(self) -> dict[str, float]:
        """The seconds as a result tells them, to a thousandth."""
        return {stage: round(spent_s, 3) for stage, spent_s in self.seconds.items()}
