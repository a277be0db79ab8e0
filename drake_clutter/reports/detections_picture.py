"""A depth image and what a detector recognised in it, as a picture."""

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.reports.drawing import Canvas, Label, middle
from drake_clutter.reports.pictures import humanised
from drake_clutter.scenes.interfaces import Observation

SIDE = 720
_OVERSAMPLING = 2
_HIGHEST = 0.45
"""m, drawn brightest."""
_TALL = 0.3
"""m; of what stands so high at the tray's edge all is in the picture."""
_INK = "#d7263d"


def detections_picture(observation: Observation) -> NDArray[np.uint8]:
    """(720, 720, 3) the middle of the image, the brighter, the higher above the tray; with outlines of what was recognised."""
    camera, depth = observation.camera, observation.depth
    reach = camera.focal_length * max(observation.support.size) / (camera.altitude - _TALL)
    side = min(round(reach), camera.width, camera.height)
    rows, columns = (slice((n - side) // 2, (n - side) // 2 + side) for n in (camera.height, camera.width))
    height = camera.altitude - np.where(np.isfinite(depth) & (depth > 0), depth, camera.altitude)[rows, columns]
    shades = matplotlib.colormaps["viridis"](np.clip(height / _HIGHEST, 0, 1))[..., :3]
    size = (_OVERSAMPLING * SIDE, _OVERSAMPLING * SIDE)
    canvas = Canvas(Image.fromarray((255 * shades).astype(np.uint8)).resize(size, Image.Resampling.NEAREST))
    labels = []
    for detection in observation.detections:
        small = Image.fromarray(detection.mask[rows, columns])
        mask = np.asarray(small.resize(size, Image.Resampling.NEAREST))
        if not mask.any():
            continue
        canvas.outline(mask, (0, 0), _INK, 4)
        ys, xs = np.nonzero(mask)
        about = (float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max()))
        labels.append(Label(humanised(detection.object_class.name), middle(mask), about, _INK, 34))
    canvas.labels(labels)
    return np.asarray(canvas.image.resize((SIDE, SIDE), Image.Resampling.LANCZOS))
