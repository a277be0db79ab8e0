"""Carrying out plans in a running diagram."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, EventStatus, LeafSystem, State
from pydrake.trajectories import PathParameterizedTrajectory, PiecewisePolynomial, Trajectory

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.paths import dynamics_plant, motion, torques
from drake_clutter.planning.plan import DESCENT_SPEED, Plan

Floats = NDArray[np.float64]

DWELL = 0.15
"""s, that the arm waits for the vacuum to build up, and to be gone."""
PERIOD = 0.025
"""s, of the looks for a new plan."""
PRESSED, HANGS = 0.0005, 0.0002
"""m; in a descent the object touches something when the bellows give way so far (1 N, and three more of damping until the arm
stands still), or are hardly pulled out: then it is held up already, or nothing hangs there (the lightest box pulls half a mm)."""
SAMPLE_PERIOD = 0.01
"""s, of the samples of reference and feed-forward torque, interpolated linearly."""


@dataclass(frozen=True)
class Schedule:
    """A plan as it is run: over the time since it began.

    Attributes:
        command: (18,), desired state, rad and rad/s, and feed-forward torque, N m.
        suction_on, descent_start, suction_off, end: s; without a descent its start is `suction_off`.
        starts: name and start, s, of each phase and dwell.
    """

    command: PiecewisePolynomial
    suction_on: float
    descent_start: float
    suction_off: float
    end: float
    starts: tuple[tuple[str, float], ...]

    def phase(self, time: float) -> str:
        """What is done at a time, s; `idle` afterwards."""
        return "idle" if time >= self.end else [name for name, start in self.starts if start <= time + 1e-9][-1]


def scheduled(plan: Plan, cell: WorkCell, touched: float = math.inf) -> Schedule:
    """The plan's phases behind each other, with dwells at the ends of the carry, and the torques that they take.

    Args:
        plan, cell: what to carry out, and where.
        touched: s, after which the descent has ended; afterwards the arm rises again as far as it went down.
    """
    approach, carry, retreat = plan.phases
    mass, p_GCm = plan.mass, plan.p_GCm
    parts, t_parts, at_rest = list[Floats](), list[Floats](), np.zeros((2, 6))
    starts, time = list[tuple[str, float]](), 0.0
    empty, loaded = Payload(), Payload(mass, p_GCm)
    let_go = list[tuple[str, Trajectory | None, Payload]]([("release", None, loaded)])
    if plan.descent is not None:
        down = _until(plan.descent, touched)
        let_go = [("steady", None, loaded), ("descend", down, loaded), *let_go, ("rise", _backwards(down), empty)]
    for name, trajectory, payload in (
        ("approach", approach.trajectory, empty),
        ("grasp", None, empty),
        ("carry", carry.trajectory, loaded),
        *let_go,
        ("retreat", retreat.trajectory, empty),
    ):
        starts.append((name, time))
        duration = float(trajectory.end_time()) if trajectory else DWELL
        if trajectory:
            q, v, a = motion(trajectory, max(2, round(duration / SAMPLE_PERIOD) + 1))
        else:
            q, v, a = np.repeat(parts[-1][-1:, :6], 2, axis=0), at_rest, at_rest
        t_parts.append(time + np.linspace(0.0, duration, len(q)))
        parts.append(np.column_stack([q, v, torques(dynamics_plant(cell, payload), q, v, a)]))
        time += duration
    at = dict(starts)
    # Neighbouring parts share a time: the later sample is left a moment later.
    t = np.concatenate([part + (1e-6 * (k > 0)) * (part == part[0]) for k, part in enumerate(t_parts)])
    command = PiecewisePolynomial.FirstOrderHold(t, np.vstack(parts).T)
    return Schedule(command, at["grasp"], at.get("descend", at["release"]), at["release"], time, tuple(starts))


def _until(trajectory: Trajectory, time: float) -> Trajectory:
    """The part up to a time, s; it may end in motion."""
    end = min(time, trajectory.end_time())
    return PathParameterizedTrajectory(trajectory, PiecewisePolynomial.FirstOrderHold([0.0, end], [[0.0, end]]))


def _backwards(trajectory: Trajectory) -> Trajectory:
    """The same way back."""
    end = trajectory.end_time()
    return PathParameterizedTrajectory(trajectory, PiecewisePolynomial.FirstOrderHold([0.0, end], [[end, 0.0]]))


@dataclass(frozen=True)
class Running:
    """What is being carried out, or was last.

    Attributes:
        plan, schedule: of it; None before the first.
        begun: s. count: of the plans begun so far.
        hung: m, how far what is carried had pulled the bellows when the descent began; NaN before.
        touched: s, of the descent, until something was touched; infinite if nothing was.
    """

    plan: Plan | None = None
    schedule: Schedule | None = None
    begun: float = 0.0
    count: int = 0
    hung: float = math.nan
    touched: float = math.inf

    @property
    def lowered(self) -> float:
        """m, that the object goes down from its place."""
        return 0.0 if self.plan is None else min(self.plan.depth, self.touched * DESCENT_SPEED)

    def __deepcopy__(self, memo: object) -> "Running":
        """Itself, as of `Plan`."""
        return self


class PickPlaceExecutor(LeafSystem):
    """Runs one plan after the other.

    Input ports: plan, abstract, a `Plan` or None; one that differs from the last is begun as soon as that has ended. bellows
        (2,), how far they are pulled out, m, and how fast, m/s: a descent ends when they give way, or where it was planned to.
    Output ports: command (18,), desired state, rad and rad/s, and feed-forward torque, N m; suction (1,), 1 for on; status,
        abstract, the phase; finished (2,), how many plans have ended, and how far the latest has lowered its object, m.
    """

    def __init__(self, *, cell: WorkCell) -> None:
        """Begins at home, with nothing to do."""
        super().__init__()
        self._cell = cell
        home, still = np.array(cell.robot.home)[None], np.zeros((1, 6))
        self._at_home = np.hstack([home, still, torques(dynamics_plant(cell, Payload()), home, still, still)]).ravel()
        self._plan_port = self.DeclareAbstractInputPort("plan", AbstractValue.Make(None))
        self._bellows = self.DeclareVectorInputPort("bellows", 2)
        self._state = self.DeclareAbstractState(AbstractValue.Make(Running()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._update)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        of = {self.all_state_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("command", 18, self._calc_command, of)
        self.DeclareVectorOutputPort("suction", 1, self._calc_suction, of)
        self.DeclareVectorOutputPort("finished", 2, self._calc_finished, of)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(""), self._calc_status, of)

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, cell: WorkCell) -> "PickPlaceExecutor":
        """Adds one."""
        system: PickPlaceExecutor = builder.AddSystem(PickPlaceExecutor(cell=cell))
        system.set_name("pick_place_executor")
        return system

    def _update(self, context: Context, state: State) -> EventStatus:
        now = self.running(context)
        after = self._felt(context, now)
        plan = self._plan_port.Eval(context) if self._plan_port.HasValue(context) else None
        over = now.schedule is None or context.get_time() >= now.begun + now.schedule.end
        if plan is not None and plan is not now.plan and over:
            after = Running(plan, scheduled(plan, self._cell), context.get_time(), now.count + 1)
        if after is not now:
            state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _felt(self, context: Context, now: Running) -> Running:
        """With an end of the descent, if the cup feels that the object has touched something."""
        if now.schedule is None or now.plan is None or not self._bellows.HasValue(context) or math.isfinite(now.touched):
            return now
        start = now.schedule.descent_start
        descended = context.get_time() - now.begun - start
        if not 0 < descended < now.schedule.suction_off - start:
            return now
        pulled = float(self._bellows.Eval(context)[0])
        hung = pulled if math.isnan(now.hung) else now.hung
        if pulled > max(hung - PRESSED, HANGS):
            return replace(now, hung=hung)
        return replace(now, hung=hung, touched=descended, schedule=scheduled(now.plan, self._cell, descended))

    def running(self, context: Context) -> Running:
        """What is being carried out, or was last."""
        running: Running = context.get_abstract_state(self._state).get_value()
        return running

    def _now(self, context: Context) -> tuple[Schedule | None, float]:
        running = self.running(context)
        if running.schedule is None:
            return None, 0.0
        return running.schedule, min(context.get_time() - running.begun, running.schedule.end)

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        schedule, time = self._now(context)
        output.SetFromVector(self._at_home if schedule is None else schedule.command.value(time).ravel())

    def _calc_suction(self, context: Context, output: BasicVector) -> None:
        schedule, time = self._now(context)
        output.SetFromVector([float(schedule is not None and schedule.suction_on <= time < schedule.suction_off)])

    def _calc_finished(self, context: Context, output: BasicVector) -> None:
        schedule, time = self._now(context)
        running, ended = self.running(context), schedule is not None and time >= schedule.end
        output.SetFromVector([running.count - (schedule is not None and not ended), running.lowered])

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        schedule, time = self._now(context)
        output.set_value("idle" if schedule is None else schedule.phase(time))
