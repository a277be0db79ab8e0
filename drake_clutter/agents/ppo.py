"""Actor-critic learning of an explorer: proximal policy optimisation (Schulman et al. 2017) on whole episodes.

Every round plays fresh episodes to their ends with the present policy, whose seeds follow from the round's number: so the state
between two rounds is the network, its optimiser and the number of rounds.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import ExplorerNetwork, action_log_probs, collate_graphs
from drake_clutter.agents.rollouts import Rollout, collect_rollouts, make_policy_fn
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    restore_learner,
    save_tensors,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.validation import InRange, NonNegative, config_class, renamed_fields


@config_class
@renamed_fields(
    steps="total_timesteps",
    episodes="episodes_per_iteration",
    passes="update_epochs",
    batch="minibatch_size",
    discount="gamma",
    trace="gae_lambda",
    clip="clip_coef",
    entropy="ent_coef",
    value="vf_coef",
)
class PPOConfig:
    """How a teacher learns.

    Attributes:
        total_timesteps: moves, in all.
        episodes_per_iteration: per round.
        update_epochs: over a round's moves; minibatch_size: moves per update.
        gamma: per move: finding something later is worth less.
        gae_lambda: of the advantage's estimate (GAE, Schulman et al. 2016).
        clip_coef: of the ratio of probabilities.
        ent_coef, vf_coef: weights in the loss.
        learning_rate: at the beginning; it falls in a straight line, to a fiftieth.
        width: of the network.
    """

    total_timesteps: Annotated[int, InRange(1)] = 150_000
    episodes_per_iteration: Annotated[int, InRange(1)] = 96
    update_epochs: Annotated[int, InRange(1)] = 4
    minibatch_size: Annotated[int, InRange(1)] = 256
    gamma: Annotated[float, InRange(0.0, 1.0)] = 0.95
    gae_lambda: Annotated[float, InRange(0.0, 1.0)] = 0.9
    clip_coef: Annotated[float, InRange(1e-06)] = 0.2
    ent_coef: NonNegative = 0.01
    vf_coef: NonNegative = 0.5
    learning_rate: NonNegative = 1e-3
    width: Annotated[int, InRange(1)] = 32


class PPOLearner:
    """One training, round by round.

    Attributes:
        step: moves so far.
        network: policy and value.
        losses: of the latest round.
    """

    def __init__(
        self,
        environment: ClutterExploration,
        config: PPOConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        """Begins a training; the environment shows what the explorer is to see."""
        self.config, self._environment, self._seed = config, environment, seed
        torch.manual_seed(seed)
        self.network = ExplorerNetwork(len(environment.node_kind_ids), config.width).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.step, self._round = 0, 0
        self.losses: dict[str, float] = {}

    def train_iteration(self) -> list[Rollout]:
        """One round; returns its episodes."""
        rng = item_rng(self._seed, 1, self._round)
        played = collect_rollouts(
            self._environment,
            self.config.episodes_per_iteration,
            (self._seed, 2, self._round),
            make_policy_fn(self.network, rng),
        )
        self.update(played, rng)
        self.step += sum(len(episode.actions) for episode in played)
        self._round += 1
        return played

    def update(self, rollouts: Sequence[Rollout], rng: np.random.Generator) -> None:
        """Takes its passes over the moves of episodes that the network has played, noted as by `acting`; `rng` orders them."""
        config = self.config
        moves = torch.from_numpy(
            np.array([move for episode in rollouts for move in episode.actions])
        )
        before = torch.tensor(
            [chance for episode in rollouts for chance, _ in episode.policy_extras]
        )
        advantages = [compute_gae(episode, config.gamma, config.gae_lambda) for episode in rollouts]
        gain = torch.from_numpy(np.concatenate(advantages))
        aim = gain + torch.tensor(
            [value for episode in rollouts for _, value in episode.policy_extras]
        )
        gain = (gain - gain.mean()) / (gain.std(correction=0) + 1e-6)
        observations = collate_graphs(
            [observation for episode in rollouts for observation in episode.observations]
        )
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * max(0.02, 1 - self.step / config.total_timesteps)
        sums, updates = np.zeros(3), 0
        device = self.network.pick_marker.device
        for _ in range(config.update_epochs):
            order = rng.permutation(len(moves))
            for part in np.array_split(order, max(1, round(len(order) / config.minibatch_size))):
                found = self.network({name: array[part] for name, array in observations.items()})
                chosen = moves[part].to(device)
                places = self.network.place_log_probs(found, chosen[:, 0])
                ratio = (action_log_probs(found, places, chosen) - before[part].to(device)).exp()
                better = gain[part].to(device)
                policy = -torch.minimum(
                    ratio * better, ratio.clamp(1 - config.clip_coef, 1 + config.clip_coef) * better
                ).mean()
                value = torch.nn.functional.smooth_l1_loss(found.value, aim[part].to(device))
                entropy = _entropy(found.pick_log_probs) + _entropy(places)
                loss = policy + config.vf_coef * value - config.ent_coef * entropy
                self._optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
                self._optimizer.step()
                sums += [policy.item(), value.item(), entropy.item()]
                updates += 1
        self.losses = dict(
            zip(("policy", "value", "entropy"), (sums / updates).tolist(), strict=True)
        )

    def save(self, path: Path) -> None:
        """Writes all that the training needs to go on as if it had never been interrupted."""
        state = {"step": self.step, "round": self._round}
        save_tensors(path, learner_tensors(self.network, self._optimizer), state)

    def load(self, path: Path) -> None:
        """Goes on where `save` was called, in a training of the same config and seed."""
        tensors, state = load_tensors(path)
        restore_learner(self.network, self._optimizer, tensors)
        self.step, self._round = state["step"], state["round"]


def compute_gae(episode: Rollout, gamma: float, gae_lambda: float) -> NDArray[np.float32]:
    """(moves,) by how much better each move was than expected, see GAE; an episode's end is worth nothing more."""
    values = [value for _, value in episode.policy_extras] + [0.0]
    found, later = np.zeros(len(episode.actions), np.float32), 0.0
    for k in reversed(range(len(found))):
        later = episode.rewards[k] + gamma * values[k + 1] - values[k] + gamma * gae_lambda * later
        found[k] = later
    return found


def _entropy(log_probabilities: torch.Tensor) -> torch.Tensor:
    return -(log_probabilities.exp() * log_probabilities.clamp(min=-1e4)).sum(dim=1).mean()
