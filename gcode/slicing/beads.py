"""Beads within one layer: centre lines with the share of area that each stands for.

A bead of share s and layer height h is laid with section s·h. Side by side at spacing s such
beads fill the layer exactly; seen alone each is a rounded rectangle of width s + h(1 − π/4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from gcode.moves import Role
from gcode.slicing import order_kernels as kernels
from gcode.stretches import in_turn

ROUND_LOSS = 1.0 - math.pi / 4.0  # of h: what a rounded edge lacks beside a square one


def spacing_of(width_mm: float, height_mm: float) -> float:
    """Distance of neighbouring beads of nominal `width_mm`."""
    return width_mm - height_mm * ROUND_LOSS


def width_of(share_mm: float, height_mm: float) -> float:
    """Nominal width of a bead that stands for a strip `share_mm` wide."""
    return share_mm + height_mm * ROUND_LOSS


@dataclass(frozen=True, slots=True)
class Bead:
    """A centre line.

    Attributes
    ----------
    xy_mm
        (n, 2) points; a closed loop repeats its first point at the end.
    share_mm
        (n-1,) strip width that each segment stands for.
    """

    xy_mm: Float[np.ndarray, "n 2"]
    share_mm: Float[np.ndarray, " m"]
    role: Role
    closed: bool

    @property
    def length_mm(self) -> float:
        """Length of the centre line."""
        return float(np.hypot(*np.diff(self.xy_mm, axis=0).T).sum())

    @property
    def area_mm2(self) -> float:
        """Area that the bead stands for."""
        return float(kernels.area_along(self.xy_mm, self.share_mm))

    def scaled(self, factor: float) -> Bead:
        """The same line with `factor` times the plastic."""
        return Bead(self.xy_mm, self.share_mm * factor, self.role, self.closed)

    def reversed(self) -> Bead:
        """The same bead from its other end."""
        return Bead(
            np.ascontiguousarray(self.xy_mm[::-1]),
            np.ascontiguousarray(self.share_mm[::-1]),
            self.role,
            self.closed,
        )

    def started_at(self, index: int) -> Bead:
        """A closed bead begun at point `index`."""
        if index == 0:
            return self
        ring = self.xy_mm[:-1]
        xy = np.concatenate([ring[index:], ring[: index + 1]])
        return Bead(xy, np.roll(self.share_mm, -index), self.role, self.closed)


def loop_bead(contour: Float[np.ndarray, "n 2"], share_mm: float, role: Role) -> Bead:
    """A closed bead along a contour."""
    xy = np.concatenate([contour, contour[:1]]).astype(np.float64)
    return Bead(xy, np.full(len(contour), share_mm), role, closed=True)


def divided(
    xy_mm: Float[np.ndarray, "n 2"], count: Int[np.ndarray, " m"]
) -> tuple[Float[np.ndarray, "k 2"], Int[np.ndarray, " p"]]:
    """Points along a chain, its pieces cut into `count` (m = n - 1) equal ones; and whose each is.

    Returns (p + 1, 2) points, the chain's own among them, and (p,) the piece that each begins in.
    """
    owner, step = in_turn(count)
    t = (step / count[owner])[:, None]
    points = xy_mm[owner] + (xy_mm[owner + 1] - xy_mm[owner]) * t
    return np.concatenate([points, xy_mm[-1:]]), owner
