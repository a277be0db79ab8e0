"""LeRobotDataset version 3.0: Parquet tables, MP4 videos and JSON metadata in a folder.

Each executed action is an episode of LeRobot: one demonstration of one task, from rest to rest.
Layout and names: LeRobot, `lerobot.datasets`, version 3.0 of its code base.

    meta/info.json                                       features, rate, counts, paths
    meta/stats.json                                      statistics of each feature
    meta/tasks.parquet                                   text and index of each task
    meta/episodes/chunk-000/file-000.parquet             a row for each episode, with its statistics
    data/chunk-000/file-000.parquet                      a row for each time
    videos/observation.images.CAMERA/chunk-000/file-000.mp4

Depth and segmentation images are not part of it.
"""

# pyarrow and PyAV are typed in part only.
# mypy: allow-untyped-calls

import json
import os
import shutil
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, temporary_path, write_json
from drake_clutter.recording.formats.demonstration import (
    OBJECT_STATE_NAMES,
    Demonstration,
    command_names,
    demonstrations,
    state_names,
)
from drake_clutter.recording.formats.feature_stats import (
    Stats,
    combine_stats,
    image_stats,
    vector_stats,
)
from drake_clutter.recording.recorded_episode import CameraImages, RecordedEpisode

CODE_BASE_VERSION = "v3.0"
"""Version of the layout."""
FOLDERS = ("data", "videos", "meta")
"""Folders of a data set; the last one is renamed last, so that its presence means a whole set."""
FILES_PER_CHUNK = 1000
"""Largest number of files in a folder."""
MAX_DATA_FILE_SIZE = 100
"""Size of a Parquet file at which the next one begins [MB]."""
MAX_VIDEO_FILE_SIZE = 200
"""Size of a video file at which the next one begins [MB]."""
VIDEO_CODEC = "h264"
"""Codec of the videos, which every player and LeRobot read."""
VIDEO_OPTIONS = {"crf": "18", "g": "2", "bf": "0"}
"""Options of the encoder: visually lossless, with a key frame every second image for fast access.
"""
PIXEL_FORMAT = "yuv420p"
"""Pixel format of the videos, whose sides are even."""
_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_STATE = "observation.state"
_OBJECT_STATE = "observation.environment_state"
_INDEX_FEATURES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def write_lerobot(out: Path, episodes: Iterable[RecordedEpisode]) -> int:
    """Write the executed actions of episodes as a LeRobot data set.

    Args:
        out: Existing folder; `meta`, `data` and `videos` in it are replaced. They appear when the
            data set is complete.
        episodes: Episodes of the same cell, rate and cameras.

    Returns:
        Number of episodes of the data set, which are executed actions.

    Raises:
        InputError: No action was executed, or the episodes differ in cell, rate or cameras.
    """
    staging = temporary_path(out / "lerobot")
    staging.mkdir()
    writer = _Writer(staging)
    try:
        for episode in episodes:
            for demonstration in demonstrations(episode):
                writer.add(demonstration)
        writer.finish(str(out))
        for name in reversed(FOLDERS):
            if (out / name).exists():
                shutil.rmtree(out / name)
        for name in FOLDERS:
            if (staging / name).exists():
                os.replace(staging / name, out / name)
        return writer.num_episodes
    finally:
        writer.close()
        shutil.rmtree(staging)


