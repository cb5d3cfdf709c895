# mypy: disable-error-code="no-untyped-def"
"""Speed planning over a whole program: reverse pass, forward pass, trapezoids; compiled."""

from __future__ import annotations

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def seconds(steps, pushed, feed, max_speed, max_acceleration, jerk, print_acceleration):
    """(n,) time of every line; zero for those that do not move.

    Junction speed is classic jerk's: no axis may change its speed by more than its jerk at once.
    """
    n = len(pushed)
    length = np.zeros(n)
    cruise = np.zeros(n)
    accel = np.zeros(n)
    entry = np.zeros(n + 1)
    unit = np.zeros((n, 4))
    last = -1
    for k in range(n):
        e = pushed[k]
        d = steps[k]
        flat = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        if not flat >= 0.0:  # the place before is not known
            flat = 0.0
        distance = np.sqrt(flat)
        if distance < 1e-9:
            distance = abs(e)
            if distance < 1e-9:
                continue
            unit[k, 3] = 1.0 if e > 0 else -1.0
        else:
            for axis in range(3):
                unit[k, axis] = d[axis] / distance
            unit[k, 3] = e / distance
        length[k] = distance
        speed = max(feed[k], 0.1)
        a = print_acceleration
        for axis in range(4):
            share = abs(unit[k, axis])
            if share > 1e-12:
                speed = min(speed, max_speed[axis] / share)
                a = min(a, max_acceleration[axis] / share)
        cruise[k], accel[k] = speed, a
        limit = 0.0
        if last >= 0:
            limit = min(speed, cruise[last])
            worst = 1.0
            for axis in range(4):
                change = abs(unit[k, axis] - unit[last, axis]) * limit
                if change > jerk[axis]:
                    worst = min(worst, jerk[axis] / change)
            limit *= worst
        entry[k] = limit
        last = k
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


@njit(cache=True, nogil=True)
def trapezoid(length, speed, accel, start, end):
    """Time of one move."""
    up = (speed * speed - start * start) / (2 * accel)
    down = (speed * speed - end * end) / (2 * accel)
    if up + down <= length:
        return (speed - start) / accel + (speed - end) / accel + (length - up - down) / speed
    peak = np.sqrt(max(0.5 * (2 * accel * length + start * start + end * end), 0.0))
    peak = max(peak, start, end)
    return (peak - start) / accel + (peak - end) / accel
