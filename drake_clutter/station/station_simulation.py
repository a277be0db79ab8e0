"""Simulation of the station: advances its Diagram and executes plans.

result = simulate_plan(cell, scene, plan)

or, for several plans one after the other:

simulation = StationSimulation(cell, scene)
result = simulation.execute(plan)
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError, format_value
from drake_clutter.limits import MAX_MOTION_DURATION
from drake_clutter.planning.motion_plan import HeldObject, Plan
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, tilt_between
from drake_clutter.station.body_sleep import BodySleepManager, affected_bodies, bodies_to_wake
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.command_schedule import CommandSchedule, RecordedSchedule
from drake_clutter.station.grasp_constraint import WeldPair
from drake_clutter.station.gripper_actuator import (
    GRIPPER_UPDATE_PERIOD,
    GripperActuator,
    SuctionActuator,
)
from drake_clutter.station.jaw_actuator import JawActuator
from drake_clutter.station.messages import PlannedMove
from drake_clutter.station.motion_recorder import MotionRecorder
from drake_clutter.station.pick_place_executor import ExecutorState, PickPlaceExecutor

SETTLE_TIME = 0.1
"""Time simulated after the arm is home [s]."""
STEP_PERIOD = 0.025
"""Period of a step: of updates of `BodySleepManager` [s]."""
TIME_STEP = STEP_PERIOD / 10
"""Time step of the plant [s]. With twice as much, high stacks creep and fall."""
COARSE_TIME_STEP = 2 * TIME_STEP
"""Time step of moves in which nothing unexpected happens [s], see `simulate_plan`."""
MAX_COARSE_DISPLACEMENT = 0.002
"""Largest error of the final position, and largest displacement of another object, of a move that
counts as uneventful [m]."""
MAX_COARSE_TILT = math.radians(1)
"""Largest error of the final orientation of such a move [rad]."""
_TIME_MARGIN = 0.001
"""Time by which the simulator advances beyond a step [s], so that rounding does not decide which
update of the plant belongs to it; less than a time step."""
_STEP_TOLERANCE = 1e-6
"""Difference of a time from a step that is due to rounding, as a fraction of the step."""
_GRIPPER_UPDATES_PER_STEP = round(STEP_PERIOD / GRIPPER_UPDATE_PERIOD)
MAX_START_ERROR = 1e-4
"""Largest difference between the commanded joints and the start of a plan [rad]."""
MAX_OVERTIME = 60.0
"""Time beyond the duration of a plan after which its execution is given up [s].

