"""The config: defaults, a user's file over them, and what is refused."""

from pathlib import Path

import pytest

from drake_clutter.config import CameraConfig, ClutterConfig, config_yaml, load_config
from drake_clutter.files import InputError


def config_file(folder: Path, text: str) -> Path:
    path = folder / "world.yaml"
    path.write_text(text)
    return path


def test_defaults() -> None:
    assert load_config() == ClutterConfig()
    assert load_config() is not load_config()


def test_a_file_changes_only_what_it_names(tmp_path: Path) -> None:
    config = load_config(config_file(tmp_path, "camera: {altitude: 2}\nexploration: {collapse_penalty: -2.5}\n"))
    expected = ClutterConfig()
    expected.camera.altitude = 2.0
    expected.exploration.collapse_penalty = -2.5
    assert config == expected


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    config = ClutterConfig()
    config.layout.tray_side = 0.1 + 0.2
    config.settle.calm_samples = 7
    assert load_config(config_file(tmp_path, config_yaml(config))) == config


def test_the_focal_length_is_that_of_the_field_of_view() -> None:
    """At 45 degrees half the height of the image lies one focal length times tan(22.5 deg) from its middle."""
    assert CameraConfig(height=480, fov_y_deg=90.0).focal_length == pytest.approx(240.0)
    assert CameraConfig(height=480, fov_y_deg=45.0).focal_length == pytest.approx(240.0 * (1 + 2**0.5))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("camera: {width: 640.5}", "width"),
        ("camera: {width: 0}", "camera.width"),
        ("camera: {altitude: 0}", "camera.altitude"),
        ("camera: {zoom: 2}", "zoom"),
        ("layout: {tray_side: -1}", "layout.tray_side"),
        ("layout: {tray_side: 0}", "layout.tray_side"),
        ("layout: {stack_gap: .nan}", "layout.stack_gap"),
        ("layout: {lying_gap: -0.001}", "layout.lying_gap"),
        ("settle: {time_step: 0}", "settle.time_step"),
        ("settle: {max_time: 0}", "settle.max_time"),
        ("settle: {jitter: .inf}", "settle.jitter"),
        ("exploration: {collapse_penalty: .nan}", "exploration.collapse_penalty"),
        ("exploration: {max_moves: -1}", "exploration.max_moves"),
        ("camera: {altitude: high}", "altitude"),
        ("camera: [1, 2]", "camera"),
        ("camera: {fov_y_deg: 0}", "camera.fov_y_deg"),
        ("camera: {fov_y_deg: 180}", "camera.fov_y_deg"),
        ("camera: {hidden_below: 1.5}", "camera.hidden_below"),
        ("layout: {placement_tries: 0}", "layout.placement_tries"),
        ("layout: {tray_side: 5}", "layout.tray_side"),
        ("settle: {calm_samples: 0}", "settle.calm_samples"),
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
    assert named in str(refusal.value).split("allowed are the fields of")[0]
    assert "allowed" in str(refusal.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.yaml"):
        load_config(tmp_path / "none.yaml")
