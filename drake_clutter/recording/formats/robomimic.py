"""Demonstrations as one HDF5 file in the layout of robomimic.

Each executed action is a demonstration. Layout: robomimic documentation, "Dataset Structure"; the
names and the order (x, y, z, w) of quaternions among the observations are those of robosuite.

    data                    attributes total, env_args
    data/demo_0             attributes num_samples, task, result, scene, recorded_episode, ...
    data/demo_0/obs/NAME    observations
    data/demo_0/actions     command that is to be reached at the next row
    data/demo_0/rewards     1 in the last row of a placed object, else 0
    data/demo_0/dones       1 in the last row
    data/demo_0/states      q, v and X_TO of all objects
    mask/NAME               names of the demonstrations that are `successful`; of these, one in
                            `VALIDATION_PERIOD` is in `valid`, the others are in `train`
"""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, atomic_write
from drake_clutter.recording.formats.demonstration import (
    OBJECT_STATE_NAMES,
    Demonstration,
    command_names,
    demonstrations,
)
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.scenes.action_samples import POSE_COLUMNS
from drake_clutter.scenes.scene_file import scene_to_yaml
from drake_clutter.validation import config_yaml

VALIDATION_PERIOD = 10
"""Number of successful demonstrations of which one serves for validation."""
_GYM_ENVIRONMENT = 2
"""`EnvType.GYM_TYPE` of robomimic."""
_MILLIMETER = 0.001


def write_robomimic(path: Path, episodes: Iterable[RecordedEpisode]) -> int:
    """Write the executed actions of episodes as demonstrations.

    Args:
        path: File to write, which appears when it is complete.
        episodes: Episodes of the same cell.

    Returns:
        Number of demonstrations.

    Raises:
        InputError: No action was executed, or the cells of episodes differ.
        OSError: The disk is full.
    """
    masks: dict[str, list[str]] = {"successful": [], "train": [], "valid": []}
    with atomic_write(path) as temporary, temporary.open("w+b", buffering=0) as raw:
        file_object = _DeferredErrors(raw)
        with h5py.File(file_object, "w") as file:
            data = file.create_group("data")
            number = 0
            total = 0
            columns: tuple[str, ...] = ()
            for episode in episodes:
                for demonstration in demonstrations(episode):
                    names = command_names(episode)
                    if number == 0:
                        columns = names
                        data.attrs["env_args"] = json.dumps(_environment(demonstration))
                        data.attrs["action_names"] = columns
                        data.attrs["object_names"] = OBJECT_STATE_NAMES
                    elif names != columns:
                        raise InputError(
                            f"episode {episode.index}: has the actions {', '.join(names)}; "
                            f"expected {', '.join(columns)}"
                        )
                    name = f"demo_{number}"
                    _write_demonstration(data.create_group(name), demonstration)
                    if demonstration.is_success:
                        _add_to_masks(masks, name)
                    number += 1
                    total += len(demonstration)
                    file_object.check()
            if not number:
                raise InputError(f"{path}: no action was executed; expected at least one")
            data.attrs["total"] = total
            for key, members in masks.items():
                file[f"mask/{key}"] = np.array(members, dtype="S")
        file_object.check()
    return number


class _DeferredErrors:
    """File object that keeps the error of a failed write for `check`.

    HDF5 crashes if writing fails while it closes a file.
    """

    def __init__(self, file: Any) -> None:
        self._file = file
        self._error: OSError | None = None

    def write(self, data: Any) -> int:
        """Write bytes, unless an earlier write has failed."""
        view = memoryview(data)
        with self._deferring():
            while len(view) and self._error is None:
                view = view[self._file.write(view) :]
        return len(data)

    def truncate(self, size: int) -> int:
        """Set the size of the file [bytes], unless an earlier write has failed."""
        with self._deferring():
            if self._error is None:
                self._file.truncate(size)
        return size

    @contextmanager
    def _deferring(self) -> Iterator[None]:
        """Keep an error for `check`."""
        try:
            yield
        except OSError as error:
            self._error = error

    def check(self) -> None:
        """Raise the error of the first write that failed."""
        if self._error is not None:
            raise self._error

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def _environment(demonstration: Demonstration) -> dict[str, Any]:
    """Return `env_args`: what an environment for the demonstrations is made of."""
    episode = demonstration.episode
    return {
        "env_name": "drake_clutter",
        "env_version": episode.package_version,
        "type": _GYM_ENVIRONMENT,
        "env_kwargs": {"cell": config_yaml(episode.cell), "rate": demonstration.rate},
    }


def _write_demonstration(group: h5py.Group, demonstration: Demonstration) -> None:
    """Write a demonstration to its group."""
    episode = demonstration.episode
    length = len(demonstration)
    samples = demonstration.samples
    group.attrs.update(
        {
            "num_samples": length,
            "task": demonstration.task,
            "result": demonstration.action.result.value,
            "pick": demonstration.action.move.pick,
            "place": demonstration.action.move.place,
            "scene": scene_to_yaml(episode.initial_scene, episode.cell),
            "recorded_episode": episode.index,
            "recorded_action": demonstration.number,
            "time": samples.time,
        }
    )
    for name, values in _observations(demonstration).items():
        _write(group, f"obs/{name}", values)
    is_last = np.arange(length) == length - 1
    _write(group, "actions", demonstration.command)
    _write(group, "rewards", (is_last & demonstration.is_success).astype(float))
    _write(group, "dones", is_last.astype(np.int64))
    _write(
        group,
        "states",
        np.column_stack([samples.q, samples.v, samples.X_TO.reshape(length, -1)]),
    )


def _observations(demonstration: Demonstration) -> dict[str, NDArray[Any]]:
    """Return the observations by the names of robosuite."""
    samples = demonstration.samples
    w_first = samples.X_TG[:, : len(POSE_COLUMNS) - 3]
    observations: dict[str, NDArray[Any]] = {
        "robot0_joint_pos": samples.q,
        "robot0_joint_vel": samples.v,
        "robot0_eef_pos": samples.X_TG[:, -3:],
        "robot0_eef_quat": np.roll(w_first, -1, axis=1),
        "robot0_gripper_qpos": samples.gripper,
        "vacuum": samples.vacuum,
        "holds_object": (samples.held_object >= 0).astype(float)[:, None],
        "object": demonstration.object_state,
    }
    for name, camera in demonstration.images.items():
        if camera.rgb is not None:
            observations[f"{name}_image"] = camera.rgb
        if camera.depth is not None:
            scale = _MILLIMETER if camera.depth.dtype.kind == "u" else 1.0
            observations[f"{name}_depth"] = (scale * camera.depth).astype(np.float32)[..., None]
        if camera.segmentation is not None:
            observations[f"{name}_segmentation"] = camera.segmentation[..., None]
    return {name: values for name, values in observations.items() if values.size}


def _write(group: h5py.Group, name: str, values: NDArray[Any]) -> None:
    """Write an array; each image is a chunk of its own."""
    chunks = (1, *values.shape[1:]) if values.ndim > 2 else values.shape
    group.create_dataset(name, data=values, chunks=chunks, compression="gzip", compression_opts=1)


def _add_to_masks(masks: dict[str, list[str]], name: str) -> None:
    """Add a successful demonstration to the lists that it belongs to."""
    masks["successful"].append(name)
    is_for_validation = len(masks["successful"]) % VALIDATION_PERIOD == 0
    masks["valid" if is_for_validation else "train"].append(name)
