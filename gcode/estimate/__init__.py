"""Estimate: how long a program takes and what it uses.

Trapezoids with look-ahead at the printer's limits; heating and homing are not counted.
"""

from gcode.estimate.estimate import Estimate, estimate

__all__ = ["Estimate", "estimate"]
