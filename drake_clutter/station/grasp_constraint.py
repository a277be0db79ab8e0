"""Two ways to fix an object to the cup in a plant, at the pose that it has then.

`WeldGrasp` is a floating joint from the cup to the object that is locked. `CompliantGrasp` is six
distance constraints, the legs of a Stewart platform, whose feet are set when it is switched on.
docs/arm.md compares them.
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
    """Fixes an object to the cup of an arm; made before the plant is finalized."""

    def reset(self, context: Context) -> None:
        """Hold nothing; called once on every new context of the plant."""

    def attach(self, context: Context, body: RigidBody) -> None:
        """Hold an object where it is."""

    def detach(self, context: Context) -> None:
        """Let it go."""

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """Return force [N] and moment [N m] of the object on the cup's lip, in G. Shapes (3,)."""


def _cup_load(plant: MultibodyPlant, arm: Arm, context: Context) -> tuple[Floats, Floats]:
    """Return the load of the cup without its own weight, from the reaction in the bellows; in G."""
    bellows = plant.GetJointByName("bellows", arm.tool)
    reaction = plant.get_reaction_forces_output_port().Eval(context)[bellows.index()]
    down_G = -arm.cup.CalcPoseInWorld(context).rotation().matrix()[2]
    weight = GRAVITY * CUP_MASS * down_G
    return -np.asarray(reaction.translational() + weight), -np.asarray(reaction.rotational())


class WeldGrasp:
    """A floating joint between cup and one object, locked while it holds.

    It replaces the object's joint to the world.
    """

    def __init__(self, plant: MultibodyPlant, arm: Arm, body: RigidBody) -> None:
        self._plant, self._arm = plant, arm
        self._joint = plant.AddJoint(QuaternionFloatingJoint("hold", arm.cup, body.body_frame()))

    def reset(self, context: Context) -> None:
        """See `GraspConstraint`."""
        self._joint.Unlock(context)

    def set_object_pose(self, context: Context, X_TO: RigidTransform) -> None:
        """Put the object at a pose."""
        self._joint.SetPose(context, self._arm.cup.CalcPoseInWorld(context).inverse() @ X_TO)

    def attach(self, context: Context, body: RigidBody) -> None:
        """See `GraspConstraint`; the object is the one that it was made for."""
        velocities, start = self._plant.GetVelocities(context), self._joint.velocity_start()
        velocities[start : start + 6] = 0.0
        self._plant.SetVelocities(context, velocities)
        self._joint.Lock(context)

    def detach(self, context: Context) -> None:
        """See `GraspConstraint`."""
        self._joint.Unlock(context)

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """See `GraspConstraint`."""
        return _cup_load(self._plant, self._arm, context)


_PLATFORM_RADIUS = 0.08
"""Size of the platforms [m]: forces and moments load the legs about equally."""
_LEG_STIFFNESS, _LEG_DAMPING = 1e4, 100.0
"""[N/m] and [N s/m]: rubber yields a little in every direction; stiff legs would tear at the seal
with every tracking error."""
_ANGLE = 2 * math.pi / 3
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
_LEGS = [(_UPPER_POINTS[k], _LOWER_POINTS[j % 3]) for k in (0, 1, 2) for j in (k, k + 2)]


class CompliantGrasp:
    """Six distance constraints from points above the lip to points around it; for any object."""

    def __init__(self, plant: MultibodyPlant, arm: Arm) -> None:
        self._plant, self._arm = plant, arm
        self._cup = plant.GetBodyByName("cup", arm.tool)
        # Between any two bodies, as long as nothing is held.
        other = plant.GetBodyByName("body", arm.tool)
        self._legs = [
            plant.AddDistanceConstraint(self._cup, top, other, foot, 1.0) for top, foot in _LEGS
        ]

    def reset(self, context: Context) -> None:
        """See `GraspConstraint`."""
        self.detach(context)

    def attach(self, context: Context, body: RigidBody) -> None:
        """See `GraspConstraint`."""
        X_OG = body.EvalPoseInWorld(context).inverse() @ self._arm.cup.CalcPoseInWorld(context)
        for leg, (top, foot) in zip(self._legs, _LEGS, strict=True):
            ends = self._cup.index(), top, body.index(), X_OG @ foot
            params = DistanceConstraintParams(
                *ends, float(np.linalg.norm(top - foot)), _LEG_STIFFNESS, _LEG_DAMPING
            )
            self._plant.SetDistanceConstraintParams(context, leg, params)
            self._plant.SetConstraintActiveStatus(context, leg, True)

    def detach(self, context: Context) -> None:
        """See `GraspConstraint`."""
        for leg in self._legs:
            self._plant.SetConstraintActiveStatus(context, leg, False)

    def load(self, context: Context) -> tuple[Floats, Floats]:
        """See `GraspConstraint`."""
        return _cup_load(self._plant, self._arm, context)
