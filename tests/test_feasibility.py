"""Feasibility studies: move and reachability results, and resuming a study."""

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from conftest import DEFAULT_CELL, ONE_CUP, cell_with, resting, rng, scene_of
from drake_clutter.planning.reachability import ReachabilityAnalysis, score_base_positions
from drake_clutter.tasks.feasibility_study import (
    MOVE_RECORD_FIELDS,
    PLANNED,
    FeasibilityStudy,
    objects_below,
    resting_side,
)
from typer.testing import CliRunner

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.cli import app
from drake_clutter.commands import feasibility_job as command
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import downward_pose
from drake_clutter.reports import feasibility_report
from drake_clutter.resources import resource_path
from drake_clutter.robots.ur_kinematics import jacobian, manipulability
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Pose
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.tasks import feasibility_study

SCENE = scene_of(
    resting("pudding_box"),
    resting("gelatin_box", floor=0.035),
    resting("large_marker", xy=(0.2, 0.2)),
    resting("tomato_soup_can", xy=(-0.1, -0.2)),
)


def study(cell: WorkCell | None = None) -> FeasibilityStudy:
    return FeasibilityStudy(
        "it", replace(ClutterConfig(), cell=cell or DEFAULT_CELL), PlannerConfig(optimize=False), 0
    )


def test_manipulability_in_closed_form() -> None:
    q = rng().uniform(-np.pi, np.pi, (50, 6))
    numeric = [abs(np.linalg.det(jacobian(row))) for row in q]
    assert manipulability(q) == pytest.approx(numeric, abs=1e-12)


def test_every_legal_move_has_a_row() -> None:
    rows = study(cell_with(ONE_CUP)).plan_all_moves("scene", 0, SCENE)
    by_pick: dict[str, list[str]] = {}
    for row in rows:
        by_pick.setdefault(row.pick, []).append(row.result)
    assert set(by_pick) == {"gelatin_box", "large_marker", "tomato_soup_can", "pudding_box"}
    assert PLANNED in by_pick["gelatin_box"]
    assert set(by_pick["large_marker"]) <= {"no seal", "no free spot"}
    assert set(by_pick["pudding_box"]) <= {"carries others", "no free spot"}
    for row in rows:
        picked = SCENE[row.pick]
        assert (row.pick_x, row.pick_y) == pytest.approx(picked.X_TO.p[:2], abs=1e-6)
        assert row.pick_top == pytest.approx(picked.corners_T[:, 2].max(), abs=1e-6)
        assert math.isfinite(row.motion_s) == (row.result == PLANNED)
        assert math.isfinite(row.place_x) == (row.result != "no free spot")
        assert row.num_below == (1 if row.pick == "gelatin_box" else 0)
        assert row.tool == ("single" if row.result == PLANNED else "")
    again = study(cell_with(ONE_CUP)).plan_all_moves("scene", 0, SCENE)
    assert [str(replace(row, planning_s=0.0)) for row in rows] == [
        str(replace(row, planning_s=0.0)) for row in again
    ]


def test_resting_side_and_objects_below() -> None:
    assert resting_side(resting("sugar_box", Orientation.UPRIGHT_0)) == "upright"
    assert resting_side(resting("sugar_box", Orientation.SIDE_0)) == "side"
    assert resting_side(resting("sugar_box", Orientation.FLAT_0)) == "flat"
    assert resting_side(resting("tomato_soup_can")) == "upright"
    assert objects_below(SCENE["gelatin_box"], SCENE.objects) == ["pudding_box"]
    assert objects_below(SCENE["tomato_soup_can"], SCENE.objects) == []


