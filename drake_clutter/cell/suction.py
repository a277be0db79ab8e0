"""Suction gripper: where its cups seal on an object, and which loads they hold.

Frames: F is the flange; G is a cup, its origin at the center of the lip, z out of the tool, into
the object; O is the object.

Sources: Body dimensions as in PickNik's `epick_description` (BSD). The vacuum of 80 % of the
atmospheric pressure is an assumption, close to the specification of the Robotiq EPick. The lip
model is the ring contact of Mahler et al. 2018, "Dex-Net 3.0", section III: the vacuum loads the
lip uniformly, and the lip opens where tension and bending cancel that load.
"""

import math
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.cell.epick import EPICK_LENGTH, epick_mass, epick_sdf
from drake_clutter.cell.gripper import (
    Grasp,
    GraspFailure,
    GraspFailureReason,
    GraspSampling,
    Payload,
    Tool,
)
from drake_clutter.cell.payload_limits import max_payload_acceleration
from drake_clutter.cell.suction_cup import SuctionCup
from drake_clutter.validation import InRange, StrictModel, rejected_error

Floats = NDArray[np.float64]

ATMOSPHERIC_PRESSURE = 101_325.0
"""Standard atmospheric pressure [Pa]."""
MAX_SEAL_GAP = 0.005
"""Largest lip-to-surface gap at which the vacuum can build up [m]."""
_NUM_LIP_POINTS = 24
"""Number of points around the lip at which the surface is sampled."""
_RAY_STANDOFF = 0.05
"""Distance above the lip at which rays to the surface start [m], so that edges that rise above
the lip are seen."""
_DOWNWARD_ROTATION = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
"""R_TG of a cup that points down."""
_Mismatch = tuple[bool, float]
"""Of a profile that does not seal: whether it is uneven, and its deviation or gap [m]."""


