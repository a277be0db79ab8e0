"""Work cell as a Drake Diagram: plant, scene graph and position-controlled arm."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.cell_plant import (
    Arm,
    add_work_cell,
    joint_state_indices,
    set_position_gains,
)
from drake_clutter.simulation.scene_plant import (
    ScenePlant,
    add_fixed_objects,
    add_objects,
    add_scene_plant,
    rigid_transform,
)
from drake_clutter.station.grasp_constraint import (
    CompliantGrasp,
    GraspConstraint,
    WeldGrasp,
    WeldPair,
)
from drake_clutter.station.vacuum_system import VacuumSystem

Floats = NDArray[np.float64]


class ClutterStation(Diagram):
    """Simulated work cell with arm, gripper and objects.

    .. pydrake_system::

        name: ClutterStation
        input_ports:
        - command
        - gripper_command
        - hold
        output_ports:
        - state
        - body_poses
        - gripper_state
        - vacuum
        - query

    Input ports:
        command: Desired positions [rad], desired velocities [rad/s] and feed-forward torques [N m]
            of n joints. Shape (3 n,).

        gripper_command: Desired positions [m], then desired velocities [m/s] of the m actuated
            joints of the gripper. Shape (2 m,).

        hold: See `VacuumSystem`. Only with suction cups.

    Output ports:
        state: State of the plant. Shape (num_multibody_states,).
        body_poses: Poses of all bodies of the plant in the world, a list of `RigidTransform`.
        gripper_state: Positions, then velocities of the gripper's k joints: of each suction cup the
            extension of the bellows [m, m/s] and two angles of bending [rad, rad/s]. Shape (2 k,).
        vacuum: Pressure of each suction cup below the ambient pressure [Pa]. Only with suction
            cups. Shape (num_cups,).
        query: `QueryObject` of `camera_scene_graph`. Only with visuals.

    Attributes:
        cell: Work cell.
        object_classes: Classes of the objects, by name.
        time_step: Time step of the plant [s].
        scene_plant: Plant with the bodies of the objects.
        fixed_bodies: Bodies of the fixed objects, by name.
        plant: Plant of arm, cell and objects.
        arm: Frames and bodies of the arm in the plant.
        vacuum_system: Vacuum of the suction cups; None for other grippers.
        grasp: Grasp constraint between a suction cup and an object; None for other grippers.
        free_joints: Free joint of each object that can be locked, by name.
        camera_scene_graph: Scene graph with the visual geometry for cameras; None without visuals.
            It is separate from the scene graph of the contacts, because render engines update
            their poses at every step, which takes longer than the step itself.
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        *,
        time_step: float,
        fixed_objects: Sequence[SceneObject] = (),
        weld: WeldPair | None = None,
        visuals: bool = False,
    ) -> None:
        """Build the diagram.

        Args:
            cell: Work cell.
            objects: Name and class of each object that can move.
            time_step: Time step of the plant [s].
            fixed_objects: Further objects that are fixed at their poses. They have no state, which
                makes a step cheaper, and are not shown to cameras.
            weld: The only object that can be grasped, with a `WeldGrasp`; None for a
                `CompliantGrasp` of any object.
            visuals: Whether to add visual geometry for cameras.
        """
        super().__init__()
        self.cell = cell
        self.object_classes = dict(objects) | {o.name: o.object_class for o in fixed_objects}
        self.time_step = time_step
        self._weld = weld
        self._weldable_object = weld.object_name if weld else ""
        builder = DiagramBuilder()
        self.scene_plant: ScenePlant = add_scene_plant(
            builder,
            objects,
            cell.support,
            time_step,
            visuals=False,
            object_with_joint=self._weldable_object,
        )
        self.plant = plant = self.scene_plant.plant
        self.fixed_bodies = add_fixed_objects(plant, fixed_objects)
        graph = self.scene_plant.scene_graph
        self.arm = add_work_cell(plant, graph, cell, compliant=True, visuals=False)
        set_position_gains(plant, self.arm)
        self.grasp = _make_grasp_constraint(plant, self.arm, cell, self.scene_plant.bodies, weld)
        plant.Finalize()
        self.free_joints = {
            name: plant.get_joint(index)
            for name, body in self.scene_plant.bodies.items()
            if name != self._weldable_object
            for index in plant.GetJointIndices(body.model_instance())
        }
        self._object_names = {
            int(body.index()): name
            for name, body in (self.scene_plant.bodies | self.fixed_bodies).items()
        }
        self._gripper_bodies = frozenset(int(i) for i in plant.GetBodyIndices(self.arm.gripper))
        self._body_of_geometry = {
            int(geometry.get_value()): index
            for index in range(plant.num_bodies())
            for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(BodyIndex(index)))
        }
        self._q_indices, self._v_indices = joint_state_indices(plant, self.arm)
        num_joints = len(self.arm.joints)
        command = builder.AddSystem(Demultiplexer(np.array([2 * num_joints, num_joints])))
        builder.ExportInput(command.get_input_port(), "command")
        builder.Connect(
            command.get_output_port(0), plant.get_desired_state_input_port(self.arm.robot)
        )
        builder.Connect(command.get_output_port(1), plant.get_actuation_input_port(self.arm.robot))
        builder.ExportInput(plant.get_desired_state_input_port(self.arm.gripper), "gripper_command")
        builder.ExportOutput(plant.get_state_output_port(), "state")
        builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
        builder.ExportOutput(plant.get_state_output_port(self.arm.gripper), "gripper_state")
        self.vacuum_system: VacuumSystem | None = None
        if isinstance(cell.gripper, SuctionGripper):
            self.vacuum_system = builder.AddNamedSystem("vacuum_system", VacuumSystem(cell.gripper))
            builder.ExportInput(self.vacuum_system.GetInputPort("hold"), "hold")
            builder.ExportOutput(self.vacuum_system.GetOutputPort("vacuum"), "vacuum")
        self.camera_scene_graph = self._add_camera_geometry(builder, objects) if visuals else None
        builder.BuildInto(self)

    def _add_camera_geometry(
        self, builder: DiagramBuilder, objects: Sequence[tuple[str, ObjectClass]]
    ) -> SceneGraph:
        """Add a scene graph with visual geometry and return it.

        The geometry belongs to a copy of the plant that is not simulated. Its poses are computed
        from the state of the simulated plant.
        """
        visual_plant = MultibodyPlant(self.time_step)
        visual_graph = builder.AddNamedSystem("camera_scene_graph", SceneGraph())
        visual_plant.RegisterAsSourceForSceneGraph(visual_graph)
        bodies = add_objects(
            visual_plant,
            visual_graph,
            objects,
            self.cell.support,
            visuals=True,
            object_with_joint=self._weldable_object,
        ).bodies
        arm = add_work_cell(visual_plant, visual_graph, self.cell, compliant=True, visuals=True)
        # The joint of a `WeldGrasp` makes the states of both plants equal.
        _make_grasp_constraint(visual_plant, arm, self.cell, bodies, self._weld)
        visual_plant.Finalize()
        poses = builder.AddNamedSystem(
            "poses", MultibodyPositionToGeometryPose(visual_plant, input_multibody_state=True)
        )
        pose_port = visual_graph.get_source_pose_port(visual_plant.get_source_id())
        builder.Connect(self.plant.get_state_output_port(), poses.get_input_port())
        builder.Connect(poses.get_output_port(), pose_port)
        builder.ExportOutput(visual_graph.get_query_output_port(), "query")
        return visual_graph

    @property
    def graspable_objects(self) -> tuple[str, ...]:
        """Names of the objects that can be grasped."""
        names = tuple(self.scene_plant.bodies)
        return (self._weldable_object,) if self._weldable_object else names

    def plant_context(self, root: Context) -> Context:
        """Return the context of the plant from the context of the root diagram."""
        return self.plant.GetMyMutableContextFromRoot(root)

    def set_state(self, root: Context, q: Floats, objects: Sequence[SceneObject]) -> None:
        """Set the state: arm and objects at rest, and no object attached.

        Args:
            root: Context of the root diagram.
            q: Joint positions of the arm [rad]. Shape (n,).
            objects: Objects that can move, at their poses.
        """
        context = self.plant_context(root)
        positions = self.plant.GetPositions(context)
        positions[self._q_indices] = q
        self.plant.SetPositions(context, positions)
        self.plant.SetVelocities(context, np.zeros(self.plant.num_velocities()))
        if self.grasp is not None:
            self.grasp.reset(context)
        for o in objects:
            X_TO = rigid_transform(o.X_TO)
            if isinstance(self.grasp, WeldGrasp) and o.name == self._weldable_object:
                self.grasp.set_object_pose(context, X_TO)
            else:
                self.plant.SetFreeBodyPose(context, self.scene_plant.bodies[o.name], X_TO)

    def copy_state(self, root: Context, other: "ClutterStation", other_root: Context) -> None:
        """Set the state of arm, gripper, vacuum and objects to that of another station.

        Objects are at rest afterwards, and none is attached.

        Args:
            root: Context of the root diagram.
            other: Station with the same cell, in which some of the objects may be fixed.
            other_root: Context of its root diagram.
        """
        context, source = self.plant_context(root), other.plant_context(other_root)
        for target, instance in (
            (self.arm.robot, other.arm.robot),
            (self.arm.gripper, other.arm.gripper),
        ):
            self.plant.SetPositions(context, target, other.plant.GetPositions(source, instance))
            self.plant.SetVelocities(context, target, other.plant.GetVelocities(source, instance))
        for name, body in other.scene_plant.bodies.items():
            X_TO = body.EvalPoseInWorld(source)
            self.plant.SetFreeBodyPose(context, self.scene_plant.bodies[name], X_TO)
        if self.vacuum_system is not None:
            assert other.vacuum_system is not None
            vacuum_context = self.vacuum_system.GetMyMutableContextFromRoot(root)
            vacuum_context.SetStateAndParametersFrom(
                other.vacuum_system.GetMyContextFromRoot(other_root)
            )

    def joint_positions(self, context: Context) -> Floats:
        """Return the joint positions of the arm [rad]. Shape (n,).

        Args:
            context: Context of the plant.
        """
        return np.asarray(self.plant.GetPositions(context)[self._q_indices])

    @property
    def joint_indices(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices of the arm's joints in the positions and velocities of the plant. Shape (n,)."""
        return self._q_indices, self._v_indices

    def tool_pose_in_object(self, context: Context, tool: str, name: str) -> RigidTransform:
        """Return X_OG of a tool and an object, by their names, in a context of the plant."""
        X_TG = self.arm.tools[tool].CalcPoseInWorld(context)
        return self.scene_plant.bodies[name].EvalPoseInWorld(context).inverse() @ X_TG

    def contact_forces(self, context: Context, link: str) -> dict[str, Floats]:
        """Return the sums of the contact forces of objects on a link of the gripper.

        Args:
            context: Context of the plant.
            link: Name of the link.

        Returns:
            Forces in T [N], shape (3,), by name of the object.
        """
        results = self.plant.get_contact_results_output_port().Eval(context)
        inspector = self.scene_plant.scene_graph.model_inspector()
        index = int(self.plant.GetBodyByName(link, self.arm.gripper).index())
        forces = dict[str, Floats]()
        for k in range(results.num_hydroelastic_contacts()):
            info = results.hydroelastic_contact_info(k)
            surface = info.contact_surface()
            first, second = (
                int(self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).index())
                for geometry in (surface.id_M(), surface.id_N())
            )
            other = second if first == index else first
            if index in (first, second) and other in self._object_names:
                sign = 1.0 if first == index else -1.0
                force = sign * np.asarray(info.F_Ac_W().translational())
                name = self._object_names[other]
                forces[name] = forces.get(name, np.zeros(3)) + force
        return forces

    def objects_in_contact(self, context: Context) -> set[str]:
        """Return the names of objects in contact with the arm or with other objects.

        Contacts between locked objects are filtered out. A locked object is reported if the arm or
        an awake object hits it.

        Args:
            context: Context of the plant.
        """
        bodies = {body for pair in self._contacts(context) for body in pair}
        return {self._object_names[body] for body in bodies if body in self._object_names}

    def contact_flags(self, context: Context, held: str) -> tuple[bool, bool]:
        """Return whether the gripper touches or holds an object, and the held one anything else.

        Args:
            context: Context of the plant.
            held: Name of the object that the gripper holds; "" for none.
        """
        touches_tool = held != ""
        touches_held = False
        for pair in self._contacts(context):
            is_gripper = not self._gripper_bodies.isdisjoint(pair)
            names = [self._object_names.get(body, "") for body in pair]
            touches_tool |= is_gripper and any(names)
            touches_held |= not is_gripper and held != "" and held in names
        return touches_tool, touches_held

    def _contacts(self, context: Context) -> list[tuple[int, int]]:
        """Return the indices of each pair of bodies in contact."""
        results = self.plant.get_contact_results_output_port().Eval(context)
        pairs = list[tuple[int, int]]()
        for i in range(results.num_hydroelastic_contacts()):
            surface = results.hydroelastic_contact_info(i).contact_surface()
            first, second = surface.id_M().get_value(), surface.id_N().get_value()
            pairs.append((self._body_of_geometry[first], self._body_of_geometry[second]))
        for i in range(results.num_point_pair_contacts()):
            info = results.point_pair_contact_info(i)
            pairs.append((int(info.bodyA_index()), int(info.bodyB_index())))
        return pairs


def _make_grasp_constraint(
    plant: MultibodyPlant,
    arm: Arm,
    cell: WorkCell,
    bodies: Mapping[str, RigidBody],
    weld: WeldPair | None,
) -> GraspConstraint | None:
    """Return a `WeldGrasp` of the weldable object, or a `CompliantGrasp` without one."""
    if not isinstance(cell.gripper, SuctionGripper):
        return None
    if weld is not None:
        return WeldGrasp(plant, arm, cell.gripper, weld.tool, bodies[weld.object_name])
    return CompliantGrasp(plant, arm, cell.gripper)
