"""Robot of a work cell as data.

Frames: T is the support, B is the robot's base, F is its flange, z out of the arm.
"""

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
    """Limits of the joints, in their order; None for the limits of the model file.

    Attributes:
        position: Lower and upper position limits [rad].
        velocity: Velocity limits [rad/s].
        acceleration: Acceleration limits [rad/s^2].
        jerk: Jerk limits [rad/s^3].
        torque: Torque limits [N m].
    """

    position: tuple[tuple[Finite, Finite], ...] | None = None
    velocity: tuple[Positive, ...] | None = None
    acceleration: tuple[Positive, ...]
    jerk: tuple[Positive, ...] | None = None
    torque: tuple[Positive, ...] | None = None


class RobotSpec(StrictModel):
    """Robot with its mounting, limits and payload.

    Attributes:
        model: SDF or URDF file: a path relative to the cell file, or a path in `models/` that
            starts with `package://drake_clutter_models/`.
        base_link: Name of the link that is welded to the base pose.
        tool_frame: Name of the frame or link F on which the gripper is mounted.
        base: Pose X_TB.
        home: Configuration in which moves start and end, and in which the arm does not occlude the
            support [rad].
        limits: Limits of the joints.
        tool_speed: Largest speed of the tools' origins in planned motions [m/s]; None for no limit.
        ik: Inverse kinematics: `ur` for the closed form of the UR family, or `numerical`.
        payload: Largest mass of gripper and object together [kg].
        pedestal_side: Side of the square pedestal between table and base [m]; 0 for no pedestal.
    """

    model: ModelFile
    base_link: NonEmptyText
    tool_frame: NonEmptyText
    base: PoseSpec
    home: Annotated[tuple[Finite, ...], Field(min_length=1)]
    limits: JointLimits
    tool_speed: Positive | None = None
    ik: Literal["ur", "numerical"] = "numerical"
    payload: Positive
    pedestal_side: Annotated[float, InRange(0.0, 1.0)] = 0.0

    @field_validator("limits")
    @classmethod
    def _check_limit_lengths(cls, limits: JointLimits, info: ValidationInfo) -> JointLimits:
        """Raise an error unless there are as many limits as joints in `home`."""
        joints = len(info.data.get("home", ()))
        for name, values in limits:
            if joints and values is not None and len(values) != joints:
                found = f"{name}: {len(values)} values"
                raise rejected_error(f"{found}; expected {joints}, as robot.home has")
        return limits

    @property
    def X_TB(self) -> RigidTransform:
        """Pose of the base in T."""
        return self.base.transform
