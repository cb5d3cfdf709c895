# mypy: disable-error-code="no-untyped-def"
"""Which things hang together by pairs that link them: a loop, compiled, for `groups`."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(inner=True, cache=True, nogil=True)
def _first(linked, i):
    """The first of those that one is linked with so far; ways to it are halved."""
    while linked[i] != i:
        linked[i] = linked[linked[i]]
        i = linked[i]
    return i


@njit(cache=True, nogil=True)
def groups(one, other, count):
    """(count,) a number for each thing, the same for those that pairs link, rising from 0."""
    linked = np.arange(count)
    for k in range(len(one)):
        a, b = _first(linked, one[k]), _first(linked, other[k])
        linked[max(a, b)] = min(a, b)
    number, found = np.empty(count, np.int64), 0
    for i in range(count):
        if linked[i] == i:
            number[i] = found
            found += 1
        else:  # with one before it
            number[i] = number[linked[i]]
    return number
