"""The work cell as a Diagram: plant, geometry, the arm under position control, and the vacuum.

Switching the vacuum changes parameters of the plant, which no system may do to another: `Vacuum` is called as a simulation's
monitor.
"""

import math
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, FilterId, GeometrySet
from pydrake.multibody.tree import PdControllerGains
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus

from drake_clutter.arm.hold import HexapodHold, HoldMaker, JointHold
from drake_clutter.arm.kinematics import JOINTS
from drake_clutter.arm.station import ArmConfig, add_arm, joint_numbers
from drake_clutter.arm.suction import load_share, unevenness
from drake_clutter.catalogue import ObjectClass
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.scenes.seams import ArmState
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
        hold: HoldMaker = HexapodHold,
    ) -> None:
        """Builds it; objects are (name, class), `pick` the name of the one that the cup can take; `hold` how."""
        super().__init__()
        self.config, self.pick, self.classes, self.time_step = config, pick, dict(objects), time_step
        builder = DiagramBuilder()
        jointed = pick if hold is JointHold else ""
        self.scene: ScenePlant = add_scene_plant(builder, objects, tray_side, time_step, visuals=False, jointed=jointed)
        self.plant = plant = self.scene.plant
        self.arm = add_arm(plant, self.scene.scene_graph, config, camera_altitude, compliant=True)
        for name in JOINTS:
            plant.GetJointActuatorByName(name, self.arm.robot).set_controller_gains(PdControllerGains(p=STIFFNESS, d=DAMPING))
        self.hold = hold(plant, self.arm, self.scene.bodies[pick])
        plant.Finalize()
        bodies = self.scene.bodies.items()
        lockable = [(n, b) for n, b in bodies if n != jointed]
        self._joints = {n: plant.get_joint(i) for n, b in lockable for i in plant.GetJointIndices(b.model_instance())}
        self._locked_filter: FilterId | None = None
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

    def arm_state(self, context: Context, suction: bool) -> ArmState:
        """From the plant's context, with the torques of the last step."""
        torque = self.plant.get_net_actuation_output_port(self.arm.robot).Eval(context)
        q, v = self.joint_angles(context), self.plant.GetVelocities(context)[self._v_at]
        return ArmState(tuple(q.tolist()), tuple(v.tolist()), tuple(torque.tolist()), suction)

    def lock_all_but(self, root: Context, free: Set[str]) -> None:
        """Makes all objects immovable but some. Those that were free must be at rest: what is locked stands still.

        What is locked no longer collides with the tray or with other locked objects: Drake crashes where it would penetrate them.
        """
        context = self.plant_context(root)
        locked, fixed = GeometrySet(), GeometrySet()
        for body in (self.plant.world_body(), self.plant.GetBodyByName("tray")):
            fixed.Add(self.plant.GetCollisionGeometriesForBody(body))
        for name, joint in self._joints.items():
            if name in free:
                continue
            locked.Add(self.plant.GetCollisionGeometriesForBody(self.scene.bodies[name]))
            if not joint.is_locked(context):
                velocities, start = self.plant.GetVelocities(context), joint.velocity_start()
                velocities[start : start + 6] = 0.0
                self.plant.SetVelocities(context, velocities)
                joint.Lock(context)
        scene_graph = self.scene.scene_graph
        manager = scene_graph.collision_filter_manager(scene_graph.GetMyMutableContextFromRoot(root))
        before = self._locked_filter
        self._locked_filter = manager.ApplyTransient(
            CollisionFilterDeclaration().ExcludeBetween(locked, fixed).ExcludeWithin(locked)
        )
        if before is not None:
            manager.RemoveDeclaration(before)
        for name in free & self._joints.keys():
            if self._joints[name].is_locked(context):
                self._joints[name].Unlock(context)


@dataclass
class Vacuum:
    """Switches the cup's hold on and off in a running simulation; to be called as its monitor.

    Attributes:
        station: whose cup.
        wanted: says, of the root context, whether the vacuum is to be on.
        held: whether the object hangs on the cup; sealed: whether it ever did; dropped: when it came off by its load, s.
        largest_share: of what the cup can bear, so far.
        overloaded: steps in a row.
        slip: m, between cup and object from when it was taken to when it was let go.
    """

    station: ClutterStation
    wanted: Callable[[Context], bool]
    held: bool = False
    sealed: bool = False
    dropped: float = math.nan
    largest_share: float = 0.0
    overloaded: int = 0
    slip: float = math.nan

    def __call__(self, root: Context) -> EventStatus:
        """The monitor."""
        station = self.station
        context = station.plant_context(root)
        wanted = self.wanted(root)
        if wanted and not self.held and math.isnan(self.dropped):
            X_OG = self._grasp(context)
            config = station.config.suction
            if unevenness(station.classes[station.pick], X_OG, config.cup_diameter) <= config.unevenness:
                station.hold.attach(context)
                self._X_OG = X_OG
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

    def _grasp(self, context: Context) -> Floats:
        """X_OG, (4, 4)."""
        X_TG = self.station.arm.cup.CalcPoseInWorld(context)
        X_TO = self.station.scene.bodies[self.station.pick].EvalPoseInWorld(context)
        return np.asarray((X_TO.inverse() @ X_TG).GetAsMatrix4())

    def _release(self, context: Context) -> None:
        self.slip = float(np.linalg.norm(self._grasp(context)[:3, 3] - self._X_OG[:3, 3]))
        self.station.hold.release(context)
        self.held = False
