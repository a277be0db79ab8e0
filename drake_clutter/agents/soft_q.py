"""Soft Q-learning of a scene generator.

The policy is the softmax of Q / temperature over the feasible rules (Haarnoja et al. 2017). Its
entropy is measured relative to the uniform choice among the feasible rules. Without discount, and
with a deterministic grammar, the optimal soft policy therefore samples each derivation with the
probability that the random generator gives it, times exp(return / temperature), up to
normalization. In particular, a state is not worth more because more rules are feasible in it.

Symbols in shapes: S sequences of L steps; B the batch size.
"""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drake_clutter.agents.graph_network import RuleQNetwork
from drake_clutter.agents.replay_buffer import (
    NETWORK_INPUT_KEYS,
    RENAMED_ARRAYS,
    ReplayBuffer,
    collate,
)
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import (
    load_learner,
    save_learner,
    tensors_with_prefix,
    with_current_keys,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationObservation
from drake_clutter.validation import (
    Count,
    CountOrZero,
    InRange,
    NetworkWidth,
    NonNegative,
    config_class,
    renamed_fields,
)

NUM_GRADIENT_SHARDS = 2
"""Number of parts into which the batch of an update is split.

The parts can be computed in parallel. Their number is fixed, so that the sum of their gradients,
and thereby the training, does not depend on the number of threads.
"""

RENAMED_STATE: Mapping[str, str] = {"remembered": "num_added", "score": "episodic_return"}
"""Current key of a saved training state by its name in version 0.1."""


@config_class
@renamed_fields(
    steps="total_timesteps",
    environments="num_envs",
    batch="batch_size",
    segment="sequence_length",
    trace="retrace_lambda",
    steps_per_update="train_frequency",
    replay="buffer_size",
    warm_up="learning_starts",
    halve_every="lr_halving_steps",
    target_rate="tau",
)
class SoftQConfig:
    """Hyperparameters of soft Q-learning.

    Attributes:
        total_timesteps: Total number of environment steps.
        num_envs: Number of environments that are stepped together.
        batch_size: Number of environment steps in the batch of an update.
        sequence_length: Number of consecutive steps for which Retrace computes targets.
        retrace_lambda: Weight of later steps in the targets; 0 gives one-step targets.
        train_frequency: Number of environment steps per update.
        buffer_size: Number of environment steps in the replay buffer.
        learning_starts: Number of steps with uniformly random actions before the first update.
        learning_rate: Initial learning rate of Adam.
        lr_halving_steps: Number of environment steps after which the learning rate is halved.
        temperature: Temperature of the policy, in units of the reward.
        tau: Fraction by which the target network moves toward the network at each update.
        width: Width of the network's embeddings.
    """

    total_timesteps: Count = 640_000
    num_envs: Count = 32
    batch_size: Count = 128
    sequence_length: Count = 8
    retrace_lambda: Annotated[float, InRange(0.0, 1.0)] = 0.95
    train_frequency: Count = 4
    buffer_size: Count = 100_000
    learning_starts: CountOrZero = 4_000
    learning_rate: NonNegative = 1e-3
    lr_halving_steps: Count = 128_000
    temperature: Annotated[float, InRange(1e-06)] = 0.25
    tau: Annotated[float, InRange(0.0, 1.0)] = 0.005
    width: NetworkWidth = 32


class SampledEpisode(NamedTuple):
    """A finished episode.

    Attributes:
        episodic_return: Sum of the rewards.
        info: Last `info` of the environment.
    """

    episodic_return: float
    info: dict[str, Any]


def sample_softmax_actions(
    values: NDArray[np.float32],
    action_mask: NDArray[np.bool_],
    temperature: float,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """Sample actions from softmax(values / temperature) by the Gumbel-max trick.

    Args:
        values: Action values. Shape (B, number of actions).
        action_mask: Feasible actions. Shape (B, number of actions).
        temperature: Temperature of the softmax, in units of the values.
        rng: Random generator.

    Returns:
        A feasible action for each row. Shape (B,).
    """
    noise = rng.gumbel(size=values.shape)
    return np.asarray(np.where(action_mask, values / temperature + noise, -np.inf).argmax(axis=1))


def action_probabilities(
    values: NDArray[np.float32],
    action_mask: NDArray[np.bool_],
    actions: NDArray[np.int64],
    temperature: float,
) -> NDArray[np.float32]:
    """Return the probability with which `sample_softmax_actions` samples each action.

    Args:
        values: Action values. Shape (B, number of actions).
        action_mask: Feasible actions. Shape (B, number of actions).
        actions: Actions. Shape (B,).
        temperature: Temperature of the softmax, in units of the values.

    Returns:
        Probabilities. Shape (B,).
    """
    exponent = np.where(action_mask, values / temperature, -np.inf)
    weight = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(weight[np.arange(len(actions)), actions] / weight.sum(axis=1), np.float32)


def soft_value(values: Tensor, action_mask: Tensor, temperature: float) -> Tensor:
    """Return the soft state value V = temperature * log(mean(exp(Q / temperature))).

    Args:
        values: Action values Q. Shape (B, number of actions).
        action_mask: Feasible actions, over which the mean is taken. Shape (B, number of actions).
        temperature: Temperature of the policy, in units of the values.

    Returns:
        State values; 0 where no action is feasible. Shape (B,).
    """
    exponent = (values / temperature).masked_fill(~action_mask, -torch.inf)
    log_mean = exponent.logsumexp(dim=1) - action_mask.sum(dim=1).log()
    return torch.where(action_mask.any(dim=1), temperature * log_mean, 0.0)


def sample_episodes(
    network: RuleQNetwork,
    make_env: Callable[[], ClutterGeneration],
    count: int,
    temperature: float,
    seed: int,
    num_envs: int = 64,
) -> list[SampledEpisode]:
    """Sample episodes with the softmax policy; equal seeds give equal episodes.

    Args:
        network: The Q-network.
        make_env: Creates an environment.
        count: Number of episodes.
        temperature: Temperature of the policy, in units of the reward.
        seed: Seed of the policy and the environments.
        num_envs: Maximum number of environments that are stepped together.
    """
    environments = [make_env() for _ in range(min(num_envs, count))]
    rng = item_rng(seed, 2)
    episodes = list[SampledEpisode]()
    while len(episodes) < count:
        # All environments finish before any is reset. Otherwise short episodes, which finish
        # first, would be overrepresented.
        running = {
            k: environment.reset(seed=int(rng.integers(2**31)))
            for k, environment in enumerate(environments)
        }
        returns = [0.0] * len(environments)
        finished = dict[int, SampledEpisode]()
        while running:
            observations = collate([observation for observation, _ in running.values()])
            masks = np.array([info["action_mask"] for _, info in running.values()]).astype(bool)
            with torch.no_grad():
                values = network(observations).cpu().numpy()
            actions = sample_softmax_actions(values, masks, temperature, rng)
            for k, action in zip(list(running), actions.tolist(), strict=True):
                observation, reward, terminated, _, info = environments[k].step(action)
                returns[k] += float(reward)
                running[k] = observation, info
                if terminated:
                    finished[k] = SampledEpisode(returns[k], info)
                    del running[k]
        episodes += [finished[k] for k in range(len(environments))]
    return episodes[:count]


def retrace_targets(
    values: Tensor,
    action_mask: Tensor,
    action: Tensor,
    behavior_prob: Tensor,
    reward: Tensor,
    terminated: Tensor,
    temperature: float,
    retrace_lambda: float,
) -> Tensor:
    """Compute Retrace targets (Munos et al. 2016, eqs. 3-4) with soft state values.

    Without discount, with pi the softmax policy, mu the behavior policy and V the soft value:

        target[k] = r[k] + V[k+1] + c[k+1] * (target[k+1] - Q[k+1, a[k+1]])
        c = retrace_lambda * min(1, pi(a) / mu(a))
        pi(a) = exp((Q(a) - V) / temperature) / number of feasible actions

    The targets are truncated at the ends of episodes.

    Args:
        values: Action values Q of the target network. Shape (S, L + 1, number of actions).
        action_mask: Feasible actions. Shape (S, L + 1, number of actions).
        action: Action of each step. Shape (S, L + 1).
        behavior_prob: Probability mu with which each action was sampled. Shape (S, L + 1).
        reward: Reward of each step. Shape (S, L + 1).
        terminated: Whether the episode ended with the step. Shape (S, L + 1).
        temperature: Temperature of the policy, in units of the reward.
        retrace_lambda: Weight of later steps; 0 gives one-step targets, 1 uses all steps.

    Returns:
        Targets for Q(s, a) of the first L steps. Shape (S, L).
    """
    flat_value = soft_value(values.flatten(0, 1), action_mask.flatten(0, 1), temperature)
    value = flat_value.view_as(reward)
    action_value = values.gather(2, action[:, :, None]).squeeze(2)
    policy_prob = ((action_value - value) / temperature).exp() / action_mask.sum(dim=2)
    coefficient = retrace_lambda * (policy_prob / behavior_prob).clamp(max=1.0)
    length = reward.shape[1] - 1
    targets: list[Tensor] = []
    next_value = value[:, length]
    for k in reversed(range(length)):
        targets.append(reward[:, k] + torch.where(terminated[:, k], 0.0, next_value))
        next_value = value[:, k] + coefficient[:, k] * (targets[-1] - action_value[:, k])
    return torch.stack(targets[::-1], dim=1)


class SoftQLearner:
    """A soft Q-learning run: environments, networks and replay buffer.

    Attributes:
        config: Hyperparameters.
        seed: Seed of the run.
        device: Device of the networks.
        step: Number of environment steps so far.
        network: The Q-network.
        losses: Losses of all updates since the list was last cleared.
    """

    def __init__(
        self,
        make_env: Callable[[], ClutterGeneration],
        config: SoftQConfig,
        seed: int,
        device: torch.device,
        num_threads: int = NUM_GRADIENT_SHARDS,
    ) -> None:
        """Start a run.

        Args:
            make_env: Creates an environment.
            config: Hyperparameters.
            seed: Seed of the run.
            device: Device of the networks.
            num_threads: Number of threads that compute an update; does not change the result.

        Raises:
            InputError: The replay buffer has no room for a sequence of every environment.
        """
        min_buffer_size = config.num_envs * (config.sequence_length + 1)
        if config.buffer_size < min_buffer_size:
            raise InputError(
                f"learning.buffer_size: {config.buffer_size}; expected {min_buffer_size} "
                "(num_envs * (sequence_length + 1)) or more"
            )
        self.config = config
        self.seed = seed
        self.device = device
        self._environments: list[ClutterGeneration] = [make_env() for _ in range(config.num_envs)]
        vocabulary = self._environments[0].vocabulary
        num_rules = len(self._environments[0].grammar.rules)
        torch.manual_seed(seed)
        self.network = RuleQNetwork(
            len(vocabulary.node_kinds), len(vocabulary.edge_kinds), num_rules, config.width
        ).to(device)
        self._target = deepcopy(self.network).requires_grad_(False)
        self._optimizer = torch.optim.Adam(
            self.network.parameters(), config.learning_rate, fused=True
        )
        self._workers = ThreadPoolExecutor(num_threads)
        self._rng = item_rng(seed, 0)
        self.step = 0
        self.losses = list[float]()
        self._returns = [0.0] * config.num_envs
        self._observations: list[GenerationObservation] = []
        self._masks: list[NDArray[np.bool_]] = []
        for k, environment in enumerate(self._environments):
            env_seed = int(item_rng(seed, 1, k).integers(2**31))
            observation, info = environment.reset(seed=env_seed)
            self._observations.append(observation)
            self._masks.append(info["action_mask"].astype(bool))
        self._buffer = ReplayBuffer(
            config.buffer_size, config.num_envs, self._observations[0], num_rules
        )

    def warm_start(self, network: RuleQNetwork) -> None:
        """Copy the weights of another network.

        Raises:
            InputError: The other network has another width.
        """
        if network.q_head.in_features != self.network.q_head.in_features:
            raise InputError(
                f"learning.width: {self.config.width}; expected that of the warm start"
            )
        self.network.load_state_dict(network.state_dict())
        self._target.load_state_dict(network.state_dict())

    @property
    def learning_rate(self) -> float:
        """Learning rate at the current step."""
        num_halvings = self.step // self.config.lr_halving_steps
        return float(self.config.learning_rate * 0.5**num_halvings)

    def train_iteration(self) -> list[SampledEpisode]:
        """Step every environment once, make the updates that are due, return ended episodes."""
        ended = []
        masks = np.array(self._masks)
        values = np.zeros(masks.shape, np.float32)
        if self.step >= self.config.learning_starts:
            with torch.no_grad():
                values = self.network(collate(self._observations)).cpu().numpy()
        actions = sample_softmax_actions(values, masks, self.config.temperature, self._rng)
        step = collate(self._observations)
        step["action_mask"] = masks
        step["action"] = actions
        step["behavior_prob"] = action_probabilities(
            values, masks, actions, self.config.temperature
        )
        rewards = np.zeros(len(actions), np.float32)
        terminations = np.zeros(len(actions), bool)
        for k, environment in enumerate(self._environments):
            observation, reward, terminated, _, info = environment.step(int(actions[k]))
            rewards[k] = reward
            terminations[k] = terminated
            self._returns[k] += float(reward)
            if terminated:
                ended.append(SampledEpisode(self._returns[k], info))
                self._returns[k] = 0.0
                observation, info = environment.reset()
            self._observations[k] = observation
            self._masks[k] = info["action_mask"].astype(bool)
        self._buffer.add(**step, reward=rewards, terminated=terminations)
        updates_before = self._num_updates_due()
        self.step += len(self._environments)
        losses = [self._update() for _ in range(self._num_updates_due() - updates_before)]
        self.losses += [loss for loss in losses if loss is not None]
        return ended

    def _num_updates_due(self) -> int:
        """Return the total number of updates that are due after the steps so far."""
        return max(0, self.step - self.config.learning_starts) // self.config.train_frequency

    def _update(self) -> float | None:
        """Update once; return the loss, or None if the replay buffer has too few steps."""
        config = self.config
        count = max(NUM_GRADIENT_SHARDS, config.batch_size // config.sequence_length)
        batch = self._buffer.sample_sequences(count, config.sequence_length, self._rng)
        if batch is None:
            return None
        bounds = [count * shard // NUM_GRADIENT_SHARDS for shard in range(NUM_GRADIENT_SHARDS + 1)]
        shards = [{name: array[a:b] for name, array in batch.items()} for a, b in pairwise(bounds)]
        losses, gradients = zip(*self._workers.map(self._shard_loss, shards), strict=True)
        num_targets = count * config.sequence_length
        for parameter, *shares in zip(self.network.parameters(), *gradients, strict=True):
            parameter.grad = sum(shares[1:], shares[0]) / num_targets
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self._optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                [*self._target.parameters()], [*self.network.parameters()], config.tau
            )
        return float(sum(losses)) / num_targets

    def _shard_loss(self, shard: dict[str, NDArray[Any]]) -> tuple[float, tuple[Tensor, ...]]:
        """Return the Huber loss summed over some sequences, and its gradients."""
        names = ("action_mask", "action", "behavior_prob", "reward", "terminated")
        action_mask, action, behavior_prob, reward, terminated = (
            torch.from_numpy(shard[name]).to(self.device) for name in names
        )
        with torch.no_grad():
            inputs = {
                name: shard[name].reshape(-1, *shard[name].shape[2:]) for name in NETWORK_INPUT_KEYS
            }
            targets = retrace_targets(
                self._target(inputs).view(action_mask.shape),
                action_mask,
                action,
                behavior_prob,
                reward,
                terminated,
                self.config.temperature,
                self.config.retrace_lambda,
            ).flatten()
        first_inputs = {
            name: shard[name][:, :-1].reshape(-1, *shard[name].shape[2:])
            for name in NETWORK_INPUT_KEYS
        }
        values = self.network(first_inputs)
        action_values = values.gather(1, action[:, :-1].reshape(-1, 1)).squeeze(1)
        loss = torch.nn.functional.smooth_l1_loss(action_values, targets, reduction="sum")
        return loss.item(), torch.autograd.grad(loss, [*self.network.parameters()])

    def save(self, path: Path) -> None:
        """Write the complete state of the run; see `Learner`."""
        tensors = {f"target.{name}": value for name, value in self._target.state_dict().items()}
        tensors |= {
            f"replay.{name}": torch.from_numpy(array[: self._buffer.num_added])
            for name, array in self._buffer.arrays.items()
        }
        state = {
            "step": self.step,
            "num_added": self._buffer.num_added,
            "rng": self._rng.bit_generator.state,
            "losses": self.losses,
            "environments": [
                {
                    "rules": environment.partial.rules,
                    "episodic_return": episodic_return,
                    "rng": environment.np_random.bit_generator.state,
                }
                for environment, episodic_return in zip(
                    self._environments, self._returns, strict=True
                )
            ],
        }
        save_learner(path, self.network, self._optimizer, state, tensors)

    def load(self, path: Path) -> None:
        """Restore the state of a run of the same config and seed; see `Learner`."""
        tensors, saved_state = load_learner(path, self.network, self._optimizer)
        state = with_current_keys(saved_state, RENAMED_STATE)
        arrays = with_current_keys(tensors_with_prefix(tensors, "replay"), RENAMED_ARRAYS)
        self._target.load_state_dict(tensors_with_prefix(tensors, "target"))
        for name, value in arrays.items():
            self._buffer.arrays[name][: len(value)] = value.numpy()
        self._buffer.num_added = state["num_added"]
        self.step = state["step"]
        self._rng.bit_generator.state = state["rng"]
        self.losses = list(state.get("losses", []))  # States of version 0.1 have none.
        for k, environment in enumerate(self._environments):
            env_state = with_current_keys(state["environments"][k], RENAMED_STATE)
            observation, info = environment.reset()
            for rule in env_state["rules"]:
                observation, _, _, _, info = environment.step(
                    environment.grammar.rule_indices[rule]
                )
            environment.np_random.bit_generator.state = env_state["rng"]
            self._returns[k] = env_state["episodic_return"]
            self._observations[k] = observation
            self._masks[k] = info["action_mask"].astype(bool)
