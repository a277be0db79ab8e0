"""LeRobot data sets: layout and numbers, read with pyarrow and PyAV, and with LeRobot itself."""

import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from pyarrow import parquet
from recorded_episodes import PLACE, PRESSURE, SCENE, image_level, synthetic_episode

from drake_clutter.files import InputError
from drake_clutter.recording.formats import lerobot
from drake_clutter.recording.formats.demonstration import demonstrations
from drake_clutter.recording.formats.lerobot import write_lerobot
from drake_clutter.recording.recorded_episode import RecordedEpisode

CAMERAS = {"overhead": 2, "wrist": 2}
"""Cameras with an image for every second sample."""
ROWS = 21
"""Images of an action of 2 s at 20 Hz, of which every second sample has one."""


def columns(path: Path) -> dict[str, NDArray[Any]]:
    """Return the columns of a Parquet file."""
    return {name: np.array(values) for name, values in parquet.read_table(path).to_pydict().items()}


@pytest.fixture(scope="module")
def episodes() -> list[RecordedEpisode]:
    return [synthetic_episode(cameras=CAMERAS, index=index) for index in range(2)]


@pytest.fixture(scope="module")
def dataset(episodes: list[RecordedEpisode], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("lerobot")
    assert write_lerobot(out, iter(episodes)) == 4, "an episode for each executed action"
    return out


def test_rows_hold_measured_states_and_the_next_commands(
    dataset: Path, episodes: list[RecordedEpisode]
) -> None:
    rows = columns(dataset / "data/chunk-000/file-000.parquet")
    samples = episodes[0].actions[0].samples
    assert samples is not None
    state, action = rows["observation.state"][:ROWS], rows["action"][:ROWS]
    assert state[:, :6] == pytest.approx(samples.q[::2], abs=1e-6)
    assert state[:, 6] == pytest.approx(samples.vacuum[::2, 0])
    assert state[:, 6].max() == PRESSURE
    assert (state[:, -1] == (samples.held_object[::2] == 1)).all()
    assert action[:-1, :6] == pytest.approx(samples.q_commanded[2::2], abs=1e-6)
    assert action[-1, :6] == pytest.approx(samples.q_commanded[-1], abs=1e-6)
    assert (action[:-1, 6] == (samples.tool_commanded[2::2] == 0)).all()
    assert not action[:, 7].any(), "the second cup never holds"
    objects = rows["observation.environment_state"][:ROWS]
    assert objects[:, :7] == pytest.approx(samples.X_TO[::2, 1], abs=1e-6)
    assert objects[:, 7:] == pytest.approx(
        np.tile([*SCENE["gelatin_box"].X_TO.quaternion, *PLACE], (ROWS, 1)), abs=1e-6
    )
    assert rows["timestamp"][:ROWS] == pytest.approx(np.arange(ROWS) / 10)
    assert (rows["episode_index"] == np.repeat(range(4), ROWS)).all()
    assert (rows["index"] == np.arange(4 * ROWS)).all()
    assert (rows["next.done"] == (rows["frame_index"] == ROWS - 1)).all()
    # Each episode has a placed and a dropped object.
    assert rows["next.success"].nonzero()[0].tolist() == [ROWS - 1, 3 * ROWS - 1]


def test_metadata_name_units_tasks_and_sources(dataset: Path) -> None:
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 10, 4)
    assert info["total_frames"] == 4 * ROWS
    features = info["features"]
    assert features["observation.state"]["names"][:2] == [
        "shoulder_pan_joint",
        "shoulder_lift_joint",
    ]
    assert features["action"]["names"][6:] == ["hold_large", "hold_small"]
    assert features["observation.images.wrist"]["shape"] == [32, 48, 3]
    tasks = columns(dataset / "meta/tasks.parquet")
    assert tasks["task"].tolist() == ["gelatin_box onto tray", "pudding_box onto tray"]
    episodes = columns(dataset / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes["result"].tolist() == ["placed", "dropped"] * 2
    assert episodes["recorded_action"].tolist() == [1, 3] * 2
    assert episodes["dataset_from_index"].tolist() == [0, ROWS, 2 * ROWS, 3 * ROWS]


def test_statistics_are_those_of_all_rows(dataset: Path) -> None:
    stats = json.loads((dataset / "meta/stats.json").read_text())
    rows = columns(dataset / "data/chunk-000/file-000.parquet")
    for name in ("observation.state", "action", "next.reward"):
        values = rows[name].reshape(4 * ROWS, -1).astype(float)
        assert stats[name]["count"] == [4 * ROWS]
        for kind in ("min", "max", "mean", "std"):
            expected = getattr(values, kind)(axis=0)
            # The table has single precision.
            assert stats[name][kind] == pytest.approx(expected, rel=1e-6, abs=1e-6)
    levels = np.array([image_level(k) for k in range(ROWS)]) / 255
    red = np.array(stats["observation.images.overhead"]["mean"])[0, 0, 0]
    assert red == pytest.approx(levels.mean())
    assert np.array(stats["observation.images.overhead"]["std"])[0, 0, 0] == pytest.approx(
        levels.std()
    )


def test_videos_hold_the_images_of_all_episodes(dataset: Path) -> None:
    path = dataset / "videos/observation.images.overhead/chunk-000/file-000.mp4"
    with av.open(str(path)) as container:
        frames = [(float(f.time), f.to_ndarray(format="rgb24")) for f in container.decode(video=0)]
    assert [time for time, _ in frames] == pytest.approx((np.arange(4 * ROWS) / 10).tolist())
    for number, (_, image) in enumerate(frames):
        red, green, _ = image.mean(axis=(0, 1))
        # 8-bit YUV with subsampled chroma keeps a level to about 2 of 255.
        assert red == pytest.approx(image_level(number % ROWS), abs=3)
        assert green == pytest.approx(90, abs=3)


def test_files_end_at_their_largest_size(
    tmp_path: Path, episodes: list[RecordedEpisode], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "MAX_DATA_FILE_SIZE", 0)
    monkeypatch.setattr(lerobot, "MAX_VIDEO_FILE_SIZE", 0)
    write_lerobot(tmp_path, episodes)
    rows = columns(tmp_path / "meta/episodes/chunk-000/file-000.parquet")
    assert rows["data/file_index"].tolist() == [0, 1, 2, 3]
    assert rows["videos/observation.images.wrist/file_index"].tolist() == [0, 1, 2, 3]
    assert not rows["videos/observation.images.wrist/from_timestamp"].any()
    last = columns(tmp_path / "data/chunk-000/file-003.parquet")
    assert (last["episode_index"] == 3).all()
    assert len(last["index"]) == ROWS


def test_a_failed_conversion_leaves_the_earlier_data_set(
    tmp_path: Path, episodes: list[RecordedEpisode]
) -> None:
    write_lerobot(tmp_path, episodes)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match="has 20 rows per second; expected 10"):
        write_lerobot(tmp_path, [episodes[0], synthetic_episode()])
    with pytest.raises(InputError, match=r"observation\.images\.wrist differs"):
        write_lerobot(tmp_path, [episodes[0], synthetic_episode(cameras={"overhead": 2})])
    with pytest.raises(InputError, match="no action was executed; expected at least one"):
        write_lerobot(tmp_path, [replace(episodes[0], actions=episodes[0].actions[1:2])])
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert len(list(tmp_path.iterdir())) == 3, "no temporary folder"


