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
    Convex,
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
from drake_clutter.planning.shape_table import (
    FoundDistances,
    MovingCapsules,
    ShapeTable,
    hull_corners,
)
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

VIEW = "view"
"""Name of the volume that a camera looks through."""

_OCCLUDED_PREFIX = "unseen_"
"""Prefix of the geometries of occluded volumes."""


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


@dataclass(frozen=True)
class _Attached:
    """Object that is attached to the gripper, with its pose in the flange F."""

    name: str
    X_FO: RigidTransform


class CollisionModel:
    """Collision model of the arm in its cell, with objects at given poses.

    The configuration of the arm is an argument of the queries. One object can be attached to the
    gripper; it then moves with the arm.

    Attributes:
        plant: Plant of arm, cell and objects.
        arm_names: Names of the bodies of robot and gripper.
        fixture_tops: Height of the highest point of each fixture [m].
        fixed_corners: Corners of the convex hull of each fixed geometry that is not an occluded
            volume, in T [m]. Shapes (V, 3).
    """

    def __init__(
        self,
        cell: WorkCell,
        objects: Sequence[tuple[str, ObjectClass]],
        occluded: Sequence[OccludedBox] = (),
        view: Floats | None = None,
    ) -> None:
        """Build the model.

        Args:
            cell: Work cell with the arm.
            objects: Name and class of each object.
            occluded: Occluded volumes, which count as obstacles.
            view: Corners in T of the convex volume that a camera looks through, which counts as the
                obstacle `VIEW` [m]; None for no such volume. Shape (m, 3).
        """
        self._robot = load_robot(cell.robot)
        self._tools = cell.gripper.tools
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
                f"{_OCCLUDED_PREFIX}{k}",
                CoulombFriction(1.0, 1.0),
            )
        if view is not None:
            plant.RegisterCollisionGeometry(
                plant.world_body(),
                RigidTransform(),
                Convex(view.T, VIEW),
                VIEW,
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
        self._geometry_depths = self._find_geometry_depths(self._robot.link_depths)
        self._fixed = (*self._arm.fixed, get_support_body(plant))
        self._names = self._name_geometries()
        filters = scene_graph.collision_filter_manager(self._geometry_context)
        obstacles = self._geometries(*self._fixed, *self._bodies.values())
        filters.Apply(CollisionFilterDeclaration().ExcludeWithin(obstacles))
        self.arm_names = frozenset(body.name() for body in self._arm.bodies)
        self.fixture_tops = self._highest_points({fixture.name for fixture in cell.fixtures})
        self._attached: _Attached | None = None
        self._poses = dict[str, Pose]()
        self._stale = set[str]()
        """Objects whose poses in the context are outdated: only rare queries need the context."""
        self._gripper_joints: tuple[float, ...] | None = None
        self._pairs_by_attached = dict[str, NDArray[np.int64]]()
        self._collect_shapes()

    def _collect_shapes(self) -> None:
        """Collect all shapes and the pairs whose distances are computed."""
        self._q[self._q_indices] = 0.0
        self.plant.SetPositions(self._context, self._q)
        query = self._query_port.Eval(self._geometry_context)
        inspector = query.inspector()
        self._geometry_ids = [*self._names]
        self._shape_names = [*self._names.values()]
        self._owners = {name: k for k, name in enumerate(dict.fromkeys(self._shape_names))}
        self._shape_owners = np.array([self._owners[name] for name in self._shape_names])
        self._is_of_arm = np.array([name in self.arm_names for name in self._shape_names])
        self._shapes = ShapeTable(
            inspector,
            {geometry: self._geometry_depths.get(geometry, 0) for geometry in self._names},
            [query.GetPoseInWorld(geometry).GetAsMatrix4() for geometry in self._names],
            self._robot.chain,
            self._robot.X_TB.GetAsMatrix4(),
        )
        shape_of = {geometry: shape for shape, geometry in enumerate(self._geometry_ids)}
        pairs = [
            (first, second) if first in self._geometry_depths else (second, first)
            for first, second in inspector.GetCollisionCandidates()
        ]
        shapes = sorted((shape_of[first], shape_of[second]) for first, second in pairs)
        self._pairs = np.array(shapes, np.int64).reshape(-1, 2)

        def shapes_of(body: RigidBody) -> list[int]:
            return [shape_of[g] for g in self.plant.GetCollisionGeometriesForBody(body)]

        self._object_shapes = {
            name: [
                (shape, inspector.GetPoseInFrame(self._geometry_ids[shape]).GetAsMatrix4())
                for shape in shapes_of(body)
            ]
            for name, body in self._bodies.items()
        }
        hulls = {
            shape: query.GetPoseInWorld(self._geometry_ids[shape]).multiply(corners.T).T
            for body in self._fixed
            for shape in shapes_of(body)
            if not self._shape_names[shape].startswith(_OCCLUDED_PREFIX)
            and len(corners := hull_corners(inspector, self._geometry_ids[shape]))
        }
        self.fixed_corners = tuple(hulls.values())
        obstacles = (*self._fixed, *self._bodies.values())
        self._obstacle_shapes = [shape for body in obstacles for shape in shapes_of(body)]
        self._solid_shapes = [
            shape
            for shape in self._obstacle_shapes
            if not self._shape_names[shape].startswith(_OCCLUDED_PREFIX)
        ]
        everywhere = np.full(3, np.inf)
        self._fixed_bounds = {
            shape: (hulls[shape].min(axis=0), hulls[shape].max(axis=0))
            if shape in hulls
            else (-everywhere, everywhere)
            for body in self._fixed
            for shape in shapes_of(body)
            if not self._shape_names[shape].startswith(_OCCLUDED_PREFIX)
        }
        self._gripper_shapes = [
            shape
            for body in self._arm.bodies
            if body.model_instance() == self._arm.gripper
            for shape in shapes_of(body)
        ]

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
            self.set_object_pose(o.name, o.X_TO)

    def set_object_pose(self, name: str, X_TO: Pose) -> None:
        """Set the pose of one object."""
        if self._poses.get(name) != X_TO:
            self._poses[name] = X_TO
            self._place(name)

    def _place(self, name: str) -> None:
        """Place the shapes of an object at its pose."""
        self._stale.add(name)
        X_TO = rigid_transform(self._poses[name]).GetAsMatrix4()
        for shape, X_OS in self._object_shapes[name]:
            self._shapes.place(shape, X_TO @ X_OS)

    def set_gripper_joints(self, positions: Sequence[float]) -> None:
        """Set the positions of the gripper's actuated joints [m]."""
        if self._gripper_joints == tuple(positions):
            return
        self._gripper_joints = tuple(positions)
        self.plant.SetPositions(self._context, self._arm.gripper, np.array(positions))
        self._q = self.plant.GetPositions(self._context)
        X_FT = self._arm.flange.CalcPoseInWorld(self._context).inverse()
        query = self._query_port.Eval(self._geometry_context)
        for shape in self._gripper_shapes:
            X_FS = X_FT @ query.GetPoseInWorld(self._geometry_ids[shape])
            self._shapes.attach(shape, X_FS.GetAsMatrix4())

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
        X_FO = self._tools[tool].X_FG @ X_OG.inverse()
        X = X_FO.GetAsMatrix4()
        for shape, X_OS in self._object_shapes[name]:
            self._shapes.attach(shape, X @ X_OS)
        self._attached = _Attached(name, X_FO)

    def detach_object(self) -> None:
        """Detach the attached object, if any; it stays where it was before it was attached."""
        if self._attached is not None:
            name = self._attached.name
            self._attached = None
            self._place(name)

    def _attached_pairs(self, name: str) -> NDArray[np.int64]:
        """Return the pairs of shapes whose distances are computed if an object is attached.

        Those between the object and the gripper are left out, those between it and obstacles are
        added. The pairs of shapes have moving ones first. Shape (p, 2).
        """
        if name not in self._pairs_by_attached:
            attached = [shape for shape, _ in self._object_shapes[name]]
            is_attached = np.isin(self._pairs, attached).any(axis=1)
            with_gripper = is_attached & np.isin(self._pairs, self._gripper_shapes).any(axis=1)
            links = self._pairs[is_attached & ~with_gripper]
            others = [shape for shape in self._obstacle_shapes if shape not in attached]
            added = [(shape, other) for shape in attached for other in others]
            self._pairs_by_attached[name] = np.vstack(
                [self._pairs[~is_attached], links[:, ::-1], np.array(added, np.int64)]
            )
        return self._pairs_by_attached[name]

    def moving_capsules(self) -> MovingCapsules:
        """Return the round shapes of links and gripper, see `MovingCapsules`."""
        return self._shapes.moving_capsules()

    def owner_name(self, shape: int) -> str:
        """Return the name of the owner of a shape, see `SignedDistance.pair`."""
        return self._shape_names[shape]

    def distances_along(
        self,
        path: Floats,
        max_distance: float,
        *,
        with_gradients: bool = False,
        until_collision: bool = False,
    ) -> FoundDistances:
        """Return the signed distances below a threshold along a path.

        Args:
            path: Joint positions of the arm. Shape (m, n).
            max_distance: Threshold [m].
            with_gradients: Whether to compute gradients.
            until_collision: Whether to leave out what follows the first intersection of the arm, so
                that the depth of no other one is computed.
        """
        return self._find_distances(
            path,
            max_distance,
            self._active_pairs,
            with_gradients=with_gradients,
            until_collision=until_collision,
        )

    def is_between(self, found: FoundDistances, pair: tuple[str, str]) -> NDArray[np.bool_]:
        """Return whether each distance is one between the owners with two names. Shape (k,)."""
        first, second = (self._owners.get(name, -1) for name in pair)
        owners = self._shape_owners[found.pairs]
        return np.asarray((owners[:, 0] == first) & (owners[:, 1] == second))

    def is_of_attached(self, found: FoundDistances) -> NDArray[np.bool_]:
        """Return whether each distance is one of the attached object. Shape (k,)."""
        owner = self._owners[self._attached.name] if self._attached is not None else -1
        return np.asarray(self._shape_owners[found.pairs[:, 0]] == owner)

    def is_to_arm(self, found: FoundDistances) -> NDArray[np.bool_]:
        """Return whether each distance is one to a part of the arm. Shape (k,)."""
        return np.asarray(self._is_of_arm[found.pairs[:, 1]])

    def signed_distance(self, found: FoundDistances, index: int) -> SignedDistance:
        """Return the distance of an index."""
        first, second = found.pairs[index].tolist()
        pair = self._shape_names[first], self._shape_names[second]
        return SignedDistance(float(found.distances[index]), pair)

    def distances_below(self, q: Floats, max_distance: float) -> list[SignedDistance]:
        """Return the signed distances below a threshold.

        Args:
            q: Joint positions of the arm. Shape (n,).
            max_distance: Threshold [m].
        """
        found = self.distances_along(q[None], max_distance)
        return [self.signed_distance(found, k) for k in range(len(found.rows))]

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
        found = self.distances_along(q[None], max_distance, with_gradients=True)
        return [
            (self.signed_distance(found, k), gradient) for k, gradient in enumerate(found.gradients)
        ]

    def object_distances(self, name: str, max_distance: float) -> list[SignedDistance]:
        """Return the signed distances of an object to solids below a threshold.

        Solids are all other objects and what is fixed, without occluded volumes.

        Args:
            name: Name of the object, which is not attached.
            max_distance: Threshold, not negative [m].
        """
        shapes = [shape for shape, _ in self._object_shapes[name]]
        others = [shape for shape in self._solid_shapes if shape not in shapes]
        pairs = np.array([(shape, other) for shape in shapes for other in others], np.int64)
        q = np.zeros((1, len(self._q_indices)))
        found = self._find_distances(q, max_distance, pairs)
        return [self.signed_distance(found, k) for k in range(len(found.rows))]

    def deepest_overlap(
        self, objects: Sequence[SceneObject], min_depth: float
    ) -> SignedDistance | None:
        """Return the deepest overlap of objects with solids; None if none is deep enough.

        Solids are the other objects and what is fixed, without occluded volumes. The bounding boxes
        of solids that overlap by some depth do so along every axis, unlike those of most solids
        that touch.

        Args:
            objects: Objects at the poses of the model.
            min_depth: Depth above which an overlap counts, not negative [m].
        """
        bounds = [*(o.bounds_T for o in objects), *self._fixed_bounds.values()]
        lower, upper = np.array(bounds).swapaxes(0, 1)
        first = slice(len(objects))
        common = np.minimum(upper[first, None], upper) - np.maximum(lower[first, None], lower)
        shapes = [[shape for shape, _ in self._object_shapes[o.name]] for o in objects]
        shapes += [[shape] for shape in self._fixed_bounds]
        pairs = [
            (shape, other)
            for i, k in np.argwhere(np.triu((common > min_depth).all(axis=2), 1)).tolist()
            for shape in shapes[i]
            for other in shapes[k]
        ]
        q = np.zeros((1, len(self._q_indices)))
        found = self._find_distances(q, 0.0, np.array(pairs, np.int64).reshape(-1, 2))
        overlaps = [self.signed_distance(found, k) for k in range(len(found.rows))]
        deepest = min(overlaps, key=lambda overlap: overlap.distance, default=SignedDistance(0.0))
        return deepest if deepest.distance < -min_depth else None

    @property
    def _active_pairs(self) -> NDArray[np.int64]:
        """Pairs of shapes whose distances are computed. Shape (p, 2)."""
        return self._pairs if self._attached is None else self._attached_pairs(self._attached.name)

    def _find_distances(
        self,
        path: Floats,
        max_distance: float,
        pairs: NDArray[np.int64],
        *,
        with_gradients: bool = False,
        until_collision: bool = False,
    ) -> FoundDistances:
        found = self._shapes.find_distances(
            path, pairs, max_distance, with_gradients=with_gradients
        )
        unknown = np.isnan(found.distances)
        is_kept = np.ones(len(found.rows), bool)
        if until_collision:
            of_arm = np.flatnonzero(unknown & self._is_of_arm[found.pairs[:, 0]])
            is_kept[int(of_arm[0]) + 1 if len(of_arm) else len(is_kept) :] = False
        for k in np.flatnonzero(unknown & is_kept):
            # Depths of penetration and rare shapes are Drake's.
            pair = self._query_pair(path[found.rows[k]], found.pairs[k])
            found.distances[k] = pair.distance if pair else 0.0
            is_kept[k] = found.distances[k] <= max_distance
            if with_gradients:
                found.gradients[k] = self._gradient(pair) if pair else 0.0
        return found if is_kept.all() else found.select(is_kept)

    def _query_pair(self, q: Floats, shapes: NDArray[np.int64]) -> SignedDistancePair | None:
        """Return Drake's result for two shapes, which sets the context to joint positions.

        Returns:
            The result, or None for shapes that just touch: FCL, Drake's library of distances, fails
            on some of them.
        """
        for name in self._stale & {self._shape_names[shape] for shape in shapes}:
            X_TO = rigid_transform(self._poses[name])
            self.plant.SetFreeBodyPose(self._context, self._bodies[name], X_TO)
            self._q = self.plant.GetPositions(self._context)
            self._stale.remove(name)
        self._q[self._q_indices] = q
        self.plant.SetPositions(self._context, self._q)
        if self._attached is not None:
            name = self._attached.name
            X_TF = self._arm.flange.CalcPoseInWorld(self._context)
            self.plant.SetFreeBodyPose(
                self._context, self._bodies[name], X_TF @ self._attached.X_FO
            )
        query = self._query_port.Eval(self._geometry_context)
        try:
            pair: SignedDistancePair = query.ComputeSignedDistancePairClosestPoints(
                *(self._geometry_ids[shape] for shape in shapes)
            )
        except RuntimeError:
            return None
        return pair

    def _gradient(self, pair: SignedDistancePair) -> Floats:
        """Return the gradient of a pair at the positions in the context [m/rad]. Shape (n,)."""
        query = self._query_port.Eval(self._geometry_context)
        world = self.plant.world_frame()
        J = self.plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._arm.flange, np.zeros(3), world, world
        )[:, self._v_indices]
        p_TF = self._arm.flange.CalcPoseInWorld(self._context).translation()
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
        return gradient

    def lowest_points(self, q: Floats) -> Floats:
        """Return the height of the lowest point of the robot's moving links [m]. Shape (m,).

        Args:
            q: Joint positions of the arm. Shape (m, n).
        """
        gripper = {self._geometry_ids[shape] for shape in self._gripper_shapes}
        shapes = [
            shape
            for shape, geometry in enumerate(self._geometry_ids)
            if self._geometry_depths.get(geometry) and geometry not in gripper
        ]
        return self._shapes.lowest_points(q, shapes)

    def tool_positions(self, tool: str, path: Floats) -> Floats:
        """Return p_TG of a tool along a path [m]. Shape (m, 3).

        Args:
            tool: Name of the tool.
            path: Joint positions of the arm. Shape (m, n).
        """
        X_TF = self._robot.X_TB.GetAsMatrix4() @ self._robot.forward_kinematics(path)
        p_FG = self._tools[tool].X_FG.translation()
        return np.asarray(X_TF[:, :3, :3] @ p_FG + X_TF[:, :3, 3])

    def _num_moving_joints(self, geometry: GeometryId) -> int:
        if geometry in self._geometry_depths:
            return self._geometry_depths[geometry]
        is_attached = self._attached is not None and self._names[geometry] == self._attached.name
        return len(self._q_indices) if is_attached else 0
