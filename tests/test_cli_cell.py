"""Commands with other work cells: what they use, what they write, and what they refuse."""

import json
from pathlib import Path

import pytest
import yaml
from conftest import DEFAULT_CELL, ONE_CUP, cell_with, resting, scene_of
from typer.testing import CliRunner

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.cli import app
from drake_clutter.cli.config_from_options import load_config_from_options
from drake_clutter.cli.run import _load_scenario
from drake_clutter.files import InputError
from drake_clutter.recording.hdf5_file import load_episode
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.validation import config_yaml, to_plain, validate

UR5E = resource_path("models/cells/ur5e_epick_tray.yaml")
SCENE = scene_of(
    resting("gelatin_box", xy=(-0.1, 0.1)), resting("pudding_box", xy=(0.15, -0.1)), side=0.6
)


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    save_scene(path, SCENE, load_cell(UR5E).with_support(SCENE.support))
    return path


def run(*arguments: str | Path, code: int = 0) -> str:
    """Run a command, check its exit code and return what it prints."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == code, result.output
    return result.output


def test_a_move_uses_and_stores_the_cell_of_the_scene(scene_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(
        "move",
        scene_file,
        "--pick",
        "gelatin_box",
        "--place",
        "tray",
        "--fidelity",
        "arm",
        "--out",
        out,
    )
    expected = load_cell(UR5E).with_support(SCENE.support)
    recorded = load_episode(out / "trajectory.h5", load_catalog())
    assert recorded.cell == expected
    (action,) = recorded.actions
    assert action.samples is not None
    assert load_scene(out / "after.yaml", load_catalog()).cell == expected
    episode = json.loads((out / "episode.json").read_text())
    assert validate(WorkCell, episode["cell"], "episode.json") == expected
    assert episode["moves"][0]["outcome"] == action.result.value == "placed"
    assert (episode["trajectory"], episode["moves"][0]["action"]) == (
        "trajectory.h5",
        "action_0001",
    )


def test_options_replace_the_cell_of_the_scene_except_its_support(
    scene_file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    cell = tmp_path / "higher.yaml"
    higher = DEFAULT_CELL.model_copy(
        update={"robot": DEFAULT_CELL.robot.model_copy(update={"payload": 9.0})}
    )
    cell.write_text(config_yaml(higher))
    moves = ("--pick", "gelatin_box", "--place", "tray", "--fidelity", "arm", "--plan-only")
    run("move", scene_file, *moves, "--cell", cell, "--set", "robot.base.z=0.35", "--out", out)
    plan = json.loads((out / "plan.json").read_text())
    assert plan["plans"][0]["planned"]
    assert plan["cell"]["robot"]["payload"] == 9.0
    assert plan["cell"]["robot"]["base"]["translation"][2] == 0.35
    assert plan["cell"]["support"]["size"] == [0.6, 0.6]


def test_a_scenario_has_the_support_of_its_scene(scene_file: Path) -> None:
    scenario = _load_scenario(None, UR5E, [f"scene={scene_file}"])
    assert scenario.world.cell == load_cell(UR5E).with_support(SCENE.support)
    assert _load_scenario(None, UR5E, []).world.cell == load_cell(UR5E)


@pytest.mark.parametrize(
    "setting", ["support.size=[0.8, 0.8]", "cell.support.floor_height=0.2", "layout.tray_side=0.8"]
)
def test_scenes_keep_their_support(setting: str, scene_file: Path, tmp_path: Path) -> None:
    commands: list[list[str | Path]] = [
        ["feasibility", scene_file],
        ["evaluate", tmp_path],
        ["run", "--set", f"scene={scene_file}"],
    ]
    for command in commands:
        with pytest.raises(
            InputError, match="the support is that of the scene; expected other fields"
        ):
            run(*command, "--set", setting, "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot": {"tool_frame": None}}, r"robot\.tool_frame: None; expected a text"),
        ({"robot": {"model": ""}}, r"robot\.model: ''; expected a text"),
        ({"robot": {"tool_frame": "nose"}}, r"robot\.tool_frame: 'nose'.*expected"),
        ({"robot": {"model": "none.sdf"}}, r"robot\.model: .*none\.sdf.*expected"),
        ({"robot": {"home": [0.0, 0.0]}}, r"robot\..*expected"),
        ({"robot": {"home": [0.0, 0.0, 0.0, 0.0, 0.0, 7.0]}}, r"robot\.home.*expected"),
        ({"robot": {"arm": 3}}, r"robot\.arm: is unknown; expected"),
        ({"gripper": {"kind": "hand"}}, r"gripper\.kind: 'hand'; expected"),
        ({"support": {"size": [9.0, 0.5]}}, r"support\.size\[0\]: 9\.0; expected"),
        (
            {"cameras": {"overhead": {"pose": {"rpy_deg": [0, 0, 0]}}}},
            r"does not see the support; expected",
        ),
        ({"fixtures": [{"name": "post"}]}, r"fixtures\[0\].*expected"),
    ],
)
def test_an_invalid_cell_is_reported_in_one_line(
    change: dict[str, object], message: str, scene_file: Path, tmp_path: Path
) -> None:
    cell = tmp_path / "cell.yaml"
    document = to_plain(DEFAULT_CELL)
    for part, fields in change.items():
        document[part] = (
            {**document[part], **fields}
            if isinstance(fields, dict) and part != "cameras"
            else fields
        )
    cell.write_text(yaml.safe_dump(document))
    arguments = (
        "move",
        scene_file,
        "--pick",
        "gelatin_box",
        "--place",
        "tray",
        "--fidelity",
        "arm",
        "--cell",
        cell,
    )
    with pytest.raises(InputError, match=message) as refusal:
        run(*arguments, "--out", tmp_path / "out")
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith(f"{cell}: ")
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    "options",
    [("--cell", "own.yaml"), ("--config", "config.yaml"), ("--set", "robot.model=none.sdf")],
)
def test_commands_without_an_arm_check_the_cell(
    options: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise scenes made with it would fail later."""
    monkeypatch.chdir(tmp_path)
    own = DEFAULT_CELL.model_copy(
        update={"robot": DEFAULT_CELL.robot.model_copy(update={"model": "none.sdf"})}
    )
    Path("own.yaml").write_text(config_yaml(own))
    Path("config.yaml").write_text("cell: {robot: {model: none.sdf}}")
    source = "--set" if options[0] == "--set" else options[1]
    with pytest.raises(
        InputError, match=rf"{source}: robot\.model: .*none\.sdf'; expected an SDF or URDF file"
    ):
        run("generate", "--nodes", "6", "--count", "1", "--out", "out", *options)
    assert not Path("out").exists()


