"""Reader of the bodies, joints and geometry of a work cell from Drake's plant of it.

The exporters write what the simulated station consists of: masses, springs, limits, gains and
collision filters are those of the plant.

Frames: T is the support and the world, P is a parent body, B is a body, G is a geometry.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, product
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import GeometryId, SceneGraph, SceneGraphInspector
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import (
    ForceElementIndex,
    Joint,
    JointActuator,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    RigidBody,
)
from pydrake.systems.framework import Context, DiagramBuilder

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.export.cell_model import (
    CellBody,
    CellCamera,
    CellFrame,
    CellJoint,
    CellModel,
    Collision,
    Color,
    JointCoupling,
    PositionActuator,
    Visual,
)
from drake_clutter.export.model_parts import Inertial
from drake_clutter.simulation.cell_plant import (
    Arm,
    add_work_cell,
    fixture_name,
    set_joint_angles,
    set_position_gains,
)

Floats = NDArray[np.float64]
_IDENTITY = RigidTransform()
_DEFAULT_COLOR = (0.6, 0.6, 0.6, 1.0)
"""Color of visual geometry without one."""


def read_cell_model(cell: WorkCell) -> CellModel:
    """Return the model of a cell.

    Args:
        cell: Work cell.

    Raises:
        InputError: A model file cannot be used.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.001)
    arm = add_work_cell(plant, scene_graph, cell, compliant=True, visuals=True)
    set_position_gains(plant, arm)
    plant.Finalize()
    context = plant.GetMyMutableContextFromRoot(builder.Build().CreateDefaultContext())
    set_joint_angles(plant, context, arm, cell.robot.home)
    return _CellReader(cell, plant, scene_graph, arm, context).read()


