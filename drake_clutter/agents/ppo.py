"""Proximal policy optimization (PPO, Schulman et al. 2017) of an exploration policy.

Every iteration collects complete episodes with the current policy. Their seeds follow from the
iteration's number, so the state between two iterations consists of the network, its optimizer and
that number.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import (
    ExplorerNetwork,
    PolicyOutput,
    action_log_probs,
    collate_graphs,
)
from drake_clutter.agents.rollouts import Rollout, collect_rollouts, make_policy_fn
from drake_clutter.learning.checkpoint import load_learner, save_learner
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.validation import (
    Count,
    InRange,
    NetworkWidth,
    NonNegative,
    config_class,
    renamed_fields,
)

MIN_LEARNING_RATE_FRACTION = 0.02
"""Fraction of the initial learning rate below which the rate is not annealed.

The last iterations still change the policy.
"""


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
    """Hyperparameters of PPO.

    Attributes:
        total_timesteps: Total number of moves.
        episodes_per_iteration: Number of episodes per iteration.
        update_epochs: Number of passes over the moves of an iteration.
        minibatch_size: Approximate number of moves per update.
        gamma: Discount factor per move; below 1, an object found later is worth less.
        gae_lambda: Lambda of generalized advantage estimation (GAE, Schulman et al. 2016).
        clip_coef: Clipping range of the probability ratio.
        ent_coef: Weight of the entropy bonus.
        vf_coef: Weight of the value loss.
        learning_rate: Initial learning rate of Adam; annealed linearly to a fiftieth of it.
        width: Width of the network's embeddings.
    """

    total_timesteps: Count = 150_000
    episodes_per_iteration: Count = 96
    update_epochs: Count = 4
    minibatch_size: Count = 256
    gamma: Annotated[float, InRange(0.0, 1.0)] = 0.95
    gae_lambda: Annotated[float, InRange(0.0, 1.0)] = 0.9
    clip_coef: Annotated[float, InRange(1e-06)] = 0.2
    ent_coef: NonNegative = 0.01
    vf_coef: NonNegative = 0.5
    learning_rate: NonNegative = 1e-3
    width: NetworkWidth = 32


class PPOLearner:
    """A PPO run.

    Attributes:
        config: Hyperparameters.
        step: Number of moves so far.
        network: Policy and value function.
        losses: Mean losses of the latest iteration by name.
    """

    def __init__(
        self,
        environment: ClutterExploration,
        config: PPOConfig,
        seed: int,
        device: torch.device,
    ) -> None:
        """Start a run.

        Args:
            environment: Where the policy is trained.
            config: Hyperparameters.
            seed: Seed of the run.
            device: Device of the network.
        """
        self.config = config
        self._environment = environment
        self._seed = seed
        torch.manual_seed(seed)
        self.network = ExplorerNetwork(
            len(environment.node_kind_ids),
            config.width,
            finds_target=environment.target_text is not None,
        ).to(device)
        self._optimizer = torch.optim.Adam(self.network.parameters(), config.learning_rate)
        self.step = 0
        self._iteration = 0
        self.losses: dict[str, float] = {}

    def train_iteration(self) -> list[Rollout]:
        """Collect episodes, update the network, and return the episodes."""
        rng = item_rng(self._seed, 1, self._iteration)
        rollouts = collect_rollouts(
            self._environment,
            self.config.episodes_per_iteration,
            (self._seed, 2, self._iteration),
            make_policy_fn(self.network, rng),
        )
        self.update(rollouts, rng)
        self.step += sum(len(rollout.actions) for rollout in rollouts)
        self._iteration += 1
        return rollouts

    def update(self, rollouts: Sequence[Rollout], rng: np.random.Generator) -> None:
        """Update the network in several epochs over the moves of episodes.

        Args:
            rollouts: Episodes that were collected with `make_policy_fn` of the current network.
            rng: Shuffles the moves.
        """
        config = self.config
        actions = torch.from_numpy(
            np.array([action for rollout in rollouts for action in rollout.actions])
        )
        extras = [extra for rollout in rollouts for extra in rollout.policy_extras]
        old_log_probs = torch.tensor([log_prob for log_prob, _ in extras])
        advantages = torch.from_numpy(
            np.concatenate(
                [compute_gae(rollout, config.gamma, config.gae_lambda) for rollout in rollouts]
            )
        )
        returns = advantages + torch.tensor([value for _, value in extras])
        advantages = (advantages - advantages.mean()) / (advantages.std(correction=0) + 1e-6)
        observations = collate_graphs(
            [observation for rollout in rollouts for observation in rollout.observations]
        )
        annealing = max(MIN_LEARNING_RATE_FRACTION, 1 - self.step / config.total_timesteps)
        for group in self._optimizer.param_groups:
            group["lr"] = config.learning_rate * annealing
        loss_sums = np.zeros(3)
        num_updates = 0
        device = self.network.pick_marker.device
        for _ in range(config.update_epochs):
            order = rng.permutation(len(actions))
            num_minibatches = max(1, round(len(order) / config.minibatch_size))
            for minibatch in np.array_split(order, num_minibatches):
                output: PolicyOutput = self.network(
                    {name: array[minibatch] for name, array in observations.items()}
                )
                minibatch_actions = actions[minibatch].to(device)
                place_log_probs = self.network.place_log_probs(output, minibatch_actions[:, 0])
                log_probs = action_log_probs(output, place_log_probs, minibatch_actions)
                ratio = (log_probs - old_log_probs[minibatch].to(device)).exp()
                advantage = advantages[minibatch].to(device)
                policy_loss = -torch.minimum(
                    ratio * advantage,
                    ratio.clamp(1 - config.clip_coef, 1 + config.clip_coef) * advantage,
                ).mean()
                value_loss = torch.nn.functional.smooth_l1_loss(
                    output.value, returns[minibatch].to(device)
                )
                entropy = _mean_entropy(output.pick_log_probs) + _mean_entropy(place_log_probs)
                loss = policy_loss + config.vf_coef * value_loss - config.ent_coef * entropy
                self._optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
                self._optimizer.step()
                loss_sums += [policy_loss.item(), value_loss.item(), entropy.item()]
                num_updates += 1
        self.losses = dict(
            zip(("policy", "value", "entropy"), (loss_sums / num_updates).tolist(), strict=True)
        )

    def save(self, path: Path) -> None:
        """Write the complete state of the run; see `Learner`."""
        state = {"step": self.step, "round": self._iteration}
        save_learner(path, self.network, self._optimizer, state)

    def load(self, path: Path) -> None:
        """Restore the state of a run of the same config and seed; see `Learner`."""
        _, state = load_learner(path, self.network, self._optimizer)
        self.step = state["step"]
        self._iteration = state["round"]


def compute_gae(rollout: Rollout, gamma: float, gae_lambda: float) -> NDArray[np.float32]:
    """Compute generalized advantage estimates (Schulman et al. 2016, eq. 16).

    The value after the last move is 0, however the episode ended.

    Args:
        rollout: An episode that was collected with `make_policy_fn`.
        gamma: Discount factor.
        gae_lambda: Weight of later temporal-difference errors.

    Returns:
        Advantages. Shape (number of moves,).
    """
    values = [value for _, value in rollout.policy_extras] + [0.0]
    advantages = np.zeros(len(rollout.actions), np.float32)
    advantage = 0.0
    for k in reversed(range(len(advantages))):
        advantage = (
            rollout.rewards[k] + gamma * values[k + 1] - values[k] + gamma * gae_lambda * advantage
        )
        advantages[k] = advantage
    return advantages


def _mean_entropy(log_probs: torch.Tensor) -> torch.Tensor:
    """Return the mean entropy of distributions. Shape of the log-probabilities: (B, N)."""
    return -(log_probs.exp() * log_probs.clamp(min=-1e4)).sum(dim=1).mean()
