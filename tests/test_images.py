"""Datasets of labeled images, and the noise of a stereo camera."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, TRAY, resting, rng, scene_of, training_script
from numpy.typing import NDArray

from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.perception.depth_noise import D435_DEPTH_NOISE, DepthNoise, add_depth_noise
from drake_clutter.perception.image_dataset import (
    ImageDataset,
    LabeledImage,
    encode_run_lengths,
    write_images,
)
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.simulation.camera_renderer import CameraRenderer
from drake_clutter.simulation.drop import sample_drop_scene, simulate_drop

SCENE = scene_of(
    resting("gelatin_box", xy=(0.2, -0.2), name="under"),
    resting("cracker_box", xy=(0.2, -0.2), floor=0.028, name="over"),
    resting("tomato_soup_can", xy=(-0.2, 0.1), name="can"),
    resting("large_marker", Orientation.FLAT_30, (-0.1, -0.2), name="marker"),
)


def decode_run_lengths(counts: list[int], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask of COCO's uncompressed counts by their definition."""
    pixels = [k % 2 == 1 for k, count in enumerate(counts) for _ in range(count)]
    return np.reshape(pixels, shape, order="F")


@pytest.fixture(scope="module")
def images(camera: CameraRenderer) -> list[LabeledImage]:
    """Return images of the scene with and without the upper box."""
    known: dict[SceneObject, int] = {}
    render_image = training_script("render_image_dataset").render_image
    generator = rng()
    scenes = (SCENE, scene_of(*(o for o in SCENE.objects if o.name != "over")))
    return [render_image(camera, scene, known, generator) for scene in scenes]


@pytest.mark.parametrize(("distance", "expected"), [(1.0, 0.0010), (1.6, 0.0025)])
def test_noise_grows_with_the_square_of_the_distance(distance: float, expected: float) -> None:
    measured = add_depth_noise(np.full((480, 640), distance, np.float32), rng())
    valid = measured[measured > 0]
    assert measured.dtype == np.float32
    assert valid.size > 0.995 * measured.size
    assert valid.mean() == pytest.approx(distance, abs=0.0003)
    assert valid.std() == pytest.approx(expected, rel=0.08)
    both_valid = (measured[:, 1:] > 0) & (measured[:, :-1] > 0)
    assert np.corrcoef(measured[:, 1:][both_valid], measured[:, :-1][both_valid])[0, 1] > 0.4, (
        "neighboring pixels are correlated"
    )


def test_disparity_is_quantized() -> None:
    measured = add_depth_noise(np.full((48, 64), 1.2, np.float32), rng())
    steps = (
        D435_DEPTH_NOISE.focal_length
        * D435_DEPTH_NOISE.baseline
        / measured[measured > 0]
        / D435_DEPTH_NOISE.disparity_step
    )
    assert steps == pytest.approx(steps.round(), abs=1e-2)


def test_holes_are_shadows_and_speckles() -> None:
    """The shadow of a wall 0.3 m above the floor is as wide as the disparities differ, 3.6 px."""
    depth = np.full((480, 640), 1.6, np.float32)
    depth[100:300, 200:400] = 1.3
    depth[400:] = np.inf
    holes = add_depth_noise(depth, rng(), DepthNoise(mean_speckle_count=0)) == 0
    assert holes[400:].all()
    rows, columns = np.nonzero(holes[:400])
    assert 100 <= rows.min() <= rows.max() < 300
    assert 196 <= columns.min() <= columns.max() == 199
    assert 200 * 2 < rows.size < 200 * 4, "the edge of the shadow is noisy"
    speckled = add_depth_noise(depth, rng()) == 0
    extra = np.count_nonzero(speckled & ~holes)
    assert (
        0
        < extra
        < 3 * D435_DEPTH_NOISE.mean_speckle_count * np.pi * D435_DEPTH_NOISE.max_speckle_radius**2
    )
    assert np.array_equal(add_depth_noise(depth, rng(1)), add_depth_noise(depth, rng(1)))


def test_images_are_read_as_they_were_written(tmp_path: Path, images: list[LabeledImage]) -> None:
    (tmp_path / ".000000").mkdir()  # Left by an interrupted run.
    write_images(tmp_path / "000000", images, DEFAULT_CELL.camera, list(CLASSES))
    assert [path.name for path in tmp_path.iterdir()] == ["000000"]
    read = ImageDataset(tmp_path)
    assert len(read) == 2
    for written, again in zip(images, (read[0], read[1]), strict=True):
        assert np.array_equal(written.color, again.color)
        assert np.array_equal(np.isinf(written.depth), np.isinf(again.depth))
        assert np.allclose(written.depth, again.depth, rtol=0, atol=0.51e-4)
        assert np.array_equal(written.label, again.label)
        assert written.classes == again.classes
        assert np.array_equal(written.unoccluded_pixels, again.unoccluded_pixels)
        for X, Y in zip(written.X_TO, again.X_TO, strict=True):
            assert pytest.approx(X.p) == Y.p
            assert pytest.approx(X.rotation, abs=1e-7) == Y.rotation
    assert read[0].visible_fractions == pytest.approx([0, 1, 1, 1])
    assert read[1].visible_fractions == pytest.approx([1, 1, 1])
    with pytest.raises(InputError, match="holds no images"):
        ImageDataset(tmp_path / "000000")


