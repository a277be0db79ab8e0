"""Datasets of labeled images, and the noise of a stereo camera."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import CLASSES, DEFAULT_CELL, TRAY, resting, rng, scene_of, training_script
from numpy.typing import NDArray
from PIL import Image
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from drake_clutter.catalog import Shape
from drake_clutter.files import InputError
from drake_clutter.grammar import Orientation
from drake_clutter.perception.bop_models import write_dataset_camera, write_models
from drake_clutter.perception.depth_noise import D435_DEPTH_NOISE, DepthNoise, add_depth_noise
from drake_clutter.perception.image_dataset import (
    TRAIN_FOLDER,
    AnnotatedImage,
    ImageDataset,
    encode_depth,
    encode_run_lengths,
    write_images,
)
from drake_clutter.rendering.lighting import LampKind
from drake_clutter.rendering.mesh_renderer import RenderedImages
from drake_clutter.rendering.visual_mesh import box_visual, load_visual_meshes
from drake_clutter.scenes.scene import Pose, SceneObject
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
def images(camera: CameraRenderer) -> list[AnnotatedImage]:
    """Return images of the scene with and without the upper box."""
    known: dict[SceneObject, NDArray[np.bool_]] = {}
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


@pytest.mark.parametrize("split", [TRAIN_FOLDER, "."], ids=["today", "version 0.1"])
def test_images_are_read_as_they_were_written(
    tmp_path: Path, images: list[AnnotatedImage], split: str
) -> None:
    folder = tmp_path / split
    (folder / ".000000").mkdir(parents=True)  # Left by an interrupted run.
    write_images(folder / "000000", images, DEFAULT_CELL.camera, list(CLASSES))
    assert [path.name for path in folder.iterdir()] == ["000000"]
    read = ImageDataset(tmp_path)
    assert len(read) == 2
    for written, again in zip((a.image for a in images), (read[0], read[1]), strict=True):
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
        ImageDataset(folder / "000000")


def test_visible_fractions_are_those_of_the_renderer(
    camera: CameraRenderer, images: list[AnnotatedImage]
) -> None:
    assert dict(
        zip(SCENE.names, images[0].image.visible_fractions, strict=True)
    ) == camera.visible_fractions(SCENE)


def test_depth_beyond_16_bits_is_unknown() -> None:
    depth = np.array([0.5, 6.5535, 6.5536, 10.0, np.inf, np.nan], np.float64)
    assert encode_depth(depth).tolist() == [5000, 65535, 0, 0, 0, 0]


def test_too_many_instances_are_refused(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    image = replace(images[0].image, classes=("sugar_box",) * 256)
    with pytest.raises(InputError, match="an image of 256 instances; allowed are at most 255"):
        write_images(
            tmp_path / "0", [replace(images[0], image=image)], DEFAULT_CELL.camera, list(CLASSES)
        )


def test_files_conform_to_bop_and_coco(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    write_images(tmp_path / "000000", images, DEFAULT_CELL.camera, list(CLASSES))
    gt, info, camera_entries, coco = (
        json.loads((tmp_path / "000000" / f"scene_{name}.json").read_text())
        for name in ("gt", "gt_info", "camera", "gt_coco")
    )
    names = {category["id"]: category["name"] for category in coco["categories"]}
    K = np.reshape(camera_entries["0"]["cam_K"], (3, 3))
    for number, instance in enumerate(gt["0"]):
        assert names[instance["obj_id"]] == images[0].image.classes[number]
        R_CO, p_CO = np.reshape(instance["cam_R_m2c"], (3, 3)), np.array(instance["cam_t_m2c"])
        corners = CLASSES[images[0].image.classes[number]].corners * 1000 @ R_CO.T + p_CO
        pixels = (corners @ K.T / corners[:, 2:])[:, :2]
        kinds = ("bbox_obj", "bbox_visib") if info["0"][number]["px_count_visib"] else ("bbox_obj",)
        for kind in kinds:
            x, y, width, height = info["0"][number][kind]
            lower, upper = pixels.min(axis=0), pixels.max(axis=0)
            assert [x, y, x + width - 1, y + height - 1] == pytest.approx([*lower, *upper], abs=1.0)
    alone = info["1"][0]
    assert alone["px_count_visib"] == alone["px_count_valid"] == alone["px_count_all"]
    assert info["0"][0] == alone | {
        "px_count_visib": 0,
        "visib_fract": 0.0,
        "bbox_visib": [-1, -1, -1, -1],
    }
    annotated = [a for a in coco["annotations"] if a["image_id"] == 0]
    assert [names[a["category_id"]] for a in annotated] == list(images[0].image.classes[1:]), (
        "the hidden instance has no mask"
    )
    for instance, annotation in enumerate(annotated, start=1):
        mask = decode_run_lengths(
            annotation["segmentation"]["counts"], annotation["segmentation"]["size"]
        )
        assert np.array_equal(mask, images[0].image.label == instance)
        assert annotation["area"] == mask.sum()


def test_pycocotools_evaluates_detections(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    """The annotations, taken as detections, have an average precision of 1."""
    write_images(tmp_path / "000000", images, DEFAULT_CELL.camera, list(CLASSES))
    truth = COCO(str(tmp_path / "000000" / "scene_gt_coco.json"))
    detections = [
        {
            "image_id": annotation["image_id"],
            "category_id": annotation["category_id"],
            "segmentation": truth.annToRLE(annotation),
            "score": 1.0,
        }
        for annotation in truth.dataset["annotations"]
    ]
    evaluation = COCOeval(truth, truth.loadRes(detections), "segm")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    assert evaluation.stats[0] == pytest.approx(1.0)


def test_masks_conform_to_bop(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    """Masks are 0 or 255 and agree with scene_gt_info.json and with the depth, in mm."""
    folder = tmp_path / "000000"
    write_images(folder, images, DEFAULT_CELL.camera, list(CLASSES))
    gt, info, cameras = (
        json.loads((folder / f"scene_{name}.json").read_text())
        for name in ("gt", "gt_info", "camera")
    )
    assert list(gt) == list(info) == list(cameras) == ["0", "1"]
    expected_masks = {f"{int(k):06d}_{n:06d}.png" for k in gt for n in range(len(gt[k]))}
    for kind in ("mask", "mask_visib"):
        assert {path.name for path in (folder / kind).iterdir()} == expected_masks
    for image, instances in gt.items():
        depth_png = np.asarray(Image.open(folder / "depth" / f"{int(image):06d}.png"))
        assert depth_png.dtype == np.uint16
        depth_mm = depth_png * cameras[image]["depth_scale"]
        for number, instance in enumerate(instances):
            name = f"{int(image):06d}_{number:06d}.png"
            mask, visible = (
                np.asarray(Image.open(folder / kind / name)) for kind in ("mask", "mask_visib")
            )
            for array in (mask, visible):
                assert array.dtype == np.uint8
                assert array.shape == depth_png.shape
                assert set(np.unique(array)) <= {0, 255}
            assert not np.any(visible & ~mask)
            entry = info[image][number]
            assert entry["px_count_all"] == np.count_nonzero(mask)
            assert entry["px_count_visib"] == np.count_nonzero(visible)
            assert entry["px_count_valid"] == np.count_nonzero(depth_png[mask > 0])
            R_CO = np.reshape(instance["cam_R_m2c"], (3, 3))
            names = list(CLASSES)
            corners = 1000 * CLASSES[names[instance["obj_id"] - 1]].corners
            corner_depths = (corners @ R_CO.T + instance["cam_t_m2c"])[:, 2]
            seen = depth_mm[visible > 0]
            assert np.all(seen > corner_depths.min() - 1)
            assert np.all(seen < corner_depths.max() + 1)


def test_compact_images(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    """Colors are nearly those that were written; depth, labels and annotations are the same."""
    for name in ("plain", "compact"):
        write_images(
            tmp_path / name / "000000",
            images,
            DEFAULT_CELL.camera,
            list(CLASSES),
            compact=name == "compact",
        )
    plain, compact = (ImageDataset(tmp_path / name) for name in ("plain", "compact"))
    assert len(compact) == len(images)
    for k in range(len(images)):
        assert np.array_equal(compact[k].depth, plain[k].depth)
        assert np.array_equal(compact[k].label, plain[k].label)
        difference = np.abs(compact[k].color.astype(int) - plain[k].color)
        assert np.median(difference) <= 2
        assert np.quantile(difference, 0.99) < 25
    folder = tmp_path / "compact" / "000000"
    assert not list(folder.glob("mask*"))
    coco = json.loads((folder / "scene_gt_coco.json").read_text())
    assert all((folder / entry["file_name"]).is_file() for entry in coco["images"])
    reference = json.loads((tmp_path / "plain" / "000000" / "scene_gt_coco.json").read_text())
    assert coco["annotations"] == reference["annotations"]
    sizes = [
        sum(f.stat().st_size for f in (tmp_path / name).rglob("*.*"))
        for name in ("plain", "compact")
    ]
    assert sizes[1] < sizes[0]


def test_models_conform_to_bop(tmp_path: Path) -> None:
    """Meshes are in mm in the frame O, with normals and texture; the camera file is complete."""
    write_dataset_camera(tmp_path, DEFAULT_CELL.camera)
    camera = json.loads((tmp_path / "camera.json").read_text())
    assert set(camera) == {"fx", "fy", "cx", "cy", "width", "height", "depth_scale"}
    assert (camera["width"], camera["height"]) == (640, 480)
    write_models(tmp_path, list(CLASSES.values()))
    models = json.loads((tmp_path / "models" / "models_info.json").read_text())
    assert list(models) == [str(obj_id) for obj_id in range(1, len(CLASSES) + 1)]
    for (obj_id, info), object_class in zip(models.items(), CLASSES.values(), strict=True):
        path = tmp_path / "models" / f"obj_{int(obj_id):06d}.ply"
        header = path.read_text().partition("end_header")[0]
        assert f"comment TextureFile {path.stem}.png" in header
        assert path.with_suffix(".png").is_file()
        for column in ("nx", "ny", "nz", "texture_u", "texture_v"):
            assert f"property float {column}\n" in header
        mesh = trimesh.load_mesh(path)
        lower = [info[f"min_{axis}"] for axis in "xyz"]
        size = [info[f"size_{axis}"] for axis in "xyz"]
        assert mesh.bounds[0] == pytest.approx(lower, abs=1e-3)
        assert mesh.extents == pytest.approx(size, abs=1e-3)
        assert size == pytest.approx([1000 * extent for extent in object_class.size], abs=0.1)
        is_cylinder = object_class.shape is Shape.CYLINDER
        diameter = np.hypot(size[0], size[2]) if is_cylinder else np.linalg.norm(size)
        assert info["diameter"] == pytest.approx(diameter, rel=0.01)
        assert ("symmetries_continuous" in info) == is_cylinder
        for transform in info["symmetries_discrete"]:
            X = np.reshape(transform, (4, 4))
            assert np.linalg.det(X[:3, :3]) == pytest.approx(1.0)
            assert np.abs(X[:3, :3]) @ size == pytest.approx(size)
        assert len(info["symmetries_discrete"]) == (1 if is_cylinder else 3)


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
    monkeypatch.setattr(script, "DISMANTLINGS", 1)
    monkeypatch.setattr(script, "GENERATED_IMAGES", 2)
    monkeypatch.setattr(script, "NODES", 10)
    monkeypatch.setattr(script, "GENERATORS", {"random": ""})
    for out in ("one", "other"):
        script.main(tmp_path / out, count=2, heap_fraction=0.0, seed=3, objects="ycb7")
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    models = 1 + 2 * len(CLASSES)
    masks = len(list((tmp_path / "one" / TRAIN_FOLDER / "000000" / "mask").iterdir()))
    assert len(files) == 2 + models + 4 + 6 + 2 * masks
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes(), (
            file
        )
    before = (tmp_path / "one" / TRAIN_FOLDER / "000000").stat().st_mtime_ns
    script.main(tmp_path / "one", count=2, heap_fraction=0.0, seed=3, objects="ycb7")
    assert (tmp_path / "one" / TRAIN_FOLDER / "000000").stat().st_mtime_ns == before, (
        "what is there is not made again"
    )
    with pytest.raises(InputError, match="results of other options"):
        script.main(tmp_path / "one", count=2, heap_fraction=0.0, seed=4, objects="ycb7")


def test_images_of_the_compiled_renderer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera moves between dismantlings, and the poses are given for where it was."""
    script = training_script("render_image_dataset")
    monkeypatch.setattr(script, "DISMANTLINGS", 2)
    monkeypatch.setattr(script, "GENERATED_IMAGES", 2)
    monkeypatch.setattr(script, "NODES", 10)
    monkeypatch.setattr(script, "GENERATORS", {"random": ""})
    options = {"heap_fraction": 0.0, "seed": 3, "objects": "ycb7"}
    options["renderer"] = script.RendererKind.RASTER
    script.main(tmp_path / "one", count=4, **options)
    script.main(tmp_path / "other", count=2, **options)
    first_item = tmp_path / "other" / TRAIN_FOLDER / "000000"
    files = [path.relative_to(tmp_path / "other") for path in first_item.rglob("*.*")]
    assert len(files) > 10
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "other" / file).read_bytes()
    options["renderer"] = script.RendererKind.VTK
    with pytest.raises(InputError, match="results of other options"):
        script.main(tmp_path / "one", count=4, **options)
    positions = set()
    checked = 0
    for item in ("000000", "000001"):
        folder = tmp_path / "one" / TRAIN_FOLDER / item
        cameras = json.loads((folder / "scene_camera.json").read_text())
        positions.add(tuple(cameras["0"]["cam_t_w2c"]))
        R_CT = np.reshape(cameras["0"]["cam_R_w2c"], (3, 3))
        assert np.degrees(np.arccos(R_CT[2, 2] * -1)) < 1.5  # still looks down
        for key, instances in json.loads((folder / "scene_gt.json").read_text()).items():
            K = np.reshape(cameras[key]["cam_K"], (3, 3))
            for k, instance in enumerate(instances):
                # The centers of boxes and cylinders lie in their silhouettes.
                u, v, w = K @ instance["cam_t_m2c"]
                path = folder / "mask" / f"{int(key):06d}_{k:06d}.png"
                assert np.asarray(Image.open(path))[round(v / w), round(u / w)] == 255
                checked += 1
    assert len(positions) == 2
    assert checked >= 8
    with pytest.raises(InputError, match="--textures unseen: expected --renderer raster"):
        script.main(tmp_path / "new", textures=script.TextureSet.UNSEEN)


