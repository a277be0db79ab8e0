"""A robot that is loaded: joints, limits, kinematics and inverse kinematics of a `RobotSpec`.

Frames: T the support; B the robot's base; F its flange, z out of the arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.robot_spec import RobotSpec
from drake_clutter.files import InputError
from drake_clutter.robots import ur_kinematics as kinematics
from drake_clutter.robots.inverse_kinematics import InverseKinematics, UrInverseKinematics
from drake_clutter.robots.joint_range import JointRange
from drake_clutter.robots.numerical_ik import NumericalInverseKinematics
from drake_clutter.robots.parsed_arm import ParsedArm, parse_arm
from drake_clutter.robots.serial_chain import SerialChain
from drake_clutter.robots.ur_fit import UrFit, fit_ur

Floats = NDArray[np.float64]

_MAX_FIT_ERROR = 1e-6
"""Largest error of the closed form's poses: entries of rotations, and positions [m]."""
_UR_VERTICAL_TOOL_ROWS = np.array([[0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
"""The three parallel axes tilt the tool by the sum of their angles, wrist 2 out of their plane."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot as planning and simulation use it.

    Attributes:
        spec: What it was loaded from.
        joint_names: In the order of q.
        joint_range: Range of the joints.
        velocity_limits: [rad/s]. Shape (n,).
        acceleration_limits: [rad/s^2]. Shape (n,).
        jerk_limits: Infinite where the cell gives none [rad/s^3]. Shape (n,).
        torque_limits: [N m]. Shape (n,).
        home: Where moves begin and end [rad]. Shape (n,).
        link_depths: How many of the joints, from the base on, move a link.
        chain: Kinematics, as the model file has them.
        ur_fit: The same in closed form, of an arm of the UR family; else None.
        ik: Inverse kinematics.
        vertical_tool_rows: Rows A with A dq = 0 exactly if a vertical tool axis stays vertical;
            None: the arm has no such linear relation. Shape (m, n).
    """

    spec: RobotSpec
    joint_names: tuple[str, ...]
    joint_range: JointRange
    velocity_limits: Floats
    acceleration_limits: Floats
    jerk_limits: Floats
    torque_limits: Floats
    home: Floats
    link_depths: Mapping[str, int]
    chain: SerialChain
    ur_fit: UrFit | None
    ik: InverseKinematics
    vertical_tool_rows: Floats | None

    @property
    def num_joints(self) -> int:
        """Number of joints, n."""
        return len(self.joint_names)

    @property
    def position_limits(self) -> Floats:
        """Least and greatest position [rad]. Shape (n, 2)."""
        return self.joint_range.limits

    @property
    def X_TB(self) -> RigidTransform:
        """Pose of the base."""
        return self.spec.X_TB

    def forward_kinematics(self, q: Floats) -> Floats:
        """Return X_BF, (..., 4, 4), at joint positions (..., n)."""
        if self.ur_fit is None:
            return self.chain.forward_kinematics(q)
        X = kinematics.forward_kinematics(q, self.ur_fit.parameters)
        X = X if self.ur_fit.X_B0 is None else self.ur_fit.X_B0 @ X
        return X if self.ur_fit.X_6F is None else X @ self.ur_fit.X_6F

    def jacobian(self, q: Floats) -> Floats:
        """Return w_BF [rad/s] over v_BF [m/s] in B per joint velocity, (6, n), at q (n,)."""
        return self.chain.jacobian(q)

    def manipulability(self, q: Floats) -> Floats:
        """Return sqrt(det(J J^T)), (...), at q (..., n) (Yoshikawa 1985); 0 if singular."""
        if self.ur_fit is None:
            return self.chain.manipulability(q)
        return kinematics.manipulability(q, self.ur_fit.parameters)

    def unwrap(self, q: Floats, reference: Floats) -> Floats:
        """Return the equivalents of q nearest to a reference, (..., n), see `JointRange`."""
        return self.joint_range.unwrap(q, reference)


@lru_cache(maxsize=32)
def load_robot(spec: RobotSpec) -> RobotModel:
    """Read a robot's model and limits.

    Raises:
        InputError: The model is not whole or does not fit the specification, or a limit is missing.
    """
    arm = parse_arm(spec)
    joints = JointRange(_position_limits(spec, arm), arm.revolute)
    home = _home(spec, arm, joints)
    unlimited, jerk = [np.inf] * len(arm.joints), spec.limits.jerk
    fit = _fit_ur_arm(arm) if spec.ik == "ur" else None
    ik: InverseKinematics = NumericalInverseKinematics(arm.chain, joints, home)
    if fit is not None:
        ik = UrInverseKinematics(fit.parameters, joints, _inverse(fit.X_B0), _inverse(fit.X_6F))
    at_home = arm.chain.forward_kinematics(home)[None]
    ik.solve(at_home), ik.track(at_home, home)  # compiled here: no plan's time limit pays for it
    return RobotModel(
        spec,
        tuple(joint.name() for joint in arm.joints),
        joints,
        _joint_limits("velocity", spec.limits.velocity, arm, arm.limits["velocity"]),
        _joint_limits("acceleration", spec.limits.acceleration, arm, unlimited),
        np.array(unlimited) if jerk is None else _joint_limits("jerk", jerk, arm, unlimited),
        _joint_limits("torque", spec.limits.torque, arm, arm.limits["torque"]),
        home,
        arm.link_depths,
        arm.chain,
        fit,
        ik,
        _UR_VERTICAL_TOOL_ROWS if fit is not None and _has_vertical_axes(spec, fit) else None,
    )


def _home(spec: RobotSpec, arm: ParsedArm, joints: JointRange) -> Floats:
    home = np.array(spec.home)
    _check_length("home", len(home), arm)
    for joint, q, (lower, upper) in zip(arm.joints, home, joints.limits, strict=True):
        if not lower <= q <= upper:
            bounds = f"from {lower:g} to {upper:g}"
            raise InputError(f"robot.home: {q:g} for joint {joint.name()!r}; allowed is {bounds}")
    return home


def _position_limits(spec: RobotSpec, arm: ParsedArm) -> Floats:
    """Return the limits of position (n, 2), the cell's over the model's."""
    found = np.column_stack([arm.limits["lower"], arm.limits["upper"]])
    if spec.limits.position is not None:
        _check_length("limits.position", len(spec.limits.position), arm)
        found = np.array(spec.limits.position)
    for joint, (lower, upper) in zip(arm.joints, found, strict=True):
        if not np.isfinite([lower, upper]).all():
            raise _missing_limit("position", joint.name())
        if not lower < upper:
            given = f"robot.limits.position: {lower:g}, {upper:g} for joint {joint.name()!r}"
            raise InputError(f"{given}; allowed is the least, then the greatest")
    return found


def _joint_limits(
    kind: str,
    given: tuple[float, ...] | None,
    arm: ParsedArm,
    of_model: list[float],
) -> Floats:
    """Return limits (n,), the cell's over the model's."""
    if given is not None:
        _check_length(f"limits.{kind}", len(given), arm)
        return np.array(given)
    for joint, limit in zip(arm.joints, of_model, strict=True):
        if not 0 < limit < np.inf:
            raise _missing_limit(kind, joint.name())
    return np.array(of_model)


def _check_length(field: str, length: int, arm: ParsedArm) -> None:
    if length != len(arm.joints):
        names = ", ".join(joint.name() for joint in arm.joints)
        allowed = f"{len(arm.joints)} values, for {names}"
        raise InputError(f"robot.{field}: {length} values; allowed is {allowed}")


def _missing_limit(kind: str, joint: str) -> InputError:
    allowed = "a value for each joint, here or in the model file"
    return InputError(f"robot.limits.{kind}: is missing for joint {joint!r}; allowed is {allowed}")


def _fit_ur_arm(arm: ParsedArm) -> UrFit:
    fit = fit_ur(arm.chain) if len(arm.joints) == 6 and arm.revolute.all() else None
    if fit is None or not fit.error < _MAX_FIT_ERROR:
        off = f"{len(arm.joints)} joints" if fit is None else f"off by {fit.error:.2g} m"
        what = f"{arm.path.name} is no arm of the UR family: {off}"
        raise InputError(f"robot.ik: 'ur' ({what}); allowed is 'numerical'")
    return fit


def _inverse(X: Floats | None) -> Floats | None:
    return None if X is None else np.asarray(np.linalg.inv(X))


def _has_vertical_axes(spec: RobotSpec, fit: UrFit) -> bool:
    """Whether the first axis is vertical and the tool's axis that of the last joint."""
    X_TB = spec.X_TB.GetAsMatrix4()
    X_T0 = X_TB if fit.X_B0 is None else X_TB @ fit.X_B0
    along = 1.0 if fit.X_6F is None else fit.X_6F[2, 2]
    return bool(min(abs(X_T0[2, 2]), abs(along)) > 1 - 1e-12)
