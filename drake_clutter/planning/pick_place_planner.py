"""Pick-and-place planner: grasps, collision-free paths, time-optimal trajectories.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache

from drake_clutter.cell.gripper import Grasp, GraspFailure, GraspSampling, Gripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_search import PickPlaceSearch
from drake_clutter.planning.place_check import check_place
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform


def find_object(objects: Sequence[SceneObject], name: str) -> SceneObject:
    """Return the object with a name.

    Raises:
        InputError: No object has the name.
    """
    for o in objects:
        if o.name == name:
            return o
    names = ", ".join(o.name for o in objects) or "an object; none is known"
    raise InputError(f"pick: {format_value(name)} is not a known object; expected {names}")


class PickPlacePlanner:
    """Deterministic pick-and-place planner for one work cell.

    Attributes:
        cell: Work cell.
        config: Parameters of the planner.
        robot: Robot of the cell.
        tools: Kinematics of robot and tool, by name of the tool.
    """

    def __init__(self, cell: WorkCell, config: PlannerConfig) -> None:
        """Load the robot of a work cell.

        Args:
            cell: Work cell.
            config: Parameters of the planner.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self.cell = cell
        self.config = config
        self.robot = load_robot(cell.robot)
        self.tools = {name: ToolKinematics(cell, name) for name in cell.gripper.tools}
        self._gripper: Gripper = cell.gripper
        self._collision_models: dict[Hashable, CollisionModel] = {}
        self._grasps = lru_cache(maxsize=256)(self._find_grasps)

    def collision_model(
        self, objects: Sequence[SceneObject], occluded: Sequence[OccludedBox] = ()
    ) -> CollisionModel:
        """Return the collision model of arm and objects, with the objects at their poses.

        The last model is reused if the objects have the same names and classes.

        Args:
            objects: Objects in the scene.
            occluded: Occluded volumes, which count as obstacles.
        """
        named_classes = tuple((o.name, o.object_class) for o in objects)
        key = named_classes, tuple(occluded)
        if key not in self._collision_models:
            self._collision_models.clear()
            self._collision_models[key] = CollisionModel(self.cell, named_classes, occluded)
        model = self._collision_models[key]
        model.set_object_poses(objects)
        return model

    def plan(
        self,
        objects: Sequence[SceneObject],
        pick: str,
        X_TO_place: Pose,
        occluded: Sequence[OccludedBox] = (),
    ) -> PickPlacePlan | PlanningFailure:
        """Plan to move an object to a pose that differs by a translation and a yaw.

        Args:
            objects: All known objects, including the picked one.
            pick: Name of the picked object.
            X_TO_place: Pose at which the object is released.
            occluded: Occluded volumes, which count as obstacles.

        Returns:
            The plan, or the reason why there is none.

        Raises:
            InputError: No object has the name.
        """
        start_time = time.perf_counter()
        picked = find_object(objects, pick)
        # Try the offset first, then the place pose itself; only once if the offset is 0.
        for offset in dict.fromkeys((self.config.descent_start_offset, 0.0)):
            X_TO_start = X_TO_place.translated((0.0, 0.0, offset))
            plan = self._plan(objects, picked, X_TO_start, occluded)
            if isinstance(plan, PlanningFailure) or plan.max_descent >= offset:
                break
        return replace(plan, planning_time=time.perf_counter() - start_time)

    def _plan(
        self,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        occluded: Sequence[OccludedBox],
    ) -> PickPlacePlan | PlanningFailure:
        start_time = time.perf_counter()
        if carried := objects_resting_on(picked, objects):
            return PlanningFailure(PlanningFailureReason.CARRIES_OTHERS, ", ".join(carried))
        grasps = self._grasps(picked)
        if isinstance(grasps, PlanningFailure):
            return grasps
        if self.cell.pedestal_overlaps_support:
            return PlanningFailure(PlanningFailureReason.IN_COLLISION, "pedestal and tray")
        model = self.collision_model(objects, occluded)
        if pairs := model.distances_below(self.robot.home, self.config.min_distance):
            nearest = min(pairs, key=lambda pair: pair.distance)
            return PlanningFailure(
                PlanningFailureReason.IN_COLLISION,
                f"at home: {' and '.join(nearest.pair)}",
                nearest.distance,
            )
        if failure := self._check_place(model, objects, picked, X_TO_place):
            return failure
        tops = [*model.fixture_tops, *(box.top_height for box in occluded)]
        search = self._search(model, objects, picked, X_TO_place, tops)
        for grasp in grasps:
            for candidate in search.ik_candidates(grasp):
                if search.num_attempts >= self.config.max_attempts:
                    return search.failures.furthest
                if time.perf_counter() - start_time > self.config.time_limit:
                    return PlanningFailure(
                        PlanningFailureReason.TIME_OUT,
                        str(search.failures.furthest),
                        self.config.time_limit,
                    )
                plan = search.plan_candidate(candidate)
                if plan is not None:
                    return plan
        return search.failures.furthest

    def _check_place(
        self,
        model: CollisionModel,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
    ) -> PlanningFailure | None:
        """Return why the object cannot be released at a pose, see `check_place`."""
        others = [o for o in objects if o is not picked]
        placed = replace(picked, X_TO=X_TO_place)
        return check_place(placed, others, model, self.config.max_guarded_descent)

    def _search(
        self,
        model: CollisionModel,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        obstacle_tops: Sequence[float] = (),
    ) -> PickPlaceSearch:
        return PickPlaceSearch(
            self.cell, self.config, self.tools, model, objects, picked, X_TO_place, obstacle_tops
        )

    def can_grasp(self, scene_object: SceneObject) -> bool:
        """Return whether the gripper has a grasp on an object that holds its weight."""
        return not isinstance(self._grasps(scene_object), PlanningFailure)

    def can_pick(self, scene_object: SceneObject, objects: Sequence[SceneObject]) -> bool:
        """Return whether an object can be grasped and no other object rests on it.

        This is a necessary condition for a plan, and much faster than planning.

        Args:
            scene_object: Object to pick.
            objects: All known objects.
        """
        return not objects_resting_on(scene_object, objects) and self.can_grasp(scene_object)

    def _find_grasps(self, picked: SceneObject) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of an object, closest to its center of mass first."""
        object_class = picked.object_class
        config = self.config
        if object_class.mass + self._gripper.mass > self.cell.robot.payload:
            return PlanningFailure(PlanningFailureReason.TOO_HEAVY, picked.name, object_class.mass)
        sampling = GraspSampling(
            config.grasp_spacing,
            config.lip_gap,
            config.max_grasps,
            config.min_payload_acceleration,
        )
        grasps = self._gripper.sample_grasps(object_class, rigid_transform(picked.X_TO), sampling)
        if isinstance(grasps, GraspFailure):
            reason = PlanningFailureReason(grasps.reason.value)
            return PlanningFailure(reason, picked.name, grasps.value)
        return grasps

    def are_endpoints_reachable(
        self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose
    ) -> bool:
        """Return whether a grasp reaches the pick and the place pose without collision.

        This is a necessary condition for a plan.

        Args:
            objects: All objects, including the picked one.
            pick: Name of the picked object.
            X_TO_place: Pose at which the object is released.
        """
        picked = find_object(objects, pick)
        grasps = self._grasps(picked)
        if objects_resting_on(picked, objects) or isinstance(grasps, PlanningFailure):
            return False
        model = self.collision_model(objects)
        if self._check_place(model, objects, picked, X_TO_place) is not None:
            return False
        search = self._search(model, objects, picked, X_TO_place)
        return any(search.has_candidate(grasp) for grasp in grasps)
