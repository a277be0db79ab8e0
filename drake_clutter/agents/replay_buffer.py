"""Replay buffer of a scene generator's training, and batches of its observations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.tasks.generation_task import GenerationObservation

NETWORK_INPUT_KEYS = (
    "node_kind",
    "node_flags",
    "position",
    "edge_links",
    "edge_kind",
    "remaining_nodes",
)
"""Arrays of the observation that the network uses; the masks follow from the kinds."""


RENAMED_ARRAYS: Mapping[str, str] = {
    "edge": "edge_links",
    "remaining": "remaining_nodes",
    "mask": "action_mask",
    "chance": "behavior_prob",
    "over": "terminated",
}
"""Current name of a replay buffer's array by its name in version 0.1."""


def collate(observations: Sequence[GenerationObservation]) -> dict[str, NDArray[Any]]:
    """Return the network's input for a batch of observations, stacked along a first axis."""
    return {
        name: np.stack([observation[name] for observation in observations])
        for name in NETWORK_INPUT_KEYS
    }


class ReplayBuffer:
    """Ring buffer of the latest steps of several environments that are stepped together.

    Attributes:
        arrays: Arrays of shape (capacity per environment, number of environments, ...) by name:
            those of the observation before the step, `action_mask`, `action`, `behavior_prob`
            (probability with which the action was sampled), `reward` and `terminated`.
        num_added: Number of steps per environment that were ever added.
    """

    def __init__(
        self, capacity: int, num_envs: int, observation: GenerationObservation, num_actions: int
    ) -> None:
        """Allocate the buffer.

        Args:
            capacity: Number of steps of all environments together.
            num_envs: Number of environments.
            observation: An observation, for the shapes and types of its arrays.
            num_actions: Number of actions.
        """

        def allocate(example: NDArray[Any]) -> NDArray[Any]:
            return np.zeros((capacity // num_envs, num_envs, *example.shape), example.dtype)

        self.arrays = {name: allocate(observation[name]) for name in NETWORK_INPUT_KEYS}
        examples = {
            "action_mask": np.zeros(num_actions, bool),
            "action": np.int64(0),
            "behavior_prob": np.float32(0),
            "reward": np.float32(0),
            "terminated": np.bool_(False),
        }
        self.arrays |= {name: allocate(np.asarray(value)) for name, value in examples.items()}
        self.num_added = 0

    def add(self, **step: NDArray[Any]) -> None:
        """Add one step of every environment.

        Args:
            step: Arrays by name. Shape (number of environments, ...).
        """
        for name, array in step.items():
            self.arrays[name][self.num_added % len(self.arrays[name])] = array
        self.num_added += 1

    def sample_sequences(
        self, count: int, length: int, rng: np.random.Generator
    ) -> dict[str, NDArray[Any]] | None:
        """Sample sequences of consecutive steps of one environment each, uniformly.

        Args:
            count: Number S of sequences.
            length: Number L of steps with targets; each sequence has one more.
            rng: Random generator.

        Returns:
            Arrays of shape (S, L + 1, ...) by name; None if the buffer has too few steps.
        """
        capacity, num_envs = self.arrays["action"].shape
        stored = min(self.num_added, capacity)
        if stored <= length:
            return None
        start = self.num_added - stored + rng.integers(stored - length, size=count)
        time = (start[:, None] + np.arange(length + 1)) % capacity
        env = rng.integers(num_envs, size=count)[:, None]
        return {name: array[time, env] for name, array in self.arrays.items()}
