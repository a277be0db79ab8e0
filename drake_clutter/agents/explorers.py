"""Explorers without learning (RE, LF, LF-clear, the oracle), and where trained ones are found."""

from collections.abc import Callable, Collection, Sequence

import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.scenes.interfaces import Detection, Move, Observation
from drake_clutter.scenes.placement import has_clear_top
from drake_clutter.scenes.scene import TRAY
from drake_clutter.tasks.belief import Belief, Decision, Policy, legal_moves
from drake_clutter.tasks.episode import Backend
from drake_clutter.tasks.oracle_search import OracleSearch


def random_explorer(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Choose uniformly among the legal moves (RE)."""
    moves = legal_moves(observation)
    return Decision(moves[rng.integers(len(moves))] if moves else None)


def _least_picked_then_largest(
    candidates: Sequence[Detection],
    belief: Belief,
    size: Callable[[Detection], float],
) -> Decision:
    """Choose the largest candidate, to the tray.

    Those picked least often come first, so that a sweep ends before a repeat begins; among equals,
    the first by name.
    """
    picks = [move.pick for move in belief.history]
    order = sorted(candidates, key=lambda d: (picks.count(d.name), -size(d), d.name))
    return Decision(Move(order[0].name, TRAY) if order else None)


def largest_first(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Choose the object in view with the largest volume, whatever may lie on it (LF).

    Nearest to the paper's. See `_least_picked_then_largest`.
    """
    return _least_picked_then_largest(
        observation.detections,
        belief,
        lambda d: d.object_class.volume,
    )


def largest_clear(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Choose the object in view with the most pixels, among those with a clear top (LF-clear).

    If nothing in view has a clear top, all are candidates. See `_least_picked_then_largest`.
    """
    clear = [d for d in observation.detections if has_clear_top(observation, d)]
    return _least_picked_then_largest(
        clear or observation.detections,
        belief,
        lambda d: float(d.mask.sum()),
    )


class OracleExplorer:
    """The oracle: follows plans of `FullKnowledgeSearch`, which knows the true scene.

    It has no move where there is no plan. Objects land where a plan puts them as long as nothing
    but the moves draws from the episode's generator.
    """

    BUDGET = 2000
    """Moves that may be tried for a plan."""

    def __init__(self, backend: Backend, search: OracleSearch) -> None:
        """Begin an episode on a backend, whose true scene is looked at."""
        self._backend, self._search = backend, search
        self._plan: list[Move] = []

    def __call__(
        self,
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        """Follow the plan; search for another when a move did not go as it was meant."""
        in_view, failed = {TRAY, *(d.name for d in observation.detections)}, belief.invalid_moves
        if not self._plan or failed or not {self._plan[0].pick, self._plan[0].place} <= in_view:
            known = [o.name for o in belief.objects]
            found = self._search.solve(
                self._backend.scene,
                budget=self.BUDGET,
                known=known,
                rng=rng,
                invalid_moves=failed,
            )
            self._plan = list(found.plan)
        return Decision(self._plan.pop(0) if self._plan else None)


PolicyFactory = Callable[[Backend], Policy]
"""Makes the policy of an episode; a privileged one may look at the backend's true scene."""

BASELINE_POLICIES: dict[str, Policy] = {
    "random": random_explorer,
    "largest-first": largest_first,
    "largest-clear": largest_clear,
}
PRETRAINED_EXPLORERS = {
    "teacher": "training/checkpoints/teacher.safetensors",
    "student": "training/checkpoints/student.safetensors",
    "student-dagger": "training/checkpoints/student_dagger.safetensors",
    "student-rg": "training/checkpoints/student_rg.safetensors",
    "student-14": "training/checkpoints/student_14.safetensors",
}
"""The shipped checkpoints, by the agent's name."""


ORACLE = "full-knowledge"


def make_policy_factory(
    name: str, config: ClutterConfig, classes: Collection[str] = ()
) -> PolicyFactory:
    """What makes an explorer for each episode.

    Args:
        name: one of `BASELINES`, of `TRAINED`, `FULL_KNOWLEDGE`, or the file of a checkpoint.
        config: the world.
        classes: names of the object classes that it will meet, as far as that is known.

    Raises:
        InputError: no such explorer, a file that is no checkpoint of one, or one that has not learned one of the classes.
    """
    if name in BASELINE_POLICIES:
        return lambda _: BASELINE_POLICIES[name]
    if name == ORACLE:
        search = OracleSearch(config)
        return lambda backend: OracleExplorer(backend, search)
    if name not in PRETRAINED_EXPLORERS and not name.endswith(".safetensors"):
        allowed = ", ".join([*BASELINE_POLICIES, *PRETRAINED_EXPLORERS, ORACLE])
        raise InputError(f"--agent {name}; allowed are {allowed}, or a .safetensors file")
    path = checkpoint_path(name, PRETRAINED_EXPLORERS)
    from drake_clutter.agents.learned_explorer import (
        LearnedExplorerFactory,
    )  # takes PyTorch, which the others do without

    return LearnedExplorerFactory(path, config.exploration, classes)
