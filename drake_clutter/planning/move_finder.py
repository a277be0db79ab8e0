"""Search for motions of the planner: approach, carry and retreat, or a transfer without object.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import time
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import Trajectory

from drake_clutter.cell.gripper import UP, Grasp, GraspFailure, GraspSampling, Gripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.motion_plan import CellState
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.planning.pick_place_search import FoundMove, MoveGoal, PickPlaceSearch
from drake_clutter.planning.place_check import check_place
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.side_grasps import side_normals
from drake_clutter.planning.state_check import (
    JOINT_TOLERANCE,
    check_configuration,
    check_joint_limits,
    to_configuration,
)
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.planning.transfer_planner import TransferPlanner
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

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

    def _find_pick(
        self,
        state: CellState,
        goal: MoveGoal,
        grasp: GraspChoice,
        occluded: Sequence[OccludedBox],
    ) -> tuple[FoundMove, int] | PlanningFailure:
        """Return a motion that starts with an approach, and the number of attempts.

        Sides of the object are grasped if there is no motion with a grasp from above.
        """
        start_time = time.perf_counter()
        if carried := objects_resting_on(goal.picked, state.objects):
            return PlanningFailure(PlanningFailureReason.CARRIES_OTHERS, ", ".join(carried))
        if grasp is None:
            faces = self._graspable_faces(goal.picked)
            first = next(faces, None)
            if first is None:
                return self._grasp_failure(goal.picked)
            candidates: Iterable[Sequence[Grasp]] = chain([first], faces)
        else:
            candidates = [(grasp,) if isinstance(grasp, Grasp) else grasp]
        model = self.collision_model(state.objects, occluded)
        failure = self._check_endpoints(state, goal, model)
        if failure is not None:
            return failure
        search = self._search(model, state, goal, occluded)
        failure = search.failures.furthest
        for grasps in candidates:
            found = self._try_grasps(search, grasps, start_time)
            if not isinstance(found, PlanningFailure):
                return found, search.num_attempts
            failure = found
            if failure.reason is PlanningFailureReason.TIME_OUT:
                break
        return failure

    def _find_held(
        self, state: CellState, goal: MoveGoal, occluded: Sequence[OccludedBox]
    ) -> FoundMove | PlanningFailure:
        """Return a motion that starts with a held object."""
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
        found = self._try_grasps(self._search(model, state, goal, occluded), (grasp,), start_time)
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

    def _find_transfer(
        self,
        state: CellState,
        X_TG: RigidTransform,
        q_goal: Floats | None,
        tool: str,
        occluded: Sequence[OccludedBox],
    ) -> Trajectory | PlanningFailure:
        """Return a motion without an object to a pose of a tool, or to joint positions."""
        if failure := self._check_start(state):
            return failure
        model = self.collision_model(state.objects, occluded)
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
        """Return why a motion cannot start or end as it is asked for."""
        if failure := self._check_start(state):
            return failure
        if goal.end is not None and (failure := check_joint_limits(self.robot, goal.end, "end")):
            return failure
        if self.cell.pedestal_overlaps_support:
            return PlanningFailure(PlanningFailureReason.IN_COLLISION, "pedestal and tray")
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
            return self._check_place(model, state.objects, goal.picked, goal.X_TO_place, max_drop)
        return None

    def _check_start(self, state: CellState) -> PlanningFailure | None:
        """Return why no motion can start in a state, apart from collisions."""
        return check_joint_limits(
            self.robot, to_configuration(self.robot, state.q, "start"), "start"
        )

    def _check_place(
        self,
        model: CollisionModel,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        max_drop: float,
    ) -> PlanningFailure | None:
        """Return why the object cannot be released at a pose, see `check_place`."""
        others = [o for o in objects if o is not picked]
        placed = replace(picked, X_TO=X_TO_place)
        return check_place(placed, others, model, max_drop)

    def _search(
        self,
        model: CollisionModel,
        state: CellState,
        goal: MoveGoal,
        occluded: Sequence[OccludedBox] = (),
    ) -> PickPlaceSearch:
        tops = [*model.fixture_tops, *(box.top_height for box in occluded)]
        return PickPlaceSearch(self.cell, self.config, self.tools, model, state, goal, tops)

    def grasps(
        self, scene_object: SceneObject, normal: Vector = UP
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of an object, closest to its center of mass first.

        Args:
            scene_object: The object at its pose.
            normal: Direction from which it is grasped: surfaces whose outward normal differs by at
                most 45 deg count. In T; a horizontal one for a side. Shape (3,).

        Raises:
            InputError: The normal is not a direction.
        """
        length = float(np.linalg.norm(normal))
        if not 0 < length < np.inf:
            raise InputError(f"normal: {format_value(list(normal))}; expected a direction")
        x, y, z = (np.array(normal) / length).tolist()
        return self._grasps(scene_object, (x, y, z))

    def _faces(self, picked: SceneObject) -> tuple[Vector, ...]:
        """Return the directions from which an object may be grasped; from above first."""
        return UP, *side_normals(picked, self.robot.X_TB.translation())

    def _graspable_faces(self, picked: SceneObject) -> Iterator[Sequence[Grasp]]:
        """Yield the grasps of each face that has any, see `_faces`."""
        for normal in self._faces(picked):
            grasps = self._grasps(picked, normal)
            if not isinstance(grasps, PlanningFailure):
                yield grasps

    def _grasp_failure(self, picked: SceneObject) -> PlanningFailure:
        """Return why no face of an object has a grasp."""
        found = (self._grasps(picked, normal) for normal in self._faces(picked))
        from_above, *of_sides = (f for f in found if isinstance(f, PlanningFailure))
        if from_above.reason is not PlanningFailureReason.NO_SEAL:
            return from_above
        # A side on which the gripper seals, but does not hold the object, is closer to a grasp.
        return next((f for f in of_sides if f.reason is not from_above.reason), from_above)

    def _find_grasps(
        self, picked: SceneObject, normal: Vector
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of an object, see `grasps`."""
        if failure := self._check_payload(picked):
            return failure
        object_class = picked.object_class
        grasps = self._gripper.sample_grasps(
            object_class, rigid_transform(picked.X_TO), replace(self._sampling, normal=normal)
        )
        if isinstance(grasps, GraspFailure):
            reason = PlanningFailureReason(grasps.reason.value)
            return PlanningFailure(reason, picked.name, grasps.value)
        return grasps

    @property
    def _sampling(self) -> GraspSampling:
        """Parameters of grasp sampling."""
        config = self.config
        return GraspSampling(
            config.grasp_spacing,
            config.lip_gap,
            config.max_grasps,
            config.min_payload_acceleration,
        )

    def _check_payload(self, picked: SceneObject) -> PlanningFailure | None:
        """Return why gripper and object exceed the payload of the robot, or None."""
        mass = picked.object_class.mass
        if mass + self._gripper.mass <= self.cell.robot.payload:
            return None
        return PlanningFailure(PlanningFailureReason.TOO_HEAVY, picked.name, mass)
