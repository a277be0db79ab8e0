"""Confidence intervals."""

import json
import math
from functools import cache
from itertools import combinations_with_replacement

import numpy as np
import pytest
from conftest import rng
from scipy.stats import binomtest, multinomial, sem, t

from drake_clutter.resources import resource_path
from drake_clutter.statistics import (
    mean_interval,
    quantile_interval,
    ratio_interval,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [
        # Newcombe 1998, Table I, method 3, and the closed forms for extreme proportions.
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (20, 20, 0.8389, 1.0),
        (0, 0, 0.0, 1.0),
    ],
)
def test_wilson_interval(successes: int, count: int, low: float, high: float) -> None:
    assert wilson_interval(successes, count) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(
    ("successes", "count"), [(0, 1), (1, 2), (0, 2), (2, 2), (3, 10), (1, 300), (700, 1000)]
)
def test_interval_of_a_mean_is_exact_for_proportions(successes: int, count: int) -> None:
    """Clopper and Pearson 1934, shifted and scaled."""
    values = [7.0] * successes + [3.0] * (count - successes)
    exact = binomtest(successes, count).proportion_ci(0.95, method="exact")
    expected = (3 + 4 * exact.low, 3 + 4 * exact.high)
    assert mean_interval(values, 3, 7) == pytest.approx(expected, rel=0, abs=2e-6)


def test_interval_of_a_mean_is_that_of_student_for_many_values() -> None:
    values = rng(1).uniform(0.2, 0.8, 2000)
    expected = t.interval(0.95, len(values) - 1, values.mean(), sem(values))
    assert mean_interval(list(values), 0, 1) == pytest.approx(expected, rel=0, abs=0.001)


@pytest.mark.parametrize("probabilities", [(0.8, 0.1, 0.1), (0.02, 0.08, 0.9), (0.3, 0.4, 0.3)])
def test_interval_of_a_mean_contains_it_in_95_percent(
    probabilities: tuple[float, ...],
) -> None:
    """The probability is summed over all samples of 0, 1 and 2; so is that of the normal method."""
    mean = probabilities[1] + 2 * probabilities[2]
    covered_by_normal = []
    for count in (1, 2, 3, 5):
        covered = covered_normal = 0.0
        for sample in combinations_with_replacement((0, 1, 2), count):
            numbers = [sample.count(value) for value in (0, 1, 2)]
            probability = multinomial.pmf(numbers, count, probabilities)
            low, high = interval_of_three_values(sample)
            covered += probability * (low <= mean <= high)
            half_width = 1.96 * sem(sample) if count > 1 else 0.0
            covered_normal += probability * (abs(np.mean(sample) - mean) <= half_width)
        assert covered >= 0.95
        covered_by_normal.append(covered_normal)
    assert max(covered_by_normal) < 0.95


@cache
def interval_of_three_values(sample: tuple[int, ...]) -> tuple[float, float]:
    interval = mean_interval(sample, 0, 2)
    assert interval is not None
    return interval


def test_interval_of_a_ratio() -> None:
    """One pair (3, 4) with a uniform weight w, and the rest at (0, 10) or (10, 10)."""
    low, high = 0.025 * 3 / (0.025 * 4 + 0.975 * 10), (0.025 * 3 + 9.75) / (0.025 * 4 + 9.75)
    interval = ratio_interval([3], [4], (0, 10), (10, 10))
    assert interval == pytest.approx((low, high), rel=0, abs=1e-6)


def test_interval_of_a_ratio_with_equal_denominators_is_that_of_a_mean() -> None:
    means = mean_interval([0, 1, 4, 4], 0, 5)
    assert means is not None
    ratios = ratio_interval([0, 1, 4, 4], [5] * 4, (0, 5), (5, 5))
    assert ratios == pytest.approx([bound / 5 for bound in means], rel=0, abs=1e-6)


def test_intervals_without_values() -> None:
    assert mean_interval([], 0, 1) is None
    assert ratio_interval([], [], (0, 1), (1, 1)) is None
    assert mean_interval([2, 2], 2, 2) == (2, 2)


@pytest.mark.parametrize(("successes", "count"), [(0, 7), (3, 7), (7, 7), (490, 1000)])
def test_wilson_interval_is_the_closed_form(successes: int, count: int) -> None:
    """Wilson 1927: the p for which the normal test statistic of the proportion is +-z."""
    z = 1.959963984540054
    center = (successes + z * z / 2) / (count + z * z)
    spread = successes * (count - successes) / count + z * z / 4
    half_width = z / (count + z * z) * math.sqrt(spread)
    expected = (center - half_width, center + half_width)
    assert wilson_interval(successes, count) == pytest.approx(expected, rel=0, abs=1e-15)


def test_intervals_of_shipped_results_are_reproduced() -> None:
    results = json.loads(resource_path("training/results/detector_color.json").read_text())
    for row in results["rows"].values():
        for recall in [row["in_view"], *row["recall_by_visible_share"].values()]:
            successes = round(recall["recall"] * recall["objects"])
            interval = wilson_interval(successes, recall["objects"])
            assert interval == pytest.approx(recall["ci95"], rel=0, abs=1e-15)


@pytest.mark.parametrize(
    ("count", "quantile", "low", "high"),
    [
        # Conover 1999, Practical Nonparametric Statistics, section 3.2: ranks from binomial tails.
        (20, 0.5, 6, 15),
        (6, 0.5, 1, 6),
        (5, 0.5, None, None),
        (100, 0.95, 90, 100),
        (59, 0.95, 52, None),
    ],
)
def test_interval_of_a_quantile_is_that_of_order_statistics(
    count: int, quantile: float, low: int | None, high: int | None
) -> None:
    values = rng(2).permutation(np.arange(1, count + 1)).tolist()
    assert quantile_interval([[value] for value in values], quantile) == (low, high)


def test_interval_of_a_quantile_takes_samples_as_wholes() -> None:
    """Equal values of a sample tell no more than one of them, opposite ones more."""
    once = quantile_interval([[k] for k in range(20)], 0.5)
    assert quantile_interval([[k, k, k] for k in range(20)], 0.5) == once
    # Of the six samples from 7 to 12 all values are on one side: 1 / 2^6 < 0.025 < 1 / 2^4.
    assert quantile_interval([[k, 19 - k] for k in range(20)], 0.5) == (7, 12)
    assert quantile_interval([], 0.5) == quantile_interval([[]], 0.5) == (None, None)
