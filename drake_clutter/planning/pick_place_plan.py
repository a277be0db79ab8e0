"""Results of the pick-and-place planner: a plan, or the reason why there is none.

Frames: T is the support, G is the tool that holds the picked object, O is that object.

A plan has three trajectory segments that start and end at rest: `approach` from the home
configuration to the grasp, `carry` to the place pose, and `retreat` to the home configuration. A
guarded descent may follow `carry`. It lowers an object of uncertain height until contact.
"""

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.trajectories import (
    BsplineTrajectory,
    PathParameterizedTrajectory,
    PiecewisePolynomial,
    Trajectory,
)

from drake_clutter.cell.gripper import Payload
from drake_clutter.planning.collision_model import SignedDistance
from drake_clutter.planning.motion_plan import CellState, HeldObject, PlanStep, reverse, stay_at
from drake_clutter.scenes.interfaces import MovePart, MoveResult, Outcome
from drake_clutter.scenes.scene import Pose, Scene

DESCENT_SPEED = 0.02
"""Largest speed of a guarded descent [m/s]: 0.5 mm between two contact checks of the executor."""

_DESCENT_STEP = 0.01
"""Height step at which contacts along a guarded descent are searched [m]."""


class PlanningFailureReason(Enum):
    """Reasons why the planner returns no plan."""

    NO_FREE_PLACEMENT = "no free spot"
    NO_SEAL = "no seal"
    NO_OPPOSED_FACES = "no opposed faces"
    NO_GRASP_LEFT = "no grasp left"
    TOO_HEAVY = "too heavy"
    CARRIES_OTHERS = "carries others"
    OBJECTS_OVERLAP = "objects overlap"
    PLACE_IN_COLLISION = "place in collision"
    PLACE_TILTED = "place tilted"
    PLACE_UNSUPPORTED = "place without support"
    PLACE_OFF_BALANCE = "place off balance"
    UNREACHABLE = "unreachable"
    HOME_IN_COLLISION = "home in collision"
    IN_COLLISION = "in collision"
    TRAJECTORY_INFEASIBLE = "trajectory infeasible"
    JOINT_LIMIT = "joint limit"
    GRASP_TOO_WEAK = "grasp too weak"
    TIME_OUT = "time out"


_UNITS = {
    PlanningFailureReason.NO_SEAL: (1000.0, "mm"),
    PlanningFailureReason.NO_OPPOSED_FACES: (1000.0, "mm"),
    PlanningFailureReason.NO_GRASP_LEFT: (1.0, "excluded"),
    PlanningFailureReason.TOO_HEAVY: (1.0, "kg"),
    PlanningFailureReason.OBJECTS_OVERLAP: (1000.0, "mm"),
    PlanningFailureReason.PLACE_IN_COLLISION: (1000.0, "mm"),
    PlanningFailureReason.PLACE_TILTED: (math.degrees(1.0), "deg"),
    PlanningFailureReason.PLACE_UNSUPPORTED: (1000.0, "mm"),
    PlanningFailureReason.PLACE_OFF_BALANCE: (1000.0, "mm"),
    PlanningFailureReason.IN_COLLISION: (1000.0, "mm"),
    PlanningFailureReason.JOINT_LIMIT: (1.0, "rad"),
    PlanningFailureReason.GRASP_TOO_WEAK: (1.0, "m/s^2"),
    PlanningFailureReason.TIME_OUT: (1.0, "s"),
}
"""Factor and unit with which the value of a failure is shown; other values have several units."""

_FAILED_PARTS = {
    PlanningFailureReason.NO_FREE_PLACEMENT: MovePart.PLACE,
    PlanningFailureReason.NO_SEAL: MovePart.PICK,
    PlanningFailureReason.NO_OPPOSED_FACES: MovePart.PICK,
    PlanningFailureReason.NO_GRASP_LEFT: MovePart.PICK,
    PlanningFailureReason.TOO_HEAVY: MovePart.PICK,
    PlanningFailureReason.GRASP_TOO_WEAK: MovePart.PICK,
    PlanningFailureReason.CARRIES_OTHERS: MovePart.PICK,
    PlanningFailureReason.PLACE_IN_COLLISION: MovePart.PLACE,
    PlanningFailureReason.PLACE_TILTED: MovePart.PLACE,
    PlanningFailureReason.PLACE_UNSUPPORTED: MovePart.PLACE,
    PlanningFailureReason.PLACE_OFF_BALANCE: MovePart.PLACE,
    PlanningFailureReason.TIME_OUT: MovePart.CARRY,
}
"""Failed part of a move by the reason. Other reasons apply to several parts, or to the cell."""


