"""Choice of the renderer of images of scenes."""

from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.cell.camera import Camera
from drake_clutter.rendering.lighting import Lighting
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.scene_rasterizer import SceneRasterizer
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer, make_engine_params


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


def make_image_renderer(kind: RendererKind, camera: Camera, lighting: Lighting) -> ImageRenderer:
    """Return a renderer.

    Args:
        kind: Kind of the renderer.
        camera: The camera.
        lighting: Light of color images; without shadows and ambient light for VTK.
    """
    if kind is RendererKind.VTK:
        return CameraRenderer(camera, make_engine_params(lighting))
    return SceneRasterizer(camera, lighting)
