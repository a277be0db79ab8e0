"""Finds plans of moves: grasp, way and timing.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import math
import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.kinematics import branches
from drake_clutter.cell.suction import greatest_acceleration, unevenness
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.attempts import Attempts, Grasp, PlannerConfig, downwards, inverse, matrix
from drake_clutter.planning.clearance import ClearanceScene
from drake_clutter.planning.paths import Payload
from drake_clutter.planning.plan import NoPlan, Plan, PlanFailure
from drake_clutter.scenes.geometry import rests_on
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.scenes.unseen import UnseenBlock

Floats = NDArray[np.float64]


class PickPlacePlanner:
    """Plans moves of objects among objects; the same question has the same answer."""

    def __init__(self, cell: WorkCell, planner: PlannerConfig) -> None:
        self.cell, self.planner = cell, planner
        self._X_BT = cell.robot.X_TB.inverse().GetAsMatrix4()
        self._X_GF = cell.gripper.X_FG.inverse().GetAsMatrix4()
        self._scenes: dict[Hashable, ClearanceScene] = {}
        self._grasps = lru_cache(maxsize=256)(self._find_grasps)

    def clearance_scene(self, objects: Sequence[SceneObject], unseen: Sequence[UnseenBlock] = ()) -> ClearanceScene:
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
        self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose, unseen: Sequence[UnseenBlock] = ()
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
        if hit := scene.close(np.array(self.cell.robot.home), self.planner.clearance):
            nearest = min(hit, key=lambda here: here.distance)
            return NoPlan(PlanFailure.IN_COLLISION, f"at home: {' and '.join(nearest.pair)}", nearest.distance)
        tops = [block.top for block in unseen]
        attempt = Attempts(self.cell, self.planner, self.reach, scene, objects, picked, X_TO_place, tops)
        for grasp in grasps:
            for q_pick, q_place, branch, yaw in attempt.ends(grasp):
                if attempt.count >= self.planner.attempts:
                    return attempt.furthest
                if time.perf_counter() - begun > self.planner.time_limit:
                    return NoPlan(PlanFailure.TIME_OUT, str(attempt.furthest), self.planner.time_limit)
                found = attempt.carry_out(grasp, q_pick, q_place, branch, yaw)
                if found is not None:
                    return found
        return attempt.furthest

    def holds(self, scene_object: SceneObject) -> bool:
        """Whether the cup seals somewhere on top of an object and can carry it."""
        return not isinstance(self._grasps(scene_object), NoPlan)

    def can_pick(self, scene_object: SceneObject, objects: Sequence[SceneObject]) -> bool:
        """Whether the cup can hold an object, and none of the others rests on it: without that, no plan is worth asking for."""
        return not rests_on(scene_object, objects) and self.holds(scene_object)

    def _find_grasps(self, picked: SceneObject) -> list[Grasp] | NoPlan:
        """Where the cup seals on top and can hold, the nearest to its middle first."""
        suction = self.cell.gripper
        lower, upper = picked.bounds_T
        X_TO = matrix(picked.X_TO)
        top = float(upper[2])
        steps = [np.arange(0, (hi - lo) / 2, self.planner.grasp_spacing) for lo, hi in zip(lower[:2], upper[:2], strict=True)]
        offsets = [np.concatenate([-s[:0:-1], s]) for s in steps]
        x, y = np.meshgrid(*offsets, indexing="ij")
        middle = (lower[:2] + upper[:2]) / 2
        points = middle + np.column_stack([x.ravel(), y.ravel()])
        points = points[np.argsort(np.round(np.linalg.norm(points - middle, axis=1), 6), kind="stable")]
        found, least = list[Grasp](), math.inf
        for point in points:
            X_TG = downwards(0.0, np.array([*point, top]))
            X_OG = inverse(X_TO) @ X_TG
            uneven = unevenness(picked.object_class, X_OG, suction.cup_diameter)
            least = min(least, uneven)
            if uneven > suction.unevenness:
                continue
            p_GCm = inverse(X_TG)[:3, :3] @ (X_TO[:3, 3] - X_TG[:3, 3])
            acceleration = greatest_acceleration(picked.object_class.mass, p_GCm, suction)
            if acceleration >= self.planner.least_acceleration:
                # How the load hangs to the side depends on the cup's yaw; its distance from the axis does not.
                payload = Payload(picked.object_class.mass, (0.0, 0.0, round(float(p_GCm[2]), 2)), round(acceleration, 1))
                found.append(Grasp(X_TG[:3, 3], payload))
                if len(found) == self.planner.grasps:
                    break
        if picked.object_class.mass + self.cell.gripper.mass > self.cell.robot.payload:
            return NoPlan(PlanFailure.TOO_HEAVY, picked.name, picked.object_class.mass)
        if not found:
            reason = PlanFailure.NO_SEAL if least > suction.unevenness else PlanFailure.TOO_HEAVY
            return NoPlan(reason, picked.name, least if reason is PlanFailure.NO_SEAL else picked.object_class.mass)
        return found

    def ends_exist(self, objects: Sequence[SceneObject], pick: str, X_TO_place: Pose) -> bool:
        """Whether any grasp that holds reaches both ends of a move without collision: what no plan can do without."""
        picked = next(o for o in objects if o.name == pick)
        grasps = self._grasps(picked)
        if rests_on(picked, objects) or isinstance(grasps, NoPlan):
            return False
        scene = self.clearance_scene(objects)
        attempts = Attempts(self.cell, self.planner, self.reach, scene, objects, picked, X_TO_place)
        return any(attempts.exist(grasp) for grasp in grasps)

    def reach(self, X_TG: Floats) -> Floats:
        """(..., 8, 6) rad, see `branches`."""
        return branches(self._X_BT @ X_TG @ self._X_GF)
