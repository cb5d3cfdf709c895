"""Stretches of a sequence over which something holds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool


def stretches_of(holds: Bool[np.ndarray, " n"]) -> list[tuple[int, int]]:
    """First place of each stretch of true, and the one after its last.

    Examples
    --------
    >>> import numpy as np
    >>> from gcode.stretches import stretches_of
    >>> stretches_of(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]]))).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))
