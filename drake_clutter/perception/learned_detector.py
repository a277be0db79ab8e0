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
from drake_clutter.perception.hypothesis_refinement import (
    MIN_SEGMENT_CELLS,
    Mask,
    candidate_classes,
    find_ambiguous_regions,
    find_unexplained_surfaces,
    label_surfaces,
    split_mask,
)
from drake_clutter.perception.pose_fit import FittedPose, PoseFitter
from drake_clutter.perception.pose_score import MAX_FLOOR_PENETRATION
from drake_clutter.perception.pose_selection import (
    PoseEvidence,
    evaluate_pose,
    select_consistent_poses,
)
from drake_clutter.perception.segmentation import (
    ImageWindow,
    Segment,
    SegmentationNetwork,
    backproject_window,
    downsample,
    extract_segments,
    fill_holes,
    make_network_input,
    upsample,
)
from drake_clutter.scenes.geometry import penetration_depth
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Pose, SceneObject

MIN_SCORE = 0.3
"""Of a fitted pose; what is worse is no detection."""
CONFIDENT_SCORE, MAX_CLAIMED_FRACTION = 0.6, 0.7
"""A pose with that score is sure; a segment of which that share lies in what sure poses explain is a piece of one."""
MAX_RIM_OVERHANG = 0.02
"""m, by which what is recognised may reach past the rim; the arm does, and it is no object."""
CONCURRENT_FITS = 2
"""Segments that are fitted at the same time; always so many, so that the number of cores changes no result."""
FLOOR_DEPTH_TOLERANCE = 0.008
"""m, of the floor; what is measured there is the floor: nothing that lies on it is so flat."""
MAX_PENETRATION = 0.010
"""m; what penetrates deeper is not there together."""
MIN_VISIBLE_FRACTION = 0.2
"""Of the pixels that an object would cover alone, that must be seen of it."""
CONFIDENT_VOTE_FRACTION, VOTE_RADIUS = 0.8, 0.03
"""A detection is sure if such a share of its pixels, by their chances of its class, votes for its middle within so many m."""
SPLIT_FREE_SPACE_RATIO = 0.1
"""Of the pixels in which a pose is seen, that in which the camera sees past it, if two may be there instead."""


class _Candidate(NamedTuple):
    object_class: ObjectClass
    fitted: FittedPose
    evidence: PoseEvidence


def _may_be_two_objects(explains: PoseEvidence) -> bool:
    """Whether the camera sees past so much of a pose that two smaller objects may lie side by side there."""
    return explains.free_space_violations > SPLIT_FREE_SPACE_RATIO * int(
        np.count_nonzero(explains.consistent)
    )


def _is_confident(X_TO: Pose, chances: NDArray[np.float32], votes_T: NDArray[np.float32]) -> bool:
    """Whether the network's answers, chances (n,) of the class and votes (n, 3) m for the middle, say so of a pose."""
    here = np.linalg.norm(votes_T - X_TO.p, axis=1) < VOTE_RADIUS  # false where it is NaN
    return bool((here * chances).sum() > CONFIDENT_VOTE_FRACTION * len(chances))


