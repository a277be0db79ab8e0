"""Association of detections with known objects."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import DEFAULT_CELL, TRAY, resting, scene_of

from drake_clutter.catalog import load_catalog
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import Detection, Observation
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.systems.tracking import associate_detections, match_to_ground_truth

CLASSES, CAMERA = load_catalog().classes, DEFAULT_CELL.camera
CAN = "tomato_soup_can"


def at(x: float, y: float, name: str = CAN) -> SceneObject:
    return SceneObject(
        name, CLASSES[name.rsplit("_", 1)[0] if name[-1].isdigit() else name], Pose((x, y, 0.05))
    )


def image(*objects: SceneObject, top: float = 0.1) -> Observation:
    """Return detections with arbitrary names in an image of a surface at height `top` [m]."""
    depth = np.full((CAMERA.height, CAMERA.width), CAMERA.X_TC.translation()[2] - top, np.float32)
    empty_mask = np.zeros(depth.shape, bool)
    detections = [
        Detection(f"detection {k}", o.object_class, o.X_TO, empty_mask)
        for k, o in enumerate(objects)
    ]
    return Observation(depth, tuple(detections), CAMERA, TRAY)


def names(known: list[SceneObject], observation: Observation) -> dict[str, tuple[float, float]]:
    result, _ = associate_detections(known, observation)
    return {d.name: d.X_TO.translation[:2] for d in result.detections}


def test_new_objects_get_new_names() -> None:
    assert names([], image(at(0, 0), at(0.1, 0))) == {f"{CAN}_1": (0, 0), f"{CAN}_2": (0.1, 0)}
    assert names([at(0, 0, f"{CAN}_1")], image(at(0.01, 0), at(0.2, 0))) == {
        f"{CAN}_1": (0.01, 0),
        f"{CAN}_2": (0.2, 0),
    }


def test_names_of_lost_objects_are_reused_only_once() -> None:
    assert names([at(0, 0, f"{CAN}_2")], image(at(0, 0), at(0.2, 0), at(0.2, 0.2))) == {
        f"{CAN}_1": (0.2, 0),
        f"{CAN}_2": (0, 0),
        f"{CAN}_3": (0.2, 0.2),
    }


def test_two_objects_of_a_class_keep_their_names() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.03, 0, f"{CAN}_2")]
    assert names(known, image(at(0.035, 0), at(0.012, 0))) == {
        f"{CAN}_1": (0.012, 0),
        f"{CAN}_2": (0.035, 0),
    }


def test_objects_of_different_classes_are_not_associated() -> None:
    box = replace(at(0, 0), name="sugar_box_1", object_class=CLASSES["sugar_box"])
    assert set(names([box], image(at(0, 0)))) == {f"{CAN}_1"}


def test_an_object_detected_at_another_position_keeps_its_name() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    floor = image(at(-0.2, 0), at(0.2, 0.2), top=0.0)
    assert names(known, floor) == {f"{CAN}_1": (-0.2, 0), f"{CAN}_2": (0.2, 0.2)}
    covered = image(at(-0.2, 0), at(0.2, 0.2), top=0.1)
    assert names(known, covered)[f"{CAN}_3"] == (-0.2, 0), (
        "the first one may still be there, occluded"
    )


def test_an_object_that_is_gone_and_undetected_is_lost() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    assert associate_detections(known, image(at(0.2, 0.2), top=0.0)).lost == (f"{CAN}_1",)
    assert associate_detections(known, image(at(0.2, 0.2), top=0.1)).lost == ()


def test_each_true_object_is_matched_once_within_its_class() -> None:
    there = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    box = replace(at(0.2, 0.2), name="box", object_class=CLASSES["sugar_box"])
    assert match_to_ground_truth([at(0.01, 0), at(0.02, 0), box], there) == (f"{CAN}_1",)
    assert match_to_ground_truth([], there) == ()


def test_an_object_whose_pixels_belong_to_another_detection_is_lost() -> None:
    """Without the pixels of the can, the box may only have been missed."""
    box = SceneObject("sugar_box_1", CLASSES["sugar_box"], Pose((0.0, 0.0, 0.1 - 0.175 / 2)))
    observed = image(at(0.0, 0.0))
    assert associate_detections([box], observed).lost == ()
    (can,) = observed.detections
    claimed = np.zeros(observed.depth.shape, bool)
    claimed[200:280, 280:360] = True
    assert associate_detections(
        [box], replace(observed, detections=(replace(can, mask=claimed),))
    ).lost == ("sugar_box_1",)


def side_by_side() -> tuple[list[SceneObject], Observation, Observation]:
    """Return two boxes, a correct observation, and one with two boxes across them."""
    apart = CLASSES["sugar_box"].size[1] / 2 + 0.001
    first = [
        resting("sugar_box", Orientation.FLAT_0, (0.0, y), name=f"sugar_box_{k}")
        for k, y in ((1, -apart), (2, apart))
    ]
    observed = LabelDetector(CAMERA).perceive(scene_of(*first)).observation
    both = np.any([d.mask for d in observed.detections], axis=0)
    west = both & (np.arange(both.shape[1]) < np.nonzero(both)[1].mean())
    across = [
        resting("sugar_box", Orientation.FLAT_90, (x, 0.0), name=f"detection {x}")
        for x in (-apart, apart)
    ]
    masks = (west, both & ~west)
    wrong = tuple(
        Detection(o.name, o.object_class, o.X_TO, mask)
        for o, mask in zip(across, masks, strict=True)
    )
    return first, observed, replace(observed, detections=wrong)


def test_known_objects_are_kept_unless_a_detection_explains_more_pixels() -> None:
    known, _, across = side_by_side()
    observation, lost = associate_detections(known, across)
    assert {d.name: d.X_TO for d in observation.detections} == {o.name: o.X_TO for o in known}
    assert lost == ()
    (whole,) = across.detections[:1]
    larger = replace(
        whole,
        mask=np.any([d.mask for d in across.detections], axis=0),
        object_class=CLASSES["cracker_box"],
    )
    observation, lost = associate_detections(known[:1], replace(across, detections=(larger,)))
    assert [d.object_class.name for d in observation.detections] == ["cracker_box"]
    assert lost == ("sugar_box_1",)


def test_confident_detections_replace_known_objects() -> None:
    known, _, across = side_by_side()
    confident = replace(
        across, detections=tuple(replace(d, is_confident=True) for d in across.detections)
    )
    observation, lost = associate_detections(known, confident)
    assert {d.X_TO for d in observation.detections} == {d.X_TO for d in across.detections}
    assert lost == ()


def test_a_missed_object_with_unchanged_depth_is_restored() -> None:
    known, observed, _ = side_by_side()
    observation, _ = associate_detections(
        known, replace(observed, detections=observed.detections[:1])
    )
    assert {d.name: d.X_TO for d in observation.detections} == {o.name: o.X_TO for o in known}
    second = next(d for d in observation.detections if d.name == "sugar_box_2")
    assert (second.mask & observed.detections[1].mask).sum() > 0.9 * observed.detections[
        1
    ].mask.sum()


@pytest.mark.parametrize(("excess", "is_restored"), [(0, True), (1, False)])
def test_a_missed_object_is_restored_if_at_most_half_its_pixels_belong_to_detections(
    excess: int, is_restored: bool
) -> None:
    box = resting("sugar_box", xy=(0.0, 0.1), name="sugar_box_1")
    observed = replace(LabelDetector(CAMERA).perceive(scene_of(box)).observation, detections=())
    (restored,) = associate_detections([box], observed).observation.detections
    pixels = np.flatnonzero(restored.mask)
    assert len(pixels) % 2 == 0
    mask = np.zeros(observed.depth.shape, bool)
    mask.ravel()[pixels[: len(pixels) // 2 + excess]] = True
    other = Detection("can", CLASSES[CAN], Pose((0.2, -0.2, 0.05)), mask, is_confident=True)
    found = associate_detections([box], replace(observed, detections=(other,))).observation
    masks = {d.name: d.mask for d in found.detections}
    assert masks.keys() == {f"{CAN}_1", *(["sugar_box_1"] if is_restored else [])}
    if is_restored:
        assert (masks["sugar_box_1"] == restored.mask & ~mask).all()


def test_an_object_out_of_view_that_penetrates_a_detection_is_lost() -> None:
    known, observed, _ = side_by_side()
    ghost = resting("gelatin_box", xy=known[0].X_TO.translation[:2], name="gelatin_box_1")
    hidden = resting("gelatin_box", xy=(0.25, 0.25), name="gelatin_box_2")
    observation, lost = associate_detections(
        [*known, ghost, hidden],
        replace(observed, depth=np.where(observed.depth > 0, np.float32(1.0), 0)),
    )
    assert len(observation.detections) == 2
    assert lost == ("gelatin_box_1",)


@pytest.mark.parametrize(("fraction", "is_kept"), [(0.4, True), (0.6, False)])
def test_a_larger_known_object_replaces_a_detection_of_which_it_explains_half(
    fraction: float, is_kept: bool
) -> None:
    known, observed, across = side_by_side()
    inside = np.flatnonzero(observed.detections[0].mask)
    outside = np.flatnonzero(~np.any([d.mask for d in observed.detections], axis=0))
    count = round(1000 * fraction)
    mask = np.zeros(observed.depth.shape, bool)
    mask.ravel()[[*inside[:count], *outside[: 1000 - count]]] = True
    detection = replace(across.detections[0], mask=mask)
    observation, _ = associate_detections(known[:1], replace(across, detections=(detection,)))
    assert (detection.X_TO in {d.X_TO for d in observation.detections}) == is_kept
    assert known[0].X_TO in {d.X_TO for d in observation.detections}
