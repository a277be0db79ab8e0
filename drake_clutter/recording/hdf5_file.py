"""Recorded episodes as HDF5 files of version 2, which describe themselves.

Attributes of the file:

    version          2
    scene            Scene before the first action, as the text of a scene file.
    cell             `WorkCell` as YAML.
    policy           Name of the policy.
    termination      Why the episode ended.
    seed             Seed of the data set; -1 if unknown.
    index            Number of the episode in the data set.
    scene_name       Name of the scene.
    rate             Samples per second [Hz].
    package_version  Version of drake_clutter.
    drake_version    Version of Drake.
    error            Exception of the policy that ended the episode; "" for none.
    variation        What was randomized, as JSON.
    joint_names      Names of the arm's joints.
    tool_names       Names of the gripper's tools.
    object_names     Names of the objects.
    object_classes   Their classes.
    phases           Names of the phases.
    frames           Meaning of the letters that name frames.

Each attempted move has a group `action_0001`, `action_0002`, ... with the attributes `pick`,
`place`, `result`, `detail`, `failure_reason`, `instability`, `tool` and `X_TO_place`, and the
dataset `believed` with the poses that the policy assumed, if they are known. If it was executed, it
has a dataset for each of `CHANNELS`, with the attributes `description`, `unit`, `frame` and
`columns`, and further attributes `time_step` and `movable`. `X_WG` is a link to `X_TG`, because the
support's frame is the world of every simulation. Images are in
`images/CAMERA/{time, X_TC, rgb, depth, segmentation}`. The group `executed` has the commands
between the samples, too, see `ExecutedCommands`.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import Catalog
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.files import (
    atomic_write,
    format_value,
    input_error,
    parse_json,
    reading_file,
)
from drake_clutter.limits import (
    MAX_COUNT,
    MAX_SAMPLE_RATE,
    MAX_SEED,
)
from drake_clutter.recording.hdf5_reader import ACTION_TEXTS, ActionReader, AttributeReader
from drake_clutter.recording.hdf5_version_1 import read_version_1
from drake_clutter.recording.recorded_episode import (
    CameraImages,
    RecordedAction,
    RecordedEpisode,
)
from drake_clutter.scenes.action_samples import (
    CHANNELS,
    EXECUTED_COMMANDS,
    PHASES,
    POSE_COLUMNS,
    ActionSamples,
    Channel,
    ExecutedCommands,
)
from drake_clutter.scenes.scene_file import scene_from_yaml, scene_to_yaml
from drake_clutter.validation import config_yaml, override_config
from drake_clutter.yaml_io import parse_yaml

FORMAT_VERSION = 2
"""Version of the files that are written."""
MAX_ACTIONS = 10_000
"""Largest number of actions of an episode, which take a day."""
FRAMES = (
    "T: support, origin at the center of its floor, z up; W: world, the same as T; G: tool of the "
    "gripper, z out of it; C: camera, z along its optical axis, y down; O: object. X_AB is the "
    "pose of B in A."
)
"""Meaning of the letters that name frames."""
_CONTENT = f"a recorded episode of version 1 to {FORMAT_VERSION} (HDF5)"
_TEXTS = ("policy", "termination", "scene_name", "package_version", "drake_version", "error")
"""Attributes of the file with a text, which are also fields of `RecordedEpisode`."""
_IMAGE_UNITS = {"rgb": "", "depth": "m, or mm if integer", "segmentation": "index of object + 1"}
"""Unit of each kind of image."""


def action_name(number: int) -> str:
    """Return the name of an action's group; the first number is 1."""
    return f"action_{number:04d}"


def save_episode(
    path: Path,
    episode: RecordedEpisode,
    *,
    record_images: Callable[[ActionSamples], Mapping[str, CameraImages]] | None = None,
) -> None:
    """Write an episode to a file, which appears when it is complete.

    The same episode gives the same bytes.

    Args:
        path: File to write.
        episode: The episode.
        record_images: Returns the images of the samples of an action, by name of the camera, which
            are needed one action at a time; None for the images of the episode.
    """
    # In memory, because HDF5 reports a full disk only when it closes a file, and not as OSError.
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        axes = episode.axes
        cell = episode.cell.with_support(episode.initial_scene.support)
        file.attrs.update(
            {
                "version": FORMAT_VERSION,
                "scene": scene_to_yaml(episode.initial_scene, cell),
                "cell": config_yaml(cell),
                **{name: getattr(episode, name) for name in _TEXTS},
                "variation": json.dumps(episode.variation, sort_keys=True, allow_nan=False),
                "seed": episode.seed,
                "index": episode.index,
                "rate": episode.rate,
                "joint_names": axes["joints"],
                "tool_names": axes["tools"],
                "object_names": axes["objects"],
                "object_classes": episode.object_classes,
                "phases": PHASES,
                "frames": FRAMES,
            }
        )
        for number, action in enumerate(episode.actions, start=1):
            if record_images is not None and action.samples is not None:
                action = replace(action, images=record_images(action.samples))
            _write_action(file.create_group(action_name(number)), action, axes)
        file.flush()
        image = file.id.get_file_image()
    with atomic_write(path) as temporary:
        temporary.write_bytes(image)


