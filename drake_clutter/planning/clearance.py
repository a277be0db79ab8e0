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
from drake_clutter.planning.tool_kinematics import inverse
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.scenes.unseen import UnseenBlock
from drake_clutter.simulation.cell_plant import Arm, add_work_cell, fixture_name, joint_numbers
from drake_clutter.simulation.plant import add_scene_plant, rigid_transform, support_body

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Clearance:
    """A signed distance.

    Attributes:
        distance: m, negative where there is penetration.
        pair: the names of what is so close, the arm's side first.
    """

    distance: float
    pair: tuple[str, str] = ("", "")


class ClearanceScene:
    """Signed distances between the arm, what it holds, and what stands around; objects stay where they were put.

    Attributes:
        arm_names: of the bodies of arm and tool.
        fixture_tops: Heights of the highest points of the cell's fixtures [m].
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        unseen: Sequence[UnseenBlock] = (),
    ) -> None:
        """Makes a plant of the arm, named objects, and space that must be taken for full."""
        builder = DiagramBuilder()
        made = add_scene_plant(builder, objects, cell.support, 0.0, visuals=False)
        self.plant, self._bodies = made.plant, made.bodies
        self._arm: Arm = add_work_cell(
            made.plant, made.scene_graph, cell, compliant=False, visuals=False
        )
        for k, block in enumerate(unseen):
            X_TB = RigidTransform(RotationMatrix.MakeZRotation(block.yaw), block.middle)
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
        self._at, self._v_at = joint_numbers(self.plant, self._arm)
        self._moved_by = self._joints_by_geometry(load_robot(cell.robot).links)
        self._fixed = (*self._arm.fixed, support_body(self.plant))
        self._names = self._name_geometries()
        self._parts = {
            geometry: (name, geometry in self._moved_by) for geometry, name in self._names.items()
        }
        self._filters = made.scene_graph.collision_filter_manager(self._geometry_context)
        standing = self._geometries(*self._fixed, *self._bodies.values())
        self._filters.Apply(CollisionFilterDeclaration().ExcludeWithin(standing))
        self.arm_names = frozenset(body.name() for body in self._arm.bodies)
        self.fixture_tops = self._tops({fixture.name for fixture in cell.fixtures})
        self._held: tuple[str, Floats] | None = None
        self._transient: list[object] = []

    def _geometries(self, *bodies: RigidBody) -> GeometrySet:
        found = GeometrySet()
        for body in bodies:
            found.Add(self.plant.GetCollisionGeometriesForBody(body))
        return found

    def _joints_by_geometry(self, links: Mapping[str, int]) -> dict[GeometryId, int]:
        """Return how many of the joints, from the base on, move each geometry of arm and tool.

        By geometry, as a link of the arm, one of the tool and an object may have one name.
        """
        found = dict[GeometryId, int]()
        for body in self._arm.bodies:
            moved_by = (
                links[body.name()] if body.model_instance() == self._arm.robot else len(self._at)
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

    def _tops(self, names: Collection[str]) -> tuple[float, ...]:
        query = self._query_port.Eval(self._geometry_context)
        inspector = self._scene_graph.model_inspector()
        tops = dict.fromkeys(names, -np.inf)
        for geometry, name in self._names.items():
            if name in tops and (box := inspector.GetObbInGeometryFrame(geometry)):
                X_TB = query.GetPoseInWorld(geometry) @ box.pose()
                half_height = np.abs(X_TB.rotation().matrix()[2]) @ box.half_width()
                tops[name] = max(tops[name], float(X_TB.translation()[2] + half_height))
        return tuple(tops.values())

    def put(self, objects: Sequence[SceneObject]) -> None:
        """Puts objects at their poses; the arm holds nothing any more."""
        self.release()
        for o in objects:
            self.plant.SetFreeBodyPose(self._context, self._bodies[o.name], rigid_transform(o.X_TO))
        self._q = self.plant.GetPositions(self._context)

    def put_one(self, name: str, X_TO: Pose) -> None:
        """Puts one object elsewhere."""
        self.plant.SetFreeBodyPose(self._context, self._bodies[name], rigid_transform(X_TO))
        self._q = self.plant.GetPositions(self._context)

    def hold(self, name: str, X_OG: RigidTransform) -> None:
        """From now on the object moves with the gripper."""
        self.release()
        held = self._geometries(self._bodies[name])
        others = self._geometries(*self._fixed, *(b for n, b in self._bodies.items() if n != name))
        tool = self._geometries(
            *(body for body in self._arm.bodies if body.model_instance() == self._arm.tool)
        )
        declaration = (
            CollisionFilterDeclaration().ExcludeBetween(held, tool).AllowBetween(held, others)
        )
        self._transient.append(self._filters.ApplyTransient(declaration))
        self._held = name, inverse(X_OG.GetAsMatrix4())

    def release(self) -> None:
        """Holds nothing any more."""
        while self._transient:
            self._filters.RemoveDeclaration(self._transient.pop())
        self._held = None

    def _close(self, q: Floats, within: float) -> list[SignedDistancePair]:
        self._q[self._at] = q
        self.plant.SetPositions(self._context, self._q)
        if self._held is not None:
            name, X_GO = self._held
            X_TG = self._arm.cup.CalcPoseInWorld(self._context).GetAsMatrix4()
            self.plant.SetFreeBodyPose(
                self._context, self._bodies[name], RigidTransform(X_TG @ X_GO)
            )
        found: list[SignedDistancePair] = self._query_port.Eval(
            self._geometry_context
        ).ComputeSignedDistancePairwiseClosestPoints(within)
        return found

    def _named(self, pair: SignedDistancePair) -> Clearance:
        (first, of_arm), (second, _) = self._parts[pair.id_A], self._parts[pair.id_B]
        moves = of_arm or (self._held is not None and first == self._held[0])
        return Clearance(float(pair.distance), (first, second) if moves else (second, first))

    def close(self, q: Floats, within: float) -> list[Clearance]:
        """At joint positions (n,): all that is closer than `within`, m."""
        return [self._named(pair) for pair in self._close(q, within)]

    def gradients(self, q: Floats, within: float) -> list[tuple[Clearance, Floats]]:
        """As `close`, each with how the distance changes with the joint positions, (n,) m/rad."""
        pairs = self._close(q, within)
        if not pairs:
            return []
        query, world = self._query_port.Eval(self._geometry_context), self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.flange, np.zeros(3), world, world
        )[:, self._v_at]
        p_TF = self._arm.flange.CalcPoseInWorld(self._context).translation()
        found = []
        for pair in pairs:
            gradient = np.zeros(len(self._at))
            for geometry, p_S, sign in (
                (pair.id_A, pair.p_ACa, 1.0),
                (pair.id_B, pair.p_BCb, -1.0),
            ):
                if joints := self._joints_that_move(geometry):
                    nx, ny, nz = sign * pair.nhat_BA_W
                    x, y, z = query.GetPoseInWorld(geometry).multiply(p_S) - p_TF
                    moment = (y * nz - z * ny, z * nx - x * nz, x * ny - y * nx)  # p_FC x n
                    gradient[:joints] += (*moment, nx, ny, nz) @ J[:, :joints]
            found.append((self._named(pair), gradient))
        return found

    def cup_position(self) -> Floats:
        """(3,) m, of the cup in T at the joint angles of the last question."""
        return np.asarray(self._arm.cup.CalcPoseInWorld(self._context).translation())

    def cup_jacobian(self, q: Floats) -> Floats:
        """(6, n) at joint positions (n,): how the cup turns (first three rows) and moves, in T."""
        self._q[self._at] = q
        self.plant.SetPositions(self._context, self._q)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.cup, np.zeros(3), world, world
        )
        return np.asarray(J[:, self._v_at])

    def _joints_that_move(self, geometry: GeometryId) -> int:
        name, of_arm = self._parts[geometry]
        if of_arm:
            return self._moved_by[geometry]
        return len(self._at) if self._held is not None and name == self._held[0] else 0
