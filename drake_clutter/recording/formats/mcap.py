"""A recorded episode as an MCAP file with Foxglove's Protobuf schemas.

Times are those of the time line of the episode, from 0. Topics:

    /tf                       foxglove.FrameTransforms  links, objects, tool and cameras in T
    /scene                    foxglove.SceneUpdate      meshes, once, in the frames of their bodies
    /belief                   foxglove.SceneUpdate      boxes where the agent believed objects
    /plan                     foxglove.SceneUpdate      path of the tool at the commanded joints
    /joint_states             foxglove.JointStates      q, v and torque
    /joint_commands           foxglove.JointStates      q, v and torque, commanded
    /gripper                  JSON                      pressure of each cup, held object, joints
    /events                   foxglove.Log              moves, phases, results and reasons
    /cameras/NAME/calibration foxglove.CameraCalibration
    /cameras/NAME/color       foxglove.CompressedImage  JPEG
    /cameras/NAME/depth       foxglove.RawImage         16UC1 [mm] or 32FC1 [m]
    /cameras/NAME/segmentation foxglove.RawImage        mono8: index of the object + 1
"""

# mcap and Protobuf are typed in part only.
# mypy: allow-untyped-calls

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.ModelPrimitive_pb2 import ModelPrimitive
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema
from numpy.typing import NDArray

from drake_clutter.files import atomic_write
from drake_clutter.mesh_file import Y_UP_TO_Z_UP
from drake_clutter.recording.formats.episode_timeline import encode_jpeg, events, start_times
from drake_clutter.recording.formats.visual_bodies import WORLD, EpisodeBodies, VisualBody
from drake_clutter.recording.recorded_episode import CameraImages, RecordedAction, RecordedEpisode
from drake_clutter.scenes.action_samples import ActionSamples

ROOT_FRAME = "T"
"""Name of the frame in which all transforms are given: the support's, z up."""
GRIPPER_TOPIC = "/gripper"
_LIBRARY = "drake_clutter"
_BELIEF_COLOR = (1.0, 0.67, 0.0, 0.5)
_PLAN_COLOR = (0.0, 0.55, 1.0, 1.0)
_PLAN_THICKNESS = 0.004
"""Thickness of the line of the plan [m]."""
_LEVELS = {"INFO": Log.INFO, "WARNING": Log.WARNING, "ERROR": Log.ERROR}
_NUMBERS = {"type": "object", "additionalProperties": {"type": "number"}}
"""JSON schema of numbers by name."""
_GRIPPER_SCHEMA = {
    "title": "drake_clutter.Gripper",
    "type": "object",
    "properties": {
        "vacuum": _NUMBERS | {"description": "pressure of each cup below the ambient one [Pa]"},
        "joints": _NUMBERS | {"description": "positions of the gripper's joints [m, rad]"},
        "tool": {"type": "string", "description": "tool that is commanded to hold"},
        "held_object": {"type": "string"},
    },
}


def write_mcap(path: Path, episode: RecordedEpisode) -> None:
    """Write an episode.

    Args:
        path: File to write, which appears when it is complete.
        episode: The episode.
    """
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library=_LIBRARY)
        _EpisodeWriter(writer, episode).write()
        writer.finish()


