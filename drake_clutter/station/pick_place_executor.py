"""Carries out plans in a running diagram."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    State,
)

from drake_clutter.cell.gripper import Payload
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.pick_place_plan import DESCENT_SPEED, PickPlacePlan
from drake_clutter.planning.time_parameterization import dynamics_plant, inverse_dynamics
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.station.command_schedule import CommandSchedule, build_command_schedule
from drake_clutter.station.messages import ExecutorStatus, Message, PlannedMove

Floats = NDArray[np.float64]

EXECUTOR_UPDATE_PERIOD = 0.025
"""Between two looks for a new plan [s]."""
CONTACT_COMPRESSION = 0.0005
"""A descent has touched something when the bellows give way so far [m]: 1 N, and three more of
damping until the arm stands still."""
MIN_BELLOWS_EXTENSION = 0.0002
"""Bellows that are pulled out less bear nothing, or what is held up already [m]; the lightest box
pulls half a millimeter."""


@dataclass(frozen=True)
class ExecutorState(Message):
    """The plan that is being carried out, or was last.

    Attributes:
        number: Of the plan.
        plan: None before the first.
        schedule: Of the plan; None before the first.
        start_time: When it began [s].
        bellows_extension: Before the descent [m]; NaN until then.
        contact_time: Of the descent, until something was touched [s]; infinite if nothing was.
    """

    plan: PickPlacePlan | None = None
    schedule: CommandSchedule | None = None
    start_time: float = 0.0
    bellows_extension: float = math.nan
    contact_time: float = math.inf

    @property
    def lowered_distance(self) -> float:
        """By which the object is let go below its planned pose [m]."""
        if self.plan is None:
            return 0.0
        return min(self.plan.max_descent, self.contact_time * DESCENT_SPEED)

    def elapsed(self, time: float) -> float:
        """Return the plan's time at a time of the simulation [s], up to the plan's end."""
        assert self.schedule is not None
        return min(time - self.start_time, self.schedule.end_time)

    def has_ended(self, time: float) -> bool:
        """Whether the arm is home again, or no plan has begun."""
        return self.schedule is None or time >= self.start_time + self.schedule.end_time


class PickPlaceExecutor(LeafSystem):
    """Carry out one plan after the other.

    .. pydrake_system::

        name: PickPlaceExecutor
        input_ports:
        - plan
        - bellows
        output_ports:
        - command
        - suction
        - finished
        - status

    Input ports:
        plan: `PlannedMove`; one with a new number begins as soon as the last has ended.
        bellows: How far the bellows are pulled out [m], and how fast [m/s]. A descent ends when
            they give way, or where it was planned to. Shape (2,).

    Output ports:
        command: Desired positions [rad] and velocities [rad/s], and feed-forward torques [N m].
            Shape (3 n,) for n joints.
        suction: 1 for on. Shape (1,).
        finished: Number of the plan that has ended, 0 while one is carried out; and how far below
            its planned pose the object was let go [m]. Shape (2,).
        status: `ExecutorStatus`.
    """

    def __init__(self, *, cell: WorkCell) -> None:
        """Make an executor that is at home."""
        super().__init__()
        self._cell = cell
        robot = load_robot(cell.robot)
        home, still = robot.home[None], np.zeros((1, robot.num_joints))
        hold = inverse_dynamics(dynamics_plant(cell, Payload()), home, still, still)
        self._at_home = np.hstack([home, still, hold]).ravel()
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(PlannedMove()))
        self._bellows = self.DeclareVectorInputPort("bellows", 2)
        self._state = self.DeclareAbstractState(AbstractValue.Make(ExecutorState()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(EXECUTOR_UPDATE_PERIOD, 0.0, self._update)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        of = {self.all_state_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort("command", len(self._at_home), self._calc_command, of)
        self.DeclareVectorOutputPort("suction", 1, self._calc_suction, of)
        self.DeclareVectorOutputPort("finished", 2, self._calc_finished, of)
        self.DeclareAbstractOutputPort(
            "status", lambda: AbstractValue.Make(ExecutorStatus()), self._calc_status, of
        )

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, cell: WorkCell) -> "PickPlaceExecutor":
        """Add an executor to a diagram."""
        system: PickPlaceExecutor = builder.AddNamedSystem(
            "pick_place_executor", PickPlaceExecutor(cell=cell)
        )
        return system

    def state(self, context: Context) -> ExecutorState:
        """Return the state in the executor's context."""
        state: ExecutorState = context.get_abstract_state(self._state).get_value()
        return state

    def _update(self, context: Context, state: State) -> EventStatus:
        now, time = self.state(context), context.get_time()
        after = self._detect_contact(context, now)
        has_plan = self._plan.HasValue(context)
        given: PlannedMove = self._plan.Eval(context) if has_plan else PlannedMove()
        if given.plan is not None and given.number != now.number and now.has_ended(time):
            schedule = build_command_schedule(given.plan, self._cell)
            after = ExecutorState(given.number, given.plan, schedule, time)
        if after is not now:
            state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _detect_contact(self, context: Context, now: ExecutorState) -> ExecutorState:
        """Return the state with an end of the descent, if the object has touched something."""
        if now.schedule is None or now.plan is None or not self._bellows.HasValue(context):
            return now
        start = now.schedule.descent_start_time
        descended = context.get_time() - now.start_time - start
        descending = 0 < descended < now.schedule.suction_off_time - start
        if not descending or math.isfinite(now.contact_time):
            return now
        extension = float(self._bellows.Eval(context)[0])
        first = math.isnan(now.bellows_extension)
        before = extension if first else now.bellows_extension
        if extension > max(before - CONTACT_COMPRESSION, MIN_BELLOWS_EXTENSION):
            return replace(now, bellows_extension=before)
        schedule = build_command_schedule(now.plan, self._cell, descended)
        return replace(now, bellows_extension=before, contact_time=descended, schedule=schedule)

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        if state.schedule is None:
            output.SetFromVector(self._at_home)
        else:
            time = state.elapsed(context.get_time())
            output.SetFromVector(state.schedule.command.value(time).ravel())

    def _calc_suction(self, context: Context, output: BasicVector) -> None:
        state, on = self.state(context), False
        if state.schedule is not None:
            time = state.elapsed(context.get_time())
            on = state.schedule.suction_on_time <= time < state.schedule.suction_off_time
        output.SetFromVector([float(on)])

    def _calc_finished(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        number = state.number if state.has_ended(context.get_time()) else 0
        output.SetFromVector([number, state.lowered_distance])

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        state, phase = self.state(context), "idle"
        if state.schedule is not None:
            phase = state.schedule.stage_at(state.elapsed(context.get_time()))
        output.set_value(ExecutorStatus(state.number, phase))