@dataclass(frozen=True)
class PlanningFailure:
    """The reason why there is no plan.

    Attributes:
        reason: Failure of the attempt that came closest to a plan.
        detail: Names of the colliding geometries, of the objects on top, or of the pose that is
            out of reach.
        value: Quantity that the reason refers to: flatness deviation of the surface under the best
            grasp [m], mass [kg], signed distance [m], tilt [rad] or time [s]; number of excluded
            grasps if none is left; depth of the deepest overlap [m]; of a place pose the depth of
            penetration [m], the tilt [rad], the gap to what is below [m] or the distance of the
            center of mass from the contact area [m]; of a configuration the excess of a joint
            [rad]; of a weak grasp the acceleration that it bears [m/s^2]. NaN if there is none.
        planning_time: Wall time spent [s].
        attempted_part: Part of the move at which that attempt failed; None if the reason says it.
    """

    reason: PlanningFailureReason
    detail: str = ""
    value: float = math.nan
    planning_time: float = 0.0
    attempted_part: MovePart | None = None

    def __str__(self) -> str:
        return f"{self.reason.value}{f': {self.detail}' if self.detail else ''}"

    @property
    def description(self) -> str:
        """Reason and detail, with the quantity if there is one."""
        return f"{self} ({self.quantity})" if self.quantity else str(self)

    @property
    def quantity(self) -> str:
        """The value with its unit; empty without one, or if it is infinite."""
        if not math.isfinite(self.value) or self.reason not in _UNITS:
            return ""
        scale, unit = _UNITS[self.reason]
        return f"{scale * self.value:.3g} {unit}"

    @property
    def failed_part(self) -> MovePart | None:
        """Part of the move that is not possible; None if the cell allows no move, or a transfer."""
        return self.attempted_part or _FAILED_PARTS.get(self.reason)

    def outcome(self, scene: Scene) -> Outcome:
        """Return the outcome of the move.

        Args:
            scene: The scene, which stays as it is.
        """
        is_full = self.reason is PlanningFailureReason.NO_FREE_PLACEMENT
        return Outcome(
            MoveResult.NO_FREE_PLACEMENT if is_full else MoveResult.NOT_PLANNED,
            scene,
            detail="" if is_full else self.description,
            failure_reason=self.reason.value,
            failed_part=self.failed_part,
        )


class FailureLog:
    """Log of failed attempts; keeps the failure of the latest planning stage.

    Attributes:
        furthest: Failure of the attempt that came closest to a plan.
    """

    def __init__(self) -> None:
        """Create a log without attempts, in which no grasp is reachable."""
        reason = PlanningFailureReason.UNREACHABLE
        self.furthest = PlanningFailure(reason, "the grasp", attempted_part=MovePart.PICK)
        self._progress = -1

    def record(
        self,
        progress: int,
        reason: PlanningFailureReason,
        detail: str,
        value: float = math.nan,
        part: MovePart | None = None,
    ) -> None:
        """Record a failure as the furthest one if no earlier attempt came as far.

        Args:
            progress: Stage of planning that failed; later stages are larger.
            reason: Reason of the failure.
            detail: See `PlanningFailure`.
            value: See `PlanningFailure`.
            part: Part of the move that failed; None if the reason says it.
        """
        if progress > self._progress:
            self._progress = progress
            self.furthest = PlanningFailure(reason, detail, value, attempted_part=part)


@dataclass(frozen=True)
class TrajectorySegment:
    """A part of a plan that starts and ends at rest.

    Attributes:
        name: `approach`, `carry` or `retreat`.
        trajectory: Joint positions over time, a cubic B-spline. Shape (n,).
        min_distance: Smallest signed distance along the trajectory, without self-collision pairs
            and pairs that are allowed to touch.
        unoptimized_duration: Duration before trajectory optimization [s].
    """

    name: str
    trajectory: BsplineTrajectory
    min_distance: SignedDistance
    unoptimized_duration: float

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.trajectory.end_time())


