"""Grasp constraints: two models of an object attached to the suction cup.

`WeldGrasp` locks a floating joint between cup and object. `CompliantGrasp` activates six distance
constraints between them, arranged like the legs of a Stewart platform.

Frames: G is the gripper, its origin at the center of the cup's lip; O is the object.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.multibody.plant import DistanceConstraintParams, MultibodyPlant
from pydrake.multibody.tree import QuaternionFloatingJoint, RigidBody
from pydrake.systems.framework import Context

from drake_clutter.cell.epick import CUP_MASS
from drake_clutter.cell.suction import GRAVITY
from drake_clutter.simulation.cell_plant import Arm

Floats = NDArray[np.float64]


class GraspConstraint(Protocol):
    """Attaches an object to the suction cup; created before the plant is finalized."""

    def reset(self, context: Context) -> None:
        """Detach any object; called once on every new context.

        Args:
            context: Context of the plant.
        """

    def attach(self, context: Context, body: RigidBody) -> None:
        """Attach an object at its current pose.

        Args:
            context: Context of the plant.
            body: Body of the object.
        """

    def detach(self, context: Context) -> None:
        """Detach the object.

        Args:
            context: Context of the plant.
        """

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip.

        Args:
            context: Context of the plant.

        Returns:
            Force [N] and moment [N m] in G. Shapes (3,).
        """


def _cup_load(plant: MultibodyPlant, arm: Arm, context: Context) -> tuple[Floats, Floats]:
    """Return force and moment in the bellows joint without the cup's weight, in G."""
    bellows = plant.GetJointByName("bellows", arm.tool)
    reaction = plant.get_reaction_forces_output_port().Eval(context)[bellows.index()]
    down_G = -arm.cup.CalcPoseInWorld(context).rotation().matrix()[2]
    weight = GRAVITY * CUP_MASS * down_G
    return -np.asarray(reaction.translational() + weight), -np.asarray(reaction.rotational())


class WeldGrasp:
    """Rigid grasp: a floating joint between cup and object that is locked.

    The joint replaces the free joint of the object, so only one object can be attached.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, body: RigidBody) -> None:
        self._plant = plant
        self._arm = arm
        self._joint = plant.AddJoint(QuaternionFloatingJoint("hold", arm.cup, body.body_frame()))

    def reset(self, context: Context) -> None:
        """Detach any object, see `GraspConstraint`."""
        self._joint.Unlock(context)

    def set_object_pose(self, context: Context, X_TO: RigidTransform) -> None:
        """Set the pose of the detached object."""
        self._joint.SetPose(context, self._arm.cup.CalcPoseInWorld(context).inverse() @ X_TO)

    def attach(self, context: Context, body: RigidBody) -> None:
        """Attach the object of the joint, see `GraspConstraint`."""
        velocities = self._plant.GetVelocities(context)
        start = self._joint.velocity_start()
        velocities[start : start + 6] = 0.0
        self._plant.SetVelocities(context, velocities)
        self._joint.Lock(context)

    def detach(self, context: Context) -> None:
        """Detach the object, see `GraspConstraint`."""
        self._joint.Unlock(context)

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip, see `GraspConstraint`."""
        return _cup_load(self._plant, self._arm, context)


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

    def __init__(self, plant: MultibodyPlant, arm: Arm) -> None:
        self._plant = plant
        self._arm = arm
        self._cup = plant.GetBodyByName("cup", arm.tool)
        # Inactive constraints need two bodies, too.
        other = plant.GetBodyByName("body", arm.tool)
        self._legs = [
            plant.AddDistanceConstraint(self._cup, upper, other, lower, 1.0)
            for upper, lower in _LEGS
        ]

    def reset(self, context: Context) -> None:
        """Detach any object, see `GraspConstraint`."""
        self.detach(context)

    def attach(self, context: Context, body: RigidBody) -> None:
        """Attach an object, see `GraspConstraint`."""
        X_OG = body.EvalPoseInWorld(context).inverse() @ self._arm.cup.CalcPoseInWorld(context)
        for leg, (upper, lower) in zip(self._legs, _LEGS, strict=True):
            length = float(np.linalg.norm(upper - lower))
            params = DistanceConstraintParams(
                self._cup.index(),
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

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """Return the load of the object on the lip, see `GraspConstraint`."""
        return _cup_load(self._plant, self._arm, context)
