"""Cameras at arbitrary poses: agreement with Drake's images, and free space."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, random_scene, resting, rng, scene_of, tray, world_with
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation
from test_camera_renderer import SCATTERED, outline
from test_placement import carried_by, deepest_with, placed_at
from test_rays import SCENES, labels

from drake_clutter.cell.camera import Camera, pixel_grid
from drake_clutter.cell.pinhole import backproject, point_to_camera, pose_to_camera, project
from drake_clutter.cell.pose_spec import PoseSpec
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.commands.render_scene import render_scene
from drake_clutter.config import upgrade_config
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.perception.pose_fit import PoseFitter, pose_error
from drake_clutter.perception.pose_selection import evaluate_pose
from drake_clutter.perception.segmentation import ImageWindow
from drake_clutter.reports.detection_image import IMAGE_SIDE, draw_detections
from drake_clutter.resources import resource_path
from drake_clutter.scenes.free_space import is_observed_free
from drake_clutter.scenes.occlusion import occluded_boxes
from drake_clutter.scenes.placement import has_clear_top
from drake_clutter.scenes.scene import Scene
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.systems.scenario import Scenario
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import load_config_as

CELL = load_cell(resource_path("models/cells/ur10_tilted_camera.yaml"))
CAMERA = CELL.camera
RAYS = RayCaster(CAMERA)
OPEN_MINDED = RayCaster(CAMERA.model_copy(update={"visibility_threshold": 1e-9}))


@pytest.fixture(scope="module")
def tilted() -> LabelDetector:
    """Return a detector for all tests."""
    return LabelDetector(CAMERA)


def anywhere(seed: int) -> Camera:
    """Return a camera at a random pose."""
    generator = rng(seed)
    translation, rpy_deg = (
        tuple(generator.uniform(-most, most, 3).tolist()) for most in (2.0, 180.0)
    )
    return Camera(
        pose=PoseSpec(translation=translation, rpy_deg=rpy_deg),
        width=320 + seed,
        height=240 - seed,
        fov_y_deg=50.0,
    )


# --- The model ---


@pytest.mark.parametrize("seed", range(8))
def test_points_are_recovered_from_pixels_and_depths(seed: int) -> None:
    """Backprojection inverts projection, and the compiled model agrees."""
    camera, generator = anywhere(seed), rng(seed)
    pixels, depth = generator.uniform(-50.0, 400.0, (40, 2)), generator.uniform(0.1, 5.0, 40)
    p_T = camera.backproject(pixels, depth)
    assert camera.project(p_T) == pytest.approx(pixels, abs=1e-8)
    assert camera.depth(p_T) == pytest.approx(depth, abs=1e-12)
    p_C = camera.rays(pixels) * depth[:, None]
    assert camera.to_camera(p_T) == pytest.approx(p_C, abs=1e-12)
    by_pose = camera.X_TC.multiply(p_C.T).T
    assert by_pose == pytest.approx(p_T, abs=1e-12)
    assert np.array([point_to_camera(camera.pinhole, *p) for p in p_T]) == pytest.approx(
        p_C, abs=1e-12
    )
    assert np.array([project(camera.pinhole, *p) for p in p_C]) == pytest.approx(pixels, abs=1e-8)
    again = [backproject(camera.pinhole, u, v, d) for (u, v), d in zip(pixels, depth, strict=True)]
    assert np.array(again) == pytest.approx(p_T, abs=1e-12)
    as_image = camera.backproject(pixels.reshape(5, 8, 2), depth.reshape(5, 8))
    assert np.array_equal(as_image.reshape(40, 3), p_T)


@pytest.mark.parametrize("seed", range(3))
def test_a_pose_in_the_camera_s_frame(seed: int) -> None:
    camera, generator = anywhere(seed), rng(seed)
    R, p = Rotation.random(rng=generator).as_matrix(), generator.uniform(-1, 1, 3)
    R_CO, p_CO = pose_to_camera(camera.pinhole, R, p)
    corner = generator.uniform(-0.1, 0.1, 3)
    assert R_CO @ corner + p_CO == pytest.approx(
        camera.to_camera((R @ corner + p)[None])[0], abs=1e-12
    )


def test_a_vertical_camera_is_exact() -> None:
    """Its rotation is exact: x, -y and height differences, also with 32 bits."""
    camera, p_T = DEFAULT_CELL.camera, rng(0).uniform(-0.5, 0.5, (100, 3))
    assert camera.is_vertical
    assert not CAMERA.is_vertical
    assert np.array_equal(
        camera.to_camera(p_T), np.column_stack([p_T[:, 0], -p_T[:, 1], 1.6 - p_T[:, 2]])
    )
    depth = rng(1).uniform(1.0, 1.6, 100).astype(np.float32)
    pixels = rng(2).integers(0, 400, (100, 2)).astype(np.float32)
    assert camera.backproject(pixels, depth).dtype == np.dtype(np.float32)
    assert np.array_equal(camera.backproject(pixels, depth)[:, 2], np.float32(1.6) - depth)
    assert (camera.floor_depth == np.float32(1.6)).all()


def test_floor_depth_and_horizon() -> None:
    pixels = pixel_grid((480, 640))
    assert CAMERA.backproject(pixels, CAMERA.floor_depth.astype(float))[..., 2] == pytest.approx(
        0.0, abs=1e-6
    )
    level = Camera(pose=PoseSpec(translation=(0.0, -2.0, 0.4), rpy_deg=(-90.0, 0.0, 0.0)))
    row = level.principal_point[1]
    assert np.isinf(level.floor_depth[: int(row) + 1]).all()
    below = np.arange(480) > row + 1
    assert level.floor_depth[below, 0] == pytest.approx(
        0.4 * level.focal_length / (np.arange(480)[below] - row), rel=1e-5
    )
    assert np.array_equal(RayCaster(level).observe(scene_of())[0].depth, level.floor_depth)


# --- Against Drake's images ---


@pytest.mark.parametrize("scene", SCENES.values(), ids=list(SCENES))
def test_rays_of_a_tilted_camera_meet_what_it_renders(scene: Scene, tilted: LabelDetector) -> None:
    """Same tolerances as for a vertical camera in `test_rays.py`."""
    perception, rendered = tilted.perceive(scene), tilted.renderer.render_label(scene)
    observation, shares = RAYS.observe(scene)
    assert shares == pytest.approx(perception.visible_fractions, abs=0.003)
    assert [d.name for d in observation.detections] == [
        d.name for d in perception.observation.detections
    ]
    cast = labels(scene, OPEN_MINDED)
    assert (cast == rendered).mean() >= 0.9999
    errors = [
        np.abs(observation.depth - perception.observation.depth)[
            binary_erosion((rendered == k) & (cast == k))
        ]
        for k in range(len(scene.objects))
    ]
    error = np.concatenate(errors)
    assert error.size > 5000
    assert np.quantile(error, 0.99) < 1.5e-6
    assert error.max() < 1e-4


def test_floor_depth_of_a_tilted_camera_equals_the_rendered_depth(tilted: LabelDetector) -> None:
    rendered = tilted.renderer.render(scene_of()).depth
    pixels = pixel_grid(rendered.shape)
    inside = (np.abs(CAMERA.backproject(pixels, CAMERA.floor_depth)[..., :2]) < 0.30).all(axis=-1)
    assert rendered[inside] == pytest.approx(CAMERA.floor_depth[inside], abs=2e-6)


@pytest.mark.parametrize("rpy_deg", [(215.0, 10.0, 70.0), (170.0, -20.0, -130.0)])
def test_rays_of_cameras_in_all_orientations(rpy_deg: tuple[float, float, float]) -> None:
    """Cameras at 1.3 m from a point above the tray's center; the frame cuts off some objects."""
    axis = Rotation.from_euler("xyz", rpy_deg, degrees=True).as_matrix()[:, 2]
    pose = PoseSpec(
        translation=tuple((np.array([0.0, 0.0, 0.1]) - 1.3 * axis).tolist()), rpy_deg=rpy_deg
    )
    config = Camera(pose=pose, width=320, height=240, visibility_threshold=1e-9)
    scene, camera, caster = SCENES["tumbled 0"], CameraRenderer(config), RayCaster(config)
    assert caster.visible_fractions(scene.objects) == pytest.approx(
        camera.visible_fractions(scene), abs=0.02
    )
    assert (labels(scene, caster) == camera.render_label(scene)).mean() >= 0.9995


