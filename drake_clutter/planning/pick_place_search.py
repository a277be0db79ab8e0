"""Search for a plan over grasps, yaw angles, IK solutions and transfer heights.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.gripper import Grasp, Payload
from drake_clutter.cell.support_sdf import FLOOR
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.grasp_candidate import EndpointContext, GraspCandidate
from drake_clutter.planning.load_deflection import LoadDeflection
from drake_clutter.planning.motion_plan import CellState, HeldObject
from drake_clutter.planning.pick_place_plan import (
    FailureLog,
    GuardedDescent,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.segment_check import CONTACT_TOLERANCE, SegmentChecker
from drake_clutter.planning.segment_planner import SegmentPlanner
from drake_clutter.planning.side_grasps import distance_from_below
from drake_clutter.planning.time_parameterization import min_travel_time
from drake_clutter.planning.tool_kinematics import (
    RISE_CORNER,
    CarryPath,
    ToolKinematics,
    WayOut,
    has_same_tilt,
    invert_pose,
    is_sideways,
    is_vertical,
    raise_pose,
    retreat_along_axis,
    turn_about_axis,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import MovePart
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]


_MAX_RAISES = 2
"""How often a path is raised that is too low above what may stand below the object."""


def _to_matrix(X_AB: RigidTransform) -> Floats:
    return np.ascontiguousarray(X_AB.GetAsMatrix4())


@dataclass(frozen=True)
class MoveGoal:
    """Motion of one object that is searched for.

    Attributes:
        picked: Object at its pose at the start, which the tool picks or holds.
        X_TO_place: Pose to which the object is carried; None to lift it above its place.
        lift_height: Height by which it is lifted at least [m].
        releases: Whether the object is released at the end.
        end: Joint positions at the end; None if the arm stays above the released object, or if
            inverse kinematics decides. Shape (n,).
    """

    picked: SceneObject
    X_TO_place: Pose | None
    lift_height: float
    releases: bool
    end: Floats | None


@dataclass(frozen=True)
class FoundMove:
    """Motion of one object.

    Attributes:
        held: The object while the tool holds it.
        segments: `approach`, `carry` and `retreat` as far as they are part of the motion, by name.
        guarded_descent: Descent from the place pose; None without one.
    """

    held: HeldObject
    segments: Mapping[str, TrajectorySegment]
    guarded_descent: GuardedDescent | None


class PickPlaceSearch:
    """Search for a plan of one move.

    A move has up to three segments. An object that is held at the start has no approach, one that
    is held at the end no retreat.

    Attributes:
        num_attempts: Number of combinations of grasp, IK solution and transfer height tried so far.
        failures: Log of the failed attempts.
    """

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        tools: Mapping[str, ToolKinematics],
        collision_model: CollisionModel,
        state: CellState,
        goal: MoveGoal,
        obstacle_tops: Sequence[float] = (),
    ) -> None:
        """Prepare the search.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            tools: Kinematics of robot and tool, by name of the tool.
            collision_model: Collision model with the objects at their poses.
            state: State at the start, with all known objects.
            goal: Motion of an object.
            obstacle_tops: Heights of the highest points of fixtures and occluded volumes [m].
        """
        self._cell = cell
        self._config = config
        self._goal = goal
        self._picked = picked = goal.picked
        self._tools = tools
        self._robot = load_robot(cell.robot)
        self._start = np.array(state.q)
        self._is_held = state.held is not None
        self._X_TO_goal = X_TO_place = goal.X_TO_place or picked.X_TO
        self._X_TO = _to_matrix(rigid_transform(picked.X_TO))
        self._X_TO_place = _to_matrix(rigid_transform(X_TO_place))
        self._poses_in_collision = set[tuple[str, bytes]]()
        self.num_attempts = 0
        self.failures = FailureLog()
        self._checker = SegmentChecker(
            cell,
            config,
            tools,
            collision_model,
            picked,
            X_TO_place,
            self.failures,
            starts_at_rest=not self._is_held,
            ends_at_rest=goal.releases,
        )
        self._segments = SegmentPlanner(
            cell,
            config,
            tools,
            collision_model,
            self._checker,
            picked,
            X_TO_place,
            None if self._is_held else self._start,
            goal.releases,
            goal.end,
            self.failures,
        )
        placed = replace(picked, X_TO=X_TO_place)
        self._others = [o for o in state.objects if o.name != picked.name]
        self._fixed_corners = collision_model.fixed_corners
        # Heights of the object's bottom: above its pick and place pose, or above a higher obstacle.
        self._place_bottom = placed.bounds_T[0][2]
        bottom = max(picked.bounds_T[0][2], self._place_bottom)
        all_tops = [*obstacle_tops, *(o.top_height for o in self._others)]
        if not all(cell.support.contains(*X.translation[:2]) for X in (picked.X_TO, X_TO_place)):
            all_tops.append(cell.support.wall_height)
        tops = sorted({round(top, 3) for top in all_tops if top > bottom})
        lift_height = goal.lift_height
        self._transfer_heights = [bottom + lift_height]
        self._transfer_heights += [top + lift_height for top in tops if top > bottom]

    def ik_candidates(self, grasp: Grasp) -> Iterator[GraspCandidate]:
        """Yield the combinations of yaw and inverse kinematics solutions of a grasp.

        The one with the shortest travel time is first.
        """
        tool = self._tools[grasp.tool]
        num_yaws = grasp.num_angles or self._config.num_yaws
        yaws = np.arange(num_yaws) * (2 * math.pi / num_yaws)
        if self._is_held:
            X_pick = [tool.pose(self._start)]
        else:
            X_pick = [self._gripper_pose_at_pick(grasp, yaw) for yaw in yaws]
        X_place = [self._gripper_pose_at_place(X) for X in X_pick]
        # Deflection and load are the same at all angles about the axis of the tool.
        X_GO = RigidTransform(invert_pose(X_pick[0]) @ self._X_TO)
        of_load = [
            LoadDeflection.of(self._cell.gripper, grasp.tool, self._picked.object_class, X_GO, X_TG)
            for X_TG in (X_pick[0], X_place[0])
        ]
        if self._goal.releases and is_sideways(X_place[0]):
            # It is released where the edge that hangs lowest touches what is below.
            X_place = [raise_pose(X_TG, max(of_load[1].drop, 0.0)) for X_TG in X_place]
        q_pick, q_place = self._solve_endpoints(tool, np.array(X_pick), np.array(X_place))
        legs = [q_place - q_pick]
        if not self._is_held:
            legs.insert(0, q_pick - self._start)
        if self._goal.releases and self._goal.end is not None:
            legs.append(q_place - self._goal.end)
        with np.errstate(invalid="ignore"):
            travel_time = min_travel_time(np.array(legs), self._robot).sum(axis=0)
        order = np.argsort(travel_time, axis=None, kind="stable")  # unreachable (NaN) last
        num_candidates = np.isfinite(travel_time).sum()
        num_solutions = travel_time.shape[1]
        indices = [divmod(int(k), num_solutions) for k in order[:num_candidates]]
        payload = self._payload(grasp, X_GO, X_pick[0], X_place[0])
        if payload.max_acceleration < self._config.min_payload_acceleration:
            mass = self._picked.object_class.mass
            self.failures.record(0, PlanningFailureReason.TOO_HEAVY, "tilted", mass)
            return
        displacement = max(deflection.displacement for deflection in of_load)
        for k in indices:
            X_TG_pick, X_TG_place = X_pick[k[0]], X_place[k[0]]
            yield GraspCandidate(
                tool=grasp.tool,
                payload=payload,
                X_TG_pick=X_TG_pick,
                X_TG_place=X_TG_place,
                X_OG=RigidTransform(invert_pose(self._X_TO) @ X_TG_pick),
                insertion=grasp.insertion,
                joints_open=grasp.joints_open,
                joints_held=grasp.joints_held,
                q_pick=q_pick[k],
                q_place=q_place[k],
                load_distance=self._config.carry_clearance.of_load(displacement),
            )

    def _solve_endpoints(
        self, tool: ToolKinematics, X_pick: Floats, X_place: Floats
    ) -> tuple[Floats, Floats]:
        """Return joint positions at the grasps and at the place poses; NaN where unreachable.

        Args:
            tool: Kinematics of the tool.
            X_pick: Poses of the tool at the grasp. Shape (m, 4, 4).
            X_place: Poses of the tool at the place pose. Shape (m, 4, 4).

        Returns:
            Solutions in rows of the same branch. Shapes (m, K, n).
        """
        if self._is_held and not self._goal.releases and self._goal.end is not None:
            return self._start[None, None], self._goal.end[None, None]
        q_place = tool.solve_ik(X_place)
        if self._is_held:
            q_pick = np.broadcast_to(self._start, q_place.shape)
        else:
            q_pick = tool.solve_ik(X_pick)
            q_place = self._robot.ik.match(q_pick, q_place)
        if (np.isfinite(q_pick[..., 0]) & ~np.isfinite(q_place[..., 0])).any():
            reason = PlanningFailureReason.UNREACHABLE
            self.failures.record(0, reason, "the place", part=MovePart.PLACE)
        if not self._is_held:
            q_pick = self._robot.unwrap(q_pick, self._start)
        return q_pick, self._robot.unwrap(q_place, q_pick)

    def _payload(
        self, grasp: Grasp, X_GO: RigidTransform, X_TG_pick: Floats, X_TG_place: Floats
    ) -> Payload:
        """Return the load of a grasp, which the tool must hold at the tilts of both endpoints."""
        if is_vertical(X_TG_pick) and is_vertical(X_TG_place):
            return grasp.payload
        downs = [-X_TG_pick[2, :3], -X_TG_place[2, :3]]
        halfway = downs[0] + downs[1]
        downs.append(halfway / np.linalg.norm(halfway))
        object_class = self._picked.object_class
        p_GCm = X_GO @ object_class.center_of_mass
        acceleration = min(
            self._cell.gripper.max_acceleration(grasp.tool, object_class.mass, p_GCm, down_G)
            for down_G in downs
        )
        return replace(grasp.payload, max_acceleration=acceleration)

    def _way_out(self, o: SceneObject, X_TG: Floats, candidate: GraspCandidate) -> WayOut:
        """Return the way out of a tool on a side of an object.

        Args:
            o: The object at its pose.
            X_TG: Pose of the tool. Shape (4, 4).
            candidate: Grasp.
        """
        if not is_sideways(X_TG):
            return WayOut()
        obstacles = [*self._fixed_corners, *(other.corners_T for other in self._others)]
        clearance = self._config.min_distance + candidate.load_distance
        distance = distance_from_below(o.corners_T, -X_TG[:2, 2], obstacles, clearance)
        return WayOut(clearance + RISE_CORNER, distance, candidate.insertion)

    def _gripper_pose_at_pick(self, grasp: Grasp, yaw: float) -> Floats:
        """Return X_TG at the grasp, `PlannerConfig.lip_gap` above the surface. Shape (4, 4)."""
        X_TG = turn_about_axis(_to_matrix(grasp.X_TG), yaw)
        return retreat_along_axis(X_TG, self._config.lip_gap)

    def _gripper_pose_at_place(self, X_TG: Floats) -> Floats:
        """Return X_TG at the place pose for X_TG at the grasp. Shapes (4, 4)."""
        return np.asarray(self._X_TO_place @ invert_pose(self._X_TO) @ X_TG)

    def _pick_endpoint(self, candidate: GraspCandidate) -> EndpointContext | None:
        """Return the endpoint at the pick pose, or None if the arm is in collision there.

        Where the gripper is in collision, no other solution of inverse kinematics is tried.
        """
        q = candidate.q_pick
        pose = candidate.tool, candidate.X_TG_pick.tobytes()
        if pose in self._poses_in_collision:
            return None
        self._checker.set_up_segment("approach", candidate)
        below = self._bodies_below(self._picked)
        found = self._checker.distances_at(candidate, q)
        of_gripper = self._checker.distances_below_object(candidate, found, below)
        context = EndpointContext(
            candidate.tool, candidate.X_TG_pick[:2, 3], of_gripper, candidate.load_distance
        )
        distance = self._checker.min_distance_along(
            q[None], context, 1, "at the grasp", MovePart.PICK, found
        )
        if distance is None:
            if self._checker.is_tool_in_collision:
                self._poses_in_collision.add(pose)
            return None
        self._checker.set_up_segment("carry", candidate)
        found = self._checker.distances_at(candidate, q)
        of_object = self._checker.contact_distances(candidate, found)
        return replace(context, allowed_distances=of_gripper | of_object)

    def _place_endpoint(self, candidate: GraspCandidate, q: Floats) -> EndpointContext | None:
        """Return the endpoint at the place pose, or None in collision.

        Only an object that is released may touch its neighbors.
        """
        self._checker.set_up_segment("carry", candidate)
        below = self._bodies_below(replace(self._picked, X_TO=self._X_TO_goal))
        found = self._checker.distances_at(candidate, q)
        of_gripper = self._checker.distances_below_object(candidate, found, below)
        allowed = (
            of_gripper | self._checker.contact_distances(candidate, found)
            if self._goal.releases
            else {}
        )
        context = EndpointContext(
            candidate.tool, candidate.X_TG_place[:2, 3], allowed, candidate.load_distance
        )
        distance = self._checker.min_distance_along(
            q[None], context, 2, "at the place", MovePart.PLACE, found
        )
        return None if distance is None else context

    def _bodies_below(self, placed: SceneObject) -> frozenset[str]:
        """Return the names of the floor and of the objects below the picked object at a pose."""
        bottom = placed.bounds_T[0][2] + CONTACT_TOLERANCE
        return frozenset({FLOOR, *(o.name for o in self._others if o.top_height <= bottom)})

    def has_candidate(self, grasp: Grasp) -> bool:
        """Return whether a grasp reaches both endpoints without collision."""
        return any(
            self._pick_endpoint(candidate) and self._place_endpoint(candidate, candidate.q_place)
            for candidate in self.ik_candidates(grasp)
        )

    def _load(self, candidate: GraspCandidate) -> Payload:
        """Return the load of a grasp with the center of mass at its yaw."""
        X_FG = self._cell.gripper.tools[candidate.tool].X_FG
        p_GCm = candidate.X_OG.inverse() @ self._picked.object_class.center_of_mass
        x, y, z = (X_FG @ p_GCm).tolist()
        return replace(candidate.payload, p_FCm=(x, y, z))

    def plan_candidate(self, candidate: GraspCandidate) -> FoundMove | None:
        """Return a motion with one of the `ik_candidates` at the lowest feasible height.

        Args:
            candidate: Grasp of the object.

        Returns:
            The motion, or None after recording a failure.
        """
        self.num_attempts += 1
        candidate = replace(candidate, payload=self._load(candidate))
        pick = self._pick_endpoint(candidate)
        if pick is None:
            return None
        # Without linear rows the configuration at the place pose results from the path.
        place = pick if self._goal.X_TO_place is None else None
        ends_at_q_place = self._robot.vertical_tool_rows is not None or not has_same_tilt(
            candidate.X_TG_pick, candidate.X_TG_place
        )
        if place is None and ends_at_q_place:
            place = self._place_endpoint(candidate, candidate.q_place)
            if place is None:
                return None
        gripper_height = max(
            candidate.X_TG_pick[2, 3] - self._picked.bounds_T[0][2],
            candidate.X_TG_place[2, 3] - self._place_bottom,
        )
        # In a bowl or a mug, the gripper rises above the rim before it moves sideways.
        recess = max(0.0, self._picked.top_height - candidate.X_TG_pick[2, 3])
        if candidate.is_sideways:
            recess = 0.0
        if self._goal.X_TO_place is not None:  # else it is only lifted, straight up
            gripper_height += candidate.load_distance
        for bottom in self._transfer_heights:
            self.num_attempts += 1
            height = bottom + recess + gripper_height
            carry_path = self._carry_path(candidate, height)
            if isinstance(carry_path, str):
                self.failures.record(
                    3, PlanningFailureReason.UNREACHABLE, carry_path, height, MovePart.CARRY
                )
                return None
            q_end = carry_path.reversed_lowering[0]
            if place is None or (self._goal.X_TO_place and not ends_at_q_place):
                place = self._place_endpoint(candidate, q_end)
            if place is None:
                continue
            segments = self._segments.plan_segments(candidate, carry_path, (pick, place))
            if segments is not None:
                return self._make_move(candidate, segments, place, q_end)
        return None

    def _carry_path(self, candidate: GraspCandidate, height: float) -> CarryPath | str:
        """Return the path with the object, or a description of the part that is out of reach.

        A straight line in joint space is not level: it is raised until it is high enough above what
        may stand below the object.
        """
        tool = self._tools[candidate.tool]
        ends = candidate.X_TG_pick, candidate.X_TG_place
        placed = replace(self._picked, X_TO=self._X_TO_goal)
        way_out, way_in = (
            self._way_out(o, X_TG, candidate)
            for o, X_TG in zip((self._picked, placed), ends, strict=True)
        )
        if self._is_held:
            way_out = WayOut()
        if not self._goal.releases:
            way_in = WayOut()
        if self._goal.X_TO_place is None:
            lift, approach = (
                tool.lift_path(ends[0], height, candidate.q_pick, way_out, has_load=has_load)
                for has_load in (True, False)
            )
            if lift is None or approach is None:
                return "above the grasp"
            return CarryPath(lift, lift[-1:], lift[-1:], approach, lift[-1:])
        for _ in range(_MAX_RAISES + 1):
            path = tool.carry_path(
                *ends, height, candidate.q_pick, candidate.q_place, (way_out, way_in)
            )
            if isinstance(path, str):
                break
            shortfall = -self._checker.carry_columns(candidate).slack(path.waypoints)
            if shortfall <= 0:
                break
            height += shortfall
        return path

    def _make_move(
        self,
        candidate: GraspCandidate,
        segments: Mapping[str, TrajectorySegment],
        place: EndpointContext,
        q_place: Floats,
    ) -> FoundMove:
        descent = None
        if self._goal.releases:
            descent = self._segments.plan_guarded_descent(candidate, place, q_place)
        held = HeldObject(
            self._picked.name,
            candidate.tool,
            candidate.X_OG,
            candidate.payload,
            candidate.insertion,
            candidate.joints_open,
            candidate.joints_held,
        )
        return FoundMove(held, segments, descent)
