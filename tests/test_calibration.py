"""Calibration of class probabilities."""

import numpy as np
import pytest
from conftest import rng

from drake_clutter.perception.calibration import (
    ClassifiedDetection,
    apply_temperature,
    expected_calibration_error,
    fit_temperature,
    negative_log_likelihood,
    reliability_bins,
)

CLASSES = ("", "box", "can")


def detections(temperature: float, count: int) -> list[ClassifiedDetection]:
    """Return detections whose probabilities are right with a temperature."""
    generator = rng(5)
    result = []
    for _ in range(count):
        right = generator.dirichlet((0.3, 1.0, 1.0))
        true = CLASSES[generator.choice(3, p=right)]
        overconfident = right**temperature / (right**temperature).sum()
        reported = CLASSES[1 + int(right[1:].argmax())]
        named = dict(zip(CLASSES, overconfident.tolist(), strict=True))
        result.append(ClassifiedDetection(named, reported, true))
    return result


@pytest.mark.parametrize("temperature", [0.5, 3.0])
def test_the_temperature_of_overconfident_probabilities(temperature: float) -> None:
    examples = detections(temperature, 3000)
    fitted = fit_temperature(examples)
    assert fitted == pytest.approx(temperature, rel=0.12)
    errors = [expected_calibration_error(reliability_bins(examples, t)) for t in (1.0, fitted)]
    assert errors[1] < 0.03 < errors[0]
    likelihoods = [negative_log_likelihood(examples, t) for t in (1.0, fitted)]
    assert likelihoods[1] < likelihoods[0]


def test_temperature_of_probabilities() -> None:
    assert apply_temperature({}, 2.0) == {}
    assert apply_temperature({"a": 0.8, "b": 0.2}, 1.0) == pytest.approx({"a": 0.8, "b": 0.2})
    # Square roots of 0.9 and 0.1 are in the ratio of 3 to 1.
    assert apply_temperature({"a": 0.9, "b": 0.1}, 2.0) == pytest.approx({"a": 0.75, "b": 0.25})
    assert apply_temperature({"a": 1.0, "b": 0.0}, 5.0) == {"a": 1.0, "b": 0.0}


def test_reliability_bins() -> None:
    """Right in 3 of 4 at 0.95, never at 0.42, where the reported class is not the best one."""
    sure = {"": 0.0, "box": 0.95, "can": 0.05}
    unsure = {"": 0.0, "box": 0.58, "can": 0.42}
    examples = [
        *(ClassifiedDetection(sure, "box", "box") for _ in range(3)),
        ClassifiedDetection(sure, "box", ""),
        ClassifiedDetection(unsure, "can", "box"),
    ]
    bins = reliability_bins(examples, 1.0)
    assert [b.count for b in bins] == [0, 0, 0, 0, 1, 0, 0, 0, 0, 4]
    assert (bins[9].mean_probability, bins[9].accuracy) == pytest.approx((0.95, 0.75))
    assert (bins[4].mean_probability, bins[4].accuracy) == pytest.approx((0.42, 0.0))
    assert np.isnan(bins[0].accuracy)
    assert expected_calibration_error(bins) == pytest.approx((4 * 0.20 + 0.42) / 5)