def test_infeasible_moves_have_a_reason() -> None:
    place = Pose((0.1, 0.1, SCENE["tomato_soup_can"].X_TO.p[2] + 0.001))

    def reason(cell: WorkCell) -> PlanningFailure:
        found = PickPlacePlanner(cell, PlannerConfig()).plan(
            SCENE.objects, "tomato_soup_can", place
        )
        assert isinstance(found, PlanningFailure)
        return found

    in_tray = reason(cell_with("robot.base.x=-0.1"))
    assert (in_tray.reason, in_tray.detail) == (
        PlanningFailureReason.IN_COLLISION,
        "pedestal and tray",
    )
    hanging = cell_with(
        "robot.base.x=-0.1", "robot.base.z=1.2", "robot.base.roll=180", "robot.pedestal_side=0.0"
    )
    planner = PickPlacePlanner(hanging, PlannerConfig())
    assert isinstance(planner.plan(SCENE.objects, "tomato_soup_can", place), PickPlacePlan), (
        "it has no pedestal"
    )
    assert reason(cell_with("robot.base.x=-5.0")).reason is PlanningFailureReason.UNREACHABLE
    assert reason(cell_with("robot.payload=1")).reason is PlanningFailureReason.TOO_HEAVY


def test_larger_pose_errors_invalidate_more_plans() -> None:
    it = study()
    rows = it.plan_all_moves("scene", 0, SCENE)
    found = it.evaluate_pose_errors("scene", 0, SCENE, rows)
    planned = sum(row.result == PLANNED for row in rows)
    assert len(found) == 5 * min(6, planned)
    holds = [
        sum(row.result == "holds" for row in found if row.error == error)
        for error in (0.002, 0.040)
    ]
    assert holds[0] > holds[1]
    assert {row.result for row in found} - {"holds", "no plan"}, "some plans fail with a reason"


def test_the_reachability_map_agrees_with_single_poses() -> None:
    reachability = ReachabilityAnalysis(DEFAULT_CELL)
    found = reachability.compute_map((0.1, 1.5), 0.3)
    assert found.reachable_fraction.shape == (2, 3, 3)
    assert (found.reachable_fraction[0] == 1).all()
    assert (found.reachable_fraction[1] < 1).any(), "too high"
    middle = reachability.analyze_poses(downward_pose(0.0, np.array([0.0, 0.0, 0.1]))[None])
    assert middle.num_solutions[0] > 0
    assert middle.manipulability[0] == pytest.approx(float(manipulability(middle.q[0])))
    away = reachability.analyze_poses(
        np.array(
            [
                downward_pose(0.0, np.array([3.0, 0.0, 0.1])),
                downward_pose(0.0, np.array([0.0, 0.0, -0.3])),
            ]
        )
    )
    assert away.num_solutions.tolist() == [0, 0]
    assert away.blocking_bodies[0] == ""
    assert "table" in away.blocking_bodies[1] or "floor" in away.blocking_bodies[1], (
        "through the floor"
    )
    near, in_tray = score_base_positions(DEFAULT_CELL, [(-0.65, 0.0), (0.0, 0.0)])
    assert near[0] == 1.0
    assert in_tray == (0.0, 0.0)


def test_the_reachability_map_covers_exactly_the_support() -> None:
    found = ReachabilityAnalysis(cell_with("support.size=[0.4, 0.8]")).compute_map((0.1,), 0.15)
    assert found.x == pytest.approx([-0.15, 0.0, 0.15])
    assert found.y == pytest.approx(np.linspace(-0.35, 0.35, 6))
    assert found.reachable_fraction.shape == found.manipulability.shape == (1, 3, 6)


def test_all_moves_are_in_the_plot_over_the_support() -> None:
    row = {"setup": "it", "result": PLANNED}
    moves = [row | {"pick_x": 0.1, "pick_y": 0.45}, row | {"pick_x": -0.14, "pick_y": -0.4}]
    figure = feasibility_report._plot_by_pick_position(
        moves, {"it": cell_with("support.size=[0.3, 1.0]")}
    )
    (panel, _) = figure.axes
    assert sorted(text.get_text() for text in panel.texts) == ["1", "1"]
    assert panel.images[0].get_extent() == pytest.approx([-0.15, 0.15, -0.5, 0.5])
    plt.close(figure)