def test_lamps_of_a_room() -> None:
    """A tray that faces each lamp gets 1.5 to 4 in all, divided by the cosine at most."""
    script = training_script("image_randomization")
    for seed in range(50):
        lighting = script.sample_room_lighting(rng(seed))
        assert 1 <= len(lighting.lamps) <= 3
        assert all(lamp.casts_shadows and not lamp.is_on_camera for lamp in lighting.lamps)
        irradiances = [
            lamp.intensity
            / (np.dot(lamp.vector, lamp.vector) if lamp.kind is LampKind.POINT else 1)
            for lamp in lighting.lamps
        ]
        assert 1.5 <= sum(irradiances) <= 4.0
        # All are above the tray: points at a positive height, directions downwards.
        assert all((lamp.vector[2] > 0) is (lamp.kind is LampKind.POINT) for lamp in lighting.lamps)
        assert lighting == script.sample_room_lighting(rng(seed))


def test_patches_on_textures(monkeypatch: pytest.MonkeyPatch) -> None:
    script = training_script("image_randomization")
    monkeypatch.setattr(script, "PRINT_PROBABILITY", 0.0)
    (mesh,) = load_visual_meshes(CLASSES["sugar_box"].folder / "visual.gltf")
    plain = box_visual((0.1, 0.1, 0.1), (0.5, 0.5, 0.5))
    variation = script.TextureVariation(3)
    varied = variation("sugar_box", mesh).texture
    assert np.array_equal(varied, variation("sugar_box", mesh).texture)
    assert not np.array_equal(varied, variation("gelatin_box", mesh).texture)
    assert variation("floor", plain).texture.shape == (64, 64, 3)
    # The mean factor on gray is that of the patches, about 1; their contrast is bounded.
    gray = replace(plain, texture=np.full((64, 64, 3), 100, np.uint8))
    factors = np.array([script.TextureVariation(k)("x", gray).texture / 100 for k in range(40)])
    assert factors.mean() == pytest.approx(1.0, abs=0.03)
    assert 0.02 < factors.std() < 0.25
    monkeypatch.setattr(script, "MAX_PATCH_CONTRAST", 0.0)
    assert np.array_equal(variation("sugar_box", mesh).texture, mesh.texture)


