"""A recorded episode for the Rerun viewer (`.rrd`).

One time line, `time` [s], with every action after the other. Entities:

    cell                     support, pedestal and fixtures
    robot/LINK gripper/LINK  links with their meshes
    objects/OBJECT           objects with their textured meshes
    tool                     frame G of the tool that the action uses
    belief                   boxes of the objects where the agent believed them
    plan                     path of the tool at the commanded joint positions
    cameras/CAMERA           pose; below it `color`, `depth` and `segmentation`
    signals/...              q, q_commanded, v and torque of the joints, pressure, held object
    events                   moves, phases, results and reasons
"""

# Rerun is typed in part only.
# mypy: allow-untyped-calls

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import trimesh
from numpy.typing import NDArray

from drake_clutter.files import atomic_write
from drake_clutter.recording.formats.episode_timeline import (
    encode_jpeg,
    events,
    start_times,
)
from drake_clutter.recording.formats.visual_bodies import TOOL, EpisodeBodies, VisualBody
from drake_clutter.recording.recorded_episode import CameraImages, RecordedAction, RecordedEpisode
from drake_clutter.scenes.action_samples import ActionSamples

TIMELINE = "time"
"""Name of the time line."""
_APPLICATION = "drake_clutter"
_JOINT_SIGNALS = ("q", "q_commanded", "v", "torque")
_BELIEF_COLOR = (255, 170, 0, 200)
_PLAN_COLOR = (0, 140, 255, 255)
_PLAN_RADIUS = 0.002
"""Radius of the line of the plan [m]."""
_AXIS_LENGTH = 0.06
"""Length of the axes of the tool's frame [m]."""
IMAGE_KINDS = ("color", "depth", "segmentation")
"""Entities of the images of a camera."""
_REFERENCE_SIDE = 0.70
"""Longer side of the support for which the viewer's eye is stated [m]; it scales with it."""
_EYE = np.array([1.2, -1.6, 1.1])
_EYE_TARGET = np.array([-0.15, 0.0, 0.35])
_IMAGE_PLANE_DISTANCE = 0.15
"""Distance at which the viewer shows a camera's image in 3-D [m]."""


def write_rerun(path: Path, episode: RecordedEpisode) -> None:
    """Write an episode.

    Args:
        path: File to write, which appears when it is complete.
        episode: The episode.
    """
    recording = rr.RecordingStream(
        _APPLICATION, recording_id=f"{episode.scene_name}-{episode.seed}-{episode.index}"
    )
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    # Not into the file at once: on a full disk, Rerun's thread ends, and `flush` waits forever.
    memory = recording.memory_recording()
    recording.send_blueprint(_blueprint(episode))
    recording.send_recording_name(f"episode {episode.index}: {episode.scene_name}")
    _Logger(recording, episode).log()
    with atomic_write(path) as temporary:
        temporary.write_bytes(memory.drain_as_bytes())


def _blueprint(episode: RecordedEpisode) -> Any:
    """Return the layout of the viewer."""
    kinds: dict[str, dict[str, None]] = {}
    for action in episode.actions:
        for name, images in action.images.items():
            found = {kind: None for kind in IMAGE_KINDS if _image_array(images, kind) is not None}
            kinds.setdefault(name, {}).update(found)
    cameras = [
        rrb.Tabs(
            *(
                rrb.Spatial2DView(
                    origin=f"cameras/{name}", contents=f"$origin/{kind}", name=f"{name} {kind}"
                )
                for kind in names
            )
        )
        for name, names in kinds.items()
    ]
    plots = [
        rrb.TimeSeriesView(origin="signals/vacuum", name="vacuum [Pa]"),
        rrb.TimeSeriesView(origin="signals/q", name="q [rad]"),
        rrb.TimeSeriesView(origin="signals/torque", name="torque [N m]"),
        rrb.TextLogView(origin="events", name="events"),
    ]
    hidden = [f"- /cameras/{name}/{kind}" for name in kinds for kind in IMAGE_KINDS]
    scale = max(episode.initial_scene.support.size) / _REFERENCE_SIDE
    scene = rrb.Spatial3DView(
        origin="/",
        name="scene",
        contents=["+ /**", *hidden],
        eye_controls=rrb.EyeControls3D(
            position=scale * _EYE, look_target=scale * _EYE_TARGET, eye_up=(0.0, 0.0, 1.0)
        ),
    )
    rows = [rrb.Horizontal(*cameras), *plots] if cameras else plots
    layout = rrb.Horizontal(scene, rrb.Vertical(*rows), column_shares=[3, 2])
    return rrb.Blueprint(layout, collapse_panels=True)


