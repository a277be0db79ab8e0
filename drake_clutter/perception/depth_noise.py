"""A stereo camera's depth, made of rendered depth: noise, steps, shadows and holes, as of a RealSense D435."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import D435_FOCAL_LENGTH


@dataclass(frozen=True)
class DepthNoise:
    """What a stereo camera makes of depth.

    It measures disparity, f b / z in pixels, so an error of the disparity becomes one of the depth that grows with its square:
    sigma_z = z^2 sigma_disparity / (f b) (Keselman et al. 2017, "Intel RealSense stereoscopic depth cameras", 3.4).

    Attributes:
        focal_length: px, f.
        baseline: m, b; the right eye is to the right of the one whose image this is, so shadows fall to the left.
        disparity_noise: px, standard deviation of a single match (Intel's guide to tuning the D400). Matching smooths it over
            three pixels each way, which leaves 0.375 of it: 1.0 mm at 1 m, 2.5 mm at 1.6 m.
        disparity_step: px, of which the disparity is a multiple.
        shadow_edge_noise: px, standard deviation of how much of a shadow is filled from beside it.
        mean_speckle_count: holes elsewhere in an image, on average.
        max_speckle_radius: px, of the largest.
    """

    focal_length: float = D435_FOCAL_LENGTH
    baseline: float = 0.050
    disparity_noise: float = 0.08
    disparity_step: float = 1 / 32
    shadow_edge_noise: float = 1.0
    mean_speckle_count: float = 8.0
    max_speckle_radius: float = 3.0


D435_DEPTH_NOISE = DepthNoise()
_LEFT_BY_SMOOTHING = 0.375
"""Of the standard deviation."""


def add_depth_noise(
    depth: NDArray[np.float32], rng: np.random.Generator, noise: DepthNoise = D435_DEPTH_NOISE
) -> NDArray[np.float32]:
    """Depth as a stereo camera measures it.

    Args:
        depth: (H, W) m, as rendered; inf or 0 where nothing is seen.
        rng: of the noise.
        noise: how much.

    Returns:
        (H, W) m, 0 where nothing is measured.
    """
    seen = np.isfinite(depth) & (depth > 0)
    fb = np.float32(noise.focal_length * noise.baseline)
    disparity = np.zeros_like(depth)
    np.divide(fb, depth, out=disparity, where=seen)
    error = _smooth(rng.standard_normal((depth.shape[0] + 2, depth.shape[1] + 2), np.float32))
    shadow = _hidden_from_right_eye(disparity) > np.abs(error) * (
        noise.shadow_edge_noise / _LEFT_BY_SMOOTHING
    )
    steps = np.round((disparity + noise.disparity_noise * error) / noise.disparity_step)
    measured = np.asarray(steps * noise.disparity_step, np.float32)
    measured[~seen | shadow | (measured <= 0)] = np.inf
    _punch_speckles(measured, rng, noise)
    return np.asarray(fb / measured, np.float32)


def _smooth(white: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) of (H + 2, W + 2), with the weights 1, 2, 1 each way."""
    down = white[:-2] + 2 * white[1:-1] + white[2:]
    return np.asarray((down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]) / 16)


def _hidden_from_right_eye(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) px, how far each point lies behind the left rim, in the right eye's image, of what is before it; < 0: it is seen."""
    column = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    rim = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.full_like(disparity, -np.inf)
    hidden[:, :-1] = column[:, :-1] - rim[:, 1:]
    return hidden


def _punch_speckles(
    measured: NDArray[np.float32], rng: np.random.Generator, noise: DepthNoise
) -> None:
    height, width = measured.shape
    reach = math.ceil(noise.max_speckle_radius)
    for _ in range(rng.poisson(noise.mean_speckle_count)):
        row, column, radius = (
            rng.integers(height),
            rng.integers(width),
            rng.uniform(0.5, noise.max_speckle_radius),
        )
        rows, columns = (
            slice(max(0, row - reach), row + reach + 1),
            slice(max(0, column - reach), column + reach + 1),
        )
        y, x = np.ogrid[
            : min(rows.stop, height) - rows.start, : min(columns.stop, width) - columns.start
        ]
        measured[rows, columns][
            np.hypot(y + rows.start - row, x + columns.start - column) <= radius
        ] = np.inf
