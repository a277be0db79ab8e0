"""Search for a plan over grasps, yaw angles, IK solutions and transfer heights.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from drake_clutter.cell.gripper import Grasp, Payload
from drake_clutter.cell.support_sdf import FLOOR
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel
from drake_clutter.planning.pick_place_plan import (
    FailureLog,
    PickPlacePlan,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.segment_planner import (
    CONTACT_TOLERANCE,
    EndpointContext,
    GraspCandidate,
    SegmentPlanner,
)
from drake_clutter.planning.time_parameterization import min_travel_time
from drake_clutter.planning.tool_kinematics import (
    ToolKinematics,
    invert_pose,
    is_vertical,
    retreat_along_axis,
    turn_about_axis,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]


def _to_matrix(X_AB: RigidTransform) -> Floats:
    return np.ascontiguousarray(X_AB.GetAsMatrix4())


class PickPlaceSearch:
    """Search for a plan of one move.

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
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        obstacle_tops: Sequence[float] = (),
    ) -> None:
        """Prepare the search.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            tools: Kinematics of robot and tool, by name of the tool.
            collision_model: Collision model with the objects at their poses.
            objects: All known objects, including the picked one.
            picked: Object to pick.
            X_TO_place: Pose at which the object is released.
            obstacle_tops: Heights of the highest points of fixtures and occluded volumes [m].
        """
        self._cell = cell
        self._config = config
        self._picked = picked
        self._tools = tools
        self._robot = load_robot(cell.robot)
        self._X_TO_goal = X_TO_place
        self._X_TO = _to_matrix(rigid_transform(picked.X_TO))
        self._X_TO_place = _to_matrix(rigid_transform(X_TO_place))
        self.num_attempts = 0
        self.failures = FailureLog()
        self._segments = SegmentPlanner(
            cell, config, tools, collision_model, picked, X_TO_place, self.failures
        )
        placed = replace(picked, X_TO=X_TO_place)
        self._others = [o for o in objects if o is not picked]
        # Heights of the object's bottom: above its pick and place pose, or above a higher obstacle.
        self._place_bottom = placed.bounds_T[0][2]
        bottom = max(picked.bounds_T[0][2], self._place_bottom)
        all_tops = (*obstacle_tops, *(o.top_height for o in self._others))
        tops = sorted({round(top, 3) for top in all_tops if top > bottom})
        lift_height = self._config.lift_height
        self._transfer_heights = [bottom + lift_height]
        self._transfer_heights += [top + lift_height for top in tops if top > bottom]

    def ik_candidates(self, grasp: Grasp) -> list[GraspCandidate]:
        """Return the combinations of yaw and inverse kinematics solutions of a grasp.

        Returns:
            Candidates; the one with the shortest travel time first.
        """
        home = self._robot.home
        tool = self._tools[grasp.tool]
        num_yaws = grasp.num_angles or self._config.num_yaws
        yaws = np.arange(num_yaws) * (2 * math.pi / num_yaws)
        X_pick = [self._gripper_pose_at_pick(grasp, yaw) for yaw in yaws]
        X_place = [self._gripper_pose_at_place(X) for X in X_pick]
        q_pick = tool.solve_ik(np.array(X_pick))
        q_place = tool.solve_ik(np.array(X_place))
        q_place = self._robot.ik.match(q_pick, q_place)
        is_pick_reachable = np.isfinite(q_pick[..., 0])
        if (is_pick_reachable & ~np.isfinite(q_place[..., 0])).any():
            self.failures.record(0, PlanningFailureReason.UNREACHABLE, "the place")
        q_pick = self._robot.unwrap(q_pick, home)
        q_place = self._robot.unwrap(q_place, q_pick)
        displacements = np.array([q_pick - home, q_place - q_pick, q_place - home])
        with np.errstate(invalid="ignore"):
            travel_time = min_travel_time(displacements, self._robot).sum(axis=0)
        order = np.argsort(travel_time, axis=None, kind="stable")  # unreachable (NaN) last
        num_candidates = np.isfinite(travel_time).sum()
        num_solutions = self._robot.ik.num_solutions
        indices = [divmod(int(k), num_solutions) for k in order[:num_candidates]]
        candidates = list[GraspCandidate]()
        for k in indices:
            X_TG_pick, X_TG_place = X_pick[k[0]], X_place[k[0]]
            X_OG = RigidTransform(invert_pose(self._X_TO) @ X_TG_pick)
            payload = self._payload(grasp, X_OG, X_TG_pick, X_TG_place)
            if payload.max_acceleration < self._config.min_payload_acceleration:
                mass = self._picked.object_class.mass
                self.failures.record(0, PlanningFailureReason.TOO_HEAVY, "tilted", mass)
                continue
            candidates.append(
                GraspCandidate(
                    tool=grasp.tool,
                    payload=payload,
                    X_TG_pick=X_TG_pick,
                    X_TG_place=X_TG_place,
                    X_OG=X_OG,
                    insertion=grasp.insertion,
                    joints_open=grasp.joints_open,
                    joints_held=grasp.joints_held,
                    q_pick=q_pick[k],
                    q_place=q_place[k],
                )
            )
        return candidates

    def _payload(
        self, grasp: Grasp, X_OG: RigidTransform, X_TG_pick: Floats, X_TG_place: Floats
    ) -> Payload:
        """Return the load of a grasp, which the tool must hold at the tilts of both endpoints."""
        if is_vertical(X_TG_pick) and is_vertical(X_TG_place):
            return grasp.payload
        downs = [-X_TG_pick[2, :3], -X_TG_place[2, :3]]
        halfway = downs[0] + downs[1]
        downs.append(halfway / np.linalg.norm(halfway))
        object_class = self._picked.object_class
        p_GCm = X_OG.inverse() @ object_class.center_of_mass
        acceleration = min(
            self._cell.gripper.max_acceleration(grasp.tool, object_class.mass, p_GCm, down_G)
            for down_G in downs
        )
        return replace(grasp.payload, max_acceleration=acceleration)

    def _gripper_pose_at_pick(self, grasp: Grasp, yaw: float) -> Floats:
        """Return X_TG at the grasp, `PlannerConfig.lip_gap` above the surface. Shape (4, 4)."""
        X_TG = turn_about_axis(_to_matrix(grasp.X_TG), yaw)
        return retreat_along_axis(X_TG, self._config.lip_gap)

    def _gripper_pose_at_place(self, X_TG: Floats) -> Floats:
        """Return X_TG at the place pose for X_TG at the grasp. Shapes (4, 4)."""
        return np.asarray(self._X_TO_place @ invert_pose(self._X_TO) @ X_TG)

    def _pick_endpoint(self, candidate: GraspCandidate) -> EndpointContext | None:
        """Return the endpoint at the pick pose, or None if the arm is in collision there."""
        q = candidate.q_pick
        self._segments.set_up_segment("approach", candidate)
        below = self._bodies_below(self._picked)
        of_gripper = self._segments.distances_below_object(candidate, q, below)
        context = EndpointContext(candidate.tool, candidate.X_TG_pick[:2, 3], of_gripper)
        if self._segments.min_distance_along(q[None], context, 1, "at the grasp") is None:
            return None
        self._segments.set_up_segment("carry", candidate)
        of_object = self._segments.contact_distances(q)
        return replace(context, allowed_distances=of_gripper | of_object)

    def _place_endpoint(self, candidate: GraspCandidate, q: Floats) -> EndpointContext | None:
        """Return the endpoint at the place pose, or None in collision."""
        self._segments.set_up_segment("carry", candidate)
        below = self._bodies_below(replace(self._picked, X_TO=self._X_TO_goal))
        of_gripper = self._segments.distances_below_object(candidate, q, below)
        allowed = of_gripper | self._segments.contact_distances(q)
        context = EndpointContext(candidate.tool, candidate.X_TG_place[:2, 3], allowed)
        distance = self._segments.min_distance_along(q[None], context, 2, "at the place")
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

    def plan_candidate(self, candidate: GraspCandidate) -> PickPlacePlan | None:
        """Return a plan with one of the `ik_candidates` at the lowest feasible height.

        Args:
            candidate: Grasp of the object.

        Returns:
            The plan, or None after recording a failure.
        """
        self.num_attempts += 1
        candidate = replace(candidate, payload=self._load(candidate))
        pick = self._pick_endpoint(candidate)
        if pick is None:
            return None
        # Without linear rows the configuration at the place pose results from the path.
        place = None
        ends_at_q_place = self._robot.vertical_tool_rows is not None or candidate.is_tilted
        if ends_at_q_place:
            place = self._place_endpoint(candidate, candidate.q_place)
            if place is None:
                return None
        gripper_height = max(
            candidate.X_TG_pick[2, 3] - self._picked.bounds_T[0][2],
            candidate.X_TG_place[2, 3] - self._place_bottom,
        )
        # In a bowl or a mug, the gripper rises above the rim before it moves sideways.
        recess = max(0.0, self._picked.top_height - candidate.X_TG_pick[2, 3])
        for bottom in self._transfer_heights:
            self.num_attempts += 1
            height = bottom + recess + gripper_height
            carry_path = self._tools[candidate.tool].carry_path(
                candidate.X_TG_pick,
                candidate.X_TG_place,
                height,
                candidate.q_pick,
                candidate.q_place,
            )
            if isinstance(carry_path, str):
                self.failures.record(3, PlanningFailureReason.UNREACHABLE, carry_path, height)
                return None
            q_end = carry_path.reversed_lowering[0]
            if not ends_at_q_place and (place := self._place_endpoint(candidate, q_end)) is None:
                continue
            assert place is not None
            segments = self._segments.plan_segments(candidate, carry_path, (pick, place))
            if segments is not None:
                return self._make_plan(candidate, segments, place, q_end)
        return None

    def _make_plan(
        self,
        candidate: GraspCandidate,
        segments: tuple[TrajectorySegment, ...],
        place: EndpointContext,
        q_place: Floats,
    ) -> PickPlacePlan:
        return PickPlacePlan(
            pick=self._picked.name,
            X_TO_pick=self._picked.X_TO,
            X_TO_place=self._X_TO_goal,
            tool=candidate.tool,
            X_OG=candidate.X_OG,
            joints_open=candidate.joints_open,
            joints_held=candidate.joints_held,
            payload=candidate.payload,
            segments=segments,
            num_attempts=self.num_attempts,
            planning_time=0.0,
            guarded_descent=self._segments.plan_guarded_descent(candidate, place, q_place),
        )
