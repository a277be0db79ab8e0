"""Recorded episodes: what is recorded, files of earlier versions, replay from the command line."""

from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import av
import h5py
import numpy as np
import pytest
from conftest import CATALOG, ONE_CUP, cell_with, resting, scene_of
from typer.testing import CliRunner

from drake_clutter import __version__
from drake_clutter.cli import app
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.recording.episode_recorder import (
    POLICY_ERROR,
    record_episode,
    recorded_action,
)
from drake_clutter.recording.exact_replay import compare_samples, replay_action
from drake_clutter.recording.hdf5_file import load_episode, save_episode
from drake_clutter.recording.recorded_episode import (
    EpisodeHeader,
    RecordedAction,
    RecordedEpisode,
)
from drake_clutter.reports.recording import motion_frames, replay_frames
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation, Outcome
from drake_clutter.tasks.belief import Belief, Decision, Policy
from drake_clutter.tasks.exploration_task import Transition

CELL = cell_with(ONE_CUP)
"""Cell whose gripper does not hold the marker."""
SCENE = scene_of(
    resting("pudding_box"),
    resting("gelatin_box", floor=0.035),
    resting("large_marker", xy=(0.2, 0.2)),
)
VERSION_1 = Path(__file__).parent / "data/trajectory_v1.h5"
"""The move of the gelatin box, with every eighth sample."""


