"""Executor of pick-and-place plans: a LeafSystem that commands joints and gripper."""

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
from drake_clutter.cell.payload_limits import GRAVITY
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.arm_dynamics import arm_dynamics
from drake_clutter.planning.motion_plan import Plan
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.station.command_schedule import (
    CommandSchedule,
    RecordedSchedule,
    build_command_schedule,
    build_withdrawal_schedule,
)
from drake_clutter.station.messages import ExecutorStatus, Message, PlannedMove

Floats = NDArray[np.float64]

EXECUTOR_UPDATE_PERIOD = 0.025
"""Period at which new plans are accepted and contact is detected [s]."""
CONTACT_COMPRESSION = 0.0005
"""Compression of the bellows that counts as contact during a guarded descent [m]: 1 N at 2000 N/m.
Damping adds about 3 N until the arm stops."""
MIN_BELLOWS_EXTENSION = 0.0002
"""Extension of the bellows below which they carry no object, or one that is already supported [m].
The lightest box extends them by 0.5 mm."""

MIN_JAW_SQUEEZE = 0.0005
"""Distance to the commanded position below which a jaw has not met an object [m]: the command is
`JAW_SQUEEZE` beyond its surface, and the 2F-85 resolves 0.3 mm (85 mm in 255 steps)."""


@dataclass(frozen=True)
class ExecutorState(Message):
    """State of the executor: the current or last plan.

    Attributes:
        number: Number of the plan.
        plan: Plan; None before the first one.
        schedule: Command schedule of the plan; None before the first one.
        start_time: Time at which the plan started [s].
        bellows_extension: Extension of the bellows at the start of the guarded descent [m]; NaN
            before.
        contact_time: Time between the start of the guarded descent and contact [s]; infinite
            without contact.
        waited: Time for which the arm has waited for the vacuum, beyond the planned dwells [s].
        grip_wait: The part of it at the current grasp [s].
        missed_grasp: Whether the gripper has not grasped the object, so that the arm goes back.
    """

    plan: Plan | None = None
    schedule: CommandSchedule | None = None
    start_time: float = 0.0
    bellows_extension: float = math.nan
    contact_time: float = math.inf
    waited: float = 0.0
    grip_wait: float = 0.0
    missed_grasp: bool = False

    @property
    def lowered_distance(self) -> float:
        """Distance between the planned and the actual release height [m]."""
        if not isinstance(self.plan, PickPlacePlan) or self.plan.guarded_descent is None:
            return 0.0
        if self.missed_grasp:
            return 0.0
        return self.plan.guarded_descent.depth_at(self.contact_time)

    def elapsed(self, time: float) -> float:
        """Return the time since the start of the plan without `waited`, at most its duration [s].

        Args:
            time: Simulation time [s].
        """
        assert self.schedule is not None
        return min(time - self.start_time - self.waited, self.schedule.end_time)

    @property
    def end_time(self) -> float:
        """Time at which the plan ends [s]; -infinity without a plan."""
        if self.schedule is None:
            return -math.inf
        return self.start_time + self.waited + self.schedule.end_time

    def has_ended(self, time: float) -> bool:
        """Return whether no plan is executed.

        Args:
            time: Simulation time [s].
        """
        return time >= self.end_time


