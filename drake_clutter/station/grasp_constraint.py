"""Grasp constraints: two models of an object attached to a suction cup.

`WeldGrasp` locks a floating joint between cup and object. `CompliantGrasp` activates six distance
constraints between them, arranged like the legs of a Stewart platform.

Frames: G is a cup, its origin at the center of the lip; O is the object.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import DistanceConstraintParams, MultibodyPlant
from pydrake.multibody.tree import QuaternionFloatingJoint, RigidBody
from pydrake.systems.framework import Context

from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.simulation.cell_plant import Arm

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class WeldPair:
    """The only object that can be grasped with a `WeldGrasp`, and the tool that grasps it.

    Attributes:
        object_name: Name of the object.
        tool: Name of the tool.
    """

    object_name: str
    tool: str


class GraspConstraint(Protocol):
    """Attaches an object to a suction cup; created before the plant is finalized."""

    def reset(self, context: Context) -> None:
        """Detach any object; called once on every new context.

        Args:
            context: Context of the plant.
        """

    def attach(self, context: Context, tool: str, body: RigidBody) -> None:
        """Attach an object at its current pose.

        Args:
            context: Context of the plant.
            tool: Name of the cup.
            body: Body of the object.
        """

    def detach(self, context: Context) -> None:
        """Detach the object.

        Args:
            context: Context of the plant.
        """

    def load(self, context: Context, tool: str) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip.

        Args:
            context: Context of the plant.
            tool: Name of the cup.

        Returns:
            Force [N] and moment [N m] in G. Shapes (3,).
        """


class _CupLoad:
    """Load on the cups of a suction gripper."""

    def __init__(self, plant: MultibodyPlant, arm: Arm, gripper: SuctionGripper) -> None:
        self._plant = plant
        self._arm = arm
        self._cups = {cup.name: cup for cup in gripper.cups}

    def calc(self, context: Context, tool: str) -> tuple[Floats, Floats]:
        """Return force and moment about the lip in the last joint without the lip's weight, in G.

        The inertia of the lip's link is neglected.
        """
        cup = self._cups[tool]
        joint = self._plant.GetJointByName(cup.joints[-1], self._arm.gripper)
        reaction = self._plant.get_reaction_forces_output_port().Eval(context)[joint.index()]
        down_G = -self._arm.tools[tool].CalcPoseInWorld(context).rotation().matrix()[2]
        weight = GRAVITY * cup.link_mass * down_G
        p_GHinge = np.array([0.0, 0.0, -cup.hinge_distance])
        p_GCm = np.array([0.0, 0.0, -cup.length / 2])
        force = reaction.translational()
        moment = reaction.rotational() + np.cross(p_GHinge, force) + np.cross(p_GCm, weight)
        return -np.asarray(force + weight), -np.asarray(moment)


class WeldGrasp:
    """Rigid grasp: a floating joint between cup and object that is locked.

    The joint replaces the free joint of the object, so only one object can be attached.
    """

    def __init__(
        self, plant: MultibodyPlant, arm: Arm, gripper: SuctionGripper, tool: str, body: RigidBody
    ) -> None:
        self._plant = plant
        self._cup = arm.tools[tool]
        self._load = _CupLoad(plant, arm, gripper)
        self._joint = plant.AddJoint(QuaternionFloatingJoint("hold", self._cup, body.body_frame()))

    def reset(self, context: Context) -> None:
        """Detach any object, see `GraspConstraint`."""
        self._joint.Unlock(context)

    def set_object_pose(self, context: Context, X_TO: RigidTransform) -> None:
        """Set the pose of the detached object."""
        self._joint.SetPose(context, self._cup.CalcPoseInWorld(context).inverse() @ X_TO)

    def attach(self, context: Context, tool: str, body: RigidBody) -> None:
        """Attach the object of the joint, see `GraspConstraint`."""
        velocities = self._plant.GetVelocities(context)
        start = self._joint.velocity_start()
        velocities[start : start + 6] = 0.0
        self._plant.SetVelocities(context, velocities)
        self._joint.Lock(context)

    def detach(self, context: Context) -> None:
        """Detach the object, see `GraspConstraint`."""
        self._joint.Unlock(context)

    def load(self, context: Context, tool: str) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip, see `GraspConstraint`."""
        return self._load.calc(context, tool)


_PLATFORM_RADIUS = 0.08
"""Radius and distance of the platforms [m]: forces and moments load the legs about equally."""
_LEG_STIFFNESS = 1e4
"""Stiffness of a leg [N/m]. Rubber is compliant in all directions; with stiff legs, tracking errors
of the arm would cause peaks of the load."""
_LEG_DAMPING = 100.0
"""Damping of a leg [N s/m]."""
_ANGLE = 2 * math.pi / 3
"""Angle between neighboring points of a platform [rad]."""
_UPPER_POINTS = np.array(
    [
        [
            _PLATFORM_RADIUS * math.cos(k * _ANGLE),
            _PLATFORM_RADIUS * math.sin(k * _ANGLE),
            -_PLATFORM_RADIUS,
        ]
        for k in (0, 1, 2)
    ]
)
"""Points of the legs on the cup, in G [m]. Shape (3, 3)."""
_LOWER_POINTS = np.array(
    [
        [
            _PLATFORM_RADIUS * math.cos((k + 0.5) * _ANGLE),
            _PLATFORM_RADIUS * math.sin((k + 0.5) * _ANGLE),
            0.0,
        ]
        for k in (0, 1, 2)
    ]
)
"""Points of the legs on the object, in G at attachment [m]. Shape (3, 3)."""
_LEGS = [(_UPPER_POINTS[k], _LOWER_POINTS[j % 3]) for k in (0, 1, 2) for j in (k, k + 2)]
"""Upper and lower point of each leg."""


class CompliantGrasp:
    """Compliant grasp of any object: six distance constraints.

    They connect three points of the cup above the lip with three points of the object at the lip.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, gripper: SuctionGripper) -> None:
        self._plant = plant
        self._cups = arm.tools
        self._load = _CupLoad(plant, arm, gripper)
        # Inactive constraints need two bodies, too.
        cup = next(iter(arm.tools.values())).body()
        other = plant.GetBodyByName("body", arm.gripper)
        self._legs = [
            plant.AddDistanceConstraint(cup, upper, other, lower, 1.0) for upper, lower in _LEGS
        ]

    def reset(self, context: Context) -> None:
        """Detach any object, see `GraspConstraint`."""
        self.detach(context)

    def attach(self, context: Context, tool: str, body: RigidBody) -> None:
        """Attach an object, see `GraspConstraint`."""
        cup = self._cups[tool]
        X_OG = body.EvalPoseInWorld(context).inverse() @ cup.CalcPoseInWorld(context)
        for leg, (upper, lower) in zip(self._legs, _LEGS, strict=True):
            length = float(np.linalg.norm(upper - lower))
            params = DistanceConstraintParams(
                cup.body().index(),
                upper,
                body.index(),
                X_OG @ lower,
                length,
                _LEG_STIFFNESS,
                _LEG_DAMPING,
            )
            self._plant.SetDistanceConstraintParams(context, leg, params)
            self._plant.SetConstraintActiveStatus(context, leg, True)

    def detach(self, context: Context) -> None:
        """Detach the object, see `GraspConstraint`."""
        for leg in self._legs:
            self._plant.SetConstraintActiveStatus(context, leg, False)

    def load(self, context: Context, tool: str) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip, see `GraspConstraint`."""
        return self._load.calc(context, tool)
