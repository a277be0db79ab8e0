"""Images of the cameras of a work cell."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.camera import Camera
from drake_clutter.config import ClutterConfig
from drake_clutter.files import atomic_write, write_json
from drake_clutter.perception.image_dataset import encode_depth
from drake_clutter.reports.scene_images import SceneRenderer
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer


def render_scene(scene: Scene, config: ClutterConfig, out: Path) -> dict[str, float]:
    """Write the images of a scene at rest.

    File names start with the camera's name if the cell has several cameras. `label.png` contains 0
    where there is no object and k at object k of the scene, counted from 1. It has 16 bits if the
    scene has more than 255 objects. `depth.png` contains steps of 0.1 mm, and 0 where the depth is
    unknown or too large for 16 bits.

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
    _write_png(out / f"{prefix}color.png", images.color)
    _write_png(out / f"{prefix}depth.png", encode_depth(images.depth))
    # Eight bits hold the numbers of 255 objects.
    label_type = np.uint8 if len(scene.objects) <= np.iinfo(np.uint8).max else np.uint16
    _write_png(out / f"{prefix}label.png", (images.label + 1).astype(label_type))
    hidden = list(camera.hidden_objects(visible_fractions))
    write_json(
        out / f"{prefix}visible.json",
        {"visible_fractions": visible_fractions, "hidden": hidden, "names": list(scene.names)},
    )
    return visible_fractions
