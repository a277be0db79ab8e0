"""The work cell as a Diagram: plant, geometry, the arm under position control, and the vacuum.

Switching the vacuum changes parameters of the plant, which no system may do to another: `Vacuum` is called as a simulation's
monitor.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus

from drake_clutter.arm.hold import HexapodHold, JointHold
from drake_clutter.arm.kinematics import JOINTS
from drake_clutter.arm.station import ArmConfig, add_arm, joint_numbers
from drake_clutter.arm.suction import load_share, unevenness
from drake_clutter.catalogue import ObjectClass
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.plant import ScenePlant, add_scene_plant, rigid_transform

Floats = NDArray[np.float64]

LETS_GO_AFTER = 0.02
"""s of overload: the time in which air gets in."""
STIFFNESS, DAMPING = 1e5, 2e3
"""N m/rad and N m s/rad of the joints' position control, as stiff as an industrial arm's."""


class ClutterStation(Diagram):
    """The arm among objects, of which one can be picked.

    Input ports: desired_state (12,) rad and rad/s; feed_forward (6,) N m.
    Output ports: state, of the whole plant; query, of the geometry.
    """

    def __init__(
        self,
        config: ArmConfig,
        objects: Sequence[tuple[str, ObjectClass]],
        pick: str,
        *,
        tray_side: float,
        camera_altitude: float,
        time_step: float,
        visuals: bool = False,
        hold: type[JointHold] | type[HexapodHold] = HexapodHold,
    ) -> None:
        """Builds it; objects are (name, class), `pick` the name of the one that the cup can take; `hold` how."""
        super().__init__()
        self.config, self.pick, self.classes, self.time_step = config, pick, dict(objects), time_step
        builder = DiagramBuilder()
        jointed = pick if hold is JointHold else ""
        self.scene: ScenePlant = add_scene_plant(builder, objects, tray_side, time_step, visuals=visuals, jointed=jointed)
        self.plant = plant = self.scene.plant
        self.arm = add_arm(plant, self.scene.scene_graph, config, camera_altitude, compliant=True)
        for name in JOINTS:
            plant.GetJointActuatorByName(name, self.arm.robot).set_controller_gains(PdControllerGains(p=STIFFNESS, d=DAMPING))
        self.hold = hold(plant, self.arm, self.scene.bodies[pick])
        plant.Finalize()
        self._q_at, self._v_at = joint_numbers(plant, self.arm)
        ports = (("desired_state", plant.get_desired_state_input_port), ("feed_forward", plant.get_actuation_input_port))
        for name, port in ports:
            builder.ExportInput(port(self.arm.robot), name)
        builder.ExportOutput(plant.get_state_output_port(), "state")
        builder.ExportOutput(self.scene.scene_graph.get_query_output_port(), "query")
        builder.BuildInto(self)

    def plant_context(self, root: Context) -> Context:
        """Of the plant, in the context of the diagram that holds the station."""
        return self.plant.GetMyMutableContextFromRoot(root)

    def set_scene(self, root: Context, q: Floats, objects: Sequence[SceneObject]) -> None:
        """Puts the arm at joint angles (6,) rad and the objects at their poses, all at rest."""
        context = self.plant_context(root)
        positions = self.plant.GetPositions(context)
        positions[self._q_at] = q
        self.plant.SetPositions(context, positions)
        self.plant.SetVelocities(context, np.zeros(self.plant.num_velocities()))
        self.hold.reset(context)
        for o in objects:
            if o.name == self.pick and isinstance(self.hold, JointHold):
                self.hold.put(context, rigid_transform(o.X_TO))
            else:
                self.plant.SetFreeBodyPose(context, self.scene.bodies[o.name], rigid_transform(o.X_TO))

    def joint_angles(self, context: Context) -> Floats:
        """(6,) rad, from the plant's context."""
        return np.asarray(self.plant.GetPositions(context)[self._q_at])

    def lock(self, root: Context, names: Sequence[str]) -> None:
        """Makes objects immovable that take no part; they must be at rest.

        What is locked no longer collides with the tray or with other locked objects: Drake crashes where it would penetrate them.
        """
        if not names:
            return
        context = self.plant_context(root)
        locked, fixed = GeometrySet(), GeometrySet()
        for name in names:
            locked.Add(self.plant.GetCollisionGeometriesForBody(self.scene.bodies[name]))
        for body in (self.plant.world_body(), self.plant.GetBodyByName("tray")):
            fixed.Add(self.plant.GetCollisionGeometriesForBody(body))
        manager = self.scene.scene_graph.collision_filter_manager(self.scene.scene_graph.GetMyMutableContextFromRoot(root))
        manager.ApplyTransient(CollisionFilterDeclaration().ExcludeBetween(locked, fixed).ExcludeWithin(locked))
        for name in names:
            (index,) = (i for i in self.plant.GetJointIndices(self.scene.bodies[name].model_instance()))
            self.plant.get_joint(index).Lock(context)


@dataclass
class Vacuum:
    """Switches the cup's hold on and off in a running simulation; to be called as its monitor.

    Attributes:
        station: whose cup.
        wanted: says, of the root context, whether the vacuum is to be on.
        held: whether the object hangs on the cup; sealed: whether it ever did; dropped: when it came off by its load, s.
        largest_share: of what the cup can bear, so far.
        overloaded: steps in a row.
    """

    station: ClutterStation
    wanted: Callable[[Context], bool]
    held: bool = False
    sealed: bool = False
    dropped: float = math.nan
    largest_share: float = 0.0
    overloaded: int = 0

    def __call__(self, root: Context) -> EventStatus:
        """The monitor."""
        station = self.station
        context = station.plant_context(root)
        wanted = self.wanted(root)
        if wanted and not self.held and math.isnan(self.dropped):
            X_TG = station.arm.cup.CalcPoseInWorld(context)
            X_TO = station.scene.bodies[station.pick].EvalPoseInWorld(context)
            X_OG = (X_TO.inverse() @ X_TG).GetAsMatrix4()
            config = station.config.suction
            if unevenness(station.classes[station.pick], X_OG, config.cup_diameter) <= config.unevenness:
                station.hold.attach(context)
                self.held = self.sealed = True
        elif self.held and not wanted:
            self._release(context)
        elif self.held:
            share = float(load_share(*station.hold.load(context), station.config.suction))
            self.largest_share = max(self.largest_share, share)
            self.overloaded = self.overloaded + 1 if share > 1 else 0
            if self.overloaded * station.time_step > LETS_GO_AFTER:
                self.dropped = root.get_time()
                self._release(context)
        return EventStatus.DidNothing()

    def _release(self, context: Context) -> None:
        self.station.hold.release(context)
        self.held = False
