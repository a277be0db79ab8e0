"""A depth image and what a detector recognised in it, as a picture."""

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from drake_clutter.cell.camera import pixel_grid
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
    """(720, 720, 3) the part of the image with the tray, the brighter, the higher above it.

    What was recognised is outlined.
    """
    camera, depth = observation.camera, observation.depth
    size_px = np.array([camera.width, camera.height])
    middle_px, wanted = camera.support_bounds(observation.support, _TALL) or (
        np.array(camera.principal_point),
        np.inf,
    )
    side = int(min(np.round(wanted), *size_px))
    left, top = np.clip(
        np.floor(middle_px + 1 - side / 2 + 1e-6).astype(int), 0, size_px - side
    ).tolist()
    rows, columns = slice(top, top + side), slice(left, left + side)
    pixels = pixel_grid(depth.shape)[rows, columns]
    measured = np.isfinite(depth) & (depth > 0)
    height = np.where(
        measured[rows, columns],
        camera.backproject(pixels, np.where(measured, depth, 1.0)[rows, columns])[..., 2],
        0.0,
    )
    shades = matplotlib.colormaps["viridis"](np.clip(height / _HIGHEST, 0, 1))[..., :3]
    size = (_OVERSAMPLING * SIDE, _OVERSAMPLING * SIDE)
    canvas = Canvas(
        Image.fromarray((255 * shades).astype(np.uint8)).resize(size, Image.Resampling.NEAREST)
    )
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
