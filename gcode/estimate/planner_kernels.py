# mypy: disable-error-code="no-untyped-def"
"""Speed planning over a whole program: reverse pass, forward pass, trapezoids; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def limits(steps, pushed, feed, max_speed, max_acceleration, jerk, before, planned, first):
    """What each line's move may do by itself and after the one before it.

    `before` (6,), which is changed: unit vector of the last move, its speed, whether there was one.
    `planned` (4, n) takes, from column `first` on, lengths (zero for what does not move), cruising
    speeds, accelerations and speeds at entry. Junction speed is classic jerk's: no axis may change
    its speed by more than its jerk at once. Accelerations are at most the X axis's where more than
    one moves.
    """
    unit = np.zeros(4)
    for k in range(len(pushed)):
        e = pushed[k]
        d = steps[k]
        flat = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        if not flat >= 0.0:  # the place before is not known
            flat = 0.0
        distance = np.sqrt(flat)
        unit[:] = 0.0
        if distance < 1e-9:
            distance = abs(e)
            if distance < 1e-9:
                continue
            unit[3] = 1.0 if e > 0 else -1.0
        else:
            for axis in range(3):
                unit[axis] = d[axis] / distance
            unit[3] = e / distance
        speed = max(feed[k], 0.1)
        a = max_acceleration[0]
        for axis in range(4):
            share = abs(unit[axis])
            if share > 1e-12:
                speed = min(speed, max_speed[axis] / share)
                a = min(a, max_acceleration[axis] / share)
        limit = 0.0
        if before[5] > 0.0:
            limit = min(speed, before[4])
            worst = 1.0
            for axis in range(4):
                change = abs(unit[axis] - before[axis]) * limit
                if change > jerk[axis]:
                    worst = min(worst, jerk[axis] / change)
            limit *= worst
        own = first + k
        planned[0, own], planned[1, own], planned[2, own], planned[3, own] = (
            distance,
            speed,
            a,
            limit,
        )
        before[:4] = unit
        before[4], before[5] = speed, 1.0


@njit(cache=True, nogil=True)
def seconds(planned):
    """(n,) time of every line, as `limits` planned them; speeds at entry are changed."""
    length, cruise, accel, entry = planned
    n = len(length)
    out = np.zeros(n)
    following = 0.0  # reverse: a move must be able to slow down to the next one's entry
    for k in range(n - 1, -1, -1):
        if length[k] == 0.0:
            continue
        entry[k] = min(entry[k], np.sqrt(following * following + 2 * accel[k] * length[k]))
        following = entry[k]
    previous = -1
    for k in range(n):
        if length[k] == 0.0:
            continue
        if previous >= 0:
            reachable = np.sqrt(entry[previous] ** 2 + 2 * accel[previous] * length[previous])
            entry[k] = min(entry[k], reachable)
            out[previous] = trapezoid(
                length[previous], cruise[previous], accel[previous], entry[previous], entry[k]
            )
        previous = k
    if previous >= 0:
        out[previous] = trapezoid(
            length[previous], cruise[previous], accel[previous], entry[previous], 0.0
        )
    return out


@njit(inner=True, cache=True, nogil=True)
def trapezoid(length, speed, accel, start, end):
    """Time of one move."""
    up = (speed * speed - start * start) / (2 * accel)
    down = (speed * speed - end * end) / (2 * accel)
    if up + down <= length:
        return (speed - start) / accel + (speed - end) / accel + (length - up - down) / speed
    peak = np.sqrt(max(0.5 * (2 * accel * length + start * start + end * end), 0.0))
    peak = max(peak, start, end)
    return (peak - start) / accel + (peak - end) / accel
