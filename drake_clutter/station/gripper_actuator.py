"""How a gripper acts in a running simulation.

Taking an object changes parameters of the plant, which no system may do to another: an actuator is
called by the simulation's monitor instead.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_clutter.cell.suction import lip_surface_profile
from drake_clutter.station.clutter_station import ClutterStation

GRIPPER_UPDATE_PERIOD = 0.01
"""Between two looks at the load, and at whether the gripper is to hold [s]."""
OVERLOAD_RELEASE_TIME = 0.02
"""Of overload, in which air gets in [s]."""
MAX_SEAL_GAP = 0.005
"""Between lip and surface, at which the vacuum can build up [m]."""


@dataclass(frozen=True)
class GraspStatus:
    """What a gripper holds, and what became of it since it was last commanded on.

    Attributes:
        held: Name of the object that is held; "" for none.
        last_held: Name of the object that was held last; "" for none.
        release_time: When the object came off by its load [s]; NaN if it did not.
        max_load_ratio: Largest load over what the gripper can bear.
        slip: Between gripper and object, from when it was taken to when it was let go [m]; NaN
            before.
    """

    held: str = ""
    last_held: str = ""
    release_time: float = math.nan
    max_load_ratio: float = 0.0
    slip: float = math.nan

    @property
    def has_held(self) -> bool:
        """Whether an object was held."""
        return self.last_held != ""

    @property
    def lost_object(self) -> bool:
        """Whether the object came off by its load."""
        return not math.isnan(self.release_time)


class GripperActuator(Protocol):
    """Takes objects and lets them go, in a running simulation.

    Attributes:
        status: What it holds.
    """

    status: GraspStatus

    def reset(self) -> None:
        """Begin anew in a context in which nothing is held."""

    def update(self, root: Context) -> None:
        """Act; called after every step with the context of the whole diagram."""


class SuctionActuator:
    """Switches the constraint between cup and object on and off.

    Attributes:
        status: What hangs on the cup.
    """

    def __init__(self, station: ClutterStation, is_commanded_on: Callable[[Context], bool]) -> None:
        """Make an actuator.

        Args:
            station: Whose cup.
            is_commanded_on: Whether the vacuum is to be on, from the root context.
        """
        self._station = station
        self._is_commanded_on = is_commanded_on
        self.reset()

    def reset(self) -> None:
        """See `GripperActuator`."""
        self.status = GraspStatus()
        self._was_commanded_on = False
        self._num_overloads = 0  # updates in a row
        self._last_update = -math.inf
        self._X_OG = RigidTransform()  # when the object was taken

    def update(self, root: Context) -> None:
        """See `GripperActuator`."""
        time = root.get_time()
        if 0 <= time - self._last_update < GRIPPER_UPDATE_PERIOD - self._station.time_step / 2:
            return
        self._last_update = time
        context, on = self._station.plant_context(root), self._is_commanded_on(root)
        if on and not self._was_commanded_on:
            self.status, self._num_overloads = GraspStatus(held=self.status.held), 0
        self._was_commanded_on = on
        if on and not self.status.held and not self.status.lost_object:
            self._try_attach(context)
        elif self.status.held and not on:
            self._release(context)
        elif self.status.held:
            self._check_overload(context, time)

    def _check_overload(self, context: Context, time: float) -> None:
        """Let go what has been too heavy for too long."""
        load = self._station.grasp.load(context)
        ratio = float(self._station.cell.gripper.load_ratio(*load))
        largest = max(self.status.max_load_ratio, ratio)
        self.status = replace(self.status, max_load_ratio=largest)
        self._num_overloads = self._num_overloads + 1 if ratio > 1 else 0
        if self._num_overloads * GRIPPER_UPDATE_PERIOD > OVERLOAD_RELEASE_TIME:
            self.status = replace(self.status, release_time=time)
            self._release(context)

    def _cup_pose_in_object(self, context: Context, name: str) -> RigidTransform:
        """Return X_OG."""
        X_TG = self._station.arm.cup.CalcPoseInWorld(context)
        X_TO = self._station.scene_plant.bodies[name].EvalPoseInWorld(context)
        return X_TO.inverse() @ X_TG

    def _try_attach(self, context: Context) -> None:
        """Take the object that is first under the lip, if close enough and the lip seals on it."""
        station, suction = self._station, self._station.cell.gripper
        grasps = {
            name: self._cup_pose_in_object(context, name) for name in station.graspable_objects
        }
        gaps = {
            name: lip_surface_profile(
                station.object_classes[name], X_OG, suction.cup_diameter
            ).min()
            for name, X_OG in grasps.items()
        }
        if not gaps:
            return
        first = min(gaps, key=lambda name: gaps[name])
        seals = suction.can_attach(station.object_classes[first], grasps[first])
        if gaps[first] <= MAX_SEAL_GAP and seals:
            station.grasp.attach(context, station.scene_plant.bodies[first])
            self.status = replace(self.status, held=first, last_held=first)
            self._X_OG = grasps[first]

    def _release(self, context: Context) -> None:
        X_OG = self._cup_pose_in_object(context, self.status.held)
        slip = float(np.linalg.norm(X_OG.translation() - self._X_OG.translation()))
        self._station.grasp.detach(context)
        self.status = replace(self.status, held="", slip=slip)
