"""What a suction cup can hold: whether it seals on a surface, and which loads it bears.

Frames: G the cup, origin in the middle of its lip, z out of the tool, into the object; O the object.

Sources: the vacuum of 80 % of the atmosphere is from memory of Robotiq's data sheet; the body's length and radius as in
PickNik's `epick_description` (BSD). A lip that is loaded evenly by the vacuum opens where tension and bending have used that up
(the ring contact of Mahler et al. 2018, "Dex-Net 3.0", section III).
"""

import math
from functools import lru_cache
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.epick import EPICK_LENGTH, EPICK_MASS, epick_sdf
from drake_clutter.cell.gripper import (
    Grasp,
    GraspFailure,
    GraspFailureReason,
    GraspSampling,
    Payload,
)
from drake_clutter.validation import InRange, StrictModel

Floats = NDArray[np.float64]

ATMOSPHERIC_PRESSURE = 101_325.0
"""Pa."""
GRAVITY = 9.81
"""m/s^2."""
_NUM_LIP_POINTS = 24
"""Points of the lip that are looked at."""
_RAY_STANDOFF = 0.05
"""m above the lip, from which is looked."""
_DOWNWARD_ROTATION = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
"""R_TG of a cup that points down."""
_ACCELERATION_DIRECTIONS = np.array(
    [
        [math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)]
        for e in (-0.8, 0.0, 0.8)
        for a in np.arange(8) * math.pi / 4
    ]
    + [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
)


class SuctionGripper(StrictModel):
    """The EPick with a cup of one and a half bellows on an extension tube.

    Attributes:
        kind: Names this gripper in a cell's file.
        cup_diameter: Of the lip [m].
        cup_length: Of the cup without load [m].
        extension: Length of the tube between body and cup [m].
        stroke: By which the cup can be pressed together or drawn out [m].
        stiffness: Along its axis [N/m].
        vacuum: Share of the atmosphere's pressure that is taken away.
        friction: Of the lip on cardboard, tin and plastic.
        unevenness: Out of a plane, that the lip still follows [m].
        safety: By how much the cup must be able to hold more than it is planned to.
    """

    kind: Literal["suction"] = "suction"
    cup_diameter: Annotated[float, InRange(0.005, 0.1)] = 0.025
    cup_length: Annotated[float, InRange(0.005, 0.1)] = 0.020
    extension: Annotated[float, InRange(0.01, 0.5)] = 0.100
    stroke: Annotated[float, InRange(0.001, 0.05)] = 0.006
    stiffness: Annotated[float, InRange(100.0, 1e5)] = 2_000.0
    vacuum: Annotated[float, InRange(0.01, 1.0)] = 0.8
    friction: Annotated[float, InRange(0.01, 10.0)] = 0.5
    unevenness: Annotated[float, InRange(0.0, 0.01)] = 0.001
    safety: Annotated[float, InRange(1.0, 100.0)] = 1.5

    @property
    def holding_force(self) -> float:
        """Force with which the atmosphere presses the lip on [N]."""
        return self.vacuum * ATMOSPHERIC_PRESSURE * math.pi * self.cup_diameter**2 / 4

    @property
    def length(self) -> float:
        """From the flange to the lip [m]."""
        return EPICK_LENGTH + self.extension + self.cup_length

    @property
    def mass(self) -> float:
        """Of the body, which counts towards the robot's payload [kg]."""
        return EPICK_MASS

    @property
    def X_FG(self) -> RigidTransform:
        """The cup at rest, in the flange's frame."""
        return RigidTransform([0.0, 0.0, self.length])

    @property
    def contact_links(self) -> tuple[str, ...]:
        """The cup."""
        return ("cup",)

    def model_sdf(self, *, compliant: bool) -> str:
        """Return the model, see `epick_sdf`."""
        return epick_sdf(
            extension=self.extension,
            cup_diameter=self.cup_diameter,
            cup_length=self.cup_length,
            stroke=self.stroke,
            stiffness=self.stiffness,
            compliant=compliant,
        )

    def sample_grasps(
        self,
        object_class: ObjectClass,
        X_TO: RigidTransform,
        sampling: GraspSampling,
    ) -> tuple[Grasp, ...] | GraspFailure:
        """Return where the cup seals on an object's top and can hold, see `Gripper`."""
        corners_T = object_class.corners @ np.ascontiguousarray(X_TO.rotation().matrix()).T
        corners_T = corners_T + X_TO.translation()
        lower, upper = corners_T.min(axis=0), corners_T.max(axis=0)
        found, least = list[Grasp](), math.inf
        for x, y in _grid_points(lower[:2], upper[:2], sampling.spacing):
            X_TG = RigidTransform(_DOWNWARD_ROTATION, [x, y, upper[2]])
            deviation = lip_flatness_deviation(
                object_class, X_TO.InvertAndCompose(X_TG), self.cup_diameter
            )
            least = min(least, deviation)
            if deviation > self.unevenness:
                continue
            p_GCm = X_TG.rotation().inverse() @ (X_TO.translation() - X_TG.translation())
            acceleration = self.max_acceleration(object_class.mass, p_GCm)
            if acceleration >= sampling.min_payload_acceleration:
                # How the load hangs to the side depends on the yaw; its depth below G does not.
                p_GCm = (0.0, 0.0, round(float(p_GCm[2]), 2))
                payload = Payload(object_class.mass, p_GCm, round(acceleration, 1))
                found.append(Grasp(X_TG.translation(), payload))
                if len(found) == sampling.max_grasps:
                    break
        if found:
            return tuple(found)
        if least > self.unevenness:
            return GraspFailure(GraspFailureReason.NO_SEAL, least)
        return GraspFailure(GraspFailureReason.TOO_HEAVY, object_class.mass)

    def can_attach(self, object_class: ObjectClass, X_OG: RigidTransform) -> bool:
        """Return whether the lip follows the surface at a pose."""
        return lip_flatness_deviation(object_class, X_OG, self.cup_diameter) <= self.unevenness

    def max_acceleration(self, mass: float, p_GCm: Floats) -> float:
        """Return the acceleration [m/s^2] of a cup that points down, see `Gripper`."""

        def bears(accelerations: Floats) -> NDArray[np.bool_]:
            load = payload_wrench(
                mass, p_GCm, accelerations[:, None, None] * _ACCELERATION_DIRECTIONS
            )
            return np.asarray(self.load_ratio(*load).max(axis=1) * self.safety <= 1)

        low, high = 0.0, 50.0
        while high - low > 0.01:
            between = np.linspace(low, high, 9)
            largest = int(np.argmin(np.append(bears(between), False))) - 1
            if largest < 0:
                return -1.0
            low, high = float(between[largest]), float(between[min(largest + 1, 8)])
        return low

    def load_ratio(self, force: Floats, moment: Floats) -> Floats:
        """Return the larger of what opens the lip and what makes it slide, see `Gripper`."""
        radius = self.cup_diameter / 2
        bending = np.hypot(moment[..., 0], moment[..., 1])
        opening = np.maximum(force[..., 2] + 2 * bending / radius, 0.0) / self.holding_force
        pressed = np.maximum(self.holding_force - force[..., 2], 1e-9)
        # A thin ring that turns in place slides with its whole circumference at its radius.
        tangential = np.hypot(np.hypot(force[..., 0], force[..., 1]), moment[..., 2] / radius)
        return np.asarray(np.maximum(opening, tangential / (self.friction * pressed)))


