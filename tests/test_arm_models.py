"""Shipped arm models: up to date, physically valid, and covered by capsules."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

import iiwa14
from drake_clutter.cell.primitives import LinkPrimitive
from drake_clutter.resources import resource_path
from ur_e_series import E_SERIES, UR3E, UR5E
from ur_family import UrArm, ur_sdf

DATA = Path(__file__).parent / "data"
MODELS = {**{arm.name: ur_sdf(arm) for arm in E_SERIES}, "iiwa14": iiwa14.iiwa14_sdf()}


def outlines(arm: UrArm) -> tuple[tuple[LinkPrimitive, ...], ...]:
    return arm.base_collision_geometry, *(link.collision_geometry for link in arm.links)


COLLISION_GEOMETRY = {
    "ur3e": outlines(UR3E),
    "ur5e": outlines(UR5E),
    "iiwa14": iiwa14.COLLISION_GEOMETRY,
}


@pytest.mark.parametrize("name", MODELS)
def test_the_shipped_models_are_up_to_date(name: str) -> None:
    assert resource_path(f"models/robots/{name}.sdf").read_text() == MODELS[name]


@pytest.mark.parametrize("name", MODELS)
def test_every_inertia_is_physical(name: str) -> None:
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModels(str(resource_path(f"models/robots/{name}.sdf")))
    for index in plant.GetBodyIndices(instance):
        assert plant.get_body(index).default_spatial_inertia().IsPhysicallyValid()


@pytest.mark.parametrize(
    ("name", "moving", "torques", "speeds_deg"),
    [
        ("ur3e", 8.7985, [56, 56, 28, 12, 12, 12], [180, 180, 180, 360, 360, 360]),
        ("ur5e", 17.7, [150, 150, 150, 28, 28, 28], [180] * 6),
        ("ur10e", 29.104, [330, 330, 150, 56, 56, 56], [120, 120, 180, 180, 180, 180]),
        ("ur16e", 27.26, [330, 330, 150, 54, 54, 54], [120, 120, 180, 180, 180, 180]),
        ("iiwa14", 17.5, [320, 320, 176, 176, 110, 40, 40], [85, 85, 100, 75, 130, 135, 135]),
    ],
)
def test_masses_and_limits_equal_the_published_values(
    name: str, moving: float, torques: list[float], speeds_deg: list[float]
) -> None:
    """Masses of links [kg], torque limits [N m] and velocity limits [deg/s] of joints."""
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModels(str(resource_path(f"models/robots/{name}.sdf")))
    bodies = [plant.get_body(index) for index in plant.GetBodyIndices(instance)]
    assert sum(body.default_mass() for body in bodies[1:]) == pytest.approx(moving)
    plant.WeldFrames(plant.world_frame(), bodies[0].body_frame())
    plant.Finalize()
    assert plant.GetEffortUpperLimits().tolist() == torques
    assert np.degrees(plant.GetVelocityUpperLimits()) == pytest.approx(speeds_deg, abs=1e-3)


def outside(points: NDArray[np.float64], rod: LinkPrimitive) -> float:
    """Return the largest distance of points from a capsule's surface, outwards [m]."""
    start, axis = np.array(rod.start), np.array(rod.end) - np.array(rod.start)
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    away = np.linalg.norm(points - start - along[:, None] * axis, axis=1)
    return float(away.max() - rod.radius)


@pytest.mark.parametrize("name", COLLISION_GEOMETRY)
def test_capsules_cover_the_collision_meshes(name: str) -> None:
    """Capsules contain the convex hulls of their parts, with a margin below 3 mm."""
    with np.load(DATA / f"{name}_outline.npz") as corners:
        for number, rods in enumerate(COLLISION_GEOMETRY[name]):
            for part, rod in enumerate(rods):
                excess = outside(corners[f"{number}.{part}"] * 1e-5, rod)
                assert -0.003 < excess <= 0, f"link {number}, capsule {part}"
