"""Trajectory files: round trip, refusal of other files, and replay from the command line."""

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import ONE_CUP, cell_with, executed, resting, rng, scene_of, tray
from typer.testing import CliRunner

from drake_clutter.catalog import load_catalog
from drake_clutter.cli import app
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import Move, MoveResult, Outcome
from drake_clutter.scenes.scene_file import save_scene
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.trajectory_file import read_trajectories, write_trajectories
from ur10 import LINKS

CELL = cell_with(ONE_CUP)
"""Cell whose gripper does not hold the marker."""
SCENE = scene_of(
    resting("pudding_box"),
    resting("gelatin_box", floor=0.035),
    resting("large_marker", xy=(0.2, 0.2)),
)
MOVES = (Move("gelatin_box"), Move("large_marker"))


@pytest.fixture(scope="module")
def outcomes(config: ClutterConfig, detector: LabelDetector) -> list[tuple[Move, Outcome]]:
    observation, executor = (
        detector.perceive(SCENE).observation,
        ArmExecutor(replace(config, cell=CELL)),
    )
    return [(move, executed(executor, SCENE, observation, move, rng())) for move in MOVES]


@pytest.fixture
def file(outcomes: list[tuple[Move, Outcome]], tmp_path: Path) -> Path:
    path = tmp_path / "trajectory.h5"
    assert write_trajectories(path, SCENE, outcomes, CELL) == 1, "the marker is not moved"
    return path


def test_written_trajectories_are_read_back(
    file: Path, outcomes: list[tuple[Move, Outcome]]
) -> None:
    scene, cell, moves = read_trajectories(file, load_catalog())
    assert cell == CELL
    assert scene.poses == SCENE.poses
    ((move, motion),) = moves
    assert move == MOVES[0]
    written = outcomes[0][1].motion
    assert [frame.time for frame in motion] == [frame.time for frame in written]
    assert [frame.arm for frame in motion] == [frame.arm for frame in written]
    for frame, other in zip(motion, written, strict=True):
        for name in scene.names:
            assert frame.poses[name].translation == other.poses[name].translation
            assert frame.poses[name].quaternion == pytest.approx(other.poses[name].quaternion)


def test_the_cell_of_a_file_has_the_support_of_the_scene(
    outcomes: list[tuple[Move, Outcome]], tmp_path: Path
) -> None:
    path, other = tmp_path / "trajectory.h5", CELL.with_support(tray(0.9))
    write_trajectories(path, SCENE, outcomes, other)
    scene, cell, _ = read_trajectories(path, load_catalog())
    assert cell.support == scene.support == SCENE.support
    assert cell == CELL


def test_datasets_are_consistent(file: Path) -> None:
    with h5py.File(file) as stored:
        move = stored["move_0001"]
        time, q, v, torque, suction = (
            move[name][()] for name in ("time", "q", "v", "torque", "suction")
        )
        assert move.attrs["result"] == MoveResult.PLACED.value
        assert move["X_TO"].shape == (len(time), 3, 7)
    mean_velocity = (q[2:] - q[:-2]) / (time[2:] - time[:-2])[:, None]
    assert np.abs(mean_velocity - v[1:-1]).max() < 0.15
    assert np.abs(torque).max() > 10
    assert (np.abs(torque) <= [1.01 * link.max_torque for link in LINKS]).all()
    assert (np.abs(v) <= [1.01 * link.max_speed for link in LINKS]).all()
    switches = np.flatnonzero(np.diff(suction.astype(int)))
    assert len(switches) == 2, "on once, off once"


def test_other_files_are_refused(file: Path, tmp_path: Path) -> None:
    catalog = load_catalog()
    (tmp_path / "text.h5").write_text("text")
    with pytest.raises(InputError, match=r"cannot be read .*; expected a trajectory file"):
        read_trajectories(tmp_path / "text.h5", catalog)
    with pytest.raises(InputError, match="expected a trajectory file") as refusal:
        read_trajectories(tmp_path, catalog)
    assert "\n" not in str(refusal.value)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = 1
    with pytest.raises(InputError, match="expected a trajectory file of version 1"):
        read_trajectories(tmp_path / "other.h5", catalog)
    with h5py.File(file, "a") as stored:
        del stored["move_0001/q"]
    with pytest.raises(InputError, match=r"move_0001\.q; expected a dataset of shape \('n', 6\)"):
        read_trajectories(file, catalog)


def test_replay_and_plan_only_from_the_command_line(file: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    result = runner.invoke(app, ["replay", str(file), "--html", str(tmp_path / "replay.html")])
    assert result.exit_code == 0, result.output
    assert "gelatin_box -> tray" in result.output
    assert (tmp_path / "replay.html").stat().st_size > 100_000
    save_scene(tmp_path / "scene.yaml", SCENE, CELL)
    moves = tmp_path / "moves.yaml"
    moves.write_text("[{pick: gelatin_box, place: tray}, {pick: large_marker, place: tray}]")
    arguments = [
        "move",
        str(tmp_path / "scene.yaml"),
        "--moves",
        str(moves),
        "--fidelity",
        "arm",
        "--plan-only",
    ]
    result = runner.invoke(app, [*arguments, "--out", str(tmp_path / "plans")])
    assert result.exit_code == 0, result.output
    planned, failed = json.loads((tmp_path / "plans" / "plan.json").read_text())["plans"]
    assert planned["planned"]
    assert [segment["name"] for segment in planned["segments"]] == ["approach", "carry", "retreat"]
    assert planned["segments"][0]["q"][0] == pytest.approx(CELL.robot.home)
    assert len(planned["segments"][1]["q"]) == len(planned["segments"][1]["time"])
    assert (failed["planned"], failed["reason"], failed["detail"]) == (
        False,
        "no seal",
        "large_marker",
    )
    assert failed["value"] is None, "its lip would be partly in the air"
