"""Equal questions asked by as many threads as there are cores, their answers in order.

For what waits in compiled code that lets other threads go on: trees' queries, kernels that are not
parallel themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from gcode.crew import cores

Question = TypeVar("Question")
Answer = TypeVar("Answer")


def in_threads(ask: Callable[[Question], Answer], questions: Iterable[Question]) -> list[Answer]:
    """The answers, in the questions' order."""
    with ThreadPoolExecutor(cores()) as pool:
        return list(pool.map(ask, questions))
