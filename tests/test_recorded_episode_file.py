"""Files of recorded episodes: round trip, description of themselves, refusal of other files."""

from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import CATALOG, DEFAULT_CELL, resting, rng, scene_of

from drake_clutter.files import InputError
from drake_clutter.recording.hdf5_file import load_episode, save_episode
from drake_clutter.recording.recorded_episode import (
    CameraImages,
    RecordedAction,
    RecordedEpisode,
)
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import (
    CHANNELS,
    PHASES,
    POSE_COLUMNS,
    ActionSamples,
    ExecutedCommands,
)
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene import Pose

SCENE = scene_of(resting("cracker_box"), resting("sugar_box", xy=(0.2, 0.2)))
NUM_SAMPLES = 3
NO_PLAN = RecordedAction(
    Move("cracker_box", "sugar_box"),
    MoveResult.NOT_PLANNED,
    detail="in collision: sugar_box",
    failure_reason="in collision",
)


def random_values(shape: tuple[int, ...], dtype: str, generator: np.random.Generator) -> np.ndarray:
    """Return values of a channel: integers that fit every channel, or any other numbers."""
    if dtype == "float64":
        return generator.standard_normal(shape)
    return generator.integers(0, 2, shape).astype(dtype)


def poses(shape: tuple[int, ...], generator: np.random.Generator) -> np.ndarray:
    values = generator.standard_normal((*shape, len(POSE_COLUMNS)))
    values[..., :4] /= np.linalg.norm(values[..., :4], axis=-1, keepdims=True)
    return values


@pytest.fixture(scope="module")
def episode() -> RecordedEpisode:
    generator = rng()
    empty = RecordedEpisode(
        SCENE, DEFAULT_CELL, (), "random", "out of moves", 7, 3, "pile", 125.0, "0.2", "1.5"
    )
    sizes = {axis: len(names) for axis, names in empty.axes.items()}
    arrays: dict[str, Any] = {
        channel.name: random_values(
            (NUM_SAMPLES, *(sizes[axis] for axis in channel.axes)), channel.dtype, generator
        )
        for channel in CHANNELS
    }
    arrays |= {"time": np.arange(NUM_SAMPLES) / 125.0}
    arrays |= {
        name: poses((NUM_SAMPLES, *rest), generator)
        for name, rest in {"X_TG": (), "X_TO": (2,)}.items()
    }
    images = CameraImages(
        np.array([0.0, 0.1]),
        poses((2,), generator),
        (600.0, 601.0, 31.5, 23.5),
        rgb=generator.integers(0, 256, (2, 48, 64, 3)).astype(np.uint8),
        depth=generator.random((2, 48, 64)).astype(np.float32),
    )
    executed = ExecutedCommands(
        np.array([0.0, 0.5]),
        generator.standard_normal((2, sizes["commands"])),
        np.array([0.35]),
        np.array([0.0, 0.2, 0.3, 0.5]),
        np.array([1, 2, -1], np.int16),
        np.array([-1, 0, -1], np.int16),
        np.array([[False, False], [False, True], [True, False]]),
    )
    moved = RecordedAction(
        Move("sugar_box"),
        MoveResult.PLACED,
        detail="placed",
        tool="large",
        X_TO_place=Pose((0.1, 0.2, 0.3), (0.0, 1.0, 0.0, 0.0)),
        samples=ActionSamples(**arrays, time_step=0.005, movable=("sugar_box",), executed=executed),
        images={"overhead": images},
    )
    return replace(empty, actions=(NO_PLAN, moved))


@pytest.fixture
def file(episode: RecordedEpisode, tmp_path: Path) -> Path:
    path = tmp_path / "episode.h5"
    save_episode(path, episode)
    return path


