"""Collision-free, timed trajectory segments of a move: approach, carry, retreat, descent.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.carry_columns import CarryColumns
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
from drake_clutter.planning.shape_table import FoundDistances
from drake_clutter.planning.time_parameterization import (
    MAX_JOINT_STEP,
    bspline_path,
    parameterize_time_optimal,
    sample_path,
)
from drake_clutter.planning.tool_kinematics import (
    CarryPath,
    ToolKinematics,
    raise_pose,
)
from drake_clutter.planning.trajectory_optimization import (
    INFLUENCE_DISTANCE,
    MIN_AXIAL_TRAVEL,
    LinearizedDistances,
    TrajectoryOptimizationProblem,
    optimize_trajectory,
)
from drake_clutter.planning.transfer_planner import TransferPlanner
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, SceneObject

Floats = NDArray[np.float64]

MAX_REPORTED_DISTANCE = 0.03
"""Distances above this are not computed when a path is checked [m]."""
CONTACT_TOLERANCE = 0.0005
"""The attached object may come closer by this to what it touches at its pick and place poses [m]:
poses of objects at rest have slight penetrations."""
OPTIMIZATION_MARGIN = 0.005
"""Distance that trajectory optimization keeps in addition to `PlannerConfig.min_distance` [m]. It
imposes distances at few points; the check afterwards is dense."""
MAX_CARRY_TILT = math.radians(0.5)
"""Largest tilt of the gripper while it carries an object [rad]; the suction cup is planned for
vertical loads."""
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
    """Plans the trajectory segments of one move and checks them for collisions."""

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        tools: Mapping[str, ToolKinematics],
        collision_model: CollisionModel,
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
        self._picked = picked
        self._X_TO_place = X_TO_place
        self._start = start
        self._releases = releases
        self._end = end
        self._num_tree_searches = 0
        self._failures = failures
        self._tools = tools
        self._robot = load_robot(cell.robot)
        self._limits = dict[Payload, MotionLimits]()
        self._columns: dict[GraspCandidate, CarryColumns] = {}
        self._grasp_contacts = {
            name: [(link, picked.name) for link in tool.contact_links]
            for name, tool in cell.gripper.tools.items()
        }

    def _motion_limits(self, payload: Payload) -> MotionLimits:
        """Return the limits of motions with a load."""
        if payload not in self._limits:
            self._limits[payload] = MotionLimits(self._cell, payload)
        return self._limits[payload]

    def min_distance_along(
        self, path: Floats, endpoint: EndpointContext, progress: int, stage: str
    ) -> SignedDistance | None:
        """Return the smallest distance along a path to obstacles that it may not touch.

        Args:
            path: Configurations. Shape (m, n).
            endpoint: Endpoint near which smaller distances are allowed.
            progress: Stage of planning, see `FailureLog.record`.
            stage: Name of the stage for the failure.

        Returns:
            The distance, infinite if nothing is near, or None after recording a failure if a
            distance is too small.
        """
        model, min_distance = self._collision_model, self._config.min_distance
        found = model.distances_along(path, MAX_REPORTED_DISTANCE)
        required = self._required_distances(found, path, endpoint, min_distance)
        if too_close := np.flatnonzero(found.distances < required).tolist():
            nearest = model.signed_distance(found, too_close[0])
            self._failures.record(
                progress,
                PlanningFailureReason.IN_COLLISION,
                f"{stage}: {' and '.join(nearest.pair)}",
                nearest.distance,
            )
            return None
        counts = (required >= min_distance) & ~model.is_to_arm(found)
        if not counts.any():
            return SignedDistance(math.inf)
        return model.signed_distance(found, int(np.where(counts, found.distances, np.inf).argmin()))

    def _required_distances(
        self, found: FoundDistances, path: Floats, endpoint: EndpointContext, min_distance: float
    ) -> Floats:
        """Return the required distances of pairs along a path [m]. Shape (k,).

        The gripper may touch the picked object, and the attached object may touch its neighbors at
        the endpoint. The required distance grows with the horizontal distance from the endpoint.

        Args:
            found: Distances along the path. Length k.
            path: Configurations. Shape (m, n).
            endpoint: Endpoint near which smaller distances are allowed.
            min_distance: Required distance of all other pairs [m]; a held object keeps more.
        """
        p_TG = self._collision_model.tool_positions(endpoint.tool, path)
        offsets = np.hypot(*(p_TG[:, :2] - endpoint.p_TG_xy).T)
        contacts = dict.fromkeys(self._grasp_contacts[endpoint.tool], self._config.lip_gap / 2)
        required = np.full(len(found.rows), min_distance)
        required[self._collision_model.is_of_attached(found)] += endpoint.load_distance
        for pair, allowed in {**endpoint.allowed_distances, **contacts}.items():
            of_pair = self._collision_model.is_between(found, pair)
            required[of_pair] = np.minimum(
                required[of_pair], allowed + offsets[found.rows[of_pair]]
            )
        return required

    def distances_below_object(
        self, candidate: GraspCandidate, q: Floats, below: Set[str]
    ) -> dict[tuple[str, str], float]:
        """Return the allowed distances between gripper and bodies below a thin object [m].

        The gripper comes as close to them as the object is thin.

        Args:
            candidate: Grasp.
            q: Joint positions at which the tool holds the object. Shape (n,).
            below: Names of the bodies below the object.
        """
        links = self._cell.gripper.tools[candidate.tool].contact_links
        distances = self._collision_model.distances_below(q, self._config.min_distance)
        # A body may have several geometries: the smallest distance is the last and is kept.
        return {
            distance.pair: max(distance.distance - CONTACT_TOLERANCE, self._config.lip_gap / 2)
            for distance in sorted(distances, key=lambda distance: -distance.distance)
            if distance.pair[0] in links and distance.pair[1] in below
        }

    def contact_distances(
        self, candidate: GraspCandidate, q: Floats
    ) -> dict[tuple[str, str], float]:
        """Return the allowed distances to neighbors of the attached object, by names [m].

        They also bound what trajectory optimization keeps: it cannot increase the distances of
        neighbors of a vertical line.

        Args:
            candidate: Grasp.
            q: Joint positions at an endpoint. Shape (n,).
        """
        name = self._picked.name
        reach = self._config.min_distance + candidate.load_distance + OPTIMIZATION_MARGIN
        distances = self._collision_model.distances_below(q, reach)
        of_object = [distance for distance in distances if distance.pair[0] == name]
        # A neighbor may have several geometries: the smallest distance is the last and is kept.
        return {
            distance.pair: distance.distance - CONTACT_TOLERANCE
            for distance in sorted(of_object, key=lambda distance: -distance.distance)
        }

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
        lift = tool.extend_upwards(carry_path.reversed_approach, candidate.insertion)
        lowering = tool.extend_upwards(carry_path.retreat, candidate.insertion)
        if lift is None or lowering is None:
            self._failures.record(3, PlanningFailureReason.UNREACHABLE, "above the object")
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
            self.set_up_segment(name, candidate)
            attempts = (self._time_segment(name, path, payload) for path in free_paths[name])
            segment = next((attempt for attempt in attempts if attempt), None)
            if segment is None:
                return None
            segments[name] = segment
        if not self._config.optimize:
            return segments
        # The load of a tilted grasp is planned for the tilts of its carry.
        return {
            name: segments[name]
            if name == "carry" and candidate.is_tilted
            else self._optimize_segment(segments[name], payload, candidate, endpoints)
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
            min_distance = self._check_segment(name, path, candidate, endpoints, progress)
            if min_distance is not None:
                yield _FreePath(path, min_distance)

    def _time_segment(
        self, name: str, free: _FreePath, payload: Payload
    ) -> TrajectorySegment | None:
        """Return the segment along a path, or None after recording a failure."""
        trajectory = parameterize_time_optimal(free.path, self._motion_limits(payload))
        if isinstance(trajectory, LimitViolation):
            self._failures.record(
                _TIMING_STAGE,
                PlanningFailureReason.TRAJECTORY_INFEASIBLE,
                f"{name}: {trajectory}",
                trajectory.ratio,
            )
            return None
        return TrajectorySegment(
            name, trajectory.to_trajectory(), free.min_distance, trajectory.end_time
        )

    def set_up_segment(self, segment_name: str, candidate: GraspCandidate) -> None:
        """Set the pose of the picked object in the collision model for a segment."""
        name = self._picked.name
        X_TO = self._X_TO_place if segment_name == "retreat" else self._picked.X_TO
        holds = segment_name == "carry"
        self._collision_model.detach_object()
        self._collision_model.set_object_pose(name, X_TO)
        self._collision_model.set_gripper_joints(
            candidate.joints_held if holds else candidate.joints_open
        )
        if holds:
            self._collision_model.attach_object(name, candidate.tool, candidate.X_OG)

    def _check_segment(
        self,
        segment_name: str,
        path: CubicSpline,
        candidate: GraspCandidate,
        endpoints: tuple[EndpointContext, EndpointContext],
        progress: int,
        spacing: float = MAX_JOINT_STEP / 2,
    ) -> SignedDistance | None:
        """Return the smallest distance along a path, or None after recording a failure.

        Args:
            segment_name: `approach`, `carry` or `retreat`.
            path: Path or trajectory in joint space.
            candidate: Grasp.
            endpoints: Pick and place endpoint.
            progress: Stage of planning, see `FailureLog.record`.
            spacing: Distance between checked configurations [rad].
        """
        self.set_up_segment(segment_name, candidate)
        points = sample_path(path, spacing)
        if segment_name == "carry" and self._exceeds_tilt(candidate, points, progress):
            return None
        if segment_name != "carry":
            context = self._arm_context(segment_name, endpoints)
            return self.min_distance_along(points, context, progress, segment_name)
        slack = self.carry_columns(candidate).slack(points)
        if slack < 0:
            detail = f"carry: {self._picked.name} and what may be below it"
            self._failures.record(progress, PlanningFailureReason.IN_COLLISION, detail, slack)
            return None
        half = len(points) // 2
        from_pick = self.min_distance_along(points[:half], endpoints[0], progress, segment_name)
        if from_pick is None:
            return None
        to_place = self.min_distance_along(points[half:], endpoints[1], progress, segment_name)
        if to_place is None:
            return None
        return min((from_pick, to_place), key=lambda distance: distance.distance)

    @staticmethod
    def _arm_context(
        segment_name: str, endpoints: tuple[EndpointContext, EndpointContext]
    ) -> EndpointContext:
        """Return the endpoint of a segment on which no object is attached."""
        return endpoints[1] if segment_name == "retreat" else endpoints[0]

    def _exceeds_tilt(self, candidate: GraspCandidate, path: Floats, progress: int) -> bool:
        """Return whether the tilt exceeds `MAX_CARRY_TILT`, and record that failure.

        Paths of robots with `vertical_tool_rows` do not tilt the gripper. The load of a tilted
        grasp is planned for its tilt.

        Args:
            candidate: Grasp.
            path: Configurations. Shape (m, n).
            progress: Stage of planning, see `FailureLog.record`.
        """
        if self._robot.vertical_tool_rows is not None or candidate.is_tilted:
            return False
        axis = self._tools[candidate.tool].axis(path)
        tilt = float(np.linalg.norm(axis[:, :2], axis=1).max())
        if tilt > MAX_CARRY_TILT:
            self._failures.record(
                progress, PlanningFailureReason.TRAJECTORY_INFEASIBLE, "carry", tilt
            )
        return tilt > MAX_CARRY_TILT

    def carry_columns(self, candidate: GraspCandidate) -> CarryColumns:
        """Return what may stand below the object where a grasp picks and places it."""
        if candidate not in self._columns:
            self._columns = {
                candidate: CarryColumns(
                    self._picked,
                    self._X_TO_place,
                    candidate,
                    self._tools[candidate.tool],
                    self._config.min_distance + candidate.load_distance,
                    self._config.carry_clearance,
                    starts_at_rest=self._start is not None,
                    ends_at_rest=self._releases,
                )
            }
        return self._columns[candidate]

    def _optimize_segment(
        self,
        segment: TrajectorySegment,
        payload: Payload,
        candidate: GraspCandidate,
        endpoints: tuple[EndpointContext, EndpointContext],
    ) -> TrajectorySegment:
        """Return a faster trajectory of a segment, or the segment itself if none is found."""
        self.set_up_segment(segment.name, candidate)
        min_distance = self._config.min_distance + OPTIMIZATION_MARGIN
        is_carry = segment.name == "carry"
        arm_context = self._arm_context(segment.name, endpoints)

        def nearby_distances(q: Floats, s: Floats) -> LinearizedDistances:
            found = self._collision_model.distances_along(
                q, INFLUENCE_DISTANCE, with_gradients=True
            )
            required = [
                self._required_distances(found, q, context, min_distance)
                for context in (endpoints if is_carry else (arm_context, arm_context))
            ]
            slack = found.distances - np.where(s[found.rows] < 0.5, *required)
            # Links are as close to each other as the arm is folded, which it is at the ends, too.
            slack[self._collision_model.is_to_arm(found)] += OPTIMIZATION_MARGIN
            # Distances between neighboring wrist links are constant.
            varies = np.abs(found.gradients).max(axis=1, initial=0.0) > 1e-6
            return LinearizedDistances(found.rows[varies], found.gradients[varies], slack[varies])

        columns = self.carry_columns(candidate)
        height = columns.clearance
        distances = (0.0, height, height) if is_carry else MIN_AXIAL_TRAVEL
        starts_at_object = segment.name == "retreat" or (is_carry and self._start is not None)
        ends_at_object = segment.name == "approach" or (is_carry and self._releases)
        has_columns = is_carry and (starts_at_object or ends_at_object)
        limits = self._motion_limits(payload)
        problem = TrajectoryOptimizationProblem(
            initial_trajectory=segment.trajectory,
            robot=self._robot,
            departure_distances=distances if starts_at_object else (),
            arrival_distances=distances if ends_at_object else (),
            keep_tool_vertical=is_carry,
            max_tool_speed=limits.max_tool_speed,
            max_tool_acceleration=payload.max_axis_acceleration,
            nearby_distances=nearby_distances,
            column_distances=columns.distances if has_columns else None,
            tool_jacobians=self._tools[candidate.tool].jacobians,
            tool_axis=self._tools[candidate.tool].axis,
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
            closest = self._check_segment(
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

        The attached object is ignored: it is expected to touch something. A rigid tool does not
        descend: it would not yield at contact.

        Args:
            candidate: Grasp.
            place: Endpoint at the place pose.
            q_place: Joint positions at the place pose. Shape (n,).
        """
        if self._cell.gripper.tools[candidate.tool].compliant_joint is None:
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
        heights = np.arange(0.0, self._config.max_guarded_descent + 1e-9, _DESCENT_STEP)
        self.set_up_segment("retreat", candidate)
        self._collision_model.set_object_pose(
            self._picked.name, self._X_TO_place.translated((0.0, 0.0, -10.0))
        )
        for previous, height in pairwise(heights):
            X_TG = np.array([raise_pose(X_place, -previous), raise_pose(X_place, -height)])
            step = self._tools[candidate.tool].track(X_TG, path[-1])
            if step is None or self.min_distance_along(step[1:], context, 0, "the descent") is None:
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
