"""Class probabilities of a known object, updated by Bayes' rule."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

ClassProbabilities = Mapping[str, float]
"""Probability of each class by its name; they sum to 1."""


@dataclass(frozen=True)
class Touch:
    """What the gripper felt in a move.

    Attributes:
        mass: Mass that hung on the tool [kg]; NaN if it was not measured.
        excess_height: By how much the object reached farther down than believed when it touched
            [m]; negative if it is shorter; NaN if it did not touch.
        has_sealed: Whether the vacuum built up; True without a suction cup.
    """

    mass: float = math.nan
    excess_height: float = math.nan
    has_sealed: bool = True


def update_probabilities(
    prior: ClassProbabilities, likelihoods: Mapping[str, float]
) -> ClassProbabilities:
    """Return the class probabilities after a measurement (Bayes' rule).

    Args:
        prior: Probabilities before the measurement.
        likelihoods: Likelihood of the measurement for each class of the prior. If all are zero, the
            measurement says nothing.
    """
    joint = {name: p * likelihoods[name] for name, p in prior.items()}
    total = sum(joint.values())
    return {name: p / total for name, p in joint.items()} if total > 0 else prior


def normal_likelihood(error: float, deviation: float, outlier_density: float) -> float:
    """Return the density of a normal distribution mixed with a uniform one.

    Args:
        error: Distance from the mean.
        deviation: Standard deviation.
        outlier_density: Density of outliers, times their probability.
    """
    density = math.exp(-0.5 * (error / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))
    return density + outlier_density
