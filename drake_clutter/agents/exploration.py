"""Explorers that need no learning: RE, LF and LF-clear (SPEC section 4)."""

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from drake_clutter.scenes.placement import has_clear_top
from drake_clutter.scenes.scene import TRAY
from drake_clutter.scenes.seams import Detection, Move, Observation
from drake_clutter.tasks.exploration import ExplorationTask, Step, legal_moves


class ExplorationAgent(Protocol):
    """Chooses moves from what the camera has shown. One instance plays one episode at a time."""

    def choose(self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator) -> Move | None:
        """The next move, or None if there is none.

        Args:
            observation: what is in view now.
            tried: the episode's earlier moves.
            rng: decides what chance decides.
        """


class RandomExplorer:
    """RE: uniform over the legal moves."""

    def choose(self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator) -> Move | None:
        """See `ExplorationAgent.choose`."""
        moves = legal_moves(observation)
        return moves[rng.integers(len(moves))] if moves else None


def _least_picked_then_largest(
    candidates: Sequence[Detection], tried: Sequence[Move], size: Callable[[Detection], float]
) -> Move | None:
    """The largest candidate to the tray. Those picked least often come first, so that a sweep ends before a repeat begins;
    among equals, the first by name."""
    picks = [move.pick for move in tried]
    order = sorted(candidates, key=lambda d: (picks.count(d.name), -size(d), d.name))
    return Move(order[0].name, TRAY) if order else None


class LargestFirst:
    """LF: the object in view with the largest volume goes to the tray, whatever may lie on it; nearest to the paper's.

    Those picked least often come first, see `_least_picked_then_largest`.
    """

    def choose(self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator) -> Move | None:
        """See `ExplorationAgent.choose`."""
        return _least_picked_then_largest(observation.detections, tried, lambda d: d.object_class.volume)


class LargestClear:
    """LF-clear: the object in view with the most pixels, among those with nothing on top, goes to the tray.

    Those picked least often come first. If nothing in view has a clear top, all count as candidates.
    """

    def choose(self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator) -> Move | None:
        """See `ExplorationAgent.choose`."""
        clear = [d for d in observation.detections if has_clear_top(observation, d)]
        return _least_picked_then_largest(clear or observation.detections, tried, lambda d: float(d.mask.sum()))


EXPLORATION_AGENTS: dict[str, Callable[[], ExplorationAgent]] = {
    "random": RandomExplorer,
    "largest-first": LargestFirst,
    "largest-clear": LargestClear,
}


def play(
    task: ExplorationTask, agent: ExplorationAgent, rng: np.random.Generator, report: Callable[[Step], None] = lambda _: None
) -> None:
    """Lets an agent play a task to its end, or until it has no move left; `report` is called after each move."""
    while task.end is None:
        move = agent.choose(task.look.observation, [step.move for step in task.steps], rng)
        if move is None:
            return
        report(task.step(move, rng))
