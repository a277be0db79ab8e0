"""What a planner answers: how a move is carried out, or why it cannot be.

Frames: T the tray, G the cup, O the picked object. A move is three paths between rests: `approach` from home to the grasp,
`carry` from there to where the object is let go, `retreat` back home. Between the last two there may be a guarded descent, for
who does not know how tall things are.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
from pydrake.math import RigidTransform
from pydrake.trajectories import Trajectory

from drake_clutter.planning.collision_model import SignedDistance
from drake_clutter.scenes.scene import Pose

DESCENT_SPEED = 0.02
"""m/s, of a guarded descent; half a millimetre between two of the executor's looks for a touch."""


class PlanningFailureReason(Enum):
    """Why there is no plan."""

    NO_FREE_SPOT = "no free spot"
    NO_SEAL = "no seal"
    TOO_HEAVY = "too heavy"
    CARRIES_OTHERS = "carries others"
    UNREACHABLE = "unreachable"
    IN_COLLISION = "in collision"
    TRAJECTORY_INFEASIBLE = "trajectory infeasible"
    TIME_OUT = "time out"


@dataclass(frozen=True)
class PlanningFailure:
    """No plan, and what stands behind that.

    Attributes:
        reason: of the attempt that came furthest.
        detail: what is in the way, what lies on the object, which pose is out of reach.
        value: m of unevenness under the best grasp, kg, m of penetration, s; as the reason has it.
        planning_time: that were spent.
    """

    reason: PlanningFailureReason
    detail: str = ""
    value: float = math.nan
    planning_time: float = 0.0

    def __str__(self) -> str:
        return f"{self.reason.value}{f': {self.detail}' if self.detail else ''}"


@dataclass(frozen=True)
class TrajectorySegment:
    """A part of a plan that begins and ends at rest.

    Attributes:
        name: approach, carry or retreat.
        trajectory: q (n,) rad over time, s.
        min_distance: the least along it, densely checked, from what was not allowed to touch; the arm's own parts left out.
        unoptimized_duration: s, that the sure way takes; the duration, unless the way was optimised.
    """

    name: str
    trajectory: Trajectory
    min_distance: SignedDistance
    unoptimized_duration: float

    @property
    def duration(self) -> float:
        """s."""
        return float(self.trajectory.end_time())


@dataclass(frozen=True)
class PickPlacePlan:
    """How a move is carried out.

    Attributes:
        pick: the object's name; X_TO_pick, X_TO_place: where it is, and where it is let go.
        X_OG: The grasp.
        mass: kg, of the object; p_GCm: (3,) m, its centre of mass in the cup's frame.
        segments: in order.
        guarded_descent: q (n,) rad over time, s: straight down from the place at `DESCENT_SPEED`, until the
            object touches something; or None.
        num_attempts: grasps and branches that were looked at.
        planning_time: that planning took.
    """

    pick: str
    X_TO_pick: Pose
    X_TO_place: Pose
    X_OG: RigidTransform
    mass: float
    p_GCm: tuple[float, float, float]
    segments: tuple[TrajectorySegment, ...]
    num_attempts: int
    planning_time: float
    guarded_descent: Trajectory | None = None

    @property
    def duration(self) -> float:
        """s, of the motion, but for the descent."""
        return sum(phase.duration for phase in self.segments)

    @property
    def max_descent(self) -> float:
        """m, of the descent."""
        return (
            0.0
            if self.guarded_descent is None
            else DESCENT_SPEED * float(self.guarded_descent.end_time())
        )

    @property
    def unoptimized_duration(self) -> float:
        """s, of the motion along the sure ways."""
        return sum(phase.unoptimized_duration for phase in self.segments)

    def __deepcopy__(self, memo: object) -> "PickPlacePlan":
        """Itself: it never changes, and Drake copies abstract values again and again."""
        return self


def plan_to_dict(plan: PickPlacePlan | PlanningFailure) -> dict[str, Any]:
    """A plan as a document: its phases' ways sampled at 100 Hz (s, rad); or why there is none."""
    if isinstance(plan, PlanningFailure):
        value = (
            plan.value if math.isfinite(plan.value) else None
        )  # infinite: the lip is partly in the air
        return {
            "planned": False,
            "reason": plan.reason.value,
            "detail": plan.detail,
            "value": value,
            "planning_time": plan.planning_time,
        }
    segments = []
    for segment in plan.segments:
        times = np.linspace(0.0, segment.duration, math.ceil(100 * segment.duration) + 1)
        near = math.isfinite(segment.min_distance.distance)
        segments.append(
            {
                "name": segment.name,
                "duration": segment.duration,
                "unoptimized_duration": segment.unoptimized_duration,
                "min_distance": segment.min_distance.distance if near else None,
                "closest_pair": list(segment.min_distance.pair) if near else [],
                "time": times.tolist(),
                "q": segment.trajectory.vector_values(times).T.tolist(),
            }
        )
    pose = plan.X_TO_place
    return {
        "planned": True,
        "place": {"translation": list(pose.translation), "quaternion": list(pose.quaternion)},
        "X_OG": plan.X_OG.GetAsMatrix4().tolist(),
        "duration": plan.duration,
        "max_descent": plan.max_descent,
        "segments": segments,
        "num_attempts": plan.num_attempts,
        "planning_time": plan.planning_time,
    }