class _Writer:
    """Writes a data set to a folder, episode by episode.

    Attributes:
        num_episodes: Number of episodes.
    """

    def __init__(self, root: Path) -> None:
        self.num_episodes = 0
        self._root = root
        self._num_frames = 0
        self._fps = 0
        self._features: dict[str, dict[str, Any]] = {}
        self._robot = ""
        self._tasks: dict[str, int] = {}
        self._stats: dict[str, list[Stats]] = {}
        self._data = _Tables(root, _DATA_PATH, MAX_DATA_FILE_SIZE)
        self._episodes = _Tables(root, _EPISODES_PATH, None)
        self._videos: dict[str, _Videos] = {}

    def add(self, demonstration: Demonstration) -> None:
        """Add an episode."""
        self._check_or_set_features(demonstration)
        length = len(demonstration)
        task = self._tasks.setdefault(demonstration.task, len(self._tasks))
        columns = _columns(demonstration) | {
            "timestamp": np.arange(length) / self._fps,
            "frame_index": np.arange(length),
            "episode_index": np.full(length, self.num_episodes),
            "index": self._num_frames + np.arange(length),
            "task_index": np.full(length, task),
        }
        chunk, file = self._data.write(
            {name: _arrow_array(columns[name], self._features[name]) for name in columns}
        )
        action = demonstration.action
        row: dict[str, Any] = {
            "episode_index": self.num_episodes,
            "tasks": [demonstration.task],
            "length": length,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self._num_frames,
            "dataset_to_index": self._num_frames + length,
            "result": action.result.value,
            "detail": action.detail,
            "tool": action.tool,
            "recorded_episode": demonstration.episode.index,
            "recorded_action": demonstration.number,
            "scene": demonstration.episode.scene_name,
            "policy": demonstration.episode.policy,
        }
        stats: dict[str, Stats] = {
            name: vector_stats(values.reshape(length, -1).astype(float))
            for name, values in columns.items()
        }
        for key, images in _color_images(demonstration).items():
            chunk, file, start = self._videos[key].write(images)
            row |= {
                f"videos/{key}/chunk_index": chunk,
                f"videos/{key}/file_index": file,
                f"videos/{key}/from_timestamp": start / self._fps,
                f"videos/{key}/to_timestamp": (start + length) / self._fps,
            }
            stats[key] = image_stats(images)
        for name, values in stats.items():
            self._stats.setdefault(name, []).append(values)
            row |= {f"stats/{name}/{kind}": value.tolist() for kind, value in values.items()}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._episodes.write({name: [value] for name, value in row.items()})
        self.num_episodes += 1
        self._num_frames += length

    def _check_or_set_features(self, demonstration: Demonstration) -> None:
        """Set rate and features by the first episode, and check that the others have the same.

        Raises:
            InputError: They differ, the rate is no whole number, or images have an odd side.
        """
        episode = demonstration.episode
        source = f"episode {episode.index}, action {demonstration.number}"
        fps = round(demonstration.rate)
        if fps < 1 or abs(demonstration.rate - fps) > 1e-3 * fps:
            raise InputError(
                f"{source}: {demonstration.rate:.3f} images or samples per second; expected a "
                "whole number of them"
            )
        features = _features(demonstration, fps)
        if not self._features:
            self._features = features
            self._fps = fps
            self._robot = Path(episode.cell.robot.model).stem
            self._videos = {
                key: _Videos(self._root, key, fps, feature["shape"])
                for key, feature in features.items()
                if feature["dtype"] == "video"
            }
        elif fps != self._fps:
            raise InputError(f"{source}: has {fps} rows per second; expected {self._fps}")
        elif features != self._features:
            (name, *_) = (
                name
                for name in [*features, *self._features]
                if features.get(name) != self._features.get(name)
            )
            raise InputError(
                f"{source}: {name} differs from that of the first episode; expected episodes of "
                "one cell with the same cameras"
            )

    def finish(self, source: str) -> None:
        """Write what describes all episodes.

        Raises:
            InputError: There are none.
        """
        if not self.num_episodes:
            raise InputError(f"{source}: no action was executed; expected at least one")
        self.close()
        _write_tasks(self._root / "meta/tasks.parquet", list(self._tasks))
        stats = {
            name: {kind: value.tolist() for kind, value in combine_stats(parts).items()}
            for name, parts in self._stats.items()
        }
        write_json(self._root / "meta/stats.json", stats)
        info = {
            "codebase_version": CODE_BASE_VERSION,
            "robot_type": self._robot,
            "total_episodes": self.num_episodes,
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": MAX_DATA_FILE_SIZE,
            "video_files_size_in_mb": MAX_VIDEO_FILE_SIZE,
            "fps": self._fps,
            "splits": {"train": f"0:{self.num_episodes}"},
            "data_path": _DATA_PATH,
            "video_path": _VIDEO_PATH if self._videos else None,
            "features": self._features,
        }
        write_json(self._root / "meta/info.json", info)

    def close(self) -> None:
        """Close all files."""
        self._data.close()
        self._episodes.close()
        for videos in self._videos.values():
            videos.close()


def _columns(demonstration: Demonstration) -> dict[str, NDArray[Any]]:
    """Return the columns of an episode that are not indices, by feature."""
    is_last = np.arange(len(demonstration)) == len(demonstration) - 1
    is_success = is_last & demonstration.is_success
    return {
        _STATE: demonstration.state,
        _OBJECT_STATE: demonstration.object_state,
        "action": demonstration.command,
        "next.reward": is_success.astype(float),
        "next.done": is_last,
        "next.success": is_success,
    }


