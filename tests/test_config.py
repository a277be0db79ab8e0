"""The config: defaults, files, earlier versions, invalid values."""

from dataclasses import replace
from pathlib import Path

import pytest
from conftest import DEFAULT_CELL, cell_with, tray, world_with

from drake_clutter.cell.camera import Camera
from drake_clutter.config import (
    ClutterConfig,
    SettleConfig,
    load_config,
    upgrade_config,
    upgrade_header_configs,
)
from drake_clutter.files import InputError
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import config_yaml, load_config_as


def config_file(folder: Path, text: str) -> Path:
    path = folder / "world.yaml"
    path.write_text(text)
    return path


def test_defaults() -> None:
    assert load_config() == ClutterConfig()


def test_a_file_changes_only_what_it_names(tmp_path: Path) -> None:
    config = load_config(
        config_file(tmp_path, "settle: {max_time: 3}\nexploration: {collapse_penalty: -2.5}\n")
    )
    expected = ClutterConfig()
    expected = replace(
        expected,
        settle=replace(expected.settle, max_time=3.0),
        exploration=replace(expected.exploration, collapse_penalty=-2.5),
    )
    assert config == expected


def test_a_file_of_version_0_1_names_parts_of_the_cell(tmp_path: Path) -> None:
    text = (
        "camera: {altitude: 2, width: 320, hidden_below: 0.2}\n"
        "layout: {tray_side: 0.5, stack_gap: 0.02}\n"
    )
    config = load_config(config_file(tmp_path, text))
    camera = Camera.overhead(2.0, width=320, visibility_threshold=0.2)
    cell = DEFAULT_CELL.model_copy(update={"support": tray(0.5), "cameras": {"overhead": camera}})
    assert config == replace(
        ClutterConfig(), layout=replace(ClutterConfig().layout, stack_gap=0.02), cell=cell
    )


def test_fields_under_their_earlier_names(tmp_path: Path) -> None:
    text = (
        "{rest_drift: 0.1, calm_speed: 0.2, calm_displacement: 0.3, calm_tilt_deg: 0.4, "
        "calm_samples: 5}"
    )
    path = config_file(tmp_path, f"settle: {text}\nlayout: {{placement_tries: 7}}\n")
    config = load_config(path, ["settle.still_displacement=0.6"])
    assert config.settle == SettleConfig(
        max_rest_displacement=0.1,
        early_stop_speed=0.2,
        early_stop_displacement=0.3,
        early_stop_tilt_deg=0.4,
        early_stop_samples=5,
        chatter_displacement=0.6,
    )
    assert config.layout.placement_attempts == 7
    head = {"world": {"settle": {"rest_drift": 0.1}, "layout": {"placement_tries": 7}}}
    assert upgrade_header_configs(head) == {
        "world": {"settle": {"max_rest_displacement": 0.1}, "layout": {"placement_attempts": 7}}
    }


def test_what_is_given_in_the_cell_is_left_alone_and_goes_over_what_moved_there(
    tmp_path: Path,
) -> None:
    """Fields of the cell are kept, and override those that moved there from version 0.1."""
    text = "{pose: {translation: [0, 0, 2], rpy_deg: [180, 0, 0]}, width: 320}"
    config = load_config(
        config_file(tmp_path, f"cell: {{cameras: {{camera: {text}, arm: {text}}}}}")
    )
    assert list(config.cell.cameras) == ["camera", "arm"]
    both = "camera: {width: 320, height: 100}\ncell: {cameras: {overhead: {height: 200}}}\n"
    camera = load_config(config_file(tmp_path, both)).cell.camera
    assert (camera.width, camera.height) == (320, 200)


@pytest.mark.parametrize(
    "text",
    [
        "camera: {}\ncell: 3",
        "arm: {}\nworld: 3",
        "arm: {}\nworld: {cell: [1]}",
        "layout: {tray_side: 1}\ncell: {support: 1}",
    ],
)
def test_parts_that_no_version_had_are_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"world\.yaml: .*expected"):
        load_config_as(Scenario(), config_file(tmp_path, text), upgrade=upgrade_config)


