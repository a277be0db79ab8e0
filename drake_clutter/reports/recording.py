"""3-D recordings of scenes in motion: one HTML file, or a live view (Meshcat)."""

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import (
    Meshcat,
    MeshcatAnimation,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
)
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation, Slerp

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import write_text
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.interfaces import MotionSample
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.cell_plant import add_work_cell, set_joint_angles
from drake_clutter.simulation.drake_log import suppress_drake_log
from drake_clutter.simulation.scene_plant import (
    add_scene_plant,
    pose_from_transform,
    rigid_transform,
)
from drake_clutter.tasks.exploration_task import Transition

FRAMES_PER_SECOND = 40
_CARRY_TIME = 0.5
"""Duration of each of lifting, carrying and lowering [s]."""
_PAUSE_AFTER_MOVE = 0.6
"""Pause after each move [s]."""
_PAUSE_AT_ENDS = 1.5
"""Pause before the first and after the last move [s]."""
_CLEARANCE = 0.03
"""Distance between a carried object and the highest other object [m]."""
_KEY_FRAME_DISTANCE = 1e-4
"""Translation below which poses share a key frame, which reduces the file to a third [m]."""
_KEY_FRAME_ANGLE = 1e-3
"""Rotation below which poses share a key frame [rad]."""
_NUM_REPETITIONS = 1_000_000_000
_REFERENCE_SIDE = 0.70
"""Side of the support for which the camera poses are given; they scale with the support [m]."""
_CAMERA_POSITION = (0.45, -1.35, 1.10)
_CAMERA_TARGET = (0.0, 0.0, 0.14)
"""Point that the camera looks at, in the tray frame [m]."""
_CAMERA_POSITION_WITH_ARM = (0.80, -2.10, 1.45)
_CAMERA_TARGET_WITH_ARM = (-0.15, 0.0, 0.46)
"""Point that the camera looks at if the arm is shown, in the tray frame [m]."""
_FOV_Y_DEG = 36.0
_LIGHTS: dict[str, dict[str, Any]] = {
    "SpotLight": {
        "intensity": 20.0,
        "castShadow": True,
        "shadow.bias": -0.003,
        "position": [-1.0, -1.1, 2.6],
    },
    "PointLightNegativeX": {"intensity": 3.0},
    "PointLightPositiveX": {"intensity": 3.0},
    "AmbientLight": {"intensity": 0.4},
    "FillLight": {"intensity": 0.3},
}
"""Properties of Meshcat's own lights.

They are dimmed, because the defaults overexpose bright products. The bias prevents surfaces from
casting shadows on themselves.
"""
_SOURCE_COMMENT = re.compile(r"^\s*// \w+\[\d+\] from .*$", re.MULTILINE)


def episode_frames(start: Scene, steps: Sequence[Transition]) -> list[MotionSample]:
    """Return the moves of an episode as one motion.

    Teleported objects are shown as lifted, carried and set down, which is an illustration. Moves
    that were not executed are omitted.

    Args:
        start: Scene before the first move.
        steps: Transitions in order.
    """
    poses = dict(start.poses)
    time = _PAUSE_AT_ENDS
    frames = [MotionSample(0.0, dict(poses))]
    scene = start
    for step in steps:
        if not step.outcome.result.was_executed:
            continue
        pick = step.move.pick
        motion: Sequence[MotionSample] = step.outcome.motion
        if step.outcome.samples is not None:
            motion = motion_frames(step.outcome.samples, start.names)
        else:
            for X_TO in _illustrate_carry(
                scene, pick, step.outcome.X_TO_released or step.outcome.scene[pick].X_TO
            ):
                poses[pick] = X_TO
                frames.append(MotionSample(time, dict(poses)))
                time += 1 / FRAMES_PER_SECOND
        for frame in motion:
            poses |= frame.poses
            frames.append(MotionSample(time + frame.time, dict(poses), frame.q))
        scene = step.outcome.scene
        poses = dict(scene.poses)
        time = frames[-1].time + _PAUSE_AFTER_MOVE
        frames.append(MotionSample(time, dict(poses)))
    frames.append(MotionSample(frames[-1].time + _PAUSE_AT_ENDS, dict(poses)))
    return frames


def motion_frames(
    samples: ActionSamples, object_names: Sequence[str], rate: float = FRAMES_PER_SECOND
) -> list[MotionSample]:
    """Return the frames of a recorded motion, with its first and last sample.

    Args:
        samples: The samples.
        object_names: Names of the objects, in the order of `ActionSamples.X_TO`.
        rate: Frames per second at most.
    """
    numbers = np.floor(samples.time * rate + 1e-6)
    (picked,) = np.nonzero(np.diff(numbers, prepend=-1.0))
    indices = [*picked[:-1].tolist(), len(samples) - 1]
    frames = list[MotionSample]()
    for k in indices:
        rows = samples.X_TO[k].tolist()
        poses = {
            name: Pose(tuple(row[4:]), tuple(row[:4]))
            for name, row in zip(object_names, rows, strict=True)
        }
        frames.append(MotionSample(float(samples.time[k]), poses, tuple(samples.q[k].tolist())))
    return frames


