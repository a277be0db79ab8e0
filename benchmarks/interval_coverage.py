"""Calculate the coverage of confidence intervals of means for few values.

    python benchmarks/interval_coverage.py --out benchmarks/results/interval_coverage.json

The coverage is the probability that the interval of independent values contains their mean. It is
summed over all samples of a distribution with few values, so only the bootstrap is random.
"""

from collections.abc import Callable, Sequence
from itertools import combinations_with_replacement

import numpy as np
from scipy.stats import multinomial, sem, t

from drake_clutter.statistics import CONFIDENCE_LEVEL, QUANTILES, mean_interval, wilson_interval
from training.results_file import ResultsFile, Row, provenance
from training.script import ResultsOption, SeedOption, format_number, print_table, run_script

DISTRIBUTIONS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "0 or 1, p = 0.5": ((0.0, 1.0), (0.5, 0.5)),
    "0 or 1, p = 0.05": ((0.0, 1.0), (0.95, 0.05)),
    "mostly 0": ((0.0, 0.25, 1.0), (0.85, 0.1, 0.05)),
    "mostly 1": ((0.0, 0.75, 1.0), (0.02, 0.08, 0.9)),
    "four equally probable values": ((0.0, 1 / 3, 2 / 3, 1.0), (0.25, 0.25, 0.25, 0.25)),
}
"""Values from 0 to 1, and the probability of each."""
COUNTS = (2, 3, 5, 20)
"""Numbers of values."""
NUM_RESAMPLES = 2000
"""Number of samples of the bootstrap."""

Interval = tuple[float, float]


def normal_interval(sample: Sequence[float]) -> Interval:
    """Return the mean with 1.96 standard errors on either side."""
    half_width = 1.959964 * float(sem(sample))
    return float(np.mean(sample)) - half_width, float(np.mean(sample)) + half_width


def student_interval(sample: Sequence[float]) -> Interval:
    """Return the interval of Student's t distribution."""
    quantile = float(t.ppf(QUANTILES[1], len(sample) - 1))
    half_width = quantile * float(sem(sample))
    return float(np.mean(sample)) - half_width, float(np.mean(sample)) + half_width


def bootstrap_interval(sample: Sequence[float], seed: int) -> Interval:
    """Return the percentile interval of the bootstrap (Efron 1979)."""
    rng = np.random.default_rng(seed)
    means = rng.choice(sample, (NUM_RESAMPLES, len(sample))).mean(axis=1)
    low, high = np.quantile(means, QUANTILES)
    return float(low), float(high)


def gaffke_interval(sample: Sequence[float]) -> Interval:
    """Return the interval of `drake_clutter.statistics.mean_interval`."""
    interval = mean_interval(sample, 0, 1)
    assert interval is not None
    return interval


def measure(name: str, count: int, seed: int) -> Row:
    """Return coverage and mean width of every kind of interval.

    Args:
        name: Name of the distribution.
        count: Number of values of a sample.
        seed: Seed of the bootstrap.
    """
    values, probabilities = DISTRIBUTIONS[name]
    methods: dict[str, Callable[[Sequence[float]], Interval]] = {
        "normal": normal_interval,
        "student": student_interval,
        "bootstrap": lambda sample: bootstrap_interval(sample, seed),
        "gaffke": gaffke_interval,
    }
    if values == (0.0, 1.0):
        methods["wilson"] = lambda sample: wilson_interval(round(sum(sample)), count)
    mean = float(np.dot(values, probabilities))
    coverage = dict.fromkeys(methods, 0.0)
    width = dict.fromkeys(methods, 0.0)
    for sample in combinations_with_replacement(values, count):
        numbers = [sample.count(value) for value in values]
        probability = float(multinomial.pmf(numbers, count, probabilities))
        for method, calculate in methods.items():
            low, high = calculate(sample)
            # The bounds of a sample of equal values are rounded.
            coverage[method] += probability * (low - 1e-9 <= mean <= high + 1e-9)
            width[method] += probability * (high - low)
    return {
        "distribution": name,
        "values": list(values),
        "probabilities": list(probabilities),
        "count": count,
        "coverage": coverage,
        "mean_width": width,
    }


def main(seed: SeedOption = 0, out: ResultsOption = None) -> None:
    """Calculate the coverage for every distribution and number of values."""
    header = {"confidence_level": CONFIDENCE_LEVEL, "seed": seed, **provenance()}
    rows = [measure(name, count, seed) for name in DISTRIBUTIONS for count in COUNTS]
    if out is not None:
        ResultsFile(out, header, ("distribution", "count")).add(*rows)
    print_table(
        [
            {"distribution": row["distribution"], "values": str(row["count"])}
            | {
                method: format_number(row["coverage"].get(method), 3)
                for method in ("normal", "student", "bootstrap", "wilson", "gaffke")
            }
            for row in rows
        ]
    )


if __name__ == "__main__":
    run_script(main)