def test_project_agrees_with_the_label_image_of_a_tilted_camera(tilted: LabelDetector) -> None:
    """As in `test_camera_renderer.py`; no pixel center may lie in the tip of a corner."""
    label, shifts = tilted.renderer.render_label(SCATTERED), []
    for index, o in enumerate(SCATTERED.objects):
        corners, centroid = outline(tilted.renderer, o)
        rows, columns = np.nonzero(label == index)
        assert np.array([columns.mean(), rows.mean()]) == pytest.approx(centroid, abs=1.0)
        assert np.array([columns.min(), rows.min()]) == pytest.approx(corners.min(axis=0), abs=1.5)
        assert np.array([columns.max(), rows.max()]) == pytest.approx(corners.max(axis=0), abs=1.5)
        shifts.append(np.array([columns.mean(), rows.mean()]) - centroid)
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.25  # pixels


def test_hidden_from_a_tilted_camera_is_not_hidden_from_above(
    detector: LabelDetector, tilted: LabelDetector
) -> None:
    """The object stands close behind a high box, seen from the camera."""
    scene = scene_of(
        resting("cracker_box", Orientation.UPRIGHT_0, (0.0, 0.0), name="wall"),
        resting("gelatin_box", xy=(0, 0.08)),
    )
    assert tilted.perceive(scene).visible_fractions["gelatin_box"] < 0.3
    assert detector.perceive(scene).visible_fractions["gelatin_box"] == 1.0