def _select_candidates(
    candidates: Sequence[_Candidate], shape: tuple[int, int]
) -> list[_Candidate]:
    """Those that together explain an image best, and of which no two are in the same place."""
    objects = [SceneObject(str(k), c.object_class, c.fitted.X_TO) for k, c in enumerate(candidates)]

    @cache
    def clash(a: int, b: int) -> bool:
        return penetration_depth(objects[a], objects[b]) > MAX_PENETRATION

    numbers = select_consistent_poses(
        [c.evidence for c in candidates],
        [c.fitted.score for c in candidates],
        shape,
        MIN_VISIBLE_FRACTION,
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
        self._classes, self._window = (
            {c.name: c for c in classes},
            ImageWindow.around_support(camera, support),
        )
        self._unknown = torch.tensor(
            [False] + [name not in self._classes for name in self._network.classes]
        )
        self._radii = [
            min(self._classes[n].size) / 2 if n in self._classes else 0.0
            for n in self._network.classes
        ]
        self._fitter, self._workers = PoseFitter(camera), ThreadPoolExecutor(CONCURRENT_FITS)

    def detect(self, depth: NDArray[np.float32], color: NDArray[np.uint8]) -> Observation:
        """What two images show; names count the objects of each class, and mean nothing beyond this image.

        The depth of what was recognised, and of the tray's floor, is that of the models: without noise.

        Args:
            depth: (height, width) m along the camera's axis; 0 or infinite where nothing is measured.
            color: (height, width, 3).
        """
        window, network = self._window, self._network
        p_TP = backproject_window(depth, self._camera, window)
        given = make_network_input(
            p_TP, color[window.rows, window.columns] if network.use_color else None
        )
        with torch.inference_mode():
            logits, votes = network(
                torch.from_numpy(given)[None].to(memory_format=torch.channels_last)
            )
            logits = logits[0].masked_fill(self._unknown[:, None, None], -torch.inf)
            kind, chances = logits.argmax(dim=0).numpy(), torch.softmax(logits, dim=0)[1:].numpy()
        votes_T = downsample(p_TP) + np.moveaxis(votes[0].numpy(), 0, 2)
        poses = self._fit_largest_first(
            extract_segments(
                kind, votes_T, self._radii, network.classes, window, depth.shape, MIN_SEGMENT_CELLS
            ),
            depth,
        )
        surface = label_surfaces(downsample(p_TP)[..., 2])
        for again in (1, 2):
            best = _select_candidates(poses, depth.shape)
            explained = [
                downsample(one.evidence.mask(depth.shape)[window.rows, window.columns])
                for one in best
            ]
            masks = find_unexplained_surfaces(surface, explained)
            if again == 1:
                classes = [network.classes.index(one.object_class.name) for one in best]
                masks += find_ambiguous_regions(surface, explained, classes, chances)
            else:
                masks += [
                    mask
                    for one, mask in zip(best, explained, strict=True)
                    if _may_be_two_objects(one.evidence)
                ]
                masks = [half for mask in masks for half in split_mask(mask, votes_T)]
            poses += self._fit(self._propose_segments(masks, chances, votes_T, depth.shape), depth)
        counted, found = Counter[str](), list[Detection]()
        clean = fill_holes(np.where(depth > 0, depth, np.nan))
        floor = self._camera.floor_depth
        at_floor = np.abs(clean - floor) < FLOOR_DEPTH_TOLERANCE
        clean[at_floor] = floor[at_floor]
        for candidate in _select_candidates(poses, depth.shape):
            name, e = candidate.object_class.name, candidate.evidence
            mask = e.mask(depth.shape)
            counted[name] += 1
            clean[mask] = e.rendered_depth[e.consistent]
            answers = downsample(mask[window.rows, window.columns])
            sure = _is_confident(
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

    def _propose_segments(
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
            if len(votes) >= MIN_SEGMENT_CELLS:
                whole, p_TO = (
                    upsample(mask, self._window, shape),
                    np.median(votes.astype(np.float64), axis=0),
                )
                found += [
                    Segment(self._network.classes[k], whole, p_TO)
                    for k in candidate_classes(mask, chances)
                ]
        return found

    def _fit_largest_first(
        self, found: Sequence[Segment], depth: NDArray[np.float32]
    ) -> list[_Candidate]:
        """Poses of segments, the largest first; what a sure pose has explained already is left out."""
        fitted, claimed = list[_Candidate](), np.zeros(depth.shape, bool)
        left = deque(sorted(found, key=lambda segment: -np.count_nonzero(segment.mask)))
        while left:
            next_ones = list[Segment]()
            while left and len(next_ones) < CONCURRENT_FITS:
                segment = left.popleft()
                if claimed[segment.mask].mean() <= MAX_CLAIMED_FRACTION:
                    next_ones.append(segment)
            for candidate in self._fit(next_ones, depth):
                fitted.append(candidate)
                if candidate.fitted.score >= CONFIDENT_SCORE:
                    claimed |= candidate.evidence.mask(depth.shape)
        return fitted

    def _fit(self, found: Sequence[Segment], depth: NDArray[np.float32]) -> list[_Candidate]:
        """The poses of segments that are good enough."""
        classes = [self._classes[segment.name] for segment in found]
        poses = self._workers.map(
            lambda s, c: self._fitter.fit(c, s.mask, depth, s.p_TO), found, classes
        )
        return [
            _Candidate(
                object_class, pose, evaluate_pose(object_class, pose.X_TO, depth, self._camera)
            )
            for object_class, pose in zip(classes, poses, strict=True)
            if pose is not None
            and pose.score >= MIN_SCORE
            and self._is_on_support(object_class, pose.X_TO)
        ]

    def _is_on_support(self, object_class: ObjectClass, X_TO: Pose) -> bool:
        """Whether an object can be there: within the rim, and not below the floor."""
        corners = X_TO.apply(object_class.corners)
        return bool(
            (np.abs(corners[:, :2]) < self._support.half_size + MAX_RIM_OVERHANG).all()
            and corners[:, 2].min() > -2 * MAX_FLOOR_PENETRATION
        )
