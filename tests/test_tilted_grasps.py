"""Tilted objects: grasped along their normal, lifted along it, and put down flat."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, resting, scene_of
from scipy.spatial.transform import Rotation

from benchmarks.motion_limits import limit_ratios
from drake_clutter.catalog import Shape
from drake_clutter.config import ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import DEPARTURE_DISTANCE
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.release_orientation import resting_quaternion, yaw_steps
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.station.station_simulation import StationSimulation

# A sugar box that leans on a pudding box, at rest; its widest face is tilted by 13.9 degrees.
LEANING = SceneObject(
    "sugar_box",
    CLASSES["sugar_box"],
    Pose((-0.0196011, 0.0, 0.0394415), (0.7875880172, -1.867e-07, 0.6162021708, -7.159e-08)),
)
SCENE = scene_of(LEANING, resting("pudding_box", xy=(0.096, 0.0)))
NORMAL = LEANING.X_TO.rotation[:, 0] * np.sign(LEANING.X_TO.rotation[2, 0])


def test_a_leaning_box_is_put_down_flat(detector: LabelDetector) -> None:
    observation = detector.perceive(SCENE).observation
    free = find_free_placements(observation, Move("sugar_box"), ExplorationConfig())
    assert free is not None
    translation = next(p for p in free.translations.tolist() if p[0] < 0 and p[1] < 0)
    place = Pose(tuple(translation), free.quaternion)
    assert abs(place.rotation[2, 0]) == pytest.approx(1.0), "on its widest face"
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    plan = planner.plan(SCENE.objects, "sugar_box", place)
    assert isinstance(plan, PickPlacePlan)
    tool, carry = planner.tools[plan.tool], plan.segments[1].trajectory
    X_TG = tool.pose(carry.vector_values(np.linspace(0.0, carry.end_time(), 400)).T)
    assert X_TG[0, :3, 2] == pytest.approx(-NORMAL, abs=1e-3)
    assert X_TG[-1, :3, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-3)
    assert plan.segments[1].duration < 0.9 * plan.segments[1].unoptimized_duration
    ratios = limit_ratios(DEFAULT_CELL, plan, plan.segments[1])
    assert max(ratios.values()) < 1.01
    assert 0.0 < ratios["cup load"] < 1.0, "with gravity in its true direction"
    lift = X_TG[:, :3, 3] - X_TG[0, :3, 3]
    along = lift @ NORMAL
    first = (along > 1e-4) & (along < DEPARTURE_DISTANCE / 2)
    assert first.sum() > 3
    sideways = np.linalg.norm(lift[first] - np.outer(along[first], NORMAL), axis=1)
    assert (sideways < 0.2 * along[first]).all(), "along the normal first"
    approach = plan.segments[0]
    assert approach.duration < approach.unoptimized_duration
    q = approach.trajectory.vector_values(np.linspace(0.0, approach.duration, 2000))
    before = tool.pose(q.T)[:, :3, 3] - X_TG[0, :3, 3]
    above = before @ NORMAL
    last = (above > 1e-4) & (above < 0.0015)
    assert last.sum() > 3
    sideways = np.linalg.norm(before[last] - np.outer(above[last], NORMAL), axis=1)
    assert (sideways < 0.2 * above[last]).all(), "along the normal last"
    result = StationSimulation(DEFAULT_CELL, SCENE).execute(plan)
    assert not result.lost_object
    assert result.position_error < 0.003
    assert result.orientation_error < math.radians(1)
    assert max(result.displacements.values()) < 0.001


@pytest.mark.parametrize(
    ("name", "rpy", "rested"),
    [
        ("sugar_box", (20, 0, 30), (0, 0, 30)),
        ("sugar_box", (0, 70, 0), (0, 90, 0)),
        ("tomato_soup_can", (40, 0, 0), (0, 0, 0)),
        ("tomato_soup_can", (60, 0, 0), (0, 0, 0)),
        ("large_marker", (0, 70, 0), (0, 90, 0)),
        ("large_marker", (0, 70, 30), (0, 90, 30)),
    ],
)
def test_the_closest_resting_orientation(
    name: str, rpy: Sequence[float], rested: Sequence[float]
) -> None:
    def quaternion(angles: Sequence[float]) -> tuple[float, float, float, float]:
        w, x, y, z = Rotation.from_euler("xyz", angles, degrees=True).as_quat(scalar_first=True)
        return w, x, y, z

    found = Pose((0.0, 0.0, 0.0), resting_quaternion(CLASSES[name], quaternion(rpy))).rotation
    assert found == pytest.approx(Pose((0.0, 0.0, 0.0), quaternion(rested)).rotation, abs=1e-9)
    slight = quaternion((2, 1, 0))
    if name != "large_marker":
        assert resting_quaternion(CLASSES[name], slight) == slight


@pytest.mark.parametrize(("tilt", "height"), [(40.0, 1.0), (50.0, 0.0)])
def test_a_cylinder_that_may_stand_or_lie_turns_to_the_nearer_of_the_two(
    tilt: float, height: float
) -> None:
    pin = replace(CLASSES["tomato_soup_can"], only_rest=None)
    w, x, y, z = Rotation.from_euler("x", tilt, degrees=True).as_quat(scalar_first=True)
    found = Pose((0.0, 0.0, 0.0), resting_quaternion(pin, (w, x, y, z))).rotation
    assert abs(found[2, 2]) == pytest.approx(height, abs=1e-9)


def test_rotations_that_change_the_outline_are_tried() -> None:
    """Boxes are symmetric by half a turn, upright cans by any turn; meshes are not."""
    upright = (1.0, 0.0, 0.0, 0.0)
    box = CLASSES["sugar_box"]
    first, later = yaw_steps(box, upright)
    assert first == (0, 90)
    assert later == (15, 30, 45, 60, 75, 105, 120, 135, 150, 165)
    mesh_first, mesh_later = yaw_steps(replace(box, shape=Shape.MESH), upright)
    assert mesh_first == (0, 90, 180, 270)
    assert {*mesh_first, *mesh_later} == set(range(0, 360, 15))
    assert yaw_steps(CLASSES["tomato_soup_can"], upright) == ((0,),)
