"""`drake-clutter render`: what the overhead camera sees of a scene."""

from pathlib import Path

import numpy as np
from PIL import Image

from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.reports.pictures import PictureCamera
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera import OverheadCamera

DEPTH_UNIT = 1e-4
"""m per step of depth.png; 0 where nothing is seen."""


def render_scene(scene: Scene, config: ClutterConfig, out: Path) -> dict[str, float]:
    """Writes the images of a scene at rest; returns the visible share of each object.

    `label.png` holds 0 for what is no object and k for the k-th object of the scene.
    """
    camera = OverheadCamera(config.cell.camera)
    images, shares = camera.render(scene), camera.visible_shares(scene)
    depth = np.where(np.isfinite(images.depth), images.depth / DEPTH_UNIT, 0)
    Image.fromarray(images.color).save(out / "color.png")
    Image.fromarray(np.rint(depth).astype(np.uint16)).save(out / "depth.png")
    Image.fromarray((images.label + 1).astype(np.uint8)).save(out / "label.png")
    Image.fromarray(PictureCamera().oblique(scene)).save(out / "picture.png")
    hidden = list(camera.hidden(shares))
    write_json(out / "visible.json", {"visible_share": shares, "hidden": hidden, "names": list(scene.names)})
    return shares
