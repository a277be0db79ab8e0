"""Statistics of the features of a LeRobot data set, by which policies normalize.

Each statistic has the axes of its feature: (n,) of a vector, (3, 1, 1) of images in [0, 1].
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

Stats = Mapping[str, NDArray[np.float64]]
"""`min`, `max`, `mean`, `std`, `count` and quantiles of a feature by name."""
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""Quantiles that LeRobot stores."""
MAX_IMAGES = 100
"""Largest number of images of an episode that its statistics cover, evenly chosen."""
MAX_IMAGE_SIDE = 150
"""Pixels of a side beyond which only every second, third, ... pixel counts."""


def vector_stats(values: NDArray[np.float64]) -> Stats:
    """Return the statistics of the rows of an array. Shape of each (n,).

    Args:
        values: Values. Shape (m, n).
    """
    return _stats(values, len(values))


def image_stats(images: NDArray[np.uint8]) -> Stats:
    """Return the statistics of the channels of images, scaled to [0, 1]. Shape of each (3, 1, 1).

    Args:
        images: Images. Shape (f, height, width, 3).
    """
    count = min(len(images), MAX_IMAGES)
    chosen = images[np.linspace(0, len(images) - 1, count).round().astype(int)]
    stride = max(1, max(chosen.shape[1:3]) // MAX_IMAGE_SIDE)
    stats = _stats(chosen[:, ::stride, ::stride].reshape(-1, 3) / 255.0, count)
    return {
        name: value if name == "count" else value.reshape(3, 1, 1) for name, value in stats.items()
    }


def _stats(values: NDArray[np.float64], count: int) -> Stats:
    """Return the statistics of rows; `count` of them count as one observation each."""
    quantiles = np.quantile(values, QUANTILES, axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([count]),
        **{f"q{round(100 * q):02d}": row for q, row in zip(QUANTILES, quantiles, strict=True)},
    }


def combine_stats(parts: Sequence[Stats]) -> Stats:
    """Return the statistics of several episodes together.

    Mean and variance are exact (Chan, Golub and LeVeque 1983, eq. 2.1). A quantile is the mean of
    those of the episodes, weighted by their counts, as in LeRobot.
    """
    counts = np.array([float(part["count"][0]) for part in parts])
    weights = counts / counts.sum()

    def average(name: str) -> NDArray[np.float64]:
        return np.tensordot(weights, np.stack([part[name] for part in parts]), axes=1)

    mean = average("mean")
    spread = np.stack([part["std"] ** 2 + (part["mean"] - mean) ** 2 for part in parts])
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": mean,
        "std": np.sqrt(np.tensordot(weights, spread, axes=1)),
        "count": np.array([round(counts.sum())]),
        **{name: average(name) for name in (f"q{round(100 * q):02d}" for q in QUANTILES)},
    }
