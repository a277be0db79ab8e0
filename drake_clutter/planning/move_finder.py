"""Search for motions of the planner: approach, carry and retreat, or a transfer without object.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import time
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import Trajectory

from drake_clutter.cell.gripper import Grasp, LazyGrasps
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.grasp_finder import GraspFinder
from drake_clutter.planning.motion_plan import CellState, HeldObject
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.planning.pick_place_search import FoundMove, MoveGoal, PickPlaceSearch
from drake_clutter.planning.place_check import check_place
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.state_check import (
    JOINT_TOLERANCE,
    check_configuration,
    check_joint_limits,
    check_names,
    check_overlaps,
    to_configuration,
)
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.planning.transfer_planner import TransferPlanner
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]

GraspChoice = Grasp | Sequence[Grasp] | None
"""Grasp of an object, several in the order in which they are tried, or None to sample grasps."""


class MoveFinder:
    """Searches for motions in one work cell, and checks how they start and end.

    Attributes:
        cell: Work cell.
        config: Parameters of the planner.
        robot: Robot of the cell.
        tools: Kinematics of robot and tool, by name of the tool.
    """

    def __init__(self, cell: WorkCell, config: PlannerConfig, grasp_finder: GraspFinder) -> None:
        """Load the robot of a work cell.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            grasp_finder: Finds the grasps of objects.

        Raises:
            InputError: The robot's model cannot be used.
        """
        self.cell = cell
        self.config = config
        self.robot = load_robot(cell.robot)
        self.tools = {name: ToolKinematics(cell, name) for name in cell.gripper.tools}
        self._collision_models: dict[Hashable, CollisionModel] = {}
        self._grasp_finder = grasp_finder

    def collision_model(
        self, objects: Sequence[SceneObject], occluded: Sequence[OccludedBox] = ()
    ) -> CollisionModel:
        """Return the collision model of arm and objects, with the objects at their poses.

        The last model is reused if the objects have the same names and classes.

        Args:
            objects: Objects in the scene.
            occluded: Occluded volumes, which count as obstacles.

        Raises:
            InputError: Two objects have the same name.
        """
        named_classes = tuple((o.name, o.object_class) for o in objects)
        check_names(objects)
        key = named_classes, tuple(occluded)
        if key not in self._collision_models:
            self._collision_models.clear()
            self._collision_models[key] = CollisionModel(self.cell, named_classes, occluded)
        model = self._collision_models[key]
        model.set_object_poses(objects)
        return model

    def find_pick(
        self,
        state: CellState,
        goal: MoveGoal,
        grasp: GraspChoice,
        occluded: Sequence[OccludedBox],
        excluded: Sequence[HeldObject] = (),
    ) -> tuple[FoundMove, int] | PlanningFailure:
        """Return a motion that starts with an approach, and the number of attempts.

        Sides of the object are grasped if there is no motion with a grasp from above.

        Args:
            state: State at the start; no object is held.
            goal: Motion of the object.
            grasp: Grasps of the object.
            occluded: Occluded volumes, which count as obstacles.
            excluded: Grasps that are left out.
        """
        start_time = time.perf_counter()
        if carried := objects_resting_on(goal.picked, state.objects):
            return PlanningFailure(PlanningFailureReason.CARRIES_OTHERS, ", ".join(carried))
        if grasp is None:
            faces = self._grasp_finder.graspable_faces(goal.picked)
            first = next(faces, None)
            if first is None:
                return self._grasp_finder.failure(goal.picked)
            candidates: Iterable[Sequence[Grasp]] = chain([first], faces)
        else:
            given = (grasp,) if isinstance(grasp, Grasp) else grasp
            verified = self._grasp_finder.verified(goal.picked, given)
            if isinstance(verified, PlanningFailure):
                return verified
            candidates = [verified]
        model = self.collision_model(state.objects, occluded)
        failure = self._check_endpoints(state, goal, model)
        if failure is not None:
            return failure
        search = self.search(model, state, goal, occluded)
        failure = search.failures.furthest
        if excluded:
            candidates = self._without(goal.picked, candidates, excluded)
            failure = PlanningFailure(
                PlanningFailureReason.NO_GRASP_LEFT, goal.picked.name, float(len(excluded))
            )
        for grasps in candidates:
            found = self._try_grasps(search, grasps, start_time)
            if not isinstance(found, PlanningFailure):
                return found, search.num_attempts
            failure = found
            if failure.reason is PlanningFailureReason.TIME_OUT:
                break
        return failure

    def _without(
        self,
        picked: SceneObject,
        candidates: Iterable[Sequence[Grasp]],
        excluded: Sequence[HeldObject],
    ) -> Iterator[Sequence[Grasp]]:
        """Yield the grasps of each face without those that are left out, if there are others."""
        for grasps in candidates:
            others = LazyGrasps(
                g for g in grasps if not self._grasp_finder.is_excluded(picked, g, excluded)
            )
            if next(iter(others), None) is not None:
                yield others

    def find_held(
        self, state: CellState, goal: MoveGoal, occluded: Sequence[OccludedBox]
    ) -> FoundMove | PlanningFailure:
        """Return a motion that starts with a held object.

        Args:
            state: State at the start, with the held object.
            goal: Motion of the object.
            occluded: Occluded volumes, which count as obstacles.
        """
        start_time = time.perf_counter()
        held = state.held
        assert held is not None
        model = self.collision_model(state.objects, occluded)
        if failure := self._check_endpoints(state, goal, model):
            return failure
        X_TG = RigidTransform(self.tools[held.tool].pose(np.array(state.q)))
        grasp = Grasp(
            held.tool, X_TG, held.payload, 1, held.insertion, held.joints_open, held.joints_held
        )
        found = self._try_grasps(self.search(model, state, goal, occluded), (grasp,), start_time)
        if isinstance(found, PlanningFailure) or goal.releases or goal.end is None:
            return found
        carry = found.segments["carry"].trajectory
        error = float(np.abs(carry.value(carry.end_time()).ravel() - goal.end).max())
        if error > JOINT_TOLERANCE:
            return PlanningFailure(PlanningFailureReason.UNREACHABLE, "the goal", error)
        return found

    def _try_grasps(
        self, search: PickPlaceSearch, grasps: Sequence[Grasp], start_time: float
    ) -> FoundMove | PlanningFailure:
        """Return the first motion that is found, or the failure of the best attempt."""
        max_attempts = search.num_attempts + self.config.max_attempts
        for grasp in grasps:
            for candidate in search.ik_candidates(grasp):
                if search.num_attempts >= max_attempts:
                    return search.failures.furthest
                if time.perf_counter() - start_time > self.config.time_limit:
                    return PlanningFailure(
                        PlanningFailureReason.TIME_OUT,
                        str(search.failures.furthest),
                        self.config.time_limit,
                    )
                found = search.plan_candidate(candidate)
                if found is not None:
                    return found
        return search.failures.furthest

    def find_transfer(
        self,
        state: CellState,
        X_TG: RigidTransform,
        q_goal: Floats | None,
        tool: str,
        occluded: Sequence[OccludedBox],
    ) -> Trajectory | PlanningFailure:
        """Return a motion without an object to a pose of a tool, or to joint positions.

        Args:
            state: State at the start.
            X_TG: Pose of the tool at the end; not used with joint positions.
            q_goal: Joint positions at the end; None for any with that pose. Shape (n,).
            tool: Name of the tool.
            occluded: Occluded volumes, which count as obstacles.
        """
        if failure := self._check_start(state):
            return failure
        model = self.collision_model(state.objects, occluded)
        if failure := check_overlaps(model, state.objects, self.config.max_overlap):
            return failure
        if failure := check_configuration(
            self.robot, self.config.min_distance, model, np.array(state.q), "at the start"
        ):
            return failure
        transfer = TransferPlanner(self.cell, self.config, self.tools[tool], model)
        if q_goal is not None:
            return transfer.plan(np.array(state.q), [q_goal])
        solutions = self.tools[tool].solve_ik(X_TG.GetAsMatrix4())
        solutions = self.robot.unwrap(solutions, np.array(state.q))
        reachable = solutions[np.isfinite(solutions[:, 0])]
        return transfer.plan(np.array(state.q), [*reachable])

    def _check_endpoints(
        self, state: CellState, goal: MoveGoal, model: CollisionModel
    ) -> PlanningFailure | None:
        """Return why a motion cannot start or end as requested."""
        if failure := self._check_start(state):
            return failure
        if goal.end is not None and (failure := check_joint_limits(self.robot, goal.end, "end")):
            return failure
        if self.cell.pedestal_overlaps_support:
            return PlanningFailure(PlanningFailureReason.IN_COLLISION, "pedestal and tray")
        at_rest = [o for o in state.objects if state.held is None or o.name != state.held.name]
        if failure := check_overlaps(model, at_rest, self.config.max_overlap):
            return failure
        if state.held is None:
            if failure := check_configuration(
                self.robot, self.config.min_distance, model, np.array(state.q), "at the start"
            ):
                return failure
            end = goal.end if goal.end is not None else np.array(state.q)
            if (end != np.array(state.q)).any() and (
                failure := check_configuration(
                    self.robot, self.config.min_distance, model, end, "at the end"
                )
            ):
                return failure
        if goal.releases and goal.X_TO_place is not None:
            # Of the motions that end with a release, only `plan` has a guarded descent.
            max_drop = self.config.max_guarded_descent if state.held is None else 0.0
            return self.check_release(model, state.objects, goal.picked, goal.X_TO_place, max_drop)
        return None

    def _check_start(self, state: CellState) -> PlanningFailure | None:
        """Return why no motion can start in a state, apart from collisions."""
        return check_joint_limits(
            self.robot, to_configuration(self.robot, state.q, "start"), "start"
        )

    def check_release(
        self,
        model: CollisionModel,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        max_drop: float,
    ) -> PlanningFailure | None:
        """Return why the object cannot be released at a pose, see `check_place`.

        Args:
            model: Collision model of the cell with all objects.
            objects: All known objects.
            picked: The object.
            X_TO_place: Its pose.
            max_drop: Distance by which a guarded descent can lower the object [m].
        """
        others = [o for o in objects if o is not picked]
        placed = replace(picked, X_TO=X_TO_place)
        return check_place(placed, others, model, max_drop)

    def search(
        self,
        model: CollisionModel,
        state: CellState,
        goal: MoveGoal,
        occluded: Sequence[OccludedBox] = (),
    ) -> PickPlaceSearch:
        """Return the search for a motion.

        Args:
            model: Collision model of the cell with all objects.
            state: State at the start.
            goal: Motion of the object.
            occluded: Occluded volumes, which count as obstacles.
        """
        tops = [*model.fixture_tops, *(box.top_height for box in occluded)]
        return PickPlaceSearch(self.cell, self.config, self.tools, model, state, goal, tops)