def replay_frames(
    episode: RecordedEpisode, speed: float = 1.0, rate: float = FRAMES_PER_SECOND
) -> list[MotionSample]:
    """Return the frames of all motions of an episode one after the other, with pauses.

    Args:
        episode: Recorded episode with at least one motion.
        speed: Factor by which the motions are played faster.
        rate: Frames per second of the playback at most.
    """
    names = episode.initial_scene.names
    motions = [
        [
            replace(frame, time=frame.time / speed)
            for frame in motion_frames(action.samples, names, rate / speed)
        ]
        for action in episode.actions
        if action.samples is not None
    ]
    return concatenate_motions(motions)


def concatenate_motions(motions: Sequence[Sequence[MotionSample]]) -> list[MotionSample]:
    """Return motions one after the other, with pauses."""
    frames = list[MotionSample]()
    time = 0.0
    for motion in motions:
        frames += [replace(frame, time=time + frame.time) for frame in motion]
        time = frames[-1].time + _PAUSE_AFTER_MOVE
    return [*frames, replace(frames[-1], time=frames[-1].time + _PAUSE_AT_ENDS)]


def _illustrate_carry(scene: Scene, pick: str, X_T_placed: Pose) -> list[Pose]:
    """Return poses of an object that is lifted, carried and set down, at 40 Hz.

    Args:
        scene: Scene before the move.
        pick: Name of the moved object.
        X_T_placed: Pose of the object at the end.
    """
    picked = scene[pick]
    # The lowest point is below the origin by at most the distance of the farthest corner.
    reach = float(np.linalg.norm(picked.object_class.corners, axis=1).max())
    tops = [o.top_height for o in scene.objects if o.name != pick]
    height = max([picked.X_TO.p[2], X_T_placed.p[2], *(top + reach for top in tops)]) + _CLEARANCE
    start = picked.X_TO.p
    end = X_T_placed.p
    corners = np.array([start, [start[0], start[1], height], [end[0], end[1], height], end])
    slerp = Slerp([0.0, 1.0], Rotation.from_matrix([picked.X_TO.rotation, X_T_placed.rotation]))
    count = round(_CARRY_TIME * FRAMES_PER_SECOND)
    time_fraction = np.arange(count) / count
    smooth = time_fraction**2 * (3 - 2 * time_fraction)
    poses = list[Pose]()
    for leg in range(3):  # lift, carry, lower
        for s in smooth:
            rotation_fraction = (0.0, s, 1.0)[leg]
            poses.append(
                Pose.from_rotation(
                    slerp(rotation_fraction).as_matrix(),
                    corners[leg] + s * (corners[leg + 1] - corners[leg]),
                )
            )
    return poses


def write_recording(
    path: Path, scene: Scene, frames: Sequence[MotionSample], cell: WorkCell
) -> None:
    """Write one HTML file that plays frames in a loop, without a network.

    Args:
        path: The file.
        scene: The objects, and the poses of those that a frame does not contain.
        frames: Frames in order of time; a single frame is a still scene.
        cell: Work cell, whose arm is shown if frames have its joint positions.
    """
    # Meshcat writes the path of each texture on this machine into comments.
    write_text(path, _SOURCE_COMMENT.sub("", _animate(scene, frames, cell).StaticHtml()))


def _animate(scene: Scene, frames: Sequence[MotionSample], cell: WorkCell) -> Meshcat:
    """Return a viewer with the animation of frames; see `write_recording`."""
    arm_positions = [frame.q for frame in frames if frame.q]
    # Drake logs the address of the viewer, which callers print where it is of use.
    with suppress_drake_log(logging.WARNING):
        meshcat, paths, arm_poses = _build_viewer(scene, cell, arm=bool(arm_positions))
    if len(frames) > 1:
        animation = MeshcatAnimation(FRAMES_PER_SECOND)
        animation.set_loop_mode(MeshcatAnimation.LoopMode.kLoopRepeat)
        animation.set_repetitions(_NUM_REPETITIONS)
        animation.set_autoplay(True)
        numbers = [round(frame.time * FRAMES_PER_SECOND) for frame in frames]
        all_poses = list[dict[str, Pose]]()
        q = arm_positions[0] if arm_positions else ()
        for frame in frames:
            q = frame.q or q  # without joint positions the arm stays where it was
            all_poses.append({**scene.poses, **frame.poses, **arm_poses(q)})
        for name, meshcat_path in paths.items():
            for index, pose in _key_frames([poses[name] for poses in all_poses]):
                animation.SetTransform(numbers[index], meshcat_path, rigid_transform(pose))
        meshcat.SetAnimation(animation)
    return meshcat