class _EpisodeWriter:
    """Writes the messages of an episode."""

    def __init__(self, writer: Writer, episode: RecordedEpisode) -> None:
        self._writer = writer
        self._episode = episode
        self._axes = episode.axes
        self._bodies = EpisodeBodies(episode)
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def write(self) -> None:
        """Write everything."""
        episode = self._episode
        info = {name: str(getattr(episode, name)) for name in ("scene_name", "policy", "seed")}
        self._writer.add_metadata("episode", info | {"termination": episode.termination})
        self._send(0.0, "/tf", _frames(0.0, self._bodies.initial_poses(), 0))
        entities = [_mesh_entity(body) for body in self._bodies.bodies]
        self._send(0.0, "/scene", SceneUpdate(entities=entities))
        for start, action in zip(start_times(episode), episode.actions, strict=True):
            self._write_belief(start, action)
            if action.samples is not None:
                self._write_samples(start, action, action.samples)
            for name, images in action.images.items():
                self._write_images(start, name, images)
        for event in events(episode):
            level = _LEVELS[event.severity.value]
            log = Log(
                timestamp=_timestamp(event.time), level=level, message=event.text, name=_LIBRARY
            )
            self._send(event.time, "/events", log)

    def _write_belief(self, start: float, action: RecordedAction) -> None:
        """Write the boxes of the objects where the agent believed them."""
        scene = self._episode.initial_scene
        cubes = list[CubePrimitive]()
        for name, X_TO in action.believed.items():
            if name in scene.names:
                corners = scene[name].object_class.corners
                center = X_TO.apply((corners.min(axis=0) + corners.max(axis=0))[None] / 2)[0]
                cube = CubePrimitive(color=_fields("rgba", _BELIEF_COLOR))
                _set_pose(cube.pose, np.array([*X_TO.quaternion, *center]))
                _set_vector(cube.size, np.ptp(corners, axis=0))
                cubes.append(cube)
        entity = SceneEntity(frame_id=ROOT_FRAME, id="belief", cubes=cubes)
        self._send(start, "/belief", SceneUpdate(entities=[entity]))

    def _write_samples(self, start: float, action: RecordedAction, samples: ActionSamples) -> None:
        """Write poses, joints, gripper and the plan of an action."""
        if action.tool and np.isfinite(samples.q_commanded).all():
            points = self._bodies.commanded_tool_path(samples, action.tool)
            line = LinePrimitive(
                type=LinePrimitive.LINE_STRIP,
                thickness=_PLAN_THICKNESS,
                color=_fields("rgba", _PLAN_COLOR),
                points=[_fields("xyz", point) for point in points],
            )
            line.pose.orientation.w = 1.0
            entity = SceneEntity(frame_id=ROOT_FRAME, id="plan", lines=[line])
            self._send(start, "/plan", SceneUpdate(entities=[entity]))
        poses = self._bodies.poses(samples)
        measured = (samples.q, samples.v, samples.torque)
        commanded = (samples.q_commanded, samples.v_commanded, samples.torque_commanded)
        for row in range(len(samples)):
            time = start + float(samples.time[row])
            self._send(time, "/tf", _frames(time, poses, row))
            self._send(time, "/joint_states", self._joints(time, measured, row))
            self._send(time, "/joint_commands", self._joints(time, commanded, row))
            self._send_json(time, GRIPPER_TOPIC, _GRIPPER_SCHEMA, self._gripper(samples, row))

    def _joints(self, time: float, state: Sequence[NDArray[np.float64]], row: int) -> Any:
        """Return positions, velocities and torques of the joints at a row."""
        q, v, torque = (values[row].tolist() for values in state)
        joints = [
            JointState(name=name, position=q[k], velocity=v[k], effort=torque[k])
            for k, name in enumerate(self._axes["joints"])
        ]
        return JointStates(timestamp=_timestamp(time), joints=joints)

    def _gripper(self, samples: ActionSamples, row: int) -> dict[str, Any]:
        """Return the state of the gripper at a row."""
        tool = int(samples.tool_commanded[row])
        held = int(samples.held_object[row])
        return {
            "vacuum": _known(self._axes["cups"], samples.vacuum[row]),
            "joints": _known(self._axes["gripper_joints"], samples.gripper[row]),
            "tool": self._axes["tools"][tool] if tool >= 0 else "",
            "held_object": self._axes["objects"][held] if held >= 0 else "",
        }

    def _write_images(self, start: float, name: str, images: CameraImages) -> None:
        """Write the images of a camera, and its pose at each of them."""
        topic = f"/cameras/{name}"
        frame = f"cameras/{name}"
        for index in range(len(images.time)):
            time = start + float(images.time[index])
            stamp = {"timestamp": _timestamp(time), "frame_id": frame}
            self._send(time, "/tf", _frames(time, {frame: images.X_TC}, index))
            if images.rgb is not None:
                data = encode_jpeg(images.rgb[index])
                image = CompressedImage(data=data, format="jpeg", **stamp)
                self._send(time, f"{topic}/color", image)
            for kind, image in _raw_images(images, index):
                raw = RawImage(
                    width=image.shape[1],
                    height=image.shape[0],
                    encoding=_ENCODINGS[image.dtype.name],
                    step=image.strides[0],
                    data=image.tobytes(),
                    **stamp,
                )
                self._send(time, f"{topic}/{kind}", raw)
            self._send(time, f"{topic}/calibration", _calibration(images, stamp))

    def _send(self, time: float, topic: str, message: Any) -> None:
        """Write a Protobuf message."""
        if topic not in self._channels:
            kind = type(message).DESCRIPTOR.full_name
            if kind not in self._schemas:
                self._schemas[kind] = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(
                topic, "protobuf", self._schemas[kind]
            )
        self._add(time, topic, message.SerializeToString(deterministic=True))

    def _send_json(
        self, time: float, topic: str, schema: dict[str, Any], message: dict[str, Any]
    ) -> None:
        """Write a JSON message."""
        if topic not in self._channels:
            number = self._writer.register_schema(
                schema["title"], "jsonschema", json.dumps(schema).encode()
            )
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        self._add(time, topic, json.dumps(message).encode())

    def _add(self, time: float, topic: str, data: bytes) -> None:
        nanoseconds = round(1e9 * time)
        self._writer.add_message(
            self._channels[topic], log_time=nanoseconds, publish_time=nanoseconds, data=data
        )


