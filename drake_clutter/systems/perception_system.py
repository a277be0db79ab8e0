"""From rendered images to what an explorer may know."""

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
"""From depth (height, width) m, colour (height, width, 3) and, for a perfect detector, the poses of all bodies, which a learned
one leaves alone."""
DetectorFn = Callable[[NDArray[np.float32], NDArray[np.uint8]], Observation]
"""Depth and colour alone, as `LearnedDetector.detect`."""


MIN_RELEASE_HEIGHT = 0.003
"""m; what is seen of a support is a millimetre or two off, and an arm that goes on down pushes stacks over."""


def with_min_release_height(world: ClutterConfig) -> ClutterConfig:
    """The world of an agent that knows its objects from images: it lets go a little higher."""
    higher = max(world.exploration.release_height, MIN_RELEASE_HEIGHT)
    return replace(world, exploration=replace(world.exploration, release_height=higher))


class PerceptionSystem(LeafSystem):
    """Detect what is in view, whenever the output is evaluated.

    .. pydrake_system::

        name: PerceptionSystem
        input_ports:
        - depth_image
        - color_image
        - body_poses
        output_ports:
        - observation

    Input ports:
        depth_image: `ImageDepth32F`.
        color_image: `ImageRgba8U`.
        body_poses: Of a plant.

    Output ports:
        observation: `Observation`, computed once for a state of the inputs.
    """

    def __init__(self, *, perceive: PerceptionFn, camera: Camera) -> None:
        """Make a system.

        Args:
            perceive: The detector.
            camera: Whose images it gets.
        """
        super().__init__()
        self._perceive, size = perceive, (camera.width, camera.height)
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
        """Add a system to a diagram; arguments as of the constructor."""
        made = PerceptionSystem(perceive=perceive, camera=camera)
        system: PerceptionSystem = builder.AddNamedSystem("perception_system", made)
        return system

    def _calc_observation(self, context: Context, output: AbstractValue) -> None:
        depth, color = (port.Eval(context).data for port in (self._depth, self._color))
        depth, color = depth[..., 0].copy(), color[..., :3].copy()
        output.set_value(self._perceive(depth, color, self._poses.Eval(context)))


class LearnedPerception:
    """A detector in the loop that is given images as a depth camera takes them."""

    def __init__(self, detect: DetectorFn, *, noise: DepthNoise | None, seed: int) -> None:
        """`noise`: what the rendered depth gets, by a seed."""
        self._detect, self._noise, self._seed = detect, noise, seed

    def __call__(
        self,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        body_poses: Sequence[RigidTransform],
    ) -> Observation:
        """See `Perceive`; the same image gets the same noise."""
        if self._noise:
            depth = add_depth_noise(
                depth, item_rng(self._seed, zlib.crc32(depth.tobytes())), self._noise
            )
        return self._detect(depth, color)


class LabelPerception:
    """The perfect detector in the loop: classes, poses and masks are the truth, depth is what the camera in the cell renders."""

    def __init__(self, scene: Scene, station: ClutterStation, world: ClutterConfig) -> None:
        """For the objects of a scene."""
        self._scene, self._detector = scene, LabelDetector(world.cell.camera)
        self._numbers = {
            o.name: int(station.scene_plant.bodies[o.name].index()) for o in scene.objects
        }

    def __call__(
        self,
        depth: NDArray[np.float32],
        color: NDArray[np.uint8],
        body_poses: Sequence[RigidTransform],
    ) -> Observation:
        """See `Perceive`."""
        poses = {
            name: pose_from_transform(body_poses[number]) for name, number in self._numbers.items()
        }
        told = self._detector.perceive(self._scene.with_poses(poses)).observation
        unobstructed = depth > told.depth - 0.01  # the arm may be in the way
        in_view = (replace(d, mask=d.mask & unobstructed) for d in told.detections)
        return Observation(
            depth, tuple(d for d in in_view if d.mask.any()), told.camera, told.support
        )
