"""Carrying out plans in a running diagram."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import BasicVector, Context, DiagramBuilder, EventStatus, LeafSystem, State
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter.arm.paths import Payload, dynamics_plant, motion, torques
from drake_clutter.arm.plan import Plan
from drake_clutter.arm.station import ArmConfig

Floats = NDArray[np.float64]

DWELL = 0.15
"""s, that the arm waits for the vacuum to build up, and to be gone."""
PERIOD = 0.025
"""s, of the looks for a new plan."""
SAMPLE_PERIOD = 0.01
"""s, of the samples of reference and feed-forward torque, interpolated linearly."""


@dataclass(frozen=True)
class Schedule:
    """A plan as it is run: over the time since it began.

    Attributes:
        command: (18,), desired state, rad and rad/s, and feed-forward torque, N m.
        suction_on, suction_off, end: s.
        starts: name and start, s, of each phase and dwell.
    """

    command: PiecewisePolynomial
    suction_on: float
    suction_off: float
    end: float
    starts: tuple[tuple[str, float], ...]

    def phase(self, time: float) -> str:
        """What is done at a time, s; `idle` afterwards."""
        return "idle" if time >= self.end else [name for name, start in self.starts if start <= time + 1e-9][-1]


def scheduled(plan: Plan, config: ArmConfig) -> Schedule:
    """The plan's phases behind each other, with dwells at the ends of the carry, and the torques that they take."""
    approach, carry, retreat = plan.phases
    mass, p_GCm = plan.mass, plan.p_GCm
    parts, t_parts, at_rest = list[Floats](), list[Floats](), np.zeros((2, 6))
    starts, time = list[tuple[str, float]](), 0.0
    empty, loaded = Payload(), Payload(mass, p_GCm)
    for name, phase, payload in (
        ("approach", approach, empty),
        ("grasp", None, empty),
        ("carry", carry, loaded),
        ("release", None, loaded),
        ("retreat", retreat, empty),
    ):
        starts.append((name, time))
        duration = phase.duration if phase else DWELL
        if phase:
            q, v, a = motion(phase.trajectory, max(2, round(duration / SAMPLE_PERIOD) + 1))
        else:
            q, v, a = np.repeat(parts[-1][-1:, :6], 2, axis=0), at_rest, at_rest
        t_parts.append(time + np.linspace(0.0, duration, len(q)))
        parts.append(np.column_stack([q, v, torques(dynamics_plant(config, payload), q, v, a)]))
        time += duration
    on, off = starts[1][1], starts[3][1]
    # Neighbouring parts share a time: the later sample is left a moment later.
    t = np.concatenate([part + (1e-6 * (k > 0)) * (part == part[0]) for k, part in enumerate(t_parts)])
    return Schedule(PiecewisePolynomial.FirstOrderHold(t, np.vstack(parts).T), on, off, time, tuple(starts))


@dataclass(frozen=True)
class Running:
    """What is being carried out, or was last.

    Attributes:
        plan, schedule: of it; None before the first.
        begun: s. count: of the plans begun so far.
    """

    plan: Plan | None = None
    schedule: Schedule | None = None
    begun: float = 0.0
    count: int = 0

    def __deepcopy__(self, memo: object) -> "Running":
        """Itself, as of `Plan`."""
        return self


class PickPlaceExecutor(LeafSystem):
    """Runs one plan after the other.

    Input port: plan, abstract, a `Plan` or None; one that differs from the last is begun as soon as that has ended.
    Output ports: command (18,), desired state, rad and rad/s, and feed-forward torque, N m; suction (1,), 1 for on; status,
        abstract, the phase; finished (1,), how many plans have ended.
    """

    def __init__(self, *, config: ArmConfig) -> None:
        """Begins at home, with nothing to do."""
        super().__init__()
        self._config = config
        home, still = np.array(config.home)[None], np.zeros((1, 6))
        self._at_home = np.hstack([home, still, torques(dynamics_plant(config, Payload()), home, still, still)]).ravel()
        self._plan_port = self.DeclareAbstractInputPort("plan", AbstractValue.Make(None))
        self._state = self.DeclareAbstractState(AbstractValue.Make(Running()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._update)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        of = {self.all_state_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("command", 18, self._calc_command, of)
        self.DeclareVectorOutputPort("suction", 1, self._calc_suction, of)
        self.DeclareVectorOutputPort("finished", 1, self._calc_finished, of)
        self.DeclareAbstractOutputPort("status", lambda: AbstractValue.Make(""), self._calc_status, of)

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, config: ArmConfig) -> "PickPlaceExecutor":
        """Adds one."""
        system: PickPlaceExecutor = builder.AddSystem(PickPlaceExecutor(config=config))
        system.set_name("pick_place_executor")
        return system

    def _update(self, context: Context, state: State) -> EventStatus:
        running = self.running(context)
        plan = self._plan_port.Eval(context) if self._plan_port.HasValue(context) else None
        over = running.schedule is None or context.get_time() >= running.begun + running.schedule.end
        if plan is not None and plan is not running.plan and over:
            begun = Running(plan, scheduled(plan, self._config), context.get_time(), running.count + 1)
            state.get_mutable_abstract_state(int(self._state)).set_value(begun)
        return EventStatus.Succeeded()

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
        ended = schedule is not None and time >= schedule.end
        output.SetFromVector([self.running(context).count - (schedule is not None and not ended)])

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        schedule, time = self._now(context)
        output.set_value("idle" if schedule is None else schedule.phase(time))
