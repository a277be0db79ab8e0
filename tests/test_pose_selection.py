"""Of many poses those that are really there, in rendered depth."""

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


def found(
    there: list[SceneObject], said: list[SceneObject], scores: list[float] | None = None
) -> list[int]:
    depth = LabelDetector(CAMERA).perceive(scene_of(*there)).observation.depth
    explained = [evaluate_pose(o.object_class, o.X_TO, depth, CAMERA) for o in said]
    return sorted(select_consistent_poses(explained, scores or [0.8] * len(said), depth.shape, 0.2))


def test_what_is_there_is_found() -> None:
    assert found([BOX, ON_TOP, BESIDE], [BOX, ON_TOP, BESIDE]) == [0, 1, 2]


def test_an_explanation_counts_pixels_as_the_label_image_does() -> None:
    look = LabelDetector(CAMERA).perceive(scene_of(BOX, ON_TOP))
    by_name = {d.name: d.mask for d in look.observation.detections}
    for o in (BOX, ON_TOP):
        e = evaluate_pose(o.object_class, o.X_TO, look.observation.depth, CAMERA)
        mask = np.zeros(look.observation.depth.shape, bool)
        mask[e.window] = e.consistent
        either = np.count_nonzero(mask | by_name[o.name])
        assert np.count_nonzero(mask & by_name[o.name]) > 0.93 * either
    assert e.unoccluded_pixels > 0.97 * np.count_nonzero(e.consistent), (
        "nothing stands before the can"
    )


def test_an_object_that_is_fitted_twice_is_one() -> None:
    again = replace(BOX, X_TO=BOX.X_TO.translated((0.002, -0.001, 0.001)))
    assert found([BOX], [again, BOX], [0.7, 0.9]) == [1]


def test_a_smaller_class_on_the_face_of_a_larger_is_none() -> None:
    part = SceneObject("part", CLASSES["gelatin_box"], Pose((0.03, 0.0, BOX.top_height - 0.014)))
    assert found([BOX], [part, BOX]) == [1]


def test_what_the_camera_sees_past_is_not_there() -> None:
    aside = replace(BESIDE, X_TO=BESIDE.X_TO.translated((0.05, 0.0, 0.0)))
    in_the_air = replace(BESIDE, X_TO=BESIDE.X_TO.translated((0.0, 0.0, 0.05)))
    assert found([BOX, BESIDE], [aside, in_the_air]) == []


def test_what_is_hardly_seen_is_left_out() -> None:
    covered = resting("pudding_box", floor=0.0)
    cover = resting("cracker_box", Orientation.FLAT_0, xy=(0.01, 0.0), floor=covered.top_height)
    assert found([covered, cover], [covered, cover]) == [1]
