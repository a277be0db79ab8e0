"""Depth images with the detected objects outlined."""

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.camera import pixel_grid
from drake_clutter.reports.canvas import Canvas, TextLabel, innermost_point
from drake_clutter.reports.scene_images import display_name
from drake_clutter.scenes.interfaces import Observation

IMAGE_SIDE = 720
"""Width and height of the image in pixels."""
_OVERSAMPLING = 2
_MAX_HEIGHT = 0.45
"""Height that is drawn brightest [m]."""
_RIM_HEIGHT = 0.3
"""Objects up to this height at the edge of the support are completely in the image [m]."""
_OUTLINE_COLOR = "#d7263d"


def draw_detections(observation: Observation) -> NDArray[np.uint8]:
    """Return the part of a depth image around the support, with detected objects outlined.

    Args:
        observation: The depth image and the detections.

    Returns:
        RGB image, the brighter, the higher above the support. Shape (720, 720, 3).
    """
    camera = observation.camera
    depth = observation.depth
    size_px = np.array([camera.width, camera.height])
    center_px, support_side = camera.support_bounds(observation.support, _RIM_HEIGHT) or (
        np.array(camera.principal_point),
        np.inf,
    )
    side = int(min(np.round(support_side), *size_px))
    left, top = np.clip(
        np.floor(center_px + 1 - side / 2 + 1e-6).astype(int), 0, size_px - side
    ).tolist()
    rows = slice(top, top + side)
    columns = slice(left, left + side)
    pixels = pixel_grid(depth.shape)[rows, columns]
    measured = np.isfinite(depth) & (depth > 0)
    height = np.where(
        measured[rows, columns],
        camera.backproject(pixels, np.where(measured, depth, 1.0)[rows, columns])[..., 2],
        0.0,
    )
    shades = matplotlib.colormaps["viridis"](np.clip(height / _MAX_HEIGHT, 0, 1))[..., :3]
    size = (_OVERSAMPLING * IMAGE_SIDE, _OVERSAMPLING * IMAGE_SIDE)
    canvas = Canvas(
        Image.fromarray((255 * shades).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    )
    labels = list[TextLabel]()
    for detection in observation.detections:
        cropped_mask = Image.fromarray(detection.mask[rows, columns])
        mask = np.asarray(cropped_mask.resize(size, Image.Resampling.NEAREST))
        if not mask.any():
            continue
        canvas.draw_outline(mask, (0, 0), _OUTLINE_COLOR, 4)
        ys, xs = np.nonzero(mask)
        bounds = (float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max()))
        name = display_name(detection.object_class.name)
        labels.append(TextLabel(name, innermost_point(mask), bounds, _OUTLINE_COLOR, 34))
    canvas.draw_labels(labels)
    return np.asarray(canvas.image.resize((IMAGE_SIDE, IMAGE_SIDE), Image.Resampling.LANCZOS))
