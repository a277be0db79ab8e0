"""Batched rollouts of exploration policies, and their metrics."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import ExplorerNetwork, collate_graphs, sample_actions
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.exploration_graph import ExplorationObservation
from drake_clutter.tasks.exploration_task import TerminationReason


class PolicyFn(Protocol):
    """A policy for a batch of environments."""

    def __call__(
        self,
        environments: Sequence[ClutterExploration],
        observations: Sequence[ExplorationObservation],
        /,
    ) -> tuple[NDArray[np.int64], list[Any]]:
        """Return the next actions.

        Args:
            environments: B environments.
            observations: Their current observations.

        Returns:
            Actions (picked node and place), shape (B, 2), and for each action an object that the
            rollout stores with it.
        """


@dataclass
class Rollout:
    """One episode.

    Attributes:
        observations: Observation before each action.
        actions: Picked node and place of each move (indices of nodes). Shape (2,) each.
        rewards: Reward of each action.
        policy_extras: Objects that the `PolicyFn` returned with the actions.
        termination: Why the episode ended.
        num_hidden: Number of objects that were hidden at the start.
        num_found: Number of those objects that were detected.
    """

    observations: list[ExplorationObservation] = field(default_factory=list)
    actions: list[NDArray[np.int64]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    policy_extras: list[Any] = field(default_factory=list)
    termination: TerminationReason = TerminationReason.GAVE_UP
    num_hidden: int = 0
    num_found: int = 0


def collect_rollouts(
    environment: ClutterExploration,
    num_episodes: int,
    seed: Sequence[int],
    policy_fn: PolicyFn,
    num_envs: int = 32,
) -> list[Rollout]:
    """Collect complete episodes; equal seeds give equal episodes.

    Args:
        environment: Template of the environments. Its copies share the cache of its judge.
        num_episodes: Number of episodes.
        seed: Integers from which, with its index, each episode is seeded; see `item_rng`.
        policy_fn: Selects the actions.
        num_envs: Maximum number of environments that are stepped together.
    """
    rollouts = [Rollout() for _ in range(num_episodes)]
    indices = iter(range(num_episodes))
    running: dict[int, tuple[ClutterExploration, ExplorationObservation]] = {}
    while True:
        while len(running) < num_envs and (index := next(indices, None)) is not None:
            env = copy(environment)
            observation, _ = env.reset(seed=int(item_rng(*seed, index).integers(2**31)))
            running[index] = env, observation
        if not running:
            return rollouts
        actions, extras = policy_fn(
            [env for env, _ in running.values()],
            [observation for _, observation in running.values()],
        )
        for index, action, extra in zip(list(running), actions, extras, strict=True):
            env, observation = running[index]
            next_observation, reward, terminated, truncated, info = env.step(action)
            rollout = rollouts[index]
            rollout.observations.append(observation)
            rollout.actions.append(action)
            rollout.rewards.append(float(reward))
            rollout.policy_extras.append(extra)
            running[index] = env, next_observation
            if terminated or truncated:
                rollout.termination = info["termination"]
                rollout.num_hidden = len(env.task.initially_hidden)
                rollout.num_found = len(env.task.found)
                del running[index]


def make_policy_fn(network: ExplorerNetwork, rng: np.random.Generator | None) -> PolicyFn:
    """Return the policy of a network; it stores (log-probability, value) with each action.

    Args:
        network: Policy and value function.
        rng: Random generator; None selects the most probable actions.
    """

    def policy_fn(
        environments: Sequence[ClutterExploration], observations: Sequence[ExplorationObservation]
    ) -> tuple[NDArray[np.int64], list[Any]]:
        sampled = sample_actions(network, collate_graphs(observations), rng)
        extras = list(zip(sampled.log_probs.tolist(), sampled.values.tolist(), strict=True))
        return sampled.actions, extras

    return policy_fn


def episode_metrics(rollouts: Sequence[Rollout]) -> dict[str, float]:
    """Return metrics of the learning progress.

    Returns:
        success: Fraction of episodes in which all hidden objects, or the target, were found.
        found_share: Fraction of all hidden objects that were found.
        collapsed: Fraction of episodes in which the scene collapsed or an object left the support.
        moves_of_successes: Mean number of moves of the successful episodes; 0 without any.
        score: Mean return.
    """
    lengths = [len(rollout.actions) for rollout in rollouts if rollout.termination.is_success]
    num_collapsed = sum(rollout.termination.is_failed_move for rollout in rollouts)
    num_hidden = sum(rollout.num_hidden for rollout in rollouts)
    num_found = sum(rollout.num_found for rollout in rollouts)
    return {
        "success": len(lengths) / len(rollouts),
        "found_share": num_found / max(1, num_hidden),
        "collapsed": num_collapsed / len(rollouts),
        "moves_of_successes": float(np.mean(lengths)) if lengths else 0.0,
        "score": float(np.mean([sum(rollout.rewards) for rollout in rollouts])),
    }
