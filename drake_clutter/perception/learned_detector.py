"""The detector that knows nothing but images: a network finds the objects, geometry fits their poses."""

from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.catalogue import ObjectClass
from drake_clutter.config import CameraConfig
from drake_clutter.learning.checkpoint import Checkpoint
from drake_clutter.perception.explaining import Explanation, chosen, explanation
from drake_clutter.perception.pose_fit import FittedPose, PoseFitter
from drake_clutter.perception.pose_score import FLOOR_SLACK
from drake_clutter.perception.segmentation import (
    Segment,
    SegmentationNetwork,
    Window,
    coarse,
    network_input,
    points,
    segments,
    without_holes,
)
from drake_clutter.scenes.scene import Pose
from drake_clutter.scenes.seams import Detection, Observation

LEAST_SCORE = 0.3
"""Of a fitted pose; what is worse is no detection."""
SURE_SCORE, CLAIMED = 0.6, 0.7
"""A pose with that score is sure; a segment of which that share lies in what sure poses explain is a piece of one."""
RIM_SLACK = 0.02
"""m, by which what is recognised may reach past the rim; the arm does, and it is no object."""
SIDE_BY_SIDE = 2
"""Segments that are fitted at the same time; always so many, so that the number of cores changes no result."""
FLOOR_WITHIN = 0.008
"""m, of the floor; what is measured there is the floor: nothing that lies on it is so flat."""
LEAST_SHARE = 0.2
"""Of the pixels that an object would cover alone, that must be seen of it."""


class _Candidate(NamedTuple):
    object_class: ObjectClass
    fitted: FittedPose
    explains: Explanation


def _best(candidates: Sequence[_Candidate], shape: tuple[int, int]) -> list[_Candidate]:
    """Those that together explain an image best."""
    numbers = chosen([c.explains for c in candidates], [c.fitted.score for c in candidates], shape, LEAST_SHARE)
    return [candidates[k] for k in numbers]


class LearnedDetector:
    """Detects objects of some classes in depth, or in depth and colour."""

    def __init__(self, checkpoint: Checkpoint, classes: Sequence[ObjectClass], camera: CameraConfig, tray_side: float) -> None:
        """With a trained network, for objects of these classes, of which it must know all."""
        self._network, self._camera, self._tray_side = SegmentationNetwork.of(checkpoint), camera, tray_side
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._classes, self._window = {c.name: c for c in classes}, Window.of(camera, tray_side)
        self._unknown = torch.tensor([False] + [name not in self._classes for name in self._network.classes])
        self._radii = [min(self._classes[n].size) / 2 if n in self._classes else 0.0 for n in self._network.classes]
        self._fitter, self._workers = PoseFitter(camera), ThreadPoolExecutor(SIDE_BY_SIDE)

    def detect(self, depth: NDArray[np.float32], color: NDArray[np.uint8]) -> Observation:
        """What two images show; names count the objects of each class, and mean nothing beyond this image.

        The depth of what was recognised, and of the tray's floor, is that of the models: without noise.

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
        poses = self._fitted(segments(kind, votes_T, self._radii, network.classes, window, depth.shape), depth)
        counted, found = Counter[str](), list[Detection]()
        clean = without_holes(np.where(depth > 0, depth, np.nan))
        clean[np.abs(clean - self._camera.altitude) < FLOOR_WITHIN] = self._camera.altitude
        for candidate in _best(poses, depth.shape):
            name, e, mask = candidate.object_class.name, candidate.explains, np.zeros(depth.shape, bool)
            counted[name] += 1
            mask[e.window] = e.seen
            clean[mask] = e.away[e.seen]
            found.append(Detection(f"{name}_{counted[name]}", candidate.object_class, candidate.fitted.X_TO, mask))
        return Observation(clean, tuple(found), self._camera, self._tray_side)

    def _fitted(self, found: Sequence[Segment], depth: NDArray[np.float32]) -> list[_Candidate]:
        """Poses of segments, the largest first; what a sure pose has explained already is left out."""
        fitted, claimed = list[_Candidate](), np.zeros(depth.shape, bool)
        left = deque(sorted(found, key=lambda segment: -np.count_nonzero(segment.mask)))
        while left:
            next_ones = list[Segment]()
            while left and len(next_ones) < SIDE_BY_SIDE:
                segment = left.popleft()
                if claimed[segment.mask].mean() <= CLAIMED:
                    next_ones.append(segment)
            classes = [self._classes[segment.name] for segment in next_ones]
            poses = self._workers.map(lambda s, c: self._fitter.fit(c, s.mask, depth, s.p_TO), next_ones, classes)
            for object_class, pose in zip(classes, poses, strict=True):
                if pose is None or pose.score < LEAST_SCORE or not self._on_tray(object_class, pose.X_TO):
                    continue
                explains = explanation(object_class, pose.X_TO, depth, self._camera)
                fitted.append(_Candidate(object_class, pose, explains))
                if pose.score >= SURE_SCORE:
                    claimed[explains.window] |= explains.seen
        return fitted

    def _on_tray(self, object_class: ObjectClass, X_TO: Pose) -> bool:
        """Whether an object can be there: within the rim, and not below the floor."""
        corners = X_TO.apply(object_class.corners)
        return bool(np.abs(corners[:, :2]).max() < self._tray_side / 2 + RIM_SLACK and corners[:, 2].min() > -2 * FLOOR_SLACK)
