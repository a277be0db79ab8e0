"""Exported plans are evenly sampled, keep the limits, and switch the tools."""

import csv
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, scene_of
from typer.testing import CliRunner

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.cli.app import app
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.planning.motion_plan import DWELL_TIME
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.plan_export import check_export, sample_plan, to_csv, to_urscript
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import Move
from drake_clutter.scenes.scene import Pose
from drake_clutter.scenes.scene_file import load_scene, save_scene

BOX = resting("sugar_box", Orientation.UPRIGHT_0)
SCENE = scene_of(BOX, resting("pudding_box", xy=(-0.15, 0.1)))
PLACE = Pose((0.2, -0.2, BOX.X_TO.p[2] + 0.001), BOX.X_TO.quaternion)
ROBOT = load_robot(DEFAULT_CELL.robot)
TOOLS = [*DEFAULT_CELL.gripper.tools]


@pytest.fixture(scope="module")
def plan() -> PickPlacePlan:
    plan = PickPlacePlanner(DEFAULT_CELL, PlannerConfig()).plan(SCENE.objects, BOX.name, PLACE)
    assert isinstance(plan, PickPlacePlan)
    return plan


@pytest.mark.parametrize("rate", [125.0, 500.0])
def test_the_samples_of_the_csv_keep_the_limits(plan: PickPlacePlan, rate: float) -> None:
    """Velocities and accelerations are finite differences of the file."""
    rows = [*csv.DictReader(to_csv(sample_plan(plan, rate)).splitlines())]
    assert [*rows[0]] == [
        *("time", "phase", "cup"),
        *(f"q_{k}" for k in range(1, 7)),
        *(f"v_{k}" for k in range(1, 7)),
    ]
    times, q, v = (
        np.array([[float(row[name]) for name in names] for row in rows])
        for names in (
            ["time"],
            [f"q_{k}" for k in range(1, 7)],
            [f"v_{k}" for k in range(1, 7)],
        )
    )
    assert np.diff(times[:, 0]) == pytest.approx(1 / rate, abs=2e-6)
    velocities = np.diff(q, axis=0) * rate
    accelerations = np.diff(q, 2, axis=0) * rate**2
    assert (np.abs(velocities) <= 1.001 * ROBOT.velocity_limits).all()
    assert (np.abs(accelerations) <= 1.001 * ROBOT.acceleration_limits + 1e-3).all()
    assert (np.abs(v) <= 1.001 * ROBOT.velocity_limits).all()
    lower, upper = ROBOT.position_limits.T
    assert ((lower <= q) & (q <= upper)).all()
    middle = (v[1:] + v[:-1]) / 2
    assert np.abs(velocities - middle).max() < 2e-3 * (500 / rate) ** 2, "v is that of q"
    for end in (0, -1):
        assert q[end] == pytest.approx(ROBOT.home, abs=1e-6)
        assert v[end] == pytest.approx(0.0, abs=1e-6)


def test_phases_and_cups_follow_the_plan(plan: PickPlacePlan) -> None:
    samples = sample_plan(plan, 500.0)
    assert [*dict.fromkeys(samples.phases)] == ["approach", "grasp", "carry", "release", "retreat"]
    for name in ("grasp", "release"):
        dwell = np.array([phase == name for phase in samples.phases])
        assert dwell.sum() / 500 == pytest.approx(DWELL_TIME, abs=0.0021)
        assert np.abs(samples.v[dwell][1:]).max() < 1e-3
    for phase, tool in zip(samples.phases, samples.tools, strict=True):
        assert tool == (plan.tool if phase in ("grasp", "carry") else "")
    assert samples.times[-1] == pytest.approx(plan.duration + 2 * DWELL_TIME, abs=0.0021)


def test_urscript_streams_the_samples(plan: PickPlacePlan) -> None:
    samples = sample_plan(plan, 125.0)
    lines = to_urscript(samples, TOOLS).splitlines()
    numbers = r"\[(-?\d+\.\d{6}(?:, -?\d+\.\d{6}){5})\]"
    servo = re.compile(rf"  servoj\({numbers}, 0, 0, 0\.008, 0\.1, 300\)")
    move = re.compile(rf"  movej\({numbers}, a=0\.5, v=0\.5\)")
    output = re.compile(r"  set_tool_digital_out\(([01]), (True|False)\)")
    start, end = lines.index("def drake_clutter_plan():"), len(lines) - 1
    assert (lines[end - 1], lines[end]) == ("  stopj(1.0)", "end")
    commands = [line for line in lines[start + 1 : end - 1] if not line.startswith("  #")]
    assert all(
        pattern.fullmatch(line)
        for line in commands[3:]
        for pattern in [servo if "servoj" in line else output]
    )
    assert move.fullmatch(commands[2])
    assert commands[:2] == [f"  set_tool_digital_out({k}, False)" for k in range(2)]
    streamed = [match[1] for line in commands if (match := servo.fullmatch(line))]
    q = np.array([[float(value) for value in text.split(",")] for text in streamed])
    assert q == pytest.approx(samples.q, abs=1e-6)
    index = TOOLS.index(plan.tool)
    switched = [k for k, line in enumerate(commands) if output.fullmatch(line)][2:]
    states = [commands[k].strip() for k in switched]
    assert states == [f"set_tool_digital_out({index}, {state})" for state in ("True", "False")]
    # Three commands before the stream, and one switch before the second.
    assert samples.phases[switched[0] - 3] == "grasp"
    assert samples.phases[switched[1] - 4] == "release"
    assert [line.strip() for line in lines if line.startswith("  #")] == [
        f"# {phase}" for phase in dict.fromkeys(samples.phases)
    ]


