"""Pick-and-place planner: grasps, collision-free paths, time-optimal trajectories.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import time
from collections.abc import Hashable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import Trajectory

from drake_clutter.cell.gripper import Grasp, GraspFailure, GraspSampling, Gripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.motion_plan import (
    CellState,
    HeldObject,
    MotionPlan,
    PlanStep,
    stay_at,
)
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
    grasp_and_carry,
    release_steps,
)
from drake_clutter.planning.pick_place_search import FoundMove, MoveGoal, PickPlaceSearch
from drake_clutter.planning.place_check import check_place
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.planning.transfer_planner import TransferPlanner
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.geometry import objects_resting_on
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import pose_from_transform, rigid_transform

Floats = NDArray[np.float64]

_DESCENT_TOLERANCE = 0.001
"""A guarded descent that falls short by less reaches what it is planned for [m]."""
_JOINT_TOLERANCE = 1e-6
"""Joint positions may differ by this from what is asked for [rad]."""


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
        grasp: Grasp | None = None,
        start: Sequence[float] | None = None,
        end: Sequence[float] | None = None,
    ) -> PickPlacePlan | PlanningFailure:
        """Plan to move an object to a pose that differs by a translation and a yaw.

        Args:
            objects: All known objects, including the picked one.
            pick: Name of the picked object.
            X_TO_place: Pose at which the object is released.
            occluded: Occluded volumes, which count as obstacles.
            grasp: Grasp of the object, see `make_grasp`; None to sample grasps.
            start: Joint positions at the start [rad]; None for home. Shape (n,).
            end: Joint positions at the end [rad]; None for home. Shape (n,).

        Returns:
            The plan, or the reason why there is none.

        Raises:
            InputError: No object has the name, or a configuration has another number of joints.
        """
        start_time = time.perf_counter()
        home = tuple(self.robot.home.tolist())
        state = CellState(home if start is None else tuple(start), tuple(objects))
        q_end = self.robot.home if end is None else self._to_configuration(end, "end")
        picked = find_object(objects, pick)
        # Try the offset first, then the place pose itself; only once if the offset is 0.
        for offset in dict.fromkeys((self.config.descent_start_offset, 0.0)):
            X_TO_start = X_TO_place.translated((0.0, 0.0, offset))
            goal = MoveGoal(picked, X_TO_start, self.config.lift_height, True, q_end)
            found = self._find_pick(state, goal, grasp, occluded)
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
            failure = self._check_place(
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
        grasp: Grasp | None = None,
        lift_height: float | None = None,
        occluded: Sequence[OccludedBox] = (),
    ) -> MotionPlan | PlanningFailure:
        """Plan to grasp an object and to lift it above its place, where it is held.

        Args:
            state: State at the start; no object is held.
            pick: Name of the object.
            grasp: Grasp of the object, see `make_grasp`; None to sample grasps.
            lift_height: Height by which it is lifted at least [m]; None for that of the
                configuration.
            occluded: Occluded volumes, which count as obstacles.

        Raises:
            InputError: No object has the name, or another object is held.
        """
        start_time = time.perf_counter()
        self._check_held(state, is_held=False)
        height = self.config.lift_height if lift_height is None else lift_height
        goal = MoveGoal(find_object(state.objects, pick), None, height, False, None)
        found = self._find_pick(state, goal, grasp, occluded)
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
            InputError: No object is held.
        """
        start_time = time.perf_counter()
        held = self._check_held(state, is_held=True)
        picked = find_object(state.objects, held.name)
        goal = MoveGoal(picked, X_TO_place, self.config.lift_height, True, None)
        found = self._find_held(state, goal, occluded)
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
            tool: Name of the tool; None for the one that holds the object, or else the first.
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
            q_goal = self._to_configuration(goal, "goal")
            X_TG = RigidTransform(self.tools[name].pose(q_goal))
            if failure := self._check_joint_limits(q_goal, "goal"):
                return failure
        if state.held is None:
            found = self._find_transfer(state, X_TG, q_goal, name, occluded)
        else:
            if state.held.tool != name:
                raise InputError(
                    f"tool: {format_value(name)}; expected {state.held.tool!r}, which holds"
                )
            X_TO = pose_from_transform(X_TG @ state.held.X_OG.inverse())
            picked = find_object(state.objects, state.held.name)
            move = self._find_held(
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
        """
        step = self._step("hold", stay_at(state.q, duration), state.held)
        return MotionPlan(state, state, (step,))

    def make_grasp(
        self, picked: SceneObject, tool: str, X_OG: RigidTransform
    ) -> Grasp | PlanningFailure:
        """Return a grasp of one's own, or the reason why the tool cannot hold the object with it.

        Args:
            picked: Object at its pose.
            tool: Name of the tool.
            X_OG: Pose of the tool in the object: of a cup with its origin on the surface.

        Raises:
            InputError: The gripper has no such tool.
        """
        if tool not in self.tools:
            raise InputError(f"tool: {format_value(tool)}; expected one of {', '.join(self.tools)}")
        object_class = picked.object_class
        if failure := self._check_payload(picked):
            return failure
        X_TO = rigid_transform(picked.X_TO)
        grasp = self._gripper.make_grasp(tool, object_class, X_TO, X_TO @ X_OG, self._sampling)
        if isinstance(grasp, GraspFailure):
            return PlanningFailure(
                PlanningFailureReason(grasp.reason.value), picked.name, grasp.value
            )
        return grasp

    def _step(self, name: str, trajectory: Trajectory, held: HeldObject | None) -> PlanStep:
        """Return a step in which the gripper stays as it is."""
        if held is None:
            open_joints = (0.0,) * self._gripper.num_actuated_joints
            return PlanStep(name, trajectory, joints=open_joints)
        return PlanStep(name, trajectory, held.payload, held.tool, held.joints_closed)

    def _find_pick(
        self,
        state: CellState,
        goal: MoveGoal,
        grasp: Grasp | None,
        occluded: Sequence[OccludedBox],
    ) -> tuple[FoundMove, int] | PlanningFailure:
        """Return a motion that starts with an approach, and the number of attempts."""
        start_time = time.perf_counter()
        if carried := objects_resting_on(goal.picked, state.objects):
            return PlanningFailure(PlanningFailureReason.CARRIES_OTHERS, ", ".join(carried))
        grasps = self._grasps(goal.picked) if grasp is None else (grasp,)
        if isinstance(grasps, PlanningFailure):
            return grasps
        model = self.collision_model(state.objects, occluded)
        if failure := self._check_endpoints(state, goal, model):
            return failure
        search = self._search(model, state, goal, occluded)
        found = self._try_grasps(search, grasps, start_time)
        return found if isinstance(found, PlanningFailure) else (found, search.num_attempts)

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
        if error > _JOINT_TOLERANCE:
            return PlanningFailure(PlanningFailureReason.UNREACHABLE, "the goal", error)
        return found

    def _try_grasps(
        self, search: PickPlaceSearch, grasps: Sequence[Grasp], start_time: float
    ) -> FoundMove | PlanningFailure:
        """Return the first motion that is found, or the failure of the best attempt."""
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
        if failure := self._check_configuration(model, np.array(state.q), "at the start"):
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
        if goal.end is not None and (failure := self._check_joint_limits(goal.end, "end")):
            return failure
        if self.cell.pedestal_overlaps_support:
            return PlanningFailure(PlanningFailureReason.IN_COLLISION, "pedestal and tray")
        if state.held is None:
            if failure := self._check_configuration(model, np.array(state.q), "at the start"):
                return failure
            end = goal.end if goal.end is not None else np.array(state.q)
            if (end != np.array(state.q)).any() and (
                failure := self._check_configuration(model, end, "at the end")
            ):
                return failure
        if goal.releases and goal.X_TO_place is not None:
            # Of the motions that end with a release, only `plan` has a guarded descent.
            max_drop = self.config.max_guarded_descent if state.held is None else 0.0
            return self._check_place(model, state.objects, goal.picked, goal.X_TO_place, max_drop)
        return None

    def _check_start(self, state: CellState) -> PlanningFailure | None:
        """Return why no motion can start in a state, apart from collisions."""
        return self._check_joint_limits(self._to_configuration(state.q, "start"), "start")

    def _check_joint_limits(self, q: Floats, name: str) -> PlanningFailure | None:
        """Return the joint that exceeds its limits most, if any.

        Args:
            q: Joint positions [rad]. Shape (n,).
            name: Name of the configuration.
        """
        lower, upper = self.robot.position_limits.T
        excess = np.maximum(lower - q, q - upper)
        joint = int(excess.argmax())
        if excess[joint] <= _JOINT_TOLERANCE:
            return None
        detail = f"{name}: {self.robot.joint_names[joint]}"
        return PlanningFailure(PlanningFailureReason.JOINT_LIMIT, detail, float(excess[joint]))

    def _check_configuration(
        self, model: CollisionModel, q: Floats, name: str
    ) -> PlanningFailure | None:
        """Return the closest pair of bodies in a configuration if it is too close."""
        pairs = model.distances_below(q, self.config.min_distance)
        if not pairs:
            return None
        nearest = min(pairs, key=lambda pair: pair.distance)
        pair = " and ".join(nearest.pair)
        if (q == self.robot.home).all():
            reason = PlanningFailureReason.HOME_IN_COLLISION
            return PlanningFailure(reason, pair, nearest.distance)
        reason = PlanningFailureReason.IN_COLLISION
        return PlanningFailure(reason, f"{name}: {pair}", nearest.distance)

    def _to_configuration(self, q: Sequence[float], name: str) -> Floats:
        """Return joint positions as an array, or raise an error if their number is wrong."""
        values = np.asarray(q, float)
        if values.shape != (self.robot.num_joints,) or not np.isfinite(values).all():
            problem = f"{name}: {format_value(list(q))}"
            raise InputError(f"{problem}; expected {self.robot.num_joints} joint positions in rad")
        return values

    @staticmethod
    def _check_held(state: CellState, *, is_held: bool) -> HeldObject:
        """Return the held object, or raise an error unless one is held as expected."""
        if is_held and state.held is None:
            raise InputError("state: no object is held; expected one, see `plan_pick`")
        if not is_held and state.held is not None:
            raise InputError(f"state: {state.held.name!r} is held; expected no held object")
        return cast(HeldObject, state.held)

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

    def grasps(self, scene_object: SceneObject) -> Sequence[Grasp] | PlanningFailure:
        """Return the feasible grasps of an object, closest to its center of mass first."""
        return self._grasps(scene_object)

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
        if failure := self._check_payload(picked):
            return failure
        object_class = picked.object_class
        grasps = self._gripper.sample_grasps(
            object_class, rigid_transform(picked.X_TO), self._sampling
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
        max_drop = self.config.max_guarded_descent
        if self._check_place(model, objects, picked, X_TO_place, max_drop) is not None:
            return False
        goal = MoveGoal(picked, X_TO_place, self.config.lift_height, True, self.robot.home)
        search = self._search(model, self.home_state(objects), goal)
        return any(search.has_candidate(grasp) for grasp in grasps)
