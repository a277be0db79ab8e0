"""Images of recorded motions, rendered from the recorded states.

Frames: T is the support and the world, F the flange, O an object, C a camera: z along the optical
axis, x to the right of the image, y down.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import QueryObject
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.files import InputError
from drake_clutter.perception.depth_noise import add_depth_noise
from drake_clutter.recording.appearance import vary_colors, vary_lighting
from drake_clutter.recording.randomization import Variation
from drake_clutter.recording.recorded_episode import CameraImages
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.cell_plant import add_work_cell, joint_state_indices
from drake_clutter.simulation.plant_rasterizer import PlantRasterizer
from drake_clutter.simulation.scene_plant import (
    add_scene_plant,
    pose_from_transform,
)

Floats = NDArray[np.float64]

WRIST = "wrist"
"""Name of the camera on the flange, `WorkCell.wrist_camera`."""
OBLIQUE = "oblique"
"""Name of the camera with a view of the whole cell."""
ARM_LABEL = 255
"""Value of the pixels of robot and gripper in a segmentation image."""
MAX_LABELED_OBJECTS = ARM_LABEL - 1
"""Largest number of objects of a scene that a segmentation image can tell apart."""
_OBLIQUE_POSITION = np.array([0.80, -2.10, 1.45])
"""Position of the oblique camera for a support of `_REFERENCE_SIDE`, in T [m]."""
_OBLIQUE_TARGET = np.array([-0.15, 0.0, 0.46])
"""Point on the optical axis of the oblique camera for such a support, in T [m]."""
_OBLIQUE_FOV_Y_DEG = 36.0
"""Vertical field of view of the oblique camera [deg]."""
_REFERENCE_SIDE = 0.70
"""Longer side of the support for which the oblique camera is stated [m]; it scales with it."""


class CameraChannel(Enum):
    """Kind of an image.

    Attributes:
        RGB: sRGB color.
        DEPTH: Depth along the optical axis.
        SEGMENTATION: Object in each pixel.
    """

    RGB = "rgb"
    DEPTH = "depth"
    SEGMENTATION = "segmentation"


@dataclass(frozen=True)
class RecordedCamera:
    """A camera whose images are recorded.

    Attributes:
        name: Name of the camera.
        camera: Its intrinsics, and its pose: X_FC if it is mounted on the flange, else X_TC.
        is_on_flange: Whether it is mounted on the flange.
    """

    name: str
    camera: Camera
    is_on_flange: bool = False


def oblique_camera(cell: WorkCell) -> Camera:
    """Return a camera with a view of robot and support."""
    scale = max(cell.support.size) / _REFERENCE_SIDE
    position = scale * _OBLIQUE_POSITION
    z = scale * _OBLIQUE_TARGET - position
    # Yaw turns the image about the vertical, roll tilts the optical axis from straight down.
    yaw = np.degrees(np.arctan2(z[1], z[0])) - 90.0
    roll = -90.0 - np.degrees(np.arctan2(-z[2], np.hypot(z[0], z[1])))
    x, y, height = position.tolist()
    return Camera(
        pose=PoseSpec(translation=(x, y, height), rpy_deg=(float(roll), 0.0, float(yaw))),
        fov_y_deg=_OBLIQUE_FOV_Y_DEG,
    )


def find_cameras(
    cell: WorkCell, names: Sequence[str], resolution: tuple[int, int] | None = None
) -> tuple[RecordedCamera, ...]:
    """Return cameras of a cell: its own, `wrist` and `oblique`.

    Args:
        cell: The cell.
        names: Names of the cameras.
        resolution: Width and height of the images [px]; None for those of each camera. The vertical
            field of view is that of the camera.

    Raises:
        InputError: There is no such camera.
    """
    known = {
        WRIST: RecordedCamera(WRIST, cell.wrist_camera, is_on_flange=True),
        OBLIQUE: RecordedCamera(OBLIQUE, oblique_camera(cell)),
    } | {name: RecordedCamera(name, camera) for name, camera in cell.cameras.items()}
    for name in names:
        if name not in known:
            raise InputError(f"--cameras {name}: expected some of {', '.join(known)}")
    cameras = [known[name] for name in dict.fromkeys(names)]
    if resolution is None:
        return tuple(cameras)
    width, height = resolution
    return tuple(
        RecordedCamera(
            c.name,
            c.camera.model_copy(update={"width": width, "height": height}),
            c.is_on_flange,
        )
        for c in cameras
    )


def image_indices(time: Floats, rate: float) -> NDArray[np.int64]:
    """Return the indices of the samples at which images are taken.

    Args:
        time: Ascending times of the samples [s]. Shape (m,).
        rate: Number of images per second [Hz].

    Returns:
        Indices of the first sample of each period, and of the last sample. Shape (f,).
    """
    # A sample whose time is a period but for rounding belongs to the period that it starts.
    period = np.floor(time * rate + 1e-6)
    _, indices = np.unique(period, return_index=True)
    return np.unique([*indices, len(time) - 1])


def depth_in_millimeters(depth: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return a depth image in whole millimeters, as depth cameras do; 0 where nothing is seen.

    Args:
        depth: Depth [m]; inf where nothing is seen. Shape (height, width).
    """
    return np.where(np.isfinite(depth), np.rint(1000 * depth), 0).astype(np.uint16)


