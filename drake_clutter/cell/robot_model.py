"""A robot that is loaded: joints, limits, kinematics and inverse kinematics of a `RobotSpec`.

Frames: T the support; B the robot's base; F its flange, z out of the arm.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)

from drake_clutter.cell import kinematics
from drake_clutter.cell.inverse_kinematics import InverseKinematics, UrInverseKinematics
from drake_clutter.cell.joint_range import JointRange
from drake_clutter.cell.model_file import model_path, parse_model, torque_limits
from drake_clutter.cell.numerical_ik import NumericalInverseKinematics
from drake_clutter.cell.robot import RobotSpec
from drake_clutter.cell.serial_chain import SerialChain
from drake_clutter.cell.ur_fit import UrFit, fit_ur
from drake_clutter.files import InputError

Floats = NDArray[np.float64]

_FITS = 1e-6
"""Largest error of the closed form's poses: entries of rotations, and positions [m]."""
_UR_VERTICAL = np.array([[0.0, 1.0, 1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]])
"""The three parallel axes tilt the tool by the sum of their angles, wrist 2 out of their plane."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot as planning and simulation use it.

    Attributes:
        spec: What it was loaded from.
        joint_names: In the order of q.
        joints: Range of the joints.
        velocity_limits: [rad/s]. Shape (n,).
        acceleration_limits: [rad/s^2]. Shape (n,).
        jerk_limits: Infinite where the cell gives none [rad/s^3]. Shape (n,).
        torque_limits: [N m]. Shape (n,).
        home: Where moves begin and end [rad]. Shape (n,).
        links: How many of the joints, from the base on, move a link.
        chain: Kinematics, as the model file has them.
        ur: The same in closed form, of an arm of the UR family; else None.
        ik: Inverse kinematics.
        vertical_tool_rows: Rows A with A dq = 0 exactly if a vertical tool axis stays vertical;
            None: the arm has no such linear relation. Shape (m, n).
    """

    spec: RobotSpec
    joint_names: tuple[str, ...]
    joints: JointRange
    velocity_limits: Floats
    acceleration_limits: Floats
    jerk_limits: Floats
    torque_limits: Floats
    home: Floats
    links: Mapping[str, int]
    chain: SerialChain
    ur: UrFit | None
    ik: InverseKinematics
    vertical_tool_rows: Floats | None

    @property
    def num_joints(self) -> int:
        """Number of joints, n."""
        return len(self.joint_names)

    @property
    def position_limits(self) -> Floats:
        """Least and greatest position [rad]. Shape (n, 2)."""
        return self.joints.limits

    @property
    def X_TB(self) -> RigidTransform:
        """Pose of the base."""
        return self.spec.X_TB

    def forward_kinematics(self, q: Floats) -> Floats:
        """Return X_BF, (..., 4, 4), at joint positions (..., n)."""
        if self.ur is None:
            return self.chain.forward_kinematics(q)
        X = kinematics.forward_kinematics(q, self.ur.parameters)
        X = X if self.ur.X_B0 is None else self.ur.X_B0 @ X
        return X if self.ur.X_6F is None else X @ self.ur.X_6F

    def jacobian(self, q: Floats) -> Floats:
        """Return w_BF [rad/s] over v_BF [m/s] in B per joint velocity, (6, n), at q (n,)."""
        return self.chain.jacobian(q)

    def manipulability(self, q: Floats) -> Floats:
        """Return sqrt(det(J J^T)), (...), at q (..., n) (Yoshikawa 1985); 0 if singular."""
        return self.chain.manipulability(q) if self.ur is None else kinematics.manipulability(q, self.ur.parameters)

    def unwrap(self, q: Floats, reference: Floats) -> Floats:
        """Return the equivalents of q nearest to a reference, (..., n), see `JointRange`."""
        return self.joints.unwrap(q, reference)


