"""The robot of a cell as data. Frames: T the support; B the robot's base; F its tool flange, z out of the arm."""

from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator
from pydrake.math import RigidTransform

from drake_clutter.cell.model_file import ModelFile
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.validation import (
    Finite,
    InRange,
    NonEmptyText,
    Positive,
    StrictModel,
    rejected_error,
)


class JointLimits(StrictModel):
    """Limits of each joint, in the order of the joints; None: as the model file has them.

    Attributes:
        position: Least and greatest [rad].
        velocity: [rad/s].
        acceleration: [rad/s^2].
        jerk: [rad/s^3].
        torque: [N m].
    """

    position: tuple[tuple[Finite, Finite], ...] | None = None
    velocity: tuple[Positive, ...] | None = None
    acceleration: tuple[Positive, ...]
    jerk: tuple[Positive, ...] | None = None
    torque: tuple[Positive, ...] | None = None


class RobotSpec(StrictModel):
    """Which robot, and where.

    Attributes:
        model: SDF or URDF file: a path relative to the cell's file, or package://drake_clutter_models/...
        base_link: The link that is fixed to the base pose.
        tool_frame: The frame or link F on which the gripper is mounted.
        base: X_TB.
        home: Where moves begin and end; the cameras see the support then [rad].
        limits: Of the joints.
        ik: Inverse kinematics: closed form of the UR family, or numerical for any arm.
        payload: Largest mass of gripper and object together [kg].
        pedestal_side: Of the pedestal's square section, from the table to the base [m]; 0 for none.
    """

    model: ModelFile
    base_link: NonEmptyText
    tool_frame: NonEmptyText
    base: PoseSpec
    home: Annotated[tuple[Finite, ...], Field(min_length=1)]
    limits: JointLimits
    ik: Literal["ur", "numerical"] = "numerical"
    payload: Positive
    pedestal_side: Annotated[float, InRange(0.0, 1.0)] = 0.0

    @field_validator("limits")
    @classmethod
    def _check_limit_lengths(cls, limits: JointLimits, info: ValidationInfo) -> JointLimits:
        """Refuse limits of another number of joints than `home` has."""
        joints = len(info.data.get("home", ()))
        for name, values in limits:
            if joints and values is not None and len(values) != joints:
                found = f"{name}: {len(values)} values"
                raise rejected_error(f"{found}; allowed are {joints}, as robot.home has")
        return limits

    @property
    def X_TB(self) -> RigidTransform:
        """Pose of the base."""
        return self.base.transform
