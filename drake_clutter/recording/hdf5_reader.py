"""Readers of the groups of HDF5 files of version 2, see `hdf5_file`.

Every attribute and dataset has a type and bounds, which are checked before it is used.
"""

from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.files import InputError, format_value, input_error
from drake_clutter.limits import MAX_IMAGE_SIDE, MAX_MOTION_DURATION, MAX_SAMPLES
from drake_clutter.recording.recorded_episode import CameraImages, RecordedAction
from drake_clutter.scenes.action_samples import (
    CHANNELS,
    EXECUTED_COMMANDS,
    PHASES,
    POSE_COLUMNS,
    ActionSamples,
    Channel,
    ExecutedCommands,
)
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene import Pose

Floats = NDArray[np.float64]
Choice = TypeVar("Choice", bound=Enum)

MAX_TIME_STEP = 0.1
"""Largest time step of a simulation [s]: objects fall through others within it."""
MAX_KNOTS = 10 * MAX_SAMPLES
"""Largest number of executed commands of an action, which may be closer than its samples."""
MAX_OBJECTS = 10_000
"""Largest number of objects of a belief: more than any scene has."""
MAX_CAMERAS = 100
"""Largest number of cameras."""
MAX_QUATERNION_ERROR = 0.01
"""Largest deviation of a quaternion's norm from 1."""
MAX_DATASET_SIZE = 2**31
"""Largest size of an uncompressed dataset that is read [bytes]: 2,300 images of 640 by 480."""
MAX_TEXT_LENGTH = 2**24
"""Largest number of characters of an attribute: far more than a scene of 200 objects has."""
ACTION_TEXTS = ("detail", "failure_reason", "instability", "tool")
"""Attributes of an action with a text, which are also fields of `RecordedAction`."""
_IMAGE_TYPES = {
    "rgb": ("uint8",),
    "depth": ("float32", "uint16"),
    "segmentation": ("uint8", "uint16"),
}
"""Types of each kind of image."""


class AttributeReader:
    """Attributes of a file or a group, each with a type and bounds."""

    def __init__(self, source: str, attributes: Mapping[str, Any]) -> None:
        """Take the attributes.

        Args:
            source: File and group, for messages.
            attributes: The attributes.
        """
        self._source = source
        self._attributes = attributes

    def _error(self, name: str, allowed: str) -> InputError:
        value = self._attributes.get(name)
        value = value.item() if isinstance(value, np.generic) else value
        shown = "is missing" if value is None else format_value(value)
        return input_error(self._source, f"{name}: {shown}; expected {allowed}")

    def text(self, name: str) -> str:
        """Return a text."""
        value = self._attributes.get(name)
        if not isinstance(value, str) or len(value) > MAX_TEXT_LENGTH:
            raise self._error(name, f"a text of at most {MAX_TEXT_LENGTH} characters")
        return value

    def texts(self, name: str, most: int) -> tuple[str, ...]:
        """Return a list of at most `most` texts."""
        values = self._attributes.get(name)
        if not isinstance(values, np.ndarray) or values.ndim != 1 or len(values) > most:
            raise self._error(name, f"a list of at most {most} texts")
        if not all(isinstance(value, str) for value in values.tolist()):
            raise self._error(name, f"a list of at most {most} texts")
        return tuple(values.tolist())

    def integer(self, name: str, least: int, most: int) -> int:
        """Return an integer in [`least`, `most`]."""
        value = self._attributes.get(name)
        if not isinstance(value, np.integer) or not least <= value <= most:
            raise self._error(name, f"an integer in [{least}, {most}]")
        return int(value)

    def quantity(self, name: str, most: float) -> float:
        """Return a number in (0, `most`]."""
        value = self._attributes.get(name)
        if not isinstance(value, np.floating) or not 0 < value <= most:
            raise self._error(name, f"a number in (0, {most:g}]")
        return float(value)

    def vector(self, name: str, length: int) -> Floats:
        """Return a vector of numbers."""
        value = self._attributes.get(name)
        if not isinstance(value, np.ndarray) or value.shape != (length,) or value.dtype.kind != "f":
            raise self._error(name, f"{length} numbers")
        return np.asarray(value, np.float64)

    def choice(self, name: str, enumeration: type[Choice]) -> Choice:
        """Return the member of an enumeration of texts."""
        value = self.text(name)
        if value not in {member.value for member in enumeration}:
            raise self._error(name, "one of " + ", ".join(member.value for member in enumeration))
        return enumeration(value)


