"""Soft Q-learning of a scene generator (SPEC section 3): the policy is the softmax of Q / temperature over the feasible rules.

Its entropy is taken relative to the uniform choice among the feasible rules. Without discount, and with a deterministic
grammar, the optimal soft policy then draws every derivation as the random generator RG does, times exp(return / temperature):
a distribution of scenes, the better the likelier, and no state is worth more because more rules are feasible there.
"""

from collections.abc import Callable, Mapping, Sequence
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
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    restore_learner,
    save_tensors,
    tensors_with_prefix,
    with_current_keys,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.generation_task import ClutterGeneration, GenerationObservation
from drake_clutter.validation import InRange, NonNegative, config_class, renamed_fields

NUM_GRADIENT_SHARDS = 2
"""Of an update, that are worked on side by side; always so many, so that the number of threads changes no result."""

NETWORK_INPUT_KEYS = (
    "node_kind",
    "node_flags",
    "position",
    "edge_links",
    "edge_kind",
    "remaining_nodes",
)
"""What of an observation the network looks at; the masks follow from the kinds."""


RENAMED_ARRAYS: Mapping[str, str] = {
    "edge": "edge_links",
    "remaining": "remaining_nodes",
    "mask": "action_mask",
    "chance": "behavior_prob",
    "over": "terminated",
}
"""Current name of a replay buffer's array by its name in version 0.1."""
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
    """How a generator learns.

    Attributes:
        total_timesteps: of the environments, in all.
        num_envs: that are stepped side by side.
        batch_size: steps per update.
        sequence_length: steps that follow each other in it.
        retrace_lambda: by which the later ones count for the earlier, see `retrace_targets`.
        train_frequency: steps of the environments between two updates.
        buffer_size: steps that are remembered.
        learning_starts: steps, at the beginning, by uniform choice.
        learning_rate: at the beginning; it is halved every `lr_halving_steps` steps (SPEC section 3).
        temperature: of the policy, in units of the reward.
        tau: by which the target network moves towards the other at every update.
        width: of the network.
    """

    total_timesteps: Annotated[int, InRange(1)] = 640_000
    num_envs: Annotated[int, InRange(1)] = 32
    batch_size: Annotated[int, InRange(1)] = 128
    sequence_length: Annotated[int, InRange(1)] = 8
    retrace_lambda: Annotated[float, InRange(0.0, 1.0)] = 0.95
    train_frequency: Annotated[int, InRange(1)] = 4
    buffer_size: Annotated[int, InRange(1)] = 100_000
    learning_starts: Annotated[int, InRange(0)] = 4_000
    learning_rate: NonNegative = 1e-3
    lr_halving_steps: Annotated[int, InRange(1)] = 128_000
    temperature: Annotated[float, InRange(1e-06)] = 0.25
    tau: Annotated[float, InRange(0.0, 1.0)] = 0.005
    width: Annotated[int, InRange(1)] = 32


class SampledEpisode(NamedTuple):
    """How an episode ended: what its rewards sum up to, and the last `info`."""

    episodic_return: float
    info: dict[str, Any]


def collate(observations: Sequence[GenerationObservation]) -> dict[str, NDArray[Any]]:
    """A batch of observations, those of their arrays that the network looks at."""
    return {
        name: np.stack([observation[name] for observation in observations])
        for name in NETWORK_INPUT_KEYS
    }


