"""Detector on images: a network segments the objects, a geometric fit gives their poses."""

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
from drake_clutter.files import InputError
from drake_clutter.perception.calibration import apply_temperature
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
    SegmentationNetwork,
    backproject_window,
    downsample,
    fill_holes,
    make_network_input,
    upsample,
)
from drake_clutter.perception.vote_segments import Segment, extract_segments
from drake_clutter.scenes.geometry import penetration_depth
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Pose, SceneObject

MIN_MEASURED_FRACTION = 0.1
"""Smallest fraction of pixels over the support with a measured depth.

The noise model of the D435 leaves at least 0.9. Below this bound an empty tray could not be
distinguished from a covered camera.
"""
MIN_SCORE = 0.3
"""Smallest score of a fitted pose that may become a detection."""
CONFIDENT_SCORE = 0.6
"""Score from which a pose claims the pixels that it explains."""
MAX_CLAIMED_FRACTION = 0.7
"""Segments with a larger fraction of claimed pixels are parts of fitted objects, and not fitted."""
MAX_RIM_OVERHANG = 0.02
"""By how much a detection may extend beyond the rim [m]; the arm, which is no object, does more."""
CONCURRENT_FITS = 2
"""Number of segments that are fitted at a time; constant, because it influences the results."""
FLOOR_DEPTH_TOLERANCE = 0.008
"""Largest depth difference at which a pixel is taken for the floor [m]; no object is so flat."""
MAX_PENETRATION = 0.010
"""Largest penetration of two detections [m]."""
MIN_VISIBLE_FRACTION = 0.2
"""Smallest fraction of a detection's unoccluded pixels that must be consistent with its pose."""
CONFIDENT_VOTE_FRACTION = 0.8
"""Probability-weighted fraction of a confident detection's cells that vote for its center."""
VOTE_RADIUS = 0.03
"""Largest distance of a vote from the center that it is for [m]."""
SPLIT_FREE_SPACE_RATIO = 0.1
"""Free-space violations per consistent pixel from which a pose may be that of two objects."""


class _Candidate(NamedTuple):
    """A fitted pose with its evidence.

    Attributes:
        object_class: Class of the object.
        fitted: Pose and score.
        evidence: Comparison of the pose with the depth image.
    """

    object_class: ObjectClass
    fitted: FittedPose
    evidence: PoseEvidence


class _CellPredictions(NamedTuple):
    """Output of the network for the (h, w) cells of its window.

    Attributes:
        class_map: Most probable class of each cell plus 1; 0: no object. Shape (h, w).
        class_probabilities: Probability of each class. Shape (classes, h, w).
        votes_T: Predicted position of the object's center [m]. Shape (h, w, 3).
    """

    class_map: NDArray[np.int64]
    class_probabilities: NDArray[np.float32]
    votes_T: NDArray[np.float32]


def _may_be_two_objects(evidence: PoseEvidence) -> bool:
    """Return whether two smaller objects side by side may explain the pixels of a pose better."""
    num_consistent = int(np.count_nonzero(evidence.consistent))
    return evidence.num_free_space_violations > SPLIT_FREE_SPACE_RATIO * num_consistent


def _is_confident(
    X_TO: Pose, probabilities: NDArray[np.float32], votes_T: NDArray[np.float32]
) -> bool:
    """Return whether the network's predictions confirm a detection.

    Args:
        X_TO: Pose of the detection.
        probabilities: Probability of its class in each of its cells. Shape (n,).
        votes_T: Predicted center in each of its cells [m]; may be NaN. Shape (n, 3).
    """
    is_near = np.linalg.norm(votes_T - X_TO.p, axis=1) < VOTE_RADIUS  # False for NaN.
    return bool((is_near * probabilities).sum() > CONFIDENT_VOTE_FRACTION * len(probabilities))


def _select_candidates(
    candidates: Sequence[_Candidate], image_shape: tuple[int, int]
) -> list[_Candidate]:
    """Return the candidates that together explain an image best and do not penetrate each other."""
    objects = [SceneObject(str(k), c.object_class, c.fitted.X_TO) for k, c in enumerate(candidates)]
    bounds = [o.bounds_T for o in objects]

    @cache
    def conflict(a: int, b: int) -> bool:
        # Objects whose bounding boxes overlap less penetrate less, too.
        (lower_a, upper_a), (lower_b, upper_b) = bounds[a], bounds[b]
        overlap = np.minimum(upper_a, upper_b) - np.maximum(lower_a, lower_b)
        if overlap.min() <= MAX_PENETRATION:
            return False
        return penetration_depth(objects[a], objects[b]) > MAX_PENETRATION

    indices = select_consistent_poses(
        [c.evidence for c in candidates],
        [c.fitted.score for c in candidates],
        image_shape,
        MIN_VISIBLE_FRACTION,
        conflict,
    )
    return [candidates[k] for k in indices]


