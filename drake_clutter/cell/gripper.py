"""Protocol of grippers: grasps, load capacity and SDF model.

A gripper has one or more tools, each with a frame of its own: a suction cup, or a pair of jaws.

Frames: T is the support; F is the robot's flange; G is a tool, its origin at the contact with the
object, z out of the tool, into the object; O is the object.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import islice
from typing import Protocol, overload

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
        p_FCm: Center of mass [m], rounded, so that cached plants can be reused. Shape (3,).
        max_acceleration: Largest acceleration of the load in any direction [m/s^2]; infinite
            without a load.
    """

    mass: float = 0.0
    p_FCm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    max_acceleration: float = math.inf

    @property
    def max_axis_acceleration(self) -> float:
        """Limit of each component that keeps the vector within its limit [m/s^2]."""
        return self.max_acceleration / math.sqrt(3)


@dataclass(frozen=True)
class Tool:
    """Part of a gripper that can hold an object.

    Attributes:
        name: Name.
        frame: Frame or link of the SDF model that is G.
        X_FG: Pose of G in the flange without load.
        contact_links: Links that touch a grasped object.
        compliant_joint: Index, among the joints of the gripper, of the joint along which the tool
            yields; None if it is rigid.
    """

    name: str
    frame: str
    X_FG: RigidTransform
    contact_links: tuple[str, ...]
    compliant_joint: int | None


@dataclass(frozen=True)
class Grasp:
    """Grasp of a tool.

    Attributes:
        tool: Name of the tool.
        X_TG: Pose of the tool: of a cup with its origin on the surface of the object.
        payload: Load after the grasp.
        num_angles: Number of equally good angles about the axis of the tool, evenly spaced; 0 for
            any angle.
        insertion: Distance by which the tool reaches below the top of the object [m].
        joints_open: Positions of the actuated joints before and after the grasp [m].
        joints_held: Positions of the actuated joints while the object is held [m].
    """

    tool: str
    X_TG: RigidTransform
    payload: Payload
    num_angles: int = 0
    insertion: float = 0.0
    joints_open: tuple[float, ...] = ()
    joints_held: tuple[float, ...] = ()


class LazyGrasps(Sequence[Grasp]):
    """Grasps that are sampled when they are first used; most plans need only the first."""

    def __init__(self, grasps: Iterator[Grasp]) -> None:
        """Take the grasps.

        Args:
            grasps: Samples the grasps.
        """
        self._sampled = list[Grasp]()
        self._rest = grasps

    @overload
    def __getitem__(self, index: int) -> Grasp: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Grasp]: ...
    def __getitem__(self, index: int | slice) -> Grasp | Sequence[Grasp]:
        """Return the grasp of an index, or those of a slice."""
        if isinstance(index, int) and index >= 0:
            self._sampled += islice(self._rest, max(0, index + 1 - len(self._sampled)))
        else:
            self._sampled += self._rest
        return self._sampled[index]

    def __len__(self) -> int:
        """Return the number of grasps, all of which are sampled."""
        self._sampled += self._rest
        return len(self._sampled)


class GraspFailureReason(Enum):
    """Reasons why a gripper has no grasp."""

    NO_SEAL = "no seal"
    NO_OPPOSED_FACES = "no opposed faces"
    TOO_HEAVY = "too heavy"
    TOO_WEAK = "grasp too weak"


@dataclass(frozen=True)
class GraspFailure:
    """Reason why a gripper has no grasp on an object.

    Attributes:
        reason: Failure of the sampled grasp that came closest to being feasible.
        value: Flatness deviation or gap under the best grasp [m] if no grasp seals, distance of the
            narrowest opposed faces or height [m] if none are between the jaws, or mass of the
            object [kg] if it is too heavy; of a given grasp that is too weak the acceleration that
            it bears [m/s^2], negative if it does not hold the object at rest.
    """

    reason: GraspFailureReason
    value: float


UP = (0.0, 0.0, 1.0)
"""Outward normal of a level surface, in T. Shape (3,)."""