It is longer than the arm may wait for the vacuum of a few grasps.
"""
POST_MOTION_WAIT = 1.0
"""Time after the end of a plan in which fallen objects stay awake [s]."""

Regrip = Callable[[Sequence[HeldObject]], PickPlacePlan | PlanningFailure]
"""Returns a plan with another grasp than those that did not hold the object."""
AddSystems = Callable[[DiagramBuilder, ClutterStation, PickPlaceExecutor], None]
"""Adds systems to a diagram and connects them, including the input port `plan` of the executor."""

_ACTUATORS: Mapping[str, Callable[..., GripperActuator]] = {
    "suction": SuctionActuator,
    "parallel_jaw": JawActuator,
}
"""Actuator by `Gripper.kind`."""


@dataclass(frozen=True)
class PickPlaceResult:
    """Result of the execution of a plan.

    Attributes:
        plan: Plan that was executed, the last one of several grasps.
        poses: Poses X_TO at the end, by name.
        grasped: Whether the gripper held an object.
        missed_grasp: Whether the arm went back without the object: no vacuum built up, or the jaws
            met nothing.
        num_grips: Number of grasps that were tried one after the other, see `Regrip`.
        drop_time: Time at which the object came off by overload [s]; NaN if it did not.
        max_load_ratio: Largest ratio of the load to the load capacity of the gripper.
        slip: Displacement between object and gripper from grasp to release [m].
        position_error: Horizontal distance of the object from its place pose [m].
        orientation_error: Angle between the object and its place pose [rad].
        displacements: Displacement of each other object, by name [m].
        lowered_distance: Distance between planned and actual release height [m].
        max_tracking_error: Largest tracking error of a joint [rad].
        simulated_time: Simulation time at the end [s].
        samples: Recorded samples; None if not recorded.
        has_ended: Whether the plan has ended within `MAX_OVERTIME` of its duration.
    """

    plan: Plan = field(repr=False)
    poses: dict[str, Pose]
    grasped: bool
    drop_time: float
    max_load_ratio: float
    slip: float
    position_error: float
    orientation_error: float
    displacements: dict[str, float]
    lowered_distance: float
    max_tracking_error: float
    simulated_time: float
    samples: ActionSamples | None = field(repr=False, default=None)
    has_ended: bool = True
    missed_grasp: bool = False
    num_grips: int = 1

    @property
    def lost_object(self) -> bool:
        """Whether the object was not held until its release."""
        return not self.grasped or not math.isnan(self.drop_time)

    @property
    def is_uneventful(self) -> bool:
        """Whether the object was held and rests at its place pose, and no other one has moved."""
        return (
            self.has_ended
            and not self.lost_object
            and self.position_error <= MAX_COARSE_DISPLACEMENT
            and self.orientation_error <= MAX_COARSE_TILT
            and max(self.displacements.values(), default=0.0) <= MAX_COARSE_DISPLACEMENT
        )

    def __str__(self) -> str:
        if not self.has_ended:
            return f"the motion had not ended after {self.simulated_time:.2f} s"
        if not self.grasped:
            grips = "" if self.num_grips == 1 else f" with {self.num_grips} grasps"
            return f"the gripper did not grasp the object{grips}"
        if not math.isnan(self.drop_time):
            return f"came off the gripper after {self.drop_time:.2f} s"
        millimeters = 1000 * self.position_error
        degrees = math.degrees(self.orientation_error)
        return f"placed with an error of {millimeters:.1f} mm and {degrees:.1f} deg"


class StationSimulation:
    """Simulation of the arm and the objects of a scene.

    Objects that take no part in a motion are locked, see `BodySleepManager`.

    Attributes:
        cell: Work cell with the support of the scene.
        station: Plant, scene graph and position control.
        executor: Converts plans to commands.
        diagram: Root diagram with station, executor and added systems.
        simulator: Simulator of the diagram.
        gripper: Attaches and releases objects.
        recorder: Records motions; None without a rate.
    """

    def __init__(
        self,
        cell: WorkCell,
        scene: Scene,
        *,
        movable: Set[str] | None = None,
        time_step: float = TIME_STEP,
        weld: WeldPair | None = None,
        visuals: bool = False,
        add_systems: AddSystems | None = None,
        rate: float | None = None,
    ) -> None:
        """Build the diagram and reset it to a scene.

        Args:
            cell: Work cell; its support is replaced by that of the scene.
            scene: Objects at rest.
            movable: Names of the objects that can move; None for all. The others are fixed at their
                poses, which makes a step cheaper, see `woken_fixed_objects`.
            time_step: Time step of the plant [s].
            weld: The only object that can be grasped; None for any, see `ClutterStation`.
            visuals: Whether to add visual geometry for cameras.
            add_systems: Adds further systems, such as a planner; None if plans are passed to
                `execute`.
            rate: Samples of motions per second [Hz]; None records nothing.

        Raises:
            InputError: A model of the cell cannot be used.
        """
        self.cell = cell.with_support(scene.support)
        builder = DiagramBuilder()
        names = set(scene.names) if movable is None else movable
        named_classes = [(o.name, o.object_class) for o in scene.objects if o.name in names]
        self.station: ClutterStation = builder.AddNamedSystem(
            "clutter_station",
            ClutterStation(
                self.cell,
                named_classes,
                time_step=time_step,
                fixed_objects=[o for o in scene.objects if o.name not in names],
                weld=weld,
                visuals=visuals,
            ),
        )
        self.executor = PickPlaceExecutor.AddToBuilder(builder, cell=self.cell)
        suction = (
            [(self.executor, self.station, "hold"), (self.station, self.executor, "vacuum")]
            if self.station.vacuum_system is not None
            else []
        )
        for source, target, port in (
            (self.executor, self.station, "command"),
            (self.executor, self.station, "gripper_command"),
            (self.station, self.executor, "gripper_state"),
            *suction,
        ):
            builder.Connect(source.GetOutputPort(port), target.GetInputPort(port))
        if add_systems is not None:
            add_systems(builder, self.station, self.executor)
        self.diagram: Diagram = builder.Build()
        make_actuator = _ACTUATORS[self.cell.gripper.kind]
        self.gripper: GripperActuator = make_actuator(
            self.station, self.cell.gripper, self._commanded_tool
        )
        self._sleep = BodySleepManager(self.station)
        self._rate = rate
        self.reset(scene)

    def reset(self, scene: Scene) -> None:
        """Reset to time 0, with the arm at home and the objects at rest.

        Args:
            scene: Objects with the names that the simulation was built with. The poses of fixed
                ones are those that it was built with.
        """
        self._scene = scene
        # The first step initializes the simulator: a plan that is available then starts at time 0.
        self.simulator = Simulator(self.diagram)
        movable = [o for o in scene.objects if o.name in self.station.scene_plant.bodies]
        self.station.set_state(self.root, np.array(self.cell.robot.home), movable)
        self.gripper.reset()
        self._sleep.reset(self.root)
        self._num_steps = 0
        self._affected_plan = 0
        self._affected: tuple[frozenset[str], ...] = ()
        self.recorder: MotionRecorder | None = None
        if self._rate is not None:
            self.recorder = MotionRecorder(
                self.station, self.executor, self.gripper, self.root, scene, self._rate
            )
            self.simulator.set_monitor(self.recorder.observe)

    def expect_first_plan(self, affected: tuple[frozenset[str], ...]) -> None:
        """Set the objects that the first plan affects, which are then not computed again.

        Args:
            affected: Names for each step, see `affected_bodies`.
        """
        self._affected_plan = 1
        self._affected = affected

    def release(self) -> None:
        """Free the memory of the diagram; the simulation cannot be used afterwards.

        Systems written in Python and the diagram that owns them refer to each other through C++,
        which the garbage collector does not see.
        """
        self.simulator.clear_monitor()
        self.recorder = None
        for system in (self.station.vacuum_system, self.station, self.executor):
            if system is not None:
                system.__dict__.clear()

    @property
    def root(self) -> Context:
        """Context of the root diagram."""
        return self.simulator.get_mutable_context()

    @property
    def plant_context(self) -> Context:
        """Context of the plant."""
        return self.station.plant_context(self.root)

    @property
    def scene(self) -> Scene:
        """Objects at their current poses."""
        return self._scene.with_poses(self.station.scene_plant.poses(self.plant_context))

    @property
    def woken_fixed_objects(self) -> frozenset[str]:
        """Names of fixed objects that were hit, or that a lost object might have hit.

        If there are any, the simulation must be repeated with all objects movable.
        """
        return frozenset(self._sleep.woken_fixed_objects)

    @property
    def executor_state(self) -> ExecutorState:
        """State of the executor with the current or last plan."""
        return self.executor.state(self.executor.GetMyContextFromRoot(self.root))

    @property
    def finished_plan(self) -> int:
        """Number of the last plan if it has ended, else 0."""
        port = self.executor.GetOutputPort("finished")
        return int(port.Eval(self.executor.GetMyContextFromRoot(self.root))[0])

    @property
    def is_at_rest(self) -> bool:
        """Whether no plan is executed, and none was within `SETTLE_TIME`."""
        return self._num_steps * STEP_PERIOD >= self.executor_state.end_time + SETTLE_TIME

    @property
    def is_asleep(self) -> bool:
        """Whether all objects are locked, see `BodySleepManager`."""
        return not self._sleep.awake

    def step(self) -> None:
        """Advance by `STEP_PERIOD`."""
        state = self.executor_state
        required = frozenset[str]()
        expects_grasp = False
        if state.plan is not None and state.schedule is not None:
            if state.number != self._affected_plan:
                self._affected_plan = state.number
                self._affected = (
                    state.schedule.affected
                    if isinstance(state.schedule, RecordedSchedule)
                    else affected_bodies(self.scene.objects, state.plan)
                )
            # A plan without a seal has fewer steps, the last of which touches nothing.
            self._affected = self._affected[: len(state.schedule.steps)]
            elapsed = self.root.get_time() - state.start_time - state.waited
            required = bodies_to_wake(state.schedule, self._affected, elapsed)
            end = state.schedule.end_time + POST_MOTION_WAIT
            held_time = state.schedule.held_time(elapsed)
            expects_grasp = held_time + STEP_PERIOD <= elapsed < end and not state.missed_grasp
        self._sleep.update(self.root, required, self.gripper.status, expects_grasp=expects_grasp)
        start = self._num_steps * STEP_PERIOD + _TIME_MARGIN
        for k in range(_GRIPPER_UPDATES_PER_STEP):
            self.simulator.AdvanceTo(start + (k + 1) * GRIPPER_UPDATE_PERIOD)
            self.gripper.update(self.root)
        self._num_steps += 1

    @property
    def is_idle(self) -> bool:
        """Whether nothing moves: no plan is executed, and all objects are asleep."""
        return self.is_at_rest and self.is_asleep

    def skip_until(self, time: float) -> None:
        """Advance to the last step before a time [s] without simulating what is in between.

        Nothing may move, and no system of the diagram may act before that time.
        """
        num_steps = math.ceil(time / STEP_PERIOD - _STEP_TOLERANCE) - 1
        if num_steps <= self._num_steps:
            return
        self._num_steps = num_steps
        self.root.SetTime(num_steps * STEP_PERIOD + _TIME_MARGIN)
        self.simulator.Initialize(InitializeParams(suppress_initialization_events=True))

    def run_until(self, condition: Callable[[], bool]) -> None:
        """Step until a condition holds; it is checked before each step."""
        while not condition():
            self.step()

    def _poses(self) -> dict[str, Pose]:
        """Return X_TO of all objects, by name."""
        return {o.name: o.X_TO for o in self.scene.objects}

    def execute(self, plan: Plan, schedule: CommandSchedule | None = None) -> PickPlaceResult:
        """Execute a plan until its end, and for `SETTLE_TIME` more.

        A plan that has not ended `MAX_OVERTIME` after its duration is given up, see
        `PickPlaceResult.has_ended`.

        The diagram must not have been built with `add_systems` that connect the executor.

        Args:
            plan: Plan to execute.
            schedule: Commands; None for those that follow from the plan.

        Raises:
            InputError: The plan does not start at the commanded joint positions, is longer than
                `MAX_MOTION_DURATION`, or a step names an unknown tool.
        """
        before = self.scene
        max_tracking_error = 0.0
        for error in self._execute(plan, schedule):
            max_tracking_error = max(max_tracking_error, error)
        return self._result(plan, _moved_objects(plan), before, max_tracking_error)

    def execute_while_uneventful(
        self, plan: Plan, expect: Callable[[], Sequence[SceneObject]] | None = None
    ) -> PickPlaceResult | None:
        """Execute a plan as `execute` does, until something unexpected happens.

        Args:
            plan: Plan to execute.
            expect: Returns, after the motion, the moved objects at the poses at which they should
                be; None for those of the plan, whose objects must be those of the scene.

        Returns:
            The result; None if the move is not uneventful, or a fixed object was hit.
        """
        before = self.scene
        max_tracking_error = 0.0
        for error in self._execute(plan):
            max_tracking_error = max(max_tracking_error, error)
            if self._sleep.woken_fixed_objects or self._has_displaced_objects(before):
                return None
        moved = _moved_objects(plan) if expect is None else expect()
        result = self._result(plan, moved, before, max_tracking_error)
        return result if result.is_uneventful else None

    def _execute(self, plan: Plan, schedule: CommandSchedule | None = None) -> Iterator[float]:
        """Execute a plan, and yield the tracking error after each step [rad].

        It is given up `MAX_OVERTIME` after its duration.
        """
        self._check_start(plan)
        steps = plan.steps
        duration = sum(s.duration for s in steps) if schedule is None else schedule.end_time
        if not duration <= MAX_MOTION_DURATION:
            allowed = f"at most {MAX_MOTION_DURATION:g} s"
            raise InputError(f"plan: takes {duration:g} s; expected {allowed}")
        last_step = self._num_steps + math.ceil((duration + MAX_OVERTIME) / STEP_PERIOD)
        number = self.executor_state.number + 1
        context = self.executor.GetMyMutableContextFromRoot(self.root)
        self.executor.GetInputPort("plan").FixValue(context, PlannedMove(number, plan, schedule))
        if self.recorder is not None:
            self.recorder.clear()
        while self.finished_plan != number or not self.is_at_rest:
            if self._num_steps >= last_step:
                return
            self.step()
            yield self._tracking_error()

    def _has_displaced_objects(self, before: Scene) -> bool:
        """Return whether an awake object that was not held has moved too far.

        Args:
            before: Scene before the motion.
        """
        names = self._sleep.awake - {self.gripper.status.last_held}
        positions = self.station.scene_plant.positions(self.plant_context, names)
        distances = (np.linalg.norm(p - before[name].X_TO.p) for name, p in positions.items())
        return any(distance > MAX_COARSE_DISPLACEMENT for distance in distances)

    @property
    def has_just_started(self) -> bool:
        """Whether a plan has started at the end of the last step, with all objects asleep."""
        state = self.executor_state
        age = self._num_steps * STEP_PERIOD - state.start_time
        return state.plan is not None and abs(age) < _TIME_MARGIN and not self._sleep.awake

    def take_over(self, other: "StationSimulation") -> None:
        """Continue at the end of the plan that has just started, which another one has executed.

        All objects must be asleep in both simulations, and none held.

        Args:
            other: Simulation with the same cell and objects, whose only plan started at time 0 from
                the state of this one.
        """
        assert self.has_just_started
        assert other.is_asleep
        root, state = self.root, self.executor_state
        executed = replace(
            other.executor_state,
            number=state.number,
            start_time=state.start_time + other.executor_state.start_time,
        )
        self.executor.set_state(self.executor.GetMyMutableContextFromRoot(root), executed)
        self.station.copy_state(root, other.station, other.root)
        self.gripper.status = other.gripper.status
        self._affected_plan = state.number
        self._affected = other._affected
        # The step before the end, so that all systems notice the end when they would.
        self.skip_until(executed.end_time)
        if self.recorder is not None:
            self.recorder.skip(state.number)

    def _check_start(self, plan: Plan) -> None:
        """Raise an error unless a plan starts at the commanded joints and names known tools."""
        tools = self.cell.gripper.tools
        for step in plan.steps:
            if step.tool and step.tool not in tools:
                allowed = ", ".join(tools)
                raise InputError(
                    f"step {step.name!r}: tool {format_value(step.tool)}; expected one of {allowed}"
                )
        commanded = self._commanded_positions()
        start = np.array(plan.start.q)
        if start.shape != commanded.shape or np.abs(start - commanded).max() > MAX_START_ERROR:
            raise InputError(
                f"plan: starts at joints {format_value(start.round(4).tolist())}; expected those "
                f"of the arm, {format_value(commanded.round(4).tolist())}"
            )

    def _result(
        self,
        plan: Plan,
        moved: Sequence[SceneObject],
        before: Scene,
        max_tracking_error: float,
    ) -> PickPlaceResult:
        poses = self._poses()
        status = self.gripper.status
        names = {o.name for o in moved}
        return PickPlaceResult(
            plan=plan,
            poses=poses,
            grasped=status.has_held,
            drop_time=status.release_time,
            max_load_ratio=status.max_load_ratio,
            slip=status.slip,
            position_error=max(
                (float(np.linalg.norm((poses[o.name].p - o.X_TO.p)[:2])) for o in moved),
                default=0.0,
            ),
            orientation_error=max(
                (tilt_between(o.object_class, o.X_TO, poses[o.name]) for o in moved), default=0.0
            ),
            displacements={
                o.name: float(np.linalg.norm(poses[o.name].p - o.X_TO.p))
                for o in before.objects
                if o.name not in names
            },
            lowered_distance=self.executor_state.lowered_distance,
            max_tracking_error=max_tracking_error,
            simulated_time=self.root.get_time(),
            samples=self.recorded_samples(),
            missed_grasp=self.executor_state.missed_grasp,
            has_ended=self.finished_plan == self.executor_state.number and self.is_at_rest,
        )

    def recorded_samples(self) -> ActionSamples | None:
        """Return the samples since the last plan started; None without a rate or a plan."""
        if self.recorder is None or self.recorder.start_time is None:
            return None
        return self.recorder.samples(self._affected)

    def _tracking_error(self) -> float:
        q = self.station.joint_positions(self.plant_context)
        return float(np.abs(self._commanded_positions() - q).max())

    def _commanded_positions(self) -> NDArray[np.float64]:
        """Return the commanded joint positions of the arm [rad]. Shape (n,)."""
        command = self.executor.GetOutputPort("command")
        values = command.Eval(self.executor.GetMyContextFromRoot(self.root))
        return np.asarray(values[: len(values) // 3])

    def _commanded_tool(self, root: Context) -> str:
        """Return the name of the tool that is commanded to hold an object; "" for none."""
        context = self.executor.GetMyContextFromRoot(root)
        hold = self.executor.GetOutputPort("hold").Eval(context)
        return next(
            (
                name
                for name, on in zip(self.cell.gripper.tools, hold.tolist(), strict=True)
                if on > 0.5
            ),
            "",
        )


def execute_grips(
    simulation: StationSimulation,
    plan: PickPlacePlan,
    regrip: Regrip | None = None,
    max_grips: int = 1,
) -> PickPlaceResult:
    """Execute a plan, and plans with other grasps while the gripper does not grasp the object.

    Args:
        simulation: Simulation, with the arm at the start of the plan.
        plan: First plan.
        regrip: Plans with another grasp; None to execute only the first plan.
        max_grips: Largest number of plans that are executed.
    """
    tried = list[HeldObject]()
    while True:
        result = simulation.execute(plan)
        tried.append(plan.held)
        if not result.missed_grasp or regrip is None or len(tried) >= max_grips:
            break
        found = regrip(tried)
        if isinstance(found, PlanningFailure):
            break
        plan = found
    return replace(result, num_grips=len(tried))


def _moved_objects(plan: Plan) -> list[SceneObject]:
    """Return the objects that a plan moves, at their poses at its end."""
    held = {state.held.name for state in (plan.start, plan.end) if state.held}
    names = {step.object_name for step in plan.steps if step.object_name} | held
    return [o for o in plan.end.objects if o.name in names]


def simulate_coarsely(
    cell: WorkCell, scene: Scene, plan: Plan, *, rate: float | None = None
) -> StationSimulation:
    """Return a simulation of its own for a plan in which nothing unexpected should happen.

    The time step is `COARSE_TIME_STEP`, and only the objects that the plan may disturb can move.

    Args:
        cell: Work cell; its support is replaced by that of the scene.
        scene: Objects at rest.
        plan: Plan that is to be executed.
        rate: Samples per second [Hz]; None records nothing.
    """
    affected = affected_bodies(scene.objects, plan)
    movable = frozenset[str]().union(*affected)
    simulation = StationSimulation(
        cell, scene, movable=movable, time_step=COARSE_TIME_STEP, rate=rate
    )
    simulation.expect_first_plan(affected)
    return simulation


def simulate_plan(
    cell: WorkCell,
    scene: Scene,
    plan: PickPlacePlan,
    *,
    rate: float | None = None,
    regrip: Regrip | None = None,
    max_grips: int = 1,
) -> PickPlaceResult:
    """Execute a plan in a simulation of its own.

    At first it is simulated coarsely, see `simulate_coarsely`. If the move is not uneventful, or
    one of the fixed objects is hit, it is simulated again with `TIME_STEP` and all objects movable.

    Args:
        cell: Work cell; its support is replaced by that of the scene.
        scene: Objects at rest.
        plan: Plan to execute.
        rate: Samples per second [Hz]; None records nothing.
        regrip: See `execute_grips`.
        max_grips: See `execute_grips`.
    """
    coarse = simulate_coarsely(cell, scene, plan, rate=rate)
    coarse_result = coarse.execute_while_uneventful(plan)
    coarse.release()
    if coarse_result is not None:
        return coarse_result
    fine = StationSimulation(cell, scene, rate=rate)
    result = execute_grips(fine, plan, regrip, max_grips)
    fine.release()
    return result
