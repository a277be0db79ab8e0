"""SDF models of the Universal Robots e-series: UR3e, UR5e, UR10e and UR16e.

Sources: Denavit-Hartenberg parameters, masses and centers of mass: Universal Robots, "DH parameters
for calculations of kinematics and dynamics". Torques: Universal Robots, "Max. joint torques".
Speeds: user manuals.

The capsules of UR3e and UR5e cover the meshes of `airo-models` 0.0.12 (MIT). No meshes of UR10e and
UR16e were available: their capsules cover the meshes of ROS-Industrial's UR10 (BSD), which has
joints of the same sizes, moved to the published lengths, with a margin of 1 to 10 mm. The margin is
1.3 times what capsules of the UR5e derived from the UR5 in the same way need. Their base is a
cylinder with the footprint of the data sheet. The masses of the bases are assumptions.
"""

import math
from dataclasses import dataclass

import numpy as np

from drake_clutter.cell.primitives import LinkPrimitive, Point
from drake_clutter.robots.ur_kinematics import DenavitHartenberg
from ur_family import CAP_COLOR, JOINT_COLOR, TUBE_COLOR, UrArm, UrLink

LINK_NAMES = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
BASE_MASS = 4.0
"""Mass of the base of all arms [kg]; an assumption."""


@dataclass(frozen=True)
class VisualShape:
    """Dimensions of the cylinders of an arm's visual geometry.

    Ends are coordinates along z of the link.

    Attributes:
        base: Radius and height [m].
        shoulder: Radius, lower end, upper end, and length of the part along -y [m].
        upper_arm: Radius, lower end and upper end of the housing at the shoulder [m].
        tube: Height and radius of the tube of the upper arm [m].
        elbow: Radius, lower end and upper end of the upper arm's housing at the elbow [m].
        forearm: Radius, lower end and upper end of the forearm's housing at the elbow [m].
        thin_tube: Height and radius of the tube of the forearm [m].
        wrist: Radius, lower end and upper end of the forearm's housing at the wrist [m].
        wrist_1: Lower end, upper end, and length of the part along -y [m].
        wrist_2: Lower end, upper end, and length of the part along y [m].
        wrist_3: Lower end [m].
    """

    base: tuple[float, float]
    shoulder: tuple[float, float, float, float]
    upper_arm: tuple[float, float, float]
    tube: tuple[float, float]
    elbow: tuple[float, float, float]
    forearm: tuple[float, float, float]
    thin_tube: tuple[float, float]
    wrist: tuple[float, float, float]
    wrist_1: tuple[float, float, float]
    wrist_2: tuple[float, float, float]
    wrist_3: float

    def visual_geometry(
        self, parameters: DenavitHartenberg
    ) -> tuple[tuple[LinkPrimitive, ...], ...]:
        """Return the cylinders of each moving link, in its frame."""
        _, a2, a3, *_ = parameters.a
        d1, _, _, d4, d5, d6 = parameters.d
        shoulder_length = self.shoulder[3]
        wrist_radius = self.wrist[0]
        return (
            (
                _vertical_cylinder(self.shoulder[:3]),
                _cylinder((0, 0, d1), (0, -shoulder_length, d1), self.shoulder[0]),
            ),
            (
                _vertical_cylinder(self.upper_arm),
                _tube(a2, self.tube),
                _vertical_cylinder(self.elbow, a2),
            ),
            (
                _vertical_cylinder(self.forearm),
                _tube(a3, self.thin_tube),
                _vertical_cylinder(self.wrist, a3),
            ),
            (
                _vertical_cylinder((wrist_radius, *self.wrist_1[:2])),
                _cylinder((0, 0, d4), (0, -self.wrist_1[2], d4), wrist_radius, CAP_COLOR),
            ),
            (
                _vertical_cylinder((wrist_radius, *self.wrist_2[:2])),
                _cylinder((0, 0, d5), (0, self.wrist_2[2], d5), wrist_radius, CAP_COLOR),
            ),
            (_cylinder((0, 0, self.wrist_3), (0, 0, d6), 0.85 * wrist_radius, TUBE_COLOR),),
        )


def _cylinder(start: Point, end: Point, radius: float, color: str = JOINT_COLOR) -> LinkPrimitive:
    return LinkPrimitive(start, end, radius, color)


