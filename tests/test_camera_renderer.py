"""Rendered images and visible fractions against geometry, and independence of history."""

import numpy as np
import pytest
from conftest import resting, rng, scene_of
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from drake_clutter.cell.camera import Camera
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer

UPRIGHT = Orientation.UPRIGHT_0
BELOW = resting("cracker_box", name="below")  # 230 mm x 160 mm, 60 mm high
SCATTERED = scene_of(
    resting("gelatin_box", Orientation.FLAT_30, (-0.25, 0.25), name="gelatin"),
    resting("sugar_box", UPRIGHT, (0.2, 0.2), name="sugar"),
    resting("master_chef_can", xy=(0.25, -0.1), name="chef"),
    resting("large_marker", Orientation.FLAT_60, (-0.2, -0.2), name="marker"),
    resting("pudding_box", Orientation.SIDE_90, (0.0, -0.28), name="pudding"),
)
CROWDED = scene_of(
    *(
        resting("gelatin_box", xy=(x, y), name=f"{x} {y}")
        for x in (-0.2, 0.0, 0.2)
        for y in (-0.2, 0.0, 0.2)
    ),
    resting("cracker_box", xy=(0.1, 0.1), floor=0.028, name="cover"),
    # The position is not round: where an edge meets the floor at the centers of pixels, the result
    # is ambiguous.
    resting("cracker_box", UPRIGHT, (-0.3013, 0.1007), name="wall"),
)


def same(one: RenderedImages, other: RenderedImages) -> bool:
    """Assert equal labels, and bitwise equal color and depth on the objects.

    At the seams of the tray, a pixel may differ.
    """
    seen = one.label >= 0
    return bool(
        np.array_equal(one.label, other.label)
        and np.array_equal(one.color[seen], other.color[seen])
        and np.array_equal(one.depth[seen], other.depth[seen])
        and np.allclose(one.depth, other.depth, rtol=0.0, atol=1e-5)
    )


def test_an_object_under_a_larger_one_is_hidden(camera: CameraRenderer) -> None:
    scene = scene_of(
        resting("gelatin_box", name="gelatin"), resting("cracker_box", floor=0.028, name="cover")
    )
    shares = camera.visible_fractions(scene)
    assert shares == {"gelatin": 0.0, "cover": 1.0}
    assert camera.hidden_objects(shares) == ("gelatin",)


def test_hidden_is_below_the_threshold_in_order() -> None:
    camera = CameraRenderer(Camera.overhead(1.6, visibility_threshold=0.25))
    assert camera.hidden_objects({"b": 0.0, "a": 0.2499, "c": 0.25, "d": 1.0}) == ("b", "a")


def test_half_covered(camera: CameraRenderer) -> None:
    """The upper box ends below the camera's axis, so it hides exactly what lies to its right."""
    shares = camera.visible_fractions(
        scene_of(BELOW, resting("cracker_box", xy=(0.115, 0.0), floor=0.060, name="above"))
    )
    assert shares["below"] == pytest.approx(0.5, abs=1 / 92)  # the box is 92 pixels long
    assert shares["above"] == 1.0


@pytest.mark.parametrize(
    ("name", "length", "width", "height"),
    [
        ("sugar_box", 0.175, 0.089, 0.038),
        ("granola_box", 0.200, 0.140, 0.055),
        ("gelatin_box", 0.085, 0.073, 0.028),
    ],
)
def test_a_smaller_box_in_the_center_hides_what_its_top_covers(
    name: str, length: float, width: float, height: float, camera: CameraRenderer
) -> None:
    """Areas of both rectangles scale with the inverse squared distance."""
    covered = length * width / (1.60 - 0.060 - height) ** 2 / (0.230 * 0.160 / (1.60 - 0.060) ** 2)
    shares = camera.visible_fractions(scene_of(BELOW, resting(name, floor=0.060, name="above")))
    assert shares == {"below": pytest.approx(1 - covered, abs=0.02), "above": 1.0}


def test_unoccluded_objects_are_fully_visible(camera: CameraRenderer) -> None:
    assert set(camera.visible_fractions(SCATTERED).values()) == {1.0}


