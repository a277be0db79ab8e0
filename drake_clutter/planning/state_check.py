"""Checks of states and configurations that a motion starts or ends with."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, format_value
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.motion_plan import CellState, HeldObject
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.robots.robot_model import RobotModel
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]

JOINT_TOLERANCE = 1e-6
"""Joint positions may differ by this from what is asked for [rad]."""
_MAX_QUATERNION_ERROR = 1e-3
"""Largest difference between the norm of a quaternion and 1: files have rounded numbers."""


def find_object(objects: Sequence[SceneObject], name: str) -> SceneObject:
    """Return the object with a name.

    Raises:
        InputError: No object has the name.
    """
    for o in objects:
        if o.name == name:
            return o
    names = ", ".join(o.name for o in objects) or "an object; none is known"
    raise InputError(f"pick: {format_value(name)} is not a known object; expected {names}")


def check_names(objects: Sequence[SceneObject]) -> None:
    """Check that objects have names of their own.

    Raises:
        InputError: Two objects have the same name.
    """
    names = [o.name for o in objects]
    if len({*names}) < len(names):
        twice = next(name for k, name in enumerate(names) if name in names[:k])
        raise InputError(f"objects: {twice!r} twice; expected names that differ")


def to_configuration(robot: RobotModel, q: Sequence[float], name: str) -> Floats:
    """Return joint positions as an array. Shape (n,).

    Args:
        robot: Robot with n joints.
        q: Joint positions [rad].
        name: Name of the configuration.

    Raises:
        InputError: There are not n finite numbers.
    """
    try:
        values = np.asarray(q, float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (robot.num_joints,) or not np.isfinite(values).all():
        problem = f"{name}: {format_value(list(q))}"
        raise InputError(f"{problem}; expected {robot.num_joints} joint positions in rad")
    return values


def check_joint_limits(robot: RobotModel, q: Floats, name: str) -> PlanningFailure | None:
    """Return the joint that exceeds its limits most, if any.

    Args:
        robot: Robot with n joints.
        q: Joint positions [rad]. Shape (n,).
        name: Name of the configuration.
    """
    lower, upper = robot.position_limits.T
    excess = np.maximum(lower - q, q - upper)
    joint = int(excess.argmax())
    if excess[joint] <= JOINT_TOLERANCE:
        return None
    detail = f"{name}: {robot.joint_names[joint]}"
    return PlanningFailure(PlanningFailureReason.JOINT_LIMIT, detail, float(excess[joint]))


def check_configuration(
    robot: RobotModel, min_distance: float, model: CollisionModel, q: Floats, name: str
) -> PlanningFailure | None:
    """Return the closest pair of bodies in a configuration if it is too close.

    Args:
        robot: Robot with n joints.
        min_distance: Smallest allowed distance [m].
        model: Collision model with the objects at their poses.
        q: Joint positions [rad]. Shape (n,).
        name: Name of the configuration.
    """
    pairs = model.distances_below(q, min_distance)
    if not pairs:
        return None
    nearest = min(pairs, key=lambda pair: pair.distance)
    pair = " and ".join(nearest.pair)
    if (q == robot.home).all():
        reason = PlanningFailureReason.HOME_IN_COLLISION
        return PlanningFailure(reason, pair, nearest.distance)
    reason = PlanningFailureReason.IN_COLLISION
    return PlanningFailure(reason, f"{name}: {pair}", nearest.distance)


def check_overlaps(
    model: CollisionModel, objects: Sequence[SceneObject], max_overlap: float
) -> PlanningFailure | None:
    """Return the solids that overlap most, if too deep.

    Args:
        model: Collision model with the objects at their poses.
        objects: Objects that are not held.
        max_overlap: Largest allowed depth [m].
    """
    deepest = model.deepest_overlap(objects, max_overlap)
    if deepest is None:
        return None
    pair = " and ".join(deepest.pair)
    return PlanningFailure(PlanningFailureReason.OBJECTS_OVERLAP, pair, -deepest.distance)


def check_held(state: CellState, *, is_held: bool) -> HeldObject:
    """Return the held object.

    Args:
        state: State at the start of a motion.
        is_held: Whether an object has to be held; else none may be held.

    Raises:
        InputError: An object is held, or none, against what is expected.
    """
    if is_held and state.held is None:
        raise InputError("state: no object is held; expected one, see `plan_pick`")
    if not is_held and state.held is not None:
        raise InputError(f"state: {state.held.name!r} is held; expected no held object")
    return cast(HeldObject, state.held)


def check_pose(X_TO: Pose, name: str) -> None:
    """Check that a pose has finite numbers and a unit quaternion.

    Args:
        X_TO: The pose.
        name: Name of the pose.

    Raises:
        InputError: It does not.
    """
    length = float(np.linalg.norm(X_TO.quaternion))
    if not np.isfinite(X_TO.translation).all() or not abs(length - 1) < _MAX_QUATERNION_ERROR:
        numbers = format_value([*X_TO.translation, *X_TO.quaternion])
        raise InputError(f"{name}: {numbers}; expected a finite position and a unit quaternion")


def check_positive(value: float, name: str) -> None:
    """Check that a number is finite and positive.

    Raises:
        InputError: It is not.
    """
    if not 0 < value < np.inf:
        raise InputError(f"{name}: {value:g}; expected a positive number")
