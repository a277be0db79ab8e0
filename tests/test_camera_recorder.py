"""Recorded images against the geometry of scene, arm and cameras."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, rng, scene_of
from pydrake.math import RigidTransform

from drake_clutter.cell.work_cell import WorkCell, load_cell
from drake_clutter.files import InputError
from drake_clutter.recording.camera_recorder import (
    ARM_LABEL,
    CameraChannel,
    CameraRecorder,
    find_cameras,
    image_indices,
    oblique_camera,
)
from drake_clutter.recording.randomization import Variation
from drake_clutter.resources import resource_path
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import Scene

CELL_FILES = sorted(resource_path("models/cells").glob("*.yaml"))
SCENE = scene_of(
    resting("cracker_box", xy=(0.1, 0.0), name="box"),  # 230 mm x 160 mm, 60 mm high
    resting("master_chef_can", xy=(-0.2, -0.2), name="can"),
)
UNVARIED = Variation()
LIP = 0.2223
"""Distance of the large cup's lip from the flange [m]."""


def samples_of(scene: Scene, cell: WorkCell, offsets: np.ndarray) -> ActionSamples:
    """Return samples 0.1 s apart of an arm at home and a box that is offset along x [m]."""
    m = len(offsets)
    q = np.tile(np.array(cell.robot.home), (m, 1))
    X_TO = np.tile([[*o.X_TO.quaternion, *o.X_TO.translation] for o in scene.objects], (m, 1, 1))
    X_TO[:, 0, 4] += offsets
    none = np.full(m, -1, np.int16)
    return ActionSamples(
        time=np.arange(m) / 10,
        q=q,
        v=0 * q,
        torque=0 * q,
        q_commanded=q,
        v_commanded=0 * q,
        torque_commanded=0 * q,
        gripper=np.zeros((m, cell.gripper.num_joints)),
        gripper_commanded=np.zeros((m, 0)),
        tool_commanded=none,
        vacuum=np.zeros((m, 2)),
        X_TG=np.zeros((m, 7)),
        held_object=none,
        phase=none,
        tool_contact=np.zeros(m, bool),
        object_contact=np.zeros(m, bool),
        X_TO=X_TO,
        time_step=np.nan,
        movable=scene.names,
    )


def make_recorder(
    names: Sequence[str], scene: Scene = SCENE, variation: Variation = UNVARIED
) -> CameraRecorder:
    """Return a recorder of all channels."""
    cameras = find_cameras(DEFAULT_CELL, names)
    return CameraRecorder(DEFAULT_CELL, scene, cameras, [*CameraChannel], variation, rng())


def test_images_show_the_recorded_poses() -> None:
    recorder = make_recorder(["overhead"])
    images = recorder.record(samples_of(SCENE, DEFAULT_CELL, np.array([0.0, 0.1])), 10)["overhead"]
    assert images.depth is not None
    assert images.segmentation is not None
    assert images.rgb is not None
    assert images.rgb.shape == (2, 480, 640, 3)
    assert images.time.tolist() == [0.0, 0.1]
    camera = DEFAULT_CELL.camera
    for k, x in enumerate((0.1, 0.2)):
        column, row = np.rint(camera.project(np.array([[x, 0.0, 0.06]]))[0]).astype(int)
        assert images.depth[k, row, column] == 1540  # the camera is 1.6 m above the floor
        pixels = (images.segmentation[k] == 1) & (images.depth[k] == 1540)  # its upper face
        sides = np.array([0.16, 0.23]) * camera.focal_length / 1.54
        assert np.ptp(np.argwhere(pixels), axis=0) + 1 == pytest.approx(sides, abs=1)
        assert pixels.sum() == (np.ptp(np.argwhere(pixels), axis=0) + 1).prod()
        assert np.argwhere(pixels).mean(axis=0) == pytest.approx([row, column], abs=1)
    # Nothing else has moved.
    moved = (images.segmentation[0] == 1) | (images.segmentation[1] == 1)
    assert (images.depth[0] == images.depth[1])[~moved].all()


def test_wrist_camera_moves_with_the_flange() -> None:
    recorder = make_recorder(["wrist"])
    samples = samples_of(SCENE, DEFAULT_CELL, np.zeros(2))
    q = samples.q + np.array([[0.0] * 6, [0.2, -0.1, 0.1, 0.3, 0.2, 1.0]])
    images = recorder.record(replace(samples, q=q), 10)["wrist"]
    assert images.segmentation is not None
    assert images.depth is not None
    robot = load_robot(DEFAULT_CELL.robot)
    for k in range(2):
        X_TF = robot.X_TB @ RigidTransform(robot.forward_kinematics(q[k]))
        X_TC = X_TF @ DEFAULT_CELL.wrist_camera.X_TC
        assert images.X_TC[k, 4:] == pytest.approx(X_TC.translation(), abs=1e-6)
        x, y, z = X_TC.inverse() @ X_TF @ np.array([0.0, 0.0, LIP])
        fx, fy, cx, cy = images.intrinsics
        column, row = round(cx + fx * x / z), round(cy + fy * y / z)
        assert images.segmentation[k, row, column] == ARM_LABEL
        # The ray to the lip's center meets the cup, of radius 12.5 mm, on its side before. The
        # camera is 100 mm beside the cup's axis.
        assert 1 - 12.5 / 100 <= images.depth[k, row, column] / (1000 * z) < 1


@pytest.mark.parametrize(
    ("rate", "expected"),
    [(10, [0, 13, 25, 38, 50, 51]), (125, list(range(52))), (1, [0, 51])],
)
def test_images_are_taken_at_the_first_sample_of_each_period(
    rate: float, expected: list[int]
) -> None:
    assert image_indices(np.arange(52) / 125, rate).tolist() == expected


def test_rounding_of_time_does_not_delay_an_image() -> None:
    assert image_indices(np.cumsum(np.full(300, 0.1)) - 0.1, 10).tolist() == list(range(300))


@pytest.mark.parametrize("path", CELL_FILES, ids=lambda path: path.stem)
def test_oblique_camera_sees_robot_and_support(path: Path) -> None:
    cell = load_cell(path)
    robot = load_robot(cell.robot)
    x, y = cell.support.half_size
    points = [[sx * x, sy * y, 0.0] for sx in (-1, 1) for sy in (-1, 1)]
    points += [
        robot.X_TB.translation(),
        (
            robot.X_TB @ RigidTransform(robot.forward_kinematics(np.array(cell.robot.home)))
        ).translation(),
    ]
    camera = oblique_camera(cell)
    pixels, depth = camera.project_with_depth(np.array(points))
    assert (depth > 0).all()
    assert (pixels >= 0).all()
    assert (pixels < [camera.width, camera.height]).all()
    # The image is upright: what is higher in T is higher in the image.
    low, high = camera.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.3]]))
    assert high[0] == pytest.approx(low[0], abs=10)
    assert high[1] < low[1] - 50


def test_an_unknown_camera_is_named() -> None:
    with pytest.raises(InputError, match=r"--cameras side: expected some of .*overhead"):
        find_cameras(DEFAULT_CELL, ["overhead", "side"])
