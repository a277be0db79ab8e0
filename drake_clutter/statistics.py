"""Confidence intervals with a level of 95 %."""

from bisect import bisect_left
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.optimize import brentq

CONFIDENCE_LEVEL = 0.95
"""Probability that an interval contains the true value."""
QUANTILES = (0.025, 0.975)
"""Quantiles between which an interval extends."""
RATIO_TOLERANCE = 1e-7
"""Error of the bounds of a mean or ratio, as a fraction of its range."""


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion (Wilson 1927).

    Args:
        successes: Number of successes.
        count: Number of trials; 0 results in the interval from 0 to 1.
    """
    if count == 0:
        return 0.0, 1.0
    from scipy.stats import binomtest  # imported late: it takes long

    interval = binomtest(successes, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float], low: float, high: float) -> tuple[float, float] | None:
    """Return Gaffke's interval of the mean of a bounded quantity (Gaffke 2005).

    It is conjectured to hold for any number of values and any distribution between the bounds
    (Learned-Miller and Thomas 2020, arXiv:1905.06208), where the normal approximation is far too
    narrow for few values. For values of 0 and 1 it is the interval of Clopper and Pearson (1934).

    Args:
        values: Independent values from `low` to `high`.
        low: Smallest possible value, which must not be chosen from the values.
        high: Largest possible value, likewise.

    Returns:
        The interval; None without values.
    """
    return ratio_interval(values, [1] * len(values), (low, 1), (high, 1))


def ratio_interval(
    numerators: Sequence[float],
    denominators: Sequence[float],
    lowest: tuple[float, float],
    highest: tuple[float, float],
) -> tuple[float, float] | None:
    """Return Gaffke's interval of a ratio of two means; see `mean_interval`.

    A ratio r is in the interval if the mean of `numerator - r * denominator` may be 0. The two
    bounds are quantiles of the ratio with random weights of the pairs, uniform on the simplex,
    where `lowest` or `highest` is one pair more.

    Args:
        numerators: Numerator of each pair; the pairs are independent.
        denominators: Denominator of each pair, positive.
        lowest: Possible pair for which `numerator - r * denominator` is smallest, for any r in
            question.
        highest: Possible pair for which it is largest.

    Returns:
        The interval; None without pairs.
    """
    if not len(numerators):
        return None
    pairs, counts = np.unique(
        np.array([numerators, denominators], float), axis=1, return_counts=True
    )
    low, high = (
        _weighted_ratio_quantile(np.column_stack([pairs, extreme]), np.append(counts, 1), quantile)
        for extreme, quantile in zip((lowest, highest), QUANTILES, strict=True)
    )
    return low, high


def quantile_interval(
    samples: Sequence[Sequence[float]], quantile: float
) -> tuple[float | None, float | None]:
    """Return the interval of a quantile of values that come in independent samples.

    It holds the values for which the interval of the share of smaller values contains the quantile
    (Woodruff 1952); see `ratio_interval`.

    Args:
        samples: Values of each sample, which may depend on each other.
        quantile: The quantile, between 0 and 1.

    Returns:
        The bounds; None where the samples are too few to tell one.
    """
    arrays = [np.sort(sample) for sample in samples if len(sample)]
    if not arrays:
        return None, None
    totals = np.array([len(array) for array in arrays], float)
    most = totals.max()
    candidates = np.unique(np.concatenate(arrays))

    def probability(value: float, extreme: float) -> float:
        """Return that of a share below the quantile, with one more sample of an extreme share."""
        counts = [np.searchsorted(array, value, side="right") for array in arrays]
        excess = np.append(counts - quantile * totals, (extreme - quantile) * most)
        scales, repeats = np.unique(excess, return_counts=True)
        if scales[0] >= 0 or scales[-1] <= 0:
            return float(scales[0] < 0)
        return _negative_sum_probability(scales, repeats)

    def first(is_past: Callable[[float], bool]) -> float | None:
        """Return the smallest candidate that is past a bound, which all that follow are, too."""
        k = bisect_left(candidates, True, key=is_past)
        return float(candidates[k]) if k < len(candidates) else None

    lower: float | None = None
    if probability(-np.inf, 1.0) > QUANTILES[1]:
        lower = first(lambda value: probability(value, 1.0) <= QUANTILES[1])
    return lower, first(lambda value: probability(value, 0.0) < QUANTILES[0])


def _weighted_ratio_quantile(
    pairs: NDArray[np.float64], counts: NDArray[np.int_], quantile: float
) -> float:
    """Return a quantile of the ratio of two means with weights that are uniform on the simplex.

    Args:
        pairs: Different pairs of numerator and denominator. Shape (2, n).
        counts: How often each pair occurs. Shape (n,).
        quantile: Probability of a smaller ratio.
    """
    numerators, denominators = pairs
    ratios = numerators / denominators
    low, high = float(ratios.min()), float(ratios.max())
    if low == high:
        return low

    def excess(ratio: float) -> float:
        return _negative_sum_probability(numerators - ratio * denominators, counts) - quantile

    return float(brentq(excess, low, high, xtol=RATIO_TOLERANCE * (high - low)))


def _negative_sum_probability(scales: NDArray[np.float64], counts: NDArray[np.int_]) -> float:
    """Return the probability that a sum of scaled exponential variables is negative.

    Uniform weights on the simplex are proportional to independent exponential variables. The
    characteristic function of the sum is inverted as by Imhof (1961, eq. 3.2), with two degrees of
    freedom for each variable.

    Args:
        scales: Scales of the variables, some negative and some positive. Shape (n,).
        counts: Number of variables of each scale. Shape (n,).
    """
    scales = scales / np.sqrt(counts @ scales**2)

    def integrand(u: float) -> float:
        angle = counts @ np.arctan(u * scales)
        modulus = np.exp(-0.5 * (counts @ np.log1p((u * scales) ** 2)))
        return float(np.sin(angle) * modulus / u)

    integral, _ = quad(integrand, 0, np.inf, limit=500)
    return float(0.5 - integral / np.pi)
