"""Episodes of exploration played side by side, for learning and for watching how it goes."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import ExplorerNetwork, collate_graphs, sample_actions
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.exploration_graph import ExplorationObservation
from drake_clutter.tasks.exploration_task import TerminationReason

PolicyFn = Callable[
    [Sequence[ClutterExploration], Sequence[ExplorationObservation]],
    tuple[NDArray[np.int64], list[Any]],
]
"""From environments and what they show: (B, 2) moves, and what is to be noted with each."""


@dataclass
class Rollout:
    """One episode, move by move.

    Attributes:
        observations, actions, rewards: of each move; policy_extras: what `Act` returned with it.
        termination: why it ended.
        num_hidden, num_found: objects hidden at the start, and those of them that were found.
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
    count: int,
    seed: Sequence[int],
    policy_fn: PolicyFn,
    num_envs: int = 32,
) -> list[Rollout]:
    """Plays episodes; the same for the same path of seeds.

    Args:
        environment: copies of it are played; they share its judge's memory.
        count: of episodes.
        seed: path under which each episode has a seed of its own.
        policy_fn: chooses the moves.
        num_envs: episodes at a time.
    """
    played = [Rollout() for _ in range(count)]
    waiting = iter(range(count))
    running: dict[int, tuple[ClutterExploration, ExplorationObservation]] = {}
    while True:
        while len(running) < num_envs and (number := next(waiting, None)) is not None:
            twin = copy(environment)
            observation, _ = twin.reset(seed=int(item_rng(*seed, number).integers(2**31)))
            running[number] = twin, observation
        if not running:
            return played
        moves, notes = policy_fn(
            [twin for twin, _ in running.values()],
            [observation for _, observation in running.values()],
        )
        for number, move, note in zip(list(running), moves, notes, strict=True):
            twin, before = running[number]
            episode = played[number]
            observation, reward, over, out_of_moves, info = twin.step(move)
            episode.observations.append(before)
            episode.actions.append(move)
            episode.rewards.append(float(reward))
            episode.policy_extras.append(note)
            running[number] = twin, observation
            if over or out_of_moves:
                episode.termination, episode.num_hidden, episode.num_found = (
                    info["end"],
                    len(twin.task.initially_hidden),
                    len(twin.task.found),
                )
                del running[number]


def make_policy_fn(network: ExplorerNetwork, rng: np.random.Generator | None) -> PolicyFn:
    """A network's moves, drawn, or without a generator the most likely; noted are log-probability and value."""

    def act(
        _: Sequence[ClutterExploration], observations: Sequence[ExplorationObservation]
    ) -> tuple[NDArray[np.int64], list[Any]]:
        moves, chance, value = sample_actions(network, collate_graphs(observations), rng)[:3]
        return moves, list(zip(chance.tolist(), value.tolist(), strict=True))

    return act


def episode_metrics(episodes: Sequence[Rollout]) -> dict[str, float]:
    """What to watch while an explorer learns."""
    won = [len(e.actions) for e in episodes if e.termination is TerminationReason.ALL_FOUND]
    return {
        "success": len(won) / len(episodes),
        "found_share": sum(e.num_found for e in episodes)
        / max(1, sum(e.num_hidden for e in episodes)),
        "collapsed": sum(e.termination is TerminationReason.COLLAPSED for e in episodes)
        / len(episodes),
        "moves_of_successes": float(np.mean(won)) if won else 0.0,
        "score": float(np.mean([sum(e.rewards) for e in episodes])),
    }
