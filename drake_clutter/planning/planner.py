"""Finds plans of moves: grasp, way and timing.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache

from drake_clutter.cell.gripper import Grasp, GraspSampling, Gripper, NoGrasp
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.attempts import Attempts
from drake_clutter.planning.clearance import ClearanceScene
from drake_clutter.planning.plan import NoPlan, Plan, PlanFailure
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.scenes.geometry import rests_on
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.scenes.unseen import UnseenBlock
from drake_clutter.simulation.plant import rigid_transform


class PickPlacePlanner:
    """Plans moves of objects among objects; the same question has the same answer.

    Attributes:
        cell: What stands around the objects.
        planner: How plans are searched.
        tool: Kinematics of the gripper.
    """

    def __init__(self, cell: WorkCell, planner: PlannerConfig) -> None:
        self.cell, self.planner = cell, planner
        self.tool = ToolKinematics(cell)
        self._gripper: Gripper = cell.gripper
        self._scenes: dict[Hashable, ClearanceScene] = {}
        self._grasps = lru_cache(maxsize=256)(self._find_grasps)

    def clearance_scene(
        self, objects: Sequence[SceneObject], unseen: Sequence[UnseenBlock] = ()
    ) -> ClearanceScene:
        """The objects and the arm; the latest of each set of objects is kept."""
        named = tuple((o.name, o.object_class) for o in objects)
        key = named, tuple(unseen)
        if key not in self._scenes:
            self._scenes.clear()
            self._scenes[key] = ClearanceScene(self.cell, named, unseen)
        scene = self._scenes[key]
        scene.put(objects)
        return scene

    def plan(
        self,
        objects: Sequence[SceneObject],
        pick: str,
        X_TO_place: Pose,
        unseen: Sequence[UnseenBlock] = (),
    ) -> Plan | NoPlan:
        """Plans to carry an object to a pose that differs by a shift and a turn about the vertical.

        Args:
            objects: all that is known to stand around, the picked one included.
            pick: its name.
            X_TO_place: where it is let go.
            unseen: space that must be taken for full, where not all is known.
        """
        begun = time.perf_counter()
        picked = next(o for o in objects if o.name == pick)
        for above in dict.fromkeys((self.planner.above, 0.0)):  # once if they are the same
            found = self._plan(objects, picked, X_TO_place.moved((0.0, 0.0, above)), unseen)
            if isinstance(found, NoPlan) or found.depth >= above:
                break
        return replace(found, seconds=time.perf_counter() - begun)

    def _plan(
        self,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        unseen: Sequence[UnseenBlock],
    ) -> Plan | NoPlan:
        begun = time.perf_counter()
        if carried := rests_on(picked, objects):
            return NoPlan(PlanFailure.CARRIES_OTHERS, ", ".join(carried))
        grasps = self._grasps(picked)
        if isinstance(grasps, NoPlan):
            return grasps
        if self.cell.pedestal_in_support:
            return NoPlan(PlanFailure.IN_COLLISION, "pedestal and tray")
        scene = self.clearance_scene(objects, unseen)
        if hit := scene.close(self.tool.robot.home, self.planner.clearance):
            nearest = min(hit, key=lambda here: here.distance)
            return NoPlan(
                PlanFailure.IN_COLLISION, f"at home: {' and '.join(nearest.pair)}", nearest.distance
            )
        tops = [*scene.fixture_tops, *(block.top for block in unseen)]
        attempt = Attempts(self.cell, self.planner, scene, objects, picked, X_TO_place, tops)
        for grasp in grasps:
            for q_pick, q_place, yaw in attempt.ends(grasp):
                if attempt.count >= self.planner.attempts:
                    return attempt.furthest
                if time.perf_counter() - begun > self.planner.time_limit:
                    return NoPlan(
                        PlanFailure.TIME_OUT, str(attempt.furthest), self.planner.time_limit
                    )
                found = attempt.carry_out(grasp, q_pick, q_place, yaw)
                if found is not None:
                    return found
        return attempt.furthest

    def holds(self, scene_object: SceneObject) -> bool:
        """Whether the gripper takes an object somewhere and can carry it."""
        return not isinstance(self._grasps(scene_object), NoPlan)

    def can_pick(self, scene_object: SceneObject, objects: Sequence[SceneObject]) -> bool:
        """Whether the cup can hold an object, and none of the others rests on it: without that, no plan is worth asking for."""
        return not rests_on(scene_object, objects) and self.holds(scene_object)

    def _find_grasps(self, picked: SceneObject) -> tuple[Grasp, ...] | NoPlan:
        """Where the gripper takes an object and can hold it, the nearest to its middle first."""
        object_class, config = picked.object_class, self.planner
        if object_class.mass + self._gripper.mass > self.cell.robot.payload:
            return NoPlan(PlanFailure.TOO_HEAVY, picked.name, object_class.mass)
        sampling = GraspSampling(config.grasp_spacing, config.grasps, config.least_acceleration)
        found = self._gripper.grasps(object_class, rigid_transform(picked.X_TO), sampling)
        if isinstance(found, NoGrasp):
            return NoPlan(PlanFailure(found.reason.value), picked.name, found.number)
        return found

    def ends_exist(self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose) -> bool:
        """Whether any grasp that holds reaches both ends of a move without collision: what no plan can do without."""
        picked = next(o for o in objects if o.name == pick)
        grasps = self._grasps(picked)
        if rests_on(picked, objects) or isinstance(grasps, NoPlan):
            return False
        scene = self.clearance_scene(objects)
        attempts = Attempts(self.cell, self.planner, scene, objects, picked, X_TO_place)
        return any(attempts.exist(grasp) for grasp in grasps)
