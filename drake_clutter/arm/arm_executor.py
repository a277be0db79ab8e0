"""Moves by the arm: planned, simulated through the whole trajectory, and judged by what happened."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantValueSource

from drake_clutter.arm.clutter_station import ClutterStation, Vacuum
from drake_clutter.arm.pick_place import PickPlaceExecutor, scheduled
from drake_clutter.arm.planner import Plan
from drake_clutter.arm.station import ArmConfig
from drake_clutter.scenes.geometry import touching_groups
from drake_clutter.scenes.scene import Pose, Scene, SceneObject, tilt_between
from drake_clutter.scenes.seams import Frame

Floats = NDArray[np.float64]

NEAR = 0.02
"""m; objects closer than that to where something is picked or put take part, with all that they touch."""
SETTLE_TIME = 0.5
"""s, that is simulated after the arm is home."""


@dataclass(frozen=True)
class Carried:
    """How a plan was carried out.

    Attributes:
        poses: X_TO by name, at the end.
        sealed: whether the cup sealed.
        dropped: s, when the object came off by its load; NaN if it did not.
        largest_share: of what the cup can bear.
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
    place_error: float
    turn_error: float
    displaced: dict[str, float]
    tracking: float
    time: float
    motion: tuple[Frame, ...] = field(repr=False, default=())


def taking_part(objects: Sequence[SceneObject], plan: Plan) -> set[str]:
    """The names of the objects that the move may disturb: the stacks that it takes from, puts on, or comes close to."""
    picked = next(o for o in objects if o.name == plan.pick)
    placed = SceneObject("", picked.object_class, plan.X_TO_place)
    found = {plan.pick}
    for group in touching_groups(objects, 0.003):
        if any(len(touching_groups([end, o], NEAR)) == 1 for end in (picked, placed) for o in group):
            found |= {o.name for o in group}
    return found


class ArmSimulation:
    """One plan among objects, in Drake."""

    def __init__(
        self, config: ArmConfig, scene: Scene, plan: Plan, *, camera_altitude: float, time_step: float = 0.005, visuals: bool = False
    ) -> None:
        """Builds the diagram."""
        self.config, self._objects, self._plan, self._time_step = config, scene.objects, plan, time_step
        builder = DiagramBuilder()
        classes = [(o.name, o.object_class) for o in scene.objects]
        self.station = builder.AddSystem(
            ClutterStation(
                config,
                classes,
                plan.pick,
                tray_side=scene.tray_side,
                camera_altitude=camera_altitude,
                time_step=time_step,
                visuals=visuals,
            )
        )
        self.executor = PickPlaceExecutor.AddToBuilder(builder, config=config)
        source = builder.AddSystem(ConstantValueSource(AbstractValue.Make(plan)))
        builder.Connect(source.get_output_port(), self.executor.GetInputPort("plan"))
        for name in ("desired_state", "feed_forward"):
            builder.Connect(self.executor.GetOutputPort(name), self.station.GetInputPort(name))
        self.diagram: Diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self._suction = self.executor.GetOutputPort("suction")
        self.vacuum = Vacuum(self.station, self._vacuum_wanted)

    def _vacuum_wanted(self, root: Context) -> bool:
        return bool(self._suction.Eval(self.executor.GetMyContextFromRoot(root))[0] > 0.5)

    def run(self, *, record: bool = False) -> Carried:
        """Simulates until the arm is home again and all has come to rest."""
        root = self.simulator.get_mutable_context()
        context = self.station.plant_context(root)
        self.station.set_scene(root, np.array(self.config.home), self._objects)
        part = taking_part(self._objects, self._plan)
        self.station.lock(root, [o.name for o in self._objects if o.name not in part])
        self.simulator.set_monitor(self.vacuum)
        self.simulator.Initialize()
        end = scheduled(self._plan, self.config).end + SETTLE_TIME
        motion, tracking = list[Frame](), 0.0
        for k in range(1, math.ceil(end / 0.025) + 1):
            self.simulator.AdvanceTo(k * 0.025 + self._time_step / 2)
            wanted = self.executor.GetOutputPort("desired_state").Eval(self.executor.GetMyContextFromRoot(root))[:6]
            tracking = max(tracking, float(np.abs(wanted - self.station.joint_angles(context)).max()))
            if record:
                motion.append(Frame(root.get_time(), self.station.scene.poses(context)))
        return self._judged(context, tracking, tuple(motion))

    def _judged(self, context: Context, tracking: float, motion: tuple[Frame, ...]) -> Carried:
        poses = self.station.scene.poses(context)
        at, wanted, objects = poses[self._plan.pick], self._plan.X_TO_place, {o.name: o for o in self._objects}
        return Carried(
            poses,
            self.vacuum.sealed,
            self.vacuum.dropped,
            self.vacuum.largest_share,
            float(np.linalg.norm((at.p - wanted.p)[:2])),
            tilt_between(objects[self._plan.pick].object_class, wanted, at),
            {n: float(np.linalg.norm(poses[n].p - o.X_TO.p)) for n, o in objects.items() if n != self._plan.pick},
            tracking,
            context.get_time(),
            motion,
        )