def test_two_cameras_are_read_back(tmp_path: Path) -> None:
    config = world_with(
        "cell.cameras={side: {pose: {translation: [0, -1, 1], rpy_deg: [-135, 0, 0]}}, "
        "top: {pose: {}}}"
    )
    assert list(config.cell.cameras) == ["side", "top"]
    assert load_config(config_file(tmp_path, config_yaml(config))) == config
    one = load_config(settings=["cell.cameras.top.width=320"], path=tmp_path / "world.yaml")
    assert [camera.width for camera in one.cell.cameras.values()] == [640, 320]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "fixtures=[{name: tray, box: [1, 1, 1]}]",
            "fixtures.tray: is taken; expected names that differ, also from tray, camera",
        ),
        (
            "fixtures=[{name: a, box: [1, 1, 1]}, {name: a, box: [1, 1, 1]}]",
            "fixtures.a: is taken; expected names that differ",
        ),
        ("fixtures=[{name: overhead, box: [1, 1, 1]}]", "gripper, overhead"),
        ("fixtures=[{name: a}]", "fixtures[0]: {'name': 'a'}; expected either a box or a model"),
        (
            "fixtures=[{name: a, box: [1, 1, 1], model: a.sdf}]",
            "expected either a box or a model",
        ),
        (
            "fixtures=[{name: a, box: [1, 1]}]",
            "fixtures[0].box: [1, 1]; expected a list of 3 numbers",
        ),
        (
            "fixtures=[{name: a, box: [1, 1, 1], color: [2, 0, 0, 1]}]",
            "fixtures[0].color[0]: 2; expected a finite number from 0",
        ),
        ("cameras={}", "cameras: {}; expected a mapping of at least one entry"),
        ("robot.home=[]", "robot.home: []; expected a list of at least one entry"),
        ("robot.home=[0, 0, 0]", "expected 3, as robot.home has"),
        (
            "robot.limits.jerk=[1, 2]",
            "robot.limits.jerk: 2 values; expected 6, as robot.home has",
        ),
        (
            "robot.limits.position=[[1, 2, 3]]",
            "robot.limits.position[0]: [1, 2, 3]; expected a list of 2 numbers",
        ),
    ],
)
def test_a_cell_that_cannot_be(setting: str, message: str) -> None:
    with pytest.raises(InputError) as refusal:
        cell_with(setting)
    assert message in str(refusal.value)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    config = world_with(
        f"cell.support.size={[0.1 + 0.2, 0.5]}",
        "settle.early_stop_samples=7",
        "cell.robot.base.yaw=10",
    )
    assert config.cell.support.size == (0.1 + 0.2, 0.5)
    assert load_config(config_file(tmp_path, config_yaml(config))) == config


def test_the_focal_length_is_that_of_the_field_of_view() -> None:
    """At 45 degrees, half the image height is one focal length times tan(22.5 deg)."""
    assert Camera.overhead(1.6, height=480, fov_y_deg=90.0).focal_length == pytest.approx(240.0)
    assert Camera.overhead(1.6, height=480, fov_y_deg=45.0).focal_length == pytest.approx(
        240.0 * (1 + 2**0.5)
    )


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("camera: {width: 640.5}", "width"),
        ("camera: {width: 0}", "cameras.overhead.width"),
        ("camera: {zoom: 2}", "zoom"),
        ("layout: {tray_side: -1}", "cell.support.size"),
        ("layout: {tray_side: 0}", "cell.support.size"),
        ("layout: {stack_gap: .nan}", "layout.stack_gap"),
        ("layout: {lying_gap: -0.001}", "layout.lying_gap"),
        ("settle: {time_step: 0}", "settle.time_step"),
        ("settle: {max_time: 0}", "settle.max_time"),
        ("settle: {jitter: .inf}", "settle.jitter"),
        ("exploration: {collapse_penalty: .nan}", "exploration.collapse_penalty"),
        ("exploration: {max_moves: -1}", "exploration.max_moves"),
        ("camera: {altitude: high}", "translation"),
        ("settle: [1, 2]", "settle"),
        ("camera: {fov_y_deg: 0}", "cameras.overhead.fov_y_deg"),
        ("camera: {fov_y_deg: 180}", "cameras.overhead.fov_y_deg"),
        ("camera: {hidden_below: 1.5}", "cameras.overhead.visibility_threshold"),
        ("layout: {placement_tries: 0}", "layout.placement_attempts"),
        ("layout: {tray_side: 5}", "cell.support.size"),
        ("settle: {calm_samples: 0}", "settle.early_stop_samples"),
        ("explorer: {}", "explorer"),
        ("- a list", "world.yaml"),
        ("settle: {time_step: 0.001", "world.yaml"),
        ("just words", "world.yaml"),
    ],
)
def test_a_broken_file_is_refused(text: str, named: str, tmp_path: Path) -> None:
    path = config_file(tmp_path, text)
    with pytest.raises(InputError) as refusal:
        load_config(path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert "\n" not in str(refusal.value)
    assert named in str(refusal.value).split("expected the fields of")[0]
    assert "expected" in str(refusal.value)


def test_a_setting_names_an_entry_of_a_list() -> None:
    """Settings keep the other fields of an entry and the other entries."""
    cell = cell_with("fixtures.0.pose.z=-0.05", "robot.limits.acceleration.1=2")
    (table,), (before,) = cell.fixtures, DEFAULT_CELL.fixtures
    assert table == before.model_copy(
        update={"pose": before.pose.model_copy(update={"translation": (0.0, 0.0, -0.05)})}
    )
    assert cell.robot.limits.acceleration == (4.0, 2.0, 6.0, 10.0, 10.0, 10.0)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml"):
        load_config(tmp_path / "none.yaml")
