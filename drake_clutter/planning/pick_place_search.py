"""The search for the ways of one move: grasps, yaws, branches and heights, until one is free.

Frames: T the tray, B the arm's base, F the flange, G the cup, O the picked object.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Grasp, Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.collision_model import CollisionModel, SignedDistance
from drake_clutter.planning.pick_place_plan import (
    DESCENT_SPEED,
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
    TrajectorySegment,
)
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.time_parameterization import (
    MAX_JOINT_STEP,
    bspline_path,
    min_travel_time,
    parameterize_time_optimal,
    sample_path,
    scale_to_limits,
)
from drake_clutter.planning.tool_kinematics import (
    CarryPath,
    ToolKinematics,
    downward_pose,
    invert_pose,
    raise_pose,
)
from drake_clutter.planning.trajectory_optimization import (
    LinearizedDistance,
    TrajectoryOptimizationProblem,
    optimize_trajectory,
)
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import rigid_transform

Floats = NDArray[np.float64]


MAX_REPORTED_DISTANCE = 0.03
"""m; what is further away than this counts as free."""
CONTACT_TOLERANCE = 0.0005
"""m, by which the held object may come closer to what it touches at an end of its way."""
OPTIMIZATION_MARGIN = 0.005
"""m, that an optimised way is kept further away than it must be: it is looked at in few points."""
INFLUENCE_DISTANCE = 0.06
"""m; what is further away is not looked at when a way is optimised."""
_DESCENT_STEP = 0.005
"""m, between the points of a guarded descent."""
MAX_CARRY_TILT = math.radians(0.5)
"""By which the gripper's axis may leave the vertical while it carries something [rad]."""


@dataclass(frozen=True)
class EndpointContext:
    """Where the object is picked up or let go.

    Attributes:
        p_TG_xy: (2,) m, of the cup there, seen from above.
        allowed_distances: m, how close the object, while it is held, may be there to what it touches, by name.
    """

    p_TG_xy: Floats
    allowed_distances: Mapping[str, float]


def _to_matrix(X_AB: RigidTransform) -> Floats:
    return np.ascontiguousarray(X_AB.GetAsMatrix4())