@dataclass(frozen=True)
class GuardedDescent:
    """Vertical descent of the gripper from the place pose, from rest to rest.

    Attributes:
        trajectory: Joint positions over time. Shape (n,).
        depth: Lowered distance over time [m]. Shape (1,).
    """

    trajectory: Trajectory
    depth: Trajectory

    @property
    def duration(self) -> float:
        """Duration if no contact occurs [s]."""
        return float(self.trajectory.end_time())

    def depth_at(self, time: float) -> float:
        """Return the lowered distance at a time [s], which is limited to the descent [m]."""
        return float(self.depth.value(min(time, self.duration))[0, 0])


@dataclass(frozen=True)
class PickPlacePlan:
    """Trajectories that pick an object and place it at another pose.

    Attributes:
        pick: Name of the object.
        X_TO_pick: Pose of the object before the move.
        X_TO_place: Pose at which the object is released, without guarded descent.
        held: The object while a tool holds it.
        start: State at the start.
        end: State at the end, without guarded descent.
        segments: `approach`, `carry` and `retreat`.
        num_attempts: Number of combinations of grasp, inverse kinematics solution and transfer
            height that were tried.
        planning_time: Wall time spent [s].
        guarded_descent: Descent from the place pose at `DESCENT_SPEED`, which the executor stops at
            contact. None without guarded descent.
    """

    pick: str
    X_TO_pick: Pose
    X_TO_place: Pose
    held: HeldObject
    start: CellState = field(repr=False)
    end: CellState = field(repr=False)
    segments: tuple[TrajectorySegment, ...]
    num_attempts: int
    planning_time: float
    guarded_descent: GuardedDescent | None = None

    @property
    def tool(self) -> str:
        """Name of the tool that holds the object."""
        return self.held.tool

    @property
    def X_OG(self) -> RigidTransform:
        """Grasp: pose of the tool in the object."""
        return self.held.X_OG

    @property
    def payload(self) -> Payload:
        """Load while the object is held."""
        return self.held.payload

    @property
    def joints_open(self) -> tuple[float, ...]:
        """Positions of the gripper's joints without the object, see `Grasp` [m]."""
        return self.held.joints_open

    @property
    def joints_held(self) -> tuple[float, ...]:
        """Positions of the gripper's joints with the object, see `Grasp` [m]."""
        return self.held.joints_held

    @property
    def steps(self) -> tuple[PlanStep, ...]:
        """Steps with dwells at grasp and release, and the whole guarded descent."""
        return self.steps_until(math.inf)

    def steps_until(self, contact_time: float) -> tuple[PlanStep, ...]:
        """Return the steps of a plan whose guarded descent ends at contact.

        Args:
            contact_time: Time since the start of the guarded descent at which it ends [s]. The arm
                then releases the object and rises by the same distance.
        """
        approach, carry, retreat = (segment.trajectory for segment in self.segments)
        descent = self.guarded_descent.trajectory if self.guarded_descent else None
        return (
            PlanStep("approach", approach, joints=self.joints_open),
            *grasp_and_carry(self.held, carry, "carry", self.X_TO_pick),
            *release_steps(
                self.held, self.X_TO_place, carry, descent, self.max_descent, contact_time
            ),
            PlanStep("retreat", retreat, joints=self.joints_open),
        )

    @property
    def duration(self) -> float:
        """Duration without dwell times and guarded descent [s]."""
        return sum(segment.duration for segment in self.segments)

    @property
    def max_descent(self) -> float:
        """Distance of the guarded descent if no contact occurs [m]."""
        if self.guarded_descent is None:
            return 0.0
        return self.guarded_descent.depth_at(self.guarded_descent.duration)

    @property
    def unoptimized_duration(self) -> float:
        """Duration before trajectory optimization [s]."""
        return sum(segment.unoptimized_duration for segment in self.segments)

    def __deepcopy__(self, memo: object) -> "PickPlacePlan":
        """Return the plan itself: it is immutable, and Drake copies abstract values often."""
        return self


