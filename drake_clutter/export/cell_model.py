"""Bodies, joints and geometry of a work cell, as `read_cell_model` finds them in Drake's plant.

Frames: T is the support and the world, P is a parent body, B is a body, G is a geometry.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Shape
from pydrake.math import RigidTransform

from drake_clutter.cell.camera import Camera
from drake_clutter.export.model_parts import Inertial

Floats = NDArray[np.float64]
Color = tuple[float, float, float, float]
"""Red, green, blue and alpha in [0, 1]."""


@dataclass(frozen=True)
class Collision:
    """Collision geometry of a body.

    Attributes:
        shape: Shape.
        X_BG: Pose in the body.
        friction: Coefficient of friction.
    """

    shape: Shape
    X_BG: RigidTransform
    friction: float


@dataclass(frozen=True)
class Visual:
    """Visual geometry of a body.

    Attributes:
        shape: Shape.
        X_BG: Pose in the body.
        color: Color.
    """

    shape: Shape
    X_BG: RigidTransform
    color: Color


@dataclass(frozen=True)
class PositionActuator:
    """Position control of a joint: torque = p (q_d - q) + d (v_d - v) + feed-forward torque.

    Attributes:
        stiffness: Gain p [N m/rad] or [N/m].
        damping: Gain d [N m s/rad] or [N s/m].
        effort_limit: Largest torque [N m] or force [N].
        gravity_effort: Torque [N m] or force [N] that carries the weight at home.
    """

    stiffness: float
    damping: float
    effort_limit: float
    gravity_effort: float


@dataclass(frozen=True)
class CellJoint:
    """Revolute or prismatic joint between a body and its parent.

    Attributes:
        name: Unique name.
        is_revolute: Whether it is revolute.
        axis_B: Axis in the body, a unit vector. Shape (3,).
        p_B: Point on the axis in the body [m]. Shape (3,).
        limits: Lower and upper position limit [rad] or [m]; infinite without.
        home: Position at home [rad] or [m].
        damping: Damping [N m s/rad] or [N s/m].
        spring: Stiffness [N m/rad] or [N/m], and position without force [rad] or [m].
        armature: Reflected inertia of the rotor [kg m^2] or [kg].
        actuator: Position control; None for a joint without.
    """

    name: str
    is_revolute: bool
    axis_B: Floats
    p_B: Floats
    limits: tuple[float, float]
    home: float
    damping: float
    spring: tuple[float, float]
    armature: float
    actuator: PositionActuator | None


@dataclass(frozen=True)
class CellBody:
    """Body of a cell.

    Attributes:
        name: Unique name, `PART/BODY`; parts are `robot`, `gripper` and `cell`.
        parent: Name of the parent; "" for the world.
        X_PB: Pose in the parent at joint position 0.
        X_TB: Pose at home.
        joint: Joint that moves it; None if it is fixed to its parent.
        inertial: Mass properties; None without mass.
        collisions: Collision geometry.
        visuals: Visual geometry.
    """

    name: str
    parent: str
    X_PB: RigidTransform
    X_TB: RigidTransform
    joint: CellJoint | None
    inertial: Inertial | None
    collisions: tuple[Collision, ...]
    visuals: tuple[Visual, ...]


@dataclass(frozen=True)
class CellFrame:
    """Frame of interest.

    Attributes:
        name: Unique name.
        body: Name of the body.
        X_BF: Pose in the body.
    """

    name: str
    body: str
    X_BF: RigidTransform


@dataclass(frozen=True)
class CellCamera:
    """Camera on a body or in the world.

    Attributes:
        name: Unique name.
        camera: Image size and field of view.
        body: Name of the body; "" for the world.
        X_BC: Pose in the body.
    """

    name: str
    camera: Camera
    body: str
    X_BC: RigidTransform


@dataclass(frozen=True)
class JointCoupling:
    """Position of a joint as a multiple of that of another one, plus an offset.

    Attributes:
        joint: Name of the joint.
        other: Name of the other joint.
        multiplier: Multiple.
        offset: Offset [rad] or [m].
    """

    joint: str
    other: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class CellModel:
    """A work cell without its support.

    Attributes:
        bodies: Bodies, parents first.
        frames: Flange `robot/FRAME` and tools `gripper/TOOL`.
        cameras: Cameras of the cell, and `robot/wrist` on the flange.
        couplings: Couplings of joints.
        excluded: Pairs of bodies, by name, that never collide, and of which one can move.
    """

    bodies: tuple[CellBody, ...]
    frames: tuple[CellFrame, ...]
    cameras: tuple[CellCamera, ...]
    couplings: tuple[JointCoupling, ...]
    excluded: tuple[tuple[str, str], ...]
