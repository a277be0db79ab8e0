"""Training of the segmentation network on rendered images."""

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drake_clutter.cell.camera import Camera
from drake_clutter.cell.support import Support
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    restore_learner,
    save_tensors,
)
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
from drake_clutter.validation import InRange, NonNegative, config_class, renamed_fields

WARM_UP_FRACTION = 0.1
"""Share of the steps in which the learning rate rises."""
MAX_IMAGES_COUNTED = 200
"""Images, at most, whose pixels are counted for the weights of the classes."""


@config_class
@renamed_fields(batch="batch_size")
class SegmentationConfig:
    """How the network learns.

    Attributes:
        steps: batches in all. batch_size: images of each.
        learning_rate: at its highest; it rises over the first tenth, and falls to nothing along a cosine.
        weight_decay: see AdamW.
        vote_weight: of a vote's error, per m, against the classes' cross entropy.
    """

    steps: Annotated[int, InRange(1)] = 5000
    batch_size: Annotated[int, InRange(1)] = 8
    learning_rate: NonNegative = 3e-3
    weight_decay: NonNegative = 1e-4
    vote_weight: NonNegative = 5.0


class TrainingExample(NamedTuple):
    """Arrays of one image, or tensors of a batch: what the network is given, and what it should answer, see `loss`."""

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
    """What is learned from an image: with the depth camera's noise, turned by quarters and mirrored at random.

    Args:
        image: as rendered.
        classes: that the network knows.
        camera, window: what is looked at.
        rng: of the noise and the turns; None: neither.
        use_color: whether colour is given.
    """
    depth = image.depth if rng is None else add_depth_noise(image.depth, rng)
    p_TP, color, label = (
        backproject_window(depth, camera, window),
        image.color[window.rows, window.columns],
        image.label,
    )
    label, middle = (
        label[window.rows, window.columns],
        np.array([pose.translation for pose in image.X_TO]).reshape(-1, 3),
    )
    if rng is not None:
        turns, step = int(rng.integers(4)), int(rng.choice([-1, 1]))
        p_TP, label = np.rot90(p_TP, turns)[:, ::step], np.rot90(label, turns)[:, ::step]
        R = np.diag([step, 1.0, 1.0]) @ np.linalg.matrix_power(
            [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], turns
        )
        p_TP, middle = (p_TP @ R.T).astype(np.float32), middle @ R.T
        light = rng.uniform(0.7, 1.3, 3) * rng.uniform(0.6, 1.4)
        color = np.clip(np.rot90(color, turns)[:, ::step] * light, 0, 255).astype(np.uint8)
    kind = np.array([0] + [classes.index(name) + 1 for name in image.classes])[
        downsample(label) + 1
    ]
    to_middle = np.vstack([np.full(3, np.nan), middle])[downsample(label) + 1] - downsample(p_TP)
    given = make_network_input(p_TP, color if use_color else None)
    return TrainingExample(
        given,
        np.ascontiguousarray(kind),
        np.ascontiguousarray(np.moveaxis(to_middle, 2, 0), np.float32),
    )


class SegmentationLearner:
    """Network and optimiser of one training, batch by batch; what a step learns from depends on nothing but seed and step.

    Attributes:
        step: batches so far. network: what learns. losses: of the latest step.
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
        """Begins a training with `num_images` images, each of which `read_image` reads."""
        self.step, self.losses = 0, dict[str, float]()
        self._read, self._count, self._config, self._camera, self._seed = (
            read_image,
            num_images,
            config,
            camera,
            seed,
        )
        self._window, self._device = ImageWindow.around_support(camera, support), device
        self.network = network.to(device)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._optimizer = torch.optim.AdamW(
            network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        counted = [
            make_example(
                read_image(k), network.classes, camera, self._window, None, False
            ).class_map
            for k in range(min(num_images, MAX_IMAGES_COUNTED))
        ]
        self._weights = class_weights(counted, len(network.classes)).to(device)
        self._readers = ThreadPoolExecutor(1)
        self._ahead = {0: self._readers.submit(self._batch, 0)}

    @property
    def learning_rate(self) -> float:
        """Of the present step."""
        done = self.step / self._config.steps
        share = (
            done / WARM_UP_FRACTION
            if done < WARM_UP_FRACTION
            else 0.5 + 0.5 * math.cos(math.pi * (done - WARM_UP_FRACTION) / (1 - WARM_UP_FRACTION))
        )
        return self._config.learning_rate * share

    def _batch(self, step: int) -> TrainingExample:
        rng = item_rng(self._seed, step)
        numbers = rng.integers(self._count, size=self._config.batch_size)
        network = self.network
        examples = [
            make_example(
                self._read(int(k)),
                network.classes,
                self._camera,
                self._window,
                rng,
                network.use_color,
            )
            for k in numbers
        ]
        return TrainingExample(*(np.stack(arrays) for arrays in zip(*examples, strict=True)))

    def train_iteration(self) -> None:
        """One batch."""
        given = self._ahead.pop(self.step, None)
        batch = given.result() if given else self._batch(self.step)
        self._ahead[self.step + 1] = self._readers.submit(self._batch, self.step + 1)
        self.network.train()
        image, kind, to_middle = (torch.from_numpy(array).to(self._device) for array in batch)
        logits, votes = self.network(image.to(memory_format=torch.channels_last))
        of_classes, of_votes = segmentation_loss(logits, votes, kind, to_middle, self._weights)
        total: Tensor = of_classes + self._config.vote_weight * of_votes
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        self._optimizer.zero_grad()
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
        self._optimizer.step()
        self.step += 1
        self.losses = {"classes": of_classes.item(), "votes_mm": 1000 * of_votes.item()}

    def save(self, path: Path) -> None:
        """Writes all that the training needs to go on as if it had never been interrupted."""
        save_tensors(path, learner_tensors(self.network, self._optimizer), {"step": self.step})

    def load(self, path: Path) -> None:
        """Goes on where `save` was called, in a training of the same config and seed."""
        tensors, state = load_tensors(path)
        restore_learner(self.network, self._optimizer, tensors)
        self.step = state["step"]