def _write_action(
    group: h5py.Group, action: RecordedAction, axes: Mapping[str, Sequence[str]]
) -> None:
    """Write an action to its group."""
    place = action.X_TO_place
    group.attrs.update(
        {
            "pick": action.move.pick,
            "place": action.move.place,
            "result": action.result.value,
            **{name: getattr(action, name) for name in ACTION_TEXTS},
            "X_TO_place": (
                np.full(len(POSE_COLUMNS), np.nan)
                if place is None
                else np.array([*place.quaternion, *place.translation])
            ),
        }
    )
    if action.believed:
        rows = [[*X_TO.quaternion, *X_TO.translation] for X_TO in action.believed.values()]
        believed = _write_dataset(group, "believed", np.array(rows))
        believed.attrs.update(
            {
                "description": "poses of the objects that the policy assumed",
                "unit": "1, m",
                "frame": "T",
                "columns": _text_array(POSE_COLUMNS),
                "names": _text_array(action.believed),
            }
        )
    if action.samples is not None:
        group.attrs["time_step"] = action.samples.time_step
        group.attrs["movable"] = _text_array(action.samples.movable)
        _write_channels(group, CHANNELS, action.samples, axes)
        group["X_WG"] = group["X_TG"]
        if action.samples.executed is not None:
            executed = group.create_group("executed")
            _write_channels(executed, EXECUTED_COMMANDS, action.samples.executed, axes)
    for name, images in action.images.items():
        _write_images(group.create_group(f"images/{name}"), images)


def _write_channels(
    group: h5py.Group,
    channels: Iterable[Channel],
    record: ActionSamples | ExecutedCommands,
    axes: Mapping[str, Sequence[str]],
) -> None:
    """Write the arrays of a record, each with its description."""
    for channel in channels:
        values = getattr(record, channel.name)
        dataset = _write_dataset(group, channel.name, values.astype(channel.dtype))
        dataset.attrs.update(
            {
                "description": channel.description,
                "unit": channel.unit,
                "frame": channel.frame,
                "columns": _text_array(axes[channel.axes[-1]] if channel.axes else ()),
            }
        )


def _text_array(texts: Iterable[str]) -> NDArray[Any]:
    """Return texts as an array that HDF5 stores, also without any."""
    return np.array([*texts], dtype=h5py.string_dtype())


def _write_dataset(
    group: h5py.Group,
    name: str,
    values: NDArray[Any],
    chunks: tuple[int, ...] | bool = True,
    level: int = 4,
) -> h5py.Dataset:
    """Write an array and return its dataset.

    Args:
        group: Group of the dataset.
        name: Name of the dataset.
        values: The array.
        chunks: Shape of a chunk; True for one that h5py chooses.
        level: Level of the compression.
    """
    if not values.size:  # HDF5 has no chunks without values
        return group.create_dataset(name, data=values)
    return group.create_dataset(
        name, data=values, chunks=chunks, compression="gzip", compression_opts=level, shuffle=True
    )


def _write_images(group: h5py.Group, images: CameraImages) -> None:
    """Write the images of a camera to a group; each image is a chunk of its own."""
    group.attrs["intrinsics"] = images.intrinsics
    time = _write_dataset(group, "time", images.time)
    time.attrs.update({"unit": "s", "description": "time since the start of the action"})
    pose = _write_dataset(group, "X_TC", images.X_TC)
    pose.attrs.update({"unit": "1, m", "frame": "T", "columns": _text_array(POSE_COLUMNS)})
    for kind, unit in _IMAGE_UNITS.items():
        values = getattr(images, kind)
        if values is not None:
            dataset = _write_dataset(group, kind, values, (1, *values.shape[1:]), level=1)
            dataset.attrs["unit"] = unit


def load_episode(path: Path, catalog: Catalog, *, images: bool = True) -> RecordedEpisode:
    """Read an episode, also of a trajectory file of version 1.

    Args:
        path: File to read.
        catalog: Catalog with the classes of the objects.
        images: Whether to read the images, too.

    Raises:
        InputError: The file is not a recorded episode; names the field and what is allowed.
    """
    with reading_file(path, _CONTENT), h5py.File(path) as file:
        reader = AttributeReader(str(path), file.attrs)
        version = reader.integer("version", 1, FORMAT_VERSION)
        if version == 1:
            return read_version_1(path, file, catalog)
        scene = scene_from_yaml(reader.text("scene"), f"{path}:scene", catalog).scene
        episode = RecordedEpisode(
            initial_scene=scene,
            cell=_read_cell(path, reader.text("cell")).with_support(scene.support),
            actions=(),
            **{name: reader.text(name) for name in _TEXTS},
            variation=_read_variation(path, reader.text("variation")),
            seed=reader.integer("seed", -1, MAX_SEED),
            index=reader.integer("index", 0, MAX_COUNT),
            rate=reader.quantity("rate", MAX_SAMPLE_RATE),
        )
        axes = episode.axes
        if len(file) > MAX_ACTIONS:
            raise input_error(str(path), f"has {len(file)} actions; expected at most {MAX_ACTIONS}")
        expected = [action_name(number) for number in range(1, len(file) + 1)]
        if sorted(file) != expected:
            problem = f"groups: {format_value([*file])}"
            raise input_error(str(path), f"{problem}; expected {format_value(expected)}")
        actions = tuple(
            ActionReader(path, file[name], name, axes).read(images=images) for name in expected
        )
        return replace(episode, actions=actions)


def _read_cell(path: Path, text: str) -> WorkCell:
    """Return the work cell of a file."""
    source = f"{path}:cell"
    return override_config(default_cell(), parse_yaml(text, source), source)


def _read_variation(path: Path, text: str) -> Mapping[str, Any]:
    """Return what was randomized."""
    variation = parse_json(text, f"{path}:variation", "a JSON object")
    if not isinstance(variation, dict):
        problem = f"variation: {format_value(variation)}"
        raise input_error(str(path), f"{problem}; expected a JSON object")
    return variation
