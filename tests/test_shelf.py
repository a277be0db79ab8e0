"""Shelf as a work cell: a rectangular support with three walls, and a board above it."""

from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, rng
from test_docs import ROOT, blocks

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig, load_config
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PlanningFailure, PlanningFailureReason
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.interfaces import Move, MoveResult, PickPlaceCommand, Verdict
from drake_clutter.scenes.placement import find_free_placements
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.validation import load_config_as


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> ClutterConfig:
    """Return the shelf of docs/how_to/set_up_work_cell.md."""
    page = ROOT / "docs" / "how_to" / "set_up_work_cell.md"
    (text,) = (
        block.text
        for block in blocks(page)
        if block.language == "yaml" and "wall_height" in block.text
    )
    path: Path = tmp_path_factory.mktemp("shelf") / "shelf.yaml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


def inside(scene: Scene, config: ClutterConfig) -> bool:
    """Return whether all objects are over the floor, between the walls."""
    corners = np.concatenate([o.X_TO.apply(o.object_class.corners) for o in scene.objects])
    return bool((np.abs(corners[:, :2]) <= config.cell.support.half_size).all())


def test_the_geometry_of_the_shelf(shelf: ClutterConfig) -> None:
    cell = shelf.cell
    assert cell.table_height == pytest.approx(-0.41)
    assert cell.robot.model == DEFAULT_CELL.robot.model
    assert cell.pedestal is not None
    X_TS, size = cell.pedestal
    bottom = X_TS.translation()[2] - size[2] / 2
    assert bottom == pytest.approx(cell.table_height, abs=0.002)
    assert not cell.pedestal_overlaps_support


def test_both_judges_agree_on_generated_scenes(shelf: ClutterConfig) -> None:
    generate = SceneGenerator(GenerationJob("random", "ycb7", None, nodes=10, seed=0, config=shelf))
    judge, static_judge = DrakeJudge(shelf), StaticStabilityJudge(shelf)
    stable = []
    for number in range(4):
        scene = generate(number).scene
        assert isinstance(scene, Scene)
        assert inside(scene, shelf)
        verdict, other = judge.judge(scene, rng(number)), static_judge.judge(scene, rng(number))
        assert isinstance(verdict, Verdict)
        assert isinstance(other, Verdict)
        assert (verdict.stable, verdict.hidden) == (other.stable, other.hidden)
        for name, share in verdict.visible_fractions.items():
            assert other.visible_fractions[name] == pytest.approx(share, abs=0.02)
        stable.append(verdict.stable)
        if verdict.stable:
            assert inside(scene.with_poses(verdict.settled), shelf)
    assert True in stable
    assert False in stable


def test_an_object_beyond_the_open_side_is_unstable(shelf: ClutterConfig) -> None:
    """An object at the edge of the open side falls; one at a wall is stable."""
    x, y = shelf.cell.support.half_size
    judge = DrakeJudge(shelf)
    for xy, stable in (((-x, 0.0), False), ((x - 0.06, 0.0), True), ((0.0, y - 0.12), True)):
        scene = Scene((resting("cracker_box", xy=xy),), shelf.cell.support)
        assert judge.judge(scene, rng()).stable is stable


def test_free_placements_are_inside_the_walls(shelf: ClutterConfig) -> None:
    scene = Scene(
        (resting("pudding_box"), resting("sugar_box", xy=(0.0, 0.25))), shelf.cell.support
    )
    observation = LabelDetector(shelf.cell.camera).perceive(scene).observation
    for o in scene.objects:
        places = find_free_placements(observation, Move(o.name), shelf.exploration)
        assert places is not None
        for x, y, z in places.translations.tolist():
            placed = o.object_class.corners, Pose((x, y, z), places.quaternion)
            assert (np.abs(placed[1].apply(placed[0])[:, :2]) < shelf.cell.support.half_size).all()


@pytest.mark.parametrize(
    ("board", "result"), [(0.80, MoveResult.PLACED), (0.45, MoveResult.NOT_PLANNED)]
)
def test_the_arm_reaches_in_or_gives_a_reason(
    shelf: ClutterConfig, board: float, result: MoveResult
) -> None:
    """A box is moved under a high board; under a low one, the arm would collide."""
    world = load_config_as(shelf, settings=[f"cell.fixtures.1.pose.z={board}"])
    picked = resting("pudding_box", xy=(-0.05, 0.1))
    scene = Scene((picked, resting("cracker_box", xy=(0.08, -0.2))), world.cell.support)
    X_TO_place = picked.X_TO.translated((0.02, -0.12, 0.001))
    command = PickPlaceCommand(Move(picked.name), picked.X_TO, X_TO_place)
    executor = ArmExecutor(world, planner_config=PlannerConfig(optimize=False))
    assert executor.execute(scene, command, rng()).result is result
    plan = executor.plan(scene, command)
    if isinstance(plan, PlanningFailure):
        assert plan.reason is PlanningFailureReason.IN_COLLISION
        assert "board" in plan.detail