def test_an_object_that_reaches_behind_the_camera_is_not_visible() -> None:
    low = Camera(pose=PoseSpec(translation=(0.0, 0.0, 0.3), rpy_deg=(-100.0, 0.0, 0.0)))
    beneath = scene_of(
        resting("sugar_box", xy=(0.0, -0.05), name="beneath"), resting("gelatin_box", xy=(0.0, 0.9))
    )
    assert RayCaster(low).visible_fractions(beneath.objects) == {"beneath": 1.0, "gelatin_box": 1.0}
    assert [d.name for d in RayCaster(low).observe(beneath)[0].detections] == ["gelatin_box"]


# --- Poses ---


@pytest.mark.parametrize("name", ["cracker_box", "sugar_box", "tomato_soup_can", "gelatin_box"])
def test_poses_are_fitted_to_images_of_a_tilted_camera(name: str, tilted: LabelDetector) -> None:
    """As accurately as from above; the true pose explains the object's pixels."""
    scene = scene_of(
        resting(name, Orientation.FLAT_30, (-0.15, 0.1), name="it"),
        resting("pudding_box", xy=(0.2, -0.1), name="another"),
    )
    depth, label = tilted.renderer.render_depth_and_label(scene)
    true = scene["it"]
    guess = true.X_TO.p + np.array([0.006, -0.006, 0.005])
    found = PoseFitter(CAMERA).fit(true.object_class, label == 0, depth, guess)
    assert found is not None
    p_error, angle = pose_error(true.object_class, found.X_TO, true.X_TO)
    assert p_error < 0.003
    assert angle < math.radians(2.0)
    explained = evaluate_pose(true.object_class, true.X_TO, depth, CAMERA)
    assert (
        explained.mask(depth.shape) != (label == 0)
    ).sum() <= 0.02 * explained.num_unoccluded_pixels
    assert explained.num_free_space_violations <= 0.02 * explained.num_unoccluded_pixels


@pytest.mark.parametrize("camera", [CAMERA, DEFAULT_CELL.camera], ids=["tilted", "vertical"])
def test_the_crop_of_the_network_contains_the_tray(camera: Camera) -> None:
    window = ImageWindow.around_support(camera, tray(0.70))
    corners = camera.project(
        np.array([[x, y, z] for x in (-0.35, 0.35) for y in (-0.35, 0.35) for z in (0.0, 0.3)])
    )
    assert (corners >= [window.columns.start, window.rows.start]).all()
    assert (corners < [window.columns.stop, window.rows.stop]).all()
    assert window.side % 16 == 0


