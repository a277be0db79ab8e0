"""Checks of the paths of a move: distances to obstacles, columns below the object, tilt.

Frames: T is the support, G is a tool of the gripper, O is the picked object.
"""

import math
from collections.abc import Mapping, Set

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.carry_columns import CarryColumns
from drake_clutter.planning.collision_model import CollisionModel, SignedDistance
from drake_clutter.planning.cubic_spline import CubicSpline
from drake_clutter.planning.grasp_candidate import EndpointContext, GraspCandidate
from drake_clutter.planning.pick_place_plan import FailureLog, PlanningFailureReason
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.shape_table import FoundDistances
from drake_clutter.planning.time_parameterization import MAX_JOINT_STEP, sample_path
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import MovePart
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
PART_OF_SEGMENT = {
    "approach": MovePart.PICK,
    "carry": MovePart.CARRY,
    "retreat": MovePart.PLACE,
}
"""Part of a move that a segment belongs to."""
_MAX_LIFT_OFFSET = 0.005
"""Up to this horizontal distance of the tool from an endpoint, a carry belongs to the endpoint [m]:
wherever else the object goes, it is first lifted and at last lowered vertically."""


class SegmentChecker:
    """Checks paths of the trajectory segments of one move, and records why they fail.

    Attributes:
        is_tool_in_collision: Whether gripper or attached object were too close to obstacles in the
            last failed check of distances; then they are in any configuration with that pose of the
            tool.
    """

    def __init__(
        self,
        cell: WorkCell,
        config: PlannerConfig,
        tools: Mapping[str, ToolKinematics],
        collision_model: CollisionModel,
        picked: SceneObject,
        X_TO_place: Pose,
        failures: FailureLog,
        *,
        starts_at_rest: bool,
        ends_at_rest: bool,
    ) -> None:
        """Prepare the checks.

        Args:
            cell: Work cell.
            config: Parameters of the planner.
            tools: Kinematics of robot and tool, by name of the tool.
            collision_model: Collision model with the objects at their poses.
            picked: Object to pick.
            X_TO_place: Pose at which the object is released.
            failures: Log in which failures are recorded.
            starts_at_rest: Whether a carry starts where the object stands.
            ends_at_rest: Whether it ends where the object is released.
        """
        self._cell = cell
        self._config = config
        self._tools = tools
        self._collision_model = collision_model
        self._picked = picked
        self._X_TO_place = X_TO_place
        self._failures = failures
        self._starts_at_rest = starts_at_rest
        self._ends_at_rest = ends_at_rest
        self._robot = load_robot(cell.robot)
        self.is_tool_in_collision = False
        self._moving_names = {*collision_model.arm_names, picked.name} - {*self._robot.link_depths}
        self._columns: dict[GraspCandidate, CarryColumns] = {}
        self._grasp_contacts = {
            name: [(link, picked.name) for link in tool.contact_links]
            for name, tool in cell.gripper.tools.items()
        }

    def distances_at(self, candidate: GraspCandidate, q: Floats) -> FoundDistances:
        """Return the distances at an endpoint, for `distances_below_object` and others.

        Args:
            candidate: Grasp.
            q: Joint positions. Shape (n,).
        """
        reach = max(MAX_REPORTED_DISTANCE, self._contact_reach(candidate))
        return self._collision_model.distances_along(q[None], reach)

    def _contact_reach(self, candidate: GraspCandidate) -> float:
        """Return the distance up to which neighbors of the attached object matter [m]."""
        return self._config.min_distance + candidate.load_distance + OPTIMIZATION_MARGIN

    def min_distance_along(
        self,
        path: Floats,
        endpoint: EndpointContext,
        progress: int,
        stage: str,
        part: MovePart,
        found: FoundDistances | None = None,
    ) -> SignedDistance | None:
        """Return the smallest distance along a path to obstacles that it may not touch.

        Args:
            path: Configurations. Shape (m, n).
            endpoint: Endpoint near which smaller distances are allowed.
            progress: Stage of planning, see `FailureLog.record`.
            stage: Name of the stage for the failure.
            part: Part of the move at the endpoint.
            found: Distances along the path, if they are known.

        Returns:
            The distance, infinite if nothing is near, or None after recording a failure if a
            distance is too small.
        """
        model, min_distance = self._collision_model, self._config.min_distance
        if found is None:
            found = model.distances_along(path, MAX_REPORTED_DISTANCE, until_collision=True)
        else:
            found = found.select(found.distances <= MAX_REPORTED_DISTANCE)
        if not len(found.rows):
            return SignedDistance(math.inf)
        required = self.required_distances(found, path, endpoint, min_distance)
        if too_close := np.flatnonzero(found.distances < required).tolist():
            pairs = [model.signed_distance(found, k) for k in too_close]
            self.is_tool_in_collision = any(
                first in self._moving_names and second not in model.arm_names
                for first, second in (found_pair.pair for found_pair in pairs)
            )
            nearest = pairs[0]
            offset = self._offsets(endpoint, path)[found.rows[too_close[0]]]
            if stage == "carry" and offset > _MAX_LIFT_OFFSET:
                part = MovePart.CARRY
            self._failures.record(
                progress,
                PlanningFailureReason.IN_COLLISION,
                f"{stage}: {' and '.join(nearest.pair)}",
                nearest.distance,
                part,
            )
            return None
        counts = (required >= min_distance) & ~model.is_to_arm(found)
        if not counts.any():
            return SignedDistance(math.inf)
        return model.signed_distance(found, int(np.where(counts, found.distances, np.inf).argmin()))

    def required_distances(
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
        offsets = self._offsets(endpoint, path)
        contacts = dict.fromkeys(self._grasp_contacts[endpoint.tool], self._config.lip_gap / 2)
        required = np.full(len(found.rows), min_distance)
        required[self._collision_model.is_of_attached(found)] += endpoint.load_distance
        for pair, allowed in {**endpoint.allowed_distances, **contacts}.items():
            of_pair = self._collision_model.is_between(found, pair)
            required[of_pair] = np.minimum(
                required[of_pair], allowed + offsets[found.rows[of_pair]]
            )
        return required

    def _offsets(self, endpoint: EndpointContext, path: Floats) -> Floats:
        """Return the horizontal distances of the tool from an endpoint [m]. Shape (m,).

        Args:
            endpoint: The endpoint.
            path: Configurations. Shape (m, n).
        """
        p_TG = self._collision_model.tool_positions(endpoint.tool, path)
        return np.asarray(np.hypot(*(p_TG[:, :2] - endpoint.p_TG_xy).T))

    def distances_below_object(
        self, candidate: GraspCandidate, found: FoundDistances, below: Set[str]
    ) -> dict[tuple[str, str], float]:
        """Return the allowed distances between gripper and bodies below a thin object [m].

        The gripper comes as close to them as the object is thin.

        Args:
            candidate: Grasp.
            found: Distances where the tool holds the object, see `distances_at`.
            below: Names of the bodies below the object.
        """
        links = self._cell.gripper.tools[candidate.tool].contact_links
        distances = self._signed_distances(found, self._config.min_distance)
        # A body may have several geometries: the smallest distance is the last and is kept.
        return {
            distance.pair: max(distance.distance - CONTACT_TOLERANCE, self._config.lip_gap / 2)
            for distance in sorted(distances, key=lambda distance: -distance.distance)
            if distance.pair[0] in links and distance.pair[1] in below
        }

    def _signed_distances(self, found: FoundDistances, max_distance: float) -> list[SignedDistance]:
        """Return those distances that are not above a threshold [m]."""
        near = np.flatnonzero(found.distances <= max_distance).tolist()
        return [self._collision_model.signed_distance(found, k) for k in near]

    def contact_distances(
        self, candidate: GraspCandidate, found: FoundDistances
    ) -> dict[tuple[str, str], float]:
        """Return the allowed distances to neighbors of the attached object, by names [m].

        They also bound what trajectory optimization keeps: it cannot increase the distances of
        neighbors of a vertical line.

        Args:
            candidate: Grasp.
            found: Distances at an endpoint, see `distances_at`.
        """
        name = self._picked.name
        distances = self._signed_distances(found, self._contact_reach(candidate))
        of_object = [distance for distance in distances if distance.pair[0] == name]
        # A neighbor may have several geometries: the smallest distance is the last and is kept.
        return {
            distance.pair: distance.distance - CONTACT_TOLERANCE
            for distance in sorted(of_object, key=lambda distance: -distance.distance)
        }

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

    def check_segment(
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
            context = arm_context(segment_name, endpoints)
            part = PART_OF_SEGMENT[segment_name]
            return self.min_distance_along(points, context, progress, segment_name, part)
        slack = self.carry_columns(candidate).slack(points)
        if slack < 0:
            detail = f"carry: {self._picked.name} and what may be below it"
            self._failures.record(
                progress, PlanningFailureReason.IN_COLLISION, detail, slack, MovePart.CARRY
            )
            return None
        half = len(points) // 2
        from_pick = self.min_distance_along(
            points[:half], endpoints[0], progress, segment_name, MovePart.PICK
        )
        if from_pick is None:
            return None
        to_place = self.min_distance_along(
            points[half:], endpoints[1], progress, segment_name, MovePart.PLACE
        )
        if to_place is None:
            return None
        return min((from_pick, to_place), key=lambda distance: distance.distance)

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
                progress, PlanningFailureReason.TRAJECTORY_INFEASIBLE, "carry", tilt, MovePart.CARRY
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
                    starts_at_rest=self._starts_at_rest,
                    ends_at_rest=self._ends_at_rest,
                )
            }
        return self._columns[candidate]


def arm_context(
    segment_name: str, endpoints: tuple[EndpointContext, EndpointContext]
) -> EndpointContext:
    """Return the endpoint of a segment on which no object is attached."""
    return endpoints[1] if segment_name == "retreat" else endpoints[0]
