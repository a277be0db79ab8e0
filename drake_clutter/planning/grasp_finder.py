"""Grasps of an object: from above, and on its sides.

Frames: T is the support, G is a tool of the gripper, O is the object.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform

from drake_clutter.cell.gripper import (
    UP,
    Grasp,
    GraspFailure,
    GraspSampling,
    Gripper,
    LazyGrasps,
)
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.planning.motion_plan import HeldObject
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.side_grasps import side_normals
from drake_clutter.robots.robot_model import RobotModel
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Vector = tuple[float, float, float]

_MAX_SAME_ANGLE = math.radians(15)
"""Grasps whose orientations differ by less count as the same [rad]: half of the angle between two
directions in which jaws grasp a standing cylinder."""


class GraspFinder:
    """Finds the grasps of the gripper of a work cell; those of the latest objects are cached."""

    def __init__(self, cell: WorkCell, config: PlannerConfig, robot: RobotModel) -> None:
        """Take the gripper.

        Args:
            cell: Work cell with the gripper.
            config: Parameters of the planner.
            robot: Robot of the cell.
        """
        self._gripper: Gripper = cell.gripper
        self._payload = cell.robot.payload
        self._config = config
        self._robot = robot
        self._grasps = lru_cache(maxsize=256)(self._find_grasps)

    def grasps(
        self, scene_object: SceneObject, normal: Vector = UP
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of a face, see `PickPlacePlanner.grasps`."""
        length = float(np.linalg.norm(normal)) if len(normal) == 3 else math.nan
        if not 0 < length < np.inf:
            raise InputError(f"normal: {format_value(list(normal))}; expected a direction")
        x, y, z = (np.array(normal) / length).tolist()
        return self._grasps(scene_object, (x, y, z))

    def _faces(self, picked: SceneObject) -> tuple[Vector, ...]:
        """Return the directions from which an object may be grasped; from above first."""
        return UP, *side_normals(picked, self._robot.X_TB.translation())

    def graspable_faces(self, picked: SceneObject) -> Iterator[Sequence[Grasp]]:
        """Yield the grasps of each face that has any, see `_faces`."""
        for normal in self._faces(picked):
            grasps = self._grasps(picked, normal)
            if not isinstance(grasps, PlanningFailure):
                yield grasps

    def failure(self, picked: SceneObject) -> PlanningFailure:
        """Return why no face of an object has a grasp."""
        found = (self._grasps(picked, normal) for normal in self._faces(picked))
        from_above, *of_sides = (f for f in found if isinstance(f, PlanningFailure))
        if from_above.reason is not PlanningFailureReason.NO_SEAL:
            return from_above
        # A side on which the gripper seals, but does not hold the object, is closer to a grasp.
        return next((f for f in of_sides if f.reason is not from_above.reason), from_above)

    def is_excluded(
        self, picked: SceneObject, grasp: Grasp, excluded: Sequence[HeldObject]
    ) -> bool:
        """Return whether a grasp is one of those that are left out.

        Grasps of a tool are the same if their points are closer than half of
        `PlannerConfig.grasp_spacing`, and their orientations but for equally good angles about the
        axis of the tool.

        Args:
            picked: Object at its pose.
            grasp: Grasp of the object.
            excluded: Grasps that are left out.
        """
        X_OG = rigid_transform(picked.X_TO).InvertAndCompose(grasp.X_TG)
        for other in excluded:
            X_GE = X_OG.InvertAndCompose(other.X_OG)
            R = X_GE.rotation().matrix()
            angle = math.atan2(R[1, 0], R[0, 0])
            if grasp.num_angles:
                turn = 2 * math.pi / grasp.num_angles
                angle -= turn * round(angle / turn)
            else:
                angle = 0.0
            tilt = math.acos(min(1.0, max(-1.0, float(R[2, 2]))))
            distance = float(np.linalg.norm(X_GE.translation()))
            if (
                other.tool == grasp.tool
                and distance < self._config.grasp_spacing / 2
                and max(abs(angle), tilt) < _MAX_SAME_ANGLE
            ):
                return True
        return False

    def verified(
        self, picked: SceneObject, grasps: Sequence[Grasp]
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return given grasps as the gripper holds the object with them.

        Args:
            picked: Object at its pose.
            grasps: Grasps, at least one.

        Returns:
            Those that hold the object, which are found when they are used, or why the first one of
            several does not if none does.

        Raises:
            InputError: There is no grasp, or the gripper has no such tool.
        """
        if not grasps:
            raise InputError("grasp: none; expected at least one grasp")
        failures = list[PlanningFailure]()

        def check(grasp: Grasp) -> Iterator[Grasp]:
            X_OG = rigid_transform(picked.X_TO).InvertAndCompose(grasp.X_TG)
            found = self.make_grasp(picked, grasp.tool, X_OG)
            if isinstance(found, PlanningFailure):
                failures.append(found)
            else:
                yield replace(found, num_angles=grasp.num_angles)

        found = LazyGrasps(verified for grasp in grasps for verified in check(grasp))
        return found if next(iter(found), None) is not None else failures[0]

    def make_grasp(
        self, picked: SceneObject, tool: str, X_OG: RigidTransform
    ) -> Grasp | PlanningFailure:
        """Return a given grasp, or why the tool cannot hold the object with it.

        Args:
            picked: Object at its pose.
            tool: Name of the tool.
            X_OG: Pose of the tool in the object.

        Raises:
            InputError: The gripper has no such tool.
        """
        if tool not in self._gripper.tools:
            allowed = ", ".join(self._gripper.tools)
            raise InputError(f"tool: {format_value(tool)}; expected one of {allowed}")
        if failure := self._check_payload(picked):
            return failure
        X_TO = rigid_transform(picked.X_TO)
        grasp = self._gripper.make_grasp(
            tool, picked.object_class, X_TO, X_TO @ X_OG, self._sampling(UP)
        )
        return _to_planning_failure(picked, grasp) if isinstance(grasp, GraspFailure) else grasp

    def _find_grasps(
        self, picked: SceneObject, normal: Vector
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of an object, see `grasps`."""
        if failure := self._check_payload(picked):
            return failure
        grasps = self._gripper.sample_grasps(
            picked.object_class, rigid_transform(picked.X_TO), self._sampling(normal)
        )
        return _to_planning_failure(picked, grasps) if isinstance(grasps, GraspFailure) else grasps

    def _sampling(self, normal: Vector) -> GraspSampling:
        """Return the parameters of the sampling of grasps from a direction."""
        config = self._config
        return GraspSampling(
            config.grasp_spacing,
            config.lip_gap,
            config.max_grasps,
            config.min_payload_acceleration,
            normal,
        )

    def _check_payload(self, picked: SceneObject) -> PlanningFailure | None:
        """Return why gripper and object exceed the payload of the robot, or None."""
        mass = picked.object_class.mass
        if mass + self._gripper.mass <= self._payload:
            return None
        return PlanningFailure(PlanningFailureReason.TOO_HEAVY, picked.name, mass)


def _to_planning_failure(picked: SceneObject, failure: GraspFailure) -> PlanningFailure:
    """Return the failure of a gripper as one of planning."""
    reason = PlanningFailureReason(failure.reason.value)
    return PlanningFailure(reason, picked.name, failure.value)
