"""Depth noise of an active stereo camera such as the RealSense D435.

Rendered depth gets disparity noise, disparity quantization, occlusion shadows and speckle holes.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import D435_FOCAL_LENGTH


@dataclass(frozen=True)
class DepthNoise:
    """Parameters of a stereo camera's depth noise.

    A stereo camera measures the disparity f b / z, so a disparity error causes a depth error that
    grows with the square of the depth: sigma_z = z^2 sigma_disparity / (f b) (Keselman et al.
    2017, "Intel RealSense stereoscopic depth cameras", Sec. 3.4).

    Attributes:
        focal_length: f [px].
        baseline: b [m]. The second imager is to the right of the imager of the image, so
            occlusion shadows fall to the left of objects.
        disparity_noise: Standard deviation of the disparity of a single match [px] (Intel, "Best
            known methods for tuning Intel RealSense D400 depth cameras for best performance").
            Smoothing over three pixels in both directions leaves 0.375 of it, which is 1.0 mm at
            a depth of 1 m and 2.5 mm at 1.6 m.
        disparity_step: Disparities are multiples of this [px].
        shadow_edge_noise: Standard deviation of the width of the part of a shadow that is filled
            from its border [px].
        mean_speckle_count: Mean number of speckle holes in an image.
        max_speckle_radius: Largest radius of a speckle hole [px].
    """

    focal_length: float = D435_FOCAL_LENGTH
    baseline: float = 0.050
    disparity_noise: float = 0.08
    disparity_step: float = 1 / 32
    shadow_edge_noise: float = 1.0
    mean_speckle_count: float = 8.0
    max_speckle_radius: float = 3.0


D435_DEPTH_NOISE = DepthNoise()
"""Noise of the RealSense D435."""
SMOOTHED_STANDARD_DEVIATION = 0.375
"""Standard deviation of unit white noise after `_smooth`: (1 + 4 + 1) / 16."""


def add_depth_noise(
    depth: NDArray[np.float32], rng: np.random.Generator, noise: DepthNoise = D435_DEPTH_NOISE
) -> NDArray[np.float32]:
    """Return a rendered depth image as a stereo camera would measure it.

    Args:
        depth: Rendered depth [m]; inf or 0 where there is no surface. Shape (H, W).
        rng: Random generator of the noise.
        noise: Parameters of the noise.

    Returns:
        Measured depth [m]; 0 where there is no measurement. Shape (H, W).
    """
    valid = np.isfinite(depth) & (depth > 0)
    focal_length_times_baseline = np.float32(noise.focal_length * noise.baseline)
    disparity = np.zeros_like(depth)
    np.divide(focal_length_times_baseline, depth, out=disparity, where=valid)
    error = _smooth(rng.standard_normal((depth.shape[0] + 2, depth.shape[1] + 2), np.float32))
    filled_width = np.abs(error) * (noise.shadow_edge_noise / SMOOTHED_STANDARD_DEVIATION)
    shadow = _distance_behind_occluder(disparity) > filled_width
    steps = np.round((disparity + noise.disparity_noise * error) / noise.disparity_step)
    measured = np.asarray(steps * noise.disparity_step, np.float32)
    measured[~valid | shadow | (measured <= 0)] = np.inf
    _add_speckle_holes(measured, rng, noise)
    return np.asarray(focal_length_times_baseline / measured, np.float32)


def _smooth(white_noise: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return an (H + 2, W + 2) image filtered by the weights 1, 2, 1 in both directions.

    Returns:
        The filtered image without its border. Shape (H, W).
    """
    vertical = white_noise[:-2] + 2 * white_noise[1:-1] + white_noise[2:]
    return np.asarray((vertical[:, :-2] + 2 * vertical[:, 1:-1] + vertical[:, 2:]) / 16)


def _distance_behind_occluder(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how far each point is behind an occluding edge in the right image.

    Args:
        disparity: Disparity of each pixel of the left image [px]. Shape (H, W).

    Returns:
        Distance in the right image from the left edge of the nearest occluder to the point [px];
        negative where the right imager sees the point. Shape (H, W).
    """
    right_column = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    occluding_edge = np.minimum.accumulate(right_column[:, ::-1], axis=1)[:, ::-1]
    occlusion = np.full_like(disparity, -np.inf)
    occlusion[:, :-1] = right_column[:, :-1] - occluding_edge[:, 1:]
    return occlusion


def _add_speckle_holes(
    disparity: NDArray[np.float32], rng: np.random.Generator, noise: DepthNoise
) -> None:
    """Set the disparity to infinity, which is a depth of 0, in small random disks."""
    height, width = disparity.shape
    reach = math.ceil(noise.max_speckle_radius)
    for _ in range(rng.poisson(noise.mean_speckle_count)):
        row = rng.integers(height)
        column = rng.integers(width)
        radius = rng.uniform(0.5, noise.max_speckle_radius)
        rows = slice(max(0, row - reach), row + reach + 1)
        columns = slice(max(0, column - reach), column + reach + 1)
        num_rows = min(rows.stop, height) - rows.start
        num_columns = min(columns.stop, width) - columns.start
        y, x = np.ogrid[:num_rows, :num_columns]
        distance = np.hypot(y + rows.start - row, x + columns.start - column)
        disparity[rows, columns][distance <= radius] = np.inf