@dataclass(frozen=True)
class _Frame:
    """Images of a camera at one time; see `CameraImages`."""

    X_TC: tuple[float, ...]
    rgb: NDArray[np.uint8] | None
    depth: NDArray[np.uint16] | None
    segmentation: NDArray[np.uint8] | None


def _stack_frames(camera: Camera, time: Floats, frames: Sequence[_Frame]) -> CameraImages:
    """Return the images of a camera at several times [s], shape (f,)."""
    f = camera.focal_length
    stacks = {
        name: np.stack([getattr(frame, name) for frame in frames])
        for name in ("rgb", "depth", "segmentation")
        if getattr(frames[0], name) is not None
    }
    X_TC = np.array([frame.X_TC for frame in frames])
    return CameraImages(time, X_TC, (f, f, *camera.principal_point), **stacks)


class CameraRecorder:
    """Renders the images of one scene, in which arm and objects are moved.

    Robot, gripper, fixtures, support and objects are shown at their recorded positions.

    Attributes:
        cameras: The cameras.
        channels: The recorded kinds of images.
    """

    def __init__(
        self,
        cell: WorkCell,
        scene: Scene,
        cameras: Sequence[RecordedCamera],
        channels: Collection[CameraChannel],
        variation: Variation,
        rng: np.random.Generator,
    ) -> None:
        """Build the scene.

        Args:
            cell: Work cell; its support is replaced by that of the scene.
            scene: The objects.
            cameras: The cameras; see `find_cameras`.
            channels: The kinds of images.
            variation: Colors, lights, mounting errors of the cameras, and noise.
            rng: Random generator of the noise of the images.

        Raises:
            InputError: The scene has more than `MAX_LABELED_OBJECTS` objects, and segmentation is
                recorded.
        """
        self.cameras = tuple(cameras)
        self._variation = variation
        self._rng = rng
        self._X_CA = [variation.camera_error(camera.name) for camera in cameras]
        self.channels = frozenset(channels)
        if CameraChannel.SEGMENTATION in self.channels and len(scene.objects) > MAX_LABELED_OBJECTS:
            raise InputError(
                f"segmentation of {len(scene.objects)} objects; expected at most "
                f"{MAX_LABELED_OBJECTS}"
            )
        builder = DiagramBuilder()
        self._scene_plant = add_scene_plant(
            builder,
            [(o.name, o.object_class) for o in scene.objects],
            scene.support,
            0.01,
            visuals=True,
        )
        plant = self._scene_plant.plant
        self._arm = add_work_cell(
            plant,
            self._scene_plant.scene_graph,
            cell.with_support(scene.support),
            compliant=True,
            visuals=True,
        )
        plant.Finalize()
        vary_colors(self._scene_plant, variation)
        self._lighting = vary_lighting(variation)
        self._rasterizer = PlantRasterizer(self._scene_plant.scene_graph.model_inspector())
        self._q_indices, _ = joint_state_indices(plant, self._arm)
        self._diagram = builder.Build()
        self._context = self._diagram.CreateDefaultContext()
        self._plant_context = plant.GetMyMutableContextFromRoot(self._context)
        self._names = scene.names
        self._scene_plant.set_poses(self._plant_context, scene.objects)
        self._labels = np.zeros(2**15, np.uint8)
        self._labels[[int(body.index()) for body in self._arm.bodies]] = ARM_LABEL
        for number, name in enumerate(self._names, start=1):
            self._labels[int(self._scene_plant.bodies[name].index())] = number

    def record(self, samples: ActionSamples, rate: float) -> dict[str, CameraImages]:
        """Return the images of an action, by name of the camera.

        Images are taken at the first sample of each period, and at the last sample.

        Args:
            samples: The samples of the action.
            rate: Number of images per second [Hz].
        """
        indices = image_indices(samples.time, rate)
        frames: dict[str, list[_Frame]] = {camera.name: [] for camera in self.cameras}
        for index in indices:
            self._set_state(samples.q[index], samples.gripper[index], samples.X_TO[index])
            for number, camera in enumerate(self.cameras):
                frames[camera.name].append(self._render(number))
        return {
            camera.name: _stack_frames(camera.camera, samples.time[indices], frames[camera.name])
            for camera in self.cameras
        }

    def _set_state(self, q: Floats, gripper: Floats, X_TO: Floats) -> None:
        """Set the positions of arm (n,), gripper (k,) and objects (o, 7)."""
        plant = self._scene_plant.plant
        positions = plant.GetPositions(self._plant_context)
        positions[self._q_indices] = q
        plant.SetPositions(self._plant_context, positions)
        plant.SetPositions(self._plant_context, self._arm.gripper, gripper)
        for name, row in zip(self._names, X_TO, strict=True):
            X = RigidTransform(
                RotationMatrix(Rotation.from_quat(row[:4], scalar_first=True).as_matrix()), row[4:]
            )
            plant.SetFreeBodyPose(self._plant_context, self._scene_plant.bodies[name], X)

    def _render(self, number: int) -> _Frame:
        """Return the images of the camera of a number in the current state."""
        X_TC = self.cameras[number].camera.X_TC @ self._X_CA[number]
        if self.cameras[number].is_on_flange:
            X_TC = self._arm.flange.CalcPoseInWorld(self._plant_context) @ X_TC
        images = self._rasterizer.render(
            self.cameras[number].camera, X_TC, self._query(), self._lighting
        )
        rgb = depth = segmentation = None
        if CameraChannel.RGB in self.channels:
            rgb = self._add_color_noise(images.color)
        if CameraChannel.DEPTH in self.channels:
            measured = images.depth
            if self._variation.depth_noise:
                measured = add_depth_noise(measured, self._rng)
            depth = depth_in_millimeters(measured)
        if CameraChannel.SEGMENTATION in self.channels:
            # The last label of the table is that of pixels in which nothing is seen, -1.
            segmentation = self._labels[images.label]
        pose = pose_from_transform(X_TC)
        return _Frame((*pose.quaternion, *pose.translation), rgb, depth, segmentation)

    def _add_color_noise(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a copy of a color image with the noise of the variation."""
        if not self._variation.color_noise:
            return image.copy()
        noise = self._variation.color_noise * self._rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)

    def _query(self) -> QueryObject:
        scene_graph = self._scene_plant.scene_graph
        return scene_graph.get_query_output_port().Eval(
            scene_graph.GetMyContextFromRoot(self._context)
        )
