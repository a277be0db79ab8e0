"""Links made of cylinders and capsules, as SDF."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Rod:
    """A cylinder, or with round ends a capsule.

    Attributes:
        start, end: (3,) m, ends of its axis, in the link's frame.
        radius: m.
        colour: of a visual one.
    """

    start: Point
    end: Point
    radius: float
    colour: str = ""


def sdf_pose(p: Floats, rotation: Rotation, relative_to: str = "") -> str:
    """SDF pose of a position (3,) m and a rotation."""
    numbers = " ".join(f"{value:.12g}" for value in (*p, *rotation.as_quat(canonical=True)))
    frame = f' relative_to="{relative_to}"' if relative_to else ""
    return f'<pose rotation_format="quat_xyzw"{frame}>{numbers}</pose>'


def sdf_geometry(kind: str, name: str, rod: Rod, shape: str) -> str:
    """A visual or collision element: the rod as a cylinder or capsule."""
    start, end = np.array(rod.start), np.array(rod.end)
    length = math.dist(start, end)
    turn, _ = Rotation.align_vectors((end - start)[None], np.array([[0.0, 0.0, 1.0]]))
    material = (
        f"\n        <material><diffuse>{rod.colour}</diffuse></material>"
        if kind == "visual" and rod.colour
        else ""
    )
    return f"""
      <{kind} name="{name}">
        {sdf_pose((start + end) / 2, turn)}
        <geometry><{shape}><radius>{rod.radius:.6g}</radius><length>{length:.6g}</length></{shape}></geometry>{material}
      </{kind}>"""


def sdf_inertial(mass: float, p_LCm: Floats, spine: Rod) -> str:
    """Of a solid cylinder of the mass that is as long and as thick as the link's longest part, about the centre of mass."""
    start, end = np.array(spine.start), np.array(spine.end)
    length = max(float(np.linalg.norm(end - start)), 1e-3)
    axis = (end - start) / length
    along, across = mass * spine.radius**2 / 2, mass * (3 * spine.radius**2 + length**2) / 12
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
    outline: tuple[Rod, ...],
    looks: tuple[Rod, ...],
    shape: str = "capsule",
) -> str:
    """A link; its outline consists of capsules or cylinders, the inertia is that of its longest visible part."""
    spine = max(looks, key=lambda rod: math.dist(rod.start, rod.end))
    shapes = [
        sdf_geometry("collision", f"outline_{k}", rod, shape) for k, rod in enumerate(outline)
    ]
    shapes += [sdf_geometry("visual", f"part_{k}", rod, "cylinder") for k, rod in enumerate(looks)]
    return f"""
    <link name="{name}">{pose}{sdf_inertial(mass, p_LCm, spine)}{"".join(shapes)}
    </link>"""
