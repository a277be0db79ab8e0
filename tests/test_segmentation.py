"""Segmentation network: its input, clusters of votes, training and checkpoints."""

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
    downsample,
    make_network_input,
    segmentation_loss,
)
from drake_clutter.perception.segmentation_training import (
    SegmentationConfig,
    SegmentationLearner,
    make_example,
)
from drake_clutter.perception.vote_segments import cluster_votes, extract_segments
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Pose
from drake_clutter.systems.scenario import PRETRAINED_DETECTORS
from drake_clutter.validation import validate

CAMERA = Camera.overhead(1.6, width=160, height=120)
WINDOW = ImageWindow.around_support(CAMERA, TRAY)
CLASSES = ("gelatin_box", "sugar_box")


def labeled_image(number: int) -> LabeledImage:
    """Return an image of two boxes, which differ only in height and size."""
    generator = rng(number)
    depth, label = np.full((120, 160), 1.6, np.float32), np.full((120, 160), -1)
    poses = []
    for k, (height, half) in enumerate(((0.05, 6), (0.15, 9))):
        row, column = int(generator.integers(20, 100)), int(generator.integers(45, 75)) + 40 * k
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


def test_the_window_contains_the_space_above_the_tray() -> None:
    corner = np.array([[0.35, 0.35, 0.5], [-0.35, -0.35, 0.5]])
    for camera in (DEFAULT_CELL.camera, CAMERA):
        window = ImageWindow.around_support(camera, TRAY)
        (right, top), (left, bottom) = camera.project(corner)
        assert window.side % 16 == 0
        assert window.columns.start <= left < right < window.columns.stop
        assert window.rows.start <= top < bottom < window.rows.stop


def test_backprojection_inverts_projection() -> None:
    image = labeled_image(0)
    p_TP = backproject_window(image.depth, CAMERA, WINDOW)
    row, column = 40, 31
    assert CAMERA.project(p_TP[row, column][None]) == pytest.approx(
        np.array([[column + WINDOW.columns.start, row + WINDOW.rows.start]]), abs=1e-3
    )
    image.depth[WINDOW.rows.start, WINDOW.columns.start] = 0.0
    assert np.isnan(backproject_window(image.depth, CAMERA, WINDOW)[0, 0]).all()
    network_input = make_network_input(backproject_window(image.depth, CAMERA, WINDOW), None)
    assert network_input.shape == (4, WINDOW.side, WINDOW.side)
    assert network_input[:2, 0, 0] == pytest.approx([0.0, 0.0])


def test_network_input_contains_slopes_and_filled_holes() -> None:
    x, y = np.meshgrid(np.arange(40) * 0.0025, np.arange(40) * 0.0025)
    p_TP = np.stack([x, y, 0.5 * x], axis=-1)
    p_TP[10:14, 20:24, 2] = np.nan
    height, is_measured, along_rows, along_columns = make_network_input(p_TP, None)
    assert not is_measured[12, 22]
    assert height[12, 22] == pytest.approx(0.5 * 22 * 0.0025 / 0.25), (
        "the nearest measurement is two rows below"
    )
    assert along_columns[30, 20] == pytest.approx(np.arctan(0.5), abs=1e-3)
    assert along_rows[30, 20] == pytest.approx(0.0, abs=1e-3)


def test_rare_classes_have_larger_weights_with_a_mean_of_one() -> None:
    class_map = np.array([0] * 81 + [1] * 9 + [2] + [-1] * 7)
    weights = class_weights([class_map], 2).numpy()
    assert weights[1] / weights[0] == pytest.approx(3.0)
    assert weights[2] / weights[0] == pytest.approx(9.0)
    assert weights[class_map[class_map >= 0]].mean() == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(4))
def test_augmented_examples_have_consistent_center_offsets(seed: int) -> None:
    image = labeled_image(1)
    plain = make_example(image, CLASSES, CAMERA, WINDOW, None, False)
    turned = make_example(image, CLASSES, CAMERA, WINDOW, rng(seed), False)
    for label in (1, 2):
        lengths = [
            np.linalg.norm(e.center_offsets[:, e.class_map == label], axis=0)
            for e in (plain, turned)
        ]
        assert np.nanmedian(lengths[1]) == pytest.approx(np.nanmedian(lengths[0]), abs=0.01)
    p_TP = downsample(backproject_window(image.depth, CAMERA, WINDOW))
    centers = p_TP + np.moveaxis(plain.center_offsets, 0, 2)
    for k, pose in enumerate(image.X_TO):
        centers_of_object = centers[plain.class_map == k + 1]
        assert centers_of_object == pytest.approx(
            np.broadcast_to(pose.translation, centers_of_object.shape), abs=1e-6
        )