def _vertical_cylinder(dimensions: tuple[float, float, float], x: float = 0.0) -> LinkPrimitive:
    """Return a cylinder along z from its radius, lower end and upper end [m]."""
    radius, low, high = dimensions
    return _cylinder((x, 0.0, low), (x, 0.0, high), radius)


def _tube(a: float, tube: tuple[float, float]) -> LinkPrimitive:
    """Return a tube along a link of length a, from its height and radius [m]."""
    return _cylinder((0.1 * a, 0.0, tube[0]), (0.95 * a, 0.0, tube[0]), tube[1], TUBE_COLOR)


def _parameters(
    a2: float, a3: float, d1: float, d4: float, d5: float, d6: float
) -> DenavitHartenberg:
    return DenavitHartenberg(
        a=(0.0, a2, a3, 0.0, 0.0, 0.0),
        d=(d1, 0.0, 0.0, d4, d5, d6),
        alpha=(np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0),
    )


def _make_arm(
    name: str,
    parameters: DenavitHartenberg,
    masses: tuple[float, ...],
    centers: tuple[Point, ...],
    torques: tuple[float, ...],
    speeds_deg: tuple[float, ...],
    shape: VisualShape,
    base_collision_geometry: LinkPrimitive,
    collision_geometry: tuple[tuple[LinkPrimitive, ...], ...],
) -> UrArm:
    columns = (
        LINK_NAMES,
        masses,
        centers,
        torques,
        speeds_deg,
        collision_geometry,
        shape.visual_geometry(parameters),
    )
    links = tuple(
        UrLink(link, mass, center, torque, math.radians(speed), collision, visual)
        for link, mass, center, torque, speed, collision, visual in zip(*columns, strict=True)
    )
    radius, height = shape.base
    return UrArm(
        name=name,
        parameters=parameters,
        links=links,
        base_collision_geometry=(base_collision_geometry,),
        base_visual_geometry=(_cylinder((0.0, 0.0, 0.0), (0.0, 0.0, height), radius),),
        base_mass=BASE_MASS,
        written_by="models/generators/ur_e_series.py",
    )