class PickPlaceSearch:
    """The search for one move: grasps, yaws, branches and heights, until a way is free."""

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        collision_model: CollisionModel,
        objects: Sequence[SceneObject],
        picked: SceneObject,
        X_TO_place: Pose,
        obstacle_tops: Sequence[float] = (),
    ) -> None:
        """Nothing is tried yet; `obstacle_tops` are heights of what else there is [m]."""
        self._cell, self._config, self._collision_model, self._picked = (
            cell,
            config,
            collision_model,
            picked,
        )
        self._tool, self._X_TO_goal = ToolKinematics(cell), X_TO_place
        self._robot = self._tool.robot
        self._X_TO = _to_matrix(rigid_transform(picked.X_TO))
        self._X_TO_place = _to_matrix(rigid_transform(X_TO_place))
        self._grasp_contacts = [(link, picked.name) for link in cell.gripper.contact_links]
        self.num_attempts, self.furthest_failure = (
            0,
            PlanningFailure(PlanningFailureReason.UNREACHABLE, "the grasp"),
        )
        self._progress = -1
        placed = replace(picked, X_TO=X_TO_place)
        others = [o for o in objects if o is not picked]
        bottom = max(picked.bounds_T[0][2], placed.bounds_T[0][2])
        obstacle_tops = sorted(
            {
                round(top, 3)
                for top in (*obstacle_tops, *(o.top_height for o in others))
                if top > bottom
            }
        )
        rise = self._config.lift_height
        self._transfer_heights = [bottom + rise] + [
            top + rise for top in obstacle_tops if top > bottom
        ]

    def record_failure(
        self,
        progress: int,
        reason: PlanningFailureReason,
        detail: str,
        value: float = math.nan,
    ) -> None:
        """Remembers why an attempt failed, if it came further than those before."""
        if progress > self._progress:
            self._progress, self.furthest_failure = progress, PlanningFailure(reason, detail, value)

    def ik_candidates(self, grasp: Grasp) -> list[tuple[Floats, Floats, float]]:
        """q (n,) at the grasp and at the place, and yaw, the quickest way first."""
        yaws = np.arange(self._config.num_yaws) * (2 * math.pi / self._config.num_yaws)
        X_pick = [raise_pose(downward_pose(yaw, grasp.p_TG), self._config.lip_gap) for yaw in yaws]
        X_place = [self._gripper_pose_at_place(X) for X in X_pick]
        q_pick, q_place = (
            self._tool.solve_ik(np.array(X_pick)),
            self._tool.solve_ik(np.array(X_place)),
        )
        q_place = self._robot.ik.match(q_pick, q_place)
        reached = np.isfinite(q_pick[..., 0])
        if (reached & ~np.isfinite(q_place[..., 0])).any():
            self.record_failure(0, PlanningFailureReason.UNREACHABLE, "the place")
        at_pick = self._robot.unwrap(q_pick, self._robot.home)
        at_place = self._robot.unwrap(q_place, at_pick)
        home = self._robot.home
        turns = np.array([at_pick - home, at_place - at_pick, at_place - home])
        with np.errstate(invalid="ignore"):
            length = min_travel_time(turns, self._robot).sum(axis=0)
        order = np.argsort(length, axis=None, kind="stable")  # what is not finite comes last
        solutions = self._robot.ik.num_solutions
        chosen = [divmod(int(k), solutions) for k in order[: np.isfinite(length).sum()]]
        return [(at_pick[k], at_place[k], float(yaws[k[0]])) for k in chosen]

    def _gripper_pose_at_place(self, X_TG: Floats) -> Floats:
        return np.asarray(self._X_TO_place @ invert_pose(self._X_TO) @ X_TG)

    def _min_distance_along(
        self, path: Floats, endpoint: EndpointContext, progress: int, stage: str
    ) -> SignedDistance | None:
        """The least clearance along a way; None, and the reason is remembered, if it is less than it must be.

        Args:
            path: (m, n) rad.
            endpoint: to which the way is near.
            progress: see `fail`.
            stage: the way is.
        """
        found, least = SignedDistance(math.inf), self._config.min_distance
        for q in path:
            for here in self._collision_model.distances_below(q, MAX_REPORTED_DISTANCE):
                allowed = self._required_distance(here, endpoint, least)
                if here.distance < allowed:
                    self.record_failure(
                        progress,
                        PlanningFailureReason.IN_COLLISION,
                        f"{stage}: {' and '.join(here.pair)}",
                        here.distance,
                    )
                    return None
                if (
                    allowed == least
                    and here.distance < found.distance
                    and here.pair[1] not in self._collision_model.arm_names
                ):
                    found = here
        return found

    def _required_distance(
        self, pair_distance: SignedDistance, endpoint: EndpointContext, min_distance: float
    ) -> float:
        """m, that two parts must be apart, at the joint angles that the scene was last asked about.

        The cup may come close to its object, and the held object to what it touches at the end of its way; but as much further
        away as they are aside of that end, at least.
        """
        if pair_distance.pair in self._grasp_contacts:
            close = self._config.lip_gap / 2
        elif (
            pair_distance.pair[0] == self._picked.name
            and pair_distance.pair[1] in endpoint.allowed_distances
        ):
            close = endpoint.allowed_distances[pair_distance.pair[1]]
        else:
            return min_distance
        return min(
            min_distance,
            close
            + float(
                np.linalg.norm(self._collision_model.gripper_position()[:2] - endpoint.p_TG_xy)
            ),
        )

    def _grasp_poses(self, grasp: Grasp, yaw: float) -> tuple[Floats, Floats, RigidTransform]:
        """X_TG at the grasp and at the place, (4, 4) each, and X_OG."""
        X_pick = raise_pose(downward_pose(yaw, grasp.p_TG), self._config.lip_gap)
        return (
            X_pick,
            self._gripper_pose_at_place(X_pick),
            RigidTransform(invert_pose(self._X_TO) @ X_pick),
        )

    def _pick_endpoint(self, X_OG: RigidTransform, q: Floats) -> EndpointContext | None:
        """The start of the object's way; None if the arm is in collision there."""
        self._set_up_segment("approach", X_OG)
        at = (self._X_TO @ _to_matrix(X_OG))[:2, 3]
        if self._min_distance_along(q[None], EndpointContext(at, {}), 1, "at the grasp") is None:
            return None
        self._set_up_segment("carry", X_OG)
        return EndpointContext(at, self._contact_distances(q))

    def _place_endpoint(self, X_OG: RigidTransform, q: Floats) -> EndpointContext | None:
        """The end of the object's way; None if the arm or the object is in collision there."""
        self._set_up_segment("carry", X_OG)
        end = EndpointContext(
            (self._X_TO_place @ _to_matrix(X_OG))[:2, 3], self._contact_distances(q)
        )
        return None if self._min_distance_along(q[None], end, 2, "at the place") is None else end

    def _contact_distances(self, q: Floats) -> dict[str, float]:
        name = self._picked.name
        near = self._collision_model.distances_below(q, self._config.min_distance)
        close = [here for here in near if here.pair[0] == name]
        return {
            here.pair[1]: here.distance - CONTACT_TOLERANCE
            for here in sorted(close, key=lambda here: -here.distance)
        }

    def has_candidate(self, grasp: Grasp) -> bool:
        """Whether some yaw and branch reach both ends without collision."""
        for q_pick, q_place, yaw in self.ik_candidates(grasp):
            X_OG = self._grasp_poses(grasp, yaw)[2]
            if self._pick_endpoint(X_OG, q_pick) and self._place_endpoint(X_OG, q_place):
                return True
        return False

    def plan_grasp(
        self, grasp: Grasp, q_pick: Floats, q_place: Floats, yaw: float
    ) -> PickPlacePlan | None:
        """A plan with this grasp, yaw and branch, at the least height that is free; None if there is none."""
        self.num_attempts += 1
        X_pick, X_place, X_OG = self._grasp_poses(grasp, yaw)
        pick, place = self._pick_endpoint(X_OG, q_pick), None
        if pick is None:
            return None
        chosen = self._robot.vertical_tool_rows is not None  # else the way decides how it arrives
        if chosen and (place := self._place_endpoint(X_OG, q_place)) is None:
            return None
        hangs = X_pick[2, 3] - self._picked.bounds_T[0][2]
        for bottom in self._transfer_heights:
            self.num_attempts += 1
            way = self._tool.carry_path(X_pick, X_place, bottom + hangs, q_pick, q_place)
            if isinstance(way, str):
                self.record_failure(3, PlanningFailureReason.UNREACHABLE, way, bottom + hangs)
                return None
            if (
                not chosen
                and (place := self._place_endpoint(X_OG, way.reversed_lowering[0])) is None
            ):
                continue
            assert place is not None
            phases = self._plan_segments(grasp, X_OG, way, (pick, place))
            if phases is not None:
                return self._make_plan(X_OG, phases, way.reversed_lowering[0])
        return None

    def _make_plan(
        self, X_OG: RigidTransform, segments: tuple[TrajectorySegment, ...], q_place: Floats
    ) -> PickPlacePlan:
        x, y, z = (float(v) for v in invert_pose(X_OG.GetAsMatrix4())[:3, 3])
        return PickPlacePlan(
            self._picked.name,
            self._picked.X_TO,
            self._X_TO_goal,
            X_OG,
            self._picked.object_class.mass,
            (x, y, z),
            segments,
            self.num_attempts,
            0.0,
            self._guarded_descent(X_OG, q_place),
        )

    def _guarded_descent(self, X_OG: RigidTransform, q_place: Floats) -> Trajectory | None:
        """Straight down from the place as far as it is asked for, and the arm is free; what it holds may touch anything."""
        X_place, way = self._X_TO_place @ _to_matrix(X_OG), [q_place]
        heights = np.arange(0.0, self._config.max_guarded_descent + 1e-9, _DESCENT_STEP)
        self._set_up_segment("retreat", X_OG)
        self._collision_model.set_object_pose(
            self._picked.name, self._X_TO_goal.translated((0.0, 0.0, -10.0))
        )
        for before, height in pairwise(heights):
            X = np.array([raise_pose(X_place, -before), raise_pose(X_place, -height)])
            step = self._tool.track(X, way[-1])
            end = EndpointContext(X_place[:2, 3], {})
            if step is None or self._min_distance_along(step[1:], end, 0, "the descent") is None:
                break
            way.append(step[1])
        if len(way) == 1:
            return None
        return PiecewisePolynomial.FirstOrderHold(
            heights[: len(way)] / DESCENT_SPEED, np.array(way).T
        )

    def _plan_segments(
        self,
        grasp: Grasp,
        X_OG: RigidTransform,
        carry_path: CarryPath,
        endpoints: tuple[EndpointContext, EndpointContext],
    ) -> tuple[TrajectorySegment, ...] | None:
        empty, up, down = Payload(), carry_path.lift, carry_path.reversed_lowering
        to_grasp, to_home = (self._tool.paths_home(column[-1]) for column in (up, down))
        ways = {
            "carry": ([carry_path.waypoints], grasp.payload),
            "approach": ([np.vstack([up, home[1:]])[::-1] for home in to_grasp], empty),
            "retreat": ([np.vstack([down, home[1:]]) for home in to_home], empty),
        }
        found = {}
        for progress, (name, (choices, payload)) in enumerate(ways.items(), start=4):
            made = (
                self._plan_segment(name, choice, payload, X_OG, endpoints, progress)
                for choice in choices
            )
            phase = next((phase for phase in made if phase), None)
            if phase is None:
                return None
            found[name] = phase
        if self._config.optimize:
            found = {
                name: self._optimize_segment(found[name], payload, X_OG, endpoints)
                for name, (_, payload) in ways.items()
            }
        return found["approach"], found["carry"], found["retreat"]

    def _plan_segment(
        self,
        name: str,
        waypoints: Floats,
        payload: Payload,
        X_OG: RigidTransform,
        endpoints: tuple[EndpointContext, EndpointContext],
        progress: int,
    ) -> TrajectorySegment | None:
        """A phase along a way; None if that is not free, or too much for the arm."""
        path = bspline_path(waypoints)
        clearance = self._check_segment(name, path, X_OG, endpoints, progress)
        if clearance is None:
            return None
        trajectory = parameterize_time_optimal(path, self._cell, payload)
        if trajectory is None:
            self.record_failure(progress, PlanningFailureReason.TRAJECTORY_INFEASIBLE, name)
            return None
        return TrajectorySegment(name, trajectory, clearance, trajectory.end_time())

    def _set_up_segment(self, segment_name: str, X_OG: RigidTransform) -> None:
        """The scene as it is during a phase."""
        name = self._picked.name
        self._collision_model.detach_object()
        self._collision_model.set_object_pose(
            name, self._X_TO_goal if segment_name == "retreat" else self._picked.X_TO
        )
        if segment_name == "carry":
            self._collision_model.attach_object(name, X_OG)

    def _check_segment(
        self,
        segment_name: str,
        path: Trajectory,
        X_OG: RigidTransform,
        endpoints: tuple[EndpointContext, EndpointContext],
        progress: int,
        spacing: float = MAX_JOINT_STEP / 2,
    ) -> SignedDistance | None:
        """The least clearance along a path, looked at every so many radians; None if it is too little."""
        self._set_up_segment(segment_name, X_OG)
        points = sample_path(path, spacing)
        if segment_name == "carry" and self._exceeds_tilt(points, progress):
            return None
        if segment_name != "carry":
            return self._min_distance_along(
                points,
                EndpointContext(endpoints[int(segment_name == "retreat")].p_TG_xy, {}),
                progress,
                segment_name,
            )
        half = len(points) // 2  # what it touched at the start it has left by then
        found = [self._min_distance_along(points[:half], endpoints[0], progress, segment_name)]
        if found[0] is not None:
            found.append(
                self._min_distance_along(points[half:], endpoints[1], progress, segment_name)
            )
        return None if None in found else min((c for c in found if c), key=lambda c: c.distance)

    def _exceeds_tilt(self, path: Floats, progress: int) -> bool:
        """Whether the gripper leaves the vertical at points (m, n); never with linear rows."""
        if self._robot.vertical_tool_rows is not None:
            return False
        tilt = float(np.linalg.norm(self._tool.axis(path)[:, :2], axis=1).max())
        if tilt > MAX_CARRY_TILT:
            self.record_failure(
                progress, PlanningFailureReason.TRAJECTORY_INFEASIBLE, "carry", tilt
            )
        return tilt > MAX_CARRY_TILT

    def _optimize_segment(
        self,
        segment: TrajectorySegment,
        payload: Payload,
        X_OG: RigidTransform,
        endpoints: tuple[EndpointContext, EndpointContext],
    ) -> TrajectorySegment:
        """The phase along a quicker way; as it is if none is found."""
        self._set_up_segment(segment.name, X_OG)
        least, carried = self._config.min_distance + OPTIMIZATION_MARGIN, segment.name == "carry"
        away = EndpointContext(endpoints[int(segment.name == "retreat")].p_TG_xy, {})

        def nearby_distances(q: Floats, along: float) -> list[LinearizedDistance]:
            found = []
            for here, gradient in self._collision_model.distances_and_gradients(
                q, INFLUENCE_DISTANCE
            ):
                needed = self._required_distance(
                    here, endpoints[int(along >= 0.5)] if carried else away, least
                )
                if (
                    np.abs(gradient).max() > 1e-6
                ):  # some of the wrist's parts are always as far apart
                    found.append(LinearizedDistance(gradient, here.distance - needed))
            return found

        upright = segment.name != "approach", segment.name != "retreat"  # at home it may go any way
        acceleration, jacobian = (
            payload.max_axis_acceleration,
            self._collision_model.gripper_jacobian,
        )
        ends_of = segment.trajectory, self._robot, upright, carried
        quick = optimize_trajectory(
            TrajectoryOptimizationProblem(
                *ends_of, acceleration, nearby_distances, jacobian, self._tool.axis
            )
        )
        trajectory = scale_to_limits(quick, self._cell, payload) if quick else None
        if trajectory is None or trajectory.end_time() >= segment.unoptimized_duration:
            return segment
        # It goes round edges as near as it may: looked at more closely than a way that rises over everything.
        clearance = self._check_segment(
            segment.name, trajectory, X_OG, endpoints, 0, MAX_JOINT_STEP / 4
        )
        if clearance is None:
            return segment
        return TrajectorySegment(segment.name, trajectory, clearance, segment.unoptimized_duration)
