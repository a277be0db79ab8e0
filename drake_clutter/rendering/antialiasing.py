"""Smoothing of the jagged edges of a rendered image.

It is FXAA (Lottes 2009, NVIDIA white paper "FXAA") with the search for the ends of edges and the
constants of VTK's `vtkFXAAOptions`, so that color images look like those of VTK.
"""

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

_RELATIVE_CONTRAST = np.float32(1 / 8)
_HARD_CONTRAST = np.float32(1 / 16)
"""Least range of luminosity among neighbors that is smoothed, of the largest, and absolute."""
_SUBPIXEL_BLEND_LIMIT = np.float32(3 / 4)
"""Largest fraction of the neighbors' mean in a pixel."""
_SUBPIXEL_CONTRAST = np.float32(1 / 4)
"""Deviation from the neighbors' mean, relative to their range, that is not smoothed."""
_SEARCH_STEPS = 12
"""Largest distance of the end of an edge [px]."""
_LUMINOSITY = np.array([0.299, 0.587, 0.114]) / 255
"""Weights of red, green and blue in the luminosity."""


@njit(cache=True, nogil=True, error_model="numpy")
def _luminosity(color, weights, luminosity):  # type: ignore[no-untyped-def]
    """Fill an image of luminosities in [0, 1]. Shape (height, width), float32."""
    for row in range(color.shape[0]):
        here = color[row]
        for column in range(color.shape[1]):
            luminosity[row, column] = (
                weights[0] * np.float32(here[column, 0])
                + weights[1] * np.float32(here[column, 1])
                + weights[2] * np.float32(here[column, 2])
            )


@njit(cache=True, nogil=True, error_model="numpy")
def _edge_shift(luminosity, row, column, is_horizontal):  # type: ignore[no-untyped-def]
    """Return by how much, and towards which neighbor, a pixel on an edge is shifted [px].

    Args:
        luminosity: Luminosities. Shape (height, width).
        row: Row of the pixel.
        column: Column of the pixel.
        is_horizontal: Whether the edge is horizontal.

    Returns:
        Step of the row towards the neighbor across the edge, step of the column, and the shift.
    """
    height, width = luminosity.shape
    center = luminosity[row, column]
    # The first neighbor is that below or on the left: VTK counts rows from the bottom.
    row_step, column_step = (1, 0) if is_horizontal else (0, -1)
    first = luminosity[min(row + row_step, height - 1), max(column + column_step, 0)]
    second = luminosity[max(row - row_step, 0), min(column - column_step, width - 1)]
    if abs(center - first) < abs(center - second):
        row_step, column_step, first = -row_step, -column_step, second
    along_row, along_column = (0, 1) if is_horizontal else (-1, 0)
    nearest_distance, nearest_value, total = _SEARCH_STEPS + 2, center, 0
    for direction in (1, -1):  # an end in the positive direction is preferred
        value = center
        distance = 1
        for _ in range(_SEARCH_STEPS):
            r = min(max(row + direction * distance * along_row, 0), height - 1)
            c = min(max(column + direction * distance * along_column, 0), width - 1)
            value = luminosity[r, c]
            across = luminosity[
                min(max(r + row_step, 0), height - 1), min(max(c + column_step, 0), width - 1)
            ]
            if abs(across - first) > abs(across - center) or abs(value - center) > abs(
                value - first
            ):
                break
            distance += 1
        total += distance
        if distance < nearest_distance:
            nearest_distance, nearest_value = distance, value
    if abs(nearest_value - first) < abs(nearest_value - center):
        return row_step, column_step, np.float32(0.5) - np.float32(nearest_distance) / total
    return row_step, column_step, np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _contrasts(here, up, down, contrasts):  # type: ignore[no-untyped-def]
    """Write the range of luminosity among each pixel and its neighbors; 0 if it is too small.

    Args:
        here: Luminosities of the row, one more at each end. Shape (width + 2,).
        up: Luminosities of the row above. Shape (width,).
        down: Luminosities of the row below. Shape (width,).
        contrasts: Output. Shape (width,).
    """
    for k in range(len(contrasts)):
        w, c, e, n, s = here[k], here[k + 1], here[k + 2], up[k], down[k]
        lowest = w if w < c else c
        lowest = e if e < lowest else lowest
        lowest = n if n < lowest else lowest
        lowest = s if s < lowest else lowest
        highest = w if w > c else c
        highest = e if e > highest else highest
        highest = n if n > highest else highest
        highest = s if s > highest else highest
        least = _RELATIVE_CONTRAST * highest
        least = least if least > _HARD_CONTRAST else _HARD_CONTRAST
        contrast = highest - lowest
        contrasts[k] = np.float32(0.0) if contrast < least else contrast


@njit(cache=True, nogil=True, error_model="numpy")
def _smooth(color, luminosity, smooth):  # type: ignore[no-untyped-def]
    """Write the pixels that are smoothed, see `smooth_edges`."""
    height, width = luminosity.shape
    padded = np.empty(width + 2, np.float32)
    contrasts = np.empty(width, np.float32)
    for row in range(height):
        above, below = max(row - 1, 0), min(row + 1, height - 1)
        here, up, down = luminosity[row], luminosity[above], luminosity[below]
        padded[0], padded[width + 1] = here[0], here[width - 1]
        padded[1 : width + 1] = here
        _contrasts(padded, up, down, contrasts)
        for column in range(width):
            contrast = contrasts[column]
            if contrast == 0.0:
                continue
            left, right = max(column - 1, 0), min(column + 1, width - 1)
            c, n, s, w, e = here[column], up[column], down[column], here[left], here[right]
            nw, ne, sw, se = up[left], up[right], down[left], down[right]
            deviation = abs(np.float32(0.25) * (n + s + w + e) - c) / contrast
            blend = max(np.float32(0.0), deviation - _SUBPIXEL_CONTRAST)
            blend = min(_SUBPIXEL_BLEND_LIMIT, blend / (np.float32(1.0) - _SUBPIXEL_CONTRAST))
            two = np.float32(2.0)
            vertical = abs(nw - two * n + ne) + two * abs(w - two * c + e) + abs(sw - two * s + se)
            horizontal = (
                abs(nw - two * w + sw) + two * abs(n - two * c + s) + abs(ne - two * e + se)
            )
            is_horizontal = horizontal >= vertical
            row_step, column_step, shift = _edge_shift(luminosity, row, column, is_horizontal)
            r = min(max(row + row_step, 0), height - 1)
            q = min(max(column + column_step, 0), width - 1)
            for k in range(3):
                value = np.float32(color[row, column, k])
                edge = value + shift * (np.float32(color[r, q, k]) - value)
                total = np.float32(0.0)
                for i in (above, row, below):
                    for j in (left, column, right):
                        total += np.float32(color[i, j, k])
                mean = total / np.float32(9.0)
                smooth[row, column, k] = np.uint8(edge + blend * (mean - edge) + np.float32(0.5))


def smooth_edges(color: NDArray[np.uint8], luminosity: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return an image with smooth edges.

    Args:
        color: The image. Shape (height, width, 3).
        luminosity: Scratch memory. Shape (height, width).

    Returns:
        New image. Shape (height, width, 3).
    """
    _luminosity(color, _LUMINOSITY.astype(np.float32), luminosity)
    smooth = color.copy()
    _smooth(color, luminosity, smooth)
    return smooth
