"""The work cell as a Diagram: plant, geometry, and the arm under position control."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PdControllerGains, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import Demultiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.scenes.interfaces import ArmState
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.cell_plant import Arm, add_work_cell, joint_state_indices
from drake_clutter.simulation.scene_plant import (
    ScenePlant,
    add_objects,
    add_scene_plant,
    rigid_transform,
)
from drake_clutter.station.grasp_constraint import CompliantGrasp, GraspConstraint, WeldGrasp

Floats = NDArray[np.float64]

JOINT_STIFFNESS, JOINT_DAMPING = 1e5, 2e3
"""Of the joints' position control [N m/rad] and [N m s/rad], as stiff as an industrial arm's."""


class ClutterStation(Diagram):
    """The arm among objects.

    .. pydrake_system::

        name: ClutterStation
        input_ports:
        - command
        output_ports:
        - state
        - body_poses
        - bellows
        - query

    Input ports:
        command: Desired positions [rad] and velocities [rad/s], and feed-forward torques [N m].
            Shape (3 n,) for n joints.

    Output ports:
        state: Of the whole plant.
        body_poses: Of all bodies of the plant.
        bellows: How far they are pulled out [m], and how fast [m/s]. Shape (2,).
        query: With visuals only: of `camera_scene_graph`.

    Attributes:
        cell: The cell.
        object_classes: Of the objects, by name.
        time_step: Of the plant [s].
        scene_plant: The objects in the plant.
        plant: The plant.
        arm: The arm in the plant.
        grasp: Fixes an object to the cup.
        free_joints: Joint to the world of each object that can be locked, by name.
        camera_scene_graph: The geometry that cameras see, or None. It is apart from that of the
            contacts, as renderers that get poses at every step take more time than the step does.
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        *,
        time_step: float,
        weldable_object: str = "",
        visuals: bool = False,
    ) -> None:
        """Build the diagram.

        Args:
            cell: What stands around.
            objects: Name and class of each.
            time_step: Of the plant [s].
            weldable_object: Name of the one object that the cup can take, by a `WeldGrasp`; "": it takes
                any, by a `CompliantGrasp`.
            visuals: Whether cameras are to see it.
        """
        super().__init__()
        self.cell, self.object_classes, self.time_step = cell, dict(objects), time_step
        self._weldable_object = weldable_object
        builder = DiagramBuilder()
        self.scene_plant: ScenePlant = add_scene_plant(
            builder, objects, cell.support, time_step, visuals=False, jointed=weldable_object
        )
        self.plant = plant = self.scene_plant.plant
        graph = self.scene_plant.scene_graph
        self.arm = add_work_cell(plant, graph, cell, compliant=True, visuals=False)
        _set_position_gains(plant, self.arm)
        self.grasp = _make_grasp_constraint(
            plant, self.arm, self.scene_plant.bodies, weldable_object
        )
        plant.Finalize()
        self.free_joints = {
            name: plant.get_joint(index)
            for name, body in self.scene_plant.bodies.items()
            if name != weldable_object
            for index in plant.GetJointIndices(body.model_instance())
        }
        self._object_names = {
            int(body.index()): name for name, body in self.scene_plant.bodies.items()
        }
        self._q_indices, self._v_indices = joint_state_indices(plant, self.arm)
        num_joints = len(self.arm.joints)
        command = builder.AddSystem(Demultiplexer(np.array([2 * num_joints, num_joints])))
        builder.ExportInput(command.get_input_port(), "command")
        builder.Connect(
            command.get_output_port(0), plant.get_desired_state_input_port(self.arm.robot)
        )
        builder.Connect(command.get_output_port(1), plant.get_actuation_input_port(self.arm.robot))
        builder.ExportOutput(plant.get_state_output_port(), "state")
        builder.ExportOutput(plant.get_body_poses_output_port(), "body_poses")
        builder.ExportOutput(plant.get_state_output_port(self.arm.tool), "bellows")
        self.camera_scene_graph = self._add_camera_geometry(builder, objects) if visuals else None
        builder.BuildInto(self)

    def _add_camera_geometry(
        self, builder: DiagramBuilder, objects: Sequence[tuple[str, ObjectClass]]
    ) -> SceneGraph:
        """Add the geometry that cameras see.

        It is that of a twin of the plant, which is never simulated, in the plant's state.
        """
        twin, seen = (
            MultibodyPlant(self.time_step),
            builder.AddNamedSystem("camera_scene_graph", SceneGraph()),
        )
        twin.RegisterAsSourceForSceneGraph(seen)
        bodies = add_objects(
            twin, seen, objects, self.cell.support, visuals=True, jointed=self._weldable_object
        ).bodies
        arm = add_work_cell(twin, seen, self.cell, compliant=True, visuals=True)
        _make_grasp_constraint(
            twin, arm, bodies, self._weldable_object
        )  # with it the states are alike
        twin.Finalize()
        poses = builder.AddNamedSystem(
            "poses", MultibodyPositionToGeometryPose(twin, input_multibody_state=True)
        )
        builder.Connect(self.plant.get_state_output_port(), poses.get_input_port())
        builder.Connect(poses.get_output_port(), seen.get_source_pose_port(twin.get_source_id()))
        builder.ExportOutput(seen.get_query_output_port(), "query")
        return seen

    @property
    def graspable_objects(self) -> tuple[str, ...]:
        """Names of the objects that the cup can take."""
        return (self._weldable_object,) if self._weldable_object else tuple(self.object_classes)

    def plant_context(self, root: Context) -> Context:
        """Return the plant's context in that of the diagram that holds the station."""
        return self.plant.GetMyMutableContextFromRoot(root)

    def set_state(self, root: Context, q: Floats, objects: Sequence[SceneObject]) -> None:
        """Put the arm at q (n,) [rad] and the objects at their poses, all at rest."""
        context = self.plant_context(root)
        positions = self.plant.GetPositions(context)
        positions[self._q_indices] = q
        self.plant.SetPositions(context, positions)
        self.plant.SetVelocities(context, np.zeros(self.plant.num_velocities()))
        self.grasp.reset(context)
        for o in objects:
            X_TO = rigid_transform(o.X_TO)
            if isinstance(self.grasp, WeldGrasp) and o.name == self._weldable_object:
                self.grasp.set_object_pose(context, X_TO)
            else:
                self.plant.SetFreeBodyPose(context, self.scene_plant.bodies[o.name], X_TO)

    def joint_positions(self, context: Context) -> Floats:
        """Return q (n,) [rad] from the plant's context."""
        return np.asarray(self.plant.GetPositions(context)[self._q_indices])

    def arm_state(self, context: Context, suction: bool) -> ArmState:
        """Return the arm's state from the plant's context, with the torques of the last step."""
        torque = self.plant.get_net_actuation_output_port(self.arm.robot).Eval(context)
        q, v = self.joint_positions(context), self.plant.GetVelocities(context)[self._v_indices]
        return ArmState(tuple(q.tolist()), tuple(v.tolist()), tuple(torque.tolist()), suction)

    def objects_in_contact(self, context: Context) -> set[str]:
        """Return names of objects that touch the arm, its tool, or another object.

        Locked objects touch only what is not locked: so of them, those that something free or the
        arm has run into.

        Args:
            context: Of the plant.
        """
        results = self.plant.get_contact_results_output_port().Eval(context)
        inspector = self.scene_plant.scene_graph.model_inspector()
        bodies = list[int]()
        for i in range(results.num_hydroelastic_contacts()):
            surface = results.hydroelastic_contact_info(i).contact_surface()
            for geometry in (surface.id_M(), surface.id_N()):
                body = self.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
                if body is not None:
                    bodies.append(int(body.index()))
        for i in range(results.num_point_pair_contacts()):
            pair = results.point_pair_contact_info(i)
            bodies += [int(pair.bodyA_index()), int(pair.bodyB_index())]
        return {self._object_names[body] for body in bodies if body in self._object_names}


def _set_position_gains(plant: MultibodyPlant, arm: Arm) -> None:
    """Give the arm's motors position control."""
    motors = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    for motor in motors:
        if motor.model_instance() == arm.robot:
            motor.set_controller_gains(PdControllerGains(p=JOINT_STIFFNESS, d=JOINT_DAMPING))


def _make_grasp_constraint(
    plant: MultibodyPlant, arm: Arm, bodies: Mapping[str, RigidBody], weldable_object: str
) -> GraspConstraint:
    """Return the constraint for the one object that is jointed, or for any."""
    return (
        WeldGrasp(plant, arm, bodies[weldable_object])
        if weldable_object
        else CompliantGrasp(plant, arm)
    )
