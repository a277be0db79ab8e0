"""Moves by the arm: planned, simulated through the whole trajectory, and judged by what happened."""

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from drake_clutter.cell.support import Support
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig, SettleConfig
from drake_clutter.planning.attempts import PlannerConfig
from drake_clutter.planning.plan import NoPlan, Plan
from drake_clutter.planning.planner import PickPlacePlanner
from drake_clutter.scenes.geometry import carried, touching_groups
from drake_clutter.scenes.interfaces import (
    Frame,
    Instability,
    MoveResult,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, tilt_between
from drake_clutter.simulation.judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import fallen, settle
from drake_clutter.station.clutter_station import ClutterStation, Freedom, Vacuum
from drake_clutter.station.pick_place import DWELL, PickPlaceExecutor, Running, Schedule

Floats = NDArray[np.float64]

SETTLE_TIME = 0.1
"""s, that is simulated after the arm is home."""
_DESCENT_LOOK = 0.01
"""m, between the places at which a descent is looked at for what it may touch."""
UNTOUCHED = 1e-4
"""m; what moved less is not settled again."""
LOOK = 0.025
"""s, between two looks at what takes part."""
TIME_STEP = LOOK / 10
"""s, of the simulation; with twice as much a high stack trembles as soon as it is free, and creeps until it falls."""
AHEAD, LIFTED = 0.05, 0.15
"""s, before a contact, and after the dwell, for which the objects around are free to move; what does move stays free."""


@dataclass(frozen=True)
class Carried:
    """How a plan was carried out.

    Attributes:
        poses: X_TO by name, at the end.
        sealed: whether the cup sealed.
        dropped: s, when the object came off by its load; NaN if it did not.
        largest_share: of what the cup can bear. slip: m, between cup and object.
        place_error: m, and turn_error: rad, of where the object came to lie from where it was to be let go; heights left out.
        displaced: m, by name, how far each other object was moved.
        tracking: rad, largest error of a joint.
        time: s simulated.
        motion: frames, if asked for.
    """

    poses: dict[str, Pose]
    sealed: bool
    dropped: float
    largest_share: float
    slip: float
    place_error: float
    turn_error: float
    displaced: dict[str, float]
    tracking: float
    time: float
    motion: tuple[Frame, ...] = field(repr=False, default=())

    def __str__(self) -> str:
        if not self.sealed:
            return "the cup did not seal"
        if not math.isnan(self.dropped):
            return f"came off the cup after {self.dropped:.2f} s"
        return f"{1000 * self.place_error:.1f} mm and {math.degrees(self.turn_error):.1f} deg from where it was to be"


def nearest(objects: Sequence[SceneObject], X_TO: Pose) -> SceneObject:
    """The object whose origin is nearest to that of a pose: what is really there, whatever the planner takes it for."""
    return min(objects, key=lambda o: float(np.linalg.norm(o.X_TO.p - X_TO.p)))


def disturbed_by(objects: Sequence[SceneObject], plan: Plan) -> tuple[set[str], set[str]]:
    """The names of what picking, and of what placing may disturb: the stacks that are taken from, put on, or come close to.

    The picked one is among both.
    """
    picked = nearest(objects, plan.X_TO_pick)
    X_TO_place = carried(plan.X_TO_pick, plan.X_TO_place, picked.X_TO)
    lowered = np.linspace(0.0, plan.depth, math.ceil(plan.depth / _DESCENT_LOOK) + 1)
    placed = [replace(picked, X_TO=X_TO_place.moved((0.0, 0.0, -height))) for height in lowered.tolist()]
    groups = touching_groups(objects, TOUCHING_MARGIN)

    def near(ends: Sequence[SceneObject]) -> set[str]:
        def close(o: SceneObject) -> bool:
            return o is not picked and any(len(touching_groups([end, o], TOUCHING_MARGIN)) == 1 for end in ends)

        return {picked.name, *(o.name for group in groups if any(close(o) for o in group) for o in group)}

    return near([picked]), near(placed)


def taking_part(schedule: Schedule, beside_pick: Set[str], beside_place: Set[str], time: float) -> set[str]:
    """The names of what may move at a time since a plan was begun, s; see `disturbed_by`."""
    on, off = schedule.suction_on - AHEAD, schedule.descent_start - AHEAD
    wanted = set[str]()
    if on <= time <= schedule.suction_on + DWELL + LIFTED:
        wanted |= beside_pick
    if off <= time <= schedule.suction_off + DWELL + LIFTED:
        wanted |= beside_place
    return wanted


class ArmSimulation:
    """One plan among objects, in Drake. What takes no part at a time is locked then."""

    def __init__(
        self,
        cell: WorkCell,
        scene: Scene,
        plan: Plan,
        *,
        time_step: float = TIME_STEP,
        jointed: bool = False,
    ) -> None:
        """Builds the diagram; `jointed`: the cup holds by a joint, see `JointHold`."""
        self.cell, self._objects, self._plan, self._time_step = cell.with_support(scene.support), scene.objects, plan, time_step
        builder = DiagramBuilder()
        classes = [(o.name, o.object_class) for o in scene.objects]
        self.station = builder.AddSystem(
            ClutterStation(
                self.cell,
                classes,
                time_step=time_step,
                jointed=plan.pick if jointed else "",
            )
        )
        self.executor = PickPlaceExecutor.AddToBuilder(builder, cell=self.cell)
        source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(plan)))
        builder.Connect(source.get_output_port(), self.executor.GetInputPort("plan"))
        builder.Connect(self.executor.GetOutputPort("command"), self.station.GetInputPort("command"))
        builder.Connect(self.station.GetOutputPort("bellows"), self.executor.GetInputPort("bellows"))
        self.diagram: Diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self._suction = self.executor.GetOutputPort("suction")
        self.vacuum = Vacuum(self.station, self._vacuum_wanted)

    @property
    def running(self) -> Running:
        """What the executor is doing now."""
        return self.executor.running(self.executor.GetMyContextFromRoot(self.simulator.get_context()))

    def _vacuum_wanted(self, root: Context) -> bool:
        return bool(self._suction.Eval(self.executor.GetMyContextFromRoot(root))[0] > 0.5)

    def run(self, *, record: bool = False) -> Carried:
        """Simulates until the arm is home again and all has come to rest."""
        root, station = self.simulator.get_mutable_context(), self.station
        context, command = station.plant_context(root), self.executor.GetOutputPort("command")
        station.set_scene(root, np.array(self.cell.robot.home), self._objects)
        self.simulator.set_monitor(self.vacuum)
        beside_pick, beside_place = disturbed_by(self._objects, self._plan)
        motion, tracking, freedom = list[Frame](), 0.0, Freedom(station, self.vacuum)
        freedom.begin(root)
        self.simulator.Initialize()
        k, schedule = 0, self.running.schedule
        assert schedule is not None, "the executor begins with the plan that it is given"
        while k * LOOK < schedule.end + SETTLE_TIME:
            k += 1
            time = root.get_time()
            wanted = taking_part(schedule, beside_pick, beside_place, time)
            freedom.update(root, wanted, must_hold=time >= schedule.suction_on + LOOK)
            self.simulator.AdvanceTo(k * LOOK + self._time_step / 2)
            now = command.Eval(self.executor.GetMyContextFromRoot(root))[:6]
            tracking = max(tracking, float(np.abs(now - station.joint_angles(context)).max()))
            schedule = self.running.schedule or schedule  # a descent that has ended makes another
            if record:
                state = station.arm_state(context, self._vacuum_wanted(root))
                motion.append(Frame(root.get_time(), station.scene.poses(context), state))
        return self._judged(context, tracking, tuple(motion))

    def _judged(self, context: Context, tracking: float, motion: tuple[Frame, ...]) -> Carried:
        poses = self.station.scene.poses(context)
        at, wanted, objects = poses[self._plan.pick], self._plan.X_TO_place, {o.name: o for o in self._objects}
        return Carried(
            poses=poses,
            sealed=self.vacuum.sealed,
            dropped=self.vacuum.dropped,
            largest_share=self.vacuum.largest_share,
            slip=self.vacuum.slip,
            place_error=float(np.linalg.norm((at.p - wanted.p)[:2])),
            turn_error=tilt_between(objects[self._plan.pick].object_class, wanted, at),
            displaced={n: float(np.linalg.norm(poses[n].p - o.X_TO.p)) for n, o in objects.items() if n != self._plan.pick},
            tracking=tracking,
            time=context.get_time(),
            motion=motion,
        )


