"""What the tests of the fleet's shared detection send to its processes, or have them be."""

from __future__ import annotations

import socket
import time

import numpy as np


def idle(listener: socket.socket, within_s: float, nice: int) -> None:
    """A worker that never takes anybody."""
    time.sleep(600.0)


def hang(place_mm: np.ndarray, deviation_mm: np.ndarray) -> np.ndarray:
    """What the job was told to go beyond, answered when nobody waits any more."""
    time.sleep(600.0)
    return deviation_mm
