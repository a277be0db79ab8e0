"""The simulated station: the only place that advances the Diagram of the arm.

simulation = StationSimulation(cell, scene)
result = simulation.execute(plan)
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.scenes.interfaces import MotionSample
from drake_clutter.scenes.scene import Pose, Scene, tilt_between
from drake_clutter.station.body_sleep import BodySleepManager, affected_bodies, bodies_to_wake
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.gripper_actuator import GripperActuator, SuctionActuator
from drake_clutter.station.messages import PlannedMove
from drake_clutter.station.pick_place_executor import ExecutorState, PickPlaceExecutor

SETTLE_TIME = 0.1
"""Simulated after the arm is home [s]."""
STEP_PERIOD = 0.025
"""Between two decisions which objects are simulated [s]."""
TIME_STEP = STEP_PERIOD / 10
"""Of the plant [s]; with twice as much a high stack trembles as soon as it is free, and creeps
until it falls."""
POST_MOTION_WAIT = 1.0
"""After a plan's end, for which what has fallen is followed [s]."""

AddSystems = Callable[[DiagramBuilder, ClutterStation, PickPlaceExecutor], None]
"""Adds systems to a diagram and connects them; they own the executor's port `plan`."""

_ACTUATORS = {"suction": SuctionActuator}
"""By the gripper's kind."""


@dataclass(frozen=True)
class PickPlaceResult:
    """How a plan was carried out.

    Attributes:
        poses: X_TO by name, at the end.
        grasped: Whether the gripper held an object.
        drop_time: When the object came off by its load [s]; NaN if it did not.
        max_load_ratio: Largest load over what the gripper can bear.
        slip: Between gripper and object [m].
        position_error: Of the object's place, heights left out [m].
        orientation_error: Of its orientation [rad].
        displacements: How far each other object was moved, by name [m].
        lowered_distance: By which the object was let go below its planned pose [m].
        max_tracking_error: Largest error of a joint [rad].
        simulated_time: Simulated [s].
        motion: Recorded samples, if asked for.
    """

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
    motion: tuple[MotionSample, ...] = field(repr=False, default=())

    @property
    def lost_object(self) -> bool:
        """Whether the gripper did not hold the object all the way."""
        return not self.grasped or not math.isnan(self.drop_time)

    def __str__(self) -> str:
        if not self.grasped:
            return "the cup did not seal"
        if not math.isnan(self.drop_time):
            return f"came off the cup after {self.drop_time:.2f} s"
        millimeters, degrees = 1000 * self.position_error, math.degrees(self.orientation_error)
        return f"{millimeters:.1f} mm and {degrees:.1f} deg from where it was to be"


