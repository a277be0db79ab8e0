"""Class probabilities of a known object, updated by Bayes' rule."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from drake_clutter.belief.known_supports import REST_ORIENTATIONS
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import TouchConfig
from drake_clutter.grammar.orientation import resting_rotation
from drake_clutter.scenes.scene import SceneObject

ClassProbabilities = Mapping[str, float]
"""Probability of each class by its name; they sum to 1."""


@dataclass(frozen=True)
class Touch:
    """What the gripper felt in a move.

    Attributes:
        mass: Mass that hung on the tool [kg]; NaN if it was not measured.
        excess_height: By how much farther than believed the object reached down when it touched
            what is below [m]; NaN if it was not measured.
        has_sealed: Whether the gripper grasped the object.
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


def touch_likelihoods(
    believed: SceneObject, touch: Touch, classes: Sequence[ObjectClass], config: TouchConfig
) -> dict[str, float]:
    """Return the likelihood of what the gripper felt for each class, by its name.

    Errors are normally distributed; a fraction of the measurements are outliers, uniform over the
    range of the classes.

    Args:
        believed: The picked object, as it was believed.
        touch: What the gripper felt.
        classes: Classes that the object may have.
        config: Errors of the measurements.
    """
    likelihoods = {c.name: 1.0 for c in classes}
    height = _extent(believed)
    for c in classes:
        if not math.isnan(touch.mass):
            deviation = math.hypot(config.mass_error, config.relative_mass_error * c.mass)
            range_ = max(o.mass for o in classes)
            likelihoods[c.name] *= _mixture(
                touch.mass - c.mass, deviation, config.outlier_fraction / range_, config
            )
        if not math.isnan(touch.excess_height):
            range_ = max(max(o.size) for o in classes)
            likelihoods[c.name] *= max(
                _mixture(
                    height + touch.excess_height - h,
                    config.height_error,
                    config.outlier_fraction / range_,
                    config,
                )
                for h in _heights_with_top_of(believed, c, config.top_face_error)
            )
        if not touch.has_sealed:
            is_believed = c is believed.object_class
            likelihoods[c.name] *= (
                config.no_seal_probability if is_believed else config.no_seal_otherwise
            )
    return likelihoods


def _mixture(error: float, deviation: float, outlier_density: float, config: TouchConfig) -> float:
    """Return the density of a normal distribution with outliers."""
    normal = math.exp(-0.5 * (error / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))
    return (1 - config.outlier_fraction) * normal + outlier_density


def _extent(o: SceneObject) -> float:
    """Return the height of an object [m]."""
    lower, upper = o.bounds_T
    return float(upper[2] - lower[2])


def _heights_with_top_of(
    believed: SceneObject, object_class: ObjectClass, tolerance: float
) -> list[float]:
    """Return the heights of a class at rest in the orientations that show the same top.

    Args:
        believed: The object whose top is seen.
        object_class: The class.
        tolerance: Largest difference of the top's sides [m].

    Returns:
        Heights [m]; those of all orientations if no one shows such a top.
    """
    sides = _horizontal_sides(believed.object_class, believed.X_TO.rotation)
    same, all_heights = [], []
    for orientation in REST_ORIENTATIONS.values():
        R_TO = resting_rotation(object_class, orientation)
        height = float(np.ptp(object_class.corners @ R_TO[2]))
        all_heights.append(height)
        if np.abs(_horizontal_sides(object_class, R_TO) - sides).max() <= tolerance:
            same.append(height)
    return same or all_heights


def _horizontal_sides(object_class: ObjectClass, R_TO: np.ndarray) -> np.ndarray:
    """Return the two sizes of a class along its most horizontal axes, ascending [m]. Shape (2,)."""
    vertical = int(np.abs(R_TO[2]).argmax())
    return np.sort(np.delete(np.asarray(object_class.size), vertical))
