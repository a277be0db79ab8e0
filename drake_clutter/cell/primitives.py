"""Links made of cylinders and capsules, as SDF."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class LinkPrimitive:
    """A cylinder, or with round ends a capsule.

    Attributes:
        start, end: (3,) m, ends of its axis, in the link's frame.
        radius: m.
        color: of a visual one.
    """

    start: Point
    end: Point
    radius: float
    color: str = ""


def sdf_pose(p: Floats, rotation: Rotation, relative_to: str = "") -> str:
    """SDF pose of a position (3,) m and a rotation."""
    numbers = " ".join(f"{value:.12g}" for value in (*p, *rotation.as_quat(canonical=True)))
    frame = f' relative_to="{relative_to}"' if relative_to else ""
    return f'<pose rotation_format="quat_xyzw"{frame}>{numbers}</pose>'


def sdf_geometry(element: str, name: str, primitive: LinkPrimitive, shape: str) -> str:
    """A visual or collision element: the rod as a cylinder or capsule."""
    start, end = np.array(primitive.start), np.array(primitive.end)
    length = math.dist(start, end)
    turn, _ = Rotation.align_vectors((end - start)[None], np.array([[0.0, 0.0, 1.0]]))
    material = (
        f"\n        <material><diffuse>{primitive.color}</diffuse></material>"
        if element == "visual" and primitive.color
        else ""
    )
    return f"""
      <{element} name="{name}">
        {sdf_pose((start + end) / 2, turn)}
        <geometry><{shape}><radius>{primitive.radius:.6g}</radius><length>{length:.6g}</length></{shape}></geometry>{material}
      </{element}>"""


def sdf_inertial(mass: float, p_LCm: Floats, primitive: LinkPrimitive) -> str:
    """Of a solid cylinder of the mass that is as long and as thick as the link's longest part, about the centre of mass."""
    start, end = np.array(primitive.start), np.array(primitive.end)
    length = max(float(np.linalg.norm(end - start)), 1e-3)
    axis = (end - start) / length
    along, across = (
        mass * primitive.radius**2 / 2,
        mass * (3 * primitive.radius**2 + length**2) / 12,
    )
    tensor = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    parts = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    entries = "".join(
        f"<i{'xyz'[i]}{'xyz'[j]}>{tensor[i, j]:.6g}</i{'xyz'[i]}{'xyz'[j]}>" for i, j in parts
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
    """A link; its outline consists of capsules or cylinders, the inertia is that of its longest visible part."""
    spine = max(visual_geometry, key=lambda rod: math.dist(rod.start, rod.end))
    shapes = [
        sdf_geometry("collision", f"outline_{k}", rod, shape)
        for k, rod in enumerate(collision_geometry)
    ]
    shapes += [
        sdf_geometry("visual", f"part_{k}", rod, "cylinder")
        for k, rod in enumerate(visual_geometry)
    ]
    return f"""
    <link name="{name}">{pose}{sdf_inertial(mass, p_LCm, spine)}{"".join(shapes)}
    </link>"""
