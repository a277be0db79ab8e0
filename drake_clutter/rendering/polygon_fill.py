"""Filling of convex polygons with a depth buffer, row by row.

Pixels have integer centers. A pixel on an edge belongs to the polygon on its right, and one on a
horizontal edge to the polygon below: polygons that share an edge share no pixel, and miss none.
"""

import math

import numpy as np

from drake_clutter.compilation import njit


@njit(cache=True, nogil=True, inline="always")
def fill_polygon(u, v, count, plane, label, nearest, hit, begin, end):  # type: ignore[no-untyped-def]
    """Draw a convex polygon where it is nearer than what was drawn before.

    The end points of an edge are ordered downwards, so that it rounds alike for both polygons that
    share it.

    Args:
        u: Columns of the corners, counter-clockwise as seen in the image [px]. Shape (>= count,).
        v: Rows of the corners [px]. Shape (>= count,).
        count: Number of corners.
        plane: Nearness as a function of the pixel: slope along a row, slope along a column, and
            value at pixel (0, 0).
        label: Value to write into `hit`.
        nearest: Largest nearness so far. Shape (height, width), float32.
        hit: Label of the largest nearness. Shape (height, width).
        begin: Scratch memory: first column in each row. Shape (height,).
        end: Scratch memory: column after the last in each row. Shape (height,).

    Returns:
        Number of pixels of the polygon, whatever is in front of it.
    """
    height, width = hit.shape
    along, down, start = plane
    top, bottom = np.inf, -np.inf
    for c in range(count):
        top, bottom = min(top, v[c]), max(bottom, v[c])
    first_row = max(0, math.ceil(top))
    last_row = min(height, math.ceil(bottom)) - 1
    for c in range(count):
        d = c + 1 if c + 1 < count else 0
        leftmost = v[c] < v[d]
        a, b = (c, d) if leftmost else (d, c)
        first_below = max(first_row, math.ceil(v[a]))
        last_below = min(last_row + 1, math.ceil(v[b]))
        if first_below >= last_below:
            continue
        slope = (u[b] - u[a]) / (v[b] - v[a])
        bound = begin if leftmost else end
        for row in range(first_below, last_below):
            bound[row] = min(max(math.ceil(u[a] + (row - v[a]) * slope), 0), width)
    pixels = 0
    for row in range(first_row, last_row + 1):
        first_column, last_column = begin[row], end[row]
        if last_column <= first_column:
            continue
        pixels += last_column - first_column
        value_here = np.float32(start + down * row + along * first_column)
        step = np.float32(along)
        # Unconditional writes to slices that start at 0 let the compiler vectorize the loop.
        nearest_here = nearest[row, first_column:last_column]
        hit_here = hit[row, first_column:last_column]
        for k in range(last_column - first_column):
            value = value_here + step * np.float32(k)
            nearer = value > nearest_here[k]
            nearest_here[k] = value if nearer else nearest_here[k]
            hit_here[k] = label if nearer else hit_here[k]
    return pixels