def test_visible_fractions_are_those_of_the_renderer(
    camera: CameraRenderer, images: list[LabeledImage]
) -> None:
    assert dict(
        zip(SCENE.names, images[0].visible_fractions, strict=True)
    ) == camera.visible_fractions(SCENE)


def test_files_conform_to_bop_and_coco(tmp_path: Path, images: list[LabeledImage]) -> None:
    write_images(tmp_path / "000000", images, DEFAULT_CELL.camera, list(CLASSES))
    gt, info, camera_entries, coco = (
        json.loads((tmp_path / "000000" / f"scene_{name}.json").read_text())
        for name in ("gt", "gt_info", "camera", "gt_coco")
    )
    names = {category["id"]: category["name"] for category in coco["categories"]}
    K = np.reshape(camera_entries["0"]["cam_K"], (3, 3))
    for number, instance in enumerate(gt["0"]):
        assert names[instance["obj_id"]] == images[0].classes[number]
        R_CO, p_CO = np.reshape(instance["cam_R_m2c"], (3, 3)), np.array(instance["cam_t_m2c"])
        corners = CLASSES[images[0].classes[number]].corners * 1000 @ R_CO.T + p_CO
        pixels = (corners @ K.T / corners[:, 2:])[:, :2]
        if info["0"][number]["px_count_visib"]:
            x, y, width, height = info["0"][number]["bbox_visib"]
            lower, upper = pixels.min(axis=0), pixels.max(axis=0)
            assert [x, y, x + width - 1, y + height - 1] == pytest.approx([*lower, *upper], abs=1.0)
    assert info["0"][0] == {
        "px_count_all": info["1"][0]["px_count_all"],
        "px_count_visib": 0,
        "visib_fract": 0.0,
    } | {"bbox_visib": [-1, -1, -1, -1]}
    annotated = [a for a in coco["annotations"] if a["image_id"] == 0]
    assert [names[a["category_id"]] for a in annotated] == list(images[0].classes[1:]), (
        "the hidden instance has no mask"
    )
    for instance, annotation in enumerate(annotated, start=1):
        mask = decode_run_lengths(
            annotation["segmentation"]["counts"], annotation["segmentation"]["size"]
        )
        assert np.array_equal(mask, images[0].label == instance)
        assert annotation["area"] == mask.sum()


def test_encode_run_lengths() -> None:
    """Counts run down the columns and begin with pixels outside of the mask."""
    assert encode_run_lengths(np.array([[False, True], [True, True]])) == [1, 3]
    assert encode_run_lengths(np.array([[True, False], [False, False]])) == [0, 1, 3]
    assert encode_run_lengths(np.zeros((2, 3), bool)) == [6]


def test_dropped_objects_start_apart_and_end_on_the_tray() -> None:
    classes = [CLASSES[name] for name in ("gelatin_box", "tomato_soup_can", "pudding_box")]
    start = sample_drop_scene(classes, TRAY, rng(2))
    for k, one in enumerate(start.objects):
        assert all(
            (
                np.minimum(one.bounds_T[1], o.bounds_T[1])
                < np.maximum(one.bounds_T[0], o.bounds_T[0])
            ).any()
            for o in start.objects[:k]
        ), "no objects overlap at the start"
    early, late = simulate_drop(start, 0.002, (0.1, 0.5))
    assert len(early.objects) == 3
    assert all(late[o.name].X_TO.p[2] < o.X_TO.p[2] for o in start.objects if o.name in late.names)
    assert all(o.bounds_T[0][2] > -0.002 for o in late.objects)


def test_the_same_seed_generates_the_same_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = training_script("render_image_dataset")
    monkeypatch.setattr(script, "GENERATED_IMAGES", 2)
    monkeypatch.setattr(script, "NODES", 10)
    monkeypatch.setattr(script, "GENERATORS", {"random": ""})
    for out in ("one", "other"):
        script.main(tmp_path / out, count=2, heap_fraction=0.0, seed=3, objects="ycb7")
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert len(files) == 1 + 4 + 6
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes(), (
            file
        )
    before = (tmp_path / "one" / "000000").stat().st_mtime_ns
    script.main(tmp_path / "one", count=2, heap_fraction=0.0, seed=3, objects="ycb7")
    assert (tmp_path / "one" / "000000").stat().st_mtime_ns == before, (
        "what is there is not made again"
    )
    with pytest.raises(InputError, match="of another job"):
        script.main(tmp_path / "one", count=2, heap_fraction=0.0, seed=4, objects="ycb7")
