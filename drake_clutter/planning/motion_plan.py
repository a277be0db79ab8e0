"""Motion plans as sequences of steps, and the state of a cell between two plans.

Frames: T is the support, G is a tool of the gripper, O is an object.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.files import InputError
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.scene_plant import pose_from_transform

Floats = NDArray[np.float64]

DWELL_TIME = 0.15
"""Time at rest in which the gripper grasps or releases the object [s]."""
JAW_SQUEEZE = 0.003
"""Distance by which jaws are commanded to close beyond the surface of the object [m], which takes
them to their largest force."""
_JOINT_TOLERANCE = 1e-6
"""Largest difference between the joints at the end of a plan and at the start of the next [rad]."""


@dataclass(frozen=True)
class HeldObject:
    """Object that a tool holds.

    Attributes:
        name: Name of the object.
        tool: Name of the tool.
        X_OG: Pose of the tool in the object.
        payload: Load.
        insertion: Distance by which the tool reaches below the top of the object [m].
        joints_open: Positions of the gripper's actuated joints after the release [m].
        joints_held: Positions of the gripper's actuated joints with the object [m].
    """

    name: str
    tool: str
    X_OG: RigidTransform
    payload: Payload
    insertion: float = 0.0
    joints_open: tuple[float, ...] = ()
    joints_held: tuple[float, ...] = ()

    @property
    def joints_closed(self) -> tuple[float, ...]:
        """Commanded positions of the gripper's actuated joints [m]."""
        return tuple(joint + JAW_SQUEEZE for joint in self.joints_held)


@dataclass(frozen=True)
class CellState:
    """State of a cell at rest: the start of a plan, and the end of the one before.

    Attributes:
        q: Joint positions of the arm [rad]. Shape (n,).
        objects: All known objects at their poses; a held one at its pose in the air.
        held: Object that a tool holds; None without one.
    """

    q: tuple[float, ...]
    objects: tuple[SceneObject, ...] = field(repr=False)
    held: HeldObject | None = None

    def moved(self, q: Floats, X_TG: Floats | None = None) -> "CellState":
        """Return the state after a motion, with the held object at its new pose.

        Args:
            q: Joint positions at the end [rad]. Shape (n,).
            X_TG: Pose of the tool that holds the object. Shape (4, 4).
        """
        state = replace(self, q=tuple(q.tolist()))
        if self.held is None or X_TG is None:
            return state
        X_TO = pose_from_transform(RigidTransform(X_TG) @ self.held.X_OG.inverse())
        return state.with_object(self.held.name, X_TO)

    def with_object(self, name: str, X_TO: Pose) -> "CellState":
        """Return the state with an object at another pose."""
        objects = (replace(o, X_TO=X_TO) if o.name == name else o for o in self.objects)
        return replace(self, objects=tuple(objects))


@dataclass(frozen=True)
class PlanStep:
    """Motion of the arm, or time at rest.

    The gripper is commanded at the start of the step.

    Attributes:
        name: `approach`, `grasp`, `lift`, `carry`, `release`, `retreat`, `move` or `hold`; with a
            guarded descent also `steady`, `descend` and `rise`; `withdraw` back to the start of the
            approach if the gripper has not grasped the object.
        trajectory: Joint positions over time. Shape (n,).
        payload: Load during the step.
        tool: Name of the tool that is commanded to hold an object; "" for none.
        joints: Commanded positions of the gripper's actuated joints [m].
        object_name: Name of the object that is grasped or released; "" for none.
        touched: Poses X_TO at which that object touches others.
    """

    name: str
    trajectory: Trajectory
    payload: Payload = field(default_factory=Payload)
    tool: str = ""
    joints: tuple[float, ...] = ()
    object_name: str = ""
    touched: tuple[Pose, ...] = ()

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.trajectory.end_time())


def stay_at(q: Sequence[float] | Floats, duration: float = DWELL_TIME) -> Trajectory:
    """Return the trajectory of an arm at rest.

    Args:
        q: Joint positions [rad]. Shape (n,).
        duration: Duration [s].
    """
    return PiecewisePolynomial.ZeroOrderHold([0.0, duration], np.column_stack([q, q]))


def reverse(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory traversed backwards."""
    end = trajectory.end_time()
    scaling = PiecewisePolynomial.FirstOrderHold([0.0, end], [[end, 0.0]])
    return PathParameterizedTrajectory(trajectory, scaling)


class Plan(Protocol):
    """Plan that a station executes."""

    @property
    def start(self) -> CellState:
        """State at the start."""

    @property
    def end(self) -> CellState:
        """State at the end, as planned."""

    @property
    def steps(self) -> tuple[PlanStep, ...]:
        """Steps in order."""


@dataclass(frozen=True)
class MotionPlan:
    """Sequence of steps from one state of the cell to another; a `Plan`.

    Attributes:
        start: State at the start.
        end: State at the end, as planned.
        steps: Steps in order.
        planning_time: Wall time spent [s].
    """

    start: CellState
    end: CellState
    steps: tuple[PlanStep, ...]
    planning_time: float = 0.0

    @property
    def duration(self) -> float:
        """Duration with the dwells [s]."""
        return sum(step.duration for step in self.steps)

    def __deepcopy__(self, memo: object) -> "MotionPlan":
        """Return the plan itself: it is immutable, and Drake copies abstract values often."""
        return self


def plan_from_steps(start: CellState, steps: Sequence[PlanStep]) -> MotionPlan:
    """Return a plan of user-defined steps, which are not checked for collisions and limits.

    Args:
        start: State at the start.
        steps: Steps in order, each of which starts where the previous one ends.

    Raises:
        InputError: There is no step, or one starts elsewhere.
    """
    if not steps:
        raise InputError("steps: none; expected at least one step")
    q = np.array(start.q)
    for step in steps:
        _check_joints(step.name, q, step.trajectory.value(0.0).ravel())
        q = step.trajectory.value(step.duration).ravel()
    return MotionPlan(start, start.moved(q), tuple(steps))


def concatenate_plans(plans: Sequence[Plan]) -> MotionPlan:
    """Return one plan of several, each of which starts in the state where the previous one ends.

    Args:
        plans: Plans in order.

    Raises:
        InputError: There is no plan, or one starts in another state.
    """
    if not plans:
        raise InputError("plans: none; expected at least one plan")
    for number, (first, second) in enumerate(pairwise(plans), start=2):
        _check_joints(f"plan {number}", np.array(first.end.q), np.array(second.start.q))
        names = [state.held.name if state.held else "" for state in (first.end, second.start)]
        if names[0] != names[1]:
            raise InputError(
                f"plan {number}: starts with {names[1] or 'nothing'!r} held; "
                f"expected {names[0] or 'nothing'!r}, as the plan before ends"
            )
    return MotionPlan(
        plans[0].start, plans[-1].end, tuple(step for plan in plans for step in plan.steps)
    )


def _check_joints(name: str, expected: Floats, q: Floats) -> None:
    """Raise an error unless two configurations are equal."""
    if expected.shape != q.shape or np.abs(expected - q).max() > _JOINT_TOLERANCE:
        texts = (np.array2string(at, precision=4, separator=", ") for at in (q, expected))
        start, allowed = (" ".join(text.split()) for text in texts)
        raise InputError(f"{name}: starts at joints {start}; expected {allowed}")
