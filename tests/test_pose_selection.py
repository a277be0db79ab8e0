"""Selection of consistent poses in rendered depth images."""

from dataclasses import replace

import numpy as np
from conftest import CLASSES, DEFAULT_CELL, resting, scene_of

from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.perception.pose_selection import evaluate_pose, select_consistent_poses
from drake_clutter.scenes.scene import Pose, SceneObject

CAMERA = DEFAULT_CELL.camera
BOX = resting("cracker_box", Orientation.FLAT_0)
ON_TOP = resting("tomato_soup_can", xy=(0.03, 0.02), floor=BOX.top_height)
BESIDE = resting("gelatin_box", xy=(0.2, 0.1))


MIN_VISIBLE_FRACTION = 0.2


def select(
    true_objects: list[SceneObject],
    hypotheses: list[SceneObject],
    scores: list[float] | None = None,
) -> list[int]:
    """Return the indices of the hypotheses that are selected in a scene of true objects."""
    depth = LabelDetector(CAMERA).perceive(scene_of(*true_objects)).observation.depth
    evidence = [evaluate_pose(o.object_class, o.X_TO, depth, CAMERA) for o in hypotheses]
    scores = scores or [0.8] * len(hypotheses)
    return sorted(select_consistent_poses(evidence, scores, depth.shape, MIN_VISIBLE_FRACTION))


def test_all_true_poses_are_selected() -> None:
    assert select([BOX, ON_TOP, BESIDE], [BOX, ON_TOP, BESIDE]) == [0, 1, 2]


def test_evidence_agrees_with_the_label_image() -> None:
    observation = LabelDetector(CAMERA).perceive(scene_of(BOX, ON_TOP)).observation
    by_name = {d.name: d.mask for d in observation.detections}
    for o in (BOX, ON_TOP):
        evidence = evaluate_pose(o.object_class, o.X_TO, observation.depth, CAMERA)
        mask = np.zeros(observation.depth.shape, bool)
        mask[evidence.window] = evidence.consistent
        union = np.count_nonzero(mask | by_name[o.name])
        assert np.count_nonzero(mask & by_name[o.name]) > 0.93 * union
    num_consistent = np.count_nonzero(evidence.consistent)
    assert evidence.num_unoccluded_pixels > 0.97 * num_consistent, "nothing occludes the can"


def test_an_object_with_two_hypotheses_is_selected_once() -> None:
    inaccurate = replace(BOX, X_TO=BOX.X_TO.translated((0.002, -0.001, 0.001)))
    assert select([BOX], [inaccurate, BOX], [0.7, 0.9]) == [1]


def test_a_smaller_class_on_the_face_of_a_larger_object_is_rejected() -> None:
    pose = Pose((0.03, 0.0, BOX.top_height - 0.014))
    smaller = SceneObject("smaller", CLASSES["gelatin_box"], pose)
    assert select([BOX], [smaller, BOX]) == [1]


def test_poses_with_free_space_violations_are_rejected() -> None:
    aside = replace(BESIDE, X_TO=BESIDE.X_TO.translated((0.05, 0.0, 0.0)))
    floating = replace(BESIDE, X_TO=BESIDE.X_TO.translated((0.0, 0.0, 0.05)))
    assert select([BOX, BESIDE], [aside, floating]) == []


def test_a_mostly_occluded_object_is_not_selected() -> None:
    covered = resting("pudding_box", floor=0.0)
    cover = resting("cracker_box", Orientation.FLAT_0, xy=(0.01, 0.0), floor=covered.top_height)
    assert select([covered, cover], [covered, cover]) == [1]
