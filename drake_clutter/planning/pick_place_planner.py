"""Pick-and-place planner: grasps, collision-free paths, time-optimal trajectories.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import Trajectory

from drake_clutter.cell.gripper import UP, Grasp
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.grasp_finder import GraspFinder, Vector
from drake_clutter.planning.motion_plan import (
    CellState,
    HeldObject,
    MotionPlan,
    PlanStep,
    stay_at,
)
from drake_clutter.planning.move_finder import GraspChoice, MoveFinder
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    grasp_and_carry,
    release_steps,
)
from drake_clutter.planning.pick_place_search import MoveGoal
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.state_check import (
    check_held,
    check_joint_limits,
    check_overlaps,
    check_pose,
    check_positive,
    find_object,
    to_configuration,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import pose_from_transform

Floats = NDArray[np.float64]

_DESCENT_TOLERANCE = 0.001
"""A guarded descent that falls short by less reaches what it is planned for [m]."""


class PickPlacePlanner:
    """Deterministic pick-and-place planner for one work cell.

    `plan` moves an object from home to home. The other methods plan parts of such a motion, between
    any states of the cell.

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
        self._grasp_finder = GraspFinder(cell, config, self.robot)
        self._finder = MoveFinder(cell, config, self._grasp_finder)
        self.tools = self._finder.tools

    def home_state(self, objects: Sequence[SceneObject]) -> CellState:
        """Return the state of the cell with the arm at home.

        Args:
            objects: All known objects at their poses.
        """
        return CellState(tuple(self.robot.home.tolist()), tuple(objects))

    def plan(
        self,
        objects: Sequence[SceneObject],
        pick: str,
        X_TO_place: Pose,
        occluded: Sequence[OccludedBox] = (),
        *,
        grasp: GraspChoice = None,
        exclude: Sequence[HeldObject] = (),
        start: Sequence[float] | None = None,
        end: Sequence[float] | None = None,
    ) -> PickPlacePlan | PlanningFailure:
        """Plan to move an object to a pose that differs by a translation and a yaw.

        Args:
            objects: All known objects, including the picked one.
            pick: Name of the picked object.
            X_TO_place: Pose at which the object is released.
            occluded: Occluded volumes, which count as obstacles.
            grasp: Grasp of the object, see `make_grasp`, or several, see `grasps`; None to sample
                grasps from above, then from its sides.
            exclude: Grasps that are left out, such as `PickPlacePlan.held` of a plan with which the
                gripper did not grasp the object.
            start: Joint positions at the start [rad]; None for home. Shape (n,).
            end: Joint positions at the end [rad]; None for home. Shape (n,).

        Returns:
            The plan, or the reason why there is none.

        Raises:
            InputError: No object has the name, the pose is not one, or a configuration has another
                number of joints.
        """
        start_time = time.perf_counter()
        home = tuple(self.robot.home.tolist())
        state = CellState(home if start is None else tuple(start), tuple(objects))
        q_end = self.robot.home if end is None else to_configuration(self.robot, end, "end")
        picked = find_object(objects, pick)
        check_pose(X_TO_place, "place")
        # Try the offset first, then the place pose itself; only once if they are the same.
        start_offset = self.config.descent_start_offset if self.config.max_guarded_descent else 0.0
        for offset in dict.fromkeys((start_offset, 0.0)):
            X_TO_start = X_TO_place.translated((0.0, 0.0, offset))
            goal = MoveGoal(picked, X_TO_start, self.config.lift_height, True, q_end)
            found = self._finder.find_pick(state, goal, grasp, occluded, exclude)
            if isinstance(found, PlanningFailure):
                return replace(found, planning_time=time.perf_counter() - start_time)
            move, num_attempts = found
            plan = PickPlacePlan(
                pick=pick,
                X_TO_pick=picked.X_TO,
                X_TO_place=X_TO_start,
                held=move.held,
                start=state,
                end=replace(state, q=tuple(q_end.tolist())).with_object(pick, X_TO_start),
                segments=tuple(move.segments[name] for name in ("approach", "carry", "retreat")),
                num_attempts=num_attempts,
                planning_time=time.perf_counter() - start_time,
                guarded_descent=move.guarded_descent,
            )
            if plan.max_descent >= offset:
                break
        if plan.max_descent < self.config.max_guarded_descent:
            model = self.collision_model(objects, occluded)
            failure = self._finder.check_release(
                model, objects, picked, plan.X_TO_place, plan.max_descent + _DESCENT_TOLERANCE
            )
            if failure is not None:
                return replace(failure, planning_time=time.perf_counter() - start_time)
        return plan

    def plan_pick(
        self,
        state: CellState,
        pick: str,
        *,
        grasp: GraspChoice = None,
        exclude: Sequence[HeldObject] = (),
        lift_height: float | None = None,
        occluded: Sequence[OccludedBox] = (),
    ) -> MotionPlan | PlanningFailure:
        """Plan to grasp an object and to lift it above its place, where it is held.

        Args:
            state: State at the start; no object is held.
            pick: Name of the object.
            grasp: Grasp of the object, see `make_grasp`, or several, see `grasps`; None to sample
                grasps from above, then from its sides.
            exclude: Grasps that are left out, see `plan`.
            lift_height: Height by which it is lifted at least [m]; None for that of the
                configuration.
            occluded: Occluded volumes, which count as obstacles.

        Raises:
            InputError: No object has the name, another object is held, or the height is not
                positive.
        """
        start_time = time.perf_counter()
        check_held(state, is_held=False)
        height = self.config.lift_height if lift_height is None else lift_height
        check_positive(height, "lift_height")
        goal = MoveGoal(find_object(state.objects, pick), None, height, False, None)
        found = self._finder.find_pick(state, goal, grasp, occluded, exclude)
        if isinstance(found, PlanningFailure):
            return replace(found, planning_time=time.perf_counter() - start_time)
        move, _ = found
        approach, lift = (move.segments[name].trajectory for name in ("approach", "carry"))
        q_end = lift.value(lift.end_time()).ravel()
        return MotionPlan(
            state,
            replace(state, held=move.held).moved(q_end, self.tools[move.held.tool].pose(q_end)),
            (
                PlanStep("approach", approach, joints=move.held.joints_open),
                *grasp_and_carry(move.held, lift, "lift", goal.picked.X_TO),
            ),
            time.perf_counter() - start_time,
        )

    def plan_place(
        self, state: CellState, X_TO_place: Pose, *, occluded: Sequence[OccludedBox] = ()
    ) -> MotionPlan | PlanningFailure:
        """Plan to release the held object at a pose; the arm stays above it.

        Args:
            state: State at the start, with a held object.
            X_TO_place: Pose at which the object is released.
            occluded: Occluded volumes, which count as obstacles.

        Raises:
            InputError: No object is held, or the pose is not one.
        """
        start_time = time.perf_counter()
        held = check_held(state, is_held=True)
        check_pose(X_TO_place, "place")
        picked = find_object(state.objects, held.name)
        goal = MoveGoal(picked, X_TO_place, self.config.lift_height, True, None)
        found = self._finder.find_held(state, goal, occluded)
        if isinstance(found, PlanningFailure):
            return replace(found, planning_time=time.perf_counter() - start_time)
        carry, retreat = (found.segments[name].trajectory for name in ("carry", "retreat"))
        q_end = retreat.value(retreat.end_time()).ravel()
        closed = held.joints_closed
        return MotionPlan(
            state,
            replace(state, held=None).moved(q_end).with_object(held.name, X_TO_place),
            (
                PlanStep("carry", carry, found.held.payload, held.tool, closed),
                *release_steps(found.held, X_TO_place, carry),
                PlanStep("retreat", retreat, joints=held.joints_open),
            ),
            time.perf_counter() - start_time,
        )

    def plan_move(
        self,
        state: CellState,
        goal: Sequence[float] | RigidTransform,
        *,
        tool: str | None = None,
        occluded: Sequence[OccludedBox] = (),
    ) -> MotionPlan | PlanningFailure:
        """Plan a motion to joint positions or to a pose of a tool, with the held object if any.

        A held object is lifted over what is on the way. Without one the arm moves on a straight
        line in joint space, or around what is on the way.

        Args:
            state: State at the start.
            goal: Joint positions [rad], shape (n,), or pose X_TG of the tool.
            tool: Name of the tool. None: the tool that holds the object; the first without one.
            occluded: Occluded volumes, which count as obstacles.

        Raises:
            InputError: The goal has another number of joints, or the gripper has no such tool.
        """
        start_time = time.perf_counter()
        name = tool or (state.held.tool if state.held else next(iter(self.tools)))
        if name not in self.tools:
            allowed = ", ".join(self.tools)
            raise InputError(f"tool: {format_value(name)}; expected one of {allowed}")
        if isinstance(goal, RigidTransform):
            X_TG, q_goal = goal, None
        else:
            q_goal = to_configuration(self.robot, goal, "goal")
            X_TG = RigidTransform(self.tools[name].pose(q_goal))
            if failure := check_joint_limits(self.robot, q_goal, "goal"):
                return failure
        if state.held is None:
            found = self._finder.find_transfer(state, X_TG, q_goal, name, occluded)
        else:
            if state.held.tool != name:
                raise InputError(
                    f"tool: {format_value(name)}; expected {state.held.tool!r}, which holds"
                )
            X_TO = pose_from_transform(X_TG @ state.held.X_OG.inverse())
            picked = find_object(state.objects, state.held.name)
            move = self._finder.find_held(
                state, MoveGoal(picked, X_TO, self.config.lift_height, False, q_goal), occluded
            )
            found = move if isinstance(move, PlanningFailure) else move.segments["carry"].trajectory
        if isinstance(found, PlanningFailure):
            return replace(found, planning_time=time.perf_counter() - start_time)
        q_end = found.value(found.end_time()).ravel()
        step = self._step("move", found, state.held)
        end = state.moved(q_end, self.tools[name].pose(q_end))
        return MotionPlan(state, end, (step,), time.perf_counter() - start_time)

    def plan_hold(self, state: CellState, duration: float) -> MotionPlan:
        """Plan to stay at rest; a held object stays held.

        Args:
            state: State at the start.
            duration: Duration [s].

        Raises:
            InputError: The duration is not positive.
        """
        check_positive(duration, "duration")
        step = self._step("hold", stay_at(state.q, duration), state.held)
        return MotionPlan(state, state, (step,))

    def make_grasp(
        self, picked: SceneObject, tool: str, X_OG: RigidTransform
    ) -> Grasp | PlanningFailure:
        """Return a user-defined grasp, or the reason why the tool cannot hold the object with it.

        Args:
            picked: Object at its pose.
            tool: Name of the tool.
            X_OG: Pose of the tool in the object: of a cup with its origin on the surface.

        Raises:
            InputError: The gripper has no such tool.
        """
        return self._grasp_finder.make_grasp(picked, tool, X_OG)

    def grasps(
        self, scene_object: SceneObject, normal: Vector = UP
    ) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of a face, closest to the center of mass first.

        Args:
            scene_object: The object at its pose.
            normal: Direction from which it is grasped: surfaces whose outward normal differs by at
                most 45 deg count. In T; a horizontal one for a side. Shape (3,).

        Raises:
            InputError: The normal is not a direction.
        """
        return self._grasp_finder.grasps(scene_object, normal)

    def graspable_faces(self, scene_object: SceneObject) -> Iterator[Sequence[Grasp]]:
        """Yield the grasps of each face that has any: from above first, then of the sides.

        Args:
            scene_object: The object at its pose.
        """
        return self._grasp_finder.graspable_faces(scene_object)

    def can_grasp(self, scene_object: SceneObject) -> bool:
        """Return whether the gripper has a grasp on an object that holds its weight."""
        return any(True for _ in self.graspable_faces(scene_object))

    def can_pick(self, scene_object: SceneObject, objects: Sequence[SceneObject]) -> bool:
        """Return whether an object can be grasped and no other object rests on it.

        This is a necessary condition for a plan, and much faster than planning.

        Args:
            scene_object: Object to pick.
            objects: All known objects.
        """
        return not objects_resting_on(scene_object, objects) and self.can_grasp(scene_object)

    def collision_model(
        self, objects: Sequence[SceneObject], occluded: Sequence[OccludedBox] = ()
    ) -> CollisionModel:
        """Return the collision model, see `MoveFinder.collision_model`."""
        return self._finder.collision_model(objects, occluded)

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
        if objects_resting_on(picked, objects):
            return False
        model = self.collision_model(objects)
        if check_overlaps(model, objects, self.config.max_overlap) is not None:
            return False
        max_drop = self.config.max_guarded_descent
        if self._finder.check_release(model, objects, picked, X_TO_place, max_drop) is not None:
            return False
        goal = MoveGoal(picked, X_TO_place, self.config.lift_height, True, self.robot.home)
        search = self._finder.search(model, self.home_state(objects), goal)
        faces = self.graspable_faces(picked)
        return any(search.has_candidate(grasp) for grasps in faces for grasp in grasps)

    def _step(self, name: str, trajectory: Trajectory, held: HeldObject | None) -> PlanStep:
        """Return a step in which the gripper stays as it is."""
        if held is None:
            open_joints = (0.0,) * self.cell.gripper.num_actuated_joints
            return PlanStep(name, trajectory, joints=open_joints)
        return PlanStep(name, trajectory, held.payload, held.tool, held.joints_closed)
