"""Names that last from image to image."""

from dataclasses import replace

import numpy as np
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
    """Of objects whose names say nothing; everywhere is seen what is `top` high, m."""
    depth = np.full((CAMERA.height, CAMERA.width), CAMERA.X_TC.translation()[2] - top, np.float32)
    nothing = np.zeros(depth.shape, bool)
    detections = [
        Detection(f"seen {k}", o.object_class, o.X_TO, nothing) for k, o in enumerate(objects)
    ]
    return Observation(depth, tuple(detections), CAMERA, TRAY)


def names(known: list[SceneObject], observation: Observation) -> dict[str, tuple[float, float]]:
    found, _ = associate_detections(known, observation)
    return {d.name: d.X_TO.translation[:2] for d in found.detections}


def test_what_is_new_gets_a_name_of_its_own() -> None:
    assert names([], image(at(0, 0), at(0.1, 0))) == {f"{CAN}_1": (0, 0), f"{CAN}_2": (0.1, 0)}
    assert names([at(0, 0, f"{CAN}_1")], image(at(0.01, 0), at(0.2, 0))) == {
        f"{CAN}_1": (0.01, 0),
        f"{CAN}_2": (0.2, 0),
    }


def test_the_names_of_what_was_lost_are_given_again_but_never_twice() -> None:
    assert names([at(0, 0, f"{CAN}_2")], image(at(0, 0), at(0.2, 0), at(0.2, 0.2))) == {
        f"{CAN}_1": (0.2, 0),
        f"{CAN}_2": (0, 0),
        f"{CAN}_3": (0.2, 0.2),
    }


def test_two_of_a_class_are_not_exchanged() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.03, 0, f"{CAN}_2")]
    assert names(known, image(at(0.035, 0), at(0.012, 0))) == {
        f"{CAN}_1": (0.012, 0),
        f"{CAN}_2": (0.035, 0),
    }


def test_classes_are_told_apart() -> None:
    box = replace(at(0, 0), name="sugar_box_1", object_class=CLASSES["sugar_box"])
    assert set(names([box], image(at(0, 0)))) == {f"{CAN}_1"}


def test_what_is_gone_from_its_place_and_seen_elsewhere_has_moved() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    floor = image(at(-0.2, 0), at(0.2, 0.2), top=0.0)
    assert names(known, floor) == {f"{CAN}_1": (-0.2, 0), f"{CAN}_2": (0.2, 0.2)}
    covered = image(at(-0.2, 0), at(0.2, 0.2), top=0.1)
    assert names(known, covered)[f"{CAN}_3"] == (-0.2, 0), (
        "the first may still be where it was, below something"
    )


def test_what_is_gone_and_not_in_view_is_lost() -> None:
    known = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    assert associate_detections(known, image(at(0.2, 0.2), top=0.0)).lost == (f"{CAN}_1",)
    assert associate_detections(known, image(at(0.2, 0.2), top=0.1)).lost == ()


def test_each_object_is_recognised_once_and_as_what_it_is() -> None:
    there = [at(0, 0, f"{CAN}_1"), at(0.2, 0.2, f"{CAN}_2")]
    box = replace(at(0.2, 0.2), name="box", object_class=CLASSES["sugar_box"])
    assert match_to_ground_truth([at(0.01, 0), at(0.02, 0), box], there) == (f"{CAN}_1",)
    assert match_to_ground_truth([], there) == ()


def test_what_was_taken_for_something_else_is_lost() -> None:
    """A box known where a can is now recognised, by its pixels; without that, it may only have been missed."""
    box = SceneObject("sugar_box_1", CLASSES["sugar_box"], Pose((0.0, 0.0, 0.1 - 0.175 / 2)))
    seen = image(at(0.0, 0.0))
    assert associate_detections([box], seen).lost == ()
    (can,) = seen.detections
    claimed = np.zeros(seen.depth.shape, bool)
    claimed[200:280, 280:360] = True
    assert associate_detections(
        [box], replace(seen, detections=(replace(can, mask=claimed),))
    ).lost == ("sugar_box_1",)


def side_by_side() -> tuple[list[SceneObject], Observation, Observation]:
    """Two boxes, what is seen of them, and what is seen if they are taken for two that lie across them."""
    apart = CLASSES["sugar_box"].size[1] / 2 + 0.001
    first = [
        resting("sugar_box", Orientation.FLAT_0, (0.0, y), name=f"sugar_box_{k}")
        for k, y in ((1, -apart), (2, apart))
    ]
    seen = LabelDetector(CAMERA).perceive(scene_of(*first)).observation
    both = np.any([d.mask for d in seen.detections], axis=0)
    west = both & (np.arange(both.shape[1]) < np.nonzero(both)[1].mean())
    across = [
        resting("sugar_box", Orientation.FLAT_90, (x, 0.0), name=f"seen {x}")
        for x in (-apart, apart)
    ]
    masks = (west, both & ~west)
    wrong = tuple(
        Detection(o.name, o.object_class, o.X_TO, mask)
        for o, mask in zip(across, masks, strict=True)
    )
    return first, seen, replace(seen, detections=wrong)


def test_what_is_known_stands_until_something_explains_more() -> None:
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


def test_what_is_known_gives_way_to_what_a_detector_is_sure_of() -> None:
    known, _, across = side_by_side()
    sure = replace(
        across, detections=tuple(replace(d, is_confident=True) for d in across.detections)
    )
    observation, lost = associate_detections(known, sure)
    assert {d.X_TO for d in observation.detections} == {d.X_TO for d in across.detections}
    assert lost == ()


def test_what_was_missed_once_but_looks_the_same_is_still_in_view() -> None:
    known, seen, _ = side_by_side()
    observation, _ = associate_detections(known, replace(seen, detections=seen.detections[:1]))
    assert {d.name: d.X_TO for d in observation.detections} == {o.name: o.X_TO for o in known}
    second = next(d for d in observation.detections if d.name == "sugar_box_2")
    assert (second.mask & seen.detections[1].mask).sum() > 0.9 * seen.detections[1].mask.sum()


def test_what_is_in_the_place_of_something_seen_is_lost() -> None:
    known, seen, _ = side_by_side()
    ghost = resting("gelatin_box", xy=known[0].X_TO.translation[:2], name="gelatin_box_1")
    hidden = resting("gelatin_box", xy=(0.25, 0.25), name="gelatin_box_2")
    observation, lost = associate_detections(
        [*known, ghost, hidden], replace(seen, depth=np.where(seen.depth > 0, np.float32(1.0), 0))
    )
    assert len(observation.detections) == 2
    assert lost == ("gelatin_box_1",)
