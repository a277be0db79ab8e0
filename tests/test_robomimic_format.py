"""robomimic files: layout and numbers, and what remains of a failed write."""

import json
import resource
import signal
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from recorded_episodes import synthetic_episode

from drake_clutter.files import InputError
from drake_clutter.recording.formats.robomimic import VALIDATION_PERIOD, write_robomimic
from drake_clutter.recording.recorded_episode import RecordedEpisode

SAMPLES = 41
"""Samples of an action of 2 s at 20 Hz."""


@pytest.fixture(scope="module")
def episode() -> RecordedEpisode:
    return synthetic_episode(cameras={"overhead": 2})


def test_demonstrations_hold_the_executed_actions(episode: RecordedEpisode, tmp_path: Path) -> None:
    path = tmp_path / "robomimic.hdf5"
    assert write_robomimic(path, [episode]) == 2
    samples = episode.actions[0].samples
    assert samples is not None
    with h5py.File(path) as file:
        assert list(file["data"]) == ["demo_0", "demo_1"]
        assert file["data"].attrs["total"] == 2 * 21
        environment = json.loads(file["data"].attrs["env_args"])
        assert environment["env_kwargs"]["rate"] == 10.0
        demo = file["data/demo_0"]
        assert demo.attrs["num_samples"] == 21
        assert demo.attrs["task"] == "gelatin_box onto tray"
        assert (demo["obs/robot0_joint_pos"][()] == samples.q[::2]).all()
        # The tool points down: half a turn about x, which is (1, 0, 0, 0) with the scalar last.
        assert (demo["obs/robot0_eef_quat"][()] == [1.0, 0.0, 0.0, 0.0]).all()
        assert (demo["obs/robot0_eef_pos"][()] == samples.X_TG[::2, 4:]).all()
        assert (demo["actions"][:-1, :6] == samples.q_commanded[2::2]).all()
        assert (demo["obs/object"][:, :7] == samples.X_TO[::2, 1]).all()
        assert demo["states"].shape == (21, 6 + 6 + 3 * 7)
        assert (demo["states"][:, 12:19] == samples.X_TO[::2, 0]).all()
        assert demo["rewards"][()].tolist() == 20 * [0.0] + [1.0]
        assert not file["data/demo_1/rewards"][()].any(), "it was dropped"
        assert file["data/demo_1/dones"][()].tolist() == 20 * [0] + [1]
        images = episode.actions[0].images["overhead"]
        assert images.rgb is not None
        assert (demo["obs/overhead_image"][()] == images.rgb).all()
        assert demo["obs/overhead_depth"][()] == pytest.approx(1.2)
        assert demo["obs/overhead_depth"].shape == (21, 32, 48, 1)
        assert file["mask/successful"][()].tolist() == [b"demo_0"]


def test_one_in_ten_successful_demonstrations_validates(tmp_path: Path) -> None:
    path = tmp_path / "robomimic.hdf5"
    assert write_robomimic(path, (synthetic_episode(index=k) for k in range(11))) == 22
    with h5py.File(path) as file:
        valid = [name.decode() for name in file["mask/valid"]]
        assert valid == [f"demo_{2 * (VALIDATION_PERIOD - 1)}"]
        assert len(file["mask/train"]) == 10
        assert file["data/demo_0/states"].shape[0] == SAMPLES


def test_a_data_set_needs_an_executed_action(episode: RecordedEpisode, tmp_path: Path) -> None:
    path = tmp_path / "robomimic.hdf5"
    with pytest.raises(InputError, match="no action was executed; expected at least one"):
        write_robomimic(path, [replace(episode, actions=episode.actions[1:2])])
    action = replace(episode.actions[0], X_TO_place=None)
    with pytest.raises(InputError, match="episode 0, action 1: has no placement; expected an"):
        write_robomimic(path, [replace(episode, actions=(action,))])
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_an_error_of_the_file(episode: RecordedEpisode, tmp_path: Path) -> None:
    """A limit of the size of files stands for the full disk."""
    path = tmp_path / "robomimic.hdf5"
    noise = np.random.default_rng(0).integers(0, 255, (21, 32, 48, 3)).astype(np.uint8)
    action = episode.actions[0]
    images = {"overhead": replace(action.images["overhead"], rgb=noise)}
    episode = replace(episode, actions=5 * (replace(action, images=images),))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as raised:
            write_robomimic(path, [episode])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert raised.value.filename == str(path)
    assert not list(tmp_path.iterdir())
