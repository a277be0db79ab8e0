"""`drake-clutter render`: what the overhead camera sees of a scene."""

from pathlib import Path

import numpy as np
from PIL import Image

from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.reports.pictures import PictureCamera
from drake_clutter.scenes.scene import Scene

DEPTH_UNIT = 1e-4
"""m per step of depth.png; 0 where nothing is seen."""


def render_scene(scene: Scene, config: ClutterConfig, out: Path) -> dict[str, float]:
    """Writes the images of a scene at rest; returns the visible share of each object.

    `label.png` holds 0 for what is no object and k for the k-th object of the scene.
    """
    look = LabelDetector(config.camera).look(scene)
    depth = np.where(np.isfinite(look.images.depth), look.images.depth / DEPTH_UNIT, 0)
    Image.fromarray(look.images.color).save(out / "color.png")
    Image.fromarray(np.rint(depth).astype(np.uint16)).save(out / "depth.png")
    Image.fromarray((look.images.label + 1).astype(np.uint8)).save(out / "label.png")
    Image.fromarray(PictureCamera().oblique(scene)).save(out / "picture.png")
    hidden = [name for name in scene.names if look.visible_share[name] < config.camera.hidden_below]
    write_json(out / "visible.json", {"visible_share": look.visible_share, "hidden": hidden, "names": list(scene.names)})
    return look.visible_share