class _CellReader:
    """Reads a plant with the arm at home."""

    def __init__(
        self,
        cell: WorkCell,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        arm: Arm,
        context: Context,
    ) -> None:
        self._cell = cell
        self._plant = plant
        self._inspector: SceneGraphInspector = scene_graph.model_inspector()
        self._arm = arm
        self._context = context
        self._gravity = plant.CalcGravityGeneralizedForces(context)
        self._springs = dict[str, tuple[float, float]]()
        for k in range(plant.num_force_elements()):
            element = plant.get_force_element(ForceElementIndex(k))
            if isinstance(element, RevoluteSpring):
                spring = element.default_stiffness(), element.default_nominal_angle()
            elif isinstance(element, PrismaticSpring):
                spring = element.stiffness(), element.nominal_position()
            else:
                continue
            self._springs[self._joint_name(element.joint())] = spring
        self._actuators: dict[str, JointActuator] = {}
        for index in plant.GetJointActuatorIndices():
            actuator = plant.get_joint_actuator(index)
            self._actuators[self._joint_name(actuator.joint())] = actuator

    def read(self) -> CellModel:
        """Return the model."""
        bodies = (*self._fixed_bodies(), *self._jointed_bodies())
        flange = self._arm.flange
        frames = {f"robot/{flange.name()}": flange}
        frames |= {f"gripper/{name}": frame for name, frame in self._arm.tools.items()}
        cameras = [
            CellCamera(name, camera, "", camera.X_TC) for name, camera in self._cell.cameras.items()
        ]
        wrist = self._cell.wrist_camera
        X_BC = flange.GetFixedPoseInBodyFrame() @ wrist.pose.transform  # of which X_FC is the pose
        cameras.append(CellCamera("robot/wrist", wrist, self._body_name(flange.body()), X_BC))
        return CellModel(
            bodies=bodies,
            frames=tuple(
                CellFrame(name, self._body_name(frame.body()), frame.GetFixedPoseInBodyFrame())
                for name, frame in frames.items()
            ),
            cameras=tuple(cameras),
            couplings=_read_couplings(
                self._cell.gripper.model_sdf(compliant=True, actuated=True), "gripper/"
            ),
            excluded=self._excluded_pairs(bodies),
        )

    def _part(self, element: RigidBody | Joint) -> str:
        """Return the part of the cell to which a body or joint belongs."""
        parts = {self._arm.robot: "robot", self._arm.gripper: "gripper"}
        return parts.get(element.model_instance(), "cell")

    def _body_name(self, body: RigidBody) -> str:
        if body.index() == self._plant.world_body().index():
            return ""
        part = self._part(body)
        if part == "cell":
            return f"cell/{fixture_name(self._plant, body)}/{body.name()}"
        return f"{part}/{body.name()}"

    def _joint_name(self, joint: Joint) -> str:
        return f"{self._part(joint)}/{joint.name()}"

    def _fixed_bodies(self) -> Iterator[CellBody]:
        """Return a body for each geometry of the world: boxes, cameras and the pedestal."""
        world = self._plant.world_body()
        collisions = self._world_geometries(self._plant.GetCollisionGeometriesForBody(world))
        visuals = self._world_geometries(self._plant.GetVisualGeometriesForBody(world))
        for name in collisions:
            X_TB = self._inspector.GetPoseInFrame(collisions[name])
            yield CellBody(
                name=name,
                parent="",
                X_PB=X_TB,
                X_TB=X_TB,
                joint=None,
                inertial=None,
                collisions=self._collisions([collisions[name]], X_TB),
                visuals=self._visuals([visuals[name]] if name in visuals else [], X_TB),
            )

    def _world_geometries(self, ids: Sequence[GeometryId]) -> dict[str, GeometryId]:
        """Return geometries of the world by the names of their bodies."""
        return {f"cell/{self._inspector.GetName(i).split('::')[-1]}": i for i in ids}

    def _jointed_bodies(self) -> Iterator[CellBody]:
        """Return the bodies of the models, parents first."""
        plant = self._plant
        waiting = [plant.get_joint(index) for index in plant.GetJointIndices()]
        known = {""}
        while waiting:
            joint = next(j for j in waiting if self._body_name(j.parent_body()) in known)
            waiting.remove(joint)
            body = joint.child_body()
            name = self._body_name(body)
            known.add(name)
            X_PF = joint.frame_on_parent().GetFixedPoseInBodyFrame()
            X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
            X_FM = RigidTransform() if joint.num_positions() else joint.X_FM()
            yield CellBody(
                name=name,
                parent=self._body_name(joint.parent_body()),
                X_PB=X_PF @ X_FM @ X_BM.inverse(),
                X_TB=body.EvalPoseInWorld(self._context),
                joint=self._joint(joint, X_BM) if joint.num_positions() else None,
                inertial=_read_inertial(body),
                collisions=self._collisions(plant.GetCollisionGeometriesForBody(body)),
                visuals=self._visuals(plant.GetVisualGeometriesForBody(body)),
            )

    def _joint(self, joint: Joint, X_BM: RigidTransform) -> CellJoint:
        name = self._joint_name(joint)
        if isinstance(joint, RevoluteJoint):
            axis_M = joint.revolute_axis()
        else:
            assert isinstance(joint, PrismaticJoint), f"{name} is a {joint.type_name()} joint"
            axis_M = joint.translation_axis()
        actuator = self._actuators.get(name)
        return CellJoint(
            name=name,
            is_revolute=isinstance(joint, RevoluteJoint),
            axis_B=X_BM.rotation() @ axis_M,
            p_B=X_BM.translation(),
            limits=(
                float(joint.position_lower_limits()[0]),
                float(joint.position_upper_limits()[0]),
            ),
            home=float(joint.GetOnePosition(self._context)),
            damping=float(joint.default_damping_vector()[0]),
            spring=self._springs.get(name, (0.0, 0.0)),
            armature=(
                actuator.default_rotor_inertia() * actuator.default_gear_ratio() ** 2
                if actuator
                else 0.0
            ),
            actuator=self._actuator(joint, actuator) if actuator else None,
        )

    def _actuator(self, joint: Joint, actuator: JointActuator) -> PositionActuator:
        gains = actuator.get_controller_gains()
        gravity_effort = -float(self._gravity[joint.velocity_start()])
        return PositionActuator(gains.p, gains.d, actuator.effort_limit(), gravity_effort)

    def _collisions(
        self, geometries: Sequence[GeometryId], X_LB: RigidTransform = _IDENTITY
    ) -> tuple[Collision, ...]:
        """Return collision geometries.

        Args:
            geometries: Geometries of a body L of the plant.
            X_LB: Pose of the exported body B in L.
        """
        X_BL = X_LB.inverse()
        return tuple(
            Collision(
                self._inspector.GetShape(geometry),
                X_BL @ self._inspector.GetPoseInFrame(geometry),
                self._inspector.GetProximityProperties(geometry)
                .GetProperty("material", "coulomb_friction")
                .dynamic_friction(),
            )
            for geometry in geometries
        )

    def _visuals(
        self, geometries: Sequence[GeometryId], X_LB: RigidTransform = _IDENTITY
    ) -> tuple[Visual, ...]:
        """Return visual geometries, see `_collisions`."""
        X_BL = X_LB.inverse()
        return tuple(
            Visual(
                self._inspector.GetShape(geometry),
                X_BL @ self._inspector.GetPoseInFrame(geometry),
                self._color(geometry),
            )
            for geometry in geometries
        )

    def _color(self, geometry: GeometryId) -> Color:
        properties = self._inspector.GetIllustrationProperties(geometry)
        if properties is None or not properties.HasProperty("phong", "diffuse"):
            return _DEFAULT_COLOR
        color = properties.GetProperty("phong", "diffuse")
        return color.r(), color.g(), color.b(), color.a()

    def _excluded_pairs(self, bodies: Sequence[CellBody]) -> tuple[tuple[str, str], ...]:
        """Return the pairs of bodies whose collisions the plant filters out."""
        moving = set[str]()
        for body in bodies:
            if body.joint is not None or body.parent in moving:
                moving.add(body.name)
        plant = self._plant
        geometries = {
            self._body_name(body): plant.GetCollisionGeometriesForBody(body)
            for body in (plant.get_body(j.child_body().index()) for j in self._joints())
        }
        world = plant.GetCollisionGeometriesForBody(plant.world_body())
        geometries |= {name: [i] for name, i in self._world_geometries(world).items()}
        return tuple(
            (first, second)
            for first, second in combinations((body.name for body in bodies), 2)
            if (first in moving or second in moving)
            and geometries[first]
            and geometries[second]
            and all(
                self._inspector.CollisionFiltered(a, b)
                for a, b in product(geometries[first], geometries[second])
            )
        )

    def _joints(self) -> Iterator[Joint]:
        return (self._plant.get_joint(index) for index in self._plant.GetJointIndices())


def _read_inertial(body: RigidBody) -> Inertial | None:
    """Return the mass properties of a body, None without mass."""
    mass = body.default_mass()
    if not mass:
        return None
    p_BCm = body.default_spatial_inertia().get_com()
    about_com = body.default_spatial_inertia().Shift(p_BCm).CalcRotationalInertia()
    tensor = about_com.CopyToFullMatrix3()
    entries = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return Inertial(mass, tuple(p_BCm.tolist()), tuple(float(tensor[e]) for e in entries))


def _read_couplings(sdf: str, prefix: str) -> tuple[JointCoupling, ...]:
    """Return the `mimic` elements of an SDF model, which a plant does not reveal.

    Args:
        sdf: Text of the model.
        prefix: Prefix of the names of its joints.
    """
    couplings = []
    for joint in ElementTree.fromstring(sdf).iter("joint"):
        for mimic in joint.iter("mimic"):
            couplings.append(
                JointCoupling(
                    joint=f"{prefix}{joint.get('name')}",
                    other=f"{prefix}{mimic.get('joint')}",
                    multiplier=float(mimic.findtext("multiplier", "1")),
                    offset=float(mimic.findtext("offset", "0")),
                )
            )
    return tuple(couplings)
