"""From rendered images to what an explorer may know."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageRgba8U

from drake_clutter.scenes.seams import Observation

Perceive = Callable[[NDArray[np.float32], NDArray[np.uint8], Sequence[RigidTransform]], Observation]
"""From depth (height, width) m, colour (height, width, 3) and, for a perfect detector, the poses of all bodies, which a learned
one leaves alone."""


class ScenePerception(LeafSystem):
    """Detects what is in view, whenever it is asked.

    Input ports: depth_image, ImageDepth32F; color_image, ImageRgba8U; body_poses, of a plant.
    Output port: observation, abstract, an `Observation`. It is computed when it is looked at, once for a state of the inputs.
    """

    def __init__(self, *, perceive: Perceive, width: int, height: int) -> None:
        """With a detector, for images of a size in pixels."""
        super().__init__()
        self._perceive = perceive
        self._depth = self.DeclareAbstractInputPort("depth_image", AbstractValue.Make(ImageDepth32F(width, height)))
        self._color = self.DeclareAbstractInputPort("color_image", AbstractValue.Make(ImageRgba8U(width, height)))
        self._poses = self.DeclareAbstractInputPort("body_poses", AbstractValue.Make([RigidTransform()]))
        self.DeclareAbstractOutputPort("observation", lambda: AbstractValue.Make(None), self._calc_observation)

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, perceive: Perceive, width: int, height: int) -> "ScenePerception":
        """Adds one."""
        system: ScenePerception = builder.AddSystem(ScenePerception(perceive=perceive, width=width, height=height))
        system.set_name("scene_perception")
        return system

    def _calc_observation(self, context: Context, output: AbstractValue) -> None:
        depth, color = (port.Eval(context).data for port in (self._depth, self._color))
        output.set_value(self._perceive(depth[..., 0].copy(), color[..., :3].copy(), self._poses.Eval(context)))