class LearnedDetector:
    """Detect objects in a depth image, or in depth and color.

    A segmentation network finds the objects, and geometric methods fit their poses. The shipped
    networks are trained for the default cell's camera, which looks straight down at the center of
    the tray. Images of other cameras are not rectified for the network.
    """

    def __init__(
        self,
        network: SegmentationNetwork,
        classes: Sequence[ObjectClass],
        camera: Camera,
        support: Support,
    ) -> None:
        """Create a detector.

        Args:
            network: Trained network.
            classes: Classes to detect; the network must have been trained with all of them.
            camera: Camera of the images.
            support: Support of the objects.

        Raises:
            InputError: The network was not trained with one of the classes.
        """
        unknown = sorted({c.name for c in classes} - set(network.classes))
        if unknown:
            raise InputError(
                f"the detector was not trained with {', '.join(unknown)}; "
                "train one with your objects by training/train_detector.py"
            )
        self._network = network
        self._camera = camera
        self._support = support
        self._network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._classes = {c.name: c for c in classes}
        self._window = ImageWindow.around_support(camera, support)
        self._is_excluded = torch.tensor(
            [False] + [name not in self._classes for name in self._network.classes]
        )
        self._vote_radii = [
            min(self._classes[n].size) / 2 if n in self._classes else 0.0
            for n in self._network.classes
        ]
        self._fitter = PoseFitter(camera)
        self._executor = ThreadPoolExecutor(CONCURRENT_FITS)

    def detect(self, depth: NDArray[np.float32], color: NDArray[np.uint8]) -> Observation:
        """Detect the objects in a depth and color image.

        Args:
            depth: Measured depth [m]; 0 or infinite where there is no measurement. Shape (H, W).
            color: Color image. Shape (H, W, 3).

        Returns:
            The detections, whose names number the objects of each class in this image, and the
            depth image. Depth of detected objects and of the floor is that of their models, without
            noise, and holes are filled.

        Raises:
            InputError: An image does not have the camera's size, or depth is measured nearly
                nowhere over the support: the camera is covered or broken.
        """
        window, network = self._window, self._network
        self._check_images(depth, color)
        p_TP = backproject_window(depth, self._camera, window)
        predictions = self._predict(p_TP, color)
        segments = extract_segments(
            predictions.class_map,
            predictions.votes_T,
            self._vote_radii,
            network.classes,
            window,
            depth.shape,
            MIN_SEGMENT_CELLS,
        )
        candidates = self._fit_largest_first(segments, depth)
        surface = label_surfaces(downsample(p_TP)[..., 2])
        for is_first_round in (True, False):
            selected = _select_candidates(candidates, depth.shape)
            explained = [
                downsample(c.evidence.mask(depth.shape)[window.rows, window.columns])
                for c in selected
            ]
            masks = find_unexplained_surfaces(surface, explained)
            if is_first_round:
                classes = [network.classes.index(c.object_class.name) for c in selected]
                masks += find_ambiguous_regions(
                    surface, explained, classes, predictions.class_probabilities
                )
            else:
                masks += [
                    mask
                    for c, mask in zip(selected, explained, strict=True)
                    if _may_be_two_objects(c.evidence)
                ]
                masks = [half for mask in masks for half in split_mask(mask, predictions.votes_T)]
            candidates += self._fit(self._propose_segments(masks, predictions, depth.shape), depth)
        return self._observation(depth, _select_candidates(candidates, depth.shape), predictions)

    def _check_images(self, depth: NDArray[np.float32], color: NDArray[np.uint8]) -> None:
        """Check sizes, and that the camera sees something; see `detect`."""
        size = (self._camera.height, self._camera.width)
        if depth.shape != size or color.shape != (*size, 3):
            raise InputError(
                f"depth and color image: shapes {depth.shape} and {color.shape}; "
                f"expected {size} and {(*size, 3)}, the size of the camera"
            )
        shown = depth[self._window.rows, self._window.columns]
        fraction = np.count_nonzero(np.isfinite(shown) & (shown > 0)) / shown.size
        if fraction < MIN_MEASURED_FRACTION:
            raise InputError(
                f"depth image: {100 * fraction:.0f} % of the pixels over the support are measured; "
                f"expected at least {100 * MIN_MEASURED_FRACTION:.0f} %, is the camera covered?"
            )

    def _predict(self, p_TP: NDArray[np.float32], color: NDArray[np.uint8]) -> _CellPredictions:
        """Return the network's predictions.

        Args:
            p_TP: Measured points of the window [m]. Shape (side, side, 3).
            color: Color image. Shape (H, W, 3).
        """
        window_color = color[self._window.rows, self._window.columns]
        network_input = make_network_input(p_TP, window_color if self._network.use_color else None)
        with torch.inference_mode():
            logits, offsets = self._network(
                torch.from_numpy(network_input)[None].to(memory_format=torch.channels_last)
            )
            logits = logits[0].masked_fill(self._is_excluded[:, None, None], -torch.inf)
            class_map = logits.argmax(dim=0).numpy()
            class_probabilities = torch.softmax(logits, dim=0)[1:].numpy()
        votes_T = downsample(p_TP) + np.moveaxis(offsets[0].numpy(), 0, 2)
        return _CellPredictions(class_map, class_probabilities, votes_T)

    def _observation(
        self,
        depth: NDArray[np.float32],
        selected: Sequence[_Candidate],
        predictions: _CellPredictions,
    ) -> Observation:
        """Return the observation of the selected candidates."""
        window = self._window
        clean_depth = fill_holes(np.where(depth > 0, depth, np.nan))
        floor_depth = self._camera.floor_depth
        is_floor = np.abs(clean_depth - floor_depth) < FLOOR_DEPTH_TOLERANCE
        clean_depth[is_floor] = floor_depth[is_floor]
        num_detected = Counter[str]()
        detections = list[Detection]()
        for candidate in selected:
            name = candidate.object_class.name
            evidence = candidate.evidence
            mask = evidence.mask(depth.shape)
            num_detected[name] += 1
            clean_depth[mask] = evidence.rendered_depth[evidence.consistent]
            cells = downsample(mask[window.rows, window.columns])
            is_confident = _is_confident(
                candidate.fitted.X_TO,
                predictions.class_probabilities[self._network.classes.index(name)][cells],
                predictions.votes_T[cells],
            )
            detections.append(
                Detection(
                    f"{name}_{num_detected[name]}",
                    candidate.object_class,
                    candidate.fitted.X_TO,
                    mask,
                    is_confident,
                    self._class_probabilities(predictions, cells),
                )
            )
        return Observation(clean_depth, tuple(detections), self._camera, self._support)

    def _class_probabilities(
        self, predictions: _CellPredictions, cells: NDArray[np.bool_]
    ) -> dict[str, float]:
        """Return the calibrated class probabilities of a detection, given its cells."""
        if not cells.any():
            return {}
        mean = predictions.class_probabilities[:, cells].mean(axis=1)
        named = {
            name: float(p)
            for name, p in zip(self._network.classes, mean, strict=True)
            if name in self._classes
        }
        named[""] = max(0.0, 1.0 - sum(named.values()))
        return apply_temperature(named, self._network.temperature)

    def _propose_segments(
        self, masks: Sequence[Mask], predictions: _CellPredictions, image_shape: tuple[int, int]
    ) -> list[Segment]:
        """Return a segment for each probable class of each mask of cells."""
        segments = []
        for mask in masks:
            votes = predictions.votes_T[mask]
            votes = votes[np.isfinite(votes).all(axis=1)]
            if len(votes) >= MIN_SEGMENT_CELLS:
                image_mask = upsample(mask, self._window, image_shape)
                p_TO = np.median(votes.astype(np.float64), axis=0)
                segments += [
                    Segment(self._network.classes[k], image_mask, p_TO)
                    for k in candidate_classes(mask, predictions.class_probabilities)
                ]
        return segments

    def _fit_largest_first(
        self, segments: Sequence[Segment], depth: NDArray[np.float32]
    ) -> list[_Candidate]:
        """Fit segments in the order of their size, without those that confident poses explain."""
        candidates = list[_Candidate]()
        claimed = np.zeros(depth.shape, bool)
        remaining = deque(sorted(segments, key=lambda segment: -np.count_nonzero(segment.mask)))
        while remaining:
            batch = list[Segment]()
            while remaining and len(batch) < CONCURRENT_FITS:
                segment = remaining.popleft()
                if claimed[segment.mask].mean() <= MAX_CLAIMED_FRACTION:
                    batch.append(segment)
            for candidate in self._fit(batch, depth):
                candidates.append(candidate)
                if candidate.fitted.score >= CONFIDENT_SCORE:
                    claimed |= candidate.evidence.mask(depth.shape)
        return candidates

    def _fit(self, segments: Sequence[Segment], depth: NDArray[np.float32]) -> list[_Candidate]:
        """Fit the poses of segments, and return those with a sufficient score."""
        classes = [self._classes[segment.class_name] for segment in segments]
        poses = self._executor.map(
            lambda s, c: self._fitter.fit(c, s.mask, depth, s.p_TO), segments, classes
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
        """Return whether an object is within the rim and not below the floor."""
        corners = X_TO.apply(object_class.corners)
        is_within_rim = np.abs(corners[:, :2]) < self._support.half_size + MAX_RIM_OVERHANG
        return bool(is_within_rim.all() and corners[:, 2].min() > -2 * MAX_FLOOR_PENETRATION)
