"""Recorded arm motions as HDF5, for a researcher's own analysis and for `drake-clutter replay`.

Attributes of the file: `version`, `scene` (a scene file's text: how everything lay at first), `cell` (a `WorkCell` as YAML).
A group `move_0001`, ... for each move that the arm carried out; its attributes are `pick`, `place`, `result` and `detail`, its
datasets, over n moments, for an arm of j joints:

    time     (n,)             s, since the move began
    q        (n, j)           rad
    v        (n, j)           rad/s
    torque   (n, j)           N m, of the motors
    suction  (n,)             whether the vacuum is switched on
    X_TO     (n, objects, 7)  qw, qx, qy, qz, x, y, z (m), in the order of the scene file's objects
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
from drake_clutter.files import InputError, atomic_write, input_error
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.interfaces import ArmState, MotionSample, Move, Outcome
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.scenes.scene_file import scene_from_yaml, scene_to_yaml
from drake_clutter.validation import config_yaml, override_config
from drake_clutter.yaml_io import parse_yaml

FORMAT_VERSION = 1
_ARM_DATASETS = ("q", "v", "torque")


def write_trajectories(
    path: Path, initial_scene: Scene, moves: Sequence[tuple[Move, Outcome]], cell: WorkCell
) -> int:
    """Writes the moves of which there is an arm's motion, in one step; returns how many there are.

    Args:
        path: the file.
        initial_scene: the scene before the first move.
        moves: and what they led to.
        cell: in which they were carried out; its support is the scene's.
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
            states = [frame.arm for frame in outcome.motion if frame.arm]
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
                }
            )
            arrays = {
                name: np.array([getattr(state, name) for state in states]) for name in _ARM_DATASETS
            }
            arrays["time"] = np.array([frame.time for frame in outcome.motion])
            arrays["suction"] = np.array([state.suction for state in states])
            poses = [
                [frame.poses[o.name] for o in initial_scene.objects] for frame in outcome.motion
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
    """Return the scene at first, the cell, and the motion of each move.

    Raises:
        InputError: the file, the field and what is allowed, for whatever cannot be such a file.
    """
    try:
        file = h5py.File(path)
    except OSError as error:
        raise input_error(
            str(path), f"cannot be read as HDF5; allowed is a trajectory file ({error})"
        ) from error
    with file:
        if int(file.attrs.get("version", 0)) != FORMAT_VERSION or "scene" not in file.attrs:
            raise InputError(
                f"{path}: version {file.attrs.get('version')}; allowed is a trajectory file of version {FORMAT_VERSION}"
            )
        scene = scene_from_yaml(str(file.attrs["scene"]), f"{path}:scene", catalog).scene
        cell = _read_cell(path, file.attrs).with_support(scene.support)
        joints = load_robot(cell.robot).num_joints
        return (
            scene,
            cell,
            [_read_move(path, name, file[name], scene, joints) for name in sorted(file)],
        )


def _read_cell(path: Path, attributes: Mapping[str, Any]) -> WorkCell:
    """Return the cell of a file; files of drake_clutter 0.1 hold the arm alone."""
    field = "cell" if "cell" in attributes else "arm"
    given = parse_yaml(str(attributes.get(field, "{}")), f"{path}:{field}")
    return override_config(
        default_cell(), upgrade_cell(given) if field == "arm" else given, f"{path}:{field}"
    )


def _read_move(
    path: Path, name: str, group: h5py.Group, scene: Scene, joints: int
) -> tuple[Move, tuple[MotionSample, ...]]:
    arrays: dict[str, NDArray[np.float64]] = {}
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_ARM_DATASETS, (joints,))
    shapes |= {"time": (), "suction": (), "X_TO": (len(scene.objects), 7)}
    for field, shape in shapes.items():
        found = group.get(field)
        if not isinstance(found, h5py.Dataset) or len(found.shape) == 0 or found.shape[1:] != shape:
            raise InputError(
                f"{path}:{name}.{field}; allowed is a dataset of shape {('n', *shape)}"
            )
        arrays[field] = found[()]
    lengths = {field: len(values) for field, values in arrays.items()}
    if len(set(lengths.values())) != 1:
        raise InputError(f"{path}:{name}: lengths {lengths}; allowed is one and the same")
    frames = []
    for k, time in enumerate(arrays["time"].tolist()):
        q, v, torque = (tuple(arrays[field][k].tolist()) for field in _ARM_DATASETS)
        arm = ArmState(q, v, torque, bool(arrays["suction"][k]))
        rows = arrays["X_TO"][k].tolist()
        poses = {
            o.name: Pose(tuple(row[4:]), tuple(row[:4]))
            for o, row in zip(scene.objects, rows, strict=True)
        }
        frames.append(MotionSample(time, poses, arm))
    return Move(str(group.attrs["pick"]), str(group.attrs["place"])), tuple(frames)