def test_fractions_refer_to_each_object_rendered_alone(camera: CameraRenderer) -> None:
    """Objects that are far apart in the image share a rendering, without effect."""
    label = camera.render_label(CROWDED)
    expected = {}
    for index, o in enumerate(CROWDED.objects):
        alone = int((camera.render_label(scene_of(o)) == 0).sum())
        expected[o.name] = float((label == index).sum()) / alone
    assert camera.visible_fractions(CROWDED) == expected
    assert 0.0 < expected["0.0 0.0"] < 1.0


def test_an_object_out_of_the_frame_is_not_hidden(camera: CameraRenderer) -> None:
    shares = camera.visible_fractions(
        scene_of(resting("sugar_box", xy=(5.0, 0.0), name="far"), BELOW)
    )
    assert shares == {"far": 1.0, "below": 1.0}


@pytest.mark.parametrize(
    ("objects", "top"),
    [
        ([], 0.0),
        ([BELOW], 0.060),
        ([resting("tomato_soup_can")], 0.101),
        ([resting("cracker_box", UPRIGHT)], 0.230),
    ],
)
def test_depth_in_the_center_is_the_distance_to_the_top(
    objects: list[SceneObject], top: float, camera: CameraRenderer
) -> None:
    corner = resting("large_marker", xy=(0.3, 0.3), name="marker")
    images = camera.render(scene_of(*objects, corner))
    center = images.depth[239:241, 319:321]
    assert center == pytest.approx(np.full((2, 2), 1.60 - top), abs=0.001)
    assert (images.label[239:241, 319:321] == (0 if objects else -1)).all()


def test_shapes_and_types(camera: CameraRenderer) -> None:
    images = camera.render(SCATTERED)
    assert images.color.shape == (480, 640, 3)
    assert images.color.dtype == np.dtype(np.uint8)
    assert images.depth.shape == images.label.shape == (480, 640)
    assert images.depth.dtype == np.dtype(np.float32)
    assert set(np.unique(images.label)) == {-1, 0, 1, 2, 3, 4}
    assert np.isinf(images.depth[0, 0])  # beside the tray
    assert np.array_equal(camera.render_label(SCATTERED), images.label)


