"""Confidence intervals."""

import json
import math

import pytest

from drake_clutter.resources import resource_path
from drake_clutter.statistics import bootstrap_ratio_interval, mean_interval, wilson_interval


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


def test_mean_interval() -> None:
    """The standard deviation is 2, so the half width for four values is 1.96 * 2 / 2."""
    assert mean_interval([1.0, 1.0, 4.4641016, 4.4641016]) == pytest.approx(
        (2.7320508 - 1.959964, 2.7320508 + 1.959964)
    )
    assert mean_interval([3.0]) is None
    assert mean_interval([]) is None


def test_bootstrap_ratio_interval() -> None:
    """The interval of a constant ratio has no width; other intervals contain the ratio."""
    assert bootstrap_ratio_interval([1, 2, 3], [2, 4, 6]) == (0.5, 0.5)
    low, high = bootstrap_ratio_interval([1, 2, 3, 0], [2, 2, 3, 2])
    assert 0 < low < 6 / 9 < high <= 1


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
