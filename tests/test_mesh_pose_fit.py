"""Poses of meshes, rendered and fitted to depth images."""

import math

import numpy as np
import pytest
import trimesh
from conftest import scene_of
from scipy.spatial.transform import Rotation

from drake_clutter.assets import build_assets
from drake_clutter.catalog import ObjectClass, load_catalog
from drake_clutter.perception.mesh_pose_fit import render_mesh, resting_rotations
from drake_clutter.perception.pose_fit import PoseFitter, pose_error
from drake_clutter.perception.pose_selection import evaluate_pose
from drake_clutter.scenes.scene import Pose, SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer


@pytest.fixture(scope="module")
def stair(tmp_path_factory: pytest.TempPathFactory) -> ObjectClass:
    """A class of two steps, 120 mm x 80 mm, 40 mm and 100 mm high."""
    folder = tmp_path_factory.mktemp("own")
    steps = [
        trimesh.creation.box(bounds=np.array(bounds) / 1000)
        for bounds in ([[-60, -40, 0], [0, 40, 40]], [[0.1, -40, 0], [60, 40, 100]])
    ]
    mesh = trimesh.util.concatenate(steps)
    mesh.export(folder / "stair.stl")  # type: ignore[no-untyped-call]
    (folder / "catalog.yaml").write_text(
        "classes:\n  stair: {shape: mesh, mesh: stair.stl, mass_g: 300}\n"
    )
    build_assets(folder)
    return load_catalog(folder).classes["stair"]


def test_the_rendered_depth_is_that_of_the_renderer(
    stair: ObjectClass, camera: CameraRenderer
) -> None:
    """The camera looks down from a known height: the steps have two depths, and no other."""
    X_TO = Pose((0.0, 0.0, 0.05), (1.0, 0.0, 0.0, 0.0))
    top, left, depth = render_mesh(stair, X_TO.rotation, X_TO.p, camera.camera)
    rows, columns = depth.shape
    images = camera.render(scene_of(SceneObject("stair", stair, X_TO)))
    window = (slice(top, top + rows), slice(left, left + columns))
    both = np.isfinite(depth) & (images.label[window] == 0)
    assert np.count_nonzero(both) > 0.95 * np.count_nonzero(images.label == 0)
    error = np.abs(depth[both] - images.depth[window][both])
    assert np.quantile(error, 0.95) < 0.002


def test_a_mesh_is_found_in_its_pose(stair: ObjectClass, camera: CameraRenderer) -> None:
    """The guessed center is 10 mm off; the object stands on its side y."""
    up_y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    R_TO = Rotation.from_euler("z", 2.9).as_matrix() @ up_y
    X_TO = Pose.from_rotation(R_TO, (0.1, -0.05, 0.04))
    images = camera.render(scene_of(SceneObject("stair", stair, X_TO)))
    guess = X_TO.p + np.array([0.006, -0.006, 0.005])
    found = PoseFitter(camera.camera).fit(stair, images.label == 0, images.depth, guess)
    assert found is not None
    position_error, rotation_error = pose_error(stair, found.X_TO, X_TO)
    assert position_error < 0.003
    assert rotation_error < math.radians(3)
    assert found.score > 0.8
    evidence = evaluate_pose(stair, found.X_TO, images.depth, camera.camera)
    assert evidence.consistent.sum() > 0.85 * evidence.num_unoccluded_pixels
    assert evidence.num_free_space_violations < 0.15 * evidence.num_unoccluded_pixels


def test_meshes_rest_on_the_sides_that_their_class_allows(stair: ObjectClass) -> None:
    rotations = resting_rotations(stair)
    assert np.linalg.det(rotations) == pytest.approx(np.ones(6))
    ups = {tuple(np.round(R[2]).astype(int)) for R in rotations}
    assert len(ups) == 6
