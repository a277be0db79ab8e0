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
MAX_REGRIPS = 1
"""Number of times that a cup may hold an object again that has come off while the pump is on."""


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
        num_regrips: Number of times that an object was held again after it had come off.
    """

    tool: str = ""
    held: str = ""
    last_held: str = ""
    release_time: float = math.nan
    max_load_ratio: float = 0.0
    slip: float = math.nan
    num_regrips: int = 0

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

    Only the cup that is commanded on has a vacuum. It builds up while the lip seals on an object,
    which is attached from `SuctionGripper.detection_vacuum` on. The lip lifts while the load is
    above the capacity at the current vacuum; the object comes off when the vacuum is lost.

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
        assert station.vacuum_system is not None
        self._grasp = station.grasp
        self._vacuum_system = station.vacuum_system
        self._commanded_tool = commanded_tool
        self.reset()

    def reset(self) -> None:
        """Reset the status, see `GripperActuator`."""
        self.status = GraspStatus()
        self._last_tool = ""
        self._sealed_leak_rate = 0.0  # of the object that is held [1/s]
        self._X_OG = RigidTransform()  # at the last attachment

    def update(self, root: Context) -> None:
        """Attach or release an object, see `GripperActuator`."""
        context = self._station.plant_context(root)
        tool = self._commanded_tool(root)
        if tool and tool != self._last_tool:
            if self.status.held:
                self._release(context)
            self.status = GraspStatus(tool)
        self._last_tool = tool
        leak_rate = math.inf
        if self.status.held:
            leak_rate = self._hold(context, root)
        elif tool and self.status.num_regrips + self.status.lost_object <= MAX_REGRIPS:
            leak_rate = self._try_attach(context, root)
        rates = [leak_rate if name == self.status.tool else math.inf for name in self._names]
        vacuum_context = self._vacuum_system.GetMyMutableContextFromRoot(root)
        self._vacuum_system.set_leak_rates(vacuum_context, np.array(rates))

    @property
    def _names(self) -> tuple[str, ...]:
        return tuple(cup.name for cup in self._gripper.cups)

    def _vacuum(self, root: Context) -> float:
        """Return the vacuum of the cup of the status [Pa]."""
        port = self._vacuum_system.GetOutputPort("vacuum")
        values = port.Eval(self._vacuum_system.GetMyContextFromRoot(root))
        return float(values[self._names.index(self.status.tool)])

    def _hold(self, context: Context, root: Context) -> float:
        """Check the load of the object that is held, and return the leak rate [1/s]."""
        tool = self.status.tool
        vacuum = self._vacuum(root)
        if vacuum < self._gripper.detection_vacuum:
            if self._last_tool == tool:
                self.status = replace(self.status, release_time=root.get_time())
            self._release(context)
            return math.inf
        force, moment = self._grasp.load(context, tool)
        ratio = float(self._gripper.load_ratio(tool, force, moment, vacuum))
        if self._last_tool == tool:
            max_ratio = max(self.status.max_load_ratio, ratio)
            self.status = replace(self.status, max_load_ratio=max_ratio)
        return math.inf if ratio > 1 else self._sealed_leak_rate

    def _try_attach(self, context: Context, root: Context) -> float:
        """Attach the object that is closest below the lip, if it seals there and has a vacuum.

        Returns:
            Leak rate [1/s].
        """
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
            return math.inf
        closest = min(gaps, key=lambda name: gaps[name])
        object_class = station.object_classes[closest]
        if not self._gripper.can_attach(tool, object_class, X_OG[closest]):
            return math.inf
        leak_rate = self._gripper.leak_rate(tool, object_class, X_OG[closest])
        if self._vacuum(root) >= self._gripper.detection_vacuum:
            self._grasp.attach(context, tool, station.scene_plant.bodies[closest])
            self.status = replace(
                self.status,
                held=closest,
                last_held=closest,
                release_time=math.nan,
                num_regrips=self.status.num_regrips + self.status.lost_object,
            )
            self._X_OG = X_OG[closest]
            self._sealed_leak_rate = leak_rate
        return leak_rate

    def _release(self, context: Context) -> None:
        X_OG = self._station.tool_pose_in_object(context, self.status.tool, self.status.held)
        slip = float(np.linalg.norm(X_OG.translation() - self._X_OG.translation()))
        self._grasp.detach(context)
        self.status = replace(self.status, held="", slip=slip)
