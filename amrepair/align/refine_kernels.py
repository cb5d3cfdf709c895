# mypy: disable-error-code="no-untyped-def"
"""Gauss–Newton on the field: normal equations, one step, and all steps of many poses; compiled.

A pose is a rotation and the place of the points' centroid; the points are about their centroid.
`step` is the same for any template; `refine_all` asks a grid's numbers (`grid.Grid`) itself.
"""

from __future__ import annotations

import numpy as np

from amrepair.align.pose_kernels import solve, turn
from amrepair.template.trilinear_kernels import field_at
from gcode.compiled import njit, prange

REFINE_SHRINK = 0.6  # of the loss's scale, from one iteration to the next
STILL_MM = 2e-4  # of the scan's far points: below this nothing moves any more
STEP_SIGMAS = 0.02  # nor where it moves by less than this share of the noise
HASTE = 15  # iterations with whole steps
# Of a step that turned back, and of one that went on, as in Rprop (Riedmiller and Braun 1993): with
# a doubling for each halving, steps to and fro about an edge would go on for ever.
TURNED_BACK, WENT_ON = 0.5, 1.2
SLOWEST = 1.0 / 256  # of a step
UNHINDERED_RATIO = 0.1  # of the limit: distances that change by less do not hinder the motion
WIDEST_REFINE_RAD = 0.2  # a step this wide has left the linear range
REFINE_DAMPING = 1e-9
GO_ON, CONVERGED, ENOUGH = 0, 1, 2  # how a step may end


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(turned, f, gradient, scale, outside):
    """(6, 6) JᵀWJ and (6,) JᵀWf of the Geman–McClure loss; rotations about the points' origin.

    Where `outside` is not 0, the loss of what is outside (f > 0) is Huber's of that scale, or
    Geman–McClure's where that pulls more.
    """
    square = scale * scale
    # one name for each sum: arrays would keep the loop from running in vectors
    b0 = b1 = b2 = b3 = b4 = b5 = h00 = h10 = h11 = h20 = h21 = h22 = 0.0
    h30 = h31 = h32 = h33 = h40 = h41 = h42 = h43 = h44 = h50 = h51 = h52 = h53 = h54 = h55 = 0.0
    for n in range(len(f)):
        x, y, z = turned[n, 0], turned[n, 1], turned[n, 2]
        gx, gy, gz = gradient[n, 0], gradient[n, 1], gradient[n, 2]
        weight = square / (f[n] * f[n] + square)
        weight *= weight
        if outside > 0.0 and f[n] > 0.0:
            weight = max(weight, outside / max(f[n], outside))
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


