"""Geometry of work cells: poses, pedestal, and overlap with the support."""

from pathlib import Path

import numpy as np
import pytest
from conftest import TRAY, cell_with, resting, scene_of, tray, world_with
from PIL import Image
from pydrake.math import RollPitchYaw

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.commands.render_scene import render_scene
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.station.station_simulation import StationSimulation


@pytest.mark.parametrize(
    "rpy_deg", [(180.0, 0.0, 30.0), (0.0, 90.0, -17.0), (12.0, 20.0, 31.0), (-90.0, 180.0, 270.0)]
)
def test_a_pose_is_roll_pitch_and_yaw(rpy_deg: tuple[float, float, float]) -> None:
    R = PoseSpec(rpy_deg=rpy_deg).transform.rotation().matrix()
    assert (
        pytest.approx(RollPitchYaw(np.radians(rpy_deg)).ToRotationMatrix().matrix(), abs=1e-12) == R
    )


@pytest.mark.parametrize("yaw", [0.0, 30.0, -45.0, 90.0])
def test_a_camera_that_looks_straight_down_is_vertical_at_any_yaw(yaw: float) -> None:
    assert Camera(pose=PoseSpec(translation=(0.1, 0.0, 1.6), rpy_deg=(180.0, 0.0, yaw))).is_vertical
    assert not Camera(
        pose=PoseSpec(translation=(0.1, 0.0, 1.6), rpy_deg=(179.0, 0.0, yaw))
    ).is_vertical


def test_a_pedestal_stands_upright_under_a_tilted_base() -> None:
    cell = cell_with("robot.base={translation: [-0.7, 0.1, 0.4], rpy_deg: [10, 20, 30]}")
    assert cell.pedestal is not None
    X_TS, (x, y, height) = cell.pedestal
    upright = RollPitchYaw(0, 0, np.radians(30)).ToRotationMatrix().matrix()
    assert X_TS.rotation().matrix() == pytest.approx(upright, abs=1e-12)
    assert X_TS.translation() == pytest.approx([-0.7, 0.1, (0.4 + cell.table_height) / 2])
    assert (x, y, height) == pytest.approx((0.16, 0.16, 0.4 - cell.table_height - 0.002))


def test_a_base_over_the_support_without_a_pedestal_is_not_in_it() -> None:
    over = "robot.base={translation: [-0.2, 0, 1.3], rpy_deg: [180, 0, 0]}"
    assert cell_with(over).pedestal_overlaps_support
    assert not cell_with(over, "robot.pedestal_side=0").pedestal_overlaps_support


@pytest.mark.parametrize(
    ("x", "y", "yaw", "stands_in"),
    [
        (-0.437, 0.0, 0.0, True),
        (-0.439, 0.0, 0.0, False),
        (-0.439, 0.0, 45.0, True),  # half a diagonal is 0.113
        (-0.470, 0.0, 45.0, True),
        (-0.472, 0.0, 45.0, False),
        (-0.437, 0.437, 0.0, True),
        (-0.437, 0.437, 45.0, False),  # beside the corner
    ],
)
def test_whether_a_turned_pedestal_stands_in_the_support(
    x: float, y: float, yaw: float, stands_in: bool
) -> None:
    base = f"robot.base={{translation: [{x}, {y}, 0.3], rpy_deg: [0, 0, {yaw}]}}"
    assert cell_with(base).pedestal_overlaps_support is stands_in


def test_cells_differ_in_the_order_of_their_cameras() -> None:
    one, two = (
        f"{name}: {{pose: {{translation: [0, 0, {z}], rpy_deg: [180, 0, 0]}}}}"
        for name, z in (("a", 1.6), ("b", 1.8))
    )
    first, second = cell_with(f"cameras={{{one}, {two}}}"), cell_with(f"cameras={{{two}, {one}}}")
    assert dict(first) == dict(second)
    assert first.camera != second.camera
    assert first != second


def test_a_camera_must_be_near_enough_to_see_the_support() -> None:
    assert Camera.overhead(9.9, fov_y_deg=10.0).is_support_visible(TRAY)
    assert not Camera.overhead(10.1, fov_y_deg=10.0).is_support_visible(TRAY)


def test_depth_beyond_the_range_of_16_bits_is_zero(tmp_path: Path) -> None:
    """Under a camera at 6.6 m, the top of a box is within 6.55 m, and the tray's floor is not."""
    world = world_with("cell.cameras.overhead.pose.z=6.6", "cell.cameras.overhead.fov_y_deg=10.0")
    render_scene(scene_of(resting("cracker_box", Orientation.UPRIGHT_0)), world, tmp_path)
    depth = np.asarray(Image.open(tmp_path / "depth.png"))
    assert set(np.unique(depth[depth > 0] // 1000)) <= {63, 64, 65}
    assert np.count_nonzero(depth) < 0.05 * depth.size


def test_a_second_tray_may_stand_beside_the_first(tmp_path: Path) -> None:
    """A second tray serves as a bin; its model and link have the names of the support."""
    path = tmp_path / "tray.sdf"
    path.write_text(support_sdf(tray(0.3), table=False))
    cell = cell_with(f"fixtures=[{{name: bin, model: {path}, pose: {{translation: [0, 0.6, 0]}}}}]")
    objects = (resting("sugar_box"), resting("pudding_box", xy=(0.2, 0.0)))
    X_TO_place = objects[0].X_TO.translated((0.0, -0.2, 0.001))
    plan = PickPlacePlanner(cell, PlannerConfig(optimize=False)).plan(
        objects, "sugar_box", X_TO_place
    )
    assert isinstance(plan, PickPlacePlan)
    done = StationSimulation(cell, scene_of(*objects)).execute(plan)
    assert done.poses["sugar_box"].p == pytest.approx(
        objects[0].X_TO.translated((0.0, -0.2, 0.0)).p, abs=2e-3
    )


def test_a_camera_may_not_have_the_name_of_another_part() -> None:
    camera = "{pose: {translation: [0, 0, 1.6], rpy_deg: [180, 0, 0]}}"
    with pytest.raises(
        InputError,
        match=r"cameras\.pedestal: a camera's name; expected names that differ from tray",
    ):
        cell_with(f"cameras={{pedestal: {camera}, side: {camera}}}")
    assert cell_with(f"cameras={{camera: {camera}}}").camera == cell_with().camera