def serve_recording(scene: Scene, frames: Sequence[MotionSample], cell: WorkCell) -> Meshcat:
    """Serve frames at the `web_url()` of the returned viewer, while it is kept.

    The arguments are those of `write_recording`.
    """
    return _animate(scene, frames, cell)


ArmPoses = Callable[[Sequence[float]], dict[str, Pose]]
"""Function from the arm's joint positions [rad] to X_TL of its links by name."""


def _build_viewer(
    scene: Scene, cell: WorkCell, *, arm: bool = False
) -> tuple[Meshcat, dict[str, str], ArmPoses]:
    """Return a viewer that shows a scene.

    Args:
        scene: The objects.
        cell: The work cell.
        arm: Whether to show the arm and the fixtures.

    Returns:
        The viewer, the Meshcat path of each object and link by name, and `ArmPoses`.
    """
    builder = DiagramBuilder()
    objects = [(o.name, o.object_class) for o in scene.objects]
    scene_plant = add_scene_plant(builder, objects, scene.support, 0.01, visuals=True)
    plant = scene_plant.plant
    links = {}
    work_cell_model = None
    if arm:
        work_cell_model = add_work_cell(
            plant,
            scene_plant.scene_graph,
            cell.with_support(scene.support),
            compliant=False,
            visuals=True,
        )
        links = {
            f"{plant.GetModelInstanceName(body.model_instance())}::{body.name()}": body
            for body in work_cell_model.bodies
        }
    plant.Finalize()
    meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    visualizer = MeshcatVisualizer.AddToBuilder(
        builder,
        scene_plant.scene_graph,
        meshcat,
        MeshcatVisualizerParams(role=Role.kIllustration, prefix="/scene"),
    )
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    scene_plant.set_poses(plant_context, scene.objects)
    visualizer.ForcedPublish(visualizer.GetMyContextFromRoot(context))

    scale = max(scene.support.size) / _REFERENCE_SIDE
    position = _CAMERA_POSITION_WITH_ARM if arm else _CAMERA_POSITION
    target = _CAMERA_TARGET_WITH_ARM if arm else _CAMERA_TARGET
    meshcat.SetCamera(Meshcat.PerspectiveCamera(fov=_FOV_Y_DEG))
    meshcat.SetCameraPose(scale * np.array(position), scale * np.array(target))
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Lights/SpotLight", "visible", True)
    for lamp, properties in _LIGHTS.items():
        for name, value in properties.items():
            meshcat.SetProperty(f"/Lights/{lamp}/<object>", name, value)
    # Gray, because the background also lights the products from all sides.
    for name, color in (("top_color", [0.50, 0.53, 0.57]), ("bottom_color", [0.70, 0.71, 0.73])):
        meshcat.SetProperty("/Background", name, color)
    inspector = scene_plant.scene_graph.model_inspector()
    frame_ids = {
        name: plant.GetBodyFrameIdOrThrow(body.index())
        for name, body in (scene_plant.bodies | links).items()
    }

    def arm_poses(q: Sequence[float]) -> dict[str, Pose]:
        if work_cell_model is not None:
            set_joint_angles(plant, plant_context, work_cell_model, q)
        return {
            name: pose_from_transform(body.EvalPoseInWorld(plant_context))
            for name, body in links.items()
        }

    paths = {
        name: "/scene/" + inspector.GetName(id).replace("::", "/") for name, id in frame_ids.items()
    }
    return meshcat, paths, arm_poses


def _key_frames(poses: Sequence[Pose]) -> list[tuple[int, Pose]]:
    """Return index and pose of the frames between which a viewer may interpolate.

    An object at rest has a key frame at the start and at the end of its rest.
    """
    keys = [(0, poses[0])]
    for index, pose in enumerate(poses[1:], start=1):
        last, held_pose = keys[-1]
        if _nearly_equal(held_pose, pose):
            continue
        if last < index - 1:
            keys.append((index - 1, held_pose))
        keys.append((index, pose))
    last, held_pose = keys[-1]
    return keys if last == len(poses) - 1 else [*keys, (len(poses) - 1, held_pose)]


def _nearly_equal(a: Pose, b: Pose) -> bool:
    """Return whether two poses may share a key frame."""
    # A small rotation changes the unit quaternion by half its angle; q and -q are equal.
    angle = 2 * min(
        np.linalg.norm(np.subtract(a.quaternion, b.quaternion)),
        np.linalg.norm(np.add(a.quaternion, b.quaternion)),
    )
    return bool(np.linalg.norm(a.p - b.p) < _KEY_FRAME_DISTANCE and angle < _KEY_FRAME_ANGLE)
