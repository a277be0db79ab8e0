"""Protocol of grippers: grasps, load capacity and SDF model.

Frames: T is the support; F is the robot's flange; G is the gripper, its origin at the contact with
the object, z out of the tool, into the object; O is the object.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.catalog import ObjectClass

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Payload:
    """Load of a gripper.

    Attributes:
        mass: Mass [kg].
        p_GCm: Center of mass [m], rounded, so that cached plants can be reused. Shape (3,).
        max_acceleration: Largest acceleration of G in any direction [m/s^2]; infinite without a
            load.
    """

    mass: float = 0.0
    p_GCm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    max_acceleration: float = math.inf

    @property
    def max_axis_acceleration(self) -> float:
        """Limit of each component that keeps the vector within its limit [m/s^2]."""
        return self.max_acceleration / math.sqrt(3)


@dataclass(frozen=True)
class Grasp:
    """Grasp of a gripper that points down, at any yaw.

    Attributes:
        p_TG: Position on the top of the object [m]. Shape (3,).
        payload: Load after the grasp.
    """

    p_TG: Floats
    payload: Payload


class GraspFailureReason(Enum):
    """Reasons why a gripper has no grasp."""

    NO_SEAL = "no seal"
    TOO_HEAVY = "too heavy"


@dataclass(frozen=True)
class GraspFailure:
    """Reason why a gripper has no grasp on an object.

    Attributes:
        reason: Failure of the sampled grasp that came closest to being feasible.
        value: Flatness deviation or gap under the best grasp [m] if no grasp seals, or mass of the
            object [kg] if it is too heavy.
    """

    reason: GraspFailureReason
    value: float


@dataclass(frozen=True)
class GraspSampling:
    """Parameters of grasp sampling.

    Attributes:
        spacing: Distance of neighboring grasp points [m].
        lip_gap: Gap between gripper and object when the gripper is switched on [m].
        max_grasps: Largest number of grasps.
        min_payload_acceleration: A grasp must hold the object at this acceleration [m/s^2].
    """

    spacing: float
    lip_gap: float
    max_grasps: int
    min_payload_acceleration: float


class Gripper(Protocol):
    """Model of a gripper; `GripperActuator` is its counterpart in a simulation."""

    @property
    def kind(self) -> str:
        """Kind of the gripper in a cell file."""

    @property
    def mass(self) -> float:
        """Mass that counts towards the payload of the robot [kg]."""

    @property
    def X_FG(self) -> RigidTransform:
        """Pose of G in the flange without load."""

    @property
    def contact_links(self) -> tuple[str, ...]:
        """Names of the links that touch a grasped object."""

    def model_sdf(self, *, compliant: bool) -> str:
        """Return the SDF model; link `body` has frame F, link `cup` has frame G.

        Args:
            compliant: Whether compliant parts can move; planning uses the rigid model.
        """

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> tuple[Grasp, ...] | GraspFailure:
        """Return feasible grasps from above, the closest to the center of mass first.

        `can_attach` holds at each of them, raised by `GraspSampling.lip_gap`.

        Args:
            object_class: Class of the object.
            X_TO: Pose of the object.
            sampling: Parameters of the sampling.
        """

    def can_attach(self, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether the gripper can attach to an object at a pose.

        Args:
            object_class: Class of the object.
            X_OG: Pose of the gripper in the object.
        """

    def max_acceleration(self, mass: float, p_GCm: Floats) -> float:
        """Return the largest acceleration of a load in any direction.

        Args:
            mass: Mass of the load [kg].
            p_GCm: Center of mass of the load [m]. Shape (3,).

        Returns:
            Acceleration including the safety factor [m/s^2]; negative if the load cannot be held.
        """

    def load_ratio(self, force: Floats, moment: Floats) -> Floats:
        """Return the ratio of a load to the load capacity; the object detaches above 1.

        Args:
            force: Force of the object on the gripper, in G [N]. Shape (..., 3).
            moment: Moment of the object about G, in G [N m]. Shape (..., 3).

        Returns:
            Load ratio. Shape (...).
        """
