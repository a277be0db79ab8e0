"""Actuation of a gripper in a running simulation.

Attaching an object changes parameters of the plant, which no Drake system may do to another one.
The simulation therefore calls the actuator between its steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_clutter.cell.lip_seal import lip_surface_profile
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.station.clutter_station import ClutterStation

GRIPPER_UPDATE_PERIOD = 0.0125
"""Period at which the command and the load are checked [s]."""
OVERLOAD_RELEASE_TIME = 0.02
"""Duration of an overload after which the object detaches [s].

Air leaks in during this time. Shorter peaks come from contacts.
"""


@dataclass(frozen=True)
class GraspStatus:
    """Status of a gripper since it was last commanded on.

    Attributes:
        tool: Name of the tool that was commanded on last; "" for none.
        held: Name of the object that is held; "" for none.
        last_held: Name of the object that was held last; "" for none.
        release_time: Time at which the object detached by overload [s]; NaN if it did not.
        max_load_ratio: Largest ratio of the load to the load capacity.
        slip: Displacement between object and gripper from attachment to release [m]; NaN before
            the release.
    """

    tool: str = ""
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
        """Whether the object came off by overload."""
        return not math.isnan(self.release_time)


class GripperActuator(Protocol):
    """Attaches and releases objects in a running simulation.

    Attributes:
        status: Status of the gripper.
    """

    status: GraspStatus

    def reset(self) -> None:
        """Reset the status for a new context in which no object is held."""

    def update(self, root: Context) -> None:
        """Attach or release an object.

        Args:
            root: Context of the root diagram; called every `GRIPPER_UPDATE_PERIOD`.
        """


class SuctionActuator:
    """Switches the grasp constraint between a suction cup and an object.

    Only the cup that is commanded on has a vacuum.

    Attributes:
        status: Status of the gripper.
    """

    def __init__(
        self,
        station: ClutterStation,
        gripper: SuctionGripper,
        commanded_tool: Callable[[Context], str],
    ) -> None:
        """Create an actuator.

        Args:
            station: Station with the gripper.
            gripper: The gripper.
            commanded_tool: Returns the name of the cup whose vacuum is commanded on, "" for none,
                from the root context.
        """
        self._station = station
        self._gripper = gripper
        assert station.grasp is not None
        self._grasp = station.grasp
        self._commanded_tool = commanded_tool
        self.reset()

    def reset(self) -> None:
        """Reset the status, see `GripperActuator`."""
        self.status = GraspStatus()
        self._last_tool = ""
        self._num_overloads = 0  # consecutive updates with overload
        self._X_OG = RigidTransform()  # at the last attachment

    def update(self, root: Context) -> None:
        """Attach or release an object, see `GripperActuator`."""
        time = root.get_time()
        context = self._station.plant_context(root)
        tool = self._commanded_tool(root)
        if self.status.held and tool != self.status.tool:
            self._release(context)
        if tool and tool != self._last_tool:
            self.status = GraspStatus(tool)
            self._num_overloads = 0
        self._last_tool = tool
        if tool and not self.status.held and not self.status.lost_object:
            self._try_attach(context)
        elif self.status.held:
            self._check_overload(context, time)

    def _check_overload(self, context: Context, time: float) -> None:
        """Release the object after an overload of `OVERLOAD_RELEASE_TIME`."""
        tool = self.status.tool
        force, moment = self._grasp.load(context, tool)
        ratio = float(self._gripper.load_ratio(tool, force, moment))
        max_ratio = max(self.status.max_load_ratio, ratio)
        self.status = replace(self.status, max_load_ratio=max_ratio)
        self._num_overloads = self._num_overloads + 1 if ratio > 1 else 0
        if self._num_overloads * GRIPPER_UPDATE_PERIOD > OVERLOAD_RELEASE_TIME:
            self.status = replace(self.status, release_time=time)
            self._release(context)

    def _try_attach(self, context: Context) -> None:
        """Attach the object that is closest below the lip, if the lip seals on it."""
        station = self._station
        tool = self.status.tool
        diameter = self._gripper.cup(tool).diameter
        X_OG = {
            name: station.tool_pose_in_object(context, tool, name)
            for name in station.graspable_objects
        }
        gaps = {
            name: lip_surface_profile(station.object_classes[name], X_OG[name], diameter).min()
            for name in X_OG
        }
        if not gaps:
            return
        closest = min(gaps, key=lambda name: gaps[name])
        if self._gripper.can_attach(tool, station.object_classes[closest], X_OG[closest]):
            self._grasp.attach(context, tool, station.scene_plant.bodies[closest])
            self.status = replace(self.status, held=closest, last_held=closest)
            self._X_OG = X_OG[closest]

    def _release(self, context: Context) -> None:
        X_OG = self._station.tool_pose_in_object(context, self.status.tool, self.status.held)
        slip = float(np.linalg.norm(X_OG.translation() - self._X_OG.translation()))
        self._grasp.detach(context)
        self.status = replace(self.status, held="", slip=slip)
