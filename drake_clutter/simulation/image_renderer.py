"""What the renderers of images of scenes have in common."""

from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.scenes.scene import Pose, Scene


class RendererKind(Enum):
    """Renderer of images.

    Attributes:
        VTK: Drake's VTK engine; lamps cast no shadows, and there is no ambient light.
        RASTER: The compiled rasterizer.
    """

    VTK = "vtk"
    RASTER = "raster"


class ImageRenderer(Protocol):
    """Renders images of scenes."""

    def render(self, scene: Scene, X_TC: Pose | None = None) -> RenderedImages:
        """Return the images of a scene.

        Args:
            scene: The scene.
            X_TC: Another pose of the camera, or None for its own.
        """

    def silhouettes(self, scene: Scene) -> NDArray[np.bool_]:
        """Return the pixels that each object covers alone on the support. Shape (N, H, W)."""