class StationSimulation:
    """The arm among the objects of a scene, in Drake.

    Objects that take no part in a motion are locked meanwhile.

    Attributes:
        cell: The cell, with the scene's support.
        station: Plant, geometry and position control.
        executor: Turns plans into commands.
        diagram: Both, and the systems that were added.
        simulator: Of the diagram.
        gripper: Takes objects and lets them go.
    """

    def __init__(
        self,
        cell: WorkCell,
        scene: Scene,
        *,
        weldable_object: str = "",
        visuals: bool = False,
        add_systems: AddSystems | None = None,
    ) -> None:
        """Build the diagram and put the objects of a scene in it.

        Args:
            cell: Everything else that stands there.
            scene: The objects, at rest.
            weldable_object: Name of the one object that the gripper can take, see `ClutterStation`.
            visuals: Whether cameras are to see the station.
            add_systems: What else is in the diagram; None: plans come by `execute`.
        """
        self.cell = cell.with_support(scene.support)
        builder = DiagramBuilder()
        classes = [(o.name, o.object_class) for o in scene.objects]
        self.station: ClutterStation = builder.AddNamedSystem(
            "clutter_station",
            ClutterStation(
                self.cell,
                classes,
                time_step=TIME_STEP,
                weldable_object=weldable_object,
                visuals=visuals,
            ),
        )
        self.executor = PickPlaceExecutor.AddToBuilder(builder, cell=self.cell)
        for source, target, port in (
            (self.executor, self.station, "command"),
            (self.station, self.executor, "bellows"),
        ):
            builder.Connect(source.GetOutputPort(port), target.GetInputPort(port))
        if add_systems is not None:
            add_systems(builder, self.station, self.executor)
        self.diagram: Diagram = builder.Build()
        make_actuator = _ACTUATORS[self.cell.gripper.kind]
        self.gripper: GripperActuator = make_actuator(self.station, self._is_suction_on)
        self._sleep = BodySleepManager(self.station)
        self.reset(scene)

    def reset(self, scene: Scene) -> None:
        """Begin anew at time 0: the arm is at home, the objects are at rest at their poses.

        Args:
            scene: The objects, by the names that the simulation was built with.
        """
        self._scene = scene
        # The first step initializes it, so that a plan that is there by then begins at time 0.
        self.simulator = Simulator(self.diagram)
        self.station.set_state(self.root, np.array(self.cell.robot.home), scene.objects)
        self.gripper.reset()
        self._sleep.reset(self.root)
        self._num_steps = 0
        self._affected = 0, set[str](), set[str]()  # number of a plan, at pick, at place
        self.simulator.set_monitor(self._monitor)

    @property
    def root(self) -> Context:
        """Context of the diagram."""
        return self.simulator.get_mutable_context()

    @property
    def plant_context(self) -> Context:
        """Context of the plant."""
        return self.station.plant_context(self.root)

    @property
    def scene(self) -> Scene:
        """The objects where they are now."""
        return self._scene.with_poses(self.station.scene_plant.poses(self.plant_context))

    @property
    def executor_state(self) -> ExecutorState:
        """The plan that is being carried out, or was last."""
        return self.executor.state(self.executor.GetMyContextFromRoot(self.root))

    @property
    def finished_plan(self) -> int:
        """Number of the plan that has ended; 0 while one is carried out."""
        port = self.executor.GetOutputPort("finished")
        return int(port.Eval(self.executor.GetMyContextFromRoot(self.root))[0])

    @property
    def is_executing(self) -> bool:
        """Whether a plan is being carried out."""
        return not self.executor_state.has_ended(self.root.get_time())

    def step(self) -> None:
        """Advance by `STEP`."""
        state, now = self.executor_state, self.root.get_time()
        wanted, must_hold = set[str](), False
        if state.plan is not None and state.schedule is not None:
            if state.number != self._affected[0]:
                self._affected = state.number, *affected_bodies(self.scene.objects, state.plan)
            elapsed = now - state.start_time
            wanted = bodies_to_wake(state.schedule, *self._affected[1:], elapsed)
            end = state.schedule.end_time + POST_MOTION_WAIT
            must_hold = state.schedule.suction_on_time + STEP_PERIOD <= elapsed < end
        self._sleep.update(self.root, wanted, self.gripper.status, expects_grasp=must_hold)
        self._num_steps += 1
        self.simulator.AdvanceTo(self._num_steps * STEP_PERIOD + TIME_STEP / 2)

    def run_until(self, condition: Callable[[], bool]) -> None:
        """Step until something is true; it is asked before each step."""
        while not condition():
            self.step()

    def sample(self) -> MotionSample:
        """Return where arm and objects are; the time is that since the latest plan began."""
        context = self.plant_context
        arm = self.station.arm_state(context, self._is_suction_on(self.root))
        time = self.root.get_time() - self.executor_state.start_time
        return MotionSample(time, self.station.scene_plant.poses(context), arm)

    def execute(self, plan: PickPlacePlan, *, record: bool = False) -> PickPlaceResult:
        """Carry a plan out, until the arm is home and all has come to rest.

        Args:
            plan: What to carry out; the diagram has no system that plans.
            record: Whether the result has the motion, a sample per step.
        """
        before, number = self.scene, self.executor_state.number + 1
        context = self.executor.GetMyMutableContextFromRoot(self.root)
        self.executor.GetInputPort("plan").FixValue(context, PlannedMove(number, plan))
        motion, tracking = list[MotionSample](), 0.0

        def at_rest() -> bool:
            if self.finished_plan != number:
                return False
            state = self.executor_state
            assert state.schedule is not None
            end = state.start_time + state.schedule.end_time
            return self._num_steps * STEP_PERIOD >= end + SETTLE_TIME

        while not at_rest():
            self.step()
            tracking = max(tracking, self._tracking_error())
            if record:
                motion.append(self.sample())
        return self._result(plan, before, tracking, tuple(motion))

    def _result(
        self, plan: PickPlacePlan, before: Scene, tracking: float, motion: tuple[MotionSample, ...]
    ) -> PickPlaceResult:
        poses, status = self.station.scene_plant.poses(self.plant_context), self.gripper.status
        place, wanted = poses[plan.pick], plan.X_TO_place
        return PickPlaceResult(
            poses=poses,
            grasped=status.has_held,
            drop_time=status.release_time,
            max_load_ratio=status.max_load_ratio,
            slip=status.slip,
            position_error=float(np.linalg.norm((place.p - wanted.p)[:2])),
            orientation_error=tilt_between(self.station.object_classes[plan.pick], wanted, place),
            displacements={
                o.name: float(np.linalg.norm(poses[o.name].p - o.X_TO.p))
                for o in before.objects
                if o.name != plan.pick
            },
            lowered_distance=self.executor_state.lowered_distance,
            max_tracking_error=tracking,
            simulated_time=self.root.get_time(),
            motion=motion,
        )

    def _tracking_error(self) -> float:
        command = self.executor.GetOutputPort("command")
        q = self.station.joint_positions(self.plant_context)
        wanted = command.Eval(self.executor.GetMyContextFromRoot(self.root))[: len(q)]
        return float(np.abs(wanted - q).max())

    def _is_suction_on(self, root: Context) -> bool:
        context = self.executor.GetMyContextFromRoot(root)
        return bool(self.executor.GetOutputPort("suction").Eval(context)[0] > 0.5)

    def _monitor(self, root: Context) -> EventStatus:
        self.gripper.update(root)
        return EventStatus.DidNothing()