def _grid_points(lower: Floats, upper: Floats, spacing: float) -> Floats:
    """Return points of a rectangle, (n, 2), the nearest to its middle first."""
    steps = [np.arange(0, (hi - lo) / 2, spacing) for lo, hi in zip(lower, upper, strict=True)]
    x, y = np.meshgrid(*(np.concatenate([-s[:0:-1], s]) for s in steps), indexing="ij")
    middle = (lower + upper) / 2
    points = middle + np.column_stack([x.ravel(), y.ravel()])
    distances = np.round(np.linalg.norm(points - middle, axis=1), 6)
    return np.asarray(points[np.argsort(distances, kind="stable")])


@lru_cache(maxsize=256)
def _piece_half_spaces(object_class: ObjectClass) -> tuple[Floats, ...]:
    """(F, 4) of each convex piece: it is where n . p + d <= 0."""
    return tuple(np.asarray(ConvexHull(piece).equations) for piece in object_class.convex_pieces)


def lip_surface_profile(object_class: ObjectClass, X_OG: RigidTransform, diameter: float) -> Floats:
    """How far below the lip an object's surface is, along the cup's axis, at points around the lip, m; infinite in the air.

    Args:
        object_class: what the cup is on.
        X_OG: z into the object.
        diameter: m, of the lip.
    """
    R_OG = X_OG.rotation().matrix()
    angle = np.arange(_NUM_LIP_POINTS) * (2 * np.pi / _NUM_LIP_POINTS)
    ring = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_NUM_LIP_POINTS)]) * diameter / 2
    p = (ring - np.array([0.0, 0.0, _RAY_STANDOFF])) @ R_OG.T + X_OG.translation()
    along = R_OG[:, 2]
    depth = np.full(_NUM_LIP_POINTS, np.inf)
    for half_spaces in _piece_half_spaces(object_class):
        steep, outside = half_spaces[:, :3] @ along, p @ half_spaces[:, :3].T + half_spaces[:, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -outside / steep
        enters = np.where(steep < -1e-9, crossing, -np.inf).max(axis=1)
        leaves = np.where(steep > 1e-9, crossing, np.inf).min(axis=1)
        beside = (outside[:, np.abs(steep) <= 1e-9] > 0).any(axis=1)
        depth = np.where((enters <= leaves) & ~beside, np.minimum(depth, enters), depth)
    return depth - _RAY_STANDOFF


def lip_flatness_deviation(
    object_class: ObjectClass, X_OG: RigidTransform, diameter: float
) -> float:
    """How far, in m, the surface under the lip leaves a plane across the cup; infinite if the lip is partly in the air.

    Tilt, curvature, edges and gaps all show as this one number. Arguments: see `surface_under_lip`.
    """
    depth = lip_surface_profile(object_class, X_OG, diameter)
    return float(np.ptp(depth)) if np.isfinite(depth).all() else math.inf


def payload_wrench(mass: float, p_GCm: Floats, acceleration: Floats) -> tuple[Floats, Floats]:
    """Force (..., 3) N and moment (..., 3) N m on the lip of a cup that points down, from a body that it carries.

    Args:
        mass: kg.
        p_GCm: (3,) m, the body's centre of mass.
        acceleration: (..., 3) m/s^2, of that, in G; its turning is left out.
    """
    down = np.array([0.0, 0.0, GRAVITY])  # z of a cup that points down
    force = mass * (down - acceleration)
    return force, np.cross(np.broadcast_to(p_GCm, force.shape), force)
