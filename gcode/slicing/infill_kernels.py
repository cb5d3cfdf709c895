"""Scan lines through polygons and their chaining into strokes: the loops under `infill`.

Polygons come flattened: points (n, 2) and the start of each contour (m + 1,).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def scan_lines(points: Any, starts: Any, spacing: float, phase: float) -> tuple[Any, Any, Any, Any]:
    """Chords of the lines y = phase + i·spacing inside the polygons (even-odd).

    Returns (line, x_low, x_high, first): chords sorted by line then x; the chords of the r-th
    line are first[r]:first[r+1].
    """
    y_low = points[:, 1].min()
    y_high = points[:, 1].max()
    i0 = int(np.ceil((y_low - phase) / spacing))
    i1 = int(np.floor((y_high - phase) / spacing))
    rows = max(0, i1 - i0 + 1)
    count = np.zeros(rows + 1, np.int64)
    xs = np.empty(0)
    for turn in range(2):
        if turn == 1:
            total = 0
            for r in range(rows + 1):
                step = count[r]
                count[r] = total
                total += step
            xs = np.empty(total)
            cursor = count.copy()
        for c in range(starts.shape[0] - 1):
            for k in range(starts[c], starts[c + 1]):
                nxt = k + 1 if k + 1 < starts[c + 1] else starts[c]
                px, py, qx, qy = points[k, 0], points[k, 1], points[nxt, 0], points[nxt, 1]
                if py > qy:
                    px, py, qx, qy = qx, qy, px, py
                if py == qy:
                    continue
                first = max(0, int(np.ceil((py - phase) / spacing)) - i0)
                for r in range(first, rows):
                    y = phase + (i0 + r) * spacing
                    if y >= qy:
                        break
                    if y < py:
                        continue
                    if turn == 0:
                        count[r] += 1
                    else:
                        xs[cursor[r]] = px + (y - py) * (qx - px) / (qy - py)
                        cursor[r] += 1
    pairs = 0
    for r in range(rows):
        pairs += (count[r + 1] - count[r]) // 2
    line = np.empty(pairs, np.int64)
    low = np.empty(pairs)
    high = np.empty(pairs)
    first_of = np.zeros(rows + 1, np.int64)
    n = 0
    for r in range(rows):
        row = np.sort(xs[count[r] : count[r + 1]])
        for j in range(row.shape[0] // 2):
            if row[2 * j + 1] - row[2 * j] > 1e-6:
                line[n] = i0 + r
                low[n] = row[2 * j]
                high[n] = row[2 * j + 1]
                n += 1
        first_of[r + 1] = n
    return line[:n], low[:n], high[:n], first_of


@njit(cache=True, nogil=True)
def chain_chords(low: Any, high: Any, first: Any, reach: float) -> tuple[Any, Any]:
    """Boustrophedon order of chords: (order, code), one entry per chord.

    `code` bit 0: traverse from high to low; bit 1: this chord begins a new stroke.
    A chord goes on into the next line where the two overlap and their near ends are within
    `reach`, so that the connecting move stays beside the outline.
    """
    n = low.shape[0]
    used = np.zeros(n, np.bool_)
    row_of = np.empty(n, np.int64)
    for r in range(first.shape[0] - 1):
        for j in range(first[r], first[r + 1]):
            row_of[j] = r
    order = np.empty(n, np.int64)
    code = np.empty(n, np.int8)
    done = 0
    for seed in range(n):
        if used[seed]:
            continue
        current = seed
        backward = False
        fresh = True
        while current >= 0:
            used[current] = True
            order[done] = current
            code[done] = (1 if backward else 0) + (2 if fresh else 0)
            done += 1
            fresh = False
            at_high = not backward
            x = high[current] if at_high else low[current]
            r = row_of[current] + 1
            best = -1
            best_gap = reach
            if r < first.shape[0] - 1:
                for j in range(first[r], first[r + 1]):
                    if used[j] or high[j] < low[current] or low[j] > high[current]:
                        continue
                    gap = abs((high[j] if at_high else low[j]) - x)
                    if gap <= best_gap:
                        best_gap = gap
                        best = j
            current = best
            backward = at_high
    return order, code


@njit(inner=True, cache=True, nogil=True)
def edges_by_row(points: Any, starts: Any, low: float, high: float) -> tuple[Any, Any, float]:
    """Edges of polygons by the rows that they reach into, and how many rows there are in a unit.

    Rows are as high as an edge is on average: three times as many entries as edges, at most.

    Returns
    -------
    tuple
        (r + 1,) where each row's edges start (with the end), (e, 2) their ends among the points,
        and rows a unit, from `low` up.
    """
    n = points.shape[0]
    climbed = 0.0
    for c in range(starts.shape[0] - 1):
        k = starts[c + 1] - 1
        for j in range(starts[c], starts[c + 1]):
            climbed += abs(points[j, 1] - points[k, 1])
            k = j
    rows = max(1, int((high - low) * n / climbed))
    a_unit = rows / (high - low)
    first = np.zeros(rows + 2, np.int64)
    edges = np.empty((0, 2), np.int64)
    for turn in range(2):
        if turn == 1:
            for r in range(rows):
                first[r + 2] += first[r + 1]
            edges = np.empty((first[rows + 1], 2), np.int64)
        for c in range(starts.shape[0] - 1):
            k = starts[c + 1] - 1
            for j in range(starts[c], starts[c + 1]):
                foot, top = min(points[j, 1], points[k, 1]), max(points[j, 1], points[k, 1])
                begin = min(int((foot - low) * a_unit), rows - 1)
                end = min(int((top - low) * a_unit), rows - 1)
                for r in range(begin, end + 1):
                    if turn == 0:
                        first[r + 2] += 1
                    else:
                        edges[first[r + 1], 0], edges[first[r + 1], 1] = j, k
                        first[r + 1] += 1
                k = j
    return first[: rows + 1], edges, a_unit


@njit(cache=True, nogil=True)
def inside(x: Any, y: Any, points: Any, starts: Any) -> Any:
    """Whether points (x, y) lie inside the polygons (even-odd)."""
    out = np.zeros(x.shape[0], np.bool_)
    low, high = points[:, 1].min(), points[:, 1].max()
    if low == high:
        return out
    first, edges, a_unit = edges_by_row(points, starts, low, high)
    for i in range(x.shape[0]):
        if not low <= y[i] < high:
            continue
        odd = False
        row = min(int((y[i] - low) * a_unit), len(first) - 2)
        for e in range(first[row], first[row + 1]):
            j, k = edges[e]
            if (points[j, 1] > y[i]) != (points[k, 1] > y[i]) and x[i] < (
                points[k, 0] - points[j, 0]
            ) * (y[i] - points[j, 1]) / (points[k, 1] - points[j, 1]) + points[j, 0]:
                odd = not odd
        out[i] = odd
    return out


@njit(cache=True, nogil=True)
def crosses(px: float, py: float, qx: float, qy: float, points: Any, starts: Any) -> bool:
    """Whether the segment p–q properly crosses any contour."""
    x_low, x_high = min(px, qx), max(px, qx)
    y_low, y_high = min(py, qy), max(py, qy)
    for c in range(starts.shape[0] - 1):
        k = starts[c + 1] - 1
        for j in range(starts[c], starts[c + 1]):
            ax, ay, bx, by = points[k, 0], points[k, 1], points[j, 0], points[j, 1]
            k = j
            if max(ax, bx) < x_low or min(ax, bx) > x_high:
                continue
            if max(ay, by) < y_low or min(ay, by) > y_high:
                continue
            d1 = (qx - px) * (ay - py) - (qy - py) * (ax - px)
            d2 = (qx - px) * (by - py) - (qy - py) * (bx - px)
            d3 = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
            d4 = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
            if d1 * d2 < 0.0 and d3 * d4 < 0.0:
                return True
    return False