@lru_cache(maxsize=32)
def load_robot(spec: RobotSpec) -> RobotModel:
    """Read a robot's model and limits.

    Raises:
        InputError: The model is not whole or does not fit the specification, or a limit is missing.
    """
    path = model_path(spec.model)
    plant = MultibodyPlant(0.0)
    instance = parse_model(plant, spec.model, visuals=False)
    moving = _weld_and_order(plant, instance, spec, path)
    plant.Finalize()
    count = len(moving)
    joints = JointRange(_positions(spec, moving), np.array([isinstance(j, RevoluteJoint) for j in moving]))
    home = np.array(spec.home)
    if len(home) != count:
        raise InputError(f"robot.home: {len(home)} values; allowed is {count}, one for each joint of {path.name}")
    for joint, q, (lower, upper) in zip(moving, home, joints.limits, strict=True):
        if not lower <= q <= upper:
            raise InputError(f"robot.home: {q:g} for {joint.name()}; allowed is from {lower:g} to {upper:g}")
    torques = torque_limits(path)
    chain = _chain(plant, instance, moving, spec)
    fit = _fitted(spec, chain, path) if spec.ik == "ur" else None
    ik: InverseKinematics = NumericalInverseKinematics(chain, joints, home)
    if fit is not None:
        ik = UrInverseKinematics(fit.parameters, joints, _inverse(fit.X_B0), _inverse(fit.X_6F))
    return RobotModel(
        spec,
        tuple(joint.name() for joint in moving),
        joints,
        _limits(spec, moving, "velocity", [float(joint.velocity_upper_limits()[0]) for joint in moving]),
        _limits(spec, moving, "acceleration", [np.inf] * count),
        _limits(spec, moving, "jerk", [np.inf] * count) if spec.limits.jerk else np.full(count, np.inf),
        _limits(spec, moving, "torque", [torques.get(joint.name(), np.inf) for joint in moving]),
        home,
        _moved_by(plant, instance, moving),
        chain,
        fit,
        ik,
        _UR_VERTICAL if fit is not None and _upright(spec, fit) else None,
    )


def _weld_and_order(plant: MultibodyPlant, instance: ModelInstanceIndex, spec: RobotSpec, path: Path) -> list[Joint]:
    """Weld the base to the world, and return the joints from base to flange."""
    bodies = {plant.get_body(index).name(): plant.get_body(index) for index in plant.GetBodyIndices(instance)}
    above = {joint.child_body().name(): joint for joint in _joints(plant, instance)}
    roots = [name for name in bodies if name not in above]
    if spec.base_link not in roots:
        names = ", ".join(roots) or "a link that no joint fixes to the world"
        raise InputError(f"robot.base_link: {spec.base_link!r} in {path.name}; allowed is {names}")
    if not plant.HasFrameNamed(spec.tool_frame, instance):
        names = ", ".join(plant.get_frame(index).name() for index in plant.GetFrameIndices(instance))
        raise InputError(f"robot.tool_frame: {spec.tool_frame!r} in {path.name}; allowed are {names}")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(spec.base_link, instance), spec.X_TB)
    chain = _up_to_base(plant.GetFrameByName(spec.tool_frame, instance).body(), above)[::-1]
    moving = [joint for joint in chain if joint.num_positions()]
    for joint in _joints(plant, instance):
        if joint.num_positions() and joint not in moving:
            raise InputError(
                f"{path}: joint {joint.name()!r} does not move the tool frame; allowed is an arm without other joints"
            )
        if joint.num_positions() and not isinstance(joint, (RevoluteJoint, PrismaticJoint)):
            raise InputError(f"{path}: joint {joint.name()!r} is {joint.type_name()}; allowed are revolute and prismatic joints")
    if not moving:
        raise InputError(f"robot.tool_frame: {spec.tool_frame!r}; allowed is a frame that joints move")
    return moving


def _joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Joint]:
    return [plant.get_joint(index) for index in plant.GetJointIndices(instance)]


def _up_to_base(body: RigidBody, above: Mapping[str, Joint]) -> list[Joint]:
    found = []
    while (joint := above.get(body.name())) is not None:
        found.append(joint)
        body = joint.parent_body()
    return found


