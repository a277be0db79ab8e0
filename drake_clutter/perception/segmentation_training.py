"""Training of the segmentation network on rendered images."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_learner, save_learner
from drake_clutter.perception.depth_noise import add_depth_noise
from drake_clutter.perception.image_dataset import LabeledImage
from drake_clutter.perception.segmentation import (
    ImageWindow,
    SegmentationNetwork,
    backproject_window,
    class_weights,
    downsample,
    make_network_input,
    segmentation_loss,
)
from drake_clutter.seeding import item_rng
from drake_clutter.validation import Count, NonNegative, config_class, renamed_fields

WARM_UP_FRACTION = 0.1
"""Fraction of the steps in which the learning rate rises."""
MAX_IMAGES_COUNTED = 200
"""Largest number of images from which the class weights are computed."""
MAX_GRADIENT_NORM = 5.0
"""Norm to which gradients are clipped."""


@config_class
@renamed_fields(batch="batch_size")
class SegmentationConfig:
    """Hyperparameters of the training.

    Attributes:
        steps: Number of batches.
        batch_size: Number of images in a batch.
        learning_rate: Largest learning rate. It rises linearly over the first tenth of the steps,
            then falls to 0 along a cosine.
        weight_decay: Weight decay of AdamW.
        vote_weight: Weight of the votes' error relative to the cross entropy [1/m].
    """

    steps: Count = 5000
    batch_size: Count = 8
    learning_rate: NonNegative = 3e-3
    weight_decay: NonNegative = 1e-4
    vote_weight: NonNegative = 5.0


class TrainingExample(NamedTuple):
    """Arrays of one image, or of a batch with a leading dimension B.

    Attributes:
        image: Input of the network, see `make_network_input`. Shape (channels, side, side).
        class_map: True class of each cell plus 1; 0: no object. Shape (h, w).
        center_offsets: True offset of the object's center from the cell's point [m]; NaN where
            there is no object or no measurement. Shape (3, h, w).
    """

    image: NDArray[np.float32]
    class_map: NDArray[np.int64]
    center_offsets: NDArray[np.float32]


def make_example(
    image: LabeledImage,
    classes: Sequence[str],
    camera: Camera,
    window: ImageWindow,
    rng: np.random.Generator | None,
    use_color: bool,
) -> TrainingExample:
    """Return the network's input and targets for an image.

    Augmentations are depth noise, quarter turns, mirroring, and random light.

    Args:
        image: Rendered image.
        classes: Names of the network's classes.
        camera: Camera of the image.
        window: Part of the image that the network sees.
        rng: Random generator of the augmentations; None: no augmentations.
        use_color: Whether the input has color channels.

    Raises:
        InputError: The image shows an object of another class.
    """
    unknown = sorted(set(image.classes) - set(classes))
    if unknown:
        raise InputError(
            f"images: show {', '.join(unknown)}; expected objects of {', '.join(classes)} alone"
        )
    depth = image.depth if rng is None else add_depth_noise(image.depth, rng)
    p_TP = backproject_window(depth, camera, window)
    color = image.color[window.rows, window.columns]
    label = image.label[window.rows, window.columns]
    p_TO = np.array([pose.translation for pose in image.X_TO]).reshape(-1, 3)
    if rng is not None:
        quarter_turns = int(rng.integers(4))
        column_step = int(rng.choice([-1, 1]))
        p_TP = np.rot90(p_TP, quarter_turns)[:, ::column_step]
        label = np.rot90(label, quarter_turns)[:, ::column_step]
        quarter_turn = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        mirror = np.diag([column_step, 1.0, 1.0])
        R = mirror @ np.linalg.matrix_power(quarter_turn, quarter_turns)
        p_TP = (p_TP @ R.T).astype(np.float32)
        p_TO = p_TO @ R.T
        light = rng.uniform(0.7, 1.3, 3) * rng.uniform(0.6, 1.4)
        lit = np.rot90(color, quarter_turns)[:, ::column_step] * light
        color = np.clip(lit, 0, 255).astype(np.uint8)
    instance = downsample(label) + 1
    class_map = np.array([0] + [classes.index(name) + 1 for name in image.classes])[instance]
    center_offsets = np.vstack([np.full(3, np.nan), p_TO])[instance] - downsample(p_TP)
    network_input = make_network_input(p_TP, color if use_color else None)
    return TrainingExample(
        network_input,
        np.ascontiguousarray(class_map),
        np.ascontiguousarray(np.moveaxis(center_offsets, 2, 0), np.float32),
    )


class SegmentationLearner:
    """Network and optimizer of a training.

    What is learned in a step depends only on the seed and on the step, so an interrupted training
    continues with the same results.

    Attributes:
        step: Number of batches so far.
        network: The network that is trained.
        losses: Losses of the latest batch.
    """

    def __init__(
        self,
        network: SegmentationNetwork,
        read_image: Callable[[int], LabeledImage],
        num_images: int,
        config: SegmentationConfig,
        camera: Camera,
        support: Support,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start a training.

        Args:
            network: The network to train.
            read_image: Returns the image of an index.
            num_images: Number of images.
            config: Hyperparameters.
            camera: Camera of the images.
            support: Support of the objects.
            seed: Seed of the batches and augmentations.
            device: Device of the network.
        """
        self.step = 0
        self.losses = dict[str, float]()
        self._read_image = read_image
        self._num_images = num_images
        self._config = config
        self._camera = camera
        self._seed = seed
        self._window = ImageWindow.around_support(camera, support)
        self._device = device
        self.network = network.to(device)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._optimizer = torch.optim.AdamW(
            network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        class_maps = [
            make_example(
                read_image(k), network.classes, camera, self._window, None, False
            ).class_map
            for k in range(min(num_images, MAX_IMAGES_COUNTED))
        ]
        self._class_weights = class_weights(class_maps, len(network.classes)).to(device)
        self._loader = ThreadPoolExecutor(1)
        self._prefetched = {0: self._loader.submit(self._make_batch, 0)}

    @property
    def learning_rate(self) -> float:
        """Learning rate of the current step."""
        progress = self.step / self._config.steps
        if progress < WARM_UP_FRACTION:
            factor = progress / WARM_UP_FRACTION
        else:
            phase = math.pi * (progress - WARM_UP_FRACTION) / (1 - WARM_UP_FRACTION)
            factor = 0.5 + 0.5 * math.cos(phase)
        return self._config.learning_rate * factor

    def _make_batch(self, step: int) -> TrainingExample:
        rng = item_rng(self._seed, step)
        indices = rng.integers(self._num_images, size=self._config.batch_size)
        network = self.network
        examples = [
            make_example(
                self._read_image(int(k)),
                network.classes,
                self._camera,
                self._window,
                rng,
                network.use_color,
            )
            for k in indices
        ]
        return TrainingExample(*(np.stack(arrays) for arrays in zip(*examples, strict=True)))

    def train_iteration(self) -> None:
        """Learn from one batch while a thread prepares the next one."""
        prefetched = self._prefetched.pop(self.step, None)
        batch = prefetched.result() if prefetched else self._make_batch(self.step)
        next_step = self.step + 1
        self._prefetched[next_step] = self._loader.submit(self._make_batch, next_step)
        self.network.train()
        image, class_map, center_offsets = (
            torch.from_numpy(array).to(self._device) for array in batch
        )
        logits, votes = self.network(image.to(memory_format=torch.channels_last))
        class_loss, vote_loss = segmentation_loss(
            logits, votes, class_map, center_offsets, self._class_weights
        )
        loss: Tensor = class_loss + self._config.vote_weight * vote_loss
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), MAX_GRADIENT_NORM)
        self._optimizer.step()
        self.step += 1
        self.losses = {"classes": class_loss.item(), "votes_mm": 1000 * vote_loss.item()}

    def save(self, path: Path) -> None:
        """Write the state from which `load` continues the training."""
        save_learner(path, self.network, self._optimizer, {"step": self.step})

    def load(self, path: Path) -> None:
        """Continue a training of the same config and seed where `save` was called."""
        _, state = load_learner(path, self.network, self._optimizer)
        self.step = state["step"]