def test_votes_for_one_center_form_one_cluster() -> None:
    generator = rng(3)
    # The first two objects are one above the other.
    centers = np.array([[0.0, 0.0, 0.02], [0.0, 0.0, 0.06], [0.2, 0.1, 0.02]])
    votes = np.vstack(
        [
            center + generator.normal(0, 0.003, (count, 3))
            for center, count in zip(centers, (900, 300, 40), strict=True)
        ]
    )
    number = cluster_votes(np.vstack([votes, [[0.5, 0.5, 0.5]]]), 0.015, 8)
    assert number[-1] < 0, "a single vote is not an object"
    assert [len(set(part)) for part in np.split(number[:-1], [900, 1200])] == [1, 1, 1]
    assert len(set(number[:-1])) == 3


def test_extracted_segments_match_the_true_masks() -> None:
    image = labeled_image(2)
    plain = make_example(image, CLASSES, CAMERA, WINDOW, None, False)
    votes = downsample(backproject_window(image.depth, CAMERA, WINDOW)) + np.moveaxis(
        plain.center_offsets, 0, 2
    )
    found = extract_segments(
        plain.class_map, votes, (0.02, 0.02), CLASSES, WINDOW, image.depth.shape, min_votes=4
    )
    assert [segment.class_name for segment in found] == list(CLASSES)
    for k, segment in enumerate(found):
        true = image.label == k
        assert (segment.mask & true).sum() / (segment.mask | true).sum() > 0.8
        assert segment.p_TO == pytest.approx(image.X_TO[k].translation, abs=1e-3)


@pytest.mark.parametrize("use_color", [False, True])
def test_output_shapes_and_checkpoint(use_color: bool, tmp_path: Path) -> None:
    network = SegmentationNetwork(CLASSES, use_color).eval()
    network_input = torch.randn(2, 7 if use_color else 4, 64, 64)
    logits, votes = network(network_input)
    assert (logits.shape, votes.shape) == ((2, 3, 32, 32), (2, 3, 32, 32))
    assert torch.allclose(network(network_input[:1])[0], logits[:1], atol=1e-5), (
        "the same without batching"
    )
    metadata = {"kind": CHECKPOINT_KIND, "classes": list(CLASSES), "use_color": use_color}
    save_checkpoint(tmp_path / "d.safetensors", network, metadata)
    loaded = SegmentationNetwork.load(tmp_path / "d.safetensors")
    assert torch.equal(loaded(network_input)[1], votes)


def test_a_checkpoint_of_another_kind_is_rejected() -> None:
    student = resource_path("training/checkpoints/student.safetensors")
    with pytest.raises(
        InputError,
        match=r"student\.safetensors: is a checkpoint of a student; expected one of a detector",
    ):
        SegmentationNetwork.load(student)


def test_a_warm_started_network_has_the_outputs_of_the_pretrained_one() -> None:
    pretrained = SegmentationNetwork(CLASSES, False).eval()
    network = SegmentationNetwork(("mug", *reversed(CLASSES)), True).eval()
    network.warm_start(pretrained)
    network_input = torch.randn(2, 7, 64, 64)
    (logits, votes), (expected, expected_votes) = (
        network(network_input),
        pretrained(network_input[:, :4]),
    )
    assert torch.allclose(logits[:, [0, 3, 2]], expected, atol=1e-5)
    assert torch.allclose(votes, expected_votes, atol=1e-6)
    assert not torch.allclose(logits[:, 1], expected[:, 1])


def test_the_loss_ignores_unknown_targets() -> None:
    class_map = torch.tensor([[[1, 0], [2, 0]]])
    center_offsets = torch.full((1, 3, 2, 2), torch.nan)
    center_offsets[0, :, 0, 0] = 0.1
    logits = torch.nn.functional.one_hot(class_map, 3).permute(0, 3, 1, 2) * 50.0
    class_loss, vote_loss = segmentation_loss(
        logits, torch.zeros(1, 3, 2, 2), class_map, center_offsets, torch.ones(3)
    )
    assert float(class_loss) == pytest.approx(0.0, abs=1e-6)
    assert float(vote_loss) == pytest.approx(0.3)


def learner() -> SegmentationLearner:
    torch.manual_seed(0)
    config = SegmentationConfig(steps=40, batch_size=4)
    network = SegmentationNetwork(CLASSES, False)
    return SegmentationLearner(
        network, labeled_image, 20, config, CAMERA, TRAY, 0, torch.device("cpu")
    )


def test_training_reduces_the_loss_and_resumes_with_identical_weights(tmp_path: Path) -> None:
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
