"""UR10 model: agreement with the closed form, published limits, and cover by capsules."""

from pathlib import Path

import numpy as np
import pytest
from conftest import rng
from numpy.typing import NDArray
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable

from drake_clutter.cell.primitives import LinkPrimitive
from drake_clutter.resources import resource_path
from drake_clutter.robots.ur_kinematics import (
    UR_JOINT_NAMES,
    forward_kinematics,
    inverse_kinematics,
    jacobian,
)
from ur10 import BASE_COLLISION_GEOMETRY, LINKS, ur10_sdf

OUTLINES = Path(__file__).parent / "data" / "ur10_outline.npz"
"""Meshes of ROS-Industrial's ur_description (BSD): corners (V, 3) in 10 um and triangles."""


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    ur10_plant = MultibodyPlant(0.001)
    Parser(ur10_plant).AddModels(str(resource_path("models/robots/ur10.sdf")))
    ur10_plant.WeldFrames(ur10_plant.world_frame(), ur10_plant.GetFrameByName("base"))
    ur10_plant.Finalize()
    return ur10_plant


def test_the_shipped_model_is_up_to_date() -> None:
    assert resource_path("models/robots/ur10.sdf").read_text() == ur10_sdf()


def test_kinematics_agree_with_drake(plant: MultibodyPlant) -> None:
    """Flange pose, Jacobian and joint order agree; inverse kinematics returns to the pose."""
    context = plant.CreateDefaultContext()
    generator = rng(0)
    assert (
        tuple(plant.get_joint(index).name() for index in plant.GetJointIndices())[:6]
        == UR_JOINT_NAMES
    )
    flange, world = plant.GetFrameByName("flange"), plant.world_frame()
    for _ in range(200):
        q = generator.uniform(-2 * np.pi, 2 * np.pi, 6)
        plant.SetPositions(context, q)
        X_B6 = flange.CalcPoseInWorld(context).GetAsMatrix4()
        np.testing.assert_allclose(forward_kinematics(q), X_B6, atol=1e-9)
        theirs = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, flange, np.zeros(3), world, world
        )
        np.testing.assert_allclose(jacobian(q), theirs, atol=1e-9)
        for found in inverse_kinematics(X_B6):
            plant.SetPositions(context, found)
            np.testing.assert_allclose(
                flange.CalcPoseInWorld(context).GetAsMatrix4(), X_B6, atol=1e-9
            )


def test_limits_and_masses_equal_the_published_values(plant: MultibodyPlant) -> None:
    assert plant.CalcTotalMass(plant.CreateDefaultContext()) - 4.0 == pytest.approx(
        7.1 + 12.7 + 4.27 + 2 + 2 + 0.365
    )
    assert plant.GetEffortUpperLimits().tolist() == [330, 330, 150, 56, 56, 56]
    assert np.degrees(plant.GetVelocityUpperLimits()) == pytest.approx(
        [120, 120, 180, 180, 180, 180], abs=1e-3
    )
    limits = [360, 360, 180, 360, 360, 360]  # the elbow as in ur_description
    assert np.degrees(plant.GetPositionUpperLimits()) == pytest.approx(limits)
    assert np.degrees(plant.GetPositionLowerLimits()) == pytest.approx([-x for x in limits])


def test_every_inertia_is_physical(plant: MultibodyPlant) -> None:
    for link in LINKS:
        M_LLo_L = plant.GetBodyByName(link.name).default_spatial_inertia()
        assert M_LLo_L.IsPhysicallyValid()


def contains(points: NDArray[np.float64], capsule: LinkPrimitive) -> NDArray[np.bool_]:
    start, axis = np.array(capsule.start), np.array(capsule.end) - np.array(capsule.start)
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.asarray(
        np.linalg.norm(points - start - along[..., None] * axis, axis=-1) <= capsule.radius
    )


def count_uncovered(triangles: NDArray[np.float64], capsules: tuple[LinkPrimitive, ...]) -> int:
    """Return the number of triangles, after subdivision, that no single capsule contains."""
    for _ in range(7):
        covered = np.any([contains(triangles, capsule).all(axis=1) for capsule in capsules], axis=0)
        rest = triangles[~covered]
        if not len(rest):
            return 0
        a, b, c = rest.swapaxes(0, 1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [
                np.stack(part, axis=1)
                for part in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
            ]
        )
    return len(rest)


@pytest.mark.parametrize("name", ["base", *(link.name for link in LINKS)])
def test_capsules_cover_the_collision_mesh(name: str) -> None:
    with np.load(OUTLINES) as outlines:
        triangles = outlines[f"{name}.corners"][outlines[f"{name}.triangles"]] * 1e-5
    capsules = (
        BASE_COLLISION_GEOMETRY
        if name == "base"
        else next(link.collision_geometry for link in LINKS if link.name == name)
    )
    assert count_uncovered(triangles, capsules) == 0
    thinner = tuple(
        LinkPrimitive(capsule.start, capsule.end, capsule.radius - 0.003) for capsule in capsules
    )
    assert count_uncovered(triangles, thinner) > 0, "no capsule is 3 mm thicker than it has to be"
