"""Robot model: joints, limits, kinematics and inverse kinematics of a `RobotSpec`.

Frames: T is the support, B is the robot's base, F is its flange, z out of the arm.
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
"""Largest difference between the poses of the closed form and of the model: entries of rotation
matrices, and positions [m]. Rounded lengths in URDF files stay below it."""
_UR_VERTICAL_TOOL_ROWS = np.array([[0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
"""Rows A with A dq = 0 if the tool axis stays vertical: the three parallel axes tilt the tool by
the sum of their angles, and wrist 2 tilts it out of their plane. Shape (2, 6)."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """Robot with n joints.

    Attributes:
        spec: Specification from which the robot was loaded.
        joint_names: Names of the joints, in the order of q.
        joint_range: Position limits.
        velocity_limits: Velocity limits [rad/s]. Shape (n,).
        acceleration_limits: Acceleration limits [rad/s^2]. Shape (n,).
        jerk_limits: Jerk limits; infinite where the cell has none [rad/s^3]. Shape (n,).
        torque_limits: Torque limits [N m]. Shape (n,).
        home: Home configuration, in which moves start and end [rad]. Shape (n,).
        link_depths: Number of joints between the base and each link, by name.
        chain: Kinematic chain of the model file.
        ur_fit: Closed-form kinematics of an arm of the UR family; None for other arms.
        ik: Inverse kinematics.
        vertical_tool_rows: Rows A with A dq = 0 if and only if a vertical tool axis stays vertical,
            shape (m, n); None if there is no such linear relation.
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
        """Lower and upper position limits [rad]. Shape (n, 2)."""
        return self.joint_range.limits

    @property
    def X_TB(self) -> RigidTransform:
        """Pose of the base in T."""
        return self.spec.X_TB

    def forward_kinematics(self, q: Floats) -> Floats:
        """Return X_BF, shape (..., 4, 4), at joint positions of shape (..., n)."""
        if self.ur_fit is None:
            return self.chain.forward_kinematics(q)
        X = kinematics.forward_kinematics(q, self.ur_fit.parameters)
        X = X if self.ur_fit.X_B0 is None else self.ur_fit.X_B0 @ X
        return X if self.ur_fit.X_6F is None else X @ self.ur_fit.X_6F

    def jacobian(self, q: Floats) -> Floats:
        """Return the spatial Jacobian of F in B, angular rows first. Shape (6, n).

        Args:
            q: Joint positions. Shape (n,).
        """
        return self.chain.jacobian(q)

    def manipulability(self, q: Floats) -> Floats:
        """Return the manipulability sqrt(det(J J^T)) (Yoshikawa 1985). Shape (...).

        Args:
            q: Joint positions. Shape (..., n).
        """
        if self.ur_fit is None:
            return self.chain.manipulability(q)
        return kinematics.manipulability(q, self.ur_fit.parameters)

    def unwrap(self, q: Floats, reference: Floats) -> Floats:
        """Return the equivalents of `q` nearest to a reference, see `JointRange.unwrap`."""
        return self.joint_range.unwrap(q, reference)


@lru_cache(maxsize=32)
def load_robot(spec: RobotSpec) -> RobotModel:
    """Load the model and the limits of a robot.

    Args:
        spec: Robot of the work cell.

    Raises:
        InputError: The model is invalid or does not match the specification, or a limit is missing.
    """
    arm = parse_arm(spec)
    joints = JointRange(_position_limits(spec, arm), arm.revolute)
    home = _home(spec, arm, joints)
    unlimited = [np.inf] * len(arm.joints)
    jerk = spec.limits.jerk
    fit = _fit_ur_arm(arm) if spec.ik == "ur" else None
    ik: InverseKinematics = NumericalInverseKinematics(arm.chain, joints, home)
    if fit is not None:
        ik = UrInverseKinematics(fit.parameters, joints, _inverse(fit.X_B0), _inverse(fit.X_6F))
    # Compile the kinematics now, so that compilation does not count for time limits of planning.
    X_BF_home = arm.chain.forward_kinematics(home)[None]
    ik.solve(X_BF_home)
    ik.track(X_BF_home, home)
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
    """Return the home configuration after checking it. Shape (n,)."""
    home = np.array(spec.home)
    _check_length("home", len(home), arm)
    for joint, q, (lower, upper) in zip(arm.joints, home, joints.limits, strict=True):
        if not lower <= q <= upper:
            bounds = f"from {lower:g} to {upper:g}"
            raise InputError(f"robot.home: {q:g} for joint {joint.name()!r}; expected {bounds}")
    return home


def _position_limits(spec: RobotSpec, arm: ParsedArm) -> Floats:
    """Return the position limits of the cell or else of the model. Shape (n, 2)."""
    limits = np.column_stack([arm.limits["lower"], arm.limits["upper"]])
    if spec.limits.position is not None:
        _check_length("limits.position", len(spec.limits.position), arm)
        limits = np.array(spec.limits.position)
    for joint, (lower, upper) in zip(arm.joints, limits, strict=True):
        if not np.isfinite([lower, upper]).all():
            raise _missing_limit("position", joint.name(), arm)
        if not lower < upper:
            given = f"robot.limits.position: {lower:g}, {upper:g} for joint {joint.name()!r}"
            raise InputError(f"{given}; expected the lower, then the upper limit")
    return limits


def _joint_limits(
    kind: str,
    cell_limits: tuple[float, ...] | None,
    arm: ParsedArm,
    model_limits: list[float],
) -> Floats:
    """Return the limits of the cell, or else those of the model. Shape (n,)."""
    if cell_limits is not None:
        _check_length(f"limits.{kind}", len(cell_limits), arm)
        return np.array(cell_limits)
    for joint, limit in zip(arm.joints, model_limits, strict=True):
        if not 0 < limit < np.inf:
            raise _missing_limit(kind, joint.name(), arm)
    return np.array(model_limits)


def _check_length(field: str, length: int, arm: ParsedArm) -> None:
    if length != len(arm.joints):
        names = ", ".join(joint.name() for joint in arm.joints)
        allowed = f"{len(arm.joints)} values, for {names}"
        raise InputError(f"robot.{field}: {length} values; expected {allowed}")


def _missing_limit(kind: str, joint: str, arm: ParsedArm) -> InputError:
    allowed = f"a value for each joint, here or in {arm.path}"
    return InputError(f"robot.limits.{kind}: is missing for joint {joint!r}; expected {allowed}")


def _fit_ur_arm(arm: ParsedArm) -> UrFit:
    """Return the closed-form kinematics of an arm, or raise an error if it has none."""
    fit = fit_ur(arm.chain) if len(arm.joints) == 6 and arm.revolute.all() else None
    if fit is None or not fit.error < _MAX_FIT_ERROR:
        off = f"{len(arm.joints)} joints" if fit is None else f"off by {fit.error:.2g} m"
        what = f"{arm.path.name} is no arm of the UR family: {off}"
        raise InputError(f"robot.ik: 'ur' ({what}); expected 'numerical'")
    return fit


def _inverse(X: Floats | None) -> Floats | None:
    return None if X is None else np.asarray(np.linalg.inv(X))


def _has_vertical_axes(spec: RobotSpec, fit: UrFit) -> bool:
    """Return whether the first axis is vertical and the tool axis along the last one."""
    X_TB = spec.X_TB.GetAsMatrix4()
    X_T0 = X_TB if fit.X_B0 is None else X_TB @ fit.X_B0
    along = 1.0 if fit.X_6F is None else fit.X_6F[2, 2]
    return bool(min(abs(X_T0[2, 2]), abs(along)) > 1 - 1e-12)