def _positions(spec: RobotSpec, moving: list[Joint]) -> Floats:
    """Return the limits of position (n, 2), the cell's over the model's."""
    given = [[float(j.position_lower_limits()[0]), float(j.position_upper_limits()[0])] for j in moving]
    if spec.limits.position is not None:
        _check_length("position", spec.limits.position, moving)
        given = [list(pair) for pair in spec.limits.position]
    for joint, (lower, upper) in zip(moving, given, strict=True):
        if not np.isfinite([lower, upper]).all():
            raise _without(joint, "position")
        if not lower < upper:
            raise InputError(f"robot.limits.position: {lower:g} to {upper:g} for {joint.name()}; allowed is the least first")
    return np.array(given)


def _limits(spec: RobotSpec, moving: list[Joint], kind: str, of_the_model: list[float]) -> Floats:
    """Return limits (n,), the cell's over the model's."""
    given = getattr(spec.limits, kind)
    if given is not None:
        _check_length(kind, given, moving)
        return np.array(given)
    for joint, limit in zip(moving, of_the_model, strict=True):
        if not 0 < limit < np.inf:
            raise _without(joint, kind)
    return np.array(of_the_model)


def _check_length(kind: str, given: tuple[object, ...], moving: list[Joint]) -> None:
    if len(given) != len(moving):
        names = ", ".join(joint.name() for joint in moving)
        raise InputError(f"robot.limits.{kind}: {len(given)} values; allowed is {len(moving)} values, for {names}")


def _without(joint: Joint, kind: str) -> InputError:
    missing = f"robot.limits.{kind}: is missing for joint {joint.name()!r}"
    return InputError(f"{missing}; allowed is a value for each joint, here or in the model file")


def _chain(plant: MultibodyPlant, instance: ModelInstanceIndex, moving: list[Joint], spec: RobotSpec) -> SerialChain:
    """Return the transforms between the joints' axes, each turned so that its axis is z."""
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, np.zeros(plant.num_positions()))
    fixed, before, X_from = [], plant.GetFrameByName(spec.base_link, instance), RigidTransform()
    for joint in moving:
        turning = isinstance(joint, RevoluteJoint)
        axis = joint.revolute_axis() if turning else joint.translation_axis()
        R = RotationMatrix() if axis[2] == 1.0 else RotationMatrix.MakeFromOneVector(axis, 2)
        X = plant.CalcRelativeTransform(context, before, joint.frame_on_parent())
        fixed.append((X_from.inverse() @ X @ RigidTransform(R)).GetAsMatrix4())
        before, X_from = joint.frame_on_child(), RigidTransform(R)
    X = plant.CalcRelativeTransform(context, before, plant.GetFrameByName(spec.tool_frame, instance))
    fixed.append((X_from.inverse() @ X).GetAsMatrix4())
    return SerialChain(np.array(fixed), np.array([isinstance(joint, RevoluteJoint) for joint in moving]))


def _moved_by(plant: MultibodyPlant, instance: ModelInstanceIndex, moving: list[Joint]) -> dict[str, int]:
    above = {joint.child_body().name(): joint for joint in _joints(plant, instance)}
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instance)]
    return {body.name(): sum(joint in moving for joint in _up_to_base(body, above)) for body in bodies}


def _fitted(spec: RobotSpec, chain: SerialChain, path: Path) -> UrFit:
    fit = fit_ur(chain) if chain.num_joints == 6 and chain.revolute.all() else None
    if fit is None or not fit.error < _FITS:
        off = f"{chain.num_joints} joints" if fit is None else f"off by {fit.error:.2g} m"
        raise InputError(f"robot.ik: 'ur', but {path.name} is no arm of the UR family ({off}); allowed is 'numerical'")
    return fit


def _inverse(X: Floats | None) -> Floats | None:
    return None if X is None else np.asarray(np.linalg.inv(X))


def _upright(spec: RobotSpec, fit: UrFit) -> bool:
    """Whether the first axis is vertical and the tool's axis that of the last joint."""
    X_T0 = spec.X_TB.GetAsMatrix4() if fit.X_B0 is None else spec.X_TB.GetAsMatrix4() @ fit.X_B0
    along = np.eye(4) if fit.X_6F is None else fit.X_6F
    return bool(abs(X_T0[2, 2]) > 1 - 1e-12 and abs(along[2, 2]) > 1 - 1e-12)
