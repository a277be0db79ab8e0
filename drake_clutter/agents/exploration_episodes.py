"""Episodes of exploration played side by side, for learning and for watching how it goes."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_clutter.agents.explorer_network import ExplorerNetwork, decide, stacked_graphs
from drake_clutter.seeding import item_rng
from drake_clutter.tasks.clutter_exploration import ClutterExploration
from drake_clutter.tasks.exploration import EpisodeEnd
from drake_clutter.tasks.exploration_graph import GraphObservation

Act = Callable[
    [Sequence[ClutterExploration], Sequence[GraphObservation]], tuple[NDArray[np.int64], list[Any]]
]
"""From environments and what they show: (B, 2) moves, and what is to be noted with each."""


@dataclass
class Played:
    """One episode, move by move.

    Attributes:
        observations, moves, rewards: of each move; notes: what `Act` returned with it.
        end: why it ended.
        hidden, found: objects hidden at the start, and those of them that were found.
    """

    observations: list[GraphObservation] = field(default_factory=list)
    moves: list[NDArray[np.int64]] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    notes: list[Any] = field(default_factory=list)
    end: EpisodeEnd = EpisodeEnd.GAVE_UP
    hidden: int = 0
    found: int = 0


def play_episodes(
    environment: ClutterExploration,
    count: int,
    seed: Sequence[int],
    act: Act,
    side_by_side: int = 32,
) -> list[Played]:
    """Plays episodes; the same for the same path of seeds.

    Args:
        environment: copies of it are played; they share its judge's memory.
        count: of episodes.
        seed: path under which each episode has a seed of its own.
        act: chooses the moves.
        side_by_side: episodes at a time.
    """
    played = [Played() for _ in range(count)]
    waiting = iter(range(count))
    running: dict[int, tuple[ClutterExploration, GraphObservation]] = {}
    while True:
        while len(running) < side_by_side and (number := next(waiting, None)) is not None:
            twin = copy(environment)
            observation, _ = twin.reset(seed=int(item_rng(*seed, number).integers(2**31)))
            running[number] = twin, observation
        if not running:
            return played
        moves, notes = act(
            [twin for twin, _ in running.values()],
            [observation for _, observation in running.values()],
        )
        for number, move, note in zip(list(running), moves, notes, strict=True):
            twin, before = running[number]
            episode = played[number]
            observation, reward, over, out_of_moves, info = twin.step(move)
            episode.observations.append(before)
            episode.moves.append(move)
            episode.rewards.append(float(reward))
            episode.notes.append(note)
            running[number] = twin, observation
            if over or out_of_moves:
                episode.end, episode.hidden, episode.found = (
                    info["end"],
                    len(twin.task.hidden_at_start),
                    len(twin.task.found),
                )
                del running[number]


def acting(network: ExplorerNetwork, rng: np.random.Generator | None) -> Act:
    """A network's moves, drawn, or without a generator the most likely; noted are log-probability and value."""

    def act(
        _: Sequence[ClutterExploration], observations: Sequence[GraphObservation]
    ) -> tuple[NDArray[np.int64], list[Any]]:
        moves, chance, value = decide(network, stacked_graphs(observations), rng)[:3]
        return moves, list(zip(chance.tolist(), value.tolist(), strict=True))

    return act


def figures(episodes: Sequence[Played]) -> dict[str, float]:
    """What to watch while an explorer learns."""
    won = [len(e.moves) for e in episodes if e.end is EpisodeEnd.ALL_FOUND]
    return {
        "success": len(won) / len(episodes),
        "found_share": sum(e.found for e in episodes) / max(1, sum(e.hidden for e in episodes)),
        "collapsed": sum(e.end is EpisodeEnd.COLLAPSED for e in episodes) / len(episodes),
        "moves_of_successes": float(np.mean(won)) if won else 0.0,
        "score": float(np.mean([sum(e.rewards) for e in episodes])),
    }