def test_another_base_keeps_the_roll_and_pitch_of_the_cell() -> None:
    hanging = cell_with("robot.base.roll=180")
    (cell,) = command.make_setups([[0.1, -0.2, 1.4, 30.0]], [], [], hanging).values()
    assert cell.robot.base.translation == (0.1, -0.2, 1.4)
    assert cell.robot.base.rpy_deg == (180.0, 0.0, 30.0)


def test_cells_with_the_same_name_are_refused(scenes: Path, tmp_path: Path) -> None:
    paths = [tmp_path / folder / "cell.yaml" for folder in ("a", "b")]
    arguments = ["feasibility", str(scenes / "pile.yaml"), "--out", str(tmp_path / "study")]
    for path in paths:
        arguments += ["--cell", str(path)]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, InputError)
    assert "cell occurs twice; expected unique file names" in str(result.exception)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    save_scene(
        folder / "pile.yaml",
        SCENE,
        DEFAULT_CELL,
        Verdict(None, SCENE.poses, dict.fromkeys(SCENE.names, 1.0), ()),
    )
    leaning = scene_of(
        resting("gelatin_box"), resting("cracker_box", Orientation.UPRIGHT_0, (0.05, 0.0), 0.028)
    )
    save_scene(folder / "falls.yaml", leaning, DEFAULT_CELL)
    return folder


def reduce_study(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "BASE_GRID_X", [-0.8, -0.6])
    monkeypatch.setattr(command, "BASE_GRID_Y", [0.0, 0.2])
    monkeypatch.setattr(command, "MAP_SPACING", 0.3)
    monkeypatch.setattr(command, "MAP_HEIGHTS", (0.05, 0.3))
    monkeypatch.setattr(feasibility_report, "CASES_PER_KIND", 1)
    monkeypatch.setattr(feasibility_study, "MAX_NOISY_MOVES", 1)


def table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.open()))