_ENCODINGS = {"uint8": "mono8", "uint16": "16UC1", "float32": "32FC1"}
"""Encoding of a `RawImage` by the type of its pixels."""


def _raw_images(images: CameraImages, index: int) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield name and pixels of the images of a number that are no color images."""
    if images.depth is not None:
        yield "depth", np.ascontiguousarray(images.depth[index])
    if images.segmentation is not None:
        yield "segmentation", np.ascontiguousarray(images.segmentation[index])


def _calibration(images: CameraImages, stamp: dict[str, Any]) -> Any:
    """Return the calibration of a camera without distortion."""
    arrays = (images.rgb, images.depth, images.segmentation)
    height, width = next(a for a in arrays if a is not None).shape[1:3]
    fx, fy, cx, cy = images.intrinsics
    return CameraCalibration(
        width=width,
        height=height,
        K=[fx, 0, cx, 0, fy, cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[fx, 0, cx, 0, 0, fy, cy, 0, 0, 0, 1, 0],
        **stamp,
    )


def _known(names: Sequence[str], values: NDArray[np.float64]) -> dict[str, float]:
    """Return numbers by name; JSON has no others than finite ones."""
    return {
        name: float(value) for name, value in zip(names, values, strict=True) if np.isfinite(value)
    }


def _timestamp(time: float) -> Timestamp:
    """Return a time [s] as a Protobuf message."""
    seconds, nanoseconds = divmod(round(1e9 * time), 10**9)
    return Timestamp(seconds=seconds, nanos=nanoseconds)


def _fields(names: str, values: Sequence[float] | NDArray[np.float64]) -> dict[str, float]:
    """Return numbers by names of one letter."""
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _set_vector(message: Any, values: NDArray[np.float64]) -> None:
    """Set x, y and z of a message."""
    message.x, message.y, message.z = (float(value) for value in values)


def _set_pose(message: Any, pose: NDArray[np.float64]) -> None:
    """Set position and orientation of a message by a pose as `POSE_COLUMNS`."""
    _set_vector(message.position, pose[4:])
    w, x, y, z = (float(value) for value in pose[:4])
    message.orientation.w, message.orientation.x = w, x
    message.orientation.y, message.orientation.z = y, z


def _frames(time: float, poses: dict[str, NDArray[np.float64]], row: int) -> Any:
    """Return the poses of frames in T at a row."""
    transforms = [
        FrameTransform(
            timestamp=_timestamp(time),
            parent_frame_id=ROOT_FRAME,
            child_frame_id=name,
            translation=_fields("xyz", rows[row, 4:]),
            rotation=_fields("wxyz", rows[row, :4]),
        )
        for name, rows in poses.items()
    ]
    return FrameTransforms(transforms=transforms)


def _mesh_entity(body: VisualBody) -> Any:
    """Return the meshes of a body, attached to its frame."""
    scene = trimesh.Scene()
    for mesh in body.parts:
        scene.add_geometry(mesh)
    # The y axis of glTF points up; viewers turn it to z.
    scene.apply_transform(np.linalg.inv(Y_UP_TO_Z_UP))
    model = ModelPrimitive(
        data=scene.export(file_type="glb"),
        media_type="model/gltf-binary",
        scale=_fields("xyz", (1.0, 1.0, 1.0)),
    )
    model.pose.orientation.w = 1.0
    return SceneEntity(
        frame_id=ROOT_FRAME if body.name == WORLD else body.name,
        id=body.name,
        frame_locked=True,
        models=[model],
    )