class SuctionGripper(StrictModel):
    """Robotiq EPick vacuum gripper with bellows suction cups on tubes.

    The vacuum of each cup is switched separately.

    Attributes:
        kind: Kind of the gripper in a cell file.
        cups: Suction cups; the first that has a grasp is preferred.
        vacuum: Pressure difference as a fraction of the atmospheric pressure.
        friction: Friction coefficient of the lip on cardboard, tin and plastic.
        unevenness: Largest deviation of the surface under the lip from a plane at which the lip
            seals [m].
        safety: Safety factor of the load capacity in planning.
    """

    kind: Literal["suction"] = "suction"
    cups: Annotated[tuple[SuctionCup, ...], Field(min_length=1)]
    vacuum: Annotated[float, InRange(0.01, 1.0)] = 0.8
    friction: Annotated[float, InRange(0.01, 10.0)] = 0.5
    unevenness: Annotated[float, InRange(0.0, 0.01)] = 0.001
    safety: Annotated[float, InRange(1.0, 100.0)] = 1.5

    @model_validator(mode="before")
    @classmethod
    def _take_single_cup(cls, document: Any) -> Any:
        """Accept the fields of the single cup of earlier files in place of `cups`."""
        return _with_cups(document) if isinstance(document, dict) else document

    @field_validator("cups")
    @classmethod
    def _check_names(cls, cups: tuple[SuctionCup, ...]) -> tuple[SuctionCup, ...]:
        names = [cup.name for cup in cups]
        if twice := [name for k, name in enumerate(names) if name in names[:k]]:
            raise rejected_error(f"{twice[0]}: a cup's name; expected names that differ")
        return cups

    @property
    def description(self) -> str:
        """Kind and diameters of the cups."""
        diameters = ", ".join(f"{1000 * cup.diameter:g} mm" for cup in self.cups)
        return f"suction, {diameters}"

    @property
    def mass(self) -> float:
        """Mass of body, tubes and cups, which counts towards the payload of the robot [kg]."""
        return epick_mass(self.cups)

    @property
    def tools(self) -> Mapping[str, Tool]:
        """Cups by name."""
        return {
            cup.name: Tool(cup.name, cup.link, cup.X_FG.transform, (cup.link,), k)
            for k, cup in enumerate(self.cups)
        }

    def cup(self, name: str) -> SuctionCup:
        """Return the cup with a name."""
        return next(cup for cup in self.cups if cup.name == name)

    def holding_force(self, tool: str) -> float:
        """Return the force of the atmosphere on a cup [N].

        Args:
            tool: Name of the cup.
        """
        return self.vacuum * ATMOSPHERIC_PRESSURE * math.pi * self.cup(tool).diameter ** 2 / 4

    @property
    def num_joints(self) -> int:
        """Bellows of each cup."""
        return len(self.cups)

    @property
    def num_actuated_joints(self) -> int:
        """None: a vacuum holds the objects."""
        return 0

    def model_sdf(self, *, compliant: bool, actuated: bool) -> str:
        """Return the SDF model, see `epick_sdf`; no part is actuated."""
        return epick_sdf(self.cups, compliant=compliant)

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> tuple[Grasp, ...] | GraspFailure:
        """Return grasps on the top at which a lip seals and holds, see `Gripper`.

        Those of the first cup come first, and those of a cup in the order of their distances from
        the center of mass.
        """
        grasps = list[Grasp]()
        closest_mismatch: _Mismatch | None = (True, math.inf)
        for cup in self.cups:
            of_cup, mismatch = self._sample_grasps_of(cup, object_class, X_TO, sampling)
            grasps += of_cup
            if closest_mismatch is not None and mismatch is not None:
                mismatch = min(mismatch, closest_mismatch)
            closest_mismatch = mismatch
        if grasps:
            return tuple(grasps)
        if closest_mismatch is not None:
            return GraspFailure(GraspFailureReason.NO_SEAL, closest_mismatch[1])
        return GraspFailure(GraspFailureReason.TOO_HEAVY, object_class.mass)

    def _sample_grasps_of(
        self,
        cup: SuctionCup,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> tuple[list[Grasp], _Mismatch | None]:
        """Return the grasps of a cup, and the closest mismatch; None if the cup seals somewhere."""
        corners_T = object_class.corners @ np.ascontiguousarray(X_TO.rotation().matrix()).T
        corners_T = corners_T + X_TO.translation()
        lower, upper = corners_T.min(axis=0), corners_T.max(axis=0)
        grasps = list[Grasp]()
        p_TCm = X_TO @ object_class.center_of_mass
        closest_mismatch: _Mismatch = (True, math.inf)
        has_seal = False
        for x, y in _grid_points(lower[:2], upper[:2], p_TCm[:2], sampling.spacing):
            X_TG = RigidTransform(_DOWNWARD_ROTATION, [x, y, upper[2]])
            X_OG = X_TO.InvertAndCompose(X_TG)
            profile = lip_surface_profile(object_class, X_OG, cup.diameter)
            if object_class.shape is Shape.MESH and np.isfinite(profile).all():
                # The lip goes down until it touches a convex piece, which may bulge.
                contact_depth = _contact_depth(object_class, X_OG, cup.diameter)
                X_TG = RigidTransform(_DOWNWARD_ROTATION, [x, y, upper[2] - contact_depth])
                profile = profile - contact_depth
            profile = profile + sampling.lip_gap
            if not self._seals(profile):
                deviation = _deviation(profile)
                is_uneven = deviation > self.unevenness
                value = deviation if is_uneven else float(profile.min())
                closest_mismatch = min(closest_mismatch, (is_uneven, value))
                continue
            has_seal = True
            p_GCm = X_TG.rotation().inverse() @ (p_TCm - X_TG.translation())
            acceleration = self.max_acceleration(cup.name, object_class.mass, p_GCm)
            if acceleration >= sampling.min_payload_acceleration:
                # The horizontal offset of the load depends on the yaw, and is neglected.
                p_GCm = (0.0, 0.0, round(float(p_GCm[2]), 2))
                a, b, c = (cup.X_FG.transform @ np.array(p_GCm)).tolist()
                payload = Payload(object_class.mass, (a, b, c), acceleration)
                grasps.append(Grasp(cup.name, X_TG, payload))
                if len(grasps) == sampling.max_grasps:
                    break
        return grasps, None if has_seal else closest_mismatch

    def can_attach(self, tool: str, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether the lip seals on the surface at a pose, see `Gripper`."""
        return self._seals(lip_surface_profile(object_class, X_OG, self.cup(tool).diameter))

    def _seals(self, profile: Floats) -> bool:
        """Return whether the lip seals at distances to the surface, see `lip_surface_profile`."""
        return bool(_deviation(profile) <= self.unevenness and profile.min() <= MAX_SEAL_GAP)

    def max_acceleration(self, tool: str, mass: float, p_GCm: Floats) -> float:
        """Return the largest acceleration of a load, see `max_payload_acceleration`.

        Args:
            tool: Name of the cup.
            mass: Mass of the load [kg].
            p_GCm: Center of mass of the load [m]. Shape (3,).
        """
        return max_payload_acceleration(
            mass, p_GCm, partial(self.load_ratio, tool), 1 / self.safety
        )

    def load_ratio(self, tool: str, force: Floats, moment: Floats) -> Floats:
        """Return the ratio of a load to the load capacity of a cup; it detaches above 1.

        Args:
            tool: Name of the cup.
            force: Force of the object on the cup, in G [N]. Shape (..., 3).
            moment: Moment of the object about G, in G [N m]. Shape (..., 3).

        Returns:
            The larger of the ratios of opening and of sliding. Shape (...).
        """
        radius = self.cup(tool).diameter / 2
        holding_force = self.holding_force(tool)
        bending = np.hypot(moment[..., 0], moment[..., 1])
        opening = np.maximum(force[..., 2] + 2 * bending / radius, 0.0) / holding_force
        normal_force = np.maximum(holding_force - force[..., 2], 1e-9)
        # A torsional moment acts as tangential force at the radius of the lip, a thin ring.
        tangential = np.hypot(np.hypot(force[..., 0], force[..., 1]), moment[..., 2] / radius)
        return np.asarray(np.maximum(opening, tangential / (self.friction * normal_force)))


_CUP_FIELDS = {
    "cup_diameter": "diameter",
    "cup_length": "length",
    "extension": "extension",
    "stroke": "stroke",
    "stiffness": "stiffness",
}
"""Fields of a cup by those of the gripper's only cup in earlier files."""


def _with_cups(document: dict[str, Any]) -> dict[str, Any]:
    """Return a document of a gripper with the fields of an only cup as `cups`.

    They change the cup of a gripper that has one, and replace the cups of any other.
    """
    given = {_CUP_FIELDS[key]: value for key, value in document.items() if key in _CUP_FIELDS}
    if not given and "cups" in document:
        return document
    rest = {key: value for key, value in document.items() if key not in _CUP_FIELDS}
    cups = rest.get("cups")
    is_only = isinstance(cups, tuple) and len(cups) == 1 and isinstance(cups[0], SuctionCup)
    cup: dict[str, Any] = {"name": "single", "extension": 0.100, "length": 0.020}
    cup |= {**(dict(cups[0]) if is_only and cups else {}), **given}
    if "X_FG" not in cup or given.keys() & {"extension", "length"}:
        extension, length = cup["extension"], cup["length"]
        is_valid = isinstance(extension, int | float) and isinstance(length, int | float)
        z = EPICK_LENGTH + extension + length if is_valid else 0.0
        cup["X_FG"] = {"translation": [0.0, 0.0, z]}
    return {**rest, "cups": [cup]}


def _grid_points(lower: Floats, upper: Floats, target: Floats, spacing: float) -> Floats:
    """Return grid points of a rectangle, the closest to a target first.

    Args:
        lower: Lower corner [m]. Shape (2,).
        upper: Upper corner [m]. Shape (2,).
        target: Position of the target [m]. Shape (2,).
        spacing: Grid spacing [m].

    Returns:
        Points. Shape (m, 2).
    """
    steps = [np.arange(0, (hi - lo) / 2, spacing) for lo, hi in zip(lower, upper, strict=True)]
    x, y = np.meshgrid(*(np.concatenate([-s[:0:-1], s]) for s in steps), indexing="ij")
    center = (lower + upper) / 2
    points = center + np.column_stack([x.ravel(), y.ravel()])
    distances = np.round(np.linalg.norm(points - target, axis=1), 6)
    return np.asarray(points[np.argsort(distances, kind="stable")])


@lru_cache(maxsize=256)
def _piece_half_spaces(object_class: ObjectClass) -> tuple[Floats, ...]:
    """Return rows (n, d) of n . p + d <= 0 inside of each convex piece. Shapes (F, 4)."""
    return tuple(np.asarray(ConvexHull(piece).equations) for piece in object_class.convex_pieces)


def _ring_points(diameter: float) -> Floats:
    """Return points of a circle in the plane of the lip [m]. Shape (24, 3)."""
    angle = np.arange(_NUM_LIP_POINTS) * (2 * np.pi / _NUM_LIP_POINTS)
    unit = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_NUM_LIP_POINTS)])
    return np.asarray(unit * diameter / 2)


