"""SDF elements of links made of cylinders and capsules."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Point = tuple[float, float, float]
"""Position (x, y, z) [m]."""


@dataclass(frozen=True)
class LinkPrimitive:
    """Cylinder or capsule of a link.

    Attributes:
        start: Start of the axis in the frame of the link [m].
        end: End of the axis in the frame of the link [m].
        radius: Radius [m].
        color: Color of a visual as "red green blue alpha", 0 to 1; "" for none.
    """

    start: Point
    end: Point
    radius: float
    color: str = ""


def sdf_pose(p: Floats, rotation: Rotation, relative_to: str = "") -> str:
    """Return an SDF pose element.

    Args:
        p: Position [m]. Shape (3,).
        rotation: Orientation.
        relative_to: Name of the frame; "" for the default of SDF.
    """
    numbers = " ".join(f"{value:.12g}" for value in (*p, *rotation.as_quat(canonical=True)))
    frame = f' relative_to="{relative_to}"' if relative_to else ""
    return f'<pose rotation_format="quat_xyzw"{frame}>{numbers}</pose>'


def sdf_geometry(element: str, name: str, primitive: LinkPrimitive, shape: str) -> str:
    """Return an SDF visual or collision element of a primitive.

    Args:
        element: `visual` or `collision`.
        name: Name of the element.
        primitive: Primitive.
        shape: `cylinder` or `capsule`.
    """
    start = np.array(primitive.start)
    end = np.array(primitive.end)
    length = math.dist(start, end)
    rotation, _ = Rotation.align_vectors((end - start)[None], np.array([[0.0, 0.0, 1.0]]))
    material = (
        f"\n        <material><diffuse>{primitive.color}</diffuse></material>"
        if element == "visual" and primitive.color
        else ""
    )
    size = f"<radius>{primitive.radius:.6g}</radius><length>{length:.6g}</length>"
    return f"""
      <{element} name="{name}">
        {sdf_pose((start + end) / 2, rotation)}
        <geometry><{shape}>{size}</{shape}></geometry>{material}
      </{element}>"""


def sdf_inertial(mass: float, p_LCm: Floats, primitive: LinkPrimitive) -> str:
    """Return an SDF inertial element with the inertia of a solid cylinder.

    Args:
        mass: Mass [kg].
        p_LCm: Center of mass in the frame of the link [m]. Shape (3,).
        primitive: Cylinder.
    """
    start = np.array(primitive.start)
    end = np.array(primitive.end)
    length = max(float(np.linalg.norm(end - start)), 1e-3)
    axis = (end - start) / length
    axial = mass * primitive.radius**2 / 2
    transverse = mass * (3 * primitive.radius**2 + length**2) / 12
    tensor = transverse * np.eye(3) + (axial - transverse) * np.outer(axis, axis)
    indices = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    entries = "".join(
        f"<i{'xyz'[i]}{'xyz'[j]}>{tensor[i, j]:.6g}</i{'xyz'[i]}{'xyz'[j]}>" for i, j in indices
    )
    return f"""
      <inertial>
        <pose>{" ".join(f"{value:.6g}" for value in p_LCm)} 0 0 0</pose>
        <mass>{mass:.6g}</mass>
        <inertia>{entries}</inertia>
      </inertial>"""


def sdf_link(
    name: str,
    pose: str,
    mass: float,
    p_LCm: Floats,
    collision_geometry: tuple[LinkPrimitive, ...],
    visual_geometry: tuple[LinkPrimitive, ...],
    shape: str = "capsule",
) -> str:
    """Return an SDF link element.

    Args:
        name: Name of the link.
        pose: SDF pose element; "" for none.
        mass: Mass [kg].
        p_LCm: Center of mass in the frame of the link [m]. Shape (3,).
        collision_geometry: Primitives of the collision geometry.
        visual_geometry: Cylinders of the visual geometry. The longest one determines the inertia.
        shape: Shape of the collision geometry, `capsule` or `cylinder`.
    """
    longest = max(visual_geometry, key=lambda cylinder: math.dist(cylinder.start, cylinder.end))
    elements = [
        sdf_geometry("collision", f"outline_{k}", primitive, shape)
        for k, primitive in enumerate(collision_geometry)
    ]
    elements += [
        sdf_geometry("visual", f"part_{k}", cylinder, "cylinder")
        for k, cylinder in enumerate(visual_geometry)
    ]
    return f"""
    <link name="{name}">{pose}{sdf_inertial(mass, p_LCm, longest)}{"".join(elements)}
    </link>"""
