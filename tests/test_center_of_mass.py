"""A center of mass away from the origin of O: loads of the cup, stability, placement, files."""

from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, scene_of
from pydrake.math import RigidTransform

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.cell.gripper import GraspFailure, GraspSampling
from drake_clutter.cell.payload_limits import DOWN_G
from drake_clutter.cell.suction import SuctionGripper
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.free_space import CELL_SIZE
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.settle import settle
from drake_clutter.stability.static_judge import StaticStabilityJudge

CENTER = np.array([0.030, 0.0, -0.060])
"""Center of mass of the carton [m]."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def write_catalog(folder: Path, center: object = (30, 0, -60)) -> Path:
    carton = f"{{shape: box, size_mm: [160, 60, 200], mass_g: 400, center_of_mass_mm: {center}}}"
    pedestal = "{shape: box, size_mm: [100, 100, 50], mass_g: 500}"
    text = f"classes:\n  carton: {carton}\n  pedestal: {pedestal}\n"
    (folder / "catalog.yaml").write_text(text.replace("(", "[").replace(")", "]"))
    load_catalog.cache_clear()
    return folder


@pytest.fixture(scope="module")
def classes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, ObjectClass]:
    folder = write_catalog(tmp_path_factory.mktemp("own"))
    build_assets(folder)
    return dict(load_catalog(folder).classes)


def standing(object_class: ObjectClass, x: float, floor: float = 0.0) -> SceneObject:
    pose = Pose((x, 0.0, floor + object_class.size[2] / 2), IDENTITY)
    return SceneObject(object_class.name, object_class, pose)


def test_the_cup_holds_above_the_center_of_mass(classes: dict[str, ObjectClass]) -> None:
    """The top is at 0.2 m, the center of mass at 0.04 m; grasps are 12 mm apart."""
    sampling = GraspSampling(
        spacing=0.012, lip_gap=0.0005, max_grasps=9, min_payload_acceleration=0.3
    )
    suction = SuctionGripper.model_validate({"cup_diameter": 0.025})
    grasps = suction.sample_grasps(classes["carton"], RigidTransform([0.3, 0.1, 0.1]), sampling)
    assert not isinstance(grasps, GraspFailure)
    payload = grasps[0].payload
    # 30 mm lie between the grasps at 24 and 36 mm, as far from both.
    p_TG = grasps[0].X_TG.translation()
    lever = p_TG[0] - 0.330
    assert abs(lever) == pytest.approx(0.006)
    assert p_TG[1:] == pytest.approx([0.1, 0.2])
    assert payload.p_FCm == pytest.approx((0.0, 0.0, 0.2223 + 0.16))
    expected = suction.max_acceleration("single", 0.4, np.array([lever, 0.0, 0.16]), DOWN_G)
    assert payload.max_acceleration == pytest.approx(expected, abs=0.051)
    # At rest, weight and bending open the lip of radius 12.5 mm.
    force = np.array([0.0, 0.0, 0.4 * 9.81])
    bending = np.array([0.0, 0.4 * 9.81 * 0.006, 0.0])
    opening = 0.4 * 9.81 * (1 + 2 * 0.006 / 0.0125) / suction.holding_force("single")
    assert suction.load_ratio("single", force, bending) == pytest.approx(opening)


def test_a_plan_knows_the_center_of_mass(classes: dict[str, ObjectClass]) -> None:
    carton = standing(classes["carton"], 0.0)
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    plan = planner.plan([carton], "carton", carton.X_TO.translated((0.0, 0.2, 0.001)))
    assert isinstance(plan, PickPlacePlan)
    x, y, z = DEFAULT_CELL.gripper.tools[plan.tool].X_FG.inverse() @ np.array(plan.payload.p_FCm)
    assert z == pytest.approx(0.16 + PlannerConfig().lip_gap, abs=1e-9)
    assert np.hypot(x, y) == pytest.approx(0.006, abs=1e-9)


@pytest.mark.parametrize(
    ("x", "stands"), [(-0.03, True), (0.0, True), (0.015, True), (0.025, False)]
)
def test_the_judges_weigh_the_center_of_mass(
    classes: dict[str, ObjectClass], x: float, stands: bool, config: ClutterConfig
) -> None:
    """It stands as long as x + 30 mm is over the pedestal, which ends at 50 mm."""
    scene = scene_of(standing(classes["pedestal"], 0.0), standing(classes["carton"], x, 0.05))
    static = StaticStabilityJudge(config, margin=0.0).find_instability(scene)
    assert (static is None) is stands
    assert (settle(scene.objects, scene.support, config.settle).instability is None) is stands


def test_the_center_of_mass_is_placed_over_the_top(
    classes: dict[str, ObjectClass], detector: LabelDetector
) -> None:
    scene = scene_of(standing(classes["pedestal"], 0.0), standing(classes["carton"], 0.2))
    observation = detector.perceive(scene).observation
    free = find_free_placements(observation, Move("carton", "pedestal"), ExplorationConfig())
    assert free is not None
    X_TO = [Pose(tuple(p), free.quaternion) for p in free.translations]
    centers = np.array([X.apply(CENTER[None])[0] for X in X_TO])
    assert np.abs(centers[:, :2]).max() < 2 * CELL_SIZE


def test_a_center_of_mass_outside_is_refused(tmp_path: Path) -> None:
    write_catalog(tmp_path, (0, 0, 100))
    with pytest.raises(
        InputError,
        match=r"classes\.carton\.center_of_mass_mm: \[0\.?0?, 0\.?0?, 100\.?0?\]; expected a point"
        r" within 80 x 30 x 100 mm",
    ):
        load_catalog(tmp_path)


def test_a_model_with_another_center_of_mass_is_refused(tmp_path: Path) -> None:
    build_assets(write_catalog(tmp_path))
    write_catalog(tmp_path, (30, 0, -50))
    with pytest.raises(
        InputError,
        match=r"center of mass: 0\.03 0 -0\.06; expected the catalog's, 0\.03 0 -0\.05 m; run",
    ):
        _ = load_catalog(tmp_path).classes["carton"].verified_sdf_path
