"""The UR10's model: as the closed form says, with the published limits, and covered by its capsules."""

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
"""Corners (V, 3), in 10 um, and triangles of each link in its frame: the meshes of ROS-Industrial's ur_description (BSD)."""


@pytest.fixture(scope="module")
def plant() -> MultibodyPlant:
    made = MultibodyPlant(0.001)
    Parser(made).AddModels(str(resource_path("models/robots/ur10.sdf")))
    made.WeldFrames(made.world_frame(), made.GetFrameByName("base"))
    made.Finalize()
    return made


def test_the_file_is_what_is_written() -> None:
    assert resource_path("models/robots/ur10.sdf").read_text() == ur10_sdf()


def test_drake_agrees_on_every_pose(plant: MultibodyPlant) -> None:
    """Of the flange, its Jacobian, and the joints' order; and the inverse leads back."""
    context, draw = plant.CreateDefaultContext(), rng(0)
    assert (
        tuple(plant.get_joint(index).name() for index in plant.GetJointIndices())[:6]
        == UR_JOINT_NAMES
    )
    flange, world = plant.GetFrameByName("flange"), plant.world_frame()
    for _ in range(200):
        q = draw.uniform(-2 * np.pi, 2 * np.pi, 6)
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


def test_limits_and_masses_are_the_published_ones(plant: MultibodyPlant) -> None:
    assert plant.CalcTotalMass(plant.CreateDefaultContext()) - 4.0 == pytest.approx(
        7.1 + 12.7 + 4.27 + 2 + 2 + 0.365
    )
    assert plant.GetEffortUpperLimits().tolist() == [330, 330, 150, 56, 56, 56]
    assert np.degrees(plant.GetVelocityUpperLimits()) == pytest.approx(
        [120, 120, 180, 180, 180, 180], abs=1e-3
    )
    assert np.degrees(plant.GetPositionUpperLimits()) == pytest.approx([360] * 6)
    assert np.degrees(plant.GetPositionLowerLimits()) == pytest.approx([-360] * 6)


def test_every_inertia_is_physical(plant: MultibodyPlant) -> None:
    for link in LINKS:
        M_LLo_L = plant.GetBodyByName(link.name).default_spatial_inertia()
        assert M_LLo_L.IsPhysicallyValid()


def within(points: NDArray[np.float64], rod: LinkPrimitive) -> NDArray[np.bool_]:
    start, axis = np.array(rod.start), np.array(rod.end) - np.array(rod.start)
    along = np.clip((points - start) @ axis / (axis @ axis), 0, 1)
    return np.asarray(
        np.linalg.norm(points - start - along[..., None] * axis, axis=-1) <= rod.radius
    )


def left_uncovered(triangles: NDArray[np.float64], rods: tuple[LinkPrimitive, ...]) -> int:
    """Of triangles (F, 3 corners, 3): a capsule that holds all corners of one holds it whole; the others are cut into four."""
    for _ in range(7):
        covered = np.any([within(triangles, rod).all(axis=1) for rod in rods], axis=0)
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
def test_the_capsules_cover_the_real_link(name: str) -> None:
    with np.load(OUTLINES) as outlines:
        triangles = outlines[f"{name}.corners"][outlines[f"{name}.triangles"]] * 1e-5
    rods = (
        BASE_COLLISION_GEOMETRY
        if name == "base"
        else next(link.collision_geometry for link in LINKS if link.name == name)
    )
    assert left_uncovered(triangles, rods) == 0
    thinner = tuple(LinkPrimitive(rod.start, rod.end, rod.radius - 0.003) for rod in rods)
    assert left_uncovered(triangles, thinner) > 0, "no capsule is 3 mm thicker than it has to be"