class PickPlaceExecutor(LeafSystem):
    """Execute plans one after the other.

    The initial state has no plan: the arm stays at its home configuration.

    .. pydrake_system::

        name: PickPlaceExecutor
        input_ports:
        - plan
        - gripper_state
        - vacuum
        output_ports:
        - command
        - gripper_command
        - hold
        - finished
        - status

    Input ports:
        plan: `PlannedMove`. A plan with a new number starts as soon as the previous one has ended.
        gripper_state: Positions, then velocities of the gripper's k joints. A guarded
            descent ends when the bellows of the tool are compressed, or at its planned end. Shape
            (2 k,).
        vacuum: Vacuum of each suction cup [Pa]; only with suction cups. The arm does not lift an
            object before `SuctionGripper.lift_vacuum`, or `grip_timeout` later than planned; below
            `detection_vacuum` it goes back then without the object. Shape (num_cups,).

    Output ports:
        command: Desired positions [rad], desired velocities [rad/s] and feed-forward torques [N m]
            of n joints. Shape (3 n,).
        gripper_command: Desired positions [m], then desired velocities [m/s] of the m actuated
            joints of the gripper. Shape (2 m,).
        hold: 1 for the tool that is commanded to hold an object, else 0; in the order of the
            gripper's tools. Shape (num_tools,).
        finished: Number of the last plan if it has ended, else 0; and distance between planned and
            actual release height [m]. Shape (2,).
        status: `ExecutorStatus`.
    """

    def __init__(self, *, cell: WorkCell) -> None:
        """Create an executor.

        Args:
            cell: Work cell with robot and gripper.
        """
        super().__init__()
        self._cell = cell
        robot = load_robot(cell.robot)
        home = robot.home[None]
        zero = np.zeros((1, robot.num_joints))
        gravity = arm_dynamics(cell, Payload()).inverse_dynamics(home, zero, zero)
        self._home_command = np.hstack([home, zero, gravity]).ravel()
        self._plan = self.DeclareAbstractInputPort("plan", AbstractValue.Make(PlannedMove()))
        self._tools = cell.gripper.tools
        self._num_actuated_joints = cell.gripper.num_actuated_joints
        self._gripper_state = self.DeclareVectorInputPort(
            "gripper_state", 2 * cell.gripper.num_joints
        )
        if isinstance(cell.gripper, SuctionGripper):
            self._vacuum = self.DeclareVectorInputPort("vacuum", len(self._tools))
        self._state = self.DeclareAbstractState(AbstractValue.Make(ExecutorState()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(EXECUTOR_UPDATE_PERIOD, 0.0, self._update)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        prerequisites = {self.all_state_ticket(), self.time_ticket()}
        self.DeclareVectorOutputPort(
            "command", len(self._home_command), self._calc_command, prerequisites
        )
        self.DeclareVectorOutputPort(
            "gripper_command",
            2 * self._num_actuated_joints,
            self._calc_gripper_command,
            prerequisites,
        )
        self.DeclareVectorOutputPort("hold", len(self._tools), self._calc_hold, prerequisites)
        self.DeclareVectorOutputPort("finished", 2, self._calc_finished, prerequisites)
        self.DeclareAbstractOutputPort(
            "status", lambda: AbstractValue.Make(ExecutorStatus()), self._calc_status, prerequisites
        )

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, cell: WorkCell) -> "PickPlaceExecutor":
        """Add an executor to a diagram and return it."""
        system: PickPlaceExecutor = builder.AddNamedSystem(
            "pick_place_executor", PickPlaceExecutor(cell=cell)
        )
        return system

    def state(self, context: Context) -> ExecutorState:
        """Return the state from the context of the executor."""
        state: ExecutorState = context.get_abstract_state(self._state).get_value()
        return state

    def set_state(self, context: Context, state: ExecutorState) -> None:
        """Set the state in the context of the executor."""
        context.SetAbstractState(int(self._state), state)

    def _update(self, context: Context, state: State) -> EventStatus:
        current = self.state(context)
        time = context.get_time()
        updated = self._await_grip(context, self._detect_contact(context, current))
        has_input = self._plan.HasValue(context)
        move: PlannedMove = self._plan.Eval(context) if has_input else PlannedMove()
        is_new = move.plan is not None and move.number != current.number
        if move.plan is not None and is_new and current.has_ended(time):
            schedule = move.schedule or build_command_schedule(move.plan, self._cell)
            updated = ExecutorState(move.number, move.plan, schedule, time)
        if updated is not current:
            state.get_mutable_abstract_state(int(self._state)).set_value(updated)
        return EventStatus.Succeeded()

    def _await_grip(self, context: Context, state: ExecutorState) -> ExecutorState:
        """Return the state, delayed if a grasp is about to end without enough vacuum.

        If no vacuum builds up in `grip_timeout`, or the jaws close without an object, the arm goes
        back.
        """
        gripper, schedule = self._cell.gripper, state.schedule
        if isinstance(schedule, RecordedSchedule):
            time = context.get_time() - state.start_time
            if all(abs(time - t) > EXECUTOR_UPDATE_PERIOD / 2 for t in schedule.wait_times):
                return state
            return replace(state, waited=state.waited + EXECUTOR_UPDATE_PERIOD)
        if schedule is None or state.missed_grasp:
            return state
        elapsed = state.elapsed(context.get_time())
        tool = schedule.tool_at(elapsed)
        ends_before_next_update = schedule.stage_at(elapsed + EXECUTOR_UPDATE_PERIOD) != "grasp"
        if schedule.stage_at(elapsed) != "grasp":
            return replace(state, grip_wait=0.0) if state.grip_wait else state
        if not tool or not ends_before_next_update:
            return state
        if not isinstance(gripper, SuctionGripper):
            is_empty = self._are_jaws_empty(context, schedule, elapsed)
            return self._withdraw(state, elapsed) if is_empty else state
        if not self._vacuum.HasValue(context):
            return state
        vacuum = float(self._vacuum.Eval(context)[list(self._tools).index(tool)])
        if vacuum >= gripper.lift_vacuum * gripper.full_vacuum:
            return state
        if state.grip_wait + EXECUTOR_UPDATE_PERIOD > gripper.grip_timeout:
            if vacuum >= gripper.detection_vacuum:
                return state
            return self._withdraw(state, elapsed)
        return replace(
            state,
            waited=state.waited + EXECUTOR_UPDATE_PERIOD,
            grip_wait=state.grip_wait + EXECUTOR_UPDATE_PERIOD,
        )

    def _are_jaws_empty(self, context: Context, schedule: CommandSchedule, time: float) -> bool:
        """Return whether all jaws have reached their commanded positions, beyond the object.

        Args:
            context: Context of the executor.
            schedule: Schedule of the plan.
            time: Time at the end of the grasp since the start of the plan [s].
        """
        count = self._num_actuated_joints
        if not count or not self._gripper_state.HasValue(context):
            return False
        positions = np.asarray(self._gripper_state.Eval(context))[:count]
        return bool((schedule.gripper_joints(time) - positions < MIN_JAW_SQUEEZE).all())

    def _withdraw(self, state: ExecutorState, time: float) -> ExecutorState:
        """Return the state of an arm that goes back without the object.

        Args:
            state: State during a grasp.
            time: Time since the start of the plan [s].
        """
        assert state.plan is not None
        assert state.schedule is not None
        withdrawal = build_withdrawal_schedule(state.schedule, state.plan, self._cell, time)
        return replace(state, schedule=withdrawal, missed_grasp=True)

    def _detect_contact(self, context: Context, state: ExecutorState) -> ExecutorState:
        """Return the state, updated if contact occurs during a guarded descent."""
        schedule = state.schedule
        if (
            schedule is None
            or not isinstance(state.plan, PickPlacePlan)
            or state.plan.guarded_descent is None
            or not self._gripper_state.HasValue(context)
        ):
            return state
        joint = self._tools[state.plan.tool].compliant_joint
        if joint is None:
            return state
        descent_start = schedule.start_of("descend")
        descent_duration = schedule.release_time - descent_start
        descent_time = state.elapsed(context.get_time()) - descent_start
        is_descending = 0 < descent_time < descent_duration
        if not is_descending or math.isfinite(state.contact_time):
            return state
        extension = float(self._gripper_state.Eval(context)[joint])
        is_first = math.isnan(state.bellows_extension)
        initial_extension = extension if is_first else state.bellows_extension
        if extension > max(initial_extension - CONTACT_COMPRESSION, MIN_BELLOWS_EXTENSION):
            return replace(state, bellows_extension=initial_extension)
        return replace(
            state,
            bellows_extension=initial_extension,
            contact_time=descent_time,
            schedule=build_command_schedule(state.plan, self._cell, descent_time),
        )

    def _calc_command(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        if state.schedule is None:
            output.SetFromVector(self._home_command)
        else:
            time = state.elapsed(context.get_time())
            output.SetFromVector(state.schedule.command.value(time).ravel())

    def _calc_gripper_command(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        positions = np.zeros(self._num_actuated_joints)
        if state.schedule is not None:
            positions = state.schedule.gripper_joints(state.elapsed(context.get_time()))
        output.SetFromVector(np.concatenate([positions, np.zeros_like(positions)]))

    def _calc_hold(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        held = ""
        if state.schedule is not None:
            held = state.schedule.tool_at(state.elapsed(context.get_time()))
        output.SetFromVector([float(name == held) for name in self._tools])

    def _calc_finished(self, context: Context, output: BasicVector) -> None:
        state = self.state(context)
        number = state.number if state.has_ended(context.get_time()) else 0
        output.SetFromVector([number, state.lowered_distance])

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        state = self.state(context)
        stage = "idle"
        if state.schedule is not None:
            stage = state.schedule.stage_at(state.elapsed(context.get_time()))
        status = ExecutorStatus(
            state.number,
            stage,
            state.missed_grasp,
            state.bellows_extension,
            self._felt_mass(state),
            math.isfinite(state.contact_time),
        )
        output.set_value(status)

    def _felt_mass(self, state: ExecutorState) -> float:
        """Return the mass that stretched the bellows, see `ExecutorStatus` [kg]."""
        gripper = self._cell.gripper
        if (
            not isinstance(gripper, SuctionGripper)
            or not isinstance(state.plan, PickPlacePlan)
            or not state.bellows_extension > MIN_BELLOWS_EXTENSION
        ):
            return math.nan
        cup = gripper.cup(state.plan.tool)
        return cup.stiffness * state.bellows_extension / GRAVITY - cup.mass