class ArmExecutor:
    """Carries out a move at fidelity `arm` (a `MoveExecutor`): planned, simulated through the whole trajectory, and judged.

    What the motion touched is settled afterwards as the judge settles. A scene has collapsed when any object but the picked one
    has moved or turned past the limits, or the picked one past them from where it was let go.
    """

    def __init__(self, config: ClutterConfig, *, planner: PlannerConfig | None = None) -> None:
        """Makes an executor."""
        self._config = config
        self._planner_config = planner or PlannerConfig()
        self._planner: PickPlacePlanner | None = None

    def plan(self, scene: Scene, command: PickPlaceCommand) -> Plan | NoPlan:
        """Return the plan for a command, or why there is none."""
        planner = self.planner(scene.support)
        return planner.plan(scene.objects, command.move.pick, command.X_TO_place)

    def planner(self, support: Support) -> PickPlacePlanner:
        """For a tray; kept."""
        if self._planner is None or self._planner.cell.support != support:
            self._planner = PickPlacePlanner(self._config.cell.with_support(support), self._planner_config)
        return self._planner

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`."""
        plan = self.plan(scene, command)
        if isinstance(plan, NoPlan):
            return Outcome(MoveResult.NOT_PLANNED, scene, detail=str(plan))
        simulation = ArmSimulation(self._config.cell, scene, plan)
        told = simulation.run(record=True)
        came_off = not told.sealed or not math.isnan(told.dropped)
        X_TO_place = plan.X_TO_place.moved((0.0, 0.0, -simulation.running.lowered))
        outcome = judged(
            scene,
            scene.at(told.poses),
            command.move.pick,
            X_TO_place,
            came_off,
            self._config.settle,
        )
        return replace(outcome, motion=told.motion, detail=str(told))


def judged(before: Scene, after: Scene, pick: str, X_TO_place: Pose, came_off: bool, config: SettleConfig) -> Outcome:
    """What a motion of the arm has led to: what it touched is settled, and everything compared with where it should be.

    Args:
        before, after: the scene, at rest and after the motion.
        pick: what was picked; X_TO_place: where it was to be let go; came_off: whether it came off the cup on the way.
        config: the limits.
    """
    put = before.at({pick: X_TO_place})
    # What comes off the cup only as it touches down, and stays there, has been put down.
    dropped = came_off and worst_fall([put[pick]], after, config) is not None
    others = [o for o in put.objects if o.name != pick or not dropped]
    instability = worst_fall(others, after, config)
    if instability is None and not dropped:
        moved = {o.name for o in before.objects if np.linalg.norm(after[o.name].X_TO.p - o.X_TO.p) > UNTOUCHED} | {pick}
        for group in touching_groups(after.objects, TOUCHING_MARGIN):
            if not moved.isdisjoint(o.name for o in group):
                after = after.at(settle(group, before.support, config).poses)
        instability = worst_fall(others, after, config)
    result = MoveResult.DROPPED if dropped else MoveResult.PLACED
    if instability is not None:
        result = MoveResult.COLLAPSED
    return Outcome(result, after, instability, released=X_TO_place)


def worst_fall(before: Sequence[SceneObject], after: Scene, config: SettleConfig) -> Instability | None:
    """Of the objects that did not stay where they were, the one that went furthest."""
    found = [fall for o in before if (fall := fallen(o, after[o.name].X_TO, after.support, config))]
    return max(found, key=lambda fall: fall.displacement, default=None)
