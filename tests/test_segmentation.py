"""The segmentation network: what it is given, how votes become objects, and that it learns and can be interrupted."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import DEFAULT_CELL, TRAY, rng

from drake_clutter.cell.camera import Camera
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint, save_checkpoint
from drake_clutter.perception.image_dataset import LabeledImage
from drake_clutter.perception.segmentation import (
    CHECKPOINT_KIND,
    ImageWindow,
    SegmentationNetwork,
    backproject_window,
    class_weights,
    cluster_votes,
    downsample,
    extract_segments,
    make_network_input,
    segmentation_loss,
)
from drake_clutter.perception.segmentation_training import (
    SegmentationConfig,
    SegmentationLearner,
    make_example,
)
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Pose
from drake_clutter.systems.scenario import PRETRAINED_DETECTORS
from drake_clutter.validation import validate

CAMERA = Camera.overhead(1.6, width=160, height=120)
WINDOW = ImageWindow.around_support(CAMERA, TRAY)
CLASSES = ("gelatin_box", "sugar_box")


def picture(number: int) -> LabeledImage:
    """Two boxes of different heights on the floor, told by nothing but that."""
    draw = rng(number)
    depth, label = np.full((120, 160), 1.6, np.float32), np.full((120, 160), -1)
    poses = []
    for k, (height, half) in enumerate(((0.05, 6), (0.15, 9))):
        row, column = int(draw.integers(20, 100)), int(draw.integers(45, 75)) + 40 * k
        patch = slice(row - half, row + half), slice(column - half, column + half)
        depth[patch], label[patch] = 1.6 - height, k
        pixel = (1.6 - height) / CAMERA.focal_length
        x, y = (
            (column - 0.5 - (CAMERA.width / 2 - 1)) * pixel,
            -(row - 0.5 - (CAMERA.height / 2 - 1)) * pixel,
        )
        poses.append(Pose((x, y, height / 2)))
    return LabeledImage(
        np.zeros((120, 160, 3), np.uint8), depth, label, CLASSES, tuple(poses), np.full(2, 100)
    )


def test_the_window_holds_the_tray() -> None:
    corner = np.array([[0.35, 0.35, 0.5], [-0.35, -0.35, 0.5]])
    for camera in (DEFAULT_CELL.camera, CAMERA):
        window = ImageWindow.around_support(camera, TRAY)
        (right, top), (left, bottom) = camera.project(corner)
        assert window.side % 16 == 0
        assert window.columns.start <= left < right < window.columns.stop
        assert window.rows.start <= top < bottom < window.rows.stop


def test_points_are_what_the_camera_projects() -> None:
    image = picture(0)
    p_TP = backproject_window(image.depth, CAMERA, WINDOW)
    row, column = 40, 31
    assert CAMERA.project(p_TP[row, column][None]) == pytest.approx(
        np.array([[column + WINDOW.columns.start, row + WINDOW.rows.start]]), abs=1e-3
    )
    image.depth[WINDOW.rows.start, WINDOW.columns.start] = 0.0
    assert np.isnan(backproject_window(image.depth, CAMERA, WINDOW)[0, 0]).all()
    given = make_network_input(backproject_window(image.depth, CAMERA, WINDOW), None)
    assert given.shape == (4, WINDOW.side, WINDOW.side)
    assert given[:2, 0, 0] == pytest.approx([0.0, 0.0])


def test_slopes_are_given_and_holes_are_as_high_as_what_is_beside_them() -> None:
    x, y = np.meshgrid(np.arange(40) * 0.0025, np.arange(40) * 0.0025)
    points_T = np.stack([x, y, 0.5 * x], axis=-1)
    points_T[10:14, 20:24, 2] = np.nan
    height, known, along_rows, along_columns = make_network_input(points_T, None)
    assert not known[12, 22]
    assert height[12, 22] == pytest.approx(0.5 * 22 * 0.0025 / 0.25), (
        "of the row two below, which is nearest"
    )
    assert along_columns[30, 20] == pytest.approx(np.arctan(0.5), abs=1e-3)
    assert along_rows[30, 20] == pytest.approx(0.0, abs=1e-3)


def test_what_is_rare_weighs_more_and_the_mean_pixel_one() -> None:
    kind = np.array([0] * 81 + [1] * 9 + [2] + [-1] * 7)
    weights = class_weights([kind], 2).numpy()
    assert weights[1] / weights[0] == pytest.approx(3.0)
    assert weights[2] / weights[0] == pytest.approx(9.0)
    assert weights[kind[kind >= 0]].mean() == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_turned_and_mirrored_examples_vote_for_the_same_middles(seed: int) -> None:
    image = picture(1)
    plain = make_example(image, CLASSES, CAMERA, WINDOW, None, False)
    turned = make_example(image, CLASSES, CAMERA, WINDOW, rng(seed), False)
    for kind in (1, 2):
        lengths = [
            np.linalg.norm(e.center_offsets[:, e.class_map == kind], axis=0)
            for e in (plain, turned)
        ]
        assert np.nanmedian(lengths[1]) == pytest.approx(np.nanmedian(lengths[0]), abs=0.01)
    p_TP = downsample(backproject_window(image.depth, CAMERA, WINDOW))
    voted = p_TP + np.moveaxis(plain.center_offsets, 0, 2)
    for k, pose in enumerate(image.X_TO):
        of_one = voted[plain.class_map == k + 1]
        assert of_one == pytest.approx(np.broadcast_to(pose.translation, of_one.shape), abs=1e-6)


def test_votes_for_one_place_are_one_object() -> None:
    draw = rng(3)
    centres = np.array(
        [[0.0, 0.0, 0.02], [0.0, 0.0, 0.06], [0.2, 0.1, 0.02]]
    )  # two lie across each other
    votes = np.vstack(
        [
            centre + draw.normal(0, 0.003, (count, 3))
            for centre, count in zip(centres, (900, 300, 40), strict=True)
        ]
    )
    number = cluster_votes(np.vstack([votes, [[0.5, 0.5, 0.5]]]), 0.015, 8)
    assert number[-1] < 0, "one vote is no object"
    assert [len(set(part)) for part in np.split(number[:-1], [900, 1200])] == [1, 1, 1]
    assert len(set(number[:-1])) == 3


def test_segments_are_masks_in_the_image() -> None:
    image = picture(2)
    plain = make_example(image, CLASSES, CAMERA, WINDOW, None, False)
    votes = downsample(backproject_window(image.depth, CAMERA, WINDOW)) + np.moveaxis(
        plain.center_offsets, 0, 2
    )
    found = extract_segments(
        plain.class_map, votes, (0.02, 0.02), CLASSES, WINDOW, image.depth.shape, min_votes=4
    )
    assert [segment.name for segment in found] == list(CLASSES)
    for k, segment in enumerate(found):
        true = image.label == k
        assert (segment.mask & true).sum() / (segment.mask | true).sum() > 0.8
        assert segment.p_TO == pytest.approx(image.X_TO[k].translation, abs=1e-3)


@pytest.mark.parametrize("use_color", [False, True])
def test_shapes(use_color: bool, tmp_path: Path) -> None:
    network = SegmentationNetwork(CLASSES, use_color).eval()
    given = torch.randn(2, 7 if use_color else 4, 64, 64)
    logits, votes = network(given)
    assert (logits.shape, votes.shape) == ((2, 3, 32, 32), (2, 3, 32, 32))
    assert torch.allclose(network(given[:1])[0], logits[:1], atol=1e-5), "one by one as in a batch"
    about = {"kind": CHECKPOINT_KIND, "classes": list(CLASSES), "use_color": use_color}
    save_checkpoint(tmp_path / "d.safetensors", network, about)
    again = SegmentationNetwork.load(tmp_path / "d.safetensors")
    assert torch.equal(again(given)[1], votes)


def test_a_checkpoint_of_something_else_is_refused() -> None:
    student = resource_path("training/checkpoints/student.safetensors")
    with pytest.raises(
        InputError,
        match=r"student\.safetensors: is a checkpoint of a student; allowed is one of a detector",
    ):
        SegmentationNetwork.load(student)


def test_a_warm_start_answers_as_what_it_begins_with_whatever_the_colours_and_other_classes_are() -> (
    None
):
    learned = SegmentationNetwork(CLASSES, False).eval()
    network = SegmentationNetwork(("mug", *reversed(CLASSES)), True).eval()
    network.warm_start(learned)
    given = torch.randn(2, 7, 64, 64)
    (logits, votes), (expected, expected_votes) = network(given), learned(given[:, :4])
    assert torch.allclose(logits[:, [0, 3, 2]], expected, atol=1e-5)
    assert torch.allclose(votes, expected_votes, atol=1e-6)
    assert not torch.allclose(logits[:, 1], expected[:, 1])


def test_the_loss_leaves_out_what_is_not_known() -> None:
    kind = torch.tensor([[[1, 0], [2, 0]]])
    to_middle = torch.full((1, 3, 2, 2), torch.nan)
    to_middle[0, :, 0, 0] = 0.1
    logits = torch.nn.functional.one_hot(kind, 3).permute(0, 3, 1, 2) * 50.0
    of_classes, of_votes = segmentation_loss(
        logits, torch.zeros(1, 3, 2, 2), kind, to_middle, torch.ones(3)
    )
    assert float(of_classes) == pytest.approx(0.0, abs=1e-6)
    assert float(of_votes) == pytest.approx(0.3)


def learner() -> SegmentationLearner:
    torch.manual_seed(0)
    config = SegmentationConfig(steps=40, batch_size=4)
    network = SegmentationNetwork(CLASSES, False)
    return SegmentationLearner(network, picture, 20, config, CAMERA, TRAY, 0, torch.device("cpu"))


def test_it_learns_and_ends_with_the_same_weights_after_an_interruption(tmp_path: Path) -> None:
    whole = learner()
    losses = []
    for step in range(40):
        whole.train_iteration()
        losses.append(whole.losses["classes"])
        if step == 29:
            whole.save(tmp_path / "state.safetensors")
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    resumed = learner()
    resumed.load(tmp_path / "state.safetensors")
    for _ in range(10):
        resumed.train_iteration()
    for name, value in whole.network.state_dict().items():
        assert torch.equal(resumed.network.state_dict()[name], value), name


@pytest.mark.parametrize(("name", "use_color"), [("depth", False), ("depth-color", True)])
def test_shipped_checkpoints_load_under_their_earlier_names(name: str, use_color: bool) -> None:
    path = resource_path(PRETRAINED_DETECTORS[name])
    stored = load_checkpoint(path)
    assert stored.metadata["looks_at_color"] is use_color
    network = SegmentationNetwork.load(path)
    assert (network.classes, network.use_color) == (tuple(stored.metadata["classes"]), use_color)
    assert torch.equal(network.stem[1][0].weight, stored.weights["into.1.0.weight"])  # type: ignore[index]


def test_configs_take_earlier_names() -> None:
    assert validate(SegmentationConfig, {"batch": 3}, "test") == SegmentationConfig(batch_size=3)
