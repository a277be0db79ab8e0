"""Status of parallel jaws in a running simulation; friction holds the object between them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context

from drake_clutter.cell.parallel_jaw import ParallelJawGripper
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.gripper_actuator import (
    GRIPPER_UPDATE_PERIOD,
    GraspStatus,
)

CONTACT_LOSS_TIME = 0.02
"""Time without contact after which the object is lost [s]; shorter ones are bounces."""


class JawActuator:
    """Observes which object both jaws touch; the executor commands the jaws.

    Attributes:
        status: Status of the gripper. `GraspStatus.max_load_ratio` is the largest ratio of
            tangential to normal force on a jaw, divided by the coefficient of friction.
    """

    def __init__(
        self,
        station: ClutterStation,
        gripper: ParallelJawGripper,
        commanded_tool: Callable[[Context], str],
    ) -> None:
        """Create an actuator.

        Args:
            station: Station with the gripper.
            gripper: The gripper.
            commanded_tool: Returns the name of the tool that is commanded to hold an object, "" for
                none, from the root context.
        """
        self._station = station
        self._gripper = gripper
        self._commanded_tool = commanded_tool
        self.reset()

    def reset(self) -> None:
        """Reset the status, see `GripperActuator`."""
        self.status = GraspStatus()
        self._was_commanded = False
        self._num_missing = 0  # consecutive updates without contact
        self._X_OG = RigidTransform()  # at the first contact

    def update(self, root: Context) -> None:
        """Observe the contacts of the jaws, see `GripperActuator`."""
        time = root.get_time()
        context = self._station.plant_context(root)
        tool = self._commanded_tool(root)
        if tool and not self._was_commanded:
            self.status = GraspStatus(tool)
            self._num_missing = 0
        self._was_commanded = bool(tool)
        if self.status.held and not tool:
            self._release(context)
        elif tool and not self.status.lost_object:
            self._observe(context, time)

    def _observe(self, context: Context, time: float) -> None:
        """Find the object that both jaws touch, or notice that it is lost."""
        links = self._gripper.tools[self.status.tool].contact_links
        forces = [self._station.contact_forces(context, link) for link in links]
        touched = set[str].intersection(*(set(by_object) for by_object in forces))
        if self.status.held and self.status.held not in touched:
            self._num_missing += 1
            if self._num_missing * GRIPPER_UPDATE_PERIOD > CONTACT_LOSS_TIME:
                self.status = replace(self.status, release_time=time)
                self._release(context)
            return
        self._num_missing = 0
        if not self.status.held and touched:
            held = min(touched)
            self._X_OG = self._station.tool_pose_in_object(context, self.status.tool, held)
            self.status = replace(self.status, held=held, last_held=held)
        if self.status.held:
            ratio = max(self._friction_ratio(context, f[self.status.held]) for f in forces)
            max_ratio = max(self.status.max_load_ratio, ratio)
            self.status = replace(self.status, max_load_ratio=max_ratio)

    def _friction_ratio(self, context: Context, force: np.ndarray) -> float:
        """Return the ratio of a contact force in T, shape (3,), to the limit of friction."""
        frame = self._station.arm.tools[self.status.tool]
        x, y, z = frame.CalcPoseInWorld(context).rotation().inverse() @ force
        return float(np.hypot(x, z)) / (self._gripper.friction * max(abs(float(y)), 1e-9))

    def _release(self, context: Context) -> None:
        X_OG = self._station.tool_pose_in_object(context, self.status.tool, self.status.held)
        slip = float(np.linalg.norm(X_OG.translation() - self._X_OG.translation()))
        self.status = replace(self.status, held="", slip=slip)
