"""Errors of poses that are fitted to rendered depth."""

import itertools
import math

import numpy as np
import pytest
from conftest import CATALOG, CLASSES, DEFAULT_CELL, resting, rng, scene_of
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion
from scipy.spatial.transform import Rotation

from drake_clutter.catalog import ObjectClass, Shape
from drake_clutter.grammar import Orientation
from drake_clutter.perception.pose_fit import FittedPose, PoseFitter, pose_error
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer

PANTRY = CATALOG.object_sets["pantry14"]


@pytest.fixture(scope="module")
def fitter() -> PoseFitter:
    """Return one fitter for all tests; no fit may depend on earlier ones."""
    return PoseFitter(DEFAULT_CELL.camera)


def place_on_tray(
    object_class: ObjectClass, R_TO: NDArray[np.float64], xy: NDArray[np.float64]
) -> SceneObject:
    """Return an object on the tray, given its orientation and horizontal position [m]."""
    lowest = float((object_class.corners @ R_TO.T)[:, 2].min())
    return SceneObject(
        object_class.name, object_class, Pose.from_rotation(R_TO, (xy[0], xy[1], -lowest))
    )


def random_resting_object(name: str, up: int, generator: np.random.Generator) -> SceneObject:
    """Return an object at a random position and yaw, its axis `up` vertical."""
    R_AO = np.zeros((3, 3))
    R_AO[2, up], R_AO[0, (up + 1) % 3], R_AO[1, (up + 2) % 3] = 1.0, 1.0, 1.0
    yaw = Rotation.from_euler("z", generator.uniform(0, 2 * math.pi)).as_matrix()
    return place_on_tray(CLASSES[name], yaw @ R_AO, generator.uniform(-0.2, 0.2, 2))


def add_noise(
    depth: NDArray[np.float32], sigma: float, generator: np.random.Generator
) -> NDArray[np.float32]:
    """Return a depth image with Gaussian noise of a standard deviation [m]."""
    return np.asarray(depth + sigma * generator.standard_normal(depth.shape), np.float32)


def fit_pose(
    fitter: PoseFitter,
    camera: CameraRenderer,
    scene: Scene,
    name: str,
    generator: np.random.Generator,
    sigma: float = 0.0,
) -> FittedPose:
    """Fit the pose of an object in a scene from a guess with an error of 1 cm."""
    depth, label = camera.render_depth_and_label(scene)
    true = scene[name]
    error = generator.standard_normal(3)
    guess = true.X_TO.p + 0.01 * error / np.linalg.norm(error)
    mask = label == scene.names.index(name)
    found = fitter.fit(
        true.object_class, mask, add_noise(depth, sigma, generator) if sigma else depth, guess
    )
    assert found is not None
    return found


CASES = [
    (name, up)
    for name in PANTRY
    for up in ((0, 1, 2) if CLASSES[name].shape is Shape.BOX else (0, 2))
]


@pytest.fixture(scope="module")
def errors(
    fitter: PoseFitter, camera: CameraRenderer
) -> dict[float, dict[tuple[str, int], tuple[float, float]]]:
    """Return position [m] and rotation errors [rad] of every resting pose, by noise [m]."""
    # One scene with all classes makes the render engine only once.
    camera.render(scene_of(*(resting(name, xy=(3.0, 0.0), name=name) for name in PANTRY)))
    found: dict[float, dict[tuple[str, int], tuple[float, float]]] = {0.0: {}, 0.0015: {}}
    for sigma, (name, up) in itertools.product(found, CASES):
        o = random_resting_object(name, up, generator := rng(up))
        fit = fit_pose(fitter, camera, scene_of(o), name, generator, sigma)
        found[sigma][name, up] = pose_error(o.object_class, fit.X_TO, o.X_TO)
    return found


def test_median_error_without_noise_is_small(
    errors: dict[float, dict[tuple[str, int], tuple[float, float]]],
) -> None:
    exact = np.array(list(errors[0.0].values()))
    assert np.median(exact[:, 0]) < 0.002
    assert np.median(exact[:, 1]) < math.radians(1.5)


@pytest.mark.parametrize(
    ("sigma", "max_distance", "max_degrees"), [(0.0, 0.006, 5.0), (0.0015, 0.010, 6.0)]
)
def test_all_errors_are_bounded(
    sigma: float,
    max_distance: float,
    max_degrees: float,
    errors: dict[float, dict[tuple[str, int], tuple[float, float]]],
) -> None:
    far = {
        case: e
        for case, e in errors[sigma].items()
        if e[0] > max_distance or e[1] > math.radians(max_degrees)
    }
    assert far == {}


@pytest.mark.parametrize("sigma", [0.0, 0.0015])
def test_half_occluded_objects(sigma: float, fitter: PoseFitter, camera: CameraRenderer) -> None:
    """The visible end determines the position of the box."""
    below = resting("cracker_box", Orientation.FLAT_30, (0.05, -0.02), name="below")
    above = resting("granola_box", Orientation.FLAT_120, (0.12, 0.03), floor=0.060, name="above")
    scene = scene_of(below, above)
    for o in scene.objects:
        found = fit_pose(fitter, camera, scene, o.name, rng(1), sigma)
        distance, angle = pose_error(o.object_class, found.X_TO, o.X_TO)
        assert distance < 0.006
        assert angle < math.radians(3)


