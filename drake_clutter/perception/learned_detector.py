"""The detector that knows nothing but images: a network finds the objects, geometry fits their poses."""

from collections import Counter, deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.perception.explaining import Explanation, chosen, explanation
from drake_clutter.perception.pose_fit import FittedPose, PoseFitter
from drake_clutter.perception.pose_score import FLOOR_SLACK
from drake_clutter.perception.second_look import (
    LEAST,
    Mask,
    doubtful,
    halves,
    possible,
    surfaces,
    unexplained,
)
from drake_clutter.perception.segmentation import (
    Segment,
    SegmentationNetwork,
    Window,
    coarse,
    fine,
    network_input,
    points,
    segments,
    without_holes,
)
from drake_clutter.scenes.geometry import penetration
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Pose, SceneObject

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
IN_EACH_OTHER = 0.010
"""m; what penetrates deeper is not there together."""
LEAST_SHARE = 0.2
"""Of the pixels that an object would cover alone, that must be seen of it."""
SURE_VOTES, VOTE_WITHIN = 0.8, 0.03
"""A detection is sure if such a share of its pixels, by their chances of its class, votes for its middle within so many m."""
TWO_INSTEAD = 0.1
"""Of the pixels in which a pose is seen, that in which the camera sees past it, if two may be there instead."""


class _Candidate(NamedTuple):
    object_class: ObjectClass
    fitted: FittedPose
    explains: Explanation


def _seen_past(explains: Explanation) -> bool:
    """Whether the camera sees past so much of a pose that two smaller objects may lie side by side there."""
    return explains.past > TWO_INSTEAD * int(np.count_nonzero(explains.seen))


def _sure(X_TO: Pose, chances: NDArray[np.float32], votes_T: NDArray[np.float32]) -> bool:
    """Whether the network's answers, chances (n,) of the class and votes (n, 3) m for the middle, say so of a pose."""
    here = np.linalg.norm(votes_T - X_TO.p, axis=1) < VOTE_WITHIN  # false where it is NaN
    return bool((here * chances).sum() > SURE_VOTES * len(chances))


def _best(candidates: Sequence[_Candidate], shape: tuple[int, int]) -> list[_Candidate]:
    """Those that together explain an image best, and of which no two are in the same place."""
    objects = [SceneObject(str(k), c.object_class, c.fitted.X_TO) for k, c in enumerate(candidates)]

    @cache
    def clash(a: int, b: int) -> bool:
        return penetration(objects[a], objects[b]) > IN_EACH_OTHER

    numbers = chosen(
        [c.explains for c in candidates],
        [c.fitted.score for c in candidates],
        shape,
        LEAST_SHARE,
        clash,
    )
    return [candidates[k] for k in numbers]