def assert_equal(read: object, written: object) -> None:
    """Compare all fields, and arrays with their types."""
    for field in fields(written):  # type: ignore[arg-type]
        a, b = getattr(read, field.name), getattr(written, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype, field.name
            np.testing.assert_array_equal(a, b)
        elif field.name not in ("samples", "executed", "images", "actions", "initial_scene"):
            assert a == b, field.name


def test_a_written_episode_is_read_back(file: Path, episode: RecordedEpisode) -> None:
    read = load_episode(file, CATALOG)
    assert_equal(read, episode)
    assert read.initial_scene.poses == SCENE.poses
    assert len(read.actions) == 2
    for a, b in zip(read.actions, episode.actions, strict=True):
        assert_equal(a, b)
    (no_plan, moved), written = read.actions, episode.actions[1]
    assert no_plan.samples is None
    assert not no_plan.images
    assert moved.samples is not None
    assert_equal(moved.samples, written.samples)
    assert written.samples is not None
    assert_equal(moved.samples.executed, written.samples.executed)
    assert_equal(moved.images["overhead"], written.images["overhead"])
    assert not load_episode(file, CATALOG, images=False).actions[1].images


def test_the_same_episode_gives_the_same_bytes(
    file: Path, episode: RecordedEpisode, tmp_path: Path
) -> None:
    save_episode(tmp_path / "again.h5", episode)
    assert (tmp_path / "again.h5").read_bytes() == file.read_bytes()


def test_a_file_describes_itself(file: Path, episode: RecordedEpisode) -> None:
    with h5py.File(file) as stored:
        attributes = stored.attrs
        assert [*attributes["joint_names"]] == [*load_robot(DEFAULT_CELL.robot).joint_names]
        assert [*attributes["object_classes"]] == ["cracker_box", "sugar_box"]
        assert [*attributes["phases"]] == [*PHASES]
        failed, moved = stored["action_0001"], stored["action_0002"]
        assert failed.attrs["failure_reason"] == "in collision"
        assert [*failed] == []
        assert (moved["q"].attrs["unit"], moved["X_TO"].attrs["frame"]) == ("rad", "T")
        assert [*moved["q"].attrs["columns"]] == [*attributes["joint_names"]]
        assert [*moved["X_TO"].attrs["columns"]] == [*POSE_COLUMNS]
        assert moved["X_WG"] == moved["X_TG"], "the support's frame is the world"
        rgb = moved["images/overhead/rgb"]
        assert (rgb.chunks, rgb.compression) == ((1, 48, 64, 3), "gzip")


def set_rate(file: h5py.File) -> None:
    file.attrs["rate"] = -1.0


def replace_dataset(file: h5py.Group, name: str, values: np.ndarray) -> None:
    del file[name]
    file[name] = values


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (set_rate, r"rate: .*-1.0.*; expected a number in \(0, 1000\]"),
        (lambda f: f.attrs.update({"version": 3}), r"version: 3; expected an integer in \[1, 2\]"),
        (lambda f: f.attrs.__delitem__("policy"), "policy: is missing; expected a text"),
        (lambda f: f.move("action_0001", "action_0003"), "expected .*'action_0001', 'action_0002'"),
        (
            lambda f: replace_dataset(f, "action_0002/q", np.zeros((NUM_SAMPLES, 5))),
            r"action_0002.q: expected a dataset of shape \(3, 6\) and type float64",
        ),
        (
            lambda f: replace_dataset(f, "action_0002/q", np.full((NUM_SAMPLES, 6), np.nan)),
            "action_0002.q: expected finite numbers",
        ),
        (
            lambda f: replace_dataset(f, "action_0002/time", np.array([0.0, 0.2, 0.1])),
            "action_0002.time: expected finite times that increase",
        ),
        (
            lambda f: replace_dataset(f, "action_0002/phase", np.full(3, 99, np.int16)),
            r"action_0002.phase: expected integers in \[-1, 12\]",
        ),
        (
            lambda f: replace_dataset(f, "action_0002/X_TG", np.zeros((NUM_SAMPLES, 7))),
            "action_0002.X_TG: expected finite poses with unit quaternions",
        ),
        (
            lambda f: replace_dataset(f, "action_0002/executed/step_start", np.zeros(2)),
            r"action_0002/executed.step_start: expected a dataset of shape \(4,\)",
        ),
        (
            lambda f: replace_dataset(
                f, "action_0002/executed/step_start", np.array([0.0, 0.2, 0.3, 1e9])
            ),
            "action_0002.executed: expected .* that do not decrease, from 0 to at most 3600 s",
        ),
        (
            lambda f: f["action_0001"].attrs.update({"result": "lost"}),
            "action_0001: result: 'lost'; expected one of placed",
        ),
    ],
)
def test_damaged_files_are_refused(
    file: Path, damage: Callable[[h5py.File], None], message: str
) -> None:
    with h5py.File(file, "a") as stored:
        damage(stored)
    with pytest.raises(InputError, match=message) as refusal:
        load_episode(file, CATALOG)
    assert str(file) in str(refusal.value)


def test_a_huge_dataset_is_refused_before_it_is_read(file: Path) -> None:
    with h5py.File(file, "a") as stored:
        images = stored["action_0002/images/overhead"]
        replace_dataset(images, "time", np.arange(60.0))
        replace_dataset(images, "X_TC", np.tile(np.eye(7)[0], (60, 1)))
        del images["rgb"]
        images.create_dataset("rgb", (60, 4096, 4096, 3), np.uint8, chunks=(1, 4096, 4096, 3))
    with pytest.raises(InputError, match=r"overhead\.rgb: has 2.8 GiB; expected at most 2 GiB"):
        load_episode(file, CATALOG)