@pytest.mark.parametrize("sigma", [0.0, 0.0015])
@pytest.mark.parametrize(
    ("name", "axis"),
    [("sugar_box", (0, 1, 0)), ("cracker_box", (1, 1, 0)), ("tomato_soup_can", (1, 0, 0))],
)
def test_tilted_objects(
    name: str, axis: tuple[float, ...], sigma: float, fitter: PoseFitter, camera: CameraRenderer
) -> None:
    tilt = Rotation.from_rotvec(
        math.radians(25) * np.array(axis) / np.linalg.norm(axis)
    ).as_matrix()
    o = place_on_tray(
        CLASSES[name],
        tilt @ resting(name, Orientation.FLAT_30).X_TO.rotation,
        np.array([0.1, 0.05]),
    )
    found = fit_pose(fitter, camera, scene_of(o), name, rng(2), sigma)
    distance, angle = pose_error(o.object_class, found.X_TO, o.X_TO)
    assert distance < 0.006
    assert angle < math.radians(4)


@pytest.mark.parametrize("error", ["wide", "narrow", "strays"])
@pytest.mark.parametrize("name", ["sugar_box", "tomato_soup_can", "large_marker"])
def test_inaccurate_masks(
    name: str, error: str, fitter: PoseFitter, camera: CameraRenderer
) -> None:
    """The mask is two pixels too wide, one too narrow, or has pixels far from the object."""
    o = resting(name, Orientation.FLAT_30, (0.12, -0.1))
    depth, label = camera.render_depth_and_label(scene_of(o))
    mask = label == 0
    if error == "wide":
        mask = np.asarray(binary_dilation(mask, iterations=2))
    elif error == "narrow":
        mask = np.asarray(binary_erosion(mask))
    else:
        mask.flat[rng(5).integers(mask.size, size=60)] = True
    found = fitter.fit(
        o.object_class,
        mask,
        add_noise(depth, 0.0015, rng(5)),
        o.X_TO.p + np.array([0.006, -0.006, 0.005]),
    )
    assert found is not None
    distance, angle = pose_error(o.object_class, found.X_TO, o.X_TO)
    assert distance < 0.006
    assert angle < math.radians(4)


def test_a_resting_object_is_exactly_at_rest(fitter: PoseFitter, camera: CameraRenderer) -> None:
    o = resting("sugar_box", Orientation.FLAT_60, (0.1, 0.1))
    found = fit_pose(fitter, camera, scene_of(o), "sugar_box", rng(3), 0.001)
    assert np.abs(found.X_TO.rotation[2, 0]) == pytest.approx(1.0, abs=1e-9)
    assert 0.8 < found.score <= 1.0


def test_fits_are_deterministic(camera: CameraRenderer) -> None:
    scene = scene_of(resting("master_chef_can", xy=(0.1, 0.1)))
    fits = [
        fit_pose(PoseFitter(DEFAULT_CELL.camera), camera, scene, "master_chef_can", rng(4), 0.0015)
        for _ in range(2)
    ]
    assert fits[0] == fits[1]


def test_too_few_measurements_result_in_no_pose(fitter: PoseFitter) -> None:
    depth = np.full((480, 640), 1.6, np.float32)
    empty = np.zeros((480, 640), bool)
    assert fitter.fit(CLASSES["sugar_box"], empty, depth, np.zeros(3)) is None
    mask = empty.copy()
    mask[200:240, 300:340] = True
    assert fitter.fit(CLASSES["sugar_box"], mask, np.full_like(depth, np.inf), np.zeros(3)) is None
    assert fitter.fit(CLASSES["sugar_box"], mask, np.zeros_like(depth), np.zeros(3)) is None


def test_images_of_another_size_are_rejected(fitter: PoseFitter) -> None:
    with pytest.raises(ValueError, match=r"\(480, 640\)"):
        fitter.fit(
            CLASSES["sugar_box"], np.ones((4, 4), bool), np.ones((4, 4), np.float32), np.zeros(3)
        )


def test_pose_error_is_the_smallest_over_symmetries() -> None:
    X_TO = Pose.from_rotation(
        Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), (0.1, 0.0, 0.0)
    )
    R = X_TO.rotation
    box, can = CLASSES["sugar_box"], CLASSES["tomato_soup_can"]
    for half_turn in ([math.pi, 0, 0], [0, math.pi, 0], [0, 0, math.pi]):
        same = Pose.from_rotation(
            R @ Rotation.from_rotvec(half_turn).as_matrix(), X_TO.p + np.array([0.0, 0.003, 0.004])
        )
        assert np.array(pose_error(box, same, X_TO)) == pytest.approx(
            np.array([0.005, 0.0]), abs=1e-6
        )
    quarter = Pose.from_rotation(R @ Rotation.from_rotvec([0, 0, math.pi / 2]).as_matrix(), X_TO.p)
    assert pose_error(box, quarter, X_TO)[1] == pytest.approx(math.pi / 2)
    assert pose_error(can, quarter, X_TO)[1] == pytest.approx(0.0, abs=1e-6)
    down = Pose.from_rotation(R @ Rotation.from_rotvec([math.pi - 0.02, 0, 0]).as_matrix(), X_TO.p)
    assert pose_error(can, down, X_TO)[1] == pytest.approx(0.02)
