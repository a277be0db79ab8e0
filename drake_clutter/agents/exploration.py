"""Explorers: RE, LF and LF-clear, which need no learning (SPEC section 4), and where the trained ones are found."""

from collections.abc import Callable, Collection, Sequence
from typing import Protocol

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.shipped import checkpoint_path
from drake_clutter.scenes.interfaces import Detection, Move, Observation
from drake_clutter.scenes.placement import has_clear_top
from drake_clutter.scenes.scene import TRAY
from drake_clutter.tasks.exploration import Decision, ExplorationTask, Step, legal_moves
from drake_clutter.tasks.full_knowledge import FullKnowledgeSearch


class Explorer(Protocol):
    """Chooses moves from what the camera has shown. One instance plays one episode at a time."""

    def choose(
        self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator, failed: Collection[Move] = ()
    ) -> Decision:
        """The next move.

        Args:
            observation: what is in view now.
            tried: the episode's earlier moves.
            rng: decides what chance decides.
            failed: those of them that could not be carried out since the scene last changed.
        """


class RandomExplorer:
    """RE: uniform over the legal moves."""

    def choose(
        self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator, failed: Collection[Move] = ()
    ) -> Decision:
        """See `Explorer.choose`."""
        moves = legal_moves(observation)
        return Decision(moves[rng.integers(len(moves))] if moves else None)


def _least_picked_then_largest(
    candidates: Sequence[Detection], tried: Sequence[Move], size: Callable[[Detection], float]
) -> Decision:
    """The largest candidate to the tray. Those picked least often come first, so that a sweep ends before a repeat begins;
    among equals, the first by name."""
    picks = [move.pick for move in tried]
    order = sorted(candidates, key=lambda d: (picks.count(d.name), -size(d), d.name))
    return Decision(Move(order[0].name, TRAY) if order else None)


class LargestFirst:
    """LF: the object in view with the largest volume goes to the tray, whatever may lie on it; nearest to the paper's.

    Those picked least often come first, see `_least_picked_then_largest`.
    """

    def choose(
        self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator, failed: Collection[Move] = ()
    ) -> Decision:
        """See `Explorer.choose`."""
        return _least_picked_then_largest(observation.detections, tried, lambda d: d.object_class.volume)


class LargestClear:
    """LF-clear: the object in view with the most pixels, among those with nothing on top, goes to the tray.

    Those picked least often come first. If nothing in view has a clear top, all count as candidates.
    """

    def choose(
        self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator, failed: Collection[Move] = ()
    ) -> Decision:
        """See `Explorer.choose`."""
        clear = [d for d in observation.detections if has_clear_top(observation, d)]
        return _least_picked_then_largest(clear or observation.detections, tried, lambda d: float(d.mask.sum()))


class FullKnowledge:
    """The ceiling: carries out the plan of `FullKnowledgeSearch`, which knows everything; gives up where there is none."""

    BUDGET = 2000
    """Moves that may be tried for a plan."""

    def __init__(self, task: ExplorationTask, search: FullKnowledgeSearch) -> None:
        self._task, self._search = task, search
        self._plan: list[Move] = []

    def choose(
        self, observation: Observation, tried: Sequence[Move], rng: np.random.Generator, failed: Collection[Move] = ()
    ) -> Decision:
        """See `Explorer.choose`. A plan that did not go as it was meant is followed by another.

        Objects land where the plan puts them as long as nothing but the moves draws from `rng`.
        """
        in_view = {TRAY, *(d.name for d in observation.detections)}
        if not self._plan or failed or not {self._plan[0].pick, self._plan[0].place} <= in_view:
            found = self._search.solve(
                self._task.scene, budget=self.BUDGET, known=self._task.known, rng=rng, failed=self._task.failed
            )
            self._plan = list(found.plan)
        return Decision(self._plan.pop(0) if self._plan else None)


ExplorerMaker = Callable[[ExplorationTask], Explorer]
"""Makes the agent of an episode; a privileged one may look at all of the task."""

BASELINES: dict[str, Callable[[], Explorer]] = {
    "random": RandomExplorer,
    "largest-first": LargestFirst,
    "largest-clear": LargestClear,
}
TRAINED = {
    "teacher": "training/checkpoints/teacher.safetensors",
    "student": "training/checkpoints/student.safetensors",
    "student-dagger": "training/checkpoints/student_dagger.safetensors",
    "student-rg": "training/checkpoints/student_rg.safetensors",
    "student-14": "training/checkpoints/student_14.safetensors",
}
"""The shipped checkpoints, by the agent's name."""


FULL_KNOWLEDGE = "full-knowledge"


def make_explorers(name: str, config: ClutterConfig, classes: Collection[str] = ()) -> ExplorerMaker:
    """What makes an explorer for each episode.

    Args:
        name: one of `BASELINES`, of `TRAINED`, `FULL_KNOWLEDGE`, or the file of a checkpoint.
        config: the world.
        classes: names of the object classes that it will meet, as far as that is known.

    Raises:
        InputError: no such explorer, a file that is no checkpoint of one, or one that has not learned one of the classes.
    """
    if name in BASELINES:
        return lambda _: BASELINES[name]()
    if name == FULL_KNOWLEDGE:
        search = FullKnowledgeSearch(config)
        return lambda task: FullKnowledge(task, search)
    if name not in TRAINED and not name.endswith(".safetensors"):
        allowed = ", ".join([*BASELINES, *TRAINED, FULL_KNOWLEDGE])
        raise InputError(f"--agent {name}; allowed are {allowed}, or a .safetensors file")
    path = checkpoint_path(name, TRAINED)
    from drake_clutter.agents.learned_explorer import LearnedExplorers  # takes PyTorch, which the others do without

    return LearnedExplorers(path, config.exploration, classes)


def play(
    task: ExplorationTask, agent: Explorer, rng: np.random.Generator, report: Callable[[Step], None] = lambda _: None
) -> None:
    """Lets an agent play a task to its end, or until it has no move left; `report` is called after each move."""
    while task.end is None:
        decision = agent.choose(task.look.observation, [step.move for step in task.steps], rng, task.failed)
        if decision.move is None:
            return
        report(task.step(decision.move, rng, decision))