def _features(demonstration: Demonstration, fps: int) -> dict[str, dict[str, Any]]:
    """Return the features of `meta/info.json`, in the order of the table."""

    def vector(names: Iterable[str]) -> dict[str, Any]:
        return {"dtype": "float32", "shape": [len([*names])], "names": [*names]}

    def scalar(dtype: str) -> dict[str, Any]:
        return {"dtype": dtype, "shape": [1], "names": None}

    episode = demonstration.episode
    features = {
        _STATE: vector(state_names(episode)),
        _OBJECT_STATE: vector(OBJECT_STATE_NAMES),
        "action": vector(command_names(episode)),
        "next.reward": scalar("float32"),
        "next.done": scalar("bool"),
        "next.success": scalar("bool"),
        **{name: scalar("int64") for name in _INDEX_FEATURES},
        "timestamp": scalar("float32"),
    }
    for key, images in _color_images(demonstration).items():
        height, width, channels = images.shape[1:]
        if height % 2 or width % 2:
            raise InputError(
                f"{key}: images of {width} x {height} pixels; expected even numbers for a video"
            )
        features[key] = {
            "dtype": "video",
            "shape": [height, width, channels],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": VIDEO_CODEC,
                "video.pix_fmt": PIXEL_FORMAT,
                "video.is_depth_map": False,
                "video.fps": fps,
                "video.channels": channels,
                "has_audio": False,
            },
        }
    return features


def _color_images(demonstration: Demonstration) -> dict[str, NDArray[np.uint8]]:
    """Return the color images of an episode by feature."""
    images: Mapping[str, CameraImages] = demonstration.images
    return {
        f"observation.images.{name}": camera.rgb
        for name, camera in images.items()
        if camera.rgb is not None
    }


def _arrow_array(values: NDArray[Any], feature: Mapping[str, Any]) -> Any:
    """Return the column of a feature with its type."""
    import pyarrow as pa

    flat = values.astype(feature["dtype"]).ravel()
    if values.ndim == 1:
        return pa.array(flat)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat), values.shape[1])


def _write_tasks(path: Path, tasks: list[str]) -> None:
    """Write the tasks in the order of their indices; the text is the index of the pandas table."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    described = [
        {"name": name, "field_name": name, "metadata": None, "pandas_type": kind, "numpy_type": t}
        for name, kind, t in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": described,
        "pandas_version": "2.0.0",
    }
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


class _Tables:
    """Parquet files of a running number, each a group of rows for each call of `write`.

    A file that has reached the largest size is followed by another one.
    """

    def __init__(self, root: Path, path: str, max_size: int | None) -> None:
        """Remember where to write.

        Args:
            root: Folder.
            path: Path below it, with `chunk_index` and `file_index`.
            max_size: Size of a file at which the next one begins [MB]; None for a single file.
        """
        self._root = root
        self._path = path
        self._max_size = max_size
        self._number = 0
        self._file: Path | None = None
        self._writer: Any = None

    def write(self, columns: Mapping[str, Any]) -> tuple[int, int]:
        """Write rows, and return chunk and number of their file."""
        import pyarrow as pa
        from pyarrow import parquet

        table = pa.table(dict(columns))
        if self._file is not None and _is_full(self._file, self._max_size):
            self.close()
            self._number += 1
        chunk, number = divmod(self._number, FILES_PER_CHUNK)
        if self._writer is None:
            self._file = self._root / self._path.format(chunk_index=chunk, file_index=number)
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._writer = parquet.ParquetWriter(self._file, table.schema)
        self._writer.write_table(table)
        return chunk, number

    def close(self) -> None:
        """Close the current file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class _Videos:
    """MP4 files of a running number with the images of one camera, episode after episode."""

    def __init__(self, root: Path, key: str, fps: int, shape: tuple[int, int, int]) -> None:
        self._root = root
        self._key = key
        self._fps = fps
        self._shape = shape
        self._number = 0
        self._num_images = 0
        self._file: Path | None = None
        self._container: Any = None
        self._stream: Any = None

    def write(self, images: NDArray[np.uint8]) -> tuple[int, int, int]:
        """Append images, and return chunk and number of the file and the number of images before.

        Args:
            images: Images. Shape (f, height, width, 3).
        """
        import av

        if self._file is not None and _is_full(self._file, MAX_VIDEO_FILE_SIZE):
            self.close()
            self._number += 1
        chunk, number = divmod(self._number, FILES_PER_CHUNK)
        if self._container is None:
            path = _VIDEO_PATH.format(video_key=self._key, chunk_index=chunk, file_index=number)
            self._file = self._root / path
            self._file.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._file), "w")
            self._stream = self._container.add_stream(
                "libx264", Fraction(self._fps), options=VIDEO_OPTIONS
            )
            self._stream.height, self._stream.width, _ = self._shape
            self._stream.pix_fmt = PIXEL_FORMAT
            self._num_images = 0
        start = self._num_images
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            self._container.mux(self._stream.encode(frame))
        self._num_images += len(images)
        return chunk, number, start

    def close(self) -> None:
        """Close the current file."""
        if self._container is not None:
            self._container.mux(self._stream.encode())
            self._container.close()
            self._container = None


def _is_full(path: Path, max_size: int | None) -> bool:
    """Return whether a file has at least a size [MB]."""
    return max_size is not None and path.stat().st_size >= max_size * 2**20