@dataclass(frozen=True)
class GraspSampling:
    """Parameters of grasp sampling.

    Attributes:
        spacing: Distance of neighboring grasp points [m].
        lip_gap: Gap between gripper and object when the gripper is switched on [m].
        max_grasps: Largest number of grasps of a tool.
        min_payload_acceleration: A grasp must hold the object at this acceleration [m/s^2].
        normal: Direction in T from which the object is seen; surfaces whose normal differs by at
            most 45 deg are grasped. Shape (3,).
    """

    spacing: float
    lip_gap: float
    max_grasps: int
    min_payload_acceleration: float
    normal: tuple[float, float, float] = UP


class Gripper(Protocol):
    """Model of a gripper; `GripperActuator` is its counterpart in a simulation."""

    @property
    def kind(self) -> str:
        """Kind of the gripper in a cell file."""

    @property
    def description(self) -> str:
        """Kind and sizes in a few words, for reports."""

    @property
    def safety(self) -> float:
        """Safety factor of the load capacity in planning."""

    @property
    def mass(self) -> float:
        """Mass that counts towards the payload of the robot [kg]."""

    @property
    def tools(self) -> Mapping[str, Tool]:
        """Tools by name; the first is preferred."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints of the model in which all parts can move, in order."""

    @property
    def num_joints(self) -> int:
        """Number of joints of the model in which all parts can move."""

    @property
    def num_actuated_joints(self) -> int:
        """Number of joints that are commanded; they are the first ones."""

    def model_sdf(self, *, compliant: bool, actuated: bool) -> str:
        """Return the SDF model; link `body` has frame F, and `Tool.frame` is frame G of a tool.

        Args:
            compliant: Whether compliant parts can move, in a simulation; planning uses the rigid
                model.
            actuated: Whether actuated parts can move; else they are fixed, opened.
        """

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> Sequence[Grasp] | GraspFailure:
        """Return feasible grasps of an object, the preferred ones first.

        There is at least one. The others may be sampled when they are first used.

        `can_attach` holds at each of them, moved back by `GraspSampling.lip_gap`.

        Args:
            object_class: Class of the object.
            X_TO: Pose of the object.
            sampling: Parameters of the sampling.
        """

    def make_grasp(
        self,
        tool: str,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        X_TG: RigidTransform,
        sampling: GraspSampling,
    ) -> Grasp | GraspFailure:
        """Return the grasp at a given pose of a tool, or why it does not hold the object.

        Args:
            tool: Name of the tool.
            object_class: Class of the object.
            X_TO: Pose of the object.
            X_TG: Pose of the tool: of a cup with its origin on the surface of the object.
            sampling: Gap and acceleration that count for sampled grasps, too.
        """

    def max_acceleration(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> float:
        """Return the largest acceleration of a load, see `max_payload_acceleration`.

        Args:
            tool: Name of the tool.
            mass: Mass of the load [kg].
            p_GCm: Center of mass of the load [m]. Shape (3,).
            down_G: Direction of gravity in G, a unit vector. Shape (3,).
        """

    def load_ratio(self, tool: str, force: Floats, moment: Floats) -> Floats:
        """Return the ratio of a load to the load capacity of a tool, which fails above 1.

        Args:
            tool: Name of the tool.
            force: Force of the object on the tool, in G [N]. Shape (..., 3).
            moment: Moment of the object about G, in G [N m]. Shape (..., 3).

        Returns:
            Ratios. Shape (...).
        """

    def deflection(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> RigidTransform:
        """Return the pose of a tool with a load at rest in the pose G that the rigid model has.

        Args:
            tool: Name of the tool.
            mass: Mass of the load [kg].
            p_GCm: Center of mass of the load [m]. Shape (3,).
            down_G: Direction of gravity in G, a unit vector. Shape (3,).
        """

    def can_attach(self, tool: str, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether a tool can attach to an object at a pose.

        Args:
            tool: Name of the tool.
            object_class: Class of the object.
            X_OG: Pose of the tool in the object.
        """
