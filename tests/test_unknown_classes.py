"""Networks refuse object classes that they were not trained with, in one line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, scene_of

from drake_clutter.catalog import load_catalog
from drake_clutter.commands.run_scenario import run_closed_loop
from drake_clutter.files import InputError
from drake_clutter.perception.image_dataset import LabeledImage
from drake_clutter.perception.segmentation import ImageWindow
from drake_clutter.perception.segmentation_training import make_example
from drake_clutter.scenes.scene import Scene
from drake_clutter.systems.scenario import Scenario, make_perception


@pytest.fixture
def own(tmp_path: Path) -> tuple[Scenario, Scene]:
    """A scenario with the depth detector, and a scene with a class of the user."""
    (tmp_path / "catalog.yaml").write_text(
        "classes:\n  tin: {shape: box, size_mm: [50, 60, 70], mass_g: 100}\n"
        "object_sets:\n  mine: [sugar_box, tin]\n"
    )
    tin = load_catalog(tmp_path).classes["tin"]
    scene = scene_of(replace(resting("pudding_box"), name="tin", object_class=tin))
    return Scenario(catalog=str(tmp_path), objects="mine", perception="depth"), scene


def test_a_detector_refuses_classes_that_it_never_saw(own: tuple[Scenario, Scene]) -> None:
    scenario, scene = own
    with pytest.raises(
        InputError,
        match=r"^perception: depth: the detector was not trained with tin; train one with your",
    ):
        run_closed_loop(replace(scenario, agent="random"), scene, lambda _: None)


def test_a_detector_needs_an_object_set_with_the_classes_of_the_scene(
    own: tuple[Scenario, Scene],
) -> None:
    scenario, scene = own
    with pytest.raises(
        InputError, match=r"^objects: ycb7; expected a set with all classes of .* contains tin$"
    ):
        make_perception(replace(scenario, objects="ycb7"), scene)
    assert make_perception(replace(scenario, perception="labels"), scene) is None


def test_a_student_refuses_classes_before_the_episode(own: tuple[Scenario, Scene]) -> None:
    scenario, scene = own
    with pytest.raises(InputError, match=r"student\.safetensors: was not trained with tin; train"):
        run_closed_loop(replace(scenario, perception="labels"), scene, lambda _: None)


def test_a_training_refuses_images_with_other_classes() -> None:
    camera = DEFAULT_CELL.camera
    shape = (camera.height, camera.width)
    image = LabeledImage(
        np.zeros((*shape, 3), np.uint8),
        np.ones(shape, np.float32),
        np.full(shape, -1),
        ("sugar_box", "tin"),
        (),
        np.zeros(0, np.int64),
    )
    window = ImageWindow.around_support(camera, DEFAULT_CELL.support)
    with pytest.raises(
        InputError, match=r"^images: show tin; expected objects of sugar_box alone$"
    ):
        make_example(image, ["sugar_box"], camera, window, None, False)
