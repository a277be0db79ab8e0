"""Trajectory files: recorded arm motions as HDF5, read by `drake-clutter replay`.

Attributes of the file:

    version  1
    scene    Initial scene as the text of a scene file.
    cell     `WorkCell` as YAML.

Each executed move has a group `move_0001`, `move_0002`, ... with the attributes `pick`, `place`,
`result`, `detail` and `tool`, the name of the gripper's tool that holds the object. Its datasets
have m samples of an arm with n joints:

    time     (m,)             Time since the start of the move [s].
    q        (m, n)           Joint positions [rad].
    v        (m, n)           Joint velocities [rad/s].
    torque   (m, n)           Joint torques of the actuators [N m].
    suction  (m,)             Whether the tool is commanded to hold the object.
    X_TO     (m, objects, 7)  Quaternion (w, x, y, z) and position (x, y, z) [m] of each object, in
                              the order of the scene file.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from drake_clutter.catalog import Catalog
from drake_clutter.cell.work_cell import WorkCell, default_cell
from drake_clutter.config import upgrade_cell
from drake_clutter.files import InputError, atomic_write, format_value, input_error, reading_file
from drake_clutter.limits import MAX_SAMPLES
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import ArmState, MotionSample, Move, Outcome
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.scenes.scene_file import scene_from_yaml, scene_to_yaml
from drake_clutter.validation import config_yaml, override_config
from drake_clutter.yaml_io import parse_yaml

FORMAT_VERSION = 1
"""Version of the file format."""
_ARM_DATASETS = ("q", "v", "torque")
"""Datasets with a column per joint; also fields of `ArmState`."""


def write_trajectories(
    path: Path, initial_scene: Scene, moves: Sequence[tuple[Move, Outcome]], cell: WorkCell
) -> int:
    """Write the moves with a recorded arm motion atomically.

    Args:
        path: File to write.
        initial_scene: Scene before the first move.
        moves: Moves with their outcomes; moves without an arm motion are skipped.
        cell: Work cell; its support is replaced by that of the scene.

    Returns:
        Number of moves written.
    """
    count = 0
    with atomic_write(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            {
                "version": FORMAT_VERSION,
                "scene": scene_to_yaml(initial_scene, cell),
                "cell": config_yaml(cell.with_support(initial_scene.support)),
            }
        )
        for move, outcome in moves:
            states = [sample.arm for sample in outcome.motion if sample.arm]
            if not states:
                continue
            count += 1
            group = file.create_group(f"move_{count:04d}")
            group.attrs.update(
                {
                    "pick": move.pick,
                    "place": move.place,
                    "result": outcome.result.value,
                    "detail": outcome.detail,
                    "tool": next((state.tool for state in states if state.tool), ""),
                }
            )
            arrays = {
                name: np.array([getattr(state, name) for state in states]) for name in _ARM_DATASETS
            }
            arrays["time"] = np.array([sample.time for sample in outcome.motion])
            arrays["suction"] = np.array([bool(state.tool) for state in states])
            poses = [
                [sample.poses[o.name] for o in initial_scene.objects] for sample in outcome.motion
            ]
            arrays["X_TO"] = np.array(
                [[(*X.quaternion, *X.translation) for X in row] for row in poses]
            )
            for name, values in arrays.items():
                group.create_dataset(name, data=values, compression="gzip", shuffle=True)
    return count


def read_trajectories(
    path: Path, catalog: Catalog
) -> tuple[Scene, WorkCell, list[tuple[Move, tuple[MotionSample, ...]]]]:
    """Read a trajectory file.

    Args:
        path: File to read.
        catalog: Catalog with the classes of the objects.

    Returns:
        Initial scene, work cell, and moves with their recorded samples.

    Raises:
        InputError: The file is not a trajectory file; names the field and what is allowed.
    """
    content = f"a trajectory file of version {FORMAT_VERSION} (HDF5)"
    with reading_file(path, content), h5py.File(path) as file:
        version = file.attrs.get("version")
        if version != FORMAT_VERSION or "scene" not in file.attrs:
            raise input_error(str(path), f"version {format_value(version)}; expected {content}")
        scene = scene_from_yaml(str(file.attrs["scene"]), f"{path}:scene", catalog).scene
        cell = _read_cell(path, file.attrs).with_support(scene.support)
        num_joints = load_robot(cell.robot).num_joints
        tool = next(iter(cell.gripper.tools))  # of files without the attribute
        moves = [
            _read_move(path, name, file[name], scene, num_joints, tool) for name in sorted(file)
        ]
        return scene, cell, moves


def _read_cell(path: Path, attributes: Mapping[str, Any]) -> WorkCell:
    """Return the work cell of a file; files of package version 0.1 have only the arm."""
    field = "cell" if "cell" in attributes else "arm"
    source = f"{path}:{field}"
    document = parse_yaml(str(attributes.get(field, "{}")), source)
    if field == "arm":
        document = upgrade_cell(document)
    return override_config(default_cell(), document, source)


def _read_move(
    path: Path, name: str, group: h5py.Group, scene: Scene, num_joints: int, default_tool: str
) -> tuple[Move, tuple[MotionSample, ...]]:
    """Return the move of a group and its samples."""
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_ARM_DATASETS, (num_joints,))
    shapes |= {"time": (), "suction": (), "X_TO": (len(scene.objects), 7)}
    arrays: dict[str, NDArray[np.float64]] = {}
    for field, shape in shapes.items():
        dataset = group.get(field)
        if (
            not isinstance(dataset, h5py.Dataset)
            or len(dataset.shape) == 0
            or dataset.shape[1:] != shape
            or dataset.shape[0] > MAX_SAMPLES
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
    tool = str(group.attrs.get("tool", default_tool))
    samples = []
    for k, time in enumerate(arrays["time"].tolist()):
        q, v, torque = (tuple(arrays[field][k].tolist()) for field in _ARM_DATASETS)
        arm = ArmState(q, v, torque, tool if arrays["suction"][k] else "")
        rows = arrays["X_TO"][k].tolist()
        poses = {
            o.name: Pose(tuple(row[4:]), tuple(row[:4]))
            for o, row in zip(scene.objects, rows, strict=True)
        }
        samples.append(MotionSample(time, poses, arm))
    return Move(str(group.attrs["pick"]), str(group.attrs["place"])), tuple(samples)