def _image_array(images: CameraImages, kind: str) -> NDArray[Any] | None:
    """Return the images of a kind."""
    return {"color": images.rgb, "depth": images.depth, "segmentation": images.segmentation}[kind]


class _Logger:
    """Writes an episode to a stream."""

    def __init__(self, recording: Any, episode: RecordedEpisode) -> None:
        self._recording = recording
        self._episode = episode
        self._bodies = EpisodeBodies(episode)

    def log(self) -> None:
        """Write everything."""
        self._recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._log_static()
        self._log_poses(np.zeros(1), self._bodies.initial_poses())
        for start, action in zip(start_times(self._episode), self._episode.actions, strict=True):
            self._log_belief(start, action)
            if action.samples is not None:
                self._log_samples(start, action, action.samples)
            for name, images in action.images.items():
                self._log_images(start, name, images)
        for event in events(self._episode):
            self._recording.set_time(TIMELINE, duration=event.time)
            self._recording.log("events", rr.TextLog(event.text, level=event.severity.value))

    def _log_static(self) -> None:
        """Write the meshes, and the names of signals and object indices."""
        for body in self._bodies.bodies:
            for number, mesh in enumerate(body.parts):
                self._recording.log(_part_path(body, number), _mesh(mesh), static=True)
        self._recording.log(TOOL, rr.TransformAxes3D(_AXIS_LENGTH), static=True)
        axes = self._episode.axes
        for signal in _JOINT_SIGNALS:
            names = rr.SeriesLines(names=axes["joints"])
            self._recording.log(f"signals/{signal}", names, static=True)
        if axes["cups"]:
            names = rr.SeriesLines(names=axes["cups"])
            self._recording.log("signals/vacuum", names, static=True)
        context = rr.AnnotationContext(list(enumerate(["other", *axes["objects"]])))
        self._recording.log("cameras", context, static=True)

    def _log_poses(self, time: NDArray[np.float64], poses: dict[str, NDArray[np.float64]]) -> None:
        """Write the poses of bodies at times."""
        for name, rows in poses.items():
            self._send(name, time, _transforms(rows))

    def _log_belief(self, start: float, action: RecordedAction) -> None:
        """Write the boxes of the objects where the agent believed them."""
        scene = self._episode.initial_scene
        names = [name for name in action.believed if name in scene.names]
        corners = [scene[name].object_class.corners for name in names]
        poses = [action.believed[name] for name in names]
        boxes = rr.Boxes3D(
            half_sizes=[np.ptp(c, axis=0) / 2 for c in corners],
            centers=[
                X_TO.apply((c.min(axis=0) + c.max(axis=0))[None] / 2)[0]
                for X_TO, c in zip(poses, corners, strict=True)
            ],
            quaternions=[_scalar_last(np.array(X_TO.quaternion)) for X_TO in poses],
            labels=names,
            colors=_BELIEF_COLOR,
            show_labels=False,
        )
        self._recording.set_time(TIMELINE, duration=start)
        self._recording.log("belief", boxes)

    def _log_samples(self, start: float, action: RecordedAction, samples: ActionSamples) -> None:
        """Write poses, signals and the plan of an action."""
        time = start + samples.time
        self._log_poses(time, self._bodies.poses(samples))
        for signal in _JOINT_SIGNALS:
            self._send_scalars(f"signals/{signal}", time, getattr(samples, signal))
        if samples.vacuum.shape[1]:
            self._send_scalars("signals/vacuum", time, samples.vacuum)
        self._send_scalars("signals/holds_object", time, (samples.held_object >= 0)[:, None])
        if action.tool and np.isfinite(samples.q_commanded).all():
            self._recording.set_time(TIMELINE, duration=start)
            path = self._bodies.commanded_tool_path(samples, action.tool)
            line = rr.LineStrips3D([path], colors=_PLAN_COLOR, radii=_PLAN_RADIUS)
            self._recording.log("plan", line)

    def _log_images(self, start: float, name: str, images: CameraImages) -> None:
        """Write the images of a camera."""
        root = f"cameras/{name}"
        fx, fy, cx, cy = images.intrinsics
        arrays = [_image_array(images, kind) for kind in IMAGE_KINDS]
        height, width = next(array for array in arrays if array is not None).shape[1:3]
        pinhole = rr.Pinhole(
            focal_length=(fx, fy),
            principal_point=(cx, cy),
            width=width,
            height=height,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=_IMAGE_PLANE_DISTANCE,
        )
        self._recording.log(root, pinhole, static=True)
        self._send(root, start + images.time, _transforms(images.X_TC))
        for index, time in enumerate(images.time):
            self._recording.set_time(TIMELINE, duration=start + float(time))
            if images.rgb is not None:
                image = rr.EncodedImage(
                    contents=encode_jpeg(images.rgb[index]), media_type="image/jpeg"
                )
                self._recording.log(f"{root}/color", image)
            if images.depth is not None:
                meter = 1000.0 if images.depth.dtype.kind == "u" else 1.0
                depth = rr.DepthImage(images.depth[index], meter=meter)
                self._recording.log(f"{root}/depth", depth)
            if images.segmentation is not None:
                labels = rr.SegmentationImage(images.segmentation[index])
                self._recording.log(f"{root}/segmentation", labels)

    def _send(self, path: str, time: NDArray[np.float64], columns: Iterable[Any]) -> None:
        """Write columns of an entity at times [s]."""
        index = rr.TimeColumn(TIMELINE, duration=time)
        self._recording.send_columns(path, indexes=[index], columns=columns)

    def _send_scalars(self, path: str, time: NDArray[np.float64], values: NDArray[Any]) -> None:
        """Write several scalars (m, n) of an entity at each time."""
        columns = rr.Scalars.columns(scalars=values.astype(float).ravel())
        self._send(path, time, columns.partition([values.shape[1]] * len(values)))


