"""Signed distances between arm, attached object and obstacles, with gradients.

Frames: T is the support and the world, F is the flange, G is a tool of the gripper, O is an object.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Box,
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    SignedDistancePair,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction
from pydrake.multibody.tree import BodyIndex, Frame, JacobianWrtVariable, RigidBody
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.planning.tool_kinematics import invert_pose
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.occlusion import OccludedBox
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.cell_plant import (
    Arm,
    add_work_cell,
    fixture_name,
    joint_state_indices,
)
from drake_clutter.simulation.scene_plant import add_scene_plant, get_support_body, rigid_transform

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class SignedDistance:
    """Signed distance between two collision geometries.

    Attributes:
        distance: Distance [m]; negative in penetration.
        pair: Names of the two geometries' owners; a part of the arm or the attached object is
            first.
    """

    distance: float
    pair: tuple[str, str] = ("", "")


class CollisionModel:
    """Collision model of the arm in its cell, with objects at given poses.

    The configuration of the arm is an argument of the queries. One object can be attached to the
    gripper; it then moves with the arm.

    Attributes:
        plant: Plant of arm, cell and objects.
        arm_names: Names of the bodies of robot and gripper.
        fixture_tops: Height of the highest point of each fixture [m].
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        occluded: Sequence[OccludedBox] = (),
    ) -> None:
        """Build the model.

        Args:
            cell: Work cell with the arm.
            objects: Name and class of each object.
            occluded: Occluded volumes, which count as obstacles.
        """
        builder = DiagramBuilder()
        scene_plant = add_scene_plant(builder, objects, cell.support, 0.0, visuals=False)
        self.plant = plant = scene_plant.plant
        self._bodies = scene_plant.bodies
        self._scene_graph = scene_graph = scene_plant.scene_graph
        self._arm: Arm = add_work_cell(plant, scene_graph, cell, compliant=False, visuals=False)
        for k, box in enumerate(occluded):
            X_TB = RigidTransform(RotationMatrix.MakeZRotation(box.yaw), box.center)
            plant.RegisterCollisionGeometry(
                plant.world_body(),
                X_TB,
                Box(*box.size),
                f"unseen_{k}",
                CoulombFriction(1.0, 1.0),
            )
        plant.Finalize()
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = plant.GetMyMutableContextFromRoot(self._root)
        self._geometry_context = scene_graph.GetMyMutableContextFromRoot(self._root)
        self._query_port = scene_graph.get_query_output_port()
        self._q = plant.GetPositions(self._context)
        self._q_indices, self._v_indices = joint_state_indices(plant, self._arm)
        self._geometry_depths = self._find_geometry_depths(load_robot(cell.robot).link_depths)
        self._fixed = (*self._arm.fixed, get_support_body(plant))
        self._names = self._name_geometries()
        self._geometry_owners = {
            geometry: (name, geometry in self._geometry_depths)
            for geometry, name in self._names.items()
        }
        self._filters = scene_graph.collision_filter_manager(self._geometry_context)
        obstacles = self._geometries(*self._fixed, *self._bodies.values())
        self._filters.Apply(CollisionFilterDeclaration().ExcludeWithin(obstacles))
        self.arm_names = frozenset(body.name() for body in self._arm.bodies)
        self.fixture_tops = self._highest_points({fixture.name for fixture in cell.fixtures})
        self._attached: tuple[str, Frame, Floats] | None = None
        self._attachment_filters: list[object] = []

    def _geometries(self, *bodies: RigidBody) -> GeometrySet:
        geometries = GeometrySet()
        for body in bodies:
            geometries.Add(self.plant.GetCollisionGeometriesForBody(body))
        return geometries

    def _find_geometry_depths(self, link_depths: Mapping[str, int]) -> dict[GeometryId, int]:
        """Return the number of joints between the base and each geometry of the arm.

        The key is the geometry, because a link, a part of the gripper and an object may share a
        name.

        Args:
            link_depths: Number of joints between the base and each link of the robot, by name.
        """
        depths = dict[GeometryId, int]()
        for body in self._arm.bodies:
            is_link = body.model_instance() == self._arm.robot
            depth = link_depths[body.name()] if is_link else len(self._q_indices)
            depths |= dict.fromkeys(self.plant.GetCollisionGeometriesForBody(body), depth)
        return depths

    def _name_geometries(self) -> dict[GeometryId, str]:
        """Return the name of each geometry's owner.

        The owner is an object, a fixture or a link; geometries of the world and of the support
        have names of their own.
        """
        names = dict[GeometryId, str]()
        object_names = {body.index(): name for name, body in self._bodies.items()}
        fixtures = {body.index(): body for body in self._arm.fixed[1:]}
        inspector = self._scene_graph.model_inspector()
        named_by_geometry = {body.index() for body in self._fixed} - set(fixtures)
        for index in map(BodyIndex, range(self.plant.num_bodies())):
            body = self.plant.get_body(index)
            name = object_names.get(index, body.name())
            if index in fixtures:
                name = fixture_name(self.plant, fixtures[index])
            for geometry in self.plant.GetCollisionGeometriesForBody(body):
                geometry_name = inspector.GetName(geometry).split("::")[-1]
                names[geometry] = geometry_name if index in named_by_geometry else name
        return names

    def _highest_points(self, names: Collection[str]) -> tuple[float, ...]:
        query = self._query_port.Eval(self._geometry_context)
        inspector = self._scene_graph.model_inspector()
        tops = dict.fromkeys(names, -np.inf)
        for geometry, name in self._names.items():
            if name in tops and (box := inspector.GetObbInGeometryFrame(geometry)):
                X_TB = query.GetPoseInWorld(geometry) @ box.pose()
                half_height = np.abs(X_TB.rotation().matrix()[2]) @ box.half_width()
                tops[name] = max(tops[name], float(X_TB.translation()[2] + half_height))
        return tuple(tops.values())

    def set_object_poses(self, objects: Sequence[SceneObject]) -> None:
        """Detach the attached object and set the poses of objects."""
        self.detach_object()
        for o in objects:
            self.plant.SetFreeBodyPose(self._context, self._bodies[o.name], rigid_transform(o.X_TO))
        self._q = self.plant.GetPositions(self._context)

    def set_object_pose(self, name: str, X_TO: Pose) -> None:
        """Set the pose of one object."""
        self.plant.SetFreeBodyPose(self._context, self._bodies[name], rigid_transform(X_TO))
        self._q = self.plant.GetPositions(self._context)

    def set_gripper_joints(self, positions: Sequence[float]) -> None:
        """Set the positions of the gripper's actuated joints [m]."""
        self.plant.SetPositions(self._context, self._arm.gripper, np.array(positions))
        self._q = self.plant.GetPositions(self._context)

    def attach_object(self, name: str, tool: str, X_OG: RigidTransform) -> None:
        """Attach an object to a tool of the gripper.

        Distances between the object and obstacles are reported, distances between the object and
        the gripper are not.

        Args:
            name: Name of the object.
            tool: Name of the tool.
            X_OG: Pose of the tool in the object.
        """
        self.detach_object()
        attached = self._geometries(self._bodies[name])
        others = self._geometries(*self._fixed, *(b for n, b in self._bodies.items() if n != name))
        gripper = self._geometries(
            *(body for body in self._arm.bodies if body.model_instance() == self._arm.gripper)
        )
        declaration = (
            CollisionFilterDeclaration()
            .ExcludeBetween(attached, gripper)
            .AllowBetween(attached, others)
        )
        self._attachment_filters.append(self._filters.ApplyTransient(declaration))
        self._attached = name, self._arm.tools[tool], invert_pose(X_OG.GetAsMatrix4())

    def detach_object(self) -> None:
        """Detach the attached object, if any; it stays at its last pose."""
        while self._attachment_filters:
            self._filters.RemoveDeclaration(self._attachment_filters.pop())
        self._attached = None

    def _pairs_below(self, q: Floats, max_distance: float) -> list[SignedDistancePair]:
        self._q[self._q_indices] = q
        self.plant.SetPositions(self._context, self._q)
        if self._attached is not None:
            name, frame, X_GO = self._attached
            X_TG = frame.CalcPoseInWorld(self._context).GetAsMatrix4()
            self.plant.SetFreeBodyPose(
                self._context, self._bodies[name], RigidTransform(X_TG @ X_GO)
            )
        query = self._query_port.Eval(self._geometry_context)
        pairs: list[SignedDistancePair] = query.ComputeSignedDistancePairwiseClosestPoints(
            max_distance
        )
        return pairs

    def _to_signed_distance(self, pair: SignedDistancePair) -> SignedDistance:
        first, first_is_arm = self._geometry_owners[pair.id_A]
        second, _ = self._geometry_owners[pair.id_B]
        first_moves = first_is_arm or (self._attached is not None and first == self._attached[0])
        names = (first, second) if first_moves else (second, first)
        return SignedDistance(float(pair.distance), names)

    def distances_below(self, q: Floats, max_distance: float) -> list[SignedDistance]:
        """Return the signed distances below a threshold.

        Args:
            q: Joint positions of the arm. Shape (n,).
            max_distance: Threshold [m].
        """
        return [self._to_signed_distance(pair) for pair in self._pairs_below(q, max_distance)]

    def distances_and_gradients(
        self, q: Floats, max_distance: float
    ) -> list[tuple[SignedDistance, Floats]]:
        """Return the signed distances below a threshold with their gradients.

        Args:
            q: Joint positions of the arm. Shape (n,).
            max_distance: Threshold [m].

        Returns:
            Pairs of a signed distance and its derivatives by the joint positions [m/rad], shape
            (n,), in the order of `distances_below`.
        """
        pairs = self._pairs_below(q, max_distance)
        if not pairs:
            return []
        query = self._query_port.Eval(self._geometry_context)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.flange, np.zeros(3), world, world
        )[:, self._v_indices]
        p_TF = self._arm.flange.CalcPoseInWorld(self._context).translation()
        distances = []
        for pair in pairs:
            gradient = np.zeros(len(self._q_indices))
            for geometry, p_GeometryC, sign in (
                (pair.id_A, pair.p_ACa, 1.0),
                (pair.id_B, pair.p_BCb, -1.0),
            ):
                if depth := self._num_moving_joints(geometry):
                    nx, ny, nz = sign * pair.nhat_BA_W
                    x, y, z = query.GetPoseInWorld(geometry).multiply(p_GeometryC) - p_TF
                    moment = (y * nz - z * ny, z * nx - x * nz, x * ny - y * nx)  # p_FC x n
                    gradient[:depth] += (*moment, nx, ny, nz) @ J[:, :depth]
            distances.append((self._to_signed_distance(pair), gradient))
        return distances

    def tool_position(self, tool: str) -> Floats:
        """Return p_TG of a tool at the positions of the last distance query [m]. Shape (3,)."""
        return np.asarray(self._arm.tools[tool].CalcPoseInWorld(self._context).translation())

    def tool_jacobian(self, tool: str, q: Floats) -> Floats:
        """Return the spatial Jacobian of G in T, angular rows first. Shape (6, n).

        Args:
            tool: Name of the tool.
            q: Joint positions of the arm. Shape (n,).
        """
        self._q[self._q_indices] = q
        self.plant.SetPositions(self._context, self._q)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context,
            JacobianWrtVariable.kV,
            self._arm.tools[tool],
            np.zeros(3),
            world,
            world,
        )
        return np.asarray(J[:, self._v_indices])

    def _num_moving_joints(self, geometry: GeometryId) -> int:
        name, is_arm = self._geometry_owners[geometry]
        if is_arm:
            return self._geometry_depths[geometry]
        is_attached = self._attached is not None and name == self._attached[0]
        return len(self._q_indices) if is_attached else 0
