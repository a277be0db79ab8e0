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
from drake_clutter.perception.depth_noise import noisy_depth
from drake_clutter.perception.image_set import LabelledImage
from drake_clutter.perception.segmentation import (
    SegmentationNetwork,
    Window,
    class_weights,
    coarse,
    loss,
    network_input,
    points,
)
from drake_clutter.seeding import item_rng
from drake_clutter.validation import InRange, NonNegative, config_class

RISING = 0.1
"""Share of the steps in which the learning rate rises."""
_COUNTED = 200
"""Images, at most, whose pixels are counted for the weights of the classes."""


@config_class
class SegmentationConfig:
    """How the network learns.

    Attributes:
        steps: batches in all. batch: images of each.
        learning_rate: at its highest; it rises over the first tenth, and falls to nothing along a cosine.
        weight_decay: see AdamW.
        vote_weight: of a vote's error, per m, against the classes' cross entropy.
    """

    steps: Annotated[int, InRange(1)] = 5000
    batch: Annotated[int, InRange(1)] = 8
    learning_rate: NonNegative = 3e-3
    weight_decay: NonNegative = 1e-4
    vote_weight: NonNegative = 5.0


class Example(NamedTuple):
    """Arrays of one image, or tensors of a batch: what the network is given, and what it should answer, see `loss`."""

    image: NDArray[np.float32]
    kind: NDArray[np.int64]
    to_middle: NDArray[np.float32]


def example(
    image: LabelledImage,
    classes: Sequence[str],
    camera: Camera,
    window: Window,
    rng: np.random.Generator | None,
    looks_at_color: bool,
) -> Example:
    """What is learned from an image: with the depth camera's noise, turned by quarters and mirrored at random.

    Args:
        image: as rendered.
        classes: that the network knows.
        camera, window: what is looked at.
        rng: of the noise and the turns; None: neither.
        looks_at_color: whether colour is given.
    """
    depth = image.depth if rng is None else noisy_depth(image.depth, rng)
    p_TP, color, label = (
        points(depth, camera, window),
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
    kind = np.array([0] + [classes.index(name) + 1 for name in image.classes])[coarse(label) + 1]
    to_middle = np.vstack([np.full(3, np.nan), middle])[coarse(label) + 1] - coarse(p_TP)
    given = network_input(p_TP, color if looks_at_color else None)
    return Example(
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
        read: Callable[[int], LabelledImage],
        count: int,
        config: SegmentationConfig,
        camera: Camera,
        support: Support,
        seed: int,
        device: torch.device,
    ) -> None:
        """Begins a training with `count` images, each of which `read` reads."""
        self.step, self.losses = 0, dict[str, float]()
        self._read, self._count, self._config, self._camera, self._seed = (
            read,
            count,
            config,
            camera,
            seed,
        )
        self._window, self._device = Window.of(camera, support), device
        self.network = network.to(device)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._optimizer = torch.optim.AdamW(
            network.parameters(), config.learning_rate, weight_decay=config.weight_decay
        )
        counted = [
            example(read(k), network.classes, camera, self._window, None, False).kind
            for k in range(min(count, _COUNTED))
        ]
        self._weights = class_weights(counted, len(network.classes)).to(device)
        self._readers = ThreadPoolExecutor(1)
        self._ahead = {0: self._readers.submit(self._batch, 0)}

    @property
    def learning_rate(self) -> float:
        """Of the present step."""
        done = self.step / self._config.steps
        share = (
            done / RISING
            if done < RISING
            else 0.5 + 0.5 * math.cos(math.pi * (done - RISING) / (1 - RISING))
        )
        return self._config.learning_rate * share

    def _batch(self, step: int) -> Example:
        rng = item_rng(self._seed, step)
        numbers = rng.integers(self._count, size=self._config.batch)
        network = self.network
        examples = [
            example(
                self._read(int(k)),
                network.classes,
                self._camera,
                self._window,
                rng,
                network.looks_at_color,
            )
            for k in numbers
        ]
        return Example(*(np.stack(arrays) for arrays in zip(*examples, strict=True)))

    def advance(self) -> None:
        """One batch."""
        given = self._ahead.pop(self.step, None)
        batch = given.result() if given else self._batch(self.step)
        self._ahead[self.step + 1] = self._readers.submit(self._batch, self.step + 1)
        self.network.train()
        image, kind, to_middle = (torch.from_numpy(array).to(self._device) for array in batch)
        logits, votes = self.network(image.to(memory_format=torch.channels_last))
        of_classes, of_votes = loss(logits, votes, kind, to_middle, self._weights)
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
