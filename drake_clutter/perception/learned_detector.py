"""The detector that knows nothing but images: a network finds the objects, geometry fits their poses."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.catalogue import ObjectClass
from drake_clutter.config import CameraConfig
from drake_clutter.learning.checkpoint import Checkpoint
from drake_clutter.perception.pose_fit import PoseFitter
from drake_clutter.perception.segmentation import (
    SegmentationNetwork,
    Window,
    coarse,
    network_input,
    points,
    segments,
    without_holes,
)
from drake_clutter.scenes.seams import Detection, Observation

LEAST_SCORE = 0.3
"""Of a fitted pose; what is worse is no detection."""


class LearnedDetector:
    """Detects objects of some classes in depth, or in depth and colour."""

    def __init__(self, checkpoint: Checkpoint, classes: Sequence[ObjectClass], camera: CameraConfig, tray_side: float) -> None:
        """With a trained network, for objects of these classes, of which it must know all."""
        self._network, self._camera, self._tray_side = SegmentationNetwork.of(checkpoint), camera, tray_side
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._classes, self._window = {c.name: c for c in classes}, Window.of(camera, tray_side)
        self._unknown = torch.tensor([False] + [name not in self._classes for name in self._network.classes])
        self._radii = [min(self._classes[n].size) / 2 if n in self._classes else 0.0 for n in self._network.classes]
        self._fitter = PoseFitter(camera)

    def detect(self, depth: NDArray[np.float32], color: NDArray[np.uint8]) -> Observation:
        """What two images show; names count the objects of each class, and mean nothing beyond this image.

        Args:
            depth: (height, width) m along the camera's axis; 0 or infinite where nothing is measured.
            color: (height, width, 3).
        """
        window, network = self._window, self._network
        p_TP = points(depth, self._camera, window)
        given = network_input(p_TP, color[window.rows, window.columns] if network.looks_at_color else None)
        with torch.inference_mode():
            logits, votes = network(torch.from_numpy(given)[None].to(memory_format=torch.channels_last))
            kind = logits[0].masked_fill(self._unknown[:, None, None], -torch.inf).argmax(dim=0).numpy()
        votes_T = coarse(p_TP) + np.moveaxis(votes[0].numpy(), 0, 2)
        counted, found = Counter[str](), list[Detection]()
        for segment in segments(kind, votes_T, self._radii, network.classes, window, depth.shape):
            object_class = self._classes[segment.name]
            fitted = self._fitter.fit(object_class, segment.mask, depth, segment.p_TO)
            if fitted is not None and fitted.score >= LEAST_SCORE:
                counted[segment.name] += 1
                found.append(Detection(f"{segment.name}_{counted[segment.name]}", object_class, fitted.X_TO, segment.mask))
        return Observation(without_holes(np.where(depth > 0, depth, np.nan)), tuple(found), self._camera, self._tray_side)