def test_the_rate_of_images_at_irregular_samples_is_their_nominal_one() -> None:
    """At 125 Hz, images at 10 Hz are alternately 12 and 13 samples apart."""
    episode = synthetic_episode(rate=125.0, cameras={"overhead": 1})
    action = episode.actions[0]
    images = action.images["overhead"]
    rows = np.array([*np.searchsorted(images.time, np.arange(0.0, 1.95, 0.1) - 1e-9), 250])
    assert images.rgb is not None
    sparse = replace(
        images, time=images.time[rows], rgb=images.rgb[rows], depth=None, segmentation=None
    )
    episode = replace(episode, actions=(replace(action, images={"overhead": sparse}),))
    (demonstration,) = demonstrations(episode)
    assert demonstration.rate == 10.0
    assert (demonstration.samples.time == images.time[rows]).all()


def test_lerobot_reads_the_data_set(
    dataset: Path,
    episodes: list[RecordedEpisode],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not in the locked environment: LeRobot pins an older PyTorch, see its job in CI."""
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    data = LeRobotDataset("local/test", root=dataset, video_backend="pyav")
    assert (data.num_episodes, len(data), data.fps) == (4, 4 * ROWS, 10)
    samples = episodes[1].actions[2].samples
    assert samples is not None
    for index in range(len(data)):
        item = data[index]
        row = int(item["frame_index"])
        assert item["observation.images.overhead"].shape == (3, 32, 48)
        red = float(item["observation.images.overhead"][0].mean())
        assert red == pytest.approx(image_level(row) / 255, abs=3 / 255)
        if index >= 3 * ROWS:
            assert item["task"] == "pudding_box onto tray"
            assert item["observation.state"][:6].numpy() == pytest.approx(
                samples.q[2 * row], abs=1e-6
            )
    windows = LeRobotDataset(
        "local/test", root=dataset, delta_timestamps={"action": [0.0, 0.1]}, video_backend="pyav"
    )
    item = windows[ROWS - 1]
    assert item["action"].shape == (2, 8)
    assert item["action_is_pad"].tolist() == [False, True]


def test_rerun_reads_the_data_set(dataset: Path, episodes: list[RecordedEpisode]) -> None:
    """A reader of LeRobot data sets that the locked environment has."""
    from rerun.experimental import LeRobotReader

    reader = LeRobotReader(str(dataset))
    assert reader.version == "v3"
    rows: defaultdict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in reader.stream(3):
        if not chunk.is_static:
            rows[str(chunk.entity_path)] += chunk.to_record_batch().to_pylist()
    samples = episodes[1].actions[2].samples
    assert samples is not None
    states = sorted(rows["/observation.state"], key=lambda row: row["frame_index"])
    q = np.array([row["Scalars:scalars"][:6] for row in states])
    assert q == pytest.approx(samples.q[::2], abs=1e-6)
    assert {row["TextDocument:text"][0] for row in rows["/task"]} == {"pudding_box onto tray"}
