"""Opposed faces between the pads of parallel jaws, and grasps of sides and meshes with them."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, own_mesh_class, resting, scene_of
from pydrake.math import RigidTransform, RotationMatrix

from drake_clutter.cell.gripper import GraspFailure, GraspSampling
from drake_clutter.cell.opposed_faces import PadContact, find_pad_contact
from drake_clutter.cell.parallel_jaw import ParallelJawGripper
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.station.station_simulation import StationSimulation

GRIPPER = ParallelJawGripper(kind="parallel_jaw")
SAMPLING = GraspSampling(spacing=0.012, lip_gap=0.0005, max_grasps=9, min_payload_acceleration=0.3)
PAD = np.array([0.022, 0.0375])


def contact(X_OG: RigidTransform) -> PadContact | float:
    """Return where pads hold a sugar box, whose x extent is 38 mm."""
    box = CLASSES["sugar_box"]
    return find_pad_contact(box, RigidTransform(), X_OG, PAD, stroke=0.085, friction=0.6)


def along_x(turn: float, y: float = 0.0) -> RigidTransform:
    """Return jaws that close along x of O, turned about their approach direction [rad]."""
    R_OG = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
    R_OG = R_OG @ RotationMatrix.MakeZRotation(turn)
    return RigidTransform(R_OG, np.zeros(3)) @ RigidTransform([0.0, y, 0.0])


def test_pads_meet_parallel_faces_in_the_middle() -> None:
    found = contact(along_x(0.0, y=0.015))
    assert isinstance(found, PadContact)
    assert found.width == pytest.approx(0.038)
    assert found.X_TG.translation() == pytest.approx(np.zeros(3), abs=1e-9)


def test_faces_beyond_the_friction_cone_are_refused() -> None:
    """tan(35 deg) is larger than the coefficient of friction."""
    assert not isinstance(contact(along_x(math.radians(35))), PadContact)
    beside = RigidTransform([0.0, 0.2, 0.0]) @ along_x(0.0)
    assert contact(beside) == math.inf


def test_a_neck_is_grasped_above_the_shoulder_that_has_no_grip(tmp_path: Path) -> None:
    """The shoulder is inclined by 70 deg to the axis, its friction cone by 31 deg."""
    outline = [(0, 0), (0.03, 0), (0.03, 0.09), (0.014, 0.096), (0.014, 0.13), (0, 0.13)]
    bottle = own_mesh_class(tmp_path, trimesh.creation.revolve(np.array(outline), sections=32))
    X_TO = RigidTransform([0.0, 0.0, 0.065])
    grasps = GRIPPER.sample_grasps(bottle, X_TO, SAMPLING)
    assert not isinstance(grasps, GraspFailure)
    width = GRIPPER.stroke - 2 * grasps[0].joints_held[0]
    assert width == pytest.approx(0.028, abs=0.001)
    tips = grasps[0].X_TG.translation()[2] - PAD[1] / 2
    assert 0.096 < tips < 0.13 - 0.008
    assert isinstance(
        GRIPPER.make_grasp("jaws", bottle, X_TO, grasps[0].X_TG, SAMPLING), type(grasps[0])
    )


def test_friction_holds_a_can_that_is_grasped_from_a_side() -> None:
    cell = load_cell(resource_path("models/cells/ur10_2f85_tray.yaml"))
    planner = PickPlacePlanner(cell, PlannerConfig(optimize=False))
    can = resting("tomato_soup_can", xy=(0.05, 0.1))
    grasps = planner.grasps(can, (0.0, -1.0, 0.0))
    assert not isinstance(grasps, PlanningFailure)
    for grasp in grasps:
        assert grasp.X_TG.rotation().matrix()[:, 2] == pytest.approx([0.0, 1.0, 0.0])
    plan = planner.plan([can], can.name, can.X_TO.translated((0.1, -0.25, 0.001)), grasp=grasps)
    assert isinstance(plan, PickPlacePlan)
    result = StationSimulation(cell, scene_of(can)).execute(plan)
    assert not result.lost_object
    assert result.position_error < 0.002
    assert result.orientation_error < math.radians(1)