def given_moves(moves: Sequence[Move]) -> Policy:
    """Return a policy with a list of moves, which fails where the list has None."""

    def choose(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        return Decision(moves[len(belief.history)])

    return choose


def record(
    config: ClutterConfig, moves: Sequence[Move], seen: list[RecordedAction]
) -> RecordedEpisode:
    return record_episode(
        SCENE,
        lambda _: given_moves(moves),
        replace(config, cell=CELL),
        EpisodeHeader("given", seed=3, index=2, scene_name="pile"),
        max_moves=3,
        stop_when_all_found=False,
        on_action=seen.append,
    )


@pytest.fixture(scope="module")
def actions() -> list[RecordedAction]:
    return []


@pytest.fixture(scope="module")
def episode(config: ClutterConfig, actions: list[RecordedAction]) -> RecordedEpisode:
    """An episode whose policy fails at its third move."""
    return record(config, [Move("large_marker"), Move("gelatin_box")], actions)


def test_failed_plans_and_executed_moves_are_recorded(
    episode: RecordedEpisode, actions: list[RecordedAction]
) -> None:
    failed, moved = episode.actions
    assert [action.move for action in actions] == [failed.move, moved.move]
    assert (failed.move, failed.result) == (Move("large_marker"), MoveResult.NOT_PLANNED)
    assert (failed.failure_reason, failed.samples) == ("no seal", None)
    assert (moved.move, moved.result, moved.failure_reason) == (
        Move("gelatin_box"),
        MoveResult.PLACED,
        "",
    )
    assert moved.tool == next(iter(CELL.gripper.tools))
    assert moved.samples is not None
    assert moved.X_TO_place is not None
    k = SCENE.names.index("gelatin_box")
    end = moved.samples.X_TO[-1, k, 4:]
    assert end[:2] == pytest.approx(moved.X_TO_place.p[:2], abs=1e-3)
    assert end[2] == pytest.approx(0.014, abs=5e-4), "half its height"
    assert moved.samples.X_TO[0, k, 4:] == pytest.approx(SCENE["gelatin_box"].X_TO.p, abs=1e-9)
    assert {*failed.believed} == {*moved.believed} == {*SCENE.names}
    assert moved.believed["gelatin_box"].p == pytest.approx(SCENE["gelatin_box"].X_TO.p)


def test_an_exception_of_the_policy_ends_the_episode(episode: RecordedEpisode) -> None:
    assert episode.error == "IndexError: list index out of range"
    assert episode.termination == POLICY_ERROR
    assert (episode.seed, episode.index, episode.policy, episode.scene_name) == (
        3,
        2,
        "given",
        "pile",
    )
    assert (episode.package_version, episode.drake_version) == (__version__, version("drake"))


def test_a_move_of_an_object_out_of_view_is_an_error_of_the_policy(config: ClutterConfig) -> None:
    episode = record(config, [Move("sugar_box")], [])
    assert episode.error.startswith("ValueError: sugar_box -> tray: expected objects in view")
    assert episode.actions == ()


def test_a_move_without_a_placement_has_a_reason() -> None:
    outcome = Outcome(MoveResult.NO_FREE_PLACEMENT, SCENE)
    transition = Transition(Decision(Move("gelatin_box")), outcome, None, (), 0.0)  # type: ignore[arg-type]
    action = recorded_action(transition, ["large"], {})
    assert (action.result, action.failure_reason) == (MoveResult.NO_FREE_PLACEMENT, "no free spot")


def test_a_recorded_episode_is_written_and_read(episode: RecordedEpisode, tmp_path: Path) -> None:
    save_episode(tmp_path / "episode.h5", episode)
    read = load_episode(tmp_path / "episode.h5", CATALOG)
    assert read.cell == CELL
    assert read.error == episode.error
    for action, written in zip(read.actions, episode.actions, strict=True):
        assert action.believed == written.believed
    samples, written_samples = read.actions[1].samples, episode.actions[1].samples
    assert samples is not None
    assert written_samples is not None
    for name, values in written_samples.channels().items():
        np.testing.assert_array_equal(samples.channels()[name], values)
    assert samples.executed is not None
    assert written_samples.executed is not None
    np.testing.assert_array_equal(samples.executed.command, written_samples.executed.command)


def test_recorded_commands_reproduce_the_motion(episode: RecordedEpisode) -> None:
    action = episode.actions[1]
    assert action.samples is not None
    replayed = replay_action(SCENE, episode.cell, action.samples, episode.rate)
    errors = compare_samples(action.samples, replayed)
    assert (errors.joint, errors.object) == (0.0, 0.0), "of commands and start, nothing is rounded"
    assert errors.is_exact
    picked = SCENE.names.index("gelatin_box")
    motion = replayed.X_TO[[0, -1], picked, 4:]
    assert np.linalg.norm(motion[1] - motion[0]) > 0.1, "it was carried"
    others = replace(action.samples, X_TO=action.samples.X_TO + 0.002 * np.eye(7)[4])
    assert compare_samples(others, replayed).object == pytest.approx(0.002, abs=1e-3)


def test_files_of_version_1_are_read() -> None:
    episode = load_episode(VERSION_1, CATALOG)
    assert episode.cell == CELL
    assert episode.initial_scene.names == SCENE.names
    (action,) = episode.actions
    assert (action.move, action.result) == (Move("gelatin_box"), MoveResult.PLACED)
    samples = action.samples
    assert samples is not None
    assert samples.q.shape == (18, 6)
    assert samples.q[0] == pytest.approx(CELL.robot.home, abs=0.01)
    assert {*samples.tool_commanded.tolist()} == {-1, 0}
    assert np.isnan(samples.q_commanded).all()
    frames = motion_frames(samples, SCENE.names)
    assert frames[-1].poses["gelatin_box"].p[:2] != pytest.approx([0.0, 0.0], abs=0.1)


def test_damaged_files_of_version_1_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.h5"
    path.write_bytes(VERSION_1.read_bytes())
    with h5py.File(path, "a") as stored:
        del stored["move_0001/q"]
    with pytest.raises(InputError, match=r"move_0001\.q; expected a dataset of shape \('n', 6\)"):
        load_episode(path, CATALOG)


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("text")
    with pytest.raises(InputError, match=r"cannot be read .*; expected a recorded episode"):
        load_episode(tmp_path / "text.h5", CATALOG)
    with pytest.raises(InputError, match="expected a recorded episode") as refusal:
        load_episode(tmp_path, CATALOG)
    assert "\n" not in str(refusal.value)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = 1
    with pytest.raises(InputError, match=r"version: is missing; expected an integer in \[1, 2\]"):
        load_episode(tmp_path / "other.h5", CATALOG)


@pytest.mark.parametrize("name", ["episode.h5", "trajectory_v1.h5"])
def test_replay_from_the_command_line(episode: RecordedEpisode, name: str, tmp_path: Path) -> None:
    path = VERSION_1
    if name == "episode.h5":
        path = tmp_path / name
        save_episode(path, episode)
    page, recording = tmp_path / "replay.html", tmp_path / "replay.rrd"
    options = ["--html", str(page), "--rrd", str(recording), "--speed", "4"]
    result = CliRunner().invoke(app, ["replay", str(path), *options])
    assert result.exit_code == 0, result.output
    assert "gelatin_box -> tray: placed" in result.output
    assert ("large_marker -> tray: not planned (no seal)" in result.output) == (path != VERSION_1)
    assert page.stat().st_size > 100_000
    assert recording.read_bytes()[:4] == b"RRF2"


def test_a_video_of_a_recording(tmp_path: Path) -> None:
    video = tmp_path / "replay.mp4"
    options = ["--mp4", str(video), "--speed", "20"]
    result = CliRunner().invoke(app, ["replay", str(VERSION_1), *options])
    assert result.exit_code == 0, result.output
    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        assert (stream.width, stream.height) == (480, 480)
        shown = [*container.decode(stream)]
    times = [float(frame.pts * frame.time_base) for frame in shown]
    frames = replay_frames(load_episode(VERSION_1, CATALOG), 20.0, 25.0)
    assert times == pytest.approx([frame.time for frame in frames], abs=0.02)
    assert times[-1] == pytest.approx(3.4 / 20 + 1.5, abs=0.02), "with a pause"
    pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in shown]
    assert np.abs(pictures[0] - pictures[2]).mean() > 1, "the arm moves"
    assert np.abs(pictures[-1] - pictures[-2]).mean() < 1, "it rests at the end"