def test_a_model_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options are relative to the working directory; written files contain absolute paths."""
    monkeypatch.chdir(tmp_path)
    Path("arm.sdf").write_text(resource_path("models/robots/ur10.sdf").read_text())
    world = load_config_from_options(None, None, ["robot.model=arm.sdf"])
    assert world.cell.robot.model == str(tmp_path / "arm.sdf")


def test_a_config_replaces_fields_of_the_cell(tmp_path: Path) -> None:
    """The config is one of version 0.1."""
    config = tmp_path / "config.yaml"
    config.write_text("{layout: {tray_side: 0.5}, camera: {altitude: 1.4}}")
    world = load_config_from_options(config, UR5E, ["robot.base.z=0.35"])
    assert world.cell.robot.model == load_cell(UR5E).robot.model
    assert world.cell.robot.base.translation[2] == 0.35
    assert world.cell.support.size == (0.5, 0.5)
    assert world.cell.camera.pose.translation[2] == 1.4


def test_a_study_refuses_cells_with_the_same_name(scene_file: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / UR5E.name
    other.write_text(config_yaml(load_cell(UR5E)))
    with pytest.raises(
        InputError,
        match="--cell, --cell-override: ur5e_epick_tray occurs twice; expected unique file",
    ):
        run("feasibility", scene_file, "--cell", UR5E, "--cell", other, "--out", tmp_path / "out")


def test_plans_alone_from_the_command_line(tmp_path: Path) -> None:
    """The small gripper does not hold the marker."""
    cell = cell_with(ONE_CUP)
    scene = scene_of(
        resting("pudding_box"),
        resting("gelatin_box", floor=0.035),
        resting("large_marker", xy=(0.2, 0.2)),
    )
    save_scene(tmp_path / "scene.yaml", scene, cell)
    moves = tmp_path / "moves.yaml"
    moves.write_text("[{pick: gelatin_box, place: tray}, {pick: large_marker, place: tray}]")
    options = ("--fidelity", "arm", "--plan-only", "--out", tmp_path / "plans")
    output = run("move", tmp_path / "scene.yaml", "--moves", moves, *options, code=1)
    assert "no plan: no seal: large_marker" in output
    planned, failed = json.loads((tmp_path / "plans" / "plan.json").read_text())["plans"]
    assert planned["planned"]
    assert [segment["name"] for segment in planned["segments"]] == ["approach", "carry", "retreat"]
    assert planned["segments"][0]["q"][0] == pytest.approx(cell.robot.home)
    assert len(planned["segments"][1]["q"]) == len(planned["segments"][1]["time"])
    assert (failed["planned"], failed["reason"], failed["detail"]) == (
        False,
        "no seal",
        "large_marker",
    )
    assert failed["value"] is None, "its lip would be partly in the air"