def test_detections_are_drawn(tilted: LabelDetector) -> None:
    picture = draw_detections(tilted.perceive(SCENES["laid out"]).observation)
    assert picture.shape == (IMAGE_SIDE, IMAGE_SIDE, 3)


# --- What is free, and what is unseen ---


@pytest.mark.parametrize("seed", range(3))
def test_placements_seen_by_a_tilted_camera_are_free(seed: int, tilted: LabelDetector) -> None:
    """Placements are free of visible and of hidden objects."""
    scene = random_scene(seed)
    observation, generator = tilted.perceive(scene).observation, rng(seed)
    moves = legal_moves(observation)
    checked = 0
    for move in [moves[i] for i in generator.permutation(len(moves))[:40]]:
        X_TO = placed_at(observation, move, generator)
        if X_TO is not None:
            checked += 1
            assert deepest_with(scene, move.pick, X_TO, tuple(carried_by(scene, move.pick))) <= 0
    assert checked >= 5


def test_free_space_is_along_the_rays(tilted: LabelDetector) -> None:
    """Space behind a wall and outside of the frame is unobserved, although nothing is above it."""
    observation = tilted.perceive(
        scene_of(resting("cracker_box", Orientation.UPRIGHT_0, name="wall"))
    ).observation
    points = np.array(
        [
            [0.0, 0.06, 0.05],
            [0.0, -0.06, 0.05],
            [0.0, 0.30, 0.05],
            [0.0, 0.0, 0.24],
            [0.0, 3.0, 0.0],
            [0.0, -2.0, 2.0],
        ]
    )
    assert is_observed_free(observation, points).tolist() == [False, True, True, True, False, False]
    assert has_clear_top(observation, observation["wall"])


def test_space_behind_known_objects_is_occluded(tilted: LabelDetector) -> None:
    """Occluded boxes contain hidden objects, except next to known ones, and no observed space."""
    wall = resting("cracker_box", Orientation.UPRIGHT_0, name="wall")
    hidden = resting("gelatin_box", xy=(0.0, 0.072), name="hidden")
    empty = tilted.perceive(scene_of()).observation.depth
    observation = tilted.perceive(scene_of(wall, hidden)).observation
    assert [d.name for d in observation.detections] == ["wall"]
    blocks = occluded_boxes([wall], observation, empty)
    grid = np.stack(np.meshgrid(*(np.linspace(-0.9, 0.9, 9) for _ in range(3))), axis=-1).reshape(
        -1, 3
    )
    p_T = hidden.X_TO.apply(grid * np.asarray(hidden.object_class.size) / 2)
    is_near_wall = (np.abs(p_T - wall.X_TO.p) < np.ptp(wall.corners_T, axis=0) / 2 + 0.03).all(
        axis=1
    )
    unseen = p_T[~is_observed_free(observation, p_T) & ~is_near_wall & (p_T[:, 2] > 0.012)]
    full = np.zeros(len(unseen), bool)
    for block in blocks:
        c, s = math.cos(block.yaw), math.sin(block.yaw)
        p_B = (unseen - block.center) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        full |= (np.abs(p_B) <= np.array(block.size) / 2 + 1e-9).all(axis=1)
    assert len(unseen) > 100
    assert full.all()
    assert all(block.center[1] > 0.03 for block in blocks)


def test_occluded_boxes_are_as_high_as_the_shadow(tilted: LabelDetector) -> None:
    """The shadow ends at the line from the camera over the upper edge of the wall.

    The boxes have the height of the shadow at their near side, rounded up to the 10 mm of the grid.
    """
    wall = resting("cracker_box", Orientation.UPRIGHT_0, name="wall")
    empty = tilted.perceive(scene_of()).observation.depth
    blocks = occluded_boxes([wall], tilted.perceive(scene_of(wall)).observation, empty)
    (x, far, top), (_, y_TC, z_TC) = wall.corners_T.max(axis=0), CAMERA.X_TC.translation()
    slope = (top - z_TC) / (far - y_TC)
    behind = [block for block in blocks if abs(block.center[0]) < x - 0.03]
    assert len({block.top_height for block in behind}) == 3
    for block in behind:
        shadow = top + slope * (block.center[1] - block.size[1] / 2 - far)
        assert shadow <= block.top_height <= min(shadow + 0.01, top)


