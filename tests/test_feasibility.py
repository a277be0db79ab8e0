"""Feasibility studies: setups and homes, moves, margins, maps, searches, and resuming a study."""

import csv
import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import DEFAULT_CELL, ONE_CUP, cell_with, resting, rng, scene_of
from feasibility_jobs import feasibility_job
from matplotlib.patches import Rectangle
from typer.testing import CliRunner

from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.cli import app
from drake_clutter.commands import feasibility_job as command
from drake_clutter.commands import feasibility_parts, feasibility_run
from drake_clutter.config import ClutterConfig
from drake_clutter.feasibility.base_search import make_base_grids, select_finalists
from drake_clutter.feasibility.home_search import Home, HomeSearch, view_corners
from drake_clutter.feasibility.margins import arm_reach, compute_margins, scaled_jacobians
from drake_clutter.feasibility.move_study import (
    MOVE_RECORD_FIELDS,
    PLANNED,
    FeasibilityStudy,
    objects_below,
    resting_side,
)
from drake_clutter.feasibility.pose_noise import NoiseKind, add_noise, scale_mass
from drake_clutter.feasibility.reach_map import ReachabilityAnalysis, tilted_pose
from drake_clutter.feasibility.setups import (
    Setup,
    SetupRequest,
    Sweep,
    UnusableSetup,
    parse_sweep,
    prepare_setup,
    sweep_setups,
)
from drake_clutter.feasibility.summary import share_interval, summarize_study
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.collision_model import VIEW
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.planning.tool_kinematics import downward_pose
from drake_clutter.reports import feasibility_cases, feasibility_figures
from drake_clutter.reports.feasibility_maps import write_interactive_maps
from drake_clutter.reports.feasibility_report import answer_sentences
from drake_clutter.reports.feasibility_tables import _with_interval
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.robots.ur_kinematics import jacobian, manipulability
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene import Pose
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.station.station_simulation import StationSimulation
from drake_clutter.statistics import ratio_interval

SCENE = scene_of(
    resting("pudding_box"),
    resting("gelatin_box", floor=0.035),
    resting("large_marker", xy=(0.2, 0.2)),
    resting("tomato_soup_can", xy=(-0.1, -0.2)),
)


def study(cell: WorkCell | None = None) -> FeasibilityStudy:
    return FeasibilityStudy("it", replace(ClutterConfig(), cell=cell or DEFAULT_CELL), 0)


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
        assert math.isfinite(row.unoptimized_s) == (row.result == PLANNED)
        assert row.possible == (row.result == PLANNED), "the arm reaches everything here"
        assert math.isfinite(row.place_x) == (row.result != "no free spot")
        assert row.num_below == (1 if row.pick == "gelatin_box" else 0)
        assert row.tool == ("single" if row.result == PLANNED else "")
    optimized = [row for row in rows if math.isfinite(row.cycle_s)]
    assert len(optimized) == min(5, sum(row.result == PLANNED for row in rows))
    assert all(2.0 < row.cycle_s < row.unoptimized_s for row in optimized)
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


def test_margins_of_a_plan() -> None:
    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False))
    place = SCENE["tomato_soup_can"].X_TO.translated((0.2, 0.1, 0.001))
    plan = planner.plan(SCENE.objects, "tomato_soup_can", place)
    assert isinstance(plan, PickPlacePlan)
    found = compute_margins(plan, DEFAULT_CELL, planner.tools[plan.tool])
    q = np.vstack(
        [s.trajectory.vector_values(np.linspace(0, s.duration, 200)).T for s in plan.segments]
    )
    lower, upper = planner.robot.position_limits.T
    assert found.joint_margin == pytest.approx(np.minimum(q - lower, upper - q).min(), abs=2e-3)
    scale = arm_reach(planner.robot) ** 3
    expected = planner.robot.manipulability(q).min() / scale
    assert found.manipulability == pytest.approx(expected, rel=0.02)
    values = np.linalg.svd(scaled_jacobians(planner.robot, q), compute_uv=False)
    assert found.singular_value == pytest.approx(values.min(), rel=0.02)
    assert 0.1 < found.torque_share <= 1.0
    assert 0.1 < found.load_share <= 1.0 + 1e-3
    assert 1 <= found.num_connected <= found.num_ik_solutions <= 8


