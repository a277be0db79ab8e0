"""Soft Q-learning of a scene generator (SPEC section 3): the policy is the softmax of Q / temperature over the feasible rules.

Its entropy is taken relative to the uniform choice among the feasible rules. Without discount, and with a deterministic
grammar, the optimal soft policy then draws every derivation as the random generator RG does, times exp(return / temperature):
a distribution of scenes, the better the likelier, and no state is worth more because more rules are feasible there.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from drake_clutter.agents.graph_network import RuleValues
from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import (
    learner_tensors,
    load_tensors,
    part_of,
    restore_learner,
    save_tensors,
)
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.generation import ClutterGeneration, GraphObservation
from drake_clutter.validation import InRange, NonNegative, config_class

PARTS = 2
"""Of an update, that are worked on side by side; always so many, so that the number of threads changes no result."""

KEPT = ("node_kind", "node_flags", "position", "edge", "edge_kind", "remaining")
"""What of an observation the network looks at; the masks follow from the kinds."""


@config_class
class SoftQConfig:
    """How a generator learns.

    Attributes:
        steps: of the environments, in all.
        environments: that are stepped side by side.
        batch: steps per update.
        segment: steps that follow each other in it; trace: by which the later ones count for the earlier, see `aims`.
        steps_per_update: steps of the environments between two updates.
        replay: steps that are remembered.
        warm_up: steps, at the beginning, by uniform choice.
        learning_rate: at the beginning; it is halved every `halve_every` steps (SPEC section 3).
        temperature: of the policy, in units of the reward.
        target_rate: by which the target network moves towards the other at every update.
        width: of the network.
    """

    steps: Annotated[int, InRange(1)] = 640_000
    environments: Annotated[int, InRange(1)] = 32
    batch: Annotated[int, InRange(1)] = 128
    segment: Annotated[int, InRange(1)] = 8
    trace: Annotated[float, InRange(0.0, 1.0)] = 0.95
    steps_per_update: Annotated[int, InRange(1)] = 4
    replay: Annotated[int, InRange(1)] = 100_000
    warm_up: Annotated[int, InRange(0)] = 4_000
    learning_rate: NonNegative = 1e-3
    halve_every: Annotated[int, InRange(1)] = 128_000
    temperature: Annotated[float, InRange(1e-06)] = 0.25
    target_rate: Annotated[float, InRange(0.0, 1.0)] = 0.005
    width: Annotated[int, InRange(1)] = 32


class Episode(NamedTuple):
    """How an episode ended: what its rewards sum up to, and the last `info`."""

    score: float
    info: dict[str, Any]


def stacked(observations: Sequence[GraphObservation]) -> dict[str, NDArray[Any]]:
    """A batch of observations, those of their arrays that the network looks at."""
    return {name: np.stack([observation[name] for observation in observations]) for name in KEPT}


def softmax_choice(
    values: NDArray[np.float32],
    mask: NDArray[np.bool_],
    temperature: float,
    rng: np.random.Generator,
) -> NDArray[np.int64]:
    """(B,) a feasible action for each row, drawn with probabilities softmax(values / temperature); values, mask: (B, actions)."""
    noise = rng.gumbel(size=values.shape)  # the largest of values with Gumbel noise is such a draw
    return np.asarray(np.where(mask, values / temperature + noise, -np.inf).argmax(axis=1))


def chances(
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


def play(
    network: RuleValues,
    make_environment: Callable[[], ClutterGeneration],
    count: int,
    temperature: float,
    seed: int,
    side_by_side: int = 64,
) -> list[Episode]:
    """Samples episodes, the same for the same seed."""
    environments = [make_environment() for _ in range(min(side_by_side, count))]
    rng, episodes = item_rng(seed, 2), list[Episode]()
    while len(episodes) < count:
        # So many at a time, and none in the place of one that ends: short episodes are not to be more frequent.
        running = {
            k: environment.reset(seed=int(rng.integers(2**31)))
            for k, environment in enumerate(environments)
        }
        scores, ended = [0.0] * len(environments), dict[int, Episode]()
        while running:
            observations = stacked([observation for observation, _ in running.values()])
            masks = np.array([info["action_mask"] for _, info in running.values()]).astype(bool)
            with torch.no_grad():
                actions = softmax_choice(
                    network(observations).cpu().numpy(), masks, temperature, rng
                )
            for k, action in zip(list(running), actions.tolist(), strict=True):
                observation, reward, over, _, info = environments[k].step(action)
                scores[k] += float(reward)
                running[k] = observation, info
                if over:
                    ended[k] = Episode(scores[k], info)
                    del running[k]
        episodes += [ended[k] for k in range(len(environments))]
    return episodes[:count]


class Replay:
    """The latest steps of some environments that are stepped side by side.

    Attributes:
        arrays: by name, (times, environments, ...), a ring over the times: the observation before the step, `mask`, what was
            feasible, `action`, the `chance` that it had, `reward`, and `over`, whether the episode ended with it.
        times: that were ever added.
    """

    def __init__(
        self, capacity: int, environments: int, observation: GraphObservation, actions: int
    ) -> None:
        """Room for that many steps, of all environments together."""

        def room(like: NDArray[Any]) -> NDArray[Any]:
            return np.zeros((capacity // environments, environments, *like.shape), like.dtype)

        self.arrays = {name: room(observation[name]) for name in KEPT}
        others = {
            "mask": np.zeros(actions, bool),
            "action": np.int64(0),
            "chance": np.float32(0),
            "reward": np.float32(0),
            "over": np.bool_(False),
        }
        self.arrays |= {name: room(np.asarray(like)) for name, like in others.items()}
        self.times = 0

    def add(self, **step: NDArray[Any]) -> None:
        """Remembers one step of every environment: arrays (environments, ...)."""
        for name, array in step.items():
            self.arrays[name][self.times % len(self.arrays[name])] = array
        self.times += 1

    def draw(
        self, segments: int, length: int, rng: np.random.Generator
    ) -> dict[str, NDArray[Any]] | None:
        """Steps of one environment after another, (segments, length + 1, ...), uniformly; None as long as there are too few."""
        capacity, environments = self.arrays["action"].shape
        held = min(self.times, capacity)
        if held <= length:
            return None
        start = self.times - held + rng.integers(held - length, size=segments)
        time = (start[:, None] + np.arange(length + 1)) % capacity
        number = rng.integers(environments, size=segments)[:, None]
        return {name: array[time, number] for name, array in self.arrays.items()}


def aims(
    values: Tensor,
    mask: Tensor,
    action: Tensor,
    chance: Tensor,
    reward: Tensor,
    over: Tensor,
    temperature: float,
    trace: float,
) -> Tensor:
    """(S, L) what Q(s, a) should be, for S segments of L steps: Retrace (Munos et al. 2016, eq. 3 and 4) with soft values.

    The errors of the later steps are added to the one-step aim, as far as the policy would take these steps today:

        aim(k) = r(k) + V(k + 1) + c(k + 1) * (aim(k + 1) - Q(k + 1, a(k + 1))), without what lies beyond an episode's end,
        c = trace * min(1, policy(a) / chance), where policy(a) = exp((Q(a) - V) / temperature) / number of feasible actions.

    Args:
        values: (S, L + 1, actions) the target network's.
        mask: (S, L + 1, actions) feasible actions.
        action, reward, over: (S, L + 1). chance: (S, L + 1), that the action had when it was taken.
        temperature: of the policy.
        trace: 0 takes one step into account, 1 all that there are.
    """
    value = soft_value(values.flatten(0, 1), mask.flatten(0, 1), temperature).view_as(reward)
    taken = values.gather(2, action[:, :, None]).squeeze(2)
    policy = ((taken - value) / temperature).exp() / mask.sum(dim=2)
    passed_on = trace * (policy / chance).clamp(max=1.0)
    length = reward.shape[1] - 1
    found: list[Tensor] = []
    later = value[:, length]
    for k in reversed(range(length)):
        found.append(reward[:, k] + torch.where(over[:, k], 0.0, later))
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
        make_environment: Callable[[], ClutterGeneration],
        config: SoftQConfig,
        seed: int,
        device: torch.device,
        threads: int = PARTS,
    ) -> None:
        """Begins a training; `make_environment()` makes a `ClutterGeneration`; `threads` work on the parts of an update.

        Raises:
            InputError: a replay too small for a segment of every environment.
        """
        least = config.environments * (config.segment + 1)
        if config.replay < least:
            raise InputError(
                f"learning.replay: {config.replay}; allowed is {least} (environments * (segment + 1)) or more"
            )
        self.config, self.seed, self.device = config, seed, device
        self._environments: list[ClutterGeneration] = [
            make_environment() for _ in range(config.environments)
        ]
        vocabulary, rules = (
            self._environments[0].vocabulary,
            len(self._environments[0].grammar.rules),
        )
        torch.manual_seed(seed)
        self.network = RuleValues(
            len(vocabulary.node_kinds), len(vocabulary.edge_kinds), rules, config.width
        ).to(device)
        self._target = deepcopy(self.network).requires_grad_(False)
        self._optimizer = torch.optim.Adam(
            self.network.parameters(), config.learning_rate, fused=True
        )
        self._workers = ThreadPoolExecutor(threads)
        self._rng = item_rng(seed, 0)
        self.step, self.losses = 0, list[float]()
        self._scores = [0.0] * config.environments
        self._observations: list[GraphObservation] = []
        self._masks: list[NDArray[np.bool_]] = []
        for number, environment in enumerate(self._environments):
            observation, info = environment.reset(
                seed=int(item_rng(seed, 1, number).integers(2**31))
            )
            self._observations.append(observation)
            self._masks.append(info["action_mask"].astype(bool))
        self._replay = Replay(config.replay, config.environments, self._observations[0], rules)

    def begin_with(self, network: RuleValues) -> None:
        """Takes over what another network has learned.

        Raises:
            InputError: it is of another width.
        """
        if network.value.in_features != self.network.value.in_features:
            raise InputError(
                f"learning.width: {self.config.width}; allowed is that of the warm start"
            )
        self.network.load_state_dict(network.state_dict())
        self._target.load_state_dict(network.state_dict())

    @property
    def learning_rate(self) -> float:
        """Of the present step."""
        return float(self.config.learning_rate * 0.5 ** (self.step // self.config.halve_every))

    def advance(self) -> list[Episode]:
        """One step of every environment, and the updates that are due; returns the episodes that ended."""
        ended = []
        masks = np.array(self._masks)
        values = np.zeros(masks.shape, np.float32)
        if self.step >= self.config.warm_up:
            with torch.no_grad():
                values = self.network(stacked(self._observations)).cpu().numpy()
        actions = softmax_choice(values, masks, self.config.temperature, self._rng)
        step = stacked(self._observations) | {"mask": masks, "action": actions}
        step["chance"] = chances(values, masks, actions, self.config.temperature)
        rewards, overs = np.zeros(len(actions), np.float32), np.zeros(len(actions), bool)
        for k, environment in enumerate(self._environments):
            observation, reward, over, _, info = environment.step(int(actions[k]))
            rewards[k], overs[k] = reward, over
            self._scores[k] += float(reward)
            if over:
                ended.append(Episode(self._scores[k], info))
                self._scores[k] = 0.0
                observation, info = environment.reset()
            self._observations[k], self._masks[k] = observation, info["action_mask"].astype(bool)
        self._replay.add(**step, reward=rewards, over=overs)
        updates_before, self.step = self._updates_due(), self.step + len(self._environments)
        self.losses = [
            loss
            for _ in range(self._updates_due() - updates_before)
            if (loss := self._update()) is not None
        ]
        return ended

    def _updates_due(self) -> int:
        return max(0, self.step - self.config.warm_up) // self.config.steps_per_update

    def _update(self) -> float | None:
        config = self.config
        segments = max(PARTS, config.batch // config.segment)
        drawn = self._replay.draw(segments, config.segment, self._rng)
        if drawn is None:
            return None
        bounds = [segments * part // PARTS for part in range(PARTS + 1)]
        parts = [{name: array[a:b] for name, array in drawn.items()} for a, b in pairwise(bounds)]
        losses, gradients = zip(*self._workers.map(self._loss, parts), strict=True)
        for parameter, *of_parts in zip(self.network.parameters(), *gradients, strict=True):
            parameter.grad = sum(of_parts[1:], of_parts[0]) / (segments * config.segment)
        for group in self._optimizer.param_groups:
            group["lr"] = self.learning_rate
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 10.0)
        self._optimizer.step()
        with torch.no_grad():
            torch._foreach_lerp_(
                [*self._target.parameters()], [*self.network.parameters()], config.target_rate
            )
        return float(sum(losses)) / (segments * config.segment)

    def _loss(self, drawn: dict[str, NDArray[Any]]) -> tuple[float, tuple[Tensor, ...]]:
        """Summed over some segments, and its gradients."""
        names = ("mask", "action", "chance", "reward", "over")
        mask, action, chance, reward, over = (
            torch.from_numpy(drawn[name]).to(self.device) for name in names
        )
        with torch.no_grad():
            values = self._target(
                {name: drawn[name].reshape(-1, *drawn[name].shape[2:]) for name in KEPT}
            ).view(mask.shape)
            aim = aims(
                values,
                mask,
                action,
                chance,
                reward,
                over,
                self.config.temperature,
                self.config.trace,
            ).flatten()
        before = {name: drawn[name][:, :-1].reshape(-1, *drawn[name].shape[2:]) for name in KEPT}
        chosen = self.network(before).gather(1, action[:, :-1].reshape(-1, 1)).squeeze(1)
        loss = torch.nn.functional.smooth_l1_loss(chosen, aim, reduction="sum")
        return loss.item(), torch.autograd.grad(loss, [*self.network.parameters()])

    def save(self, path: Path) -> None:
        """Writes all that the training needs to go on as if it had never been interrupted."""
        tensors = learner_tensors(self.network, self._optimizer)
        tensors |= {f"target.{name}": value for name, value in self._target.state_dict().items()}
        tensors |= {
            f"replay.{name}": torch.from_numpy(array[: self._replay.times])
            for name, array in self._replay.arrays.items()
        }
        state = {
            "step": self.step,
            "remembered": self._replay.times,
            "rng": self._rng.bit_generator.state,
            "environments": [
                {
                    "rules": environment.partial.rules,
                    "score": score,
                    "rng": environment.np_random.bit_generator.state,
                }
                for environment, score in zip(self._environments, self._scores, strict=True)
            ],
        }
        save_tensors(path, tensors, state)

    def load(self, path: Path) -> None:
        """Goes on where `save` was called, in a training of the same config and seed."""
        tensors, state = load_tensors(path)
        restore_learner(self.network, self._optimizer, tensors)
        self._target.load_state_dict(part_of(tensors, "target"))
        for name, value in part_of(tensors, "replay").items():
            self._replay.arrays[name][: len(value)] = value.numpy()
        self._replay.times, self.step = state["remembered"], state["step"]
        self._rng.bit_generator.state = state["rng"]
        for k, (environment, saved) in enumerate(
            zip(self._environments, state["environments"], strict=True)
        ):
            observation, info = environment.reset()
            for rule in saved["rules"]:
                observation, _, _, _, info = environment.step(environment.grammar.index[rule])
            environment.np_random.bit_generator.state = saved["rng"]
            self._scores[k], self._observations[k], self._masks[k] = (
                saved["score"],
                observation,
                info["action_mask"].astype(bool),
            )