def sample_softmax_actions(
    values: NDArray[np.float32],
    mask: NDArray[np.bool_],
    temperature: float,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """(B,) a feasible action for each row, drawn with probabilities softmax(values / temperature); values, mask: (B, actions)."""
    noise = rng.gumbel(size=values.shape)  # the largest of values with Gumbel noise is such a draw
    return np.asarray(np.where(mask, values / temperature + noise, -np.inf).argmax(axis=1))


def action_probabilities(
    values: NDArray[np.float32],
    mask: NDArray[np.bool_],
    actions: NDArray[np.int64],
    temperature: float,
) -> NDArray[np.float32]:
    """(B,) the probability with which `softmax_choice` takes each action."""
    exponent = np.where(mask, values / temperature, -np.inf)
    weight = np.exp(exponent - exponent.max(axis=1, keepdims=True))
    return np.asarray(weight[np.arange(len(actions)), actions] / weight.sum(axis=1), np.float32)


def soft_value(values: Tensor, mask: Tensor, temperature: float) -> Tensor:
    """(B,) V = temperature * log mean exp(Q / temperature) over the feasible actions; 0 where there are none."""
    exponent = (values / temperature).masked_fill(~mask, -torch.inf)
    return torch.where(
        mask.any(dim=1), temperature * (exponent.logsumexp(dim=1) - mask.sum(dim=1).log()), 0.0
    )


def sample_episodes(
    network: RuleQNetwork,
    make_env: Callable[[], ClutterGeneration],
    count: int,
    temperature: float,
    seed: int,
    num_envs: int = 64,
) -> list[SampledEpisode]:
    """Samples episodes, the same for the same seed."""
    environments = [make_env() for _ in range(min(num_envs, count))]
    rng, episodes = item_rng(seed, 2), list[SampledEpisode]()
    while len(episodes) < count:
        # So many at a time, and none in the place of one that ends: short episodes are not to be more frequent.
        running = {
            k: environment.reset(seed=int(rng.integers(2**31)))
            for k, environment in enumerate(environments)
        }
        scores, ended = [0.0] * len(environments), dict[int, SampledEpisode]()
        while running:
            observations = collate([observation for observation, _ in running.values()])
            masks = np.array([info["action_mask"] for _, info in running.values()]).astype(bool)
            with torch.no_grad():
                actions = sample_softmax_actions(
                    network(observations).cpu().numpy(), masks, temperature, rng
                )
            for k, action in zip(list(running), actions.tolist(), strict=True):
                observation, reward, over, _, info = environments[k].step(action)
                scores[k] += float(reward)
                running[k] = observation, info
                if over:
                    ended[k] = SampledEpisode(scores[k], info)
                    del running[k]
        episodes += [ended[k] for k in range(len(environments))]
    return episodes[:count]


class ReplayBuffer:
    """The latest steps of some environments that are stepped side by side.

    Attributes:
        arrays: by name, (times, environments, ...), a ring over the times: the observation before the step, `mask`, what was
            feasible, `action`, the `chance` that it had, `reward`, and `over`, whether the episode ended with it.
        num_added: that were ever added.
    """

    def __init__(
        self, capacity: int, environments: int, observation: GenerationObservation, actions: int
    ) -> None:
        """Room for that many steps, of all environments together."""

        def room(like: NDArray[Any]) -> NDArray[Any]:
            return np.zeros((capacity // environments, environments, *like.shape), like.dtype)

        self.arrays = {name: room(observation[name]) for name in NETWORK_INPUT_KEYS}
        others = {
            "action_mask": np.zeros(actions, bool),
            "action": np.int64(0),
            "behavior_prob": np.float32(0),
            "reward": np.float32(0),
            "terminated": np.bool_(False),
        }
        self.arrays |= {name: room(np.asarray(like)) for name, like in others.items()}
        self.num_added = 0

    def add(self, **step: NDArray[Any]) -> None:
        """Remembers one step of every environment: arrays (environments, ...)."""
        for name, array in step.items():
            self.arrays[name][self.num_added % len(self.arrays[name])] = array
        self.num_added += 1

    def sample_sequences(
        self, segments: int, length: int, rng: np.random.Generator
    ) -> dict[str, NDArray[Any]] | None:
        """Steps of one environment after another, (segments, length + 1, ...), uniformly; None as long as there are too few."""
        capacity, environments = self.arrays["action"].shape
        held = min(self.num_added, capacity)
        if held <= length:
            return None
        start = self.num_added - held + rng.integers(held - length, size=segments)
        time = (start[:, None] + np.arange(length + 1)) % capacity
        number = rng.integers(environments, size=segments)[:, None]
        return {name: array[time, number] for name, array in self.arrays.items()}


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
    """(S, L) what Q(s, a) should be, for S segments of L steps: Retrace (Munos et al. 2016, eq. 3 and 4) with soft values.

    The errors of the later steps are added to the one-step aim, as far as the policy would take these steps today:

        aim(k) = r(k) + V(k + 1) + c(k + 1) * (aim(k + 1) - Q(k + 1, a(k + 1))), without what lies beyond an episode's end,
        c = trace * min(1, policy(a) / chance), where policy(a) = exp((Q(a) - V) / temperature) / number of feasible actions.

    Args:
        values: (S, L + 1, actions) the target network's.
        action_mask: (S, L + 1, actions) feasible actions.
        action, reward, terminated: (S, L + 1). chance: (S, L + 1), that the action had when it was taken.
        temperature: of the policy.
        retrace_lambda: 0 takes one step into account, 1 all that there are.
    """
    value = soft_value(values.flatten(0, 1), action_mask.flatten(0, 1), temperature).view_as(reward)
    taken = values.gather(2, action[:, :, None]).squeeze(2)
    policy = ((taken - value) / temperature).exp() / action_mask.sum(dim=2)
    passed_on = retrace_lambda * (policy / behavior_prob).clamp(max=1.0)
    length = reward.shape[1] - 1
    found: list[Tensor] = []
    later = value[:, length]
    for k in reversed(range(length)):
        found.append(reward[:, k] + torch.where(terminated[:, k], 0.0, later))
        later = value[:, k] + passed_on[:, k] * (found[-1] - taken[:, k])
    return torch.stack(found[::-1], dim=1)


class SoftQLearner:
    """Environments, networks and replay of one training, step by step.

    Attributes:
        step: of the environments, so far.
        network: Q.
        losses: the latest, one per update.
    """

    def __init__(
        self,
        make_env: Callable[[], ClutterGeneration],
        config: SoftQConfig,
        seed: int,
        device: torch.device,
        num_threads: int = NUM_GRADIENT_SHARDS,
    ) -> None:
        """Begins a training; `make_environment()` makes a `ClutterGeneration`; `num_threads` work on the parts of an update.

        Raises:
            InputError: a replay too small for a segment of every environment.
        """
        least = config.num_envs * (config.sequence_length + 1)
        if config.buffer_size < least:
            raise InputError(
                f"learning.buffer_size: {config.buffer_size}; allowed is {least} "
                "(num_envs * (sequence_length + 1)) or more"
            )
        self.config, self.seed, self.device = config, seed, device
        self._environments: list[ClutterGeneration] = [make_env() for _ in range(config.num_envs)]
        vocabulary, rules = (
            self._environments[0].vocabulary,
            len(self._environments[0].grammar.rules),
        )
        torch.manual_seed(seed)
        self.network = RuleQNetwork(
            len(vocabulary.node_kinds), len(vocabulary.edge_kinds), rules, config.width
        ).to(device)
        self._target = deepcopy(self.network).requires_grad_(False)
        self._optimizer = torch.optim.Adam(
            self.network.parameters(), config.learning_rate, fused=True
        )
        self._workers = ThreadPoolExecutor(num_threads)
        self._rng = item_rng(seed, 0)
        self.step, self.losses = 0, list[float]()
        self._scores = [0.0] * config.num_envs
        self._observations: list[GenerationObservation] = []
        self._masks: list[NDArray[np.bool_]] = []
        for number, environment in enumerate(self._environments):
            observation, info = environment.reset(
                seed=int(item_rng(seed, 1, number).integers(2**31))
            )
            self._observations.append(observation)
            self._masks.append(info["action_mask"].astype(bool))
        self._replay = ReplayBuffer(
            config.buffer_size, config.num_envs, self._observations[0], rules
        )

    def warm_start(self, network: RuleQNetwork) -> None:
        """Takes over what another network has learned.

        Raises:
            InputError: it is of another width.
        """
        if network.q_head.in_features != self.network.q_head.in_features:
            raise InputError(
                f"learning.width: {self.config.width}; allowed is that of the warm start"
            )
        self.network.load_state_dict(network.state_dict())
        self._target.load_state_dict(network.state_dict())

    @property
    def learning_rate(self) -> float:
        """Of the present step."""
        return float(self.config.learning_rate * 0.5 ** (self.step // self.config.lr_halving_steps))

    def train_iteration(self) -> list[SampledEpisode]:
        """One step of every environment, and the updates that are due; returns the episodes that ended."""
        ended = []
        masks = np.array(self._masks)
        values = np.zeros(masks.shape, np.float32)
        if self.step >= self.config.learning_starts:
            with torch.no_grad():
                values = self.network(collate(self._observations)).cpu().numpy()
        actions = sample_softmax_actions(values, masks, self.config.temperature, self._rng)
        step = collate(self._observations) | {"action_mask": masks, "action": actions}
        step["behavior_prob"] = action_probabilities(
            values, masks, actions, self.config.temperature
        )
        rewards, overs = np.zeros(len(actions), np.float32), np.zeros(len(actions), bool)
        for k, environment in enumerate(self._environments):
            observation, reward, over, _, info = environment.step(int(actions[k]))
            rewards[k], overs[k] = reward, over
            self._scores[k] += float(reward)
            if over:
                ended.append(SampledEpisode(self._scores[k], info))
                self._scores[k] = 0.0
                observation, info = environment.reset()
            self._observations[k], self._masks[k] = observation, info["action_mask"].astype(bool)
        self._replay.add(**step, reward=rewards, terminated=overs)
        updates_before, self.step = self._updates_due(), self.step + len(self._environments)
        self.losses = [
            loss
            for _ in range(self._updates_due() - updates_before)
            if (loss := self._update()) is not None
        ]
        return ended

    def _updates_due(self) -> int:
        return max(0, self.step - self.config.learning_starts) // self.config.train_frequency

    def _update(self) -> float | None:
        config = self.config
        segments = max(NUM_GRADIENT_SHARDS, config.batch_size // config.sequence_length)
        drawn = self._replay.sample_sequences(segments, config.sequence_length, self._rng)
        if drawn is None:
            return None
        bounds = [segments * part // NUM_GRADIENT_SHARDS for part in range(NUM_GRADIENT_SHARDS + 1)]
        parts = [{name: array[a:b] for name, array in drawn.items()} for a, b in pairwise(bounds)]
        losses, gradients = zip(*self._workers.map(self._loss, parts), strict=True)
        for parameter, *of_parts in zip(self.network.parameters(), *gradients, strict=True):
            parameter.grad = sum(of_parts[1:], of_parts[0]) / (segments * config.sequence_length)
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self._optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                [*self._target.parameters()], [*self.network.parameters()], config.tau
            )
        return float(sum(losses)) / (segments * config.sequence_length)

    def _loss(self, drawn: dict[str, NDArray[Any]]) -> tuple[float, tuple[Tensor, ...]]:
        """Summed over some segments, and its gradients."""
        names = ("action_mask", "action", "behavior_prob", "reward", "terminated")
        mask, action, chance, reward, over = (
            torch.from_numpy(drawn[name]).to(self.device) for name in names
        )
        with torch.no_grad():
            values = self._target(
                {
                    name: drawn[name].reshape(-1, *drawn[name].shape[2:])
                    for name in NETWORK_INPUT_KEYS
                }
            ).view(mask.shape)
            aim = retrace_targets(
                values,
                mask,
                action,
                chance,
                reward,
                over,
                self.config.temperature,
                self.config.retrace_lambda,
            ).flatten()
        before = {
            name: drawn[name][:, :-1].reshape(-1, *drawn[name].shape[2:])
            for name in NETWORK_INPUT_KEYS
        }
        chosen = self.network(before).gather(1, action[:, :-1].reshape(-1, 1)).squeeze(1)
        loss = torch.nn.functional.smooth_l1_loss(chosen, aim, reduction="sum")
        return loss.item(), torch.autograd.grad(loss, [*self.network.parameters()])

    def save(self, path: Path) -> None:
        """Writes all that the training needs to go on as if it had never been interrupted."""
        tensors = learner_tensors(self.network, self._optimizer)
        tensors |= {f"target.{name}": value for name, value in self._target.state_dict().items()}
        tensors |= {
            f"replay.{name}": torch.from_numpy(array[: self._replay.num_added])
            for name, array in self._replay.arrays.items()
        }
        state = {
            "step": self.step,
            "num_added": self._replay.num_added,
            "rng": self._rng.bit_generator.state,
            "environments": [
                {
                    "rules": environment.partial.rules,
                    "episodic_return": score,
                    "rng": environment.np_random.bit_generator.state,
                }
                for environment, score in zip(self._environments, self._scores, strict=True)
            ],
        }
        save_tensors(path, tensors, state)

    def load(self, path: Path) -> None:
        """Goes on where `save` was called, in a training of the same config and seed."""
        tensors, state = load_tensors(path)
        state = with_current_keys(state, RENAMED_STATE)
        arrays = with_current_keys(tensors_with_prefix(tensors, "replay"), RENAMED_ARRAYS)
        restore_learner(self.network, self._optimizer, tensors)
        self._target.load_state_dict(tensors_with_prefix(tensors, "target"))
        for name, value in arrays.items():
            self._replay.arrays[name][: len(value)] = value.numpy()
        self._replay.num_added, self.step = state["num_added"], state["step"]
        self._rng.bit_generator.state = state["rng"]
        for k, (environment, saved) in enumerate(
            zip(self._environments, state["environments"], strict=True)
        ):
            saved = with_current_keys(saved, RENAMED_STATE)
            observation, info = environment.reset()
            for rule in saved["rules"]:
                observation, _, _, _, info = environment.step(
                    environment.grammar.rule_indices[rule]
                )
            environment.np_random.bit_generator.state = saved["rng"]
            self._scores[k], self._observations[k], self._masks[k] = (
                saved["episodic_return"],
                observation,
                info["action_mask"].astype(bool),
            )