class ActionReader:
    """Reads an action from its group."""

    def __init__(
        self, path: Path, group: h5py.Group, name: str, axes: Mapping[str, Sequence[str]]
    ) -> None:
        """Take the group.

        Args:
            path: File, for messages.
            group: Group of the action.
            name: Name of the group.
            axes: See `RecordedEpisode.axes`.
        """
        self._path = path
        self._source = f"{path}:{name}"
        if not isinstance(group, h5py.Group):
            raise input_error(self._source, "is a dataset; expected a group")
        self._group = group
        self._axes = axes
        self._attributes = AttributeReader(self._source, group.attrs)

    def read(self, *, images: bool) -> RecordedAction:
        """Return the action.

        Args:
            images: Whether to read its images.
        """
        attributes = self._attributes
        place = attributes.vector("X_TO_place", len(POSE_COLUMNS))
        X_TO_place = None
        if not np.isnan(place).all():
            self._check_poses("X_TO_place", place)
            X_TO_place = Pose(tuple(place[4:].tolist()), tuple(place[:4].tolist()))
        pick = attributes.text("pick")
        if pick not in self._axes["objects"]:
            problem = f"pick: {format_value(pick)}"
            raise input_error(self._source, f"{problem}; expected the name of an object")
        return RecordedAction(
            Move(pick, attributes.text("place")),
            attributes.choice("result", MoveResult),
            **{name: attributes.text(name) for name in ACTION_TEXTS},
            X_TO_place=X_TO_place,
            believed=self._read_believed() if "believed" in self._group else {},
            samples=self._read_samples() if "time" in self._group else None,
            images=self._read_images() if images and "images" in self._group else {},
        )

    def _read_believed(self) -> dict[str, Pose]:
        """Return the poses of the belief by name."""
        count = self._count(self._group, "believed", MAX_OBJECTS)
        shape = (count, len(POSE_COLUMNS))
        rows = self._array(self._group, "believed", shape, ("float64",))
        self._check_poses("believed", rows)
        source = f"{self._source}.believed"
        names = AttributeReader(source, self._group["believed"].attrs).texts("names", count)
        if len(set(names)) != count:
            problem = f"names: {format_value([*names])}"
            raise input_error(source, f"{problem}; expected {count} different names")
        poses = (Pose(tuple(row[4:]), tuple(row[:4])) for row in rows.tolist())
        return dict(zip(names, poses, strict=True))

    def _read_samples(self) -> ActionSamples:
        """Return the samples."""
        objects = self._axes["objects"]
        num_tools = len(self._axes["tools"])
        count = self._count(self._group, "time", MAX_SAMPLES)
        arrays: dict[str, Any] = {
            channel.name: self._channel(self._group, channel, count) for channel in CHANNELS
        }
        self._check_times(f"{self._source}.time", arrays["time"])
        limits = {"tool_commanded": num_tools, "held_object": len(objects), "phase": len(PHASES)}
        self._check_indices(self._group, arrays, limits)
        for name in ("X_TG", "X_TO"):
            self._check_poses(name, arrays[name])
        movable = self._attributes.texts("movable", len(objects))
        if unknown := [name for name in movable if name not in objects]:
            problem = f"movable: {format_value(unknown[0])}"
            raise input_error(self._source, f"{problem}; expected names of objects")
        time_step = self._attributes.quantity("time_step", MAX_TIME_STEP)
        executed = self._read_executed(num_tools) if "executed" in self._group else None
        return ActionSamples(**arrays, time_step=time_step, movable=movable, executed=executed)

    def _read_executed(self, num_tools: int) -> ExecutedCommands:
        """Return the executed commands."""
        group = self._group["executed"]
        if not isinstance(group, h5py.Group):
            raise input_error(f"{self._source}.executed", "is a dataset; expected a group")
        num_knots = self._count(group, "time", MAX_KNOTS)
        num_steps = self._count(group, "step_phase", MAX_SAMPLES)
        counts = {"time": num_knots, "command": num_knots, "step_start": num_steps + 1}
        counts["wait_time"] = self._count(group, "wait_time", MAX_SAMPLES, least=0)
        arrays: dict[str, Any] = {
            channel.name: self._channel(group, channel, counts.get(channel.name, num_steps))
            for channel in EXECUTED_COMMANDS
        }
        self._check_times(self._source_of(group, "time"), arrays["time"])
        starts = arrays["step_start"]
        is_ordered = starts[0] == 0 and (np.diff(starts) >= 0).all()
        if num_knots < 2 or not is_ordered or starts[-1] > MAX_MOTION_DURATION:
            allowed = "at least 2 commands, and starts that do not decrease, from 0 to at most "
            allowed += f"{MAX_MOTION_DURATION:g} s"
            raise input_error(f"{self._source}.executed", f"expected {allowed}")
        self._check_indices(group, arrays, {"step_phase": len(PHASES), "step_tool": num_tools})
        return ExecutedCommands(**arrays)

    def _read_images(self) -> dict[str, CameraImages]:
        """Return the images by name of the camera."""
        cameras = self._group["images"]
        if not isinstance(cameras, h5py.Group) or len(cameras) > MAX_CAMERAS:
            allowed = f"a group with at most {MAX_CAMERAS} cameras"
            raise input_error(f"{self._source}.images", f"expected {allowed}")
        return {name: self._read_camera(name, cameras[name]) for name in cameras}

    def _read_camera(self, name: str, group: Any) -> CameraImages:
        """Return the images of a camera."""
        source = f"{self._source}.images/{name}"
        if not isinstance(group, h5py.Group):
            raise input_error(source, "is a dataset; expected a group")
        count = self._count(group, "time", MAX_SAMPLES)
        time = self._array(group, "time", (count,), ("float64",))
        self._check_times(f"{source}.time", time)
        X_TC = self._array(group, "X_TC", (count, len(POSE_COLUMNS)), ("float64",))
        self._check_poses(f"images/{name}.X_TC", X_TC)
        arrays = {}
        for kind, types in _IMAGE_TYPES.items():
            if kind in group:
                side = getattr(group[kind], "shape", ())[1:3]
                if len(side) != 2 or max(side) > MAX_IMAGE_SIDE:
                    allowed = f"images with at most {MAX_IMAGE_SIDE} pixels a side"
                    raise input_error(f"{source}.{kind}", f"expected {allowed}")
                channels = (3,) if kind == "rgb" else ()
                arrays[kind] = self._array(group, kind, (count, *side, *channels), types)
        fx, fy, cx, cy = AttributeReader(source, group.attrs).vector("intrinsics", 4).tolist()
        return CameraImages(time, X_TC, (fx, fy, cx, cy), **arrays)

    def _source_of(self, group: h5py.Group, name: str) -> str:
        """Return file, group and name of a dataset, for messages."""
        return f"{self._path}:{group.name.removeprefix('/')}.{name}"

    def _count(self, group: h5py.Group, name: str, most: int, least: int = 1) -> int:
        """Return the length of a dataset, in [`least`, `most`]."""
        shape = getattr(group.get(name), "shape", ())
        if not shape or not least <= shape[0] <= most:
            allowed = f"a dataset with {least} to {most} values"
            raise input_error(self._source_of(group, name), f"expected {allowed}")
        return int(shape[0])

    def _array(
        self, group: h5py.Group, name: str, shape: tuple[int, ...], types: tuple[str, ...]
    ) -> NDArray[Any]:
        """Return the values of a dataset, whose size is checked before it is read.

        Args:
            group: Group of the dataset.
            name: Name of the dataset.
            shape: Its shape.
            types: Types that it may have.
        """
        dataset = group.get(name)
        is_own = isinstance(group.get(name, getlink=True), h5py.HardLink)
        if (
            not isinstance(dataset, h5py.Dataset)
            or not is_own
            or dataset.external
            or dataset.is_virtual
            or dataset.shape != shape
            or str(dataset.dtype) not in types
        ):
            allowed = f"a dataset of shape {shape} and type {' or '.join(types)}"
            raise input_error(self._source_of(group, name), f"expected {allowed}")
        if dataset.nbytes > MAX_DATASET_SIZE:
            allowed = f"at most {MAX_DATASET_SIZE / 2**30:g} GiB"
            raise input_error(
                self._source_of(group, name),
                f"has {dataset.nbytes / 2**30:.1f} GiB; expected {allowed}",
            )
        values: NDArray[Any] = dataset[()]
        return values

    def _channel(self, group: h5py.Group, channel: Channel, count: int) -> NDArray[Any]:
        """Return the values of a channel with `count` rows, which are finite."""
        shape = (count, *(len(self._axes[axis]) for axis in channel.axes))
        values = self._array(group, channel.name, shape, (channel.dtype,))
        if channel.dtype == "float64" and not np.isfinite(values).all():
            raise input_error(self._source_of(group, channel.name), "expected finite numbers")
        return values

    def _check_indices(
        self, group: h5py.Group, arrays: Mapping[str, NDArray[Any]], sizes: Mapping[str, int]
    ) -> None:
        """Check that indices are at least -1 and below the size of what they refer to."""
        for name, size in sizes.items():
            if not ((arrays[name] >= -1) & (arrays[name] < size)).all():
                allowed = f"integers in [-1, {size - 1}]"
                raise input_error(self._source_of(group, name), f"expected {allowed}")

    def _check_times(self, source: str, time: Floats) -> None:
        """Check that times are finite and increase from 0 or later."""
        if not np.isfinite(time).all() or time[0] < 0 or (np.diff(time) <= 0).any():
            raise input_error(source, "expected finite times that increase, from 0 or later")

    def _check_poses(self, name: str, poses: Floats) -> None:
        """Check that poses are finite and have unit quaternions."""
        norm = np.linalg.norm(poses[..., :4], axis=-1)
        if not np.isfinite(poses).all() or not (np.abs(norm - 1) < MAX_QUATERNION_ERROR).all():
            allowed = "finite poses with unit quaternions"
            raise input_error(f"{self._source}.{name}", f"expected {allowed}")