def test_a_study_from_the_command_line(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reduce_study(monkeypatch)
    small = tmp_path / "small_cup.yaml"
    small.write_text("{suction: {cup_diameter: 0.015}}")
    targets = tmp_path / "targets.yaml"
    targets.write_text("[{name: up, translation: [0.1, 0.0, 0.2], quaternion: [0, 1, 0, 0]}]")
    out = tmp_path / "study"
    arguments = [
        "feasibility",
        str(scenes),
        "--out",
        str(out),
        "--base=-0.7,0,0.3,0",
        "--tray=0.65,0,-0.3,0",
        "--cell-override",
        str(small),
    ]
    result = CliRunner().invoke(app, [*arguments, "--targets", str(targets), "--json"])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["unstable_scenes"] == ["falls"]
    assert list(summary["setups"]) == ["small_cup", "base -0.7, 0, 0.3, 0", "tray 0.65, 0, -0.3, 0"]
    moves = table(out / "moves.csv")
    assert tuple(moves[0]) == MOVE_RECORD_FIELDS
    for name, found in summary["setups"].items():
        rows = [row for row in moves if row["setup"] == name]
        assert found["moves"] == len(rows) > 0
        assert found["planned"] == sum(row["result"] == PLANNED for row in rows) > 0
        for group in ("object_class", "resting_side"):
            assert found["groups"][group] == {
                value: {
                    "moves": sum(row[group] == value for row in rows),
                    "planned": sum(
                        row[group] == value and row["result"] == PLANNED for row in rows
                    ),
                }
                for value in {row[group] for row in rows}
            }
        for parts in found["groups"].values():
            assert sum(part["moves"] for part in parts.values()) == len(rows)
    assert {row["scene"] for row in moves} == {"pile"}
    assert len(table(out / "bases.csv")) == 4
    assert {(row["setup"], row["target"]) for row in table(out / "targets.csv")} == {
        (name, "up") for name in summary["setups"]
    }
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64") >= 10
    assert "http:" not in page
    assert "https:" not in page
    # Existing parts are kept, and missing ones are computed.
    monkeypatch.setattr(command, "write_feasibility_report", lambda *_: None)
    before = {path.name: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    (gone := next(path for path in (out / "parts").iterdir() if "scene_0001" in path.name)).unlink()
    result = CliRunner().invoke(app, [*arguments, "--targets", str(targets)])
    assert result.exit_code == 0, result.output
    after = {path.name: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    assert {name for name in after if after[name] != before[name]} == {gone.name}
    result = CliRunner().invoke(app, [*arguments, "--seed", "1"])
    assert isinstance(result.exception, InputError)
    assert "holds results of other options" in str(result.exception)


def test_a_study_of_other_robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scene is on a small tray, which all robots reach."""
    reduce_study(monkeypatch)
    pile = [resting("pudding_box"), resting("tomato_soup_can", xy=(-0.1, -0.15))]
    scene, out = scene_of(*pile, side=0.5), tmp_path / "study"
    verdict = Verdict(None, scene.poses, dict.fromkeys(scene.names, 1.0), ())
    save_scene(tmp_path / "pile.yaml", scene, DEFAULT_CELL, verdict)
    arguments = ["feasibility", str(tmp_path / "pile.yaml"), "--out", str(out)]
    names = ["iiwa14_epick_tray", "ur5e_epick_tray", "ur10e_epick_tray"]
    for name in names:
        option = "--cell" if name == names[-1] else "--cell-override"
        arguments += [option, str(resource_path(f"models/cells/{name}.yaml"))]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    setups = json.loads((out / "summary.json").read_text())["setups"]
    assert set(setups) == set(names)
    for found in setups.values():
        assert found["planned"] > 0
        assert set(found["results"]) <= {PLANNED, PlanningFailureReason.NO_FREE_PLACEMENT.value}
    reach = table(out / "reach.csv")
    for name in names:
        of_setup = [row for row in reach if row["setup"] == name]
        assert max(float(row["reachable_fraction"]) for row in of_setup) == 1.0
        assert {float(row["x"]) for row in of_setup} == {-0.2, 0.2}, (
            "over the scene's tray, whatever the cell's"
        )
    assert (out / "report.html").stat().st_size > 1e5


def test_the_tray_pose_is_the_inverse_of_the_base_pose() -> None:
    (one,) = command.make_setups([], [[0.4, 0.5, -0.3, 30.0]], [], DEFAULT_CELL).values()
    X_BT = one.robot.X_TB.inverse().GetAsMatrix4()
    assert X_BT[:3, 3] == pytest.approx([0.4, 0.5, -0.3])
    assert math.degrees(math.atan2(X_BT[1, 0], X_BT[0, 0])) == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[{name: a, translation: [0, 0], quaternion: [0, 1, 0, 0]}]",
            r"\[0\]\.translation: \[0, 0\]; expected",
        ),
        (
            "[{name: a, translation: [0, 0, 0], quaternion: [0, 0, 0, 0]}]",
            "expected w, x, y, z that are not all zero",
        ),
        ("{name: a}", "{'name': 'a'}; expected a list"),
        (
            "[{translation: [0, 0, 0]}]",
            r"\[0\]\.name: is missing; needed are name, translation, quaternion",
        ),
    ],
)
def test_invalid_targets(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "targets.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        command.read_targets(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "{suction: {cup_diameter: 1.0}}",
            r"gripper\.cups\[0\]\.diameter: 1\.0; expected a finite number from 0\.005 to 0\.1",
        ),
        ("{base: [0, 0]}", "base: is unknown"),
        (
            "{base: [0, 0, 0, north]}",
            "robot.base.rpy_deg\\[2\\]: 'north'; expected a finite number",
        ),
        ("{reach: 3}", "reach: is unknown"),
    ],
)
def test_invalid_cell_overrides(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        command.make_setups([], [], [path], DEFAULT_CELL)


def test_a_cell_override_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "long.yaml"
    path.write_text("{base: [-0.7, 0.1, 0.3, 10], suction: {extension: 0.15}}")
    found: dict[str, Any] = command.make_setups([], [], [path], DEFAULT_CELL)
    assert found == {
        "long": cell_with(
            *[
                "robot.base.x=-0.7",
                "robot.base.y=0.1",
                "robot.base.yaw=10",
                "gripper.extension=0.15",
            ]
        )
    }
