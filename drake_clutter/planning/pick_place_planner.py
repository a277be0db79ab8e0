"""Finds plans of moves: grasp, way and timing.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache

from drake_clutter.cell.gripper import Grasp, GraspFailure, GraspSampling, Gripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_search import PickPlaceSearch
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform


class PickPlacePlanner:
    """Plans moves of objects among objects; the same question has the same answer.

    Attributes:
        cell: What stands around the objects.
        config: How plans are searched.
        tool: Kinematics of the gripper.
    """

    def __init__(self, cell: WorkCell, config: PlannerConfig) -> None:
        self.cell, self.config = cell, config
        self.tool = ToolKinematics(cell)
        self._gripper: Gripper = cell.gripper
        self._collision_models: dict[Hashable, CollisionModel] = {}
        self._grasps = lru_cache(maxsize=256)(self._find_grasps)

    def collision_model(
        self, objects: Sequence[SceneObject], occluded: Sequence[OccludedBox] = ()
    ) -> CollisionModel:
        """The objects and the arm; the latest of each set of objects is kept."""
        named = tuple((o.name, o.object_class) for o in objects)
        key = named, tuple(occluded)
        if key not in self._collision_models:
            self._collision_models.clear()
            self._collision_models[key] = CollisionModel(self.cell, named, occluded)
        scene = self._collision_models[key]
        scene.set_object_poses(objects)
        return scene

    def plan(
        self,
        objects: Sequence[SceneObject],
        pick: str,
        X_TO_place: Pose,
        occluded: Sequence[OccludedBox] = (),
    ) -> PickPlacePlan | PlanningFailure:
        """Plans to carry an object to a pose that differs by a shift and a turn about the vertical.

        Args:
            objects: all that is known to stand around, the picked one included.
            pick: its name.
            X_TO_place: where it is let go.
            occluded: space that must be taken for full, where not all is known.
        """
        begun = time.perf_counter()
        picked = next(o for o in objects if o.name == pick)
        for above in dict.fromkeys(
            (self.config.descent_start_offset, 0.0)
        ):  # once if they are the same
            found = self._plan(objects, picked, X_TO_place.translated((0.0, 0.0, above)), occluded)
            if isinstance(found, PlanningFailure) or found.max_descent >= above:
                break
        return replace(found, planning_time=time.perf_counter() - begun)

    def _plan(
        self,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        occluded: Sequence[OccludedBox],
    ) -> PickPlacePlan | PlanningFailure:
        begun = time.perf_counter()
        if carried := objects_resting_on(picked, objects):
            return PlanningFailure(PlanningFailureReason.CARRIES_OTHERS, ", ".join(carried))
        grasps = self._grasps(picked)
        if isinstance(grasps, PlanningFailure):
            return grasps
        if self.cell.pedestal_overlaps_support:
            return PlanningFailure(PlanningFailureReason.IN_COLLISION, "pedestal and tray")
        scene = self.collision_model(objects, occluded)
        if hit := scene.distances_below(self.tool.robot.home, self.config.min_distance):
            nearest = min(hit, key=lambda here: here.distance)
            return PlanningFailure(
                PlanningFailureReason.IN_COLLISION,
                f"at home: {' and '.join(nearest.pair)}",
                nearest.distance,
            )
        tops = [*scene.fixture_tops, *(block.top_height for block in occluded)]
        attempt = PickPlaceSearch(self.cell, self.config, scene, objects, picked, X_TO_place, tops)
        for grasp in grasps:
            for q_pick, q_place, yaw in attempt.ik_candidates(grasp):
                if attempt.num_attempts >= self.config.max_attempts:
                    return attempt.furthest_failure
                if time.perf_counter() - begun > self.config.time_limit:
                    return PlanningFailure(
                        PlanningFailureReason.TIME_OUT,
                        str(attempt.furthest_failure),
                        self.config.time_limit,
                    )
                found = attempt.plan_grasp(grasp, q_pick, q_place, yaw)
                if found is not None:
                    return found
        return attempt.furthest_failure

    def can_grasp(self, scene_object: SceneObject) -> bool:
        """Whether the gripper takes an object somewhere and can carry it."""
        return not isinstance(self._grasps(scene_object), PlanningFailure)

    def can_pick(self, scene_object: SceneObject, objects: Sequence[SceneObject]) -> bool:
        """Whether the cup can hold an object, and none of the others rests on it: without that, no plan is worth asking for."""
        return not objects_resting_on(scene_object, objects) and self.can_grasp(scene_object)

    def _find_grasps(self, picked: SceneObject) -> tuple[Grasp, ...] | PlanningFailure:
        """Where the gripper takes an object and can hold it, the nearest to its middle first."""
        object_class, config = picked.object_class, self.config
        if object_class.mass + self._gripper.mass > self.cell.robot.payload:
            return PlanningFailure(PlanningFailureReason.TOO_HEAVY, picked.name, object_class.mass)
        sampling = GraspSampling(
            config.grasp_spacing, config.max_grasps, config.min_payload_acceleration
        )
        found = self._gripper.sample_grasps(object_class, rigid_transform(picked.X_TO), sampling)
        if isinstance(found, GraspFailure):
            return PlanningFailure(
                PlanningFailureReason(found.reason.value), picked.name, found.value
            )
        return found

    def are_endpoints_reachable(
        self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose
    ) -> bool:
        """Whether any grasp that holds reaches both ends of a move without collision: what no plan can do without."""
        picked = next(o for o in objects if o.name == pick)
        grasps = self._grasps(picked)
        if objects_resting_on(picked, objects) or isinstance(grasps, PlanningFailure):
            return False
        scene = self.collision_model(objects)
        attempts = PickPlaceSearch(self.cell, self.config, scene, objects, picked, X_TO_place)
        return any(attempts.has_candidate(grasp) for grasp in grasps)
