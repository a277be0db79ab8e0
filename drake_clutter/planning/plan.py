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

from drake_clutter.planning.clearance import Clearance
from drake_clutter.scenes.scene import Pose

DESCENT_SPEED = 0.02
"""m/s, of a guarded descent; half a millimetre between two of the executor's looks for a touch."""


class PlanFailure(Enum):
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
class NoPlan:
    """No plan, and what stands behind that.

    Attributes:
        reason: of the attempt that came furthest.
        about: what is in the way, what lies on the object, which pose is out of reach.
        number: m of unevenness under the best grasp, kg, m of penetration, s; as the reason has it.
        seconds: that were spent.
    """

    reason: PlanFailure
    about: str = ""
    number: float = math.nan
    seconds: float = 0.0

    def __str__(self) -> str:
        return f"{self.reason.value}{f': {self.about}' if self.about else ''}"


@dataclass(frozen=True)
class Phase:
    """A part of a plan that begins and ends at rest.

    Attributes:
        name: approach, carry or retreat.
        trajectory: q (n,) rad over time, s.
        clearance: the least along it, densely checked, from what was not allowed to touch; the arm's own parts left out.
        sure: s, that the sure way takes; the duration, unless the way was optimised.
    """

    name: str
    trajectory: Trajectory
    clearance: Clearance
    sure: float

    @property
    def duration(self) -> float:
        """s."""
        return float(self.trajectory.end_time())


@dataclass(frozen=True)
class Plan:
    """How a move is carried out.

    Attributes:
        pick: the object's name; X_TO_pick, X_TO_place: where it is, and where it is let go.
        X_OG: The grasp.
        mass: kg, of the object; p_GCm: (3,) m, its centre of mass in the cup's frame.
        phases: in order.
        descent: q (n,) rad over time, s: straight down from the place at `DESCENT_SPEED`, to be run until the object touches
            something; or None.
        attempts: grasps and branches that were looked at.
        seconds: that planning took.
    """

    pick: str
    X_TO_pick: Pose
    X_TO_place: Pose
    X_OG: RigidTransform
    mass: float
    p_GCm: tuple[float, float, float]
    phases: tuple[Phase, ...]
    attempts: int
    seconds: float
    descent: Trajectory | None = None

    @property
    def duration(self) -> float:
        """s, of the motion, but for the descent."""
        return sum(phase.duration for phase in self.phases)

    @property
    def depth(self) -> float:
        """m, of the descent."""
        return 0.0 if self.descent is None else DESCENT_SPEED * float(self.descent.end_time())

    @property
    def sure(self) -> float:
        """s, of the motion along the sure ways."""
        return sum(phase.sure for phase in self.phases)

    def __deepcopy__(self, memo: object) -> "Plan":
        """Itself: it never changes, and Drake copies abstract values again and again."""
        return self


def plan_fields(found: Plan | NoPlan) -> dict[str, Any]:
    """A plan as a document: its phases' ways sampled at 100 Hz (s, rad); or why there is none."""
    if isinstance(found, NoPlan):
        number = (
            found.number if math.isfinite(found.number) else None
        )  # infinite: the lip is partly in the air
        return {
            "planned": False,
            "reason": found.reason.value,
            "about": found.about,
            "number": number,
            "seconds": found.seconds,
        }
    phases = []
    for phase in found.phases:
        times = np.linspace(0.0, phase.duration, math.ceil(100 * phase.duration) + 1)
        near = math.isfinite(phase.clearance.distance)
        phases.append(
            {
                "name": phase.name,
                "duration": phase.duration,
                "sure_duration": phase.sure,
                "clearance": phase.clearance.distance if near else None,
                "between": list(phase.clearance.pair) if near else [],
                "time": times.tolist(),
                "q": phase.trajectory.vector_values(times).T.tolist(),
            }
        )
    pose = found.X_TO_place
    return {
        "planned": True,
        "place": {"translation": list(pose.translation), "quaternion": list(pose.quaternion)},
        "X_OG": found.X_OG.GetAsMatrix4().tolist(),
        "duration": found.duration,
        "descent": found.depth,
        "phases": phases,
        "attempts": found.attempts,
        "seconds": found.seconds,
    }
