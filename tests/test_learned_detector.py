"""Shipped detectors on images that are not part of the training data."""

import numpy as np
import pytest
from conftest import CATALOG, resting, scene_of

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.perception.learned_detector import LearnedDetector
from drake_clutter.perception.segmentation import SegmentationNetwork
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.systems.scenario import PRETRAINED_DETECTORS


@pytest.fixture(scope="module", params=PRETRAINED_DETECTORS)
def detector(request: pytest.FixtureRequest, config: ClutterConfig) -> LearnedDetector:
    network = SegmentationNetwork.load(resource_path(PRETRAINED_DETECTORS[request.param]))
    return LearnedDetector(
        network, CATALOG.object_set("ycb7"), config.cell.camera, config.cell.support
    )


def cluttered_scene() -> Scene:
    """Return a scene with two adjacent small boxes, which together look like a larger one."""
    boxes = [
        resting("gelatin_box", Orientation.FLAT_0, (0.0, y), name=f"gelatin_box_{y}")
        for y in (-0.0375, 0.0375)
    ]
    others = [
        resting("sugar_box", Orientation.FLAT_90, (-0.2, 0.1)),
        resting("tomato_soup_can", xy=(0.2, 0.15)),
    ]
    return scene_of(*boxes, *others, resting("cracker_box", Orientation.FLAT_0, (0.2, -0.2)))


def test_all_objects_are_detected_with_confidence(
    detector: LearnedDetector, config: ClutterConfig
) -> None:
    scene = cluttered_scene()
    images = CameraRenderer(config.cell.camera).render(scene)
    observation = detector.detect(images.depth, images.color)
    assert sorted(d.object_class.name for d in observation.detections) == sorted(
        o.object_class.name for o in scene.objects
    )
    for o in scene.objects:
        nearest = min(
            observation.detections, key=lambda d: float(np.linalg.norm(d.X_TO.p - o.X_TO.p))
        )
        assert nearest.object_class.name == o.object_class.name
        assert np.linalg.norm(nearest.X_TO.p - o.X_TO.p) < 0.005
    assert sum(d.is_confident for d in observation.detections) >= len(scene.objects) - 1


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0])
def test_a_camera_that_sees_nothing(
    value: float, detector: LearnedDetector, config: ClutterConfig
) -> None:
    camera = config.cell.camera
    depth = np.full((camera.height, camera.width), value, np.float32)
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    with pytest.raises(InputError, match="0 % of the pixels over the support are measured"):
        detector.detect(depth, color)
    depth[:, : camera.width // 2] = camera.floor_depth[:, : camera.width // 2]
    assert detector.detect(depth, color).detections == (), "half of the tray is seen, and empty"


def test_images_of_another_size(detector: LearnedDetector) -> None:
    with pytest.raises(
        InputError, match=r"\(240, 320\) and \(480, 640, 3\); expected \(480, 640\)"
    ):
        detector.detect(np.ones((240, 320), np.float32), np.zeros((480, 640, 3), np.uint8))


def test_class_probabilities(detector: LearnedDetector, config: ClutterConfig) -> None:
    """They sum to 1 over the classes of the detector and no object, at any temperature."""
    scene = scene_of(resting("cracker_box"), resting("tomato_soup_can", xy=(0.2, 0.2)))
    images = CameraRenderer(config.cell.camera).render(scene)
    certain = list[float]()
    for temperature in (1.0, 4.0):
        detector._network.temperature = temperature
        for detection in detector.detect(images.depth, images.color).detections:
            p = detection.class_probabilities
            assert p.keys() == {"", *(c.name for c in CATALOG.object_set("ycb7"))}
            assert sum(p.values()) == pytest.approx(1.0)
            assert max(p, key=lambda name: p[name]) == detection.object_class.name
            certain.append(p[detection.object_class.name])
    detector._network.temperature = 1.0
    assert len(certain) == 4
    assert max(certain[2:]) < min(certain[:2])


def test_an_empty_tray_has_no_detections(detector: LearnedDetector, config: ClutterConfig) -> None:
    images = CameraRenderer(config.cell.camera).render(scene_of())
    assert detector.detect(images.depth, images.color).detections == ()