def grasp_and_carry(
    held: HeldObject, trajectory: Trajectory, name: str, X_TO_pick: Pose
) -> tuple[PlanStep, ...]:
    """Return the dwell in which an object is grasped, and the motion that follows.

    Args:
        held: The object.
        trajectory: Motion with the object.
        name: Name of that motion.
        X_TO_pick: Pose of the object at the grasp.
    """
    closed = held.joints_closed
    q = trajectory.value(0.0).ravel()
    return (
        PlanStep("grasp", stay_at(q), Payload(), held.tool, closed, held.name, (X_TO_pick,)),
        PlanStep(name, trajectory, held.payload, held.tool, closed),
    )


def release_steps(
    held: HeldObject,
    X_TO_place: Pose,
    carry: Trajectory,
    descent: Trajectory | None = None,
    max_descent: float = 0.0,
    contact_time: float = math.inf,
) -> tuple[PlanStep, ...]:
    """Return the dwell in which an object is released, with the guarded descent around it.

    Args:
        held: The object.
        X_TO_place: Pose of the object before the descent.
        carry: Motion that ends at that pose.
        descent: Guarded descent; None without one.
        max_descent: Distance of the descent [m].
        contact_time: See `PickPlacePlan.steps_until`.
    """
    q = carry.value(carry.end_time()).ravel()
    closed = held.joints_closed
    num_heights = math.ceil(max_descent / _DESCENT_STEP) + 1
    touched = tuple(
        X_TO_place.translated((0.0, 0.0, -height))
        for height in np.linspace(0.0, max_descent, num_heights).tolist()
    )
    if descent is None:
        dwell = stay_at(q)
        return (PlanStep("release", dwell, held.payload, "", held.joints_open, held.name, touched),)
    lowered = _truncate(descent, contact_time)
    dwell = stay_at(lowered.value(lowered.end_time()).ravel())
    return (
        PlanStep("steady", stay_at(q), held.payload, held.tool, closed),
        PlanStep("descend", lowered, held.payload, held.tool, closed, held.name, touched),
        PlanStep("release", dwell, held.payload, "", held.joints_open, held.name, touched),
        PlanStep("rise", reverse(lowered), Payload(), "", held.joints_open),
    )


def _truncate(trajectory: Trajectory, time: float) -> Trajectory:
    """Return a trajectory up to a time [s]."""
    end = min(time, trajectory.end_time())
    scaling = PiecewisePolynomial.FirstOrderHold([0.0, end], [[0.0, end]])
    return PathParameterizedTrajectory(trajectory, scaling)


def plan_to_dict(plan: PickPlacePlan | PlanningFailure) -> dict[str, Any]:
    """Return a planning result as a JSON document.

    Returns:
        The reason of a failure, or the plan with its segments sampled at 100 Hz [s, rad].
    """
    if isinstance(plan, PlanningFailure):
        # The flatness deviation is infinite where a part of the lip has no surface below.
        value = plan.value if math.isfinite(plan.value) else None
        return {
            "planned": False,
            "reason": plan.reason.value,
            "detail": plan.detail,
            "value": value,
            "quantity": plan.quantity,
            "planning_time": plan.planning_time,
        }
    pose = plan.X_TO_place
    return {
        "planned": True,
        "place": {"translation": list(pose.translation), "quaternion": list(pose.quaternion)},
        "tool": plan.tool,
        "X_OG": plan.X_OG.GetAsMatrix4().tolist(),
        "duration": plan.duration,
        "max_descent": plan.max_descent,
        "segments": [_segment_to_dict(segment) for segment in plan.segments],
        "num_attempts": plan.num_attempts,
        "planning_time": plan.planning_time,
    }


def _segment_to_dict(segment: TrajectorySegment) -> dict[str, Any]:
    times = np.linspace(0.0, segment.duration, math.ceil(100 * segment.duration) + 1)
    has_pair = math.isfinite(segment.min_distance.distance)
    return {
        "name": segment.name,
        "duration": segment.duration,
        "unoptimized_duration": segment.unoptimized_duration,
        "min_distance": segment.min_distance.distance if has_pair else None,
        "closest_pair": list(segment.min_distance.pair) if has_pair else [],
        "time": times.tolist(),
        "q": segment.trajectory.vector_values(times).T.tolist(),
    }