def _part_path(body: VisualBody, number: int) -> str:
    """Return the entity of a part of a body."""
    return f"{body.name}/part_{number}"


def _scalar_last(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return quaternions (w, x, y, z) as (x, y, z, w)."""
    return np.roll(quaternions, -1, axis=-1)


def _transforms(poses: NDArray[np.float64]) -> Sequence[Any]:
    """Return the columns of poses (m, 7)."""
    columns: Sequence[Any] = rr.Transform3D.columns(
        translation=poses[:, 4:], quaternion=_scalar_last(poses[:, :4])
    )
    return columns


def _mesh(mesh: trimesh.Trimesh) -> Any:
    """Return a mesh with its texture or color."""
    visual: Any = mesh.visual
    material = visual.material
    texture = material.baseColorTexture
    uv = visual.uv if texture is not None else None
    return rr.Mesh3D(
        vertex_positions=mesh.vertices,
        triangle_indices=mesh.faces,
        vertex_normals=mesh.vertex_normals,
        # The origin of texture coordinates is the lower left corner in trimesh.
        vertex_texcoords=None if uv is None else np.column_stack([uv[:, 0], 1 - uv[:, 1]]),
        albedo_texture=None if texture is None else np.asarray(texture.convert("RGB")),
        albedo_factor=None if texture is not None else material.baseColorFactor,
    )
