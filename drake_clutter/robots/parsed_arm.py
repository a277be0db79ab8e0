"""Parsing of an arm: joints from base to flange, links and kinematic chain.

Frames: B is the robot's base, F is its flange.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    Joint,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)

from drake_clutter.cell.robot_spec import RobotSpec
from drake_clutter.files import InputError
from drake_clutter.robots.model_parsing import (
    find_mimic_joint,
    parse_model,
    read_torque_limits,
    resolve_model_path,
)
from drake_clutter.robots.serial_chain import SerialChain

_DRAKE_FRAME_SUFFIXES = ("__model__", "_parent", "_child")
"""Suffixes of frame names that Drake's parser adds."""


@dataclass(frozen=True, eq=False)
class ParsedArm:
    """Arm in a finalized plant of its own, with its base at the world's origin.

    Attributes:
        plant: Plant of the arm, without geometry.
        path: Model file.
        base: Frame B.
        flange: Frame F.
        joints: Joints between base and flange, from the base on.
        link_depths: Number of joints between the base and each link, by name.
    """

    plant: MultibodyPlant
    path: Path
    base: Frame
    flange: Frame
    joints: tuple[Joint, ...]
    link_depths: Mapping[str, int]

    @property
    def revolute(self) -> NDArray[np.bool_]:
        """Whether each joint is revolute. Shape (n,)."""
        return np.array([isinstance(joint, RevoluteJoint) for joint in self.joints])

    @property
    def limits(self) -> Mapping[str, list[float]]:
        """Joint limits `lower`, `upper`, `velocity` and `torque`; infinite if absent."""
        torques = read_torque_limits(self.path)
        return {
            "lower": [float(joint.position_lower_limits()[0]) for joint in self.joints],
            "upper": [float(joint.position_upper_limits()[0]) for joint in self.joints],
            "velocity": [float(joint.velocity_upper_limits()[0]) for joint in self.joints],
            "torque": [torques.get(joint.name(), np.inf) for joint in self.joints],
        }

    @cached_property
    def chain(self) -> SerialChain:
        """Kinematic chain whose joint axes are the z axes of its frames."""
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositions(context, np.zeros(self.plant.num_positions()))
        fixed = []
        previous = self.base
        X_previous = RigidTransform()  # rotates the z axis to the previous joint's axis
        for joint in self.joints:
            is_revolute = isinstance(joint, RevoluteJoint)
            axis = joint.revolute_axis() if is_revolute else joint.translation_axis()
            R = RotationMatrix() if axis[2] == 1.0 else RotationMatrix.MakeFromOneVector(axis, 2)
            X = self.plant.CalcRelativeTransform(context, previous, joint.frame_on_parent())
            fixed.append((X_previous.inverse() @ X @ RigidTransform(R)).GetAsMatrix4())
            previous = joint.frame_on_child()
            X_previous = RigidTransform(R)
        X = self.plant.CalcRelativeTransform(context, previous, self.flange)
        fixed.append((X_previous.inverse() @ X).GetAsMatrix4())
        return SerialChain(np.array(fixed), self.revolute)


def parse_arm(spec: RobotSpec) -> ParsedArm:
    """Parse the arm of a model file.

    Args:
        spec: Robot of the work cell.

    Raises:
        InputError: The file is invalid, has no such base or flange, or is not a serial arm.
    """
    path = resolve_model_path(spec.model)
    plant = MultibodyPlant(0.0)
    instance = parse_model(plant, spec.model, visuals=True)  # Missing meshes are reported, too.
    parent_joints = {joint.child_body().name(): joint for joint in _joints(plant, instance)}
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instance)]
    roots = [body.name() for body in bodies if body.name() not in parent_joints]
    if spec.base_link not in roots:
        known = ", ".join(roots) or "a link that is not fixed to the world"
        raise InputError(f"robot.base_link: {spec.base_link!r}; expected in {path.name}: {known}")
    if loose := [name for name in roots if name != spec.base_link]:
        raise InputError(
            f"{path}: link {loose[0]!r} has no parent joint; expected a model of one arm"
        )
    if not plant.HasFrameNamed(spec.tool_frame, instance):
        frames = [plant.get_frame(index).name() for index in plant.GetFrameIndices(instance)]
        known = ", ".join(name for name in frames if not name.endswith(_DRAKE_FRAME_SUFFIXES))
        given = f"robot.tool_frame: {spec.tool_frame!r}"
        raise InputError(f"{given}; expected in {path.name}: {known}")
    base = plant.GetFrameByName(spec.base_link, instance)
    flange = plant.GetFrameByName(spec.tool_frame, instance)
    moving = _movable_joints(_joints_to_base(flange.body(), parent_joints))
    if not moving:
        raise InputError(
            f"robot.tool_frame: {spec.tool_frame!r}; expected a frame that joints move"
        )
    _check_serial(path, _joints(plant, instance), moving)
    plant.WeldFrames(plant.world_frame(), base)
    plant.Finalize()
    link_depths = {
        body.name(): len(_movable_joints(_joints_to_base(body, parent_joints))) for body in bodies
    }
    return ParsedArm(plant, path, base, flange, tuple(moving), link_depths)


def _joints(plant: MultibodyPlant, instance: ModelInstanceIndex) -> list[Joint]:
    return [plant.get_joint(index) for index in plant.GetJointIndices(instance)]


def _joints_to_base(body: RigidBody, parent_joints: Mapping[str, Joint]) -> list[Joint]:
    """Return the joints between the base and a body, from the base on."""
    path = []
    while (joint := parent_joints.get(body.name())) is not None:
        path.append(joint)
        body = joint.parent_body()
    return path[::-1]


def _movable_joints(joints: list[Joint]) -> list[Joint]:
    return [joint for joint in joints if joint.num_positions()]


def _check_serial(path: Path, joints: list[Joint], moving: list[Joint]) -> None:
    """Raise an error unless all movable joints move the tool frame independently."""
    for joint in _movable_joints(joints):
        what = f"{path}: joint {joint.name()!r}"
        if joint not in moving:
            raise InputError(f"{what} does not move the tool frame; expected a model of one arm")
        if not isinstance(joint, (RevoluteJoint, PrismaticJoint)):
            kinds = "revolute, continuous and prismatic joints"
            raise InputError(f"{what} is of type {joint.type_name()}; expected {kinds}")
    if (mimic := find_mimic_joint(path)) is not None:
        allowed = "joints that move by themselves"
        raise InputError(f"{path}: joint {mimic!r} mimics another; expected {allowed}")
