"""Trajectory files of version 1, which are read but no longer written.

Attributes of the file: `version`, `scene`, the text of a scene file, and `cell`, the work cell as
YAML; of package version 0.1 `arm` instead. Each executed move has a group `move_0001`, ... with the
attributes `pick`, `place`, `result`, `detail` and `tool`, and the datasets `time`, `q`, `v`,
`torque`, `suction`, whether the tool is commanded to hold the object, and `X_TO`. Moves that were
not executed are missing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import Catalog
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import upgrade_cell
from drake_clutter.files import InputError, format_value, input_error
from drake_clutter.limits import MAX_SAMPLES
from drake_clutter.recording.recorded_episode import RecordedAction, RecordedEpisode
from drake_clutter.scenes.action_samples import CHANNELS, ActionSamples
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene_file import scene_from_yaml
from drake_clutter.validation import override_config
from drake_clutter.yaml_io import parse_yaml

_SAMPLE_RATE = 40.0
"""Samples per second [Hz]."""
_UNKNOWN: Mapping[str, Any] = {"float64": np.nan, "int16": -1, "bool": False}
"""Values of channels that the files do not have, by type."""


def read_version_1(path: Path, file: h5py.File, catalog: Catalog) -> RecordedEpisode:
    """Return the episode of a file; what it does not hold is unknown, see `ActionSamples`.

    Args:
        path: The file, for messages.
        file: The opened file.
        catalog: Catalog with the classes of the objects.

    Raises:
        InputError: A field cannot be used; names it and what is allowed.
    """
    scene = scene_from_yaml(str(file.attrs["scene"]), f"{path}:scene", catalog).scene
    episode = RecordedEpisode(
        initial_scene=scene,
        cell=_read_cell(path, file.attrs).with_support(scene.support),
        actions=(),
        policy="",
        termination="",
        seed=-1,
        index=0,
        scene_name="",
        rate=_SAMPLE_RATE,
        package_version="",
        drake_version="",
    )
    axes = episode.axes
    actions = tuple(_read_move(path, name, file[name], axes) for name in sorted(file))
    return replace(episode, actions=actions)


def _read_cell(path: Path, attributes: Mapping[str, Any]) -> WorkCell:
    """Return the work cell of a file; files of package version 0.1 have only the arm."""
    field = "cell" if "cell" in attributes else "arm"
    source = f"{path}:{field}"
    document = parse_yaml(str(attributes.get(field, "{}")), source)
    if field == "arm":
        document = upgrade_cell(document)
    return override_config(default_cell(), document, source)


def _read_move(
    path: Path, name: str, group: h5py.Group, axes: Mapping[str, Sequence[str]]
) -> RecordedAction:
    """Return the action of a group."""
    num_joints, num_objects = len(axes["joints"]), len(axes["objects"])
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("q", "v", "torque"), (num_joints,))
    shapes |= {"time": (), "suction": (), "X_TO": (num_objects, 7)}
    arrays: dict[str, NDArray[Any]] = {}
    for field, shape in shapes.items():
        dataset = group.get(field)
        if (
            not isinstance(dataset, h5py.Dataset)
            or len(dataset.shape) == 0
            or dataset.shape[1:] != shape
            or not 1 <= dataset.shape[0] <= MAX_SAMPLES
        ):
            raise InputError(
                f"{path}:{name}.{field}; expected a dataset of shape {('n', *shape)}, "
                f"n at most {MAX_SAMPLES}"
            )
        arrays[field] = dataset[()]
        if arrays[field].dtype.kind not in "bif" or not np.isfinite(arrays[field]).all():
            raise InputError(f"{path}:{name}.{field}; expected finite numbers")
    if not (np.abs(np.linalg.norm(arrays["X_TO"][..., :4], axis=-1) - 1) < 0.01).all():
        raise InputError(f"{path}:{name}.X_TO; expected unit quaternions")
    lengths = {field: len(values) for field, values in arrays.items()}
    if len(set(lengths.values())) != 1:
        raise InputError(f"{path}:{name}: lengths {lengths}; expected equal lengths")
    tools = axes["tools"]
    tool = str(group.attrs.get("tool", tools[0]))
    if tool not in tools:
        raise InputError(f"{path}:{name}: tool {tool!r}; expected one of {', '.join(tools)}")
    result = str(group.attrs["result"])
    allowed = [member.value for member in MoveResult]
    if result not in allowed:
        raise InputError(f"{path}:{name}: result {result!r}; expected {', '.join(allowed)}")
    pick = str(group.attrs["pick"])
    if pick not in axes["objects"]:
        problem = f"pick: {format_value(pick)}"
        raise input_error(f"{path}:{name}", f"{problem}; expected the name of an object")
    values: dict[str, Any] = {}
    for channel in CHANNELS:
        shape = (len(arrays["time"]), *(len(axes[axis]) for axis in channel.axes))
        default = np.full(shape, _UNKNOWN[channel.dtype], channel.dtype)
        values[channel.name] = arrays.get(channel.name, default)
    values["tool_commanded"] = np.where(arrays["suction"], tools.index(tool), -1).astype(np.int16)
    return RecordedAction(
        move=Move(pick, str(group.attrs["place"])),
        result=MoveResult(result),
        detail=str(group.attrs["detail"]),
        tool=tool,
        samples=ActionSamples(**values, time_step=np.nan, movable=tuple(axes["objects"])),
    )
