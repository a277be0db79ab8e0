"""Cloning of a reaching policy from the states of demonstrations and next to them.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from drake_clutter.learning.checkpoint import load_learner, save_learner
from drake_clutter.planning.tool_kinematics import ToolKinematics
from drake_clutter.seeding import item_rng
from drake_clutter.validation import Count, Flag, NonEmptyText, Positive, Seed, config_class
from training.reaching_demonstrations import Demonstration
from training.reaching_policy import LOOKAHEAD, ReachingPolicy

Floats = NDArray[np.float64]

STATES_PER_MOVE = 8
"""States of a demonstration in a batch."""
PERTURBATIONS = (0.002, 0.15)
"""Range of the standard deviation of sampled offsets from demonstrated joint angles [rad]."""


@config_class
class CloningConfig:
    """Configuration of a training.

    Attributes:
        data: Folder that `drake-clutter record` wrote.
        tool: Name of the tool whose moves are learned; it must be on the axis of the last joint.
        observation: Where the target comes from: `state` or `depth`.
        validation: Number of the last moves, whose scenes are not learned from.
        seed: Random seed.
        steps: Number of batches.
        batch_size: States in a batch.
        learning_rate: Learning rate of Adam at the start; it decreases to 0 as a cosine.
        perturb: Whether to sample states next to the demonstrations.
        evaluate_every: Steps between two evaluations.
    """

    data: str = "runs/train_sg_star_moves"
    tool: NonEmptyText = "large"
    observation: Literal["state", "depth"] = "state"
    validation: Count = 100
    seed: Seed = 0
    steps: Count = 6000
    batch_size: Count = 256
    learning_rate: Positive = 1e-3
    perturb: Flag = True
    evaluate_every: Count = 500


class CloningLearner:
    """Network and optimizer of a training.

    Attributes:
        step: Number of batches so far.
        network: The policy.
        losses: Losses of the latest batch.
    """

    def __init__(
        self,
        network: ReachingPolicy,
        demonstrations: Sequence[Demonstration],
        config: CloningConfig,
    ) -> None:
        """Start a training.

        Args:
            network: Policy.
            demonstrations: Moves to learn from.
            config: Configuration.
        """
        self.step = 0
        self.network = network
        self.losses = dict[str, float]()
        self._config = config
        self._sampler = StateSampler(demonstrations, perturb=config.perturb)
        self._optimizer = torch.optim.Adam(network.parameters(), config.learning_rate)
        if config.observation == "depth":
            images = [d.image for d in demonstrations if d.image is not None]
            self._images = torch.from_numpy(np.stack(images))

    def train_iteration(self) -> None:
        """Learn from one batch."""
        config = self._config
        progress = self.step / config.steps
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * (1 + math.cos(math.pi * progress)) / 2
        batch = self._sampler.sample(config.batch_size, item_rng(config.seed, self.step))
        if config.observation == "depth":
            chosen, inverse = torch.unique(batch.index, return_inverse=True)
            target = self.network.find_target(self._images[chosen])[inverse]
        else:
            target = batch.target
        change = self.network(batch.q, batch.p_TG, batch.axis, target)
        loss = relative_error(change, batch.change).mean()
        self.losses = {"waypoint": loss.item()}
        if config.observation == "depth":
            # Where the demonstration ends, its tool is at the point to be found.
            point_loss = functional.l1_loss(target[:, :3], batch.end)
            self.losses["target_mm"] = 1000 * point_loss.item()
            loss = loss + 10 * point_loss
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        self._optimizer.step()
        self.step += 1

    def save(self, path: Path) -> None:
        """Write the state from which `load` continues the training."""
        save_learner(path, self.network, self._optimizer, {"step": self.step})

    def load(self, path: Path) -> None:
        """Continue a training of the same config and seed where `save` was called."""
        _, state = load_learner(path, self.network, self._optimizer)
        self.step = state["step"]


def relative_error(change: Tensor, expected: Tensor) -> Tensor:
    """Return the error of waypoints relative to their distance, shape (b,), from (b, n - 1).

    Close to the target, where waypoints are close, errors of milliradians count.
    """
    scale = expected.abs().amax(dim=1) + 0.01
    return (change - expected).abs().mean(dim=1) / scale


@dataclass(frozen=True, eq=False)
class StateBatch:
    """States with the waypoints of their demonstrations.

    Attributes:
        index: Index of the demonstration. Shape (b,).
        q: Joint angles [rad]. Shape (b, n).
        p_TG: Position of the tool [m]. Shape (b, 3).
        axis: Axis of the tool. Shape (b, 3).
        target: Target, see `object_target` [m]. Shape (b, 4).
        end: Position of the tool at the end of the demonstration [m]. Shape (b, 3).
        change: Change of the joint angles to the waypoint [rad]. Shape (b, n - 1).
    """

    index: Tensor
    q: Tensor
    p_TG: Tensor
    axis: Tensor
    target: Tensor
    end: Tensor
    change: Tensor


class StateSampler:
    """Samples states of demonstrations and next to them."""

    def __init__(self, demonstrations: Sequence[Demonstration], *, perturb: bool) -> None:
        """Compute waypoints.

        Args:
            demonstrations: Demonstrations.
            perturb: Whether to sample states next to them.
        """
        self._perturb = perturb
        self._kinematics = ToolKinematics(demonstrations[0].cell, demonstrations[0].tool)
        q, waypoints, index = list[Floats](), list[Floats](), list[int]()
        for k, d in enumerate(demonstrations):
            # The arm waits at the end, so that the policy learns to stop.
            period = float(np.median(np.diff(d.time)))
            times = np.arange(d.time[0], d.time[-1] + LOOKAHEAD, period)
            for array, shift in ((q, 0.0), (waypoints, LOOKAHEAD)):
                columns = [np.interp(times + shift, d.time, column) for column in d.q.T]
                array.append(np.column_stack(columns))
            index += [k] * len(times)
        self._q = np.concatenate(q)
        self._waypoints = np.concatenate(waypoints)
        self._index = np.array(index)
        self._first = np.searchsorted(self._index, np.arange(len(demonstrations) + 1))
        self._targets = np.array([d.target for d in demonstrations])
        self._ends = self._kinematics.pose(np.array([d.q[-1] for d in demonstrations]))[:, :3, 3]

    @property
    def action_scale(self) -> Floats:
        """Standard deviation of the changes of the joint angles [rad]. Shape (n - 1,)."""
        return np.asarray((self._waypoints - self._q)[:, :-1].std(axis=0))

    def sample(self, size: int, rng: np.random.Generator) -> StateBatch:
        """Return random states."""
        # Few demonstrations in a batch, because each has an image.
        moves = rng.integers(len(self._first) - 1, size=max(1, size // STATES_PER_MOVE))
        moves = np.repeat(moves, STATES_PER_MOVE)
        chosen = rng.integers(self._first[moves], self._first[moves + 1])
        size = len(chosen)
        q = self._q[chosen]
        if self._perturb:
            low, high = np.log(PERTURBATIONS)
            scale = np.exp(rng.uniform(low, high, (size, 1)))
            q = q + scale * rng.standard_normal(q.shape)
        return self._batch(chosen, q)

    def all_states(self) -> StateBatch:
        """Return all demonstrated states."""
        return self._batch(np.arange(len(self._q)), self._q)

    def _batch(self, chosen: NDArray[np.int64], q: Floats) -> StateBatch:
        index = self._index[chosen]
        X_TG = self._kinematics.pose(q)
        p_TG, axis = X_TG[:, :3, 3], X_TG[:, :3, 2]
        change = (self._waypoints[chosen] - q)[:, :-1]
        arrays = (q, p_TG, axis, self._targets[index], self._ends[index], change)
        tensors = [torch.from_numpy(array.astype(np.float32)) for array in arrays]
        return StateBatch(torch.from_numpy(index), *tensors)
