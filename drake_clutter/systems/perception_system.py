"""Drake system that turns camera images into observations, and the detectors that it calls."""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from drake_clutter.cell.camera import Camera
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.depth_noise import DepthNoise, add_depth_noise
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import Observation
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.scene_plant import pose_from_transform
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.messages import empty_observation

PerceptionFn = Callable[
    [NDArray[np.float32], NDArray[np.uint8], Sequence[RigidTransform]], Observation
]
"""Returns the observation in a pair of images.

Args: depth image [m], shape (H, W); color image, shape (H, W, 3); and the poses of all bodies,
which only the ground-truth detector uses.
"""
DetectorFn = Callable[[NDArray[np.float32], NDArray[np.uint8]], Observation]
"""Returns the observation in a pair of images, for example `LearnedDetector.detect`.

Args: depth image [m], shape (H, W), and color image, shape (H, W, 3).
"""

ARM_DEPTH_DIFFERENCE = 0.01
"""Pixels that are closer to the camera by more than this show the arm [m]."""
MIN_RELEASE_HEIGHT = 0.003
"""Smallest release height for poses from images [m].

The detected height of a support is wrong by one or two millimeters, and an arm that moves down too
far pushes stacks over.
"""
MIN_POSITION_DOUBT = 0.003
"""Smallest bound on the error of a detected object's position [m].

It is about four times the median error of the shipped detectors.
"""


def with_image_tolerances(config: ClutterConfig) -> ClutterConfig:
    """Return a config whose placements allow for the errors of poses from images."""
    exploration = config.exploration
    placement = replace(
        exploration.placement,
        position_doubt=max(exploration.placement.position_doubt, MIN_POSITION_DOUBT),
    )
    release_height = max(exploration.release_height, MIN_RELEASE_HEIGHT)
    exploration = replace(exploration, placement=placement, release_height=release_height)
    return replace(config, exploration=exploration)


class PerceptionSystem(LeafSystem):
    """Detect the objects in the camera's images when the output is evaluated.

    .. pydrake_system::

        name: PerceptionSystem
        input_ports:
        - depth_image
        - color_image
        - body_poses
        output_ports:
        - observation

    Input ports:
        depth_image: `ImageDepth32F` [m].
        color_image: `ImageRgba8U`.
        body_poses: Poses of all bodies of the plant, list of `RigidTransform`.

    Output ports:
        observation: `Observation`, abstract; cached until an input changes.
    """

    def __init__(self, *, perceive: PerceptionFn, camera: Camera) -> None:
        """Create the system.

        Args:
            perceive: Returns the detections in an image.
            camera: Camera of the images.
        """
        super().__init__()
        self._perceive = perceive
        size = (camera.width, camera.height)
        self._depth = self.DeclareAbstractInputPort(
            "depth_image", AbstractValue.Make(ImageDepth32F(*size))
        )
        self._color = self.DeclareAbstractInputPort(
            "color_image", AbstractValue.Make(ImageRgba8U(*size))
        )
        self._poses = self.DeclareAbstractInputPort(
            "body_poses", AbstractValue.Make([RigidTransform()])
        )
        self.DeclareAbstractOutputPort(
            "observation", lambda: AbstractValue.Make(empty_observation()), self._calc_observation
        )

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, *, perceive: PerceptionFn, camera: Camera
    ) -> "PerceptionSystem":
        """Add a system to a diagram; see the constructor for the arguments."""
        system = PerceptionSystem(perceive=perceive, camera=camera)
        builder.AddNamedSystem("perception_system", system)
        return system

    def _calc_observation(self, context: Context, output: AbstractValue) -> None:
        depth = self._depth.Eval(context).data[..., 0].copy()
        color = self._color.Eval(context).data[..., :3].copy()
        output.set_value(self._perceive(depth, color, self._poses.Eval(context)))


class LearnedPerception:
    """Learned detector on images with the noise of a depth camera (a `PerceptionFn`)."""

    def __init__(self, detect: DetectorFn, *, noise: DepthNoise | None, seed: int) -> None:
        """Create a detector.

        Args:
            detect: Detector of objects in noisy images.
            noise: Noise of the depth camera; None: no noise.
            seed: Seed of the noise.
        """
        self._detect = detect
        self._noise = noise
        self._seed = seed

    def __call__(
        self,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        body_poses: Sequence[RigidTransform],
    ) -> Observation:
        """Return the observation; the same image always gets the same noise."""
        if self._noise:
            rng = item_rng(self._seed, zlib.crc32(depth.tobytes()))
            depth = add_depth_noise(depth, rng, self._noise)
        return self._detect(depth, color)


class LabelPerception:
    """Ground-truth detector of classes, poses and masks (a `PerceptionFn`).

    The depth image is that of the camera in the simulated cell. Pixels in which the arm occludes an
    object are removed from its mask.
    """

    def __init__(self, scene: Scene, station: ClutterStation, config: ClutterConfig) -> None:
        """Create a detector.

        Args:
            scene: Scene whose objects are detected.
            station: Station that simulates the scene.
            config: Config with the cell.
        """
        self._scene = scene
        self._detector = LabelDetector(config.cell.camera)
        self._body_indices = {
            o.name: int(station.scene_plant.bodies[o.name].index()) for o in scene.objects
        }

    def __call__(
        self,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        body_poses: Sequence[RigidTransform],
    ) -> Observation:
        """Return the observation of the objects at the poses of their bodies."""
        poses = {
            name: pose_from_transform(body_poses[index])
            for name, index in self._body_indices.items()
        }
        without_arm = self._detector.perceive(self._scene.with_poses(poses)).observation
        is_unobstructed = depth > without_arm.depth - ARM_DEPTH_DIFFERENCE
        masked = (replace(d, mask=d.mask & is_unobstructed) for d in without_arm.detections)
        detections = tuple(d for d in masked if d.mask.any())
        return replace(without_arm, depth=depth, detections=detections)
