"""What a gripper of a cell is asked: where it grasps, what it holds, and how it looks in a plant.

Frames: T the support; F the robot's flange; G the gripper, origin where it touches an object, z out
of the tool, into the object; O the object.
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
    """What a gripper carries.

    Attributes:
        mass: [kg].
        p_GCm: Center of mass, rounded, so that plants can be kept [m]. Shape (3,).
        max_acceleration: Greatest of G, in any direction; infinite without a load [m/s^2].
    """

    mass: float = 0.0
    p_GCm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    max_acceleration: float = math.inf

    @property
    def max_axis_acceleration(self) -> float:
        """Greatest acceleration along each axis, so that the vector is within the limit [m/s^2]."""
        return self.max_acceleration / math.sqrt(3)


@dataclass(frozen=True)
class Grasp:
    """Where a gripper that points down takes an object, at any yaw.

    Attributes:
        p_TG: On the object's top [m]. Shape (3,).
        payload: What is carried then.
    """

    p_TG: Floats
    payload: Payload


class GraspFailureReason(Enum):
    """Why a gripper offers no grasp."""

    NO_SEAL = "no seal"
    TOO_HEAVY = "too heavy"


@dataclass(frozen=True)
class GraspFailure:
    """No grasp, and the number behind the reason.

    Attributes:
        reason: Of the grasp that came furthest.
        value: Deviation from a plane under the best grasp [m], or the object's mass [kg].
    """

    reason: GraspFailureReason
    value: float


@dataclass(frozen=True)
class GraspSampling:
    """How densely grasps are sampled.

    Attributes:
        spacing: Between neighboring points of a face [m].
        max_grasps: Largest number of grasps.
        min_payload_acceleration: That a grasp must bear [m/s^2].
    """

    spacing: float
    max_grasps: int
    min_payload_acceleration: float


class Gripper(Protocol):
    """A gripper as data. How it acts in a simulation is the station's."""

    @property
    def kind(self) -> str:
        """Name of its kind in a cell's file."""

    @property
    def mass(self) -> float:
        """Counts towards the robot's payload [kg]."""

    @property
    def X_FG(self) -> RigidTransform:
        """Frame G without a load."""

    @property
    def contact_links(self) -> tuple[str, ...]:
        """Links of its model that touch what it holds."""

    def model_sdf(self, *, compliant: bool) -> str:
        """Return its model: link `body` has frame F, link `cup` has frame G.

        Args:
            compliant: False for a rigid model, as planning uses it.
        """

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> tuple[Grasp, ...] | GraspFailure:
        """Return where it grasps an object from above, the nearest to its middle first."""

    def can_attach(self, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether it takes hold of an object at a pose."""

    def max_acceleration(self, mass: float, p_GCm: Floats) -> float:
        """Return with which acceleration it may move a load in any direction [m/s^2].

        Args:
            mass: [kg].
            p_GCm: Center of mass [m]. Shape (3,).

        Returns:
            Safety included; negative if it cannot hold the load.
        """

    def load_ratio(self, force: Floats, moment: Floats) -> Floats:
        """Return which share of what it bears a load takes up; above 1 the object comes off.

        Args:
            force: Of the object on the gripper, in G [N]. Shape (..., 3).
            moment: About G [N m]. Shape (..., 3).
        """
