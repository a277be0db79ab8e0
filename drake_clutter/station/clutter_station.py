"""The work cell as a Diagram: plant, geometry, the arm under position control, and the vacuum.

Switching the vacuum changes parameters of the plant, which no system may do to another: `Vacuum` is called as a simulation's
monitor.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, FilterId, GeometrySet, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PdControllerGains, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus
from pydrake.systems.primitives import Demultiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_clutter.catalogue import ObjectClass
from drake_clutter.cell.kinematics import JOINTS
from drake_clutter.cell.plant import Arm, add_work_cell, joint_numbers
from drake_clutter.cell.suction import surface_under_lip
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.scenes.interfaces import ArmState
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.plant import ScenePlant, add_scene_plant, populated, rigid_transform
from drake_clutter.station.hold import HexapodHold, Hold, JointHold

Floats = NDArray[np.float64]

LOAD_PERIOD = 0.01
"""s, of the looks at what the cup bears, and at whether the vacuum is wanted."""
LETS_GO_AFTER = 0.02
"""s of overload: the time in which air gets in."""
SUCKED_FROM = 0.005
"""m between lip and surface, at most, for the vacuum to take hold."""
STIFFNESS, DAMPING = 1e5, 2e3
"""N m/rad and N m s/rad of the joints' position control, as stiff as an industrial arm's."""


class ClutterStation(Diagram):
    """The arm among objects.

    Input port: command (18,), desired state, rad and rad/s, and feed-forward torque, N m.
    Output ports: state, of the whole plant; body_poses, of all its bodies; bellows (2,), how far they are pulled out, m, and
        how fast, m/s; with visuals query, of `camera_scene_graph`.

    Attributes:
        camera_scene_graph: the geometry that cameras see, or None: apart from that of the contacts, as renderers that are told of
            poses at every step take more time than the step does.
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        *,
        time_step: float,
        jointed: str = "",
        visuals: bool = False,
    ) -> None:
        """Builds it.

        Args:
            cell: what stands around.
            objects: name and class of each.
            time_step: s.
            jointed: the name of the one object that the cup can take, by a `JointHold`; none: it takes any, by a `HexapodHold`.
            visuals: whether cameras are to see it.
        """
        super().__init__()
        self.cell, self.classes, self.time_step = cell, dict(objects), time_step
        self._jointed = jointed
        builder = DiagramBuilder()
        self.scene: ScenePlant = add_scene_plant(builder, objects, cell.support, time_step, visuals=False, jointed=jointed)
        self.plant = plant = self.scene.plant
        self.arm = add_work_cell(plant, self.scene.scene_graph, cell, compliant=True, visuals=False)
        for name in JOINTS:
            plant.GetJointActuatorByName(name, self.arm.robot).set_controller_gains(PdControllerGains(p=STIFFNESS, d=DAMPING))
        self.hold = _hold(plant, self.arm, self.scene.bodies, jointed)
        plant.Finalize()
        bodies = self.scene.bodies.items()
        lockable = [(n, b) for n, b in bodies if n != jointed]
        self._joints = {n: plant.get_joint(i) for n, b in lockable for i in plant.GetJointIndices(b.model_instance())}
        self._name_of = {int(body.index()): name for name, body in self.scene.bodies.items()}
        self._locked_filter: FilterId | None = None
        self._q_at, self._v_at = joint_numbers(plant, self.arm)
        command = builder.AddSystem(Demultiplexer(np.array([12, 6])))
        builder.ExportInput(command.get_input_port(), "command")
        builder.Connect(command.get_output_port(0), plant.get_desired_state_input_port(self.arm.robot))
        builder.Connect(command.get_output_port(1), plant.get_actuation_input_port(self.arm.robot))
        builder.ExportOutput(plant.get_state_output_port(), "state")
        builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
        builder.ExportOutput(plant.get_state_output_port(self.arm.tool), "bellows")
        self.camera_scene_graph = self._add_camera_geometry(builder, objects) if visuals else None
        builder.BuildInto(self)

    def _add_camera_geometry(self, builder: DiagramBuilder, objects: Sequence[tuple[str, ObjectClass]]) -> SceneGraph:
        """Adds the geometry that cameras see: of a twin of the plant, which is never simulated, in the plant's state."""
        twin, seen = MultibodyPlant(self.time_step), builder.AddNamedSystem("camera_scene_graph", SceneGraph())
        twin.RegisterAsSourceForSceneGraph(seen)
        bodies = populated(twin, seen, objects, self.cell.support, visuals=True, jointed=self._jointed).bodies
        arm = add_work_cell(twin, seen, self.cell, compliant=True, visuals=True)
        _hold(twin, arm, bodies, self._jointed)  # with it the states are alike
        twin.Finalize()
        poses = builder.AddNamedSystem("poses", MultibodyPositionToGeometryPose(twin, input_multibody_state=True))
        builder.Connect(self.plant.get_state_output_port(), poses.get_input_port())
        builder.Connect(poses.get_output_port(), seen.get_source_pose_port(twin.get_source_id()))
        builder.ExportOutput(seen.get_query_output_port(), "query")
        return seen

    @property
    def takeable(self) -> tuple[str, ...]:
        """The objects that the cup can take."""
        return (self._jointed,) if self._jointed else tuple(self.classes)

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
            if isinstance(self.hold, JointHold) and o.name == self._jointed:
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

    def touched(self, context: Context) -> set[str]:
        """The names of objects that touch the arm, its tool, or another object, from the plant's context.

        Locked objects touch nothing but what is not locked: so of them, those that something free or the arm has run into.
        """
        results = self.plant.get_contact_results_output_port().Eval(context)
        surfaces = (results.hydroelastic_contact_info(i).contact_surface() for i in range(results.num_hydroelastic_contacts()))
        pairs = [(surface.id_M(), surface.id_N()) for surface in surfaces]
        points = (results.point_pair_contact_info(i) for i in range(results.num_point_pair_contacts()))
        bodies = [{self._name_of.get(b, "") for b in (int(p.bodyA_index()), int(p.bodyB_index()))} for p in points]
        inspector = self.scene.scene_graph.model_inspector()
        for pair in pairs:
            found = (self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)) for geometry in pair)
            bodies.append({self._name_of.get(int(body.index()), "") for body in found if body is not None})
        return set().union(*bodies) - {""}

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


