"""Class probabilities of a known object, updated by Bayes' rule."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_clutter.belief.known_supports import REST_ORIENTATIONS
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import TouchConfig
from drake_clutter.grammar.orientation import resting_rotation
from drake_clutter.scenes.scene import Pose, SceneObject

ClassProbabilities = Mapping[str, float]
"""Probability of each class by its name; they sum to 1."""
MAX_TOP_DIFFERENCE = 0.010
"""Largest difference of the sides of two tops that look the same to the camera [m]."""
MIN_PROBABILITY = 0.001
"""Smallest probability of a class before the gripper has felt the object."""


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

    @property
    def has_felt(self) -> bool:
        """Whether the gripper felt a mass, a height, or that it did not grasp the object."""
        is_measured = not (math.isnan(self.mass) and math.isnan(self.excess_height))
        return is_measured or not self.has_sealed


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
) -> dict[ObjectClass, float]:
    """Return the likelihood of what the gripper felt for each class.

    Errors are normally distributed; a fraction of the measurements are outliers, uniform over the
    range of the classes.

    Args:
        believed: The picked object, as it was believed.
        touch: What the gripper felt.
        classes: Classes that the object may have.
        config: Errors of the measurements.
    """
    likelihoods = dict.fromkeys(classes, 1.0)
    height = _extent(believed)
    for c in classes:
        if not math.isnan(touch.mass):
            deviation = math.hypot(config.mass_error, config.relative_mass_error * c.mass)
            range_ = max(o.mass for o in classes)
            likelihoods[c] *= _mixture(
                touch.mass - c.mass, deviation, config.outlier_fraction / range_, config
            )
        if not math.isnan(touch.excess_height):
            range_ = max(max(o.size) for o in classes)
            likelihoods[c] *= max(
                _mixture(
                    height + touch.excess_height - h,
                    config.height_error,
                    config.outlier_fraction / range_,
                    config,
                )
                for h in _heights_with_top_of(believed, c)
            )
        if not touch.has_sealed:
            is_believed = c.name == believed.object_class.name
            likelihoods[c] *= (
                config.no_seal_probability if is_believed else config.no_seal_otherwise
            )
    return likelihoods


def revise_class(
    detected: ObjectClass,
    probabilities: ClassProbabilities,
    likelihoods: Mapping[ObjectClass, float],
) -> ObjectClass:
    """Return the most probable class of a detected object that the gripper has felt.

    Args:
        detected: Class of the detection.
        probabilities: See `Detection.class_probabilities`; without any the class is certain.
        likelihoods: Likelihood of what the gripper felt, by class.
    """
    if not probabilities or not likelihoods:
        return detected
    classes = {c.name: c for c in likelihoods}
    # No class is impossible for a detector.
    prior = {name: max(probabilities.get(name, 0.0), MIN_PROBABILITY) for name in classes}
    posterior = update_probabilities(prior, {c.name: value for c, value in likelihoods.items()})
    best = max(posterior, key=lambda name: posterior[name])
    is_better = posterior[best] > posterior.get(detected.name, 0.0)
    return classes[best] if is_better else detected


def pose_with_same_top(believed: SceneObject, object_class: ObjectClass) -> Pose | None:
    """Return the pose at which an object of another class shows the same top.

    Args:
        believed: The object whose top is seen.
        object_class: The other class.

    Returns:
        X_TO; None if no orientation at rest has such a top.
    """
    R_old = believed.X_TO.rotation
    sides = _horizontal_sides(believed.object_class, R_old)
    yaw = _longer_side_yaw(believed.object_class, R_old)
    for orientation in REST_ORIENTATIONS.values():
        R_new = resting_rotation(object_class, orientation)
        if np.abs(_horizontal_sides(object_class, R_new) - sides).max() <= MAX_TOP_DIFFERENCE:
            turn = yaw - _longer_side_yaw(object_class, R_new)
            R = Rotation.from_euler("z", turn).as_matrix() @ R_new
            height = float(np.ptp(object_class.corners @ R[2]))
            x, y, _ = believed.X_TO.translation
            return Pose.from_rotation(R, (x, y, believed.top_height - height / 2))
    return None


def _longer_side_yaw(object_class: ObjectClass, R_TO: NDArray[np.float64]) -> float:
    """Return the yaw of the longer of the two most horizontal axes [rad]."""
    size = np.array(object_class.size)
    size[int(np.abs(R_TO[2]).argmax())] = -1.0
    x, y, _ = R_TO[:, int(size.argmax())]
    return math.atan2(y, x)


def _mixture(error: float, deviation: float, outlier_density: float, config: TouchConfig) -> float:
    """Return the density of a normal distribution with outliers."""
    normal = math.exp(-0.5 * (error / deviation) ** 2) / (deviation * math.sqrt(2 * math.pi))
    return (1 - config.outlier_fraction) * normal + outlier_density


def _extent(o: SceneObject) -> float:
    """Return the height of an object [m]."""
    lower, upper = o.bounds_T
    return float(upper[2] - lower[2])


def _heights_with_top_of(believed: SceneObject, object_class: ObjectClass) -> list[float]:
    """Return the heights of a class at rest in the orientations that show the same top.

    Args:
        believed: The object whose top is seen.
        object_class: The class.

    Returns:
        Heights [m]; those of all orientations if no one shows such a top.
    """
    sides = _horizontal_sides(believed.object_class, believed.X_TO.rotation)
    same, all_heights = [], []
    for orientation in REST_ORIENTATIONS.values():
        R_TO = resting_rotation(object_class, orientation)
        height = float(np.ptp(object_class.corners @ R_TO[2]))
        all_heights.append(height)
        if np.abs(_horizontal_sides(object_class, R_TO) - sides).max() <= MAX_TOP_DIFFERENCE:
            same.append(height)
    return same or all_heights


def _horizontal_sides(object_class: ObjectClass, R_TO: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the two sizes of a class along its most horizontal axes, ascending [m]. Shape (2,)."""
    vertical = int(np.abs(R_TO[2]).argmax())
    return np.sort(np.delete(np.asarray(object_class.size), vertical))
