"""Progress as a callback: rooms report, the command line draws.

Progress is not logging: it is said often, kept nowhere, and may be dropped.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable


@runtime_checkable
class Progress(Protocol):
    """Called as work goes on; must be cheap and must not raise."""

    def __call__(self, stage: str, done: float, total: float) -> None:
        """Report that `done` of `total` (any unit) of `stage` is finished."""


def silent(stage: str, done: float, total: float) -> None:
    """A progress that says nothing."""
