"""Rerun and MCAP files: what their readers find in them, against the recorded numbers."""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import errno
import io
import json
import os
import resource
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from PIL import Image
from pydrake.geometry import Box, Mesh
from recorded_episodes import (
    HOME,
    PRESSURE,
    SCENE,
    image_level,
    read_rerun,
    synthetic_episode,
)

from drake_clutter.catalog import load_catalog
from drake_clutter.recording.formats.episode_timeline import events, start_times
from drake_clutter.recording.formats.mcap import write_mcap
from drake_clutter.recording.formats.rerun import write_rerun
from drake_clutter.recording.formats.visual_bodies import shape_meshes
from drake_clutter.recording.hdf5_file import load_episode
from drake_clutter.recording.recorded_episode import RecordedEpisode
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import ActionSamples

VERSION_1 = Path(__file__).parent / "data" / "trajectory_v1.h5"
STARTS = (1.0, 4.0, 5.0)
"""Times of the actions: of 2 s, of none, of 2 s, with pauses of 1 s."""
Rows = dict[str, NDArray[np.float64]]
FOXGLOVE_FIELDS = {
    "foxglove.FrameTransforms": {"transforms"},
    "foxglove.SceneUpdate": {"deletions", "entities"},
    "foxglove.JointStates": {"timestamp", "joints"},
    "foxglove.Log": {"timestamp", "level", "message", "name", "file", "line"},
    "foxglove.CompressedImage": {"timestamp", "frame_id", "data", "format"},
    "foxglove.RawImage": {"timestamp", "frame_id", "width", "height", "encoding", "step", "data"},
    "foxglove.CameraCalibration": {
        *("timestamp", "frame_id", "width", "height"),
        *("distortion_model", "D", "K", "R", "P"),
    },
}
"""Fields of each schema, see https://docs.foxglove.dev/docs/sdk/schemas."""


@pytest.fixture(scope="module")
def episode() -> RecordedEpisode:
    return synthetic_episode(cameras={"overhead": 2})


@pytest.fixture(scope="module")
def samples(episode: RecordedEpisode) -> ActionSamples:
    samples = episode.actions[0].samples
    assert samples is not None
    return samples


@pytest.fixture(scope="module")
def flange(episode: RecordedEpisode, samples: ActionSamples) -> NDArray[np.float64]:
    """X_TF of the first action by the robot's kinematics. Shape (m, 4, 4)."""
    robot = load_robot(episode.cell.robot)
    X_TB = robot.X_TB.GetAsMatrix4()
    return np.array([X_TB @ robot.forward_kinematics(q) for q in samples.q])


@pytest.fixture(scope="module")
def rrd(
    episode: RecordedEpisode, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[tuple[float, dict[str, Any]]]]:
    """Rows of each entity: time [s], NaN if static, and values by component, in order of time."""
    path = tmp_path_factory.mktemp("rerun") / "episode.rrd"
    write_rerun(path, episode)
    assert [entry.name for entry in path.parent.iterdir()] == ["episode.rrd"]
    return read_rerun(path)


