"""Where the scanner hangs over the bed: found once, written to a file, read by every run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from amrepair.errors import InputError
from amrepair.frames import Transform

RIGID = 1e-4
"""A rotation's rows are orthonormal to this."""


def read_calibration(path: Path | None) -> Transform:
    """The pose of a scanner: build from scanner; identity where there is no file.

    Raises
    ------
    InputError
        If the file holds none.
    """
    if path is None:
        return Transform.identity("build", "scanner")
    try:
        matrix = np.array(json.loads(path.read_text())["build_from_scanner"], float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"the calibration {path} cannot be read ({error}); it is a JSON object with "
            "build_from_scanner, a 4×4 matrix"
        ) from error
    if matrix.shape != (4, 4):
        raise InputError(f"the calibration {path} holds {matrix.shape}, not 4×4")
    turn = matrix[:3, :3]
    if not (np.abs(turn @ turn.T - np.eye(3)).max() < RIGID and np.linalg.det(turn) > 0):
        raise InputError(
            f"the calibration {path} is no rigid motion: its rotation stretches or mirrors; "
            "calibrate again"
        )
    return Transform("build", "scanner", matrix)
