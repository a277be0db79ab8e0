"""Images of the cameras of a work cell."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.camera import Camera
from drake_clutter.config import ClutterConfig
from drake_clutter.files import atomic_write, write_json
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer

DEPTH_UNIT = 1e-4
"""Depth per step of the 16-bit `depth.png` [m].

The value is 0 where the depth is unknown or too large for 16 bits.
"""


def render_scene(scene: Scene, config: ClutterConfig, out: Path) -> dict[str, float]:
    """Write the images of a scene at rest.

    File names start with the camera's name if the cell has several cameras. `label.png` contains 0
    where there is no object and k at object k of the scene, counted from 1.

    Args:
        scene: The scene.
        config: Configuration with the cell.
        out: Output folder.

    Returns:
        Visible fraction of each object by name, from the camera used for exploration.
    """
    cameras = config.cell.cameras
    visible_fractions = [
        _write_camera_images(scene, camera, out, f"{name}_" if len(cameras) > 1 else "")
        for name, camera in cameras.items()
    ]
    _write_png(out / "picture.png", SceneRenderer().render_oblique(scene))
    return visible_fractions[0]


def _write_png(path: Path, pixels: NDArray[Any]) -> None:
    """Write an image atomically."""
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary)


def _write_camera_images(scene: Scene, config: Camera, out: Path, prefix: str) -> dict[str, float]:
    """Write the images of one camera; return the visible fraction of each object."""
    camera = CameraRenderer(config)
    images = camera.render(scene)
    visible_fractions = camera.visible_fractions(scene)
    depth = np.rint(images.depth / DEPTH_UNIT)
    depth = np.where(depth <= np.iinfo(np.uint16).max, depth, 0)
    _write_png(out / f"{prefix}color.png", images.color)
    _write_png(out / f"{prefix}depth.png", depth.astype(np.uint16))
    _write_png(out / f"{prefix}label.png", (images.label + 1).astype(np.uint8))
    hidden = list(camera.hidden_objects(visible_fractions))
    write_json(
        out / f"{prefix}visible.json",
        {"visible_fractions": visible_fractions, "hidden": hidden, "names": list(scene.names)},
    )
    return visible_fractions
