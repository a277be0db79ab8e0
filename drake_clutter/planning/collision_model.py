"""How far the arm, and what it holds, is from everything else."""

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
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable, RigidBody
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
    """A signed distance.

    Attributes:
        distance: m, negative where there is penetration.
        pair: the names of what is so close, the arm's side first.
    """

    distance: float
    pair: tuple[str, str] = ("", "")


class CollisionModel:
    """Signed distances between the arm, what it holds, and what stands around; objects stay where they were put.

    Attributes:
        arm_names: of the bodies of arm and tool.
        fixture_tops: Heights of the highest points of the cell's fixtures [m].
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        occluded: Sequence[OccludedBox] = (),
    ) -> None:
        """Makes a plant of the arm, named objects, and space that must be taken for full."""
        builder = DiagramBuilder()
        made = add_scene_plant(builder, objects, cell.support, 0.0, visuals=False)
        self.plant, self._bodies = made.plant, made.bodies
        self._arm: Arm = add_work_cell(
            made.plant, made.scene_graph, cell, compliant=False, visuals=False
        )
        for k, block in enumerate(occluded):
            X_TB = RigidTransform(RotationMatrix.MakeZRotation(block.yaw), block.center)
            made.plant.RegisterCollisionGeometry(
                made.plant.world_body(),
                X_TB,
                Box(*block.size),
                f"unseen_{k}",
                CoulombFriction(1.0, 1.0),
            )
        made.plant.Finalize()
        self._diagram = builder.Build()
        self._root = self._diagram.CreateDefaultContext()
        self._context = made.plant.GetMyMutableContextFromRoot(self._root)
        self._scene_graph, self._geometry_context = (
            made.scene_graph,
            made.scene_graph.GetMyMutableContextFromRoot(self._root),
        )
        self._query_port = made.scene_graph.get_query_output_port()
        self._q = self.plant.GetPositions(self._context)
        self._q_indices, self._v_indices = joint_state_indices(self.plant, self._arm)
        self._geometry_depths = self._find_geometry_depths(load_robot(cell.robot).link_depths)
        self._fixed = (*self._arm.fixed, get_support_body(self.plant))
        self._names = self._name_geometries()
        self._geometry_owners = {
            geometry: (name, geometry in self._geometry_depths)
            for geometry, name in self._names.items()
        }
        self._filters = made.scene_graph.collision_filter_manager(self._geometry_context)
        standing = self._geometries(*self._fixed, *self._bodies.values())
        self._filters.Apply(CollisionFilterDeclaration().ExcludeWithin(standing))
        self.arm_names = frozenset(body.name() for body in self._arm.bodies)
        self.fixture_tops = self._highest_points({fixture.name for fixture in cell.fixtures})
        self._attached: tuple[str, Floats] | None = None
        self._attachment_filters: list[object] = []

    def _geometries(self, *bodies: RigidBody) -> GeometrySet:
        found = GeometrySet()
        for body in bodies:
            found.Add(self.plant.GetCollisionGeometriesForBody(body))
        return found

    def _find_geometry_depths(self, link_depths: Mapping[str, int]) -> dict[GeometryId, int]:
        """Return how many of the joints, from the base on, move each geometry of arm and tool.

        By geometry, as a link of the arm, one of the tool and an object may have one name.
        """
        found = dict[GeometryId, int]()
        for body in self._arm.bodies:
            moved_by = (
                link_depths[body.name()]
                if body.model_instance() == self._arm.robot
                else len(self._q_indices)
            )
            found |= dict.fromkeys(self.plant.GetCollisionGeometriesForBody(body), moved_by)
        return found

    def _name_geometries(self) -> dict[GeometryId, str]:
        names = dict[GeometryId, str]()
        owners = {body.index(): name for name, body in self._bodies.items()}
        fixtures = {body.index(): body for body in self._arm.fixed[1:]}
        inspector = self._scene_graph.model_inspector()
        shapes = {body.index() for body in self._fixed} - set(fixtures)
        for index in map(BodyIndex, range(self.plant.num_bodies())):
            body = self.plant.get_body(index)
            name = owners.get(index, body.name())
            if index in fixtures:
                name = fixture_name(self.plant, fixtures[index])
            for geometry in self.plant.GetCollisionGeometriesForBody(body):
                of_its_own = inspector.GetName(geometry).split("::")[-1]
                names[geometry] = of_its_own if index in shapes else name
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
        """Puts objects at their poses; the arm holds nothing any more."""
        self.detach_object()
        for o in objects:
            self.plant.SetFreeBodyPose(self._context, self._bodies[o.name], rigid_transform(o.X_TO))
        self._q = self.plant.GetPositions(self._context)

    def set_object_pose(self, name: str, X_TO: Pose) -> None:
        """Puts one object elsewhere."""
        self.plant.SetFreeBodyPose(self._context, self._bodies[name], rigid_transform(X_TO))
        self._q = self.plant.GetPositions(self._context)

    def attach_object(self, name: str, X_OG: RigidTransform) -> None:
        """From now on the object moves with the gripper."""
        self.detach_object()
        held = self._geometries(self._bodies[name])
        others = self._geometries(*self._fixed, *(b for n, b in self._bodies.items() if n != name))
        tool = self._geometries(
            *(body for body in self._arm.bodies if body.model_instance() == self._arm.tool)
        )
        declaration = (
            CollisionFilterDeclaration().ExcludeBetween(held, tool).AllowBetween(held, others)
        )
        self._attachment_filters.append(self._filters.ApplyTransient(declaration))
        self._attached = name, invert_pose(X_OG.GetAsMatrix4())

    def detach_object(self) -> None:
        """Holds nothing any more."""
        while self._attachment_filters:
            self._filters.RemoveDeclaration(self._attachment_filters.pop())
        self._attached = None

    def _pairs_below(self, q: Floats, max_distance: float) -> list[SignedDistancePair]:
        self._q[self._q_indices] = q
        self.plant.SetPositions(self._context, self._q)
        if self._attached is not None:
            name, X_GO = self._attached
            X_TG = self._arm.cup.CalcPoseInWorld(self._context).GetAsMatrix4()
            self.plant.SetFreeBodyPose(
                self._context, self._bodies[name], RigidTransform(X_TG @ X_GO)
            )
        found: list[SignedDistancePair] = self._query_port.Eval(
            self._geometry_context
        ).ComputeSignedDistancePairwiseClosestPoints(max_distance)
        return found

    def _to_signed_distance(self, pair: SignedDistancePair) -> SignedDistance:
        (first, of_arm), (second, _) = (
            self._geometry_owners[pair.id_A],
            self._geometry_owners[pair.id_B],
        )
        moves = of_arm or (self._attached is not None and first == self._attached[0])
        return SignedDistance(float(pair.distance), (first, second) if moves else (second, first))

    def distances_below(self, q: Floats, max_distance: float) -> list[SignedDistance]:
        """At joint positions (n,): all that is closer than `max_distance`, m."""
        return [self._to_signed_distance(pair) for pair in self._pairs_below(q, max_distance)]

    def distances_and_gradients(
        self, q: Floats, max_distance: float
    ) -> list[tuple[SignedDistance, Floats]]:
        """As `close`, each with how the distance changes with the joint positions, (n,) m/rad."""
        pairs = self._pairs_below(q, max_distance)
        if not pairs:
            return []
        query, world = self._query_port.Eval(self._geometry_context), self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.flange, np.zeros(3), world, world
        )[:, self._v_indices]
        p_TF = self._arm.flange.CalcPoseInWorld(self._context).translation()
        found = []
        for pair in pairs:
            gradient = np.zeros(len(self._q_indices))
            for geometry, p_S, sign in (
                (pair.id_A, pair.p_ACa, 1.0),
                (pair.id_B, pair.p_BCb, -1.0),
            ):
                if joints := self._num_moving_joints(geometry):
                    nx, ny, nz = sign * pair.nhat_BA_W
                    x, y, z = query.GetPoseInWorld(geometry).multiply(p_S) - p_TF
                    moment = (y * nz - z * ny, z * nx - x * nz, x * ny - y * nx)  # p_FC x n
                    gradient[:joints] += (*moment, nx, ny, nz) @ J[:, :joints]
            found.append((self._to_signed_distance(pair), gradient))
        return found

    def gripper_position(self) -> Floats:
        """(3,) m, of the cup in T at the joint angles of the last question."""
        return np.asarray(self._arm.cup.CalcPoseInWorld(self._context).translation())

    def gripper_jacobian(self, q: Floats) -> Floats:
        """(6, n) at joint positions (n,): how the cup turns (first three rows) and moves, in T."""
        self._q[self._q_indices] = q
        self.plant.SetPositions(self._context, self._q)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.cup, np.zeros(3), world, world
        )
        return np.asarray(J[:, self._v_indices])

    def _num_moving_joints(self, geometry: GeometryId) -> int:
        name, of_arm = self._geometry_owners[geometry]
        if of_arm:
            return self._geometry_depths[geometry]
        return (
            len(self._q_indices) if self._attached is not None and name == self._attached[0] else 0
        )