def test_a_singular_arm_has_a_singular_value_of_zero() -> None:
    """A UR with a straight elbow, and with two parallel wrist axes."""
    robot = load_robot(DEFAULT_CELL.robot)
    q = np.array([[0.3, -1.0, 0.0, -1.0, 1.2, 0.0], [0.3, -1.0, 1.0, -1.0, 0.0, 0.0]])
    values = np.linalg.svd(scaled_jacobians(robot, q), compute_uv=False)
    assert values[:, -1] == pytest.approx([0.0, 0.0], abs=1e-9)


def test_a_given_home_is_kept_if_it_is_clear() -> None:
    home = HomeSearch(DEFAULT_CELL).find_home(keep=True)
    assert home == Home(DEFAULT_CELL.robot.home, is_given=True)


def test_a_home_is_found_beside_the_view() -> None:
    """On the table, the arm at the cell's home hides the tray from the camera."""
    low = cell_with("robot.base.z=0")
    search = HomeSearch(low)
    obstacle = search.find_obstacle(np.array(low.robot.home))
    assert obstacle is not None
    assert VIEW in obstacle.pair
    home = search.find_home(keep=True)
    assert isinstance(home, Home)
    assert not home.is_given
    assert VIEW in home.obstacle
    assert search.find_obstacle(np.array(home.q)) is None
    assert search.find_home(keep=True) == home, "the same again"
    setup = prepare_setup("low", SetupRequest(low, keep_home=False))
    assert isinstance(setup, Setup)
    assert setup.cell.robot.home == home.q


def test_the_view_is_the_hull_of_camera_and_support() -> None:
    corners = view_corners(DEFAULT_CELL)
    assert corners.shape == (9, 3)
    assert corners.max(axis=0) == pytest.approx([0.35, 0.35, 1.6])
    assert corners.min(axis=0) == pytest.approx([-0.35, -0.35, 0.0])