def test_random_prints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Prints hide the texture; those for tests are of other kinds than those for training."""
    script = training_script("image_randomization")
    training, unseen = (set(script.PRINTS[textures]) for textures in script.TextureSet)
    assert len(training) == len(unseen) == 3
    assert not training & unseen
    for make_print in training | unseen:
        pictures = [make_print(rng(seed)) for seed in (1, 1, 2)]
        assert pictures[0].shape == (script.PRINT_SIDE, script.PRINT_SIDE, 3)
        assert pictures[0].dtype == np.uint8
        assert len(np.unique(pictures[0].reshape(-1, 3), axis=0)) >= 2
        assert np.array_equal(pictures[0], pictures[1])
        assert not np.array_equal(pictures[0], pictures[2])
    monkeypatch.setattr(script, "PRINT_PROBABILITY", 0.0)
    monkeypatch.setattr(script, "MAX_PATCH_CONTRAST", 0.0)
    (mesh,) = load_visual_meshes(CLASSES["sugar_box"].folder / "visual.gltf")
    printed = script.TextureVariation(1, script.TextureSet.UNSEEN)("sugar_box", mesh).texture
    differs = (printed != mesh.texture).any(axis=2)
    assert differs.mean() > 0.9


def test_colors_of_instances() -> None:
    """Each instance has its own affine map, which clips; the background is replaced."""
    script = training_script("image_randomization")
    color = np.full((4, 6, 3), 100, np.uint8)
    label = np.full((4, 6), -1)
    label[1, 2:4] = 0
    label[2, 2:4] = 1
    depth = np.ones((4, 6), np.float32)
    depth[:, 5] = np.inf
    images = RenderedImages(color, depth, label)
    changed = script.randomize_colors(images, 2, rng(4))
    for mask in (label == 0, label == 1, (label < 0) & np.isfinite(depth)):
        assert len(np.unique(changed[mask], axis=0)) == 1
        # Gray is on the axis of the hue rotation: gain 0.7 to 1.34, offset -15 to 15.
        assert np.all((changed[mask] > 54) & (changed[mask] < 150))
    assert len({tuple(changed[k]) for k in ((1, 2), (2, 2), (0, 0))}) == 3
    white = replace(images, color=np.full((4, 6, 3), 255, np.uint8))
    assert script.randomize_colors(white, 2, rng(4)).max() == 255


def test_stacks_are_turned_about_themselves() -> None:
    script = training_script("scene_dismantling")
    below = resting("cracker_box", xy=(0.0, 0.0), name="below")
    above = resting("gelatin_box", xy=(0.0, 0.0), name="above")
    above = replace(above, X_TO=Pose((0.0, 0.0, below.top_height + above.X_TO.p[2])))
    beside = resting("sugar_box", xy=(0.25, 0.25), name="beside")
    scene = scene_of(above, below, beside)
    turned = script.turn_stacks(scene, rng(2))
    assert turned.names == scene.names
    for name in scene.names:
        assert turned[name].X_TO.p[2] == scene[name].X_TO.p[2]
        assert np.abs(turned[name].X_TO.rotation[:2, :2]).max() < 0.999, "not turned"
        assert (np.abs(np.array(turned[name].bounds_T)[:, :2]) < TRAY.half_size).all()
    relative = [s["below"].X_TO.rotation.T @ s["above"].X_TO.rotation for s in (scene, turned)]
    assert relative[1] == pytest.approx(relative[0], abs=1e-9)
    crowded = scene_of(
        *(resting("sugar_box", xy=(x, 0.0), name=f"{x}") for x in np.linspace(-0.3, 0.3, 7))
    )
    assert script.turn_stacks(crowded, rng(2)).objects == crowded.objects, "no room"


def test_objects_are_put_on_others() -> None:
    script = training_script("scene_dismantling")
    box = resting("cracker_box", name="box")
    can = resting("tomato_soup_can", xy=(0.2, 0.2), name="can")
    for seed in range(5):
        placed = script.place_on_object(can, scene_of(box), rng(seed))
        assert placed.bounds_T[0][2] == pytest.approx(box.top_height)
        assert np.all(np.abs(placed.X_TO.p[:2]) <= 0.3 * np.ptp(box.bounds_T, axis=0)[:2])
    assert (
        script.place_on_object(can, scene_of(box, resting("cracker_box", name="other")), rng(1))
        is None
    )


def test_a_mirrored_pose_is_refused(tmp_path: Path, images: list[AnnotatedImage]) -> None:
    write_images(tmp_path / "000000", images[:1], DEFAULT_CELL.camera, [*CLASSES])
    path = tmp_path / "000000" / "scene_gt.json"
    document = json.loads(path.read_text())
    document["0"][0]["cam_R_m2c"] = [-1, 0, 0, 0, 1, 0, 0, 0, 1]
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"scene_gt.json: .*the nine numbers of a rotation matrix"):
        ImageDataset(tmp_path)[0]