class LearnedDetector:
    """Detects objects of some classes in depth, or in depth and colour.

    The shipped networks learned from the default cell's camera: from above the tray's middle,
    straight down. What another one shows them is not rectified; the poses are fitted to any.
    """

    def __init__(
        self,
        network: SegmentationNetwork,
        classes: Sequence[ObjectClass],
        camera: Camera,
        support: Support,
    ) -> None:
        """With a trained network, for objects of these classes, of which it must know all."""
        self._network, self._camera, self._support = network, camera, support
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._classes, self._window = {c.name: c for c in classes}, Window.of(camera, support)
        self._unknown = torch.tensor(
            [False] + [name not in self._classes for name in self._network.classes]
        )
        self._radii = [
            min(self._classes[n].size) / 2 if n in self._classes else 0.0
            for n in self._network.classes
        ]
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
        given = network_input(
            p_TP, color[window.rows, window.columns] if network.looks_at_color else None
        )
        with torch.inference_mode():
            logits, votes = network(
                torch.from_numpy(given)[None].to(memory_format=torch.channels_last)
            )
            logits = logits[0].masked_fill(self._unknown[:, None, None], -torch.inf)
            kind, chances = logits.argmax(dim=0).numpy(), torch.softmax(logits, dim=0)[1:].numpy()
        votes_T = coarse(p_TP) + np.moveaxis(votes[0].numpy(), 0, 2)
        poses = self._sure_first(
            segments(kind, votes_T, self._radii, network.classes, window, depth.shape, LEAST), depth
        )
        surface = surfaces(coarse(p_TP)[..., 2])
        for again in (1, 2):
            best = _best(poses, depth.shape)
            explained = [
                coarse(one.explains.mask(depth.shape)[window.rows, window.columns]) for one in best
            ]
            masks = unexplained(surface, explained)
            if again == 1:
                classes = [network.classes.index(one.object_class.name) for one in best]
                masks += doubtful(surface, explained, classes, chances)
            else:
                masks += [
                    mask
                    for one, mask in zip(best, explained, strict=True)
                    if _seen_past(one.explains)
                ]
                masks = [half for mask in masks for half in halves(mask, votes_T)]
            poses += self._fitted(self._guessed(masks, chances, votes_T, depth.shape), depth)
        counted, found = Counter[str](), list[Detection]()
        clean = without_holes(np.where(depth > 0, depth, np.nan))
        floor = self._camera.floor_depth
        at_floor = np.abs(clean - floor) < FLOOR_WITHIN
        clean[at_floor] = floor[at_floor]
        for candidate in _best(poses, depth.shape):
            name, e = candidate.object_class.name, candidate.explains
            mask = e.mask(depth.shape)
            counted[name] += 1
            clean[mask] = e.away[e.seen]
            answers = coarse(mask[window.rows, window.columns])
            sure = _sure(
                candidate.fitted.X_TO,
                chances[network.classes.index(name)][answers],
                votes_T[answers],
            )
            found.append(
                Detection(
                    f"{name}_{counted[name]}",
                    candidate.object_class,
                    candidate.fitted.X_TO,
                    mask,
                    sure,
                )
            )
        return Observation(clean, tuple(found), self._camera, self._support)

    def _guessed(
        self,
        masks: Sequence[Mask],
        chances: NDArray[np.float32],
        votes_T: NDArray[np.float32],
        shape: tuple[int, int],
    ) -> list[Segment]:
        """A segment for each class that may be in a mask of the network's answers."""
        found = []
        for mask in masks:
            votes = votes_T[mask]
            votes = votes[np.isfinite(votes).all(axis=1)]
            if len(votes) >= LEAST:
                whole, p_TO = (
                    fine(mask, self._window, shape),
                    np.median(votes.astype(np.float64), axis=0),
                )
                found += [
                    Segment(self._network.classes[k], whole, p_TO) for k in possible(mask, chances)
                ]
        return found

    def _sure_first(self, found: Sequence[Segment], depth: NDArray[np.float32]) -> list[_Candidate]:
        """Poses of segments, the largest first; what a sure pose has explained already is left out."""
        fitted, claimed = list[_Candidate](), np.zeros(depth.shape, bool)
        left = deque(sorted(found, key=lambda segment: -np.count_nonzero(segment.mask)))
        while left:
            next_ones = list[Segment]()
            while left and len(next_ones) < SIDE_BY_SIDE:
                segment = left.popleft()
                if claimed[segment.mask].mean() <= CLAIMED:
                    next_ones.append(segment)
            for candidate in self._fitted(next_ones, depth):
                fitted.append(candidate)
                if candidate.fitted.score >= SURE_SCORE:
                    claimed |= candidate.explains.mask(depth.shape)
        return fitted

    def _fitted(self, found: Sequence[Segment], depth: NDArray[np.float32]) -> list[_Candidate]:
        """The poses of segments that are good enough."""
        classes = [self._classes[segment.name] for segment in found]
        poses = self._workers.map(
            lambda s, c: self._fitter.fit(c, s.mask, depth, s.p_TO), found, classes
        )
        return [
            _Candidate(
                object_class, pose, explanation(object_class, pose.X_TO, depth, self._camera)
            )
            for object_class, pose in zip(classes, poses, strict=True)
            if pose is not None
            and pose.score >= LEAST_SCORE
            and self._on_tray(object_class, pose.X_TO)
        ]

    def _on_tray(self, object_class: ObjectClass, X_TO: Pose) -> bool:
        """Whether an object can be there: within the rim, and not below the floor."""
        corners = X_TO.apply(object_class.corners)
        return bool(
            (np.abs(corners[:, :2]) < self._support.half_size + RIM_SLACK).all()
            and corners[:, 2].min() > -2 * FLOOR_SLACK
        )
