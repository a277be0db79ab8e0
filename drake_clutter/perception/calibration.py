"""Calibration of the class probabilities of detections by a temperature.

Guo et al. 2017, "On calibration of modern neural networks".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

MIN_PROBABILITY = 1e-6
"""Probabilities below are taken for this one: no class is excluded by an image alone."""
MAX_TEMPERATURE = 20.0
"""Largest temperature that is fitted; the smallest is its inverse."""
NUM_BINS = 10
"""Number of bins of a reliability diagram."""


def apply_temperature(probabilities: Mapping[str, float], temperature: float) -> dict[str, float]:
    """Return class probabilities whose logarithms are divided by a temperature.

    Args:
        probabilities: Probability of each class by its name.
        temperature: Above 1, the probabilities become more equal.
    """
    if not probabilities:
        return {}
    scaled = _scaled(np.array([list(probabilities.values())]), temperature)[0]
    return dict(zip(probabilities, scaled.tolist(), strict=True))


def _scaled(probabilities: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Return rows of class probabilities with a temperature, see `apply_temperature`."""
    # Classes that are not in question stay at 0.
    clipped = np.where(probabilities > 0, np.maximum(probabilities, MIN_PROBABILITY), 0.0)
    powers = clipped ** (1 / temperature)
    return np.asarray(powers / powers.sum(axis=1, keepdims=True))


@dataclass(frozen=True)
class ClassifiedDetection:
    """A detection with its true class.

    Attributes:
        probabilities: Probability of each class by its name, and of no object by "".
        reported_class: Class of the detection.
        true_class: Class of the object that it is matched to; "" if there is none.
    """

    probabilities: Mapping[str, float]
    reported_class: str
    true_class: str


def negative_log_likelihood(detections: Sequence[ClassifiedDetection], temperature: float) -> float:
    """Return the mean negative log likelihood of the true classes."""
    likelihoods = [
        apply_temperature(d.probabilities, temperature).get(d.true_class, 0.0) for d in detections
    ]
    return float(-np.log(np.maximum(likelihoods, MIN_PROBABILITY)).mean())


def fit_temperature(detections: Sequence[ClassifiedDetection]) -> float:
    """Return the temperature with the largest likelihood of the true classes."""
    bound = float(np.log(MAX_TEMPERATURE))
    result = minimize_scalar(
        lambda log: negative_log_likelihood(detections, float(np.exp(log))),
        bounds=(-bound, bound),
        method="bounded",
    )
    return float(np.exp(result.x))


@dataclass(frozen=True)
class ReliabilityBin:
    """Detections whose probability of the reported class is in an interval.

    Attributes:
        lower: Lower bound of the probability.
        upper: Upper bound of the probability.
        count: Number of detections.
        mean_probability: Their mean probability; NaN without any.
        accuracy: Fraction of them with the right class; NaN without any.
    """

    lower: float
    upper: float
    count: int
    mean_probability: float
    accuracy: float


def reliability_bins(
    detections: Sequence[ClassifiedDetection], temperature: float
) -> list[ReliabilityBin]:
    """Return the bins of a reliability diagram with a temperature."""
    p = np.array(
        [
            apply_temperature(d.probabilities, temperature).get(d.reported_class, 0.0)
            for d in detections
        ]
    )
    is_right = np.array([d.reported_class == d.true_class for d in detections])
    bin_of = np.minimum((p * NUM_BINS).astype(int), NUM_BINS - 1)
    bins = []
    for k in range(NUM_BINS):
        members = bin_of == k
        count = int(members.sum())
        mean = float(p[members].mean()) if count else np.nan
        accuracy = float(is_right[members].mean()) if count else np.nan
        bins.append(ReliabilityBin(k / NUM_BINS, (k + 1) / NUM_BINS, count, mean, accuracy))
    return bins


def expected_calibration_error(bins: Sequence[ReliabilityBin]) -> float:
    """Return the mean difference of probability and accuracy, weighted by the detections."""
    total = sum(b.count for b in bins)
    return sum(b.count * abs(b.mean_probability - b.accuracy) for b in bins if b.count) / total
