"""Exploration policies without learning, and the lookup of policies by name.

The baselines of Kumar et al. 2022 are random exploration (RE) and largest first (LF).
"""

from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import Protocol

import numpy as np

from drake_clutter.agents.area_reduction import AreaReductionExplorer
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_path
from drake_clutter.scenes.interfaces import Detection, Move, Observation
from drake_clutter.scenes.placement import has_clear_top
from drake_clutter.scenes.scene import TRAY
from drake_clutter.tasks.belief import Belief, Decision, Policy, legal_moves
from drake_clutter.tasks.episode import Backend
from drake_clutter.tasks.oracle_search import OracleSearch
from drake_clutter.tasks.search_target import SearchTarget, no_target_error


def random_explorer(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Choose uniformly among the legal moves (RE)."""
    moves = legal_moves(observation)
    return Decision(moves[rng.integers(len(moves))] if moves else None)


def _largest_of_least_picked(
    candidates: Sequence[Detection],
    belief: Belief,
    size: Callable[[Detection], float],
) -> Decision:
    """Move the largest of the least often picked candidates to the tray.

    Every candidate is thus picked once before any is picked again. Ties are broken by name.

    Args:
        candidates: Objects that may be picked.
        belief: Its history counts the picks.
        size: Size of a candidate.
    """
    picks = [move.pick for move in belief.history]
    order = sorted(candidates, key=lambda d: (picks.count(d.name), -size(d), d.name))
    return Decision(Move(order[0].name, TRAY) if order else None)


def largest_first(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Pick the object in view with the largest volume, whatever lies on it (LF).

    See `_largest_of_least_picked` for the order of repeated picks.
    """
    return _largest_of_least_picked(
        observation.detections,
        belief,
        lambda d: d.object_class.volume,
    )


def largest_clear(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Pick the object with the most pixels among those with a clear top (LF-clear).

    If no object in view has a clear top, all are candidates. See `_largest_of_least_picked` for the
    order of repeated picks.
    """
    clear = [d for d in observation.detections if has_clear_top(observation, d)]
    return _largest_of_least_picked(
        clear or observation.detections,
        belief,
        lambda d: float(d.mask.sum()),
    )


class OracleExplorer:
    """Oracle policy: follows the plans of `OracleSearch`, computed from the true scene.

    It has no move if there is no plan. Objects are placed where the plan puts them as long as only
    the moves draw from the random generator of the episode.
    """

    BUDGET = 2000
    """Maximum number of moves that are evaluated in the search for a plan."""

    def __init__(
        self, backend: Backend, search: OracleSearch, target: SearchTarget | None = None
    ) -> None:
        """Create the policy of an episode.

        Args:
            backend: Backend of the episode, whose true scene the search uses.
            search: Searches for plans.
            target: Target of the search; None for all objects.
        """
        self._targets = frozenset[str]() if target is None else target.names
        self._backend = backend
        self._search = search
        self._plan: list[Move] = []

    def __call__(
        self,
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        """Return the next move of the plan; plan again after a move with another outcome."""
        in_view = {TRAY, *(d.name for d in observation.detections)}
        invalid_moves = belief.invalid_moves
        is_plan_valid = (
            bool(self._plan)
            and not invalid_moves
            and {self._plan[0].pick, self._plan[0].place} <= in_view
        )
        if not is_plan_valid:
            result = self._search.solve(
                self._backend.scene,
                budget=self.BUDGET,
                known=[o.name for o in belief.objects],
                rng=rng,
                invalid_moves=invalid_moves,
                targets=self._targets,
            )
            self._plan = list(result.plan)
        return Decision(self._plan.pop(0) if self._plan else None)


class PolicyFactory(Protocol):
    """Creates the policies of episodes, which share what the factory has loaded."""

    def __call__(self, backend: Backend, *, target: SearchTarget | None = None) -> Policy:
        """Return the policy of an episode.

        Args:
            backend: Backend of the episode, whose true scene a privileged policy observes.
            target: Target of the search; None for all objects.
        """


BASELINE_POLICIES: dict[str, Policy] = {
    "random": random_explorer,
    "largest-first": largest_first,
    "largest-clear": largest_clear,
}
"""Policies without learning and without privileged knowledge, by the name of the agent."""
PRETRAINED_EXPLORERS = {
    "teacher": "training/checkpoints/teacher.safetensors",
    "student": "training/checkpoints/student.safetensors",
    "student-dagger": "training/checkpoints/student_dagger.safetensors",
    "student-rg": "training/checkpoints/student_rg.safetensors",
    "student-14": "training/checkpoints/student_14.safetensors",
}
"""Checkpoints that ship with the package, by the name of the agent."""
ORACLE = "full-knowledge"
"""Name of the agent that is an `OracleExplorer`."""
AREA_REDUCTION = "area-reduction"
"""Name of the agent that is an `AreaReductionExplorer`."""


def _make_area_policy(
    config: ExplorationConfig, backend: Backend, *, target: SearchTarget | None = None
) -> Policy:
    """Return the area policy of an episode; see `PolicyFactory`."""
    if target is None:
        raise no_target_error(AREA_REDUCTION)
    return AreaReductionExplorer(target.object_class, config)


def make_policy_factory(
    name: str,
    config: ClutterConfig,
    classes: Collection[str] = (),
    *,
    with_target: bool = False,
) -> PolicyFactory:
    """Return a factory of the policies of an agent.

    Args:
        name: One of `BASELINE_POLICIES`, one of `PRETRAINED_EXPLORERS`, `AREA_REDUCTION`, `ORACLE`,
            or the file of a checkpoint.
        config: Configuration of the simulated world.
        classes: Names of the object classes that will occur, as far as they are known.
        with_target: Whether the episodes look for a target, which the factory is given for each.

    Raises:
        InputError: The agent is unknown, the file is not a checkpoint of an exploration policy,
            the policy was not trained with one of the classes, or it needs a target.
    """
    if name in BASELINE_POLICIES:
        return lambda backend, *, target=None: BASELINE_POLICIES[name]
    if name == ORACLE:
        search = OracleSearch(config)
        return lambda backend, *, target=None: OracleExplorer(backend, search, target)
    if name == AREA_REDUCTION:
        if not with_target:
            raise no_target_error(name)
        return partial(_make_area_policy, config.exploration)
    if name not in PRETRAINED_EXPLORERS and not name.endswith(".safetensors"):
        allowed = ", ".join([*BASELINE_POLICIES, *PRETRAINED_EXPLORERS, AREA_REDUCTION, ORACLE])
        raise InputError(f"--agent {name}; expected {allowed}, or a .safetensors file")
    path = checkpoint_path(name, PRETRAINED_EXPLORERS)
    # Imported late: needs PyTorch, which is not required for the other agents.
    from drake_clutter.agents.learned_explorer import LearnedExplorerFactory

    return LearnedExplorerFactory(path, config.exploration, classes, with_target=with_target)