def test_unusable_setups_have_a_reason() -> None:
    def reason(*settings: str) -> str:
        setup = prepare_setup("it", SetupRequest(cell_with(*settings), keep_home=False))
        assert isinstance(setup, UnusableSetup)
        return setup.reason

    assert reason("robot.base.x=-0.2") == "the base stands in the support"
    assert reason("robot.base.x=-5") == "no part of the support is in reach"
    crate = '{"name": "crate", "box": [0.4, 0.4, 0.6], "pose": {"translation": [-0.65, 0, 0.6]}}'
    in_crate = "in collision wherever the support is in reach: upper_arm and crate"
    assert reason(f"fixtures=[{crate}]") == in_crate
    cell = load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml"))
    spec = cell.robot.model_copy(update={"ik": "ur"})
    request = SetupRequest(cell.model_copy(update={"robot": spec}))
    other = prepare_setup("it", request)
    assert isinstance(other, UnusableSetup)
    assert other.reason.startswith("robot.ik: 'ur' (iiwa14.sdf is no arm of the UR family")


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("robot.base.z=0:0.6:0.2", (0.0, 0.2, 0.4, 0.6)),
        ("robot.base.z=0:0.5:0.2", (0.0, 0.2, 0.4)),
        ("robot.base.z=0.3:-0.3:-0.3", (0.3, 0.0, -0.3)),
        ("robot.base.z=0.1", (0.1,)),
        ("robot.base.z=0.1,0.4", (0.1, 0.4)),
    ],
)
def test_sweeps(text: str, values: Sequence[float]) -> None:
    sweep = parse_sweep("--sweep", text)
    assert sweep.field == "robot.base.z"
    assert sweep.values == pytest.approx(values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot.base.z", "expected FIELD=FIRST:LAST:STEP"),
        ("robot.base.z=0:1", "expected FIELD=FIRST:LAST:STEP"),
        ("robot.base.z=0:1:0", "expected FIELD=FIRST:LAST:STEP"),
        ("robot.base.z=1:0:0.1", "expected FIELD=FIRST:LAST:STEP"),
        ("robot.base.z=a,b", "expected FIELD=FIRST:LAST:STEP"),
        ("robot.base.z=0.1,0.1", "with different values"),
        ("robot.base.z=0:1:1e-9", "1000000001 values; expected at most 2000"),
    ],
)
def test_invalid_sweeps(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_sweep("--sweep", text)


def test_all_combinations_are_swept() -> None:
    requests = {"default": SetupRequest(DEFAULT_CELL, keep_home=True)}
    sweeps = [Sweep("robot.base.z", (0.0, 0.3)), Sweep("gripper.cups.0.extension", (0.1, 0.2))]
    found = sweep_setups(requests, sweeps)
    assert [*found] == [
        f"robot.base.z={z}, gripper.cups.0.extension={e}" for z in ("0", "0.3") for e in (0.1, 0.2)
    ]
    last = found["robot.base.z=0.3, gripper.cups.0.extension=0.2"]
    assert last.cell == cell_with("gripper.cups.0.extension=0.2")
    assert not last.keep_home
    both = sweep_setups(requests | {"b": requests["default"]}, sweeps[:1])
    assert "b, robot.base.z=0" in both
    with pytest.raises(InputError, match=r"--sweep: 2002 setups; expected at most 2000"):
        sweep_setups(requests, [Sweep("a", tuple(range(1001))), Sweep("b", (0.0, 1.0))])
    with pytest.raises(InputError, match=r"--sweep robot\.base\.up=1: robot\.base\.up: is unknown"):
        sweep_setups(requests, [Sweep("robot.base.up", (1.0,))])


def test_the_reachability_map_agrees_with_single_poses() -> None:
    analysis = ReachabilityAnalysis(DEFAULT_CELL)
    found = analysis.compute_map((0.0, 90.0), (0.1, 1.5), 0.3)
    assert found.reachable_fraction.shape == found.singular_value.shape == (2, 2, 3, 3)
    assert (found.reachable_fraction[0, 0] == 1).all()
    assert (found.reachable_fraction[0, 1] < 1).any(), "too high"
    assert found.reachable_fraction[1, 0].mean() < 1, "the tool is horizontal near the floor"
    middle = analysis.analyze_poses(downward_pose(0.0, np.array([0.0, 0.0, 0.1]))[None])
    assert middle.is_reachable.tolist() == [True]
    robot = load_robot(DEFAULT_CELL.robot)
    values = np.linalg.svd(scaled_jacobians(robot, middle.q), compute_uv=False)
    assert middle.singular_value[0] == pytest.approx(values[0, -1])
    positions = [[3.0, 0.0, 0.1], [0.0, 0.0, -0.3]]
    away = analysis.analyze_poses(np.array([downward_pose(0.0, np.array(p)) for p in positions]))
    assert away.is_reachable.tolist() == [False, False]
    assert away.num_solutions[0] == 0
    assert away.obstacles[0] == ""
    assert "table" in away.obstacles[1] or "floor" in away.obstacles[1], "through the floor"


def test_the_reachability_map_covers_exactly_the_support() -> None:
    analysis = ReachabilityAnalysis(cell_with("support.size=[0.4, 0.8]"))
    found = analysis.compute_map((0.0,), (0.1,), 0.15)
    assert found.x == pytest.approx([-0.15, 0.0, 0.15])
    assert found.y == pytest.approx(np.linspace(-0.35, 0.35, 6))
    assert found.reachable_fraction.shape == (1, 1, 3, 6)


def test_a_tilted_tool_points_to_its_side() -> None:
    X = tilted_pose(math.radians(30), math.radians(90), np.array([0.1, 0.2, 0.3]))
    assert X[:3, 2] == pytest.approx([0.0, 0.5, -math.sqrt(0.75)])
    assert X[:3, 3] == pytest.approx([0.1, 0.2, 0.3])
    assert X[:3, :3] @ X[:3, :3].T == pytest.approx(np.eye(3))
    assert np.linalg.det(X[:3, :3]) == pytest.approx(1.0)


def test_bases_in_the_support_are_left_out() -> None:
    searches = [Sweep("robot.base.x", (-0.7, 0.0)), Sweep("robot.base.z", (0.0, 0.4))]
    (grid,) = make_base_grids(DEFAULT_CELL, searches)
    assert grid.bases.tolist() == [[-0.7, 0.0, 0.0, 0.0], [-0.7, 0.0, 0.4, 0.0]]
    assert "robot.base.z=0.4" in grid.settings_of(1)
    with pytest.raises(InputError, match="all bases stand in the support"):
        make_base_grids(DEFAULT_CELL, [Sweep("robot.base.x", (0.0, 0.1))])
    with pytest.raises(InputError, match="60000 bases; expected at most 50000"):
        make_base_grids(DEFAULT_CELL, [Sweep("robot.base.x", tuple(range(60000)))])
    with pytest.raises(InputError, match="the base is tilted; expected an upright one"):
        make_base_grids(cell_with("robot.base.roll=180"), searches)


def test_finalists_are_good_and_far_apart() -> None:
    """The first has the best neighborhood; bad bases are left out."""
    (grid,) = make_base_grids(DEFAULT_CELL, [Sweep("robot.base.y", tuple(np.arange(11) / 10))])
    share = np.array([0.5, 0.2, 1.0, 0.2, 0.2, 0.9, 1.0, 1.0, 1.0, 0.9, 0.2])
    found = [index for _, index in select_finalists([grid], [share])]
    assert found[:2] == [7, 2]
    assert {*found[2:]} == {6, 8}


def test_intervals_take_scenes_as_the_sample() -> None:
    counts = [(3, 3), (2, 4), (0, 0), (5, 5)]
    expected = ratio_interval([3, 2, 5], [3, 4, 5], (0, 5), (5, 5))
    assert share_interval(counts) == expected
    assert share_interval([(0, 0)]) is None
    low, high = share_interval([(3, 3)] * 20) or (0.0, 0.0)
    assert low == pytest.approx(0.025 ** (1 / 20), abs=1e-6), "the bound of Clopper and Pearson"
    assert high == 1.0


def move_row(setup: str, scene: str, pick: str, result: str) -> dict[str, Any]:
    (record,) = study().plan_all_moves("s", 0, scene_of(resting("pudding_box")))[:1]
    fields = {name: getattr(record, name) for name in MOVE_RECORD_FIELDS}
    possible = result not in ("no free spot", "no seal")
    changed = {"setup": setup, "scene": scene, "pick": pick, "result": result}
    return fields | changed | {"possible": possible}


def test_a_summary_is_of_the_possible_moves() -> None:
    results = {
        "a": [PLANNED, PLANNED, "unreachable", "no seal"],
        "b": [PLANNED, "unreachable", "unreachable", PLANNED],
    }
    cycles = {"a": (5.0, 3.0, None, None), "b": (4.0, None, None, math.nan)}
    row = move_row("a", "0", "0", PLANNED)
    moves = [
        row
        | {"setup": setup, "scene": str(k % 2), "pick": str(k), "result": result}
        | {"possible": result != "no seal", "cycle_s": cycles[setup][k]}
        for setup, found in results.items()
        for k, result in enumerate(found)
    ]
    home = Home(DEFAULT_CELL.robot.home, is_given=True)
    setups: dict[str, Setup | UnusableSetup] = {
        "b": Setup("b", DEFAULT_CELL, home),
        "a": Setup("a", DEFAULT_CELL, home),
        "c": UnusableSetup("c", "no home"),
    }
    summary = summarize_study(setups, moves, (), (), ["0", "1"])
    b, a, c = summary["setups"]
    assert (a["possible"], a["planned"], a["share"]) == (3, 2, 2 / 3)
    assert (a["impossible"], a["failures"]) == ({"no seal": 1}, {"unreachable": 1})
    assert (b["possible"], b["planned"], b["share"]) == (4, 2, 0.5)
    assert c["unusable"] == "no home"
    unknown = {key: [None, None] for key in ("median_ci95", "p95_ci95")}
    # If 5 % are above the quantile, both are with a probability of 0.05^2 only.
    bounded = unknown | {"p95_ci95": [3.0, None]}
    assert a["cycle_s"] == {"median": 3.0, "p95": 3.0} | bounded, "of two scenes only"
    assert b["cycle_s"] == {"median": 4.0, "p95": 4.0} | unknown, "of the optimized motions"
    assert b["failures_ci95"] == {"unreachable": share_interval([(1, 2), (1, 2)])}
    assert summary["ranking"] == ["a", "b"]
    (comparison,) = summary["comparisons"]
    assert comparison["possible_in_both"] == 3
    assert (comparison["planned_by_first_only"], comparison["planned_by_second_only"]) == (1, 0)
    assert comparison["difference"] == pytest.approx(1 / 3)
    low, high = comparison["difference_ci95"]
    assert -1 <= low < 0 < high <= 1
    first, second, third = answer_sentences(summary)
    assert first.startswith("a does 2 of the 3 moves that 2 scenes and its tools allow: 66.7 %")
    assert second == "Of its 1 failure, 1 is \u201cunreachable\u201d."
    assert third.endswith(
        f"b is next, 33.3 points behind (95 % interval {100 * low:.1f} to {100 * high:.1f}): the "
        "data are compatible with no difference."
    )


def test_pose_errors_have_their_size() -> None:
    objects = [resting("tomato_soup_can", name=str(k)) for k in range(400)]
    origin = objects[0].X_TO.p
    moved = np.array([o.X_TO.p - origin for o in add_noise(objects, NoiseKind.POSE, 0.01, rng())])
    assert moved[:, :2].std(axis=0) == pytest.approx([0.01, 0.01], rel=0.12)
    assert (moved[:, 2] == 0).all()
    shifted = np.array(
        [o.X_TO.p - origin for o in add_noise(objects, NoiseKind.CALIBRATION, 0.01, rng())]
    )
    assert np.ptp(shifted, axis=0) == pytest.approx([0, 0, 0]), "all alike"
    assert np.linalg.norm(shifted[0]) > 0
    assert add_noise(objects, NoiseKind.MASS, 0.5, rng()) == objects


def test_a_scaled_mass_is_simulated() -> None:
    scene = scene_of(resting("tomato_soup_can"))
    simulation = StationSimulation(DEFAULT_CELL, scene)
    scale_mass(simulation, "tomato_soup_can", 1.5)
    body = simulation.station.scene_plant.bodies["tomato_soup_can"]
    mass = scene.objects[0].object_class.mass
    assert body.get_mass(simulation.plant_context) == pytest.approx(1.5 * mass)


def test_all_moves_are_in_the_plot_over_the_support() -> None:
    row = {"setup": "it", "result": PLANNED, "possible": True}
    moves = [row | {"pick_x": 0.1, "pick_y": 0.45}, row | {"pick_x": -0.14, "pick_y": -0.4}]
    cells = {"it": cell_with("support.size=[0.3, 1.0]")}
    figure = feasibility_figures.plot_by_position(moves, cells, "pick", ["it"])
    (panel, _) = figure.axes
    assert sorted(text.get_text() for text in panel.texts) == ["1", "1"]
    assert panel.images[0].get_extent() == pytest.approx([-0.15, 0.15, -0.5, 0.5])


def test_reasons_of_failures_are_those_of_the_setups_shown() -> None:
    """Of two moves of a, one fails; b, which fails for another reason, is not shown."""
    row = {"setup": "a", "scene": "s", "possible": True}
    moves = [
        row | {"result": PLANNED},
        row | {"result": "unreachable"},
        row | {"setup": "b", "result": "in collision"},
    ]
    (axes,) = feasibility_figures.plot_failures(moves, ["a"]).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["unreachable"]
    (bar,) = axes.patches
    assert isinstance(bar, Rectangle)
    assert bar.get_width() == 0.5


def test_interactive_maps_hold_the_rows(tmp_path: Path) -> None:
    """Bases in the support have no number; text of the study cannot end the script element."""
    base = {"settings": "", "z": 0.0, "yaw": math.pi / 2, "possible": 7}
    bases = [
        base | {"x": x, "y": y, "reachable": n}
        for x, y, n in ((0.1, 0.2, 3), (0.1, 0.4, 5), (0.3, 0.4, 7))
    ]
    moves = [
        move_row("a", "</script>", "box", PLANNED),
        move_row("a", "s", "box", "no seal"),
        move_row("b", "s", "can", "unreachable"),
    ]
    write_interactive_maps(tmp_path, moves, {}, bases, ["a"])
    page = (tmp_path / "maps.html").read_text()
    assert page.count("</script>") == page.count("<script") == 3
    (source,) = re.findall(r'src="(.*?)"', page)
    assert "Plotly" in (tmp_path / source).read_text()
    data = json.loads(page.partition('type="application/json">')[2].partition("</script>")[0])
    (grid,) = data["bases"]
    assert (grid["x"], grid["y"], grid["yaw_deg"]) == ([0.1, 0.3], [0.2, 0.4], [90.0])
    assert grid["reachable"] == [[[[3, 5], [None, 7]]]]
    ((move,),) = [of_setup["rows"] for of_setup in data["moves"]]
    assert move["pick"] == [moves[0]["pick_x"], moves[0]["pick_y"]]
    assert move["text"].startswith("&lt;/script&gt;: box to tray<br>planned")


def test_another_base_keeps_the_roll_and_pitch_of_the_cell() -> None:
    hanging = cell_with("robot.base.roll=180")
    (request,) = command.make_setups([[0.1, -0.2, 1.4, 30.0]], [], [], hanging).values()
    cell = request.cell
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
    monkeypatch.setattr(feasibility_parts, "MAP_SPACING", 0.3)
    monkeypatch.setattr(feasibility_parts, "MAP_HEIGHTS", (0.05, 0.3))
    monkeypatch.setattr(feasibility_cases, "MAX_CASES_PER_SETUP", 1)


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
    arguments = ["feasibility", str(scenes), "--out", str(out), "--base=-0.7,0,0.3,0"]
    arguments += ["--base=-0.1,0,0.3,0", "--cell-override", str(small), "--targets", str(targets)]
    arguments += ["--agent", "largest-clear"]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    summary = json.loads((out / "summary.json").read_text())
    assert summary["unstable_scenes"] == ["falls"]
    names = ["small_cup", "base -0.7, 0, 0.3, 0", "base -0.1, 0, 0.3, 0"]
    assert [setup["name"] for setup in summary["setups"]] == names
    assert summary["setups"][2]["unusable"] == "the base stands in the support"
    assert {*summary["ranking"]} == {*names[:2]}
    moves = table(out / "moves.csv")
    assert [*moves[0]] == [*MOVE_RECORD_FIELDS]
    for setup in summary["setups"][:2]:
        rows = [row for row in moves if row["setup"] == setup["name"]]
        possible = [row for row in rows if row["possible"] == "True"]
        assert setup["legal"] == len(rows)
        assert setup["possible"] == len(possible) > 0
        assert setup["planned"] == sum(row["result"] == PLANNED for row in rows) > 0
        assert sum(setup["impossible"].values()) == len(rows) - len(possible)
        for parts in setup["groups"].values():
            assert sum(part["possible"] for part in parts.values()) == len(possible)
        assert setup["sequences"]["scenes"] == 1
    assert {row["scene"] for row in moves} == {"pile"}
    found = {(row["setup"], row["target"], row["reachable"]) for row in table(out / "targets.csv")}
    assert found == {(name, "up", "True") for name in names[:2]}
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64") >= 8
    assert "http:" not in page
    assert "https:" not in page
    # Existing parts are kept, and missing ones are computed.
    monkeypatch.setattr(feasibility_run, "write_feasibility_report", lambda *_: None)
    before = {path.name: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    gone = out / "parts" / "moves_0000_scene_0001.json"
    gone.unlink()
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    after = {path.name: path.stat().st_mtime_ns for path in (out / "parts").iterdir()}
    assert {name for name in after if after[name] != before[name]} == {gone.name}
    result = CliRunner().invoke(app, [*arguments, "--seed", "1"])
    assert isinstance(result.exception, InputError)
    assert "holds results of other options" in str(result.exception)


def test_a_killed_study_is_finished_by_any_number_of_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is the same, byte by byte, as a study that one process makes in one go."""
    monkeypatch.setattr(feasibility_run, "write_feasibility_report", lambda *_: None)
    cells = {"default": DEFAULT_CELL, "small": cell_with(ONE_CUP, "gripper.cup_diameter=0.015")}
    paths = tmp_path / "can.yaml", tmp_path / "box.yaml"
    for path, name in zip(paths, ("tomato_soup_can", "pudding_box"), strict=True):
        scene = scene_of(resting(name))
        verdict = Verdict(None, scene.poses, dict.fromkeys(scene.names, 1.0), ())
        save_scene(path, scene, DEFAULT_CELL, verdict)
    job = replace(
        feasibility_job(paths[0]),
        scenes=paths,
        setups={name: SetupRequest(cell, keep_home=True) for name, cell in cells.items()},
    )

    def run(name: str, workers: int, num_parts: float) -> dict[str, Any]:
        """Run a study that is killed after a number of parts."""

        def progress(parts: Iterable[Any], num_done: int, total: int) -> Iterable[Any]:
            for k, part in enumerate(parts):
                if total == 4 and num_done + k >= num_parts:
                    raise KeyboardInterrupt
                yield part

        return feasibility_run.run_feasibility_study(
            job, tmp_path / name, workers=workers, progress=progress
        )

    whole = run("whole", 1, math.inf)
    with pytest.raises(KeyboardInterrupt):
        run("killed", 1, 1)
    assert len([*(tmp_path / "killed" / "parts").glob("moves_*.json")]) == 1
    assert run("killed", 2, math.inf) == whole
    summaries = [(tmp_path / name / "summary.json").read_bytes() for name in ("whole", "killed")]
    assert summaries[0] == summaries[1]
    tables = [table(tmp_path / name / "moves.csv") for name in ("whole", "killed")]
    for first, second in zip(*tables, strict=True):
        assert first | {"planning_s": ""} == second | {"planning_s": ""}
    assert {setup["possible"] for setup in whole["setups"]} != {0}


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
    assert {setup["name"] for setup in setups} == {*names}
    for setup in setups:
        assert setup["planned"] == setup["possible"] > 0
        assert setup["home"]["is_given"]
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
    X_BT = one.cell.robot.X_TB.inverse().GetAsMatrix4()
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
    assert found["long"].cell == cell_with(
        *[
            "robot.base.x=-0.7",
            "robot.base.y=0.1",
            "robot.base.yaw=10",
            "gripper.extension=0.15",
        ]
    )


def test_bounds_that_are_not_known_are_left_out() -> None:
    assert _with_interval(1.25, [None, None], 1, " s") == "1.2 s"
    assert _with_interval(1.25, [1.0, None], 1, " s") == "1.2 (1.0 to -) s"
    assert _with_interval(None, None) == "-"
