"""Triangles and footprints on a regular XY grid, cell by cell: the loops under `surfaces`.

Compiled; no allocation policy, no units of its own: everything is in cells' own millimetres.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gcode.compiled import njit


@njit(cache=True, nogil=True)
def column_crossings(
    vertices: Any, faces: Any, x0: float, y0: float, cell: float, nx: int, ny: int
) -> tuple[Any, Any, Any]:
    """Heights at which vertical lines through the cells' centres cross a mesh.

    Returns (offset, z, up): crossings of cell i = iy·nx + ix are z[offset[i]:offset[i+1]], not
    sorted; `up` is +1 where the face looks up and −1 where it looks down. Edges shared by two
    faces are counted once by the half-open rule on signed areas.
    """
    count = np.zeros(nx * ny + 1, np.int64)
    for phase in range(2):
        if phase == 1:
            total = 0
            for i in range(nx * ny + 1):
                step = count[i]
                count[i] = total
                total += step
            z_out = np.empty(total, np.float64)
            up_out = np.empty(total, np.int8)
            cursor = count.copy()
        for f in range(faces.shape[0]):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            # cell units, centres at integers
            ax = (vertices[a, 0] - x0) / cell - 0.5
            ay = (vertices[a, 1] - y0) / cell - 0.5
            bx = (vertices[b, 0] - x0) / cell - 0.5
            by = (vertices[b, 1] - y0) / cell - 0.5
            cx = (vertices[c, 0] - x0) / cell - 0.5
            cy = (vertices[c, 1] - y0) / cell - 0.5
            az, bz, cz = vertices[a, 2], vertices[b, 2], vertices[c, 2]
            area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
            if area == 0.0:
                continue
            sign = 1
            if area < 0.0:
                sign = -1
                bx, cx = cx, bx
                by, cy = cy, by
                bz, cz = cz, bz
                area = -area
            y_low = min(ay, by, cy)
            y_high = max(ay, by, cy)
            iy_first = max(0, int(np.ceil(y_low)))
            iy_last = min(ny - 1, int(np.floor(y_high)))
            for iy in range(iy_first, iy_last + 1):
                y = float(iy)
                # half-open scan line: an edge owns its lower end, not its upper one
                x_low = np.inf
                x_high = -np.inf
                hits = 0
                for e in range(3):
                    if e == 0:
                        px, py, qx, qy = ax, ay, bx, by
                    elif e == 1:
                        px, py, qx, qy = bx, by, cx, cy
                    else:
                        px, py, qx, qy = cx, cy, ax, ay
                    if (py <= y) != (qy <= y):
                        # from the lower end always, so that both faces of an edge agree exactly
                        if py < qy:
                            x = px + (y - py) * (qx - px) / (qy - py)
                        else:
                            x = qx + (y - qy) * (px - qx) / (py - qy)
                        x_low = min(x_low, x)
                        x_high = max(x_high, x)
                        hits += 1
                if hits < 2:
                    continue
                ix_first = max(0, int(np.ceil(x_low)))
                ix_last = min(nx - 1, int(np.ceil(x_high)) - 1)
                for ix in range(ix_first, ix_last + 1):
                    i = iy * nx + ix
                    if phase == 0:
                        count[i] += 1
                    else:
                        x = float(ix)
                        wb = ((x - ax) * (cy - ay) - (cx - ax) * (y - ay)) / area
                        wc = ((bx - ax) * (y - ay) - (x - ax) * (by - ay)) / area
                        z = az + wb * (bz - az) + wc * (cz - az)
                        z_out[cursor[i]] = min(max(z, min(az, bz, cz)), max(az, bz, cz))
                        up_out[cursor[i]] = sign
                        cursor[i] += 1
    return count, z_out, up_out


@njit(cache=True, nogil=True)
def column_top(offset: Any, z: Any, empty: float) -> Any:
    """Highest crossing of each column, `empty` where there is none."""
    n = offset.shape[0] - 1
    top = np.full(n, empty)
    for i in range(n):
        for j in range(offset[i], offset[i + 1]):
            if z[j] > top[i] or j == offset[i]:
                top[i] = z[j]
    return top


@njit(cache=True, nogil=True)
def dilate_rows(
    z: Any, row_dy: Any, row_low: Any, row_high: Any, y0: int, y1: int, x0: int, x1: int
) -> Any:
    """Greatest height under a footprint of rows [low, high] at dy, for cells [y0, y1) × [x0, x1).

    Cells of the answer may lie outside the field; nothing stands there.
    """
    ny, nx = z.shape
    out = np.full((y1 - y0, x1 - x0), -np.inf)
    if row_dy.shape[0] == 0:
        return out
    # maxima of 1, 2, 4 … cells from each cell on: two of them make any row of the footprint
    top, left = y0 + row_dy.min(), x0 + row_low.min()
    height, width = y1 + row_dy.max() - top, x1 + row_high.max() - left
    spans = np.full((height, width), -np.inf)
    for iy in range(max(0, -top), min(height, ny - top)):
        for ix in range(max(0, -left), min(width, nx - left)):
            spans[iy, ix] = z[iy + top, ix + left]
    long, longest = 1, (row_high - row_low).max() + 1
    while long <= longest:
        for iy in range(y1 - y0):  # a row of the answer stays in the cache while it is made
            into = out[iy]
            for r in range(row_dy.shape[0]):
                wide = row_high[r] - row_low[r] + 1
                if wide < long or wide >= 2 * long:
                    continue
                source = spans[iy + y0 + row_dy[r] - top, x0 + row_low[r] - left :]
                other = source[wide - long :]
                for ix in range(x1 - x0):
                    a = source[ix] if source[ix] > other[ix] else other[ix]
                    into[ix] = a if a > into[ix] else into[ix]
        for iy in range(height):
            row, other = spans[iy], spans[iy, long:]
            for ix in range(width - long):
                row[ix] = row[ix] if row[ix] > other[ix] else other[ix]
        long *= 2
    return out


@njit(cache=True, nogil=True)
def column_rest(
    offset: Any, z: Any, gone_offset: Any, gone_z: Any, film: float, empty: float
) -> Any:
    """Highest crossing of each column after a second solid is taken from the first.

    Both are given by their crossings (`column_crossings`). What is left thinner than `film` goes
    with what was taken; `empty` where nothing stays.
    """
    n = offset.shape[0] - 1
    top = np.full(n, empty)
    for i in range(n):
        if gone_offset[i] == gone_offset[i + 1]:
            for j in range(offset[i], offset[i + 1]):
                if z[j] > top[i] or j == offset[i]:
                    top[i] = z[j]
            continue
        stands = np.sort(z[offset[i] : offset[i + 1]])
        gone = np.sort(gone_z[gone_offset[i] : gone_offset[i + 1]])
        done = False
        for k in range(len(stands) - 1, 0, -2):
            high, low = stands[k], stands[k - 1]
            touched = False
            for g in range(len(gone) - 1, 0, -2):
                if gone[g - 1] >= high or gone[g] <= low:
                    continue
                touched = True
                if high - gone[g] > film:
                    break
                high = gone[g - 1]
            if not touched or high - low > film:
                top[i] = high
                done = True
            if done:
                break
    return top


@njit(cache=True, nogil=True)
def beside_lines(
    start: Any, end: Any, within: Any, height: Any, low: Any, cell: float, ny: int, nx: int
) -> Any:
    """(ny, nx) greatest `height` (n,) of stretches that cells' middles lie within of, else −inf.

    Stretches go from `start` to `end` (n, 2), and reach `within` (n,) aside; `low` is the corner
    of the cells.
    """
    found = np.full((ny, nx), -np.inf)
    for n in range(len(start)):
        ax, ay, far = start[n, 0], start[n, 1], within[n]
        dx, dy = end[n, 0] - ax, end[n, 1] - ay
        square = max(dx * dx + dy * dy, 1e-12)
        x0, x1 = min(ax, ax + dx) - far - low[0], max(ax, ax + dx) + far - low[0]
        y0, y1 = min(ay, ay + dy) - far - low[1], max(ay, ay + dy) + far - low[1]
        for iy in range(max(0, int(np.floor(y0 / cell))), min(ny, int(np.floor(y1 / cell)) + 1)):
            py = low[1] + (iy + 0.5) * cell - ay
            for ix in range(
                max(0, int(np.floor(x0 / cell))), min(nx, int(np.floor(x1 / cell)) + 1)
            ):
                px = low[0] + (ix + 0.5) * cell - ax
                share = min(max((px * dx + py * dy) / square, 0.0), 1.0)
                ox, oy = px - share * dx, py - share * dy
                if ox * ox + oy * oy <= far * far:
                    found[iy, ix] = max(found[iy, ix], height[n])
    return found


@njit(cache=True, nogil=True)
def less_with_distance(z: Any, rise: float, within: float) -> Any:
    """Greatest of all cells' values less `rise` for every cell of distance, up to `within` cells.

    Four sweeps hand on from cell to cell which one's value wins (Danielsson 1980, with weights).
    What wins at a neighbour but is too far from here hides what is lower and nearer: the answer may
    then be too low, yet no lower than the greatest of all cells there less `rise × (within - √2)`.
    """
    ny, nx = z.shape
    out, won = z.copy(), z.copy()  # what wins here, less its distance, and before
    from_y = np.empty((ny, nx), np.int32)
    from_x = np.empty((ny, nx), np.int32)
    for iy in range(ny):
        for ix in range(nx):
            from_y[iy, ix] = iy
            from_x[iy, ix] = ix
    for down in (True, False):
        for row in range(ny):
            iy = row if down else ny - 1 - row
            before = iy - 1 if down else iy + 1
            for right in (True, False):
                for column in range(nx):
                    ix = column if right else nx - 1 - column
                    back = ix - 1 if right else ix + 1
                    for k in range(4):
                        # the row before, where it was swept already, and the cell before
                        jy = iy if k == 3 else before
                        jx = back if k == 3 else ix + k - 1
                        if jy < 0 or jy >= ny or jx < 0 or jx >= nx:
                            continue
                        most = won[jy, jx]
                        if most <= out[iy, ix]:
                            continue
                        sy, sx = from_y[jy, jx], from_x[jy, jx]
                        far = np.sqrt(float((sy - iy) ** 2 + (sx - ix) ** 2))
                        if far > within:
                            continue
                        value = most - rise * far
                        if value > out[iy, ix]:
                            out[iy, ix] = value
                            won[iy, ix] = most
                            from_y[iy, ix] = sy
                            from_x[iy, ix] = sx
    return out
