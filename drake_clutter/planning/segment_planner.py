"""Collision-free, timed trajectory segments of a move: approach, carry, retreat, descent.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel, SignedDistance
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.grasp_candidate import EndpointContext, GraspCandidate
from drake_clutter.planning.motion_limits import LimitViolation, MotionLimits, scale_to_limits
from drake_clutter.planning.pick_place_plan import (
    DESCENT_SPEED,
    FailureLog,
    GuardedDescent,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.segment_check import (
    OPTIMIZATION_MARGIN,
    PART_OF_SEGMENT,
    SegmentChecker,
    arm_context,
)
from drake_clutter.planning.spline_program import LinearizedDistances
from drake_clutter.planning.time_parameterization import (
    MAX_JOINT_STEP,
    bspline_path,
    parameterize_time_optimal,
)
from drake_clutter.planning.tool_kinematics import (
    CarryPath,
    ToolKinematics,
    departure_axis,
    raise_pose,
)
from drake_clutter.planning.trajectory_optimization import (
    INFLUENCE_DISTANCE,
    MIN_AXIAL_TRAVEL,
    TrajectoryOptimizationProblem,
    optimize_trajectory,
)
from drake_clutter.planning.transfer_planner import TransferPlanner
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import MovePart
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]

MAX_TREE_SEARCHES = 3
"""Largest number of searches of a move with RRT-Connect, which takes up to some seconds if it finds
no path."""
_TIMING_STAGE = 7
"""Stage of planning at which paths are timed, after the checks of all paths; see `FailureLog`."""
_DESCENT_STEP = 0.005
"""Distance between checked points of a guarded descent [m]."""


@dataclass(frozen=True)
class _FreePath:
    """Path that is free of collisions, with its smallest signed distance."""

    path: CubicSpline
    min_distance: SignedDistance


class SegmentPlanner:
    """Plans the trajectory segments of one move."""

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        tools: Mapping[str, ToolKinematics],
        collision_model: CollisionModel,
        checker: SegmentChecker,
        picked: SceneObject,
        X_TO_place: Pose,
        start: Floats | None,
        releases: bool,
        end: Floats | None,
        failures: FailureLog,
    ) -> None:
        """Prepare the planner.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            tools: Kinematics of robot and tool, by name of the tool.
            collision_model: Collision model with the objects at their poses.
            checker: Checks of the paths.
            picked: Object to pick.
            X_TO_place: Pose at which the object is released.
            start: Joint positions before the approach; None without approach. Shape (n,).
            releases: Whether the object is released, and a retreat follows.
            end: Joint positions after the retreat; None if it ends above the object. Shape (n,).
            failures: Log in which failures are recorded.
        """
        self._cell = cell
        self._config = config
        self._collision_model = collision_model
        self._checker = checker
        self._picked = picked
        self._X_TO_place = X_TO_place
        self._start = start
        self._releases = releases
        self._end = end
        self._num_tree_searches = 0
        self._failures = failures
        self._tools = tools
        self._robot = load_robot(cell.robot)
        self._limits = dict[tuple[Payload, str], MotionLimits]()

    def _motion_limits(self, payload: Payload, candidate: GraspCandidate) -> MotionLimits:
        """Return the limits of motions with the load of a grasp, or without load."""
        tilted_tool = candidate.tool if payload.mass and candidate.is_tilted else ""
        key = payload, tilted_tool
        if key not in self._limits:
            self._limits[key] = MotionLimits(self._cell, payload, tilted_tool=tilted_tool)
        return self._limits[key]

    def plan_segments(
        self,
        candidate: GraspCandidate,
        carry_path: CarryPath,
        endpoints: tuple[EndpointContext, EndpointContext],
    ) -> dict[str, TrajectorySegment] | None:
        """Return `approach`, `carry` and `retreat` as far as asked for, by name.

        Returns:
            The segments, or None after recording a failure.
        """
        empty = Payload()
        tool = self._tools[candidate.tool]
        # Without the object the tool leaves it upwards before it moves sideways.
        # On a side, it has left the object before it moves upwards.
        insertion = 0.0 if candidate.is_sideways else candidate.insertion
        lift = tool.extend_upwards(carry_path.reversed_approach, insertion)
        lowering = tool.extend_upwards(carry_path.retreat, insertion)
        if lift is None or lowering is None:
            part = MovePart.PICK if lift is None else MovePart.PLACE
            self._failures.record(
                3, PlanningFailureReason.UNREACHABLE, "above the object", part=part
            )
            return None
        # Candidate waypoints and payload of each segment, in the order of planning.
        candidates: dict[str, tuple[Iterable[Floats], Payload]] = {
            "carry": ([carry_path.waypoints], candidate.payload)
        }
        if self._start is not None:
            to_start = self._paths_between(tool, lift[-1], self._start, candidate)
            approaches = (np.vstack([lift, path[1:]])[::-1] for path in to_start)
            candidates["approach"] = (approaches, empty)
        if self._releases:
            q_end = lowering[-1] if self._end is None else self._end
            to_end = self._paths_between(tool, lowering[-1], q_end, candidate)
            candidates["retreat"] = ((np.vstack([lowering, path[1:]]) for path in to_end), empty)
        # All paths are checked for collisions before any is timed, which takes longer.
        free_paths = dict[str, Iterator[_FreePath]]()
        for progress, (name, (paths, _)) in enumerate(candidates.items(), start=4):
            found = self._free_paths(name, paths, candidate, endpoints, progress)
            first = next(found, None)
            if first is None:
                return None
            free_paths[name] = chain([first], found)
        segments = dict[str, TrajectorySegment]()
        for name, (_, payload) in candidates.items():
            self._checker.set_up_segment(name, candidate)
            limits = self._motion_limits(payload, candidate)
            attempts = (self._time_segment(name, path, limits) for path in free_paths[name])
            segment = next((attempt for attempt in attempts if attempt), None)
            if segment is None:
                return None
            segments[name] = segment
        if not self._config.optimize:
            return segments
        return {
            name: self._optimize_segment(segments[name], payload, candidate, endpoints)
            for name, (_, payload) in candidates.items()
        }

    def _paths_between(
        self, tool: ToolKinematics, q: Floats, q_end: Floats, candidate: GraspCandidate
    ) -> Iterator[Floats]:
        """Yield candidate paths of an arm without an object. Shapes (m, n).

        Between home and a grasp from above there are alternatives: other grasps and inverse
        kinematics solutions. From and to any other configuration, RRT-Connect comes last.
        """
        if np.array_equal(q, q_end):
            yield q_end[None]
            return
        yield from tool.paths_between(q, q_end)
        is_from_home = np.array_equal(q_end, self._robot.home) and not candidate.is_sideways
        if is_from_home or self._num_tree_searches == MAX_TREE_SEARCHES:
            return
        self._num_tree_searches += 1
        transfer = TransferPlanner(self._cell, self._config, tool, self._collision_model)
        yield from transfer.tree_paths(q, q_end)

    def _free_paths(
        self,
        name: str,
        paths: Iterable[Floats],
        candidate: GraspCandidate,
        endpoints: tuple[EndpointContext, EndpointContext],
        progress: int,
    ) -> Iterator[_FreePath]:
        """Yield those of a segment's paths, given by waypoints, that are free of collisions."""
        for waypoints in paths:
            path = bspline_path(waypoints)
            min_distance = self._checker.check_segment(name, path, candidate, endpoints, progress)
            if min_distance is not None:
                yield _FreePath(path, min_distance)

    def _time_segment(
        self, name: str, free: _FreePath, limits: MotionLimits
    ) -> TrajectorySegment | None:
        """Return the segment along a path, or None after recording a failure."""
        trajectory = parameterize_time_optimal(free.path, limits)
        if isinstance(trajectory, LimitViolation):
            self._failures.record(
                _TIMING_STAGE,
                PlanningFailureReason.TRAJECTORY_INFEASIBLE,
                f"{name}: {trajectory}",
                trajectory.ratio,
                PART_OF_SEGMENT[name],
            )
            return None
        return TrajectorySegment(
            name, trajectory.to_trajectory(), free.min_distance, trajectory.end_time
        )

    def _optimize_segment(
        self,
        segment: TrajectorySegment,
        payload: Payload,
        candidate: GraspCandidate,
        endpoints: tuple[EndpointContext, EndpointContext],
    ) -> TrajectorySegment:
        """Return a faster trajectory of a segment, or the segment itself if none is found."""
        self._checker.set_up_segment(segment.name, candidate)
        min_distance = self._config.min_distance + OPTIMIZATION_MARGIN
        is_carry = segment.name == "carry"
        contexts = endpoints if is_carry else (arm_context(segment.name, endpoints),) * 2

        def nearby_distances(q: Floats, s: Floats) -> LinearizedDistances:
            found = self._collision_model.distances_along(
                q, INFLUENCE_DISTANCE, with_gradients=True
            )
            required = [
                self._checker.required_distances(found, q, context, min_distance)
                for context in contexts
            ]
            slack = found.distances - np.where(s[found.rows] < 0.5, *required)
            # Links are as close to each other as the arm is folded, which it is at the ends, too.
            slack[self._collision_model.is_to_arm(found)] += OPTIMIZATION_MARGIN
            # Distances between neighboring wrist links are constant.
            varies = np.abs(found.gradients).max(axis=1, initial=0.0) > 1e-6
            return LinearizedDistances(found.rows[varies], found.gradients[varies], slack[varies])

        columns = self._checker.carry_columns(candidate)
        height = columns.clearance
        distances = (0.0, height, height) if is_carry else MIN_AXIAL_TRAVEL
        starts_at_object = segment.name == "retreat" or (is_carry and self._start is not None)
        ends_at_object = segment.name == "approach" or (is_carry and self._releases)
        has_columns = is_carry and (starts_at_object or ends_at_object)
        limits = self._motion_limits(payload, candidate)
        tool = self._tools[candidate.tool]
        ends = tool.pose(segment.trajectory.vector_values([0.0, segment.duration]).T)
        problem = TrajectoryOptimizationProblem(
            initial_trajectory=segment.trajectory,
            robot=self._robot,
            departure_distances=distances if starts_at_object else (),
            arrival_distances=distances if ends_at_object else (),
            departure_directions=(
                departure_axis(ends[0]) if is_carry else -ends[0, :3, 2],
                departure_axis(ends[1]) if is_carry else -ends[1, :3, 2],
            ),
            level_axis=candidate.level_axis if is_carry else None,
            max_tool_speed=limits.max_tool_speed,
            max_tool_acceleration=payload.max_axis_acceleration,
            nearby_distances=nearby_distances,
            column_distances=columns.distances if has_columns else None,
            tool_jacobians=tool.jacobians,
            tool_rotations=lambda q: tool.pose(q)[:, :3, :3],
        )
        for optimized in optimize_trajectory(problem):
            trajectory = scale_to_limits(optimized, limits)
            if (
                isinstance(trajectory, LimitViolation)
                or trajectory.end_time >= segment.unoptimized_duration
            ):
                continue
            # Optimized paths pass obstacles closely: the check is denser than that of the initial
            # path.
            closest = self._checker.check_segment(
                segment.name, trajectory, candidate, endpoints, 0, MAX_JOINT_STEP / 4
            )
            if closest is not None:
                return TrajectorySegment(
                    segment.name, trajectory.to_trajectory(), closest, segment.unoptimized_duration
                )
        return segment

    def plan_guarded_descent(
        self, candidate: GraspCandidate, place: EndpointContext, q_place: Floats
    ) -> GuardedDescent | None:
        """Return the vertical descent from the place pose as far as the arm is free.

        The attached object is ignored: it is expected to touch something. A tool that does not
        yield along the vertical at contact does not descend: a rigid one, or one on a side.

        Args:
            candidate: Grasp.
            place: Endpoint at the place pose.
            q_place: Joint positions at the place pose. Shape (n,).
        """
        is_rigid = self._cell.gripper.tools[candidate.tool].compliant_joint is None
        if is_rigid or candidate.is_sideways:
            return None
        heights = np.arange(0.0, self._config.max_guarded_descent + 1e-9, _DESCENT_STEP)
        if len(heights) == 1:
            return None
        X_place = candidate.X_TG_place
        # A thin object may be lowered until the gripper is just above what is below.
        allowed = {
            pair: self._config.lip_gap / 2
            for pair in place.allowed_distances
            if pair[0] in self._cell.gripper.tools[candidate.tool].contact_links
        }
        context = replace(place, allowed_distances=allowed)
        path = [q_place]
        self._checker.set_up_segment("retreat", candidate)
        self._collision_model.set_object_pose(
            self._picked.name, self._X_TO_place.translated((0.0, 0.0, -10.0))
        )
        for previous, height in pairwise(heights):
            X_TG = np.array([raise_pose(X_place, -previous), raise_pose(X_place, -height)])
            step = self._tools[candidate.tool].track(X_TG, path[-1])
            if step is None:
                break
            distance = self._checker.min_distance_along(
                step[1:], context, 0, "the descent", MovePart.PLACE
            )
            if distance is None:
                break
            path.append(step[1])
        if len(path) == 1:
            return None
        limits = MotionLimits(self._cell, candidate.payload, DESCENT_SPEED)
        trajectory = parameterize_time_optimal(bspline_path(np.array(path)), limits)
        if isinstance(trajectory, LimitViolation):
            return None
        times = np.linspace(0.0, trajectory.end_time, 10 * len(path))
        heights = self._tools[candidate.tool].pose(trajectory.values(times))[:, 2, 3]
        depth = PiecewisePolynomial.FirstOrderHold(times, (heights[0] - heights)[None])
        return GuardedDescent(trajectory.to_trajectory(), depth)
