"""Parallel-jaw gripper: two opposed pads that hold an object by friction.

Frames: F is the flange, z out of the arm; G is the tool, its origin midway between the centers of
the pads, z out of the arm, y from the right to the left jaw; O is the object.

Sources: stroke, forces, mass and length are those of the Robotiq 2F-85 (instruction manual, section
"Specifications"). Assumptions: the jaws move on straight lines, while those of the 2F-85 move on
arcs of 14 mm height; size of pads, jaws and palm; friction of the pads.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix

from drake_clutter.assets.contact_properties import SURFACE_FRICTION
from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.gripper import (
    UP,
    Grasp,
    GraspFailure,
    GraspFailureReason,
    GraspSampling,
    LazyGrasps,
    Payload,
    Tool,
)
from drake_clutter.cell.jaw_sdf import JawGeometry, jaw_sdf
from drake_clutter.cell.opposed_faces import PadContact, closing_poses, find_pad_contact
from drake_clutter.cell.payload_limits import max_payload_acceleration
from drake_clutter.validation import InRange, StrictModel

Floats = NDArray[np.float64]

JAWS = "jaws"
"""Name of the only tool."""
_NUM_CYLINDER_ANGLES = 6
"""Number of directions in which a standing cylinder is grasped."""
_MIN_PAD_OVERLAP = 0.008
"""Least height of the part of an object that is between the pads [m]."""
_SHORTER_INSERTIONS = (0.0, 1 / 3, 2 / 3)
"""Shares of the height of a pad by which the jaws reach less far than they can."""
_PALM_CLEARANCE = 0.006
"""Distance of an object to the palm, and of the tips of the jaws to what the object is on [m]."""
_PATCH_RADIUS = 0.011
"""Radius of a contact patch of uniform pressure [m]: half of the width of a pad; an assumption."""


class ParallelJawGripper(StrictModel):
    """Parallel-jaw gripper with the dimensions of the Robotiq 2F-85.

    Attributes:
        kind: Kind of the gripper in a cell file.
        stroke: Largest opening of the jaws [m].
        force: Force of each jaw on the object [N]; 20 to 235 for the 2F-85.
        friction: Friction coefficient between pads and objects.
        clearance: Distance of each jaw to the object before and after the grasp [m].
        mass: Mass [kg].
        safety: Safety factor of the load capacity in planning.
    """

    kind: Literal["parallel_jaw"]
    stroke: Annotated[float, InRange(0.01, 0.5)] = 0.085
    force: Annotated[float, InRange(1.0, 1000.0)] = 60.0
    friction: Annotated[float, InRange(0.05, 0.95)] = 0.6
    clearance: Annotated[float, InRange(0.0, 0.05)] = 0.007
    mass: Annotated[float, InRange(0.1, 20.0)] = 0.925
    safety: Annotated[float, InRange(1.0, 100.0)] = 2.0

    @property
    def description(self) -> str:
        """Kind and stroke."""
        return f"parallel jaws, {1000 * self.stroke:g} mm"

    @property
    def geometry(self) -> JawGeometry:
        """Shapes of palm and jaws."""
        # Drake combines coefficients as 2 a b / (a + b).
        pad_friction = self.friction * SURFACE_FRICTION / (2 * SURFACE_FRICTION - self.friction)
        return JawGeometry(self.stroke, self.force, self.mass, pad_friction)

    @property
    def tools(self) -> Mapping[str, Tool]:
        """The pair of jaws."""
        geometry = self.geometry
        return {JAWS: Tool(JAWS, JAWS, geometry.X_FG, geometry.jaw_links, None)}

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Guides of the left and the right jaw."""
        return self.geometry.jaw_joints

    @property
    def num_joints(self) -> int:
        """Both jaws."""
        return 2

    @property
    def num_actuated_joints(self) -> int:
        """Both jaws."""
        return 2

    def model_sdf(self, *, compliant: bool, actuated: bool) -> str:
        """Return the SDF model, see `jaw_sdf`; no part is compliant."""
        return jaw_sdf(self.geometry, coupled=compliant, movable=actuated)

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> Sequence[Grasp] | GraspFailure:
        """Return grasps on two opposed faces, see `Gripper`.

        From above, boxes are grasped on two vertical faces, upright cylinders in several
        directions, lying ones across. Meshes, and all objects from their sides, are grasped where
        rays find opposed faces, see `opposed_faces`.
        """
        if sampling.normal != UP or object_class.shape is Shape.MESH:
            return self._sample_opposed_faces(object_class, X_TO, sampling)
        corners_T = object_class.corners @ np.ascontiguousarray(X_TO.rotation().matrix()).T
        corners_T = corners_T + X_TO.translation()
        bottom, top = float(corners_T[:, 2].min()), float(corners_T[:, 2].max())
        height = self._pad_height(bottom, top)
        if height is None:
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, top - bottom)
        p_TCm = X_TO @ object_class.center_of_mass
        widths = list[float]()
        grasps = list[Grasp]()
        for direction, width in _opposed_faces(object_class, X_TO):
            widths.append(width)
            if width + 2 * self.clearance > self.stroke:
                continue
            z = np.array([0.0, 0.0, -1.0])
            y = np.array([*(direction[:2] / np.linalg.norm(direction[:2])), 0.0])
            R_TG = RotationMatrix(np.column_stack([np.cross(y, z), y, z]))
            X_TG = RigidTransform(R_TG, [*X_TO.translation()[:2], height])
            insertion = top - height + self.geometry.pad_size[2] / 2
            grasp = self._grasp_at(object_class, X_TG, p_TCm, width, insertion)
            if grasp.payload.max_acceleration >= sampling.min_payload_acceleration:
                grasps.append(replace(grasp, num_angles=2))
        if grasps:
            return tuple(grasps[: sampling.max_grasps])
        narrowest = min(widths, default=math.inf)
        if narrowest + 2 * self.clearance > self.stroke:
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, narrowest)
        return GraspFailure(GraspFailureReason.TOO_HEAVY, object_class.mass)

    def _sample_opposed_faces(
        self, object_class: ObjectClass, X_TO: RigidTransform, sampling: GraspSampling
    ) -> Sequence[Grasp] | GraspFailure:
        """Return grasps on opposed faces that rays find, see `sample_grasps`."""
        normal = np.array(sampling.normal)
        along_normal = X_TO.multiply(object_class.corners.T).T @ normal
        bottom, top = float(along_normal.min()), float(along_normal.max())
        # Only what is below an object keeps the tips of the jaws away.
        height = self._pad_height(bottom if sampling.normal == UP else -math.inf, top)
        if height is None:
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, top - bottom)
        max_insertion = top - height + self.geometry.pad_size[2] / 2
        widths = list[float]()
        grasps = LazyGrasps(
            islice(
                self._iterate_grasps(object_class, X_TO, sampling, max_insertion, widths),
                sampling.max_grasps,
            )
        )
        if next(iter(grasps), None):
            return grasps
        narrowest = min(widths, default=math.inf)
        if narrowest + 2 * self.clearance > self.stroke:
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, narrowest)
        return GraspFailure(GraspFailureReason.TOO_HEAVY, object_class.mass)

    def _iterate_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
        max_insertion: float,
        widths: list[float],
    ) -> Iterator[Grasp]:
        """Yield grasps on opposed faces.

        Args:
            object_class: Class of the object.
            X_TO: Pose of the object.
            sampling: Parameters of the sampling.
            max_insertion: Largest distance of the tips of the jaws below the side from which the
                object is seen [m]. Shorter ones are tried where friction does not hold it.
            widths: Receives the distances of what was between the pads [m].
        """
        p_TCm = X_TO @ object_class.center_of_mass
        poses = closing_poses(object_class, X_TO, np.array(sampling.normal), sampling.spacing)
        pad_height = float(self.geometry.pad_size[2])
        shorter = [max_insertion - share * pad_height for share in _SHORTER_INSERTIONS]
        insertions = [depth for depth in shorter if depth >= _MIN_PAD_OVERLAP]
        for X_TS in poses:
            for insertion in insertions:
                X_TG = X_TS @ RigidTransform([0.0, 0.0, insertion - pad_height / 2])
                contact = self._find_contact(object_class, X_TO, X_TG)
                width = contact.width if isinstance(contact, PadContact) else contact
                widths.append(width)
                if not isinstance(contact, PadContact) or width + 2 * self.clearance > self.stroke:
                    continue
                grasp = self._grasp_at(object_class, contact.X_TG, p_TCm, width, insertion)
                if grasp.payload.max_acceleration >= sampling.min_payload_acceleration:
                    yield replace(grasp, num_angles=2)
                    break

    def _find_contact(
        self, object_class: ObjectClass, X_TO: RigidTransform, X_TG: RigidTransform
    ) -> PadContact | float:
        """Return where the pads touch an object, see `find_pad_contact`."""
        pad = self.geometry.pad_size[[0, 2]]
        return find_pad_contact(object_class, X_TO, X_TG, pad, self.stroke, self.friction)

    def _grasp_at(
        self,
        object_class: ObjectClass,
        X_TG: RigidTransform,
        p_TCm: Floats,
        width: float,
        insertion: float,
    ) -> Grasp:
        """Return the grasp at a pose of the jaws.

        Args:
            object_class: Class of the object.
            X_TG: Pose of the jaws.
            p_TCm: Center of mass of the object [m]. Shape (3,).
            width: Distance of the opposed faces [m].
            insertion: Distance of the tips of the jaws below the side of the object from which it
                is seen [m].
        """
        p_GCm = X_TG.inverse() @ p_TCm
        down_G = -X_TG.rotation().matrix()[2]
        acceleration = self.max_acceleration(JAWS, object_class.mass, p_GCm, down_G)
        x_F, y_F, z_F = (self.geometry.X_FG @ np.round(p_GCm, 2)).tolist()
        held = (self.stroke - width) / 2
        return Grasp(
            JAWS,
            X_TG,
            Payload(object_class.mass, (x_F, y_F, z_F), round(acceleration, 1)),
            num_angles=1,
            insertion=max(0.0, insertion),
            joints_open=(held - self.clearance,) * 2,
            joints_held=(held,) * 2,
        )

    def make_grasp(
        self,
        tool: str,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        X_TG: RigidTransform,
        sampling: GraspSampling,
    ) -> Grasp | GraspFailure:
        """Return the grasp at a given pose of the jaws, see `Gripper`."""
        X_OG = X_TO.InvertAndCompose(X_TG)
        contact = self._find_contact(object_class, X_TO, X_TG)
        if not isinstance(contact, PadContact):
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, contact)
        width = contact.width
        if width + 2 * self.clearance > self.stroke:
            return GraspFailure(GraspFailureReason.NO_OPPOSED_FACES, width)
        p_TCm = X_TO @ object_class.center_of_mass
        corners_G = object_class.corners @ X_OG.rotation().matrix() + X_OG.inverse().translation()
        insertion = self.geometry.pad_size[2] / 2 - float(corners_G[:, 2].min())
        grasp = self._grasp_at(object_class, contact.X_TG, p_TCm, width, insertion)
        if grasp.payload.max_acceleration < sampling.min_payload_acceleration:
            acceleration = grasp.payload.max_acceleration
            return GraspFailure(GraspFailureReason.TOO_WEAK, acceleration)
        return grasp

    def can_attach(self, tool: str, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether faces of an object are between the pads, closer than the stroke."""
        contact = self._find_contact(object_class, RigidTransform(), X_OG)
        return isinstance(contact, PadContact) and contact.width < self.stroke

    def _pad_height(self, bottom: float, top: float) -> float | None:
        """Return the height of the pads' centers for an object [m]; None if it is too low."""
        half = self.geometry.pad_size[2] / 2
        lowest = bottom + _PALM_CLEARANCE + half
        highest = top + half - _MIN_PAD_OVERLAP
        deepest = top - self.geometry.palm_distance + _PALM_CLEARANCE
        height = max(top - half, lowest, deepest)
        return height if height <= highest else None

    def max_acceleration(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> float:
        """Return the largest acceleration of a load, see `Gripper`."""
        return max_payload_acceleration(
            mass, p_GCm, down_G, partial(self.load_ratio, tool), 1 / self.safety
        )

    def deflection(self, tool: str, mass: float, p_GCm: Floats, down_G: Floats) -> RigidTransform:
        """Return the identity: the jaws are rigid."""
        return RigidTransform()

    def load_ratio(self, tool: str, force: Floats, moment: Floats) -> Floats:
        """Return the ratio of a load to the load capacity; the object slips above 1.

        The limit surface of each patch is an ellipsoid (Howe and Cutkosky 1996, "Practical
        force-motion models for sliding manipulation", section 3); a patch of uniform pressure
        resists torsion with 2/3 of its radius. Moments about x and z act as pressure on the pads,
        which is neglected.

        Args:
            tool: Name of the tool.
            force: Force of the object on the gripper, in G [N]. Shape (..., 3).
            moment: Moment of the object about G, in G [N m]. Shape (..., 3).

        Returns:
            The larger of the ratios of slipping and of opening. Shape (...).
        """
        capacity = 2 * self.friction * self.force
        tangential = np.hypot(force[..., 0], force[..., 2]) / capacity
        torsion = np.abs(moment[..., 1]) / (capacity * 2 / 3 * _PATCH_RADIUS)
        return np.asarray(
            np.maximum(np.hypot(tangential, torsion), np.abs(force[..., 1]) / self.force)
        )


def _opposed_faces(
    object_class: ObjectClass, X_TO: RigidTransform
) -> Iterator[tuple[Floats, float]]:
    """Yield the direction in T and the distance [m] of opposed vertical faces, narrow ones first.

    Args:
        object_class: Class of the object.
        X_TO: Pose of the object.
    """
    R_TO = X_TO.rotation().matrix()
    up = int(np.argmax(np.abs(R_TO[2])))
    size = object_class.size
    if object_class.shape is Shape.BOX:
        for axis in sorted({0, 1, 2} - {up}, key=lambda axis: size[axis]):
            yield R_TO[:, axis], size[axis]
    elif object_class.shape is Shape.CYLINDER and up == 2:
        for angle in np.arange(_NUM_CYLINDER_ANGLES) * (math.pi / _NUM_CYLINDER_ANGLES):
            yield R_TO @ np.array([math.cos(angle), math.sin(angle), 0.0]), size[0]
    elif object_class.shape is Shape.CYLINDER:
        yield np.cross(R_TO[:, 2], np.array([0.0, 0.0, 1.0])), size[0]