UR3E = _make_arm(
    name="ur3e",
    parameters=_parameters(a2=-0.24355, a3=-0.2132, d1=0.15185, d4=0.13105, d5=0.08535, d6=0.0921),
    masses=(1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
    centers=(
        (0.0, -0.02, 0.0),
        (0.13, 0.0, 0.1157),
        (0.05, 0.0, 0.0238),
        (0.0, 0.0, 0.01),
        (0.0, 0.0, 0.01),
        (0.0, 0.0, -0.02),
    ),
    torques=(56.0, 56.0, 28.0, 12.0, 12.0, 12.0),
    speeds_deg=(180.0, 180.0, 180.0, 360.0, 360.0, 360.0),
    shape=VisualShape(
        base=(0.053, 0.0890),
        shoulder=(0.045, 0.0960, 0.200, 0.061),
        upper_arm=(0.045, 0.066, 0.170),
        tube=(0.120, 0.033),
        elbow=(0.036, 0.068, 0.172),
        forearm=(0.034, 0.036, 0.066),
        thin_tube=(0.027, 0.027),
        wrist=(0.029, -0.016, 0.074),
        wrist_1=(0.0773, 0.161, 0.047),
        wrist_2=(0.0499, 0.115, 0.050),
        wrist_3=0.0504,
    ),
    base_collision_geometry=LinkPrimitive((0.0, 0.0, 0.0280), (-0.0001, -0.0008, 0.0419), 0.071),
    collision_geometry=(
        (LinkPrimitive((-0.0008, -0.0005, 0.1467), (-0.0018, -0.0123, 0.1524), 0.070),),
        (
            LinkPrimitive((-0.0143, 0.0, 0.1199), (-0.001, 0.0004, 0.1144), 0.070),
            LinkPrimitive((-0.1847, 0.0, 0.1198), (-0.0887, 0.0, 0.1199), 0.039),
            LinkPrimitive((-0.2426, -0.0003, 0.115), (-0.2401, 0.0001, 0.1215), 0.063),
        ),
        (
            LinkPrimitive((-0.0434, 0.0, 0.027), (0.0007, 0.0001, 0.0563), 0.040),
            LinkPrimitive((-0.1503, 0.0, 0.0272), (-0.0828, -0.0001, 0.0269), 0.029),
            LinkPrimitive((-0.2077, -0.0011, 0.0422), (-0.2032, -0.0004, 0.0192), 0.051),
        ),
        (LinkPrimitive((-0.0001, -0.0064, 0.1284), (0.0, 0.0004, 0.1227), 0.056),),
        (LinkPrimitive((0.0, 0.0172, 0.0851), (0.0, -0.0081, 0.0819), 0.046),),
        (LinkPrimitive((-0.0002, 0.0003, 0.0709), (0.0014, -0.0016, 0.0705), 0.038),),
    ),
)

UR5E = _make_arm(
    name="ur5e",
    parameters=_parameters(a2=-0.425, a3=-0.3922, d1=0.1625, d4=0.1333, d5=0.0997, d6=0.0996),
    masses=(3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
    centers=(
        (0.0, -0.02561, 0.00193),
        (0.2125, 0.0, 0.11336),
        (0.15, 0.0, 0.0265),
        (0.0, -0.0018, 0.01634),
        (0.0, 0.0018, 0.01634),
        (0.0, 0.0, -0.001159),
    ),
    torques=(150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
    speeds_deg=(180.0, 180.0, 180.0, 180.0, 180.0, 180.0),
    shape=VisualShape(
        base=(0.062, 0.0950),
        shoulder=(0.056, 0.1010, 0.216, 0.0730),
        upper_arm=(0.056, 0.076, 0.198),
        tube=(0.138, 0.043),
        elbow=(0.053, 0.064, 0.194),
        forearm=(0.055, 0.025, 0.062),
        thin_tube=(0.0065, 0.037),
        wrist=(0.037, -0.041, 0.058),
        wrist_1=(0.0597, 0.170, 0.0536),
        wrist_2=(0.0536, 0.137, 0.053),
        wrist_3=0.0560,
    ),
    base_collision_geometry=LinkPrimitive((0.0003, 0.0003, 0.0466), (0.0, 0.0, 0.0214), 0.079),
    collision_geometry=(
        (LinkPrimitive((-0.0002, -0.0032, 0.1553), (0.0, -0.0144, 0.162), 0.084),),
        (
            LinkPrimitive((0.0001, 0.0, 0.1342), (-0.0231, 0.0, 0.1379), 0.084),
            LinkPrimitive((-0.3189, 0.0, 0.1378), (-0.1024, 0.0, 0.1378), 0.044),
            LinkPrimitive((-0.4036, 0.0, 0.1378), (-0.4243, 0.0, 0.1246), 0.087),
        ),
        (
            LinkPrimitive((-0.0478, -0.0011, 0.0082), (0.0007, 0.0, 0.048), 0.060),
            LinkPrimitive((-0.1011, 0.0, 0.0065), (-0.3342, 0.0, 0.0067), 0.039),
            LinkPrimitive((-0.3885, 0.0, 0.0047), (-0.3904, 0.0002, 0.0124), 0.062),
        ),
        (LinkPrimitive((0.0, 0.0001, 0.1116), (0.0, -0.0014, 0.1324), 0.065),),
        (LinkPrimitive((-0.0007, 0.0119, 0.0977), (0.0004, -0.0094, 0.0951), 0.057),),
        (LinkPrimitive((-0.0038, -0.0026, 0.0733), (0.0025, 0.0023, 0.0715), 0.043),),
    ),
)

_LARGE_BASE = LinkPrimitive((0.0, 0.0, 0.026), (0.0, 0.0, 0.066), 0.099)
_LARGE_SHOULDER = (LinkPrimitive((-0.0001, -0.0006, 0.1656), (-0.0001, -0.0121, 0.1821), 0.109),)
_LARGE_WRISTS = (
    (LinkPrimitive((-0.0006, -0.0009, 0.1551), (0.0, -0.009, 0.172), 0.077),),
    (LinkPrimitive((0.0, -0.0002, 0.1118), (-0.001, 0.0127, 0.1194), 0.072),),
    (LinkPrimitive((-0.0004, -0.0009, 0.0811), (0.0, -0.001, 0.0813), 0.051),),
)
"""Capsules of the wrist links of UR10e and UR16e."""

UR10E = _make_arm(
    name="ur10e",
    parameters=_parameters(a2=-0.6127, a3=-0.57155, d1=0.1807, d4=0.17415, d5=0.11985, d6=0.11655),
    masses=(7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
    centers=(
        (0.021, 0.0, 0.027),
        (0.38, 0.0, 0.158),
        (0.24, 0.0, 0.068),
        (0.0, 0.007, 0.018),
        (0.0, 0.007, 0.018),
        (0.0, 0.0, -0.026),
    ),
    torques=(330.0, 330.0, 150.0, 56.0, 56.0, 56.0),
    speeds_deg=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    shape=VisualShape(
        base=(0.090, 0.0917),
        shoulder=(0.070, 0.0917, 0.260, 0.083),
        upper_arm=(0.075, 0.086, 0.255),
        tube=(0.1762, 0.054),
        elbow=(0.060, 0.1076, 0.240),
        forearm=(0.058, -0.014, 0.1076),
        thin_tube=(0.0393, 0.043),
        wrist=(0.045, -0.0147, 0.1012),
        wrist_1=(0.1012, 0.218, 0.062),
        wrist_2=(0.062, 0.164, 0.0616),
        wrist_3=0.0660,
    ),
    base_collision_geometry=_LARGE_BASE,
    collision_geometry=(
        _LARGE_SHOULDER,
        (
            LinkPrimitive((-0.0018, 0.0, 0.1635), (-0.0188, 0.0, 0.1761), 0.119),
            LinkPrimitive((-0.1242, 0.0, 0.1761), (-0.5066, 0.0, 0.1761), 0.065),
            LinkPrimitive((-0.6121, 0.0001, 0.1726), (-0.5799, -0.0001, 0.1762), 0.093),
        ),
        (
            LinkPrimitive((-0.0029, 0.0006, 0.0501), (-0.0224, 0.0001, 0.0395), 0.088),
            LinkPrimitive((-0.5168, 0.0, 0.0394), (-0.1152, 0.0, 0.0395), 0.051),
            LinkPrimitive((-0.5722, -0.0006, 0.0572), (-0.566, -0.0002, 0.0342), 0.068),
        ),
        *_LARGE_WRISTS,
    ),
)

UR16E = _make_arm(
    name="ur16e",
    parameters=_parameters(a2=-0.4784, a3=-0.36, d1=0.1807, d4=0.17415, d5=0.11985, d6=0.11655),
    masses=(7.369, 10.45, 4.321, 2.18, 2.033, 0.907),
    centers=(
        (0.0, -0.016, 0.03),
        (0.302, 0.0, 0.16),
        (0.194, 0.0, 0.065),
        (0.0, -0.009, 0.011),
        (0.0, 0.018, 0.012),
        (0.0, 0.0, -0.044),
    ),
    torques=(330.0, 330.0, 150.0, 54.0, 54.0, 54.0),
    speeds_deg=(120.0, 120.0, 180.0, 180.0, 180.0, 180.0),
    shape=VisualShape(
        base=(0.090, 0.0917),
        shoulder=(0.070, 0.0917, 0.260, 0.083),
        upper_arm=(0.075, 0.086, 0.255),
        tube=(0.176, 0.054),
        elbow=(0.060, 0.108, 0.240),
        forearm=(0.058, -0.014, 0.108),
        thin_tube=(0.040, 0.043),
        wrist=(0.045, -0.014, 0.102),
        wrist_1=(0.102, 0.218, 0.062),
        wrist_2=(0.062, 0.164, 0.0616),
        wrist_3=0.0660,
    ),
    base_collision_geometry=_LARGE_BASE,
    collision_geometry=(
        _LARGE_SHOULDER,
        (
            LinkPrimitive((0.0013, 0.0, 0.1622), (-0.0194, -0.0005, 0.1762), 0.119),
            LinkPrimitive((-0.1269, 0.0, 0.1759), (-0.3698, 0.0, 0.1758), 0.065),
            LinkPrimitive((-0.4777, 0.0, 0.1725), (-0.4457, -0.0001, 0.176), 0.093),
        ),
        (
            LinkPrimitive((-0.0021, 0.0, 0.0503), (-0.0217, 0.0002, 0.0401), 0.088),
            LinkPrimitive((-0.3012, 0.0001, 0.0401), (-0.1117, 0.0, 0.0402), 0.051),
            LinkPrimitive((-0.3599, -0.0023, 0.0603), (-0.3539, 0.0001, 0.0338), 0.068),
        ),
        *_LARGE_WRISTS,
    ),
)

E_SERIES = (UR3E, UR5E, UR10E, UR16E)
