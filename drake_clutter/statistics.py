"""Confidence intervals with a level of 95 %."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest, norm, sem

CONFIDENCE_LEVEL = 0.95
"""Probability that an interval contains the true value."""
QUANTILES = (0.025, 0.975)
"""Quantiles between which an interval extends."""
NUM_RESAMPLES = 2000
"""Number of bootstrap samples."""


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion (Wilson 1927).

    Args:
        successes: Number of successes.
        count: Number of trials; 0 results in the interval from 0 to 1.
    """
    if count == 0:
        return 0.0, 1.0
    interval = binomtest(successes, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the interval of a mean by the normal approximation; None for fewer than two values."""
    if len(values) < 2:
        return None
    half_width = float(norm.ppf(QUANTILES[1]) * sem(values))
    mean = float(np.mean(values))
    return mean - half_width, mean + half_width


def bootstrap_ratio_interval(
    numerators: Sequence[float], denominators: Sequence[float]
) -> tuple[float, float]:
    """Return the percentile bootstrap interval of a ratio of sums (Efron 1979).

    Scenes are resampled with a constant seed. `scipy.stats.bootstrap` would draw other samples, and
    change the intervals of published results.

    Args:
        numerators: Summand of each scene in the numerator.
        denominators: Summand of each scene in the denominator.
    """
    num_scenes = len(numerators)
    resampled = np.random.default_rng(0).integers(num_scenes, size=(NUM_RESAMPLES, num_scenes))
    numerator = np.asarray(numerators)[resampled].sum(axis=1)
    denominator = np.asarray(denominators)[resampled].sum(axis=1)
    low, high = np.quantile(numerator / denominator, QUANTILES).tolist()
    return low, high