@pytest.fixture(scope="module")
def mcap_file(episode: RecordedEpisode, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """MCAP file of the episode."""
    path = tmp_path_factory.mktemp("mcap") / "episode.mcap"
    write_mcap(path, episode)
    assert [entry.name for entry in path.parent.iterdir()] == ["episode.mcap"]
    return path


@pytest.fixture(scope="module")
def mcap(mcap_file: Path) -> dict[str, list[tuple[float, Any]]]:
    """Messages of each topic with their times [s], in order of time."""
    messages = defaultdict(list)
    with mcap_file.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            decoded = (
                json.loads(message.data)
                if channel.message_encoding == "json"
                else DecoderFactory().decoder_for("protobuf", schema)(message.data)
            )
            messages[channel.topic].append((message.log_time / 1e9, decoded))
    return messages


def within(rows: list[tuple[float, Any]], first: float, last: float) -> list[tuple[float, Any]]:
    """Return the rows of an interval of time [s]."""
    return [row for row in rows if first - 1e-6 <= row[0] <= last + 1e-6]


def rerun_poses(rows: list[tuple[float, dict[str, Any]]]) -> tuple[list[float], Any, Any]:
    """Return times, translations and quaternions (x, y, z, w)."""
    return (
        [time for time, _ in rows],
        np.array([row["Transform3D:translation"][0] for _, row in rows]),
        np.array([row["Transform3D:quaternion"][0] for _, row in rows]),
    )


def test_actions_follow_each_other_with_their_reasons(episode: RecordedEpisode) -> None:
    assert tuple(start_times(episode)) == STARTS
    found = [(event.time, event.text, event.severity.value) for event in events(episode)]
    assert found[0] == (1.0, "1. gelatin_box -> tray", "INFO")
    assert found[1] == (1.0, "1. approach", "INFO")
    # The middle half of 2 s, at 20 Hz, begins after 0.5 s.
    assert found[2][0] == pytest.approx(1.55)
    assert found[2][1:] == ("1. carry", "INFO")
    assert (3.0, "1. placed", "INFO") in found
    assert (4.0, "2. not planned (no grasp; large_marker)", "WARNING") in found
    assert (7.0, "3. dropped (pudding_box came off)", "ERROR") in found
    assert found[-1] == (8.0, "end: found", "INFO")


def test_rerun_shows_arm_and_objects_where_they_were(
    rrd: dict[str, Any], samples: ActionSamples, flange: NDArray[np.float64]
) -> None:
    rows = within(rrd["/gripper/body"], 1.0, 3.0)
    times, translations, quaternions = rerun_poses(rows)
    assert times == pytest.approx((1.0 + samples.time).tolist())
    assert translations == pytest.approx(flange[:, :3, 3], abs=1e-6)
    rotations = trimesh.transformations.quaternion_matrix(np.roll(quaternions[7], 1))[:3, :3]
    assert rotations == pytest.approx(flange[7, :3, :3], abs=1e-6)
    _, translations, quaternions = rerun_poses(within(rrd["/objects/gelatin_box"], 1.0, 3.0))
    assert translations == pytest.approx(samples.X_TO[:, 1, 4:], abs=1e-6)
    assert np.roll(quaternions, 1, axis=1) == pytest.approx(samples.X_TO[:, 1, :4], abs=1e-6)
    time, _ = rrd["/robot/wrist_3"][0]
    assert time == 0.0, "the arm is shown at home before the first action"


def test_rerun_holds_signals_belief_plan_images_and_events(
    rrd: dict[str, Any], episode: RecordedEpisode, samples: ActionSamples
) -> None:
    q = [row["Scalars:scalars"] for time, row in within(rrd["/signals/q"], 1.0, 3.0)]
    assert np.array(q) == pytest.approx(samples.q)
    vacuum = [row["Scalars:scalars"] for _, row in within(rrd["/signals/vacuum"], 1.0, 3.0)]
    assert np.array(vacuum) == pytest.approx(samples.vacuum)
    assert np.max(vacuum) == PRESSURE
    beliefs = [(time, row["Boxes3D:labels"]) for time, row in rrd["/belief"]]
    assert beliefs == [(start, list(SCENE.names)) for start in STARTS]
    boxes = rrd["/belief"][0][1]
    sizes = np.ptp(SCENE["pudding_box"].object_class.corners, axis=0)
    assert boxes["Boxes3D:half_sizes"][0] == pytest.approx(sizes / 2)
    assert [time for time, _ in rrd["/plan"]] == [STARTS[0], STARTS[2]]
    (strip,) = rrd["/plan"][0][1]["LineStrips3D:strips"]
    assert len(strip) == len(samples)
    colors = within(rrd["/cameras/overhead/color"], 1.0, 3.0)
    assert len(colors) == 21
    (blob,) = colors[4][1]["EncodedImage:blob"]
    red = np.asarray(Image.open(io.BytesIO(bytes(blob)))).mean(axis=(0, 1))[0]
    assert red == pytest.approx(image_level(4), abs=3)
    texts = [row["TextLog:text"][0] for _, row in rrd["/events"]]
    assert sorted(texts) == sorted(event.text for event in events(episode))
    assert "/objects/gelatin_box/part_0" in rrd, "the mesh"


def test_mcap_schemas_are_those_that_foxglove_documents(mcap_file: Path) -> None:
    """Foxglove recognizes a schema by its name; the fields are those of its reference."""
    with mcap_file.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    found = dict[str, str]()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        found[channel.topic] = schema.name
        if channel.topic == "/gripper":
            assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
            assert json.loads(schema.data)["title"] == schema.name
            continue
        assert channel.message_encoding == schema.encoding == "protobuf"
        files = FileDescriptorSet.FromString(schema.data).file
        # The descriptors are complete: a reader needs no other file.
        assert {name for f in files for name in f.dependency} <= {f.name for f in files}
        messages = {f"{f.package}.{m.name}": m for f in files for m in f.message_type}
        fields = {field.name for field in messages[schema.name].field}
        assert fields == FOXGLOVE_FIELDS[schema.name]
    camera = "/cameras/overhead"
    assert found == {
        "/tf": "foxglove.FrameTransforms",
        **dict.fromkeys(("/scene", "/belief", "/plan"), "foxglove.SceneUpdate"),
        **dict.fromkeys(("/joint_states", "/joint_commands"), "foxglove.JointStates"),
        "/gripper": "drake_clutter.Gripper",
        "/events": "foxglove.Log",
        f"{camera}/color": "foxglove.CompressedImage",
        f"{camera}/depth": "foxglove.RawImage",
        f"{camera}/segmentation": "foxglove.RawImage",
        f"{camera}/calibration": "foxglove.CameraCalibration",
    }


def test_mcap_messages_can_be_shown(mcap: dict[str, Any]) -> None:
    """Frames are known, images have the size of the calibration, and stamps are the log times."""
    frames = {"T"}
    for time, message in mcap["/tf"]:
        for transform in message.transforms:
            frames.add(transform.child_frame_id)
            assert transform.timestamp.ToNanoseconds() == round(1e9 * time)
            q = transform.rotation
            assert q.w**2 + q.x**2 + q.y**2 + q.z**2 == pytest.approx(1.0)
    for topic in ("/scene", "/belief", "/plan"):
        for _, update in mcap[topic]:
            assert {entity.frame_id for entity in update.entities} <= frames
    camera = "/cameras/overhead"
    for (time, color), (_, depth), (_, labels), (_, calibration) in zip(
        *(mcap[f"{camera}/{kind}"] for kind in ("color", "depth", "segmentation", "calibration")),
        strict=True,
    ):
        messages = (color, depth, labels, calibration)
        assert {message.frame_id for message in messages} == {"cameras/overhead"} <= frames
        assert {m.timestamp.ToNanoseconds() for m in messages} == {round(1e9 * time)}
        size = calibration.width, calibration.height
        image = Image.open(io.BytesIO(color.data))
        assert (color.format, image.format, image.size) == ("jpeg", "JPEG", size)
        for raw, encoding, pixel in ((depth, "16UC1", 2), (labels, "mono8", 1)):
            assert (raw.encoding, raw.width, raw.height) == (encoding, *size)
            assert (raw.step, len(raw.data)) == (pixel * size[0], pixel * size[0] * size[1])
        assert [len(calibration.K), len(calibration.R), len(calibration.P)] == [9, 9, 12]


def test_mcap_holds_frames_joints_gripper_and_events(
    mcap: dict[str, Any],
    episode: RecordedEpisode,
    samples: ActionSamples,
    flange: NDArray[np.float64],
) -> None:
    frames = [
        {transform.child_frame_id: transform for transform in message.transforms}
        for _, message in within(mcap["/tf"], 1.0, 3.0)
    ]
    bodies = [found for found in frames if "gripper/body" in found]
    assert len(bodies) == len(samples)
    for row, found in enumerate(bodies):
        p = found["gripper/body"].translation
        assert (p.x, p.y, p.z) == pytest.approx(flange[row, :3, 3])
        X = found["objects/gelatin_box"]
        assert X.parent_frame_id == "T"
        expected = samples.X_TO[row, 1]
        rotation = X.rotation
        assert (rotation.w, rotation.x, rotation.y, rotation.z) == pytest.approx(expected[:4])
    first = {t.child_frame_id: t for t in mcap["/tf"][0][1].transforms}
    assert set(first) > {"robot/wrist_3", "objects/large_marker"}
    states = within(mcap["/joint_states"], 1.0, 3.0)
    assert [[joint.position for joint in m.joints] for _, m in states] == samples.q.tolist()
    assert [joint.effort for joint in states[0][1].joints] == samples.torque[0].tolist()
    commands = within(mcap["/joint_commands"], 1.0, 3.0)
    assert [joint.position for joint in commands[9][1].joints] == samples.q_commanded[9].tolist()
    assert states[0][1].joints[0].name == episode.axes["joints"][0]
    gripper = [message for _, message in within(mcap["/gripper"], 1.0, 3.0)]
    assert [m["vacuum"]["large"] for m in gripper] == samples.vacuum[:, 0].tolist()
    assert gripper[20]["held_object"] == "gelatin_box"
    assert gripper[20]["tool"] == "large"
    assert gripper[0]["held_object"] == ""
    logs = [(time, message.message, message.level) for time, message in mcap["/events"]]
    assert logs == [(e.time, e.text, levels()[e.severity.value]) for e in events(episode)]


def levels() -> dict[str, int]:
    """Values of `Log.Level`."""
    return {"INFO": 2, "WARNING": 3, "ERROR": 4}


def test_mcap_holdsshape_meshes_images_and_beliefs(
    mcap: dict[str, Any], episode: RecordedEpisode
) -> None:
    ((time, update),) = mcap["/scene"]
    assert time == 0.0
    entities = {entity.id: entity for entity in update.entities}
    assert entities["cell"].frame_id == "T"
    marker = entities["objects/large_marker"]
    assert marker.frame_id == "objects/large_marker"
    scene = trimesh.load_scene(io.BytesIO(marker.models[0].data), file_type="glb")
    mesh = scene.to_mesh()
    # Viewers turn the y axis of glTF to z, a quarter of a turn about x.
    turned = np.column_stack([mesh.vertices[:, 0], -mesh.vertices[:, 2], mesh.vertices[:, 1]])
    corners = SCENE["large_marker"].object_class.corners
    assert np.ptp(turned, axis=0) == pytest.approx(np.ptp(corners, axis=0), abs=1e-3)
    images = episode.actions[0].images["overhead"]
    assert images.depth is not None
    depth = mcap["/cameras/overhead/depth"][0][1]
    assert (depth.encoding, depth.step, depth.frame_id) == ("16UC1", 96, "cameras/overhead")
    assert depth.data == images.depth[0].tobytes()
    calibration = mcap["/cameras/overhead/calibration"][0][1]
    assert list(calibration.K) == [50.0, 0.0, 23.5, 0.0, 50.0, 15.5, 0.0, 0.0, 1.0]
    color = mcap["/cameras/overhead/color"][5][1]
    red = np.asarray(Image.open(io.BytesIO(color.data))).mean(axis=(0, 1))[0]
    assert red == pytest.approx(image_level(5), abs=3)
    believed = [len(update.entities[0].cubes) for _, update in mcap["/belief"]]
    assert believed == [3, 3, 3]


def test_the_plan_starts_at_the_tool_at_home(
    mcap: dict[str, Any], episode: RecordedEpisode
) -> None:
    robot = load_robot(episode.cell.robot)
    points = mcap["/plan"][0][1].entities[0].lines[0].points
    # The commands are 1 mrad beside the measured joints.
    X_TF = robot.X_TB.GetAsMatrix4() @ robot.forward_kinematics(HOME + 0.001)
    tool = episode.cell.gripper.tools["large"]
    p_TG = (X_TF @ tool.X_FG.GetAsMatrix4())[:3, 3]
    assert (points[0].x, points[0].y, points[0].z) == pytest.approx(p_TG, abs=1e-6)


def test_meshes_of_shapes_and_files(tmp_path: Path) -> None:
    (box,) = shape_meshes(Box(0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 1.0))
    assert box.extents == pytest.approx([0.1, 0.2, 0.3])
    visual: Any = box.visual
    assert visual.material.baseColorFactor.tolist() == [255, 0, 0, 255]
    trimesh.creation.box([0.1, 0.2, 0.3]).export(tmp_path / "box.gltf")
    (mesh,) = shape_meshes(Mesh(str(tmp_path / "box.gltf"), 2.0), (0.0, 1.0, 0.0, 1.0))
    assert mesh.extents == pytest.approx([0.2, 0.6, 0.4]), "the y axis of glTF points up"


def test_a_full_disk_ends_a_file_for_rerun(episode: RecordedEpisode, tmp_path: Path) -> None:
    """Rerun's own writer waits forever."""
    path = tmp_path / "episode.rrd"
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=os.strerror(errno.EFBIG)) as full:
            write_rerun(path, episode)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert full.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


def test_an_episode_of_version_1_is_shown_without_what_it_does_not_hold(tmp_path: Path) -> None:
    episode = load_episode(VERSION_1, load_catalog())
    write_rerun(tmp_path / "episode.rrd", episode)
    rows = Counter(
        {name: len(found) for name, found in read_rerun(tmp_path / "episode.rrd").items()}
    )
    samples = episode.actions[0].samples
    assert samples is not None
    assert rows["/robot/wrist_3"] == 1 + len(samples)
    assert "/plan" not in rows
    write_mcap(tmp_path / "episode.mcap", episode)
    with (tmp_path / "episode.mcap").open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=["/gripper"]):
            assert json.loads(message.data, parse_constant=pytest.fail)["vacuum"] == {}