def test_more_than_two_tools_have_standard_outputs(plan: PickPlacePlan) -> None:
    text = to_urscript(sample_plan(plan, 10.0), ["a", "b", "c", plan.tool])
    assert "  set_standard_digital_out(1, True)" in text.splitlines()
    assert "  set_standard_digital_out(0, False)" in text.splitlines()


def test_exports_that_cannot_be_run_are_refused() -> None:
    iiwa = load_robot(load_cell(resource_path("models/cells/iiwa14_epick_tray.yaml")).robot)
    check_export("csv", 1000.0, iiwa)
    with pytest.raises(InputError, match=r"^--export urscript: .*; expected an arm of the UR"):
        check_export("urscript", 500.0, iiwa)
    with pytest.raises(InputError, match=r"--rate 1000 with --export urscript; expected 10 to 500"):
        check_export("urscript", 1000.0, ROBOT)
    for rate in (0.0, math.nan, 1001.0):
        with pytest.raises(InputError, match="expected 10 to 1000 Hz"):
            check_export("csv", rate, ROBOT)


@pytest.mark.parametrize(
    ("place", "values"),
    [
        ("tray", None),
        ("0.2,-0.2,0.09,30", (0.2, -0.2, 0.09, 30.0)),
        ("0.2, -0.2, 0.09, 30", (0.2, -0.2, 0.09, 30.0)),
        ("0.2,-0.2,0.09", None),
        ("0.2,-0.2,nan,30", None),
    ],
)
def test_a_place_may_be_a_pose(place: str, values: tuple[float, ...] | None) -> None:
    assert Move("box", place).place_values == values


def test_plans_to_poses_are_exported_from_the_command_line(tmp_path: Path) -> None:
    save_scene(tmp_path / "scene.yaml", SCENE, DEFAULT_CELL)
    height = BOX.X_TO.p[2]
    moves = [
        {"pick": BOX.name, "place": f"0.2,-0.2,{height + 0.001},90"},
        {"pick": BOX.name, "place": f"0.2,-0.2,{height - 0.037},0"},
    ]
    (tmp_path / "moves.yaml").write_text(json.dumps(moves))
    arguments = ["move", str(tmp_path / "scene.yaml"), "--moves", str(tmp_path / "moves.yaml")]
    arguments += ["--fidelity", "arm", "--plan-only", "--export", "csv", "--export", "urscript"]
    out = tmp_path / "out"
    result = CliRunner().invoke(app, [*arguments, "--rate", "125", "--out", str(out)])
    assert result.exit_code == 1, result.output
    assert {path.name for path in out.iterdir()} >= {"plan_1.csv", "plan_1.script", "plan.json"}
    assert not (out / "plan_2.csv").exists()
    planned, refused = json.loads((out / "plan.json").read_text())["plans"]
    assert planned["place"]["translation"] == pytest.approx([0.2, -0.2, height + 0.001])
    found = Pose(tuple(planned["place"]["translation"]), tuple(planned["place"]["quaternion"]))
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert found.rotation == pytest.approx(quarter @ BOX.X_TO.rotation, abs=1e-3)
    assert (refused["reason"], refused["detail"]) == ("place in collision", "floor")
    assert refused["value"] == pytest.approx(0.037, abs=1e-4)
    assert refused["quantity"] == "37 mm"
    for extra, message in (
        (["--rate", "5"], "--rate 5 with --export csv; expected 10 to 1000 Hz"),
        (["--rate", "nan"], "--rate nan; expected a finite number"),
        (["--export", "pdf"], "'pdf' is not one of 'csv', 'urscript'"),
    ):
        result = CliRunner().invoke(app, [*arguments, *extra, "--out", str(tmp_path / "no")])
        assert result.exit_code != 0
        assert message in f"{result.output} {result.exception}"


def test_a_move_to_a_pose_is_carried_out(tmp_path: Path) -> None:
    """A box is teleported onto another one, and turned; it does not fit into the floor."""
    scene = scene_of(BOX, resting("cracker_box", xy=(-0.15, 0.1)))
    save_scene(tmp_path / "scene.yaml", scene, DEFAULT_CELL)
    z = scene["cracker_box"].top_height + BOX.X_TO.p[2] + 0.001
    arguments = ["move", str(tmp_path / "scene.yaml"), "--pick", BOX.name, "--place"]
    fidelity = ["--fidelity", "static_or_drake", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, [*arguments, f"-0.15,0.1,{z},45", *fidelity])
    assert result.exit_code == 0, result.output
    (move,) = json.loads((tmp_path / "out" / "episode.json").read_text())["moves"]
    assert move["outcome"] == "placed"
    after = load_scene(tmp_path / "out" / "after.yaml", load_catalog()).scene
    assert after[BOX.name].X_TO.p == pytest.approx([-0.15, 0.1, z - 0.001], abs=0.003)
    turned = BOX.X_TO.rotation.T @ after[BOX.name].X_TO.rotation
    assert math.degrees(math.acos((np.trace(turned) - 1) / 2)) == pytest.approx(45, abs=0.5)
