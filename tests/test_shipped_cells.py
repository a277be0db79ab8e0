"""Shipped cells: the home configuration is free and outside of the view; the tray is reachable."""

from collections.abc import Callable
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray
from pydrake.geometry import Box, Convex
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder
from test_robot_model import CELLS

from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import RobotModel, load_robot
from drake_clutter.robots.robot_plant import add_robot, filter_collisions

Floats = NDArray[np.float64]

OBJECTS = 0.30
"""Height up to which the view of objects must be free [m]."""


def cell_of(name: str) -> WorkCell:
    return load_cell(resource_path(f"models/cells/{name}_epick_tray.yaml"))


def view(cell: WorkCell) -> Convex:
    """Return the convex hull of the camera and the space above the tray."""
    x, y = cell.support.half_size
    corners = [[i * x, j * y, z] for i in (1, -1) for j in (1, -1) for z in (0.0, OBJECTS)]
    return Convex(np.array([*corners, cell.camera.X_TC.translation()]).T, "view")


def clearance(cell: WorkCell, robot: RobotModel, with_view: bool) -> Callable[[Floats], float]:
    """Return a function from q to the smallest distance of arm and gripper [m]."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    instance = add_robot(plant, robot, visuals=False)
    tool = cell.gripper.model_sdf(compliant=False, actuated=False)
    (gripper,) = Parser(plant).AddModelsFromString(tool, "sdf")
    flange = plant.GetFrameByName(robot.spec.tool_frame, instance)
    plant.WeldFrames(flange, plant.GetFrameByName("body", gripper))
    solids = [(f.pose.transform, Box(*f.box)) for f in cell.fixtures if f.box is not None]
    if cell.pedestal is not None:
        solids.append((cell.pedestal[0], Box(*cell.pedestal[1])))
    shapes = [*solids, (RigidTransform(), view(cell))] if with_view else solids
    for number, (X_TS, shape) in enumerate(shapes):
        friction = CoulombFriction(1.0, 1.0)
        world = plant.world_body()
        plant.RegisterCollisionGeometry(world, X_TS, shape, f"solid_{number}", friction)
    filter_collisions(plant, scene_graph, robot, instance)
    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()

    def distance(q: Floats) -> float:
        context = plant.GetMyMutableContextFromRoot(root)
        plant.SetPositions(context, q)
        query = plant.get_geometry_query_input_port().Eval(context)
        found = query.ComputeSignedDistancePairwiseClosestPoints(0.1)
        return min((float(pair.distance) for pair in found), default=0.1)

    assert diagram is not None
    return distance


@pytest.mark.parametrize("name", CELLS)
def test_home_is_free_of_collisions_and_outside_of_the_view(name: str) -> None:
    cell = cell_of(name)
    robot = load_robot(cell.robot)
    assert not cell.pedestal_overlaps_support
    assert clearance(cell, robot, with_view=True)(robot.home) > 0.008
    X_TG = cell.robot.X_TB @ RigidTransform(robot.forward_kinematics(robot.home))
    if name != "ur10":
        assert X_TG.rotation().matrix()[2, 2] == pytest.approx(-1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "share"),
    [
        ("ur10", 1.0),
        ("ur3e", 0.9),
        ("ur5e", 1.0),
        ("ur10e", 1.0),
        ("ur16e", 0.95),
        ("iiwa14", 0.85),
    ],
)
def test_the_gripper_reaches_the_tray(name: str, share: float) -> None:
    """Downward poses at 25 positions, at least 5 cm from the walls, and three heights."""
    cell = cell_of(name)
    robot = load_robot(cell.robot)
    distance = clearance(cell, robot, with_view=False)
    tool = next(iter(cell.gripper.tools.values()))
    X_BT, X_GF = cell.robot.X_TB.inverse(), tool.X_FG.inverse()
    x, y = cell.support.half_size - 0.05
    reached, heights = [], (0.03, 0.2, 0.35)
    for p_TG in product(np.linspace(-x, x, 5), np.linspace(-y, y, 5), heights):
        X_TG = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), p_TG)
        solutions = robot.ik.solve((X_BT @ X_TG @ X_GF).GetAsMatrix4())
        usable = solutions[np.isfinite(solutions[:, 0])]
        reached.append(any(distance(q) > 0.003 for q in usable))
    assert np.mean(reached) >= share