def test_unidentified_flat_objects_are_seen_by_a_tilted_camera(tilted: LabelDetector) -> None:
    """An unidentified object of 28 mm gives an occluded box; floor and rim give none."""
    empty = tilted.perceive(scene_of()).observation.depth
    assert occluded_boxes([], tilted.perceive(scene_of()).observation, empty) == ()
    stranger = resting("gelatin_box", xy=(0.1, 0.1), name="stranger")
    (block,) = occluded_boxes([], tilted.perceive(scene_of(stranger)).observation, empty)
    assert block.top_height == pytest.approx(0.028, abs=2e-3)
    assert np.hypot(block.center[0] - 0.1, block.center[1] - 0.1) < 0.02


# --- Cells ---


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        (
            "cameras.overhead.pose.roll=0",
            r"cameras\.overhead: does not see the support; expected a pose",
        ),
        (
            "cameras.overhead.pose.x=5",
            r"cameras\.overhead: does not see the support; expected a pose",
        ),
    ],
)
def test_a_camera_that_does_not_see_the_support_is_refused(setting: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        load_config_as(DEFAULT_CELL, settings=[setting])
    assert "\n" not in str(raised.value)


def test_a_second_camera_may_see_something_else(tmp_path: Path) -> None:
    """All cameras of a cell are rendered to files with the camera's name as prefix."""
    aside = "{pose: {translation: [0, -1, 1], rpy_deg: [-135, 0, 0]}, width: 64, height: 48}"
    world = world_with(f"cell.cameras.aside={aside}")
    assert world.cell.camera == DEFAULT_CELL.camera
    scene = scene_of(resting("sugar_box"))
    shares = render_scene(scene, world, tmp_path)
    assert shares == {"sugar_box": 1.0}
    files = {
        f"{name}_{kind}"
        for name in ("overhead", "aside")
        for kind in ("color.png", "depth.png", "label.png", "visible.json")
    }
    assert {path.name for path in tmp_path.iterdir()} == {*files, "picture.png"}
    with pytest.raises(InputError, match="a camera's name"):
        world_with(f"cell.cameras={{a/b: {aside}}}")


def test_depth_noise_of_an_earlier_scenario_moves_to_the_camera() -> None:
    scenario = load_config_as(
        Scenario(),
        settings=["camera_noise=false", "world.cell.robot.base.x=-0.7"],
        upgrade=upgrade_config,
    )
    assert not scenario.world.cell.camera.depth_noise
    assert scenario.world.cell.camera.pose == DEFAULT_CELL.camera.pose
    assert Scenario().world.cell.camera.depth_noise


@pytest.mark.parametrize("height", [0.10, 0.15, 0.30, 0.60])
def test_occluded_boxes_end_at_the_support_for_low_cameras(
    height: float,
) -> None:
    """An unidentified object above the camera occludes nothing behind the camera."""
    camera = Camera(
        pose=PoseSpec(translation=(0.0, -1.0, height), rpy_deg=(-90.0 - 20.0 * height, 0.0, 0.0))
    )
    detector, stranger = (
        LabelDetector(camera),
        resting("cracker_box", Orientation.UPRIGHT_0, (0.05, 0.0)),
    )
    empty = np.where(camera.floor_depth < 5, camera.floor_depth, np.float32(np.inf))
    blocks = occluded_boxes(
        [], replace(detector.perceive(scene_of(stranger)).observation, detections=()), empty
    )
    assert blocks
    for block in blocks:
        low, high = (
            np.array(block.center) - np.array(block.size) / 2,
            np.array(block.center) + np.array(block.size) / 2,
        )
        assert np.abs([low[:2], high[:2]]).max() < 0.36 * math.sqrt(2)
        assert high[2] < 0.25