def outline(
    camera: CameraRenderer, o: SceneObject
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return corners and centroid of the object's convex outline in the image [px]."""
    points = camera.camera.project(o.corners_T)
    around = points[ConvexHull(points).vertices]
    following = np.roll(around, -1, axis=0)
    cross = around[:, 0] * following[:, 1] - following[:, 0] * around[:, 1]
    return around, ((around + following) * cross[:, None]).sum(axis=0) / (3 * cross.sum())


@pytest.mark.parametrize("index", range(5), ids=SCATTERED.names)
def test_project_agrees_with_the_label_image(index: int, camera: CameraRenderer) -> None:
    """Masks agree to the pixel: a pixel belongs to an object if its center does."""
    corners, centroid = outline(camera, SCATTERED.objects[index])
    rows, columns = np.nonzero(camera.render_label(SCATTERED) == index)
    assert np.array([columns.mean(), rows.mean()]) == pytest.approx(centroid, abs=1.0)
    assert np.array([columns.min(), rows.min()]) == pytest.approx(corners.min(axis=0), abs=1.0)
    assert np.array([columns.max(), rows.max()]) == pytest.approx(corners.max(axis=0), abs=1.5)


def test_a_picture_from_elsewhere_has_its_own_labels(camera: CameraRenderer) -> None:
    near = camera.render(SCATTERED, Pose((0.0, 0.0, 1.00), (0.0, 1.0, 0.0, 0.0)))
    here = camera.render_label(SCATTERED)
    assert (near.label >= 0).sum() > 1.5 * (here >= 0).sum()


def test_project_is_not_shifted(camera: CameraRenderer) -> None:
    shifts = []
    label = camera.render_label(SCATTERED)
    for index, o in enumerate(SCATTERED.objects):
        rows, columns = np.nonzero(label == index)
        shifts.append(np.array([columns.mean(), rows.mean()]) - outline(camera, o)[1])
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.25  # pixels


def test_project_by_hand(camera: CameraRenderer) -> None:
    """In the image, x points to the right and y up.

    A point at half the altitude is twice as far from the center, shifted by half a pixel.
    """
    f = camera.camera.focal_length
    points = camera.camera.project(
        np.array([[0.0, 0.0, 0.0], [0.16, 0.0, 0.0], [0.0, 0.16, 0.0], [0.16, 0.16, 0.8]])
    )
    center = np.array([319.0, 239.0])
    assert points - center == pytest.approx(
        f * np.array([[0, 0], [0.1, 0], [0, -0.1], [0.2, -0.2]])
    )


def test_images_do_not_depend_on_what_was_rendered_before(config_camera: Camera) -> None:
    """Images do not depend on earlier scenes or on the size of the pool of bodies."""
    camera = CameraRenderer(config_camera)
    first = camera.render(SCATTERED)
    crowded = camera.render(CROWDED)
    assert same(camera.render(SCATTERED), first)
    other = CameraRenderer(config_camera)
    assert same(other.render(CROWDED), crowded)
    assert same(other.render(SCATTERED), first)
    assert other.visible_fractions(SCATTERED) == camera.visible_fractions(SCATTERED)
    assert not same(first, crowded)


@pytest.fixture(scope="module")
def config_camera() -> Camera:
    return Camera.overhead(1.6, width=320, height=240)


def test_the_order_of_objects_changes_labels_alone(camera: CameraRenderer) -> None:
    backwards = Scene(SCATTERED.objects[::-1], SCATTERED.support)
    one, other = camera.render(SCATTERED), camera.render(backwards)
    assert np.array_equal(one.color, other.color)
    assert np.array_equal(one.depth, other.depth)
    assert np.array_equal(np.where(one.label >= 0, 4 - one.label, -1), other.label)


def test_another_tray_is_drawn(camera: CameraRenderer) -> None:
    """The depth along a row shows the side of the tray, whose rim is 25 mm high."""
    for side in (0.50, 0.70):
        depth = camera.render(scene_of(resting("large_marker", name="m"), side=side)).depth[200]
        floor = np.flatnonzero(np.abs(depth - 1.60) < 0.001)
        visible = (floor[-1] - floor[0]) / camera.camera.focal_length * 1.60
        assert visible == pytest.approx(side, abs=0.02)


def test_a_picture_from_elsewhere(camera: CameraRenderer) -> None:
    """From the camera's own pose the images are equal; from lower down, depths are smaller."""
    down = (0.0, 1.0, 0.0, 0.0)  # half a turn about x
    assert same(camera.render(SCATTERED, Pose((0.0, 0.0, 1.60), down)), camera.render(SCATTERED))
    near = camera.render(SCATTERED, Pose((0.0, 0.0, 1.00), down))
    assert near.depth[240, 320] == pytest.approx(1.00, abs=0.001)
    assert near.color.shape == (480, 640, 3)


def test_the_detector_reports_what_is_not_hidden(detector: LabelDetector) -> None:
    scene = scene_of(
        *(
            resting("gelatin_box", name="gelatin"),
            resting("cracker_box", floor=0.028, name="cover"),
        ),
        resting("large_marker", Orientation.FLAT_90, (0.2, 0.1), name="marker"),
    )
    look, images = detector.perceive(scene), detector.renderer.render(scene)
    observation = look.observation
    assert [d.name for d in observation.detections] == ["cover", "marker"]
    assert look.visible_fractions == {"gelatin": 0.0, "cover": 1.0, "marker": 1.0}
    for detection in observation.detections:
        o = scene[detection.name]
        assert (detection.object_class, detection.X_TO) == (o.object_class, o.X_TO)
        assert np.array_equal(detection.mask, images.label == scene.objects.index(o))
        assert detection.mask.any()
    assert observation["marker"].name == "marker"
    with pytest.raises(KeyError, match="'gelatin' is not in view; in view are cover, marker"):
        observation["gelatin"]
    assert np.array_equal(observation.depth, images.depth)
    assert observation.support == scene.support


def test_detections_of_a_random_heap_are_those_above_the_threshold(detector: LabelDetector) -> None:
    generator = rng(4)
    heap = scene_of(
        *(
            resting(
                "pudding_box",
                Orientation.FLAT_60,
                generator.uniform(-0.1, 0.1, 2).tolist(),
                floor=0.035 * k,
                name=f"pudding {k}",
            )
            for k in range(8)
        )
    )
    look = detector.perceive(heap)
    expected = [name for name, share in look.visible_fractions.items() if share >= 0.30]
    assert [d.name for d in look.observation.detections] == expected
    assert 0 < len(expected) < 8