def _hold(plant: MultibodyPlant, arm: Arm, bodies: Mapping[str, RigidBody], jointed: str) -> Hold:
    """For the one object that is jointed, or for any."""
    return JointHold(plant, arm, bodies[jointed]) if jointed else HexapodHold(plant, arm)


@dataclass
class Vacuum:
    """Switches the cup's hold on and off in a running simulation; to be called as its monitor.

    Attributes:
        station: whose cup.
        wanted: says, of the root context, whether the vacuum is to be on.
        held: the name of the object that hangs on the cup, or "".
        taken: the name of the one that did since the vacuum was last switched on, or "".
        sealed: whether one did since the vacuum was last switched on; dropped: when it came off by its load since then, s.
        largest_share: of what the cup can bear, since then.
        slip: m, between cup and object from when it was taken to when it was let go.
    """

    station: ClutterStation
    wanted: Callable[[Context], bool]
    held: str = ""
    taken: str = ""
    sealed: bool = False
    dropped: float = math.nan
    largest_share: float = 0.0
    slip: float = math.nan
    _on: bool = False
    _overloaded: int = 0  # looks in a row
    _looked: float = -math.inf  # s

    def __call__(self, root: Context) -> EventStatus:
        """The monitor."""
        station, time = self.station, root.get_time()
        if 0 <= time - self._looked < LOAD_PERIOD - station.time_step / 2:
            return EventStatus.DidNothing()
        self._looked = time
        context = station.plant_context(root)
        wanted = self.wanted(root)
        if wanted and not self._on:
            self.sealed, self.dropped, self.largest_share, self.slip, self._overloaded = False, math.nan, 0.0, math.nan, 0
            self.taken = ""
        self._on = wanted
        if wanted and not self.held and math.isnan(self.dropped):
            self._take(context)
        elif self.held and not wanted:
            self._release(context)
        elif self.held:
            share = float(station.cell.gripper.load_ratio(*station.hold.load(context)))
            self.largest_share = max(self.largest_share, share)
            self._overloaded = self._overloaded + 1 if share > 1 else 0
            if self._overloaded * LOAD_PERIOD > LETS_GO_AFTER:
                self.dropped = time
                self._release(context)
        return EventStatus.DidNothing()

    def _grasp(self, context: Context, name: str) -> RigidTransform:
        """X_OG."""
        X_TG = self.station.arm.cup.CalcPoseInWorld(context)
        X_TO = self.station.scene.bodies[name].EvalPoseInWorld(context)
        return X_TO.inverse() @ X_TG

    def _take(self, context: Context) -> None:
        """Takes the object that is first under the lip, if it is close enough and the lip seals on it."""
        station, suction = self.station, self.station.cell.gripper
        grasps = {name: self._grasp(context, name) for name in station.takeable}
        below = {n: surface_under_lip(station.classes[n], X_OG, suction.cup_diameter).min() for n, X_OG in grasps.items()}
        first = min(below, key=lambda name: below[name])
        if below[first] <= SUCKED_FROM and suction.seals(station.classes[first], grasps[first]):
            station.hold.attach(context, station.scene.bodies[first])
            self.held, self.taken, self.sealed, self._X_OG = first, first, True, grasps[first]

    def _release(self, context: Context) -> None:
        self.slip = float(np.linalg.norm(self._grasp(context, self.held).translation() - self._X_OG.translation()))
        self.station.hold.release(context)
        self.held = ""


