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

from drake_clutter.agents.exploration_episodes import Played, acting, play_episodes
from drake_clutter.agents.explorer_network import ExplorerNetwork, log_probability, stacked_graphs
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    restore_learner,
    save_tensors,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.validation import InRange, NonNegative, config_class


@config_class
class ActorCriticConfig:
    """How a teacher learns.

    Attributes:
        steps: moves, in all.
        episodes: per round.
        passes: over a round's moves; batch: moves per update.
        discount: per move: finding something later is worth less.
        trace: of the advantage's estimate (GAE, Schulman et al. 2016).
        clip: of the ratio of probabilities.
        entropy, value: weights in the loss.
        learning_rate: at the beginning; it falls in a straight line, to a fiftieth.
        width: of the network.
    """

    steps: Annotated[int, InRange(1)] = 150_000
    episodes: Annotated[int, InRange(1)] = 96
    passes: Annotated[int, InRange(1)] = 4
    batch: Annotated[int, InRange(1)] = 256
    discount: Annotated[float, InRange(0.0, 1.0)] = 0.95
    trace: Annotated[float, InRange(0.0, 1.0)] = 0.9
    clip: Annotated[float, InRange(1e-06)] = 0.2
    entropy: NonNegative = 0.01
    value: NonNegative = 0.5
    learning_rate: NonNegative = 1e-3
    width: Annotated[int, InRange(1)] = 32


class ActorCritic:
    """One training, round by round.

    Attributes:
        step: moves so far.
        network: policy and value.
        losses: of the latest round.
    """

    def __init__(
        self,
        environment: ClutterExploration,
        config: ActorCriticConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        """Begins a training; the environment shows what the explorer is to see."""
        self.config, self._environment, self._seed = config, environment, seed
        torch.manual_seed(seed)
        self.network = ExplorerNetwork(len(environment.numbers), config.width).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.step, self._round = 0, 0
        self.losses: dict[str, float] = {}

    def advance(self) -> list[Played]:
        """One round; returns its episodes."""
        rng = item_rng(self._seed, 1, self._round)
        played = play_episodes(
            self._environment,
            self.config.episodes,
            (self._seed, 2, self._round),
            acting(self.network, rng),
        )
        self.learn(played, rng)
        self.step += sum(len(episode.moves) for episode in played)
        self._round += 1
        return played

    def learn(self, played: Sequence[Played], rng: np.random.Generator) -> None:
        """Takes its passes over the moves of episodes that the network has played, noted as by `acting`; `rng` orders them."""
        config = self.config
        moves = torch.from_numpy(np.array([move for episode in played for move in episode.moves]))
        before = torch.tensor([chance for episode in played for chance, _ in episode.notes])
        advantages = [advantage(episode, config.discount, config.trace) for episode in played]
        gain = torch.from_numpy(np.concatenate(advantages))
        aim = gain + torch.tensor([value for episode in played for _, value in episode.notes])
        gain = (gain - gain.mean()) / (gain.std(correction=0) + 1e-6)
        observations = stacked_graphs(
            [observation for episode in played for observation in episode.observations]
        )
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * max(0.02, 1 - self.step / config.steps)
        sums, updates = np.zeros(3), 0
        device = self.network.mark.device
        for _ in range(config.passes):
            order = rng.permutation(len(moves))
            for part in np.array_split(order, max(1, round(len(order) / config.batch))):
                found = self.network({name: array[part] for name, array in observations.items()})
                chosen = moves[part].to(device)
                places = self.network.places(found, chosen[:, 0])
                ratio = (log_probability(found, places, chosen) - before[part].to(device)).exp()
                better = gain[part].to(device)
                policy = -torch.minimum(
                    ratio * better, ratio.clamp(1 - config.clip, 1 + config.clip) * better
                ).mean()
                value = torch.nn.functional.smooth_l1_loss(found.value, aim[part].to(device))
                entropy = _entropy(found.pick) + _entropy(places)
                loss = policy + config.value * value - config.entropy * entropy
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


def advantage(episode: Played, discount: float, trace: float) -> NDArray[np.float32]:
    """(moves,) by how much better each move was than expected, see GAE; an episode's end is worth nothing more."""
    values = [value for _, value in episode.notes] + [0.0]
    found, later = np.zeros(len(episode.moves), np.float32), 0.0
    for k in reversed(range(len(found))):
        later = episode.rewards[k] + discount * values[k + 1] - values[k] + discount * trace * later
        found[k] = later
    return found


def _entropy(log_probabilities: torch.Tensor) -> torch.Tensor:
    return -(log_probabilities.exp() * log_probabilities.clamp(min=-1e4)).sum(dim=1).mean()