def _piece_depths(object_class: ObjectClass, X_OG: RigidTransform, points: Floats) -> Floats:
    """Return the depth of the convex pieces below points of the lip.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        points: Points in G [m]. Shape (n, 3).

    Returns:
        Distances along z of G [m]; infinite where no surface is below. Shape (n,).
    """
    R_OG = X_OG.rotation().matrix()
    starts = (points - np.array([0.0, 0.0, _RAY_STANDOFF])) @ R_OG.T + X_OG.translation()
    direction = R_OG[:, 2]
    depth = np.full(len(points), np.inf)
    # Intersect each ray with the half-spaces of each convex piece.
    for half_spaces in _piece_half_spaces(object_class):
        slope = half_spaces[:, :3] @ direction
        offset = starts @ half_spaces[:, :3].T + half_spaces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -offset / slope
        entry = np.where(slope < -1e-9, crossing, -np.inf).max(axis=1)
        leaving = np.where(slope > 1e-9, crossing, np.inf).min(axis=1)
        misses = (offset[:, np.abs(slope) <= 1e-9] > 0).any(axis=1)
        depth = np.where((entry <= leaving) & ~misses, np.minimum(depth, entry), depth)
    return depth - _RAY_STANDOFF


def _mesh_depths(object_class: ObjectClass, X_OG: RigidTransform, points: Floats) -> Floats:
    """Return the depth of a mesh below points of the lip, see `_piece_depths`."""
    triangles = (object_class.surface_triangles - X_OG.translation()) @ X_OG.rotation().matrix()
    near = (triangles[:, :, :2].min(axis=1) <= points[:, :2].max(axis=0)).all(axis=1) & (
        triangles[:, :, :2].max(axis=1) >= points[:, :2].min(axis=0)
    ).all(axis=1)
    a, b, c = (triangles[near, corner] for corner in range(3))
    side_b = b - a
    side_c = c - a
    area = side_b[:, 0] * side_c[:, 1] - side_b[:, 1] * side_c[:, 0]
    arm_x = points[:, 0, None] - a[:, 0]
    arm_y = points[:, 1, None] - a[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        weight_b = (arm_x * side_c[:, 1] - arm_y * side_c[:, 0]) / area
        weight_c = (side_b[:, 0] * arm_y - side_b[:, 1] * arm_x) / area
        depth = a[:, 2] + weight_b * side_b[:, 2] + weight_c * side_c[:, 2]
        inside = (np.minimum(weight_b, weight_c) >= -1e-9) & (weight_b + weight_c <= 1 + 1e-9)
    return np.asarray(np.where(inside, depth, np.inf).min(axis=1, initial=np.inf))


def _contact_depth(object_class: ObjectClass, X_OG: RigidTransform, diameter: float) -> float:
    """Return how far a cup moves along z of G until it touches a convex piece [m]."""
    points = np.vstack([_ring_points(share * diameter) for share in (0.0, 0.5, 1.0)])
    return float(_piece_depths(object_class, X_OG, points).min())


def lip_surface_profile(object_class: ObjectClass, X_OG: RigidTransform, diameter: float) -> Floats:
    """Return the distance between lip and surface at points around the lip.

    The surface of a mesh is the mesh itself, as its convex pieces may bulge above a flat face.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        diameter: Diameter of the lip [m].

    Returns:
        Distances along z of G [m]; infinite where no surface is below. Shape (24,).
    """
    depths = _mesh_depths if object_class.shape is Shape.MESH else _piece_depths
    return depths(object_class, X_OG, _ring_points(diameter))


def lip_flatness_deviation(
    object_class: ObjectClass, X_OG: RigidTransform, diameter: float
) -> float:
    """Return the deviation of the surface under the lip from a plane [m].

    The plane is normal to the cup's axis. Tilt, curvature, edges and gaps all increase it.

    Args:
        object_class: Class of the object.
        X_OG: Pose of the gripper in the object.
        diameter: Diameter of the lip [m].

    Returns:
        Deviation [m]; infinite if a part of the lip has no surface below.
    """
    return _deviation(lip_surface_profile(object_class, X_OG, diameter))


def _deviation(profile: Floats) -> float:
    """Return the deviation of a `lip_surface_profile` from a plane [m]; infinite over an edge."""
    return float(np.ptp(profile)) if np.isfinite(profile).all() else math.inf