@njit(cache=True, nogil=True)
def step(hessian, slope, known, first, rotation, place, last, pace, scale, iteration, limits):
    """One damped step of a pose, in place; how it ended, and the next pace and scale.

    Parameters
    ----------
    hessian, slope
        Of `normal_equations`.
    known
        (6,) inverse variances of the first guess; 0 where nothing is known.
    first
        (3, 4) the guess, rotation and place.
    last
        (6,) the step before; takes this one.
    limits
        Points, their reach, their noise, the last scale, and the step that is small enough.
    """
    count, reach, sigma, last_scale, enough = limits
    h, b = np.empty((6, 6)), np.empty(6)
    share = 1.0 / (sigma * sigma * count)
    trace = 0.0
    for a in range(6):
        trace += hessian[a, a]
    for a in range(6):
        for c in range(6):
            h[a, c] = share * hessian[a, c]
        h[a, a] += share * REFINE_DAMPING * trace / 6.0 + known[a]
        b[a] = -share * slope[a]
    for a in range(3):
        # the axis-angle vector of the small rotation away from the guess
        i, j = (a + 1) % 3, (a + 2) % 3
        away = 0.0
        for c in range(3):
            away += 0.5 * (rotation[j, c] * first[i, c] - rotation[i, c] * first[j, c])
        b[a] -= known[a] * away
        b[3 + a] -= known[3 + a] * (place[a] - first[a, 3])
    solve(h, b)
    angle = np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    if angle > WIDEST_REFINE_RAD:
        for a in range(6):
            b[a] *= WIDEST_REFINE_RAD / angle
    if iteration > HASTE:
        # to and fro across an edge of the field, where its gradient turns at once
        along = 0.0
        for a in range(6):
            along += b[a] * last[a]
        pace *= TURNED_BACK if along < 0.0 else WENT_ON
        pace = min(max(pace, SLOWEST), 1.0)
    for a in range(6):
        last[a] = b[a]
        b[a] *= pace
    turn(rotation, b[0], b[1], b[2])
    for a in range(3):
        place[a] += b[3 + a]
    moved = np.sqrt(b[3] ** 2 + b[4] ** 2 + b[5] ** 2)
    moved += reach * np.sqrt(b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    limit = max(STILL_MM, STEP_SIGMAS * sigma)
    still = moved < limit
    if iteration > HASTE:  # a rod turns on for ever: what counts is what its points would see
        square = 0.0
        for a in range(6):
            for c in range(6):
                square += b[a] * hessian[a, c] * b[c]
        still |= np.sqrt(max(square, 0.0) / count) < UNHINDERED_RATIO * limit
    if scale <= last_scale * (1 + 1e-9) and (still or moved < enough):
        return CONVERGED if still else ENOUGH, pace, scale
    if moved < 0.25 * scale:
        scale = max(last_scale, scale * REFINE_SHRINK)
    return GO_ON, pace, scale


@njit(inner=True, cache=True, nogil=True)
def _asked(local, rotation, place, grid, turned, f, gradient):
    """The points turned, the grid's field at their places, and its gradient there."""
    origin, cell, base, block_of, blocks = grid
    r, p = rotation, place
    for m in range(len(local)):
        x, y, z = local[m, 0], local[m, 1], local[m, 2]
        tx = r[0, 0] * x + r[0, 1] * y + r[0, 2] * z
        ty = r[1, 0] * x + r[1, 1] * y + r[1, 2] * z
        tz = r[2, 0] * x + r[2, 1] * y + r[2, 2] * z
        turned[m, 0], turned[m, 1], turned[m, 2] = tx, ty, tz
        f[m], gradient[m, 0], gradient[m, 1], gradient[m, 2] = field_at(
            tx + p[0], ty + p[1], tz + p[2], origin, cell, base, block_of, blocks
        )


@njit(inner=True, cache=True, nogil=True)
def _to_its_end(
    local, rotation, place, known, scale, most, limits, outside, grid, hessian, residual
):
    """All steps of one pose, in place: iterations, and whether it converged."""
    n = len(local)
    turned, gradient = np.empty((n, 3)), np.empty((n, 3))
    first, last, pace = np.empty((3, 4)), np.zeros(6), 1.0
    first[:, :3], first[:, 3] = rotation, place
    iterations, ended = 0, GO_ON
    while iterations < most and ended == GO_ON:
        iterations += 1
        _asked(local, rotation, place, grid, turned, residual, gradient)
        h, slope = normal_equations(turned, residual, gradient, scale, outside)
        hessian[:] = h
        ended, pace, scale = step(
            h, slope, known, first, rotation, place, last, pace, scale, iterations, limits
        )
    _asked(local, rotation, place, grid, turned, residual, gradient)
    return iterations, ended == CONVERGED


@njit(cache=True, nogil=True, parallel=True)
def refine_all(local, rotations, places, known, scale, most, limits, outside, grid):
    """Every pose moved to its minimum on a grid's field, in place.

    Returns (k, 6, 6) hessians, (k, n) residuals, (k, 2) iterations and whether it converged.
    """
    count = len(rotations)
    hessians, residuals = np.zeros((count, 6, 6)), np.empty((count, len(local)))
    ends = np.empty((count, 2), np.int64)
    for k in prange(count):
        ends[k, 0], ends[k, 1] = _to_its_end(
            local, rotations[k], places[k], known, scale, most, limits, outside, grid,
            hessians[k], residuals[k],
        )  # fmt: skip
    return hessians, residuals, ends
