"""Confidence intervals at 95 %."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest, norm, sem

CONFIDENCE_LEVEL = 0.95
QUANTILES = (0.025, 0.975)


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the interval of a proportion (Wilson 1927); all of 0 to 1 if nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    interval = binomtest(successes, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Return the interval of a mean by the normal approximation; None for fewer than two values."""
    if len(values) < 2:
        return None
    half_width = float(norm.ppf(QUANTILES[1]) * sem(values))
    return float(np.mean(values)) - half_width, float(np.mean(values)) + half_width


def bootstrap_ratio_interval(
    numerators: Sequence[float],
    denominators: Sequence[float],
) -> tuple[float, float]:
    """Return the interval of a ratio of sums over scenes, by bootstrap."""
    resampled = np.random.default_rng(0).integers(len(numerators), size=(2000, len(numerators)))
    ratios = np.asarray(numerators)[resampled].sum(axis=1) / np.asarray(denominators)[
        resampled
    ].sum(
        axis=1,
    )
    low, high = np.quantile(ratios, QUANTILES).tolist()
    return low, high
