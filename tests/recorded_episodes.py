"""A recorded episode with known numbers, for tests of files and reports.

Its motion is no simulation: joints and the picked object follow smooth curves, and each image has
one color, from which its time can be read.
"""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from conftest import DEFAULT_CELL, resting, scene_of

from drake_clutter.recording.recorded_episode import (
    CameraImages,
    RecordedAction,
    RecordedEpisode,
)
from drake_clutter.scenes.action_samples import PHASES, ActionSamples
from drake_clutter.scenes.interfaces import Move, MoveResult
from drake_clutter.scenes.scene import Pose, Scene

SCENE = scene_of(
    resting("pudding_box", xy=(-0.1, 0.0)),
    resting("gelatin_box", xy=(0.1, 0.1)),
    resting("large_marker", xy=(0.2, -0.2)),
)
PLACE = (-0.2, 0.15, 0.02)
"""Position at which every object is placed, without a turn [m]."""
HOME = np.array([0.0, -1.8, 1.8, -1.6, -1.57, 0.0])
IMAGE_SIZE = (32, 48)
"""Height and width of the images [px]."""
PRESSURE = 60_000.0
"""Pressure of a cup that holds, below the ambient one [Pa]."""


def synthetic_samples(
    scene: Scene, pick: str, place: Pose, rate: float, duration: float = 2.0
) -> ActionSamples:
    """Return samples of a move that holds its object in the middle half of a duration [s]."""
    time = np.arange(round(duration * rate) + 1) / rate
    s = time / duration
    profile = s**2 * (3 - 2 * s)
    q = HOME + 0.4 * np.sin(np.pi * profile)[:, None] * np.arange(1, 7) / 6
    v = np.gradient(q, time, axis=0)
    v[[0, -1]] = 0.0
    holds = (s > 0.25) & (s < 0.75)
    tools = list(DEFAULT_CELL.gripper.tools)
    index = scene.names.index(pick)
    poses = np.array([[*o.X_TO.quaternion, *o.X_TO.translation] for o in scene.objects])
    X_TO = np.tile(poses, (len(time), 1, 1))
    carried = np.clip((s - 0.25) / 0.5, 0.0, 1.0)[:, None]
    X_TO[:, index, 4:] = (1 - carried) * scene[pick].X_TO.p + carried * place.p
    X_TG = np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.3], (len(time), 1))
    X_TG[:, 4:] += X_TO[:, index, 4:]
    vacuum = np.zeros((len(time), len(tools)))
    vacuum[holds, 0] = PRESSURE
    phase = np.full(len(time), PHASES.index("approach"))
    phase[holds] = PHASES.index("carry")
    return ActionSamples(
        time=time,
        q=q,
        v=v,
        torque=np.tile([10.0, 60.0, 30.0, 5.0, 1.0, 0.1], (len(time), 1)),
        q_commanded=q + 0.001,
        v_commanded=v,
        torque_commanded=np.tile([10.0, 60.0, 30.0, 5.0, 1.0, 0.1], (len(time), 1)),
        gripper=np.zeros((len(time), DEFAULT_CELL.gripper.num_joints)),
        gripper_commanded=np.zeros((len(time), DEFAULT_CELL.gripper.num_actuated_joints)),
        tool_commanded=np.where(holds, 0, -1).astype(np.int16),
        vacuum=vacuum,
        X_TG=X_TG,
        held_object=np.where(holds, index, -1).astype(np.int16),
        phase=phase.astype(np.int16),
        tool_contact=holds,
        object_contact=np.zeros(len(time), dtype=bool),
        X_TO=X_TO,
        time_step=0.0025,
        movable=scene.names,
    )


def image_level(index: int) -> int:
    """Return the red level of the image of a number."""
    return 20 + 6 * (index % 30)


def synthetic_images(samples: ActionSamples, every: int, *, depth: bool = False) -> CameraImages:
    """Return images of every n-th sample; image k has red level `image_level(k)`."""
    time = samples.time[::every]
    rgb = np.full((len(time), *IMAGE_SIZE, 3), 90, dtype=np.uint8)
    rgb[..., 0] = [[[image_level(k)]] for k in range(len(time))]
    millimeters = np.full((len(time), *IMAGE_SIZE), 1200, dtype=np.uint16)
    return CameraImages(
        time=time,
        X_TC=np.tile([0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.2], (len(time), 1)),
        intrinsics=(50.0, 50.0, 23.5, 15.5),
        rgb=rgb,
        depth=millimeters if depth else None,
        segmentation=np.full((len(time), *IMAGE_SIZE), 2, dtype=np.uint8) if depth else None,
    )


def synthetic_episode(
    *, rate: float = 20.0, cameras: Mapping[str, int] | None = None, index: int = 0
) -> RecordedEpisode:
    """Return an episode of a placed, an unplanned and a dropped object.

    Args:
        rate: Samples per second [Hz].
        cameras: Samples per image of each camera, by name.
        index: Number of the episode.
    """
    actions = list[RecordedAction]()
    scene = SCENE
    for pick, result in (("gelatin_box", MoveResult.PLACED), ("pudding_box", MoveResult.DROPPED)):
        place = replace(scene[pick].X_TO, translation=PLACE)
        samples = synthetic_samples(scene, pick, place, rate)
        images = {
            name: synthetic_images(samples, every, depth=True)
            for name, every in (cameras or {}).items()
        }
        detail = "" if result is MoveResult.PLACED else "pudding_box came off"
        action = RecordedAction(
            Move(pick),
            result,
            detail=detail,
            tool="large",
            X_TO_place=place,
            believed=scene.poses,
            samples=samples,
            images=images,
        )
        actions.append(action)
        scene = scene.with_poses(
            {
                name: Pose(tuple(row[4:]), tuple(row[:4]))
                for name, row in zip(scene.names, samples.X_TO[-1].tolist(), strict=True)
            }
        )
    unplanned = RecordedAction(
        Move("large_marker"),
        MoveResult.NOT_PLANNED,
        detail="large_marker",
        failure_reason="no grasp",
        believed=scene.poses,
    )
    return RecordedEpisode(
        initial_scene=SCENE,
        cell=DEFAULT_CELL,
        actions=(actions[0], unplanned, actions[1]),
        policy="random",
        termination="found",
        seed=7,
        index=index,
        scene_name=f"scene_{index}",
        rate=rate,
        package_version="0",
        drake_version="0",
    )


def read_rerun(path: Path) -> dict[str, list[tuple[float, dict[str, Any]]]]:
    """Return the rows of each entity of a file for Rerun, in order of time.

    A row is a time [s], NaN if it is static, and values by component.
    """
    import pyarrow as pa
    from rerun.chunk import RrdReader

    rows = defaultdict(list)
    for chunk in RrdReader(str(path)).stream():
        batch = chunk.to_record_batch()
        # Python has no times in nanoseconds.
        columns = [c.cast(pa.int64()) if pa.types.is_temporal(c.type) else c for c in batch.columns]
        for row in pa.RecordBatch.from_arrays(columns, batch.schema.names).to_pylist():
            nanoseconds = row.pop("time", None)
            time = np.nan if nanoseconds is None else nanoseconds / 1e9
            rows[str(chunk.entity_path)].append((time, row))
    return {path: sorted(found, key=lambda row: row[0]) for path, found in rows.items()}


def with_samples(episode: RecordedEpisode, number: int, samples: ActionSamples) -> RecordedEpisode:
    """Return the episode with other samples of an action."""
    actions = list(episode.actions)
    actions[number - 1] = replace(actions[number - 1], samples=samples)
    return replace(episode, actions=tuple(actions))
