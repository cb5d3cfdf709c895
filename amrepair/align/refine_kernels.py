# mypy: disable-error-code="no-untyped-def"
"""Normal equations of a pose on the field, in one pass over the points; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def normal_equations(turned, f, gradient, scale):
    """(6, 6) JᵀWJ and (6,) JᵀWf of the Geman–McClure loss; rotations about the points' origin."""
    square = scale * scale
    # one name for each sum: arrays would keep the loop from running in vectors
    b0 = b1 = b2 = b3 = b4 = b5 = h00 = h10 = h11 = h20 = h21 = h22 = 0.0
    h30 = h31 = h32 = h33 = h40 = h41 = h42 = h43 = h44 = h50 = h51 = h52 = h53 = h54 = h55 = 0.0
    for n in range(len(f)):
        x, y, z = turned[n, 0], turned[n, 1], turned[n, 2]
        gx, gy, gz = gradient[n, 0], gradient[n, 1], gradient[n, 2]
        weight = square / (f[n] * f[n] + square)
        weight *= weight
        rx, ry, rz = y * gz - z * gy, z * gx - x * gz, x * gy - y * gx
        ux, uy, uz = weight * rx, weight * ry, weight * rz
        vx, vy, vz = weight * gx, weight * gy, weight * gz
        b0, b1, b2 = b0 + ux * f[n], b1 + uy * f[n], b2 + uz * f[n]
        b3, b4, b5 = b3 + vx * f[n], b4 + vy * f[n], b5 + vz * f[n]
        h00, h10, h11 = h00 + ux * rx, h10 + uy * rx, h11 + uy * ry
        h20, h21, h22 = h20 + uz * rx, h21 + uz * ry, h22 + uz * rz
        h30, h31, h32 = h30 + vx * rx, h31 + vx * ry, h32 + vx * rz
        h40, h41, h42 = h40 + vy * rx, h41 + vy * ry, h42 + vy * rz
        h50, h51, h52 = h50 + vz * rx, h51 + vz * ry, h52 + vz * rz
        h33, h43, h44 = h33 + vx * gx, h43 + vy * gx, h44 + vy * gy
        h53, h54, h55 = h53 + vz * gx, h54 + vz * gy, h55 + vz * gz
    half = np.array(
        [
            [h00, h10, h20, h30, h40, h50],
            [0.0, h11, h21, h31, h41, h51],
            [0.0, 0.0, h22, h32, h42, h52],
            [0.0, 0.0, 0.0, h33, h43, h53],
            [0.0, 0.0, 0.0, 0.0, h44, h54],
            [0.0, 0.0, 0.0, 0.0, 0.0, h55],
        ]
    )
    for row in range(1, 6):
        for column in range(row):
            half[row, column] = half[column, row]
    return half, np.array([b0, b1, b2, b3, b4, b5])