class Freedom:
    """Which objects may move, look by look: the others are locked, which makes the simulation ten times cheaper.

    Attributes:
        free: names of those that may.
    """

    AT_REST = 0.002
    """m/s; of an object that was free for some looks, on their average: contact may make it tremble without getting anywhere."""
    LOOKS = 4

    def __init__(self, station: ClutterStation, vacuum: Vacuum) -> None:
        self._station, self._vacuum = station, vacuum
        self.free = set[str]()
        self._before = deque[tuple[float, dict[str, Floats]]](maxlen=self.LOOKS)
        self._hit = deque[set[str]](maxlen=self.LOOKS)

    def begin(self, root: Context) -> None:
        """Locks all."""
        self._station.lock_all_but(root, self.free)

    def update(self, root: Context, wanted: Set[str], *, must_hold: bool) -> None:
        """Frees what is wanted, what is held, and what still moves.

        Args:
            root: of the simulation.
            wanted: names.
            must_hold: whether the cup is holding something, if all went well; if it does not, what falls may hit anything.
        """
        moving = {name for name, speed in self._speeds(root).items() if speed > self.AT_REST}
        lost = not math.isnan(self._vacuum.dropped) or (must_hold and not self._vacuum.sealed)
        held = {self._vacuum.held} - {""}
        # What is run into is freed as well, for long enough to see whether it moves: locked it would stand like a rock.
        self._hit.append(self._station.touched(self._station.plant_context(root)) - self.free if self.free else set())
        free = set(self._station.classes) if lost else {*wanted, *moving, *held}.union(*self._hit)
        if free != self.free:
            self._station.lock_all_but(root, free)
            self.free = free

    def _speeds(self, root: Context) -> dict[str, float]:
        """Of what is free, m/s."""
        scene, context, time = self._station.scene, self._station.plant_context(root), root.get_time()
        speeds, places = scene.speeds(context, self.free), {n: X_TO.p for n, X_TO in scene.poses(context, self.free).items()}
        if len(self._before) == self.LOOKS:
            then, earlier = self._before[0]
            speeds |= {n: float(np.linalg.norm(p - earlier[n])) / (time - then) for n, p in places.items() if n in earlier}
        self._before.append((time, places))
        return speeds
