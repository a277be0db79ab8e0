"""Oracle search: the shortest sequence of moves that reveals the objects of a known scene.

The search has access to the true scene, but only to the moves of an explorer: it picks objects in
view. Its plans bound what exploration policies can achieve, and it decides whether a scene that
hides objects is solvable.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

import networkx as nx
import numpy as np

from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import InconclusiveVerdict, Move, MoveResult, Observation
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.seeding import item_rng
from drake_clutter.stability.static_executor import StaticExecutor
from drake_clutter.stability.static_judge import StaticStabilityJudge

MAX_OBJECTS = 64
"""Maximum number of objects of a scene; `RayCaster.occluder_sets` stores sets as 64 bits."""
MAX_PLAN_LENGTH = 30
"""Maximum number of moves of a plan."""


class Solvability(Enum):
    """Whether a scene's hidden objects can be revealed."""

    SOLVABLE = "solvable"
    UNSOLVABLE = "proved unsolvable"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class SearchResult:
    """Result of an oracle search, according to the static stability judge.

    Attributes:
        solvability: Whether a plan exists, if the budget suffices to decide it.
        plan: Moves that reveal every object, or the target, without a collapse; empty unless
            solvable.
        lower_bound: Number of moves below which no plan exists.
        unrevealable: Names of objects that no sequence of moves can reveal, if they prove that the
            scene is unsolvable.
        moves_evaluated: Number of moves that the search evaluated.
    """

    solvability: Solvability
    plan: tuple[Move, ...]
    lower_bound: int
    unrevealable: tuple[str, ...]
    moves_evaluated: int

    @property
    def is_optimal(self) -> bool:
        """Whether the plan is proved to be a shortest one."""
        return self.solvability is Solvability.SOLVABLE and len(self.plan) == self.lower_bound


@dataclass(frozen=True)
class _State:
    """A node of the search.

    Attributes:
        scene: The scene.
        observation: Observation of the scene.
        known: Names of the objects that have been in view.
        rng_state: State of the random generator that chooses among equally good placements. With
            it, a plan has the same placements when it is executed.
        lower_bound: Number of moves that are needed at least to reveal the remaining objects.
        blockers: Names of the objects that may have to be moved to reveal the remaining objects.
    """

    scene: Scene
    observation: Observation
    known: frozenset[str]
    rng_state: Mapping[str, Any]
    lower_bound: int
    blockers: frozenset[str]

    @property
    def key(self) -> tuple[frozenset[str], tuple[tuple[float, ...], ...]]:
        """Key that is equal for states whose positions differ by less than 1 mm."""
        return self.known, tuple(
            tuple(round(v, 3) for v in o.X_TO.translation) for o in self.scene.objects
        )


class _OutOfBudgetError(Exception):
    """The maximum number of evaluated moves was reached."""


class OracleSearch:
    """Searches for a shortest plan by iterative-deepening A* (Korf 1985).

    First a plan is searched that only moves objects in the way of hidden ones. Then shorter plans
    are searched exhaustively, from the lower bound on.

    The lower bound: a ray from the camera reaches a hidden object only after all objects in front
    of it, and all objects that rest on those, have been moved. Revealing an object thus needs the
    number of moves that frees enough of its rays. The bounds of hidden objects that have no
    blocking object in common are added. Of a target of several objects, one must be revealed, and
    the bound is the smallest of theirs.
    """

    def __init__(self, config: ClutterConfig, judge: StaticStabilityJudge | None = None) -> None:
        """Create a search.

        Args:
            config: Configuration of the simulated world.
            judge: A judge whose cache of verdicts is shared; None creates one.
        """
        self._judge = judge or StaticStabilityJudge(config)
        self._ray_caster = self._judge.ray_caster
        self._executor = StaticExecutor(config, self._judge)
        self._config = config.exploration
        self._visibility_threshold = config.cell.camera.visibility_threshold
        self._targets: frozenset[str] = frozenset()

    def solve(
        self,
        scene: Scene,
        seed: int = 0,
        budget: int = 5000,
        *,
        optimal: bool = True,
        known: Collection[str] = (),
        rng: np.random.Generator | None = None,
        invalid_moves: Collection[Move] = (),
        on_evaluation: Callable[[], None] = lambda: None,
        targets: Collection[str] = (),
    ) -> SearchResult:
        """Search for a plan.

        Args:
            scene: The scene, at rest.
            seed: Seed of the choice among equally good placements. An episode with the same seed
                has the placements of the plan.
            budget: Maximum number of moves that are evaluated.
            optimal: Whether to continue the search for a shorter plan after one was found.
            known: Names of the objects that have been in view before.
            rng: Random generator that will choose the placements, used instead of the seed. Its
                state is not changed.
            invalid_moves: Moves that failed in this scene, with which no plan may start.
            on_evaluation: Called before each move that is evaluated.
            targets: Names of the objects of which one is to be revealed; empty for all objects.

        Raises:
            InputError: The scene has more than `MAX_OBJECTS` objects.
        """
        if len(scene.objects) > MAX_OBJECTS:
            raise InputError(
                f"objects: {len(scene.objects)}; expected at most {MAX_OBJECTS}, "
                "for an oracle search"
            )
        self._invalid_first_moves = invalid_moves
        self._on_evaluation = on_evaluation
        self._remaining_budget = budget
        self._has_inconclusive_verdict = False
        rng_state = (rng or item_rng(seed)).bit_generator.state
        self._targets = frozenset(targets)
        start = self._make_state(scene, frozenset(known), rng_state)
        immovable = self._judge.immovable_objects(scene)
        fixed = immovable if isinstance(immovable, frozenset) else ()
        unrevealable = self.find_unrevealable(scene, start.known, fixed)
        if targets and unrevealable:
            unrevealable = tuple(name for name in unrevealable if name in targets)
            if len(unrevealable) < len(self._targets):
                self._targets -= {*unrevealable}
                unrevealable = ()
                start = self._make_state(scene, frozenset(known), rng_state)
        lower_bound = start.lower_bound
        if unrevealable:
            return SearchResult(Solvability.UNSOLVABLE, (), lower_bound, unrevealable, 0)

        def result(solvability: Solvability, plan: list[Move]) -> SearchResult:
            moves_evaluated = budget - self._remaining_budget
            return SearchResult(solvability, tuple(plan), lower_bound, (), moves_evaluated)

        plan: list[Move] | None = None
        is_exhausted = False
        try:
            self._remaining_budget = budget // 2
            plan = self._depth_limited_search(start, MAX_PLAN_LENGTH, only_blockers=True)
        except _OutOfBudgetError:
            pass
        self._remaining_budget += budget - budget // 2
        if plan is not None and not optimal:
            return result(Solvability.SOLVABLE, plan)
        try:
            while not is_exhausted and lower_bound < (
                len(plan) if plan is not None else MAX_PLAN_LENGTH + 1
            ):
                self._has_inconclusive_verdict = False
                shorter = self._depth_limited_search(start, lower_bound, only_blockers=False)
                if shorter is not None:
                    plan = shorter
                    break
                if self._has_inconclusive_verdict:
                    break  # A move with an inconclusive verdict might begin a shorter plan.
                is_exhausted = not self._limit_reached and plan is None
                lower_bound += not is_exhausted
        except _OutOfBudgetError:
            pass
        if plan is not None:
            return result(Solvability.SOLVABLE, plan)
        return result(Solvability.UNSOLVABLE if is_exhausted else Solvability.UNDECIDED, [])

    def _make_state(
        self, scene: Scene, known: frozenset[str], rng_state: Mapping[str, Any]
    ) -> _State:
        """Return the node of a scene, with its lower bound."""
        observation, _ = self._ray_caster.observe(scene)
        known |= {detection.name for detection in observation.detections}
        hidden = [name for name in scene.names if name not in known]
        if self._targets:
            is_found = not self._targets.isdisjoint(known)
            hidden = [] if is_found else [name for name in hidden if name in self._targets]
        lower_bound = 0
        # Bipartite graph of hidden objects and objects that may have to be moved for them. Nodes
        # have roles, as a hidden object may itself block another one.
        blocking = nx.Graph()
        if hidden:
            move_sets = self._moved_with(scene)
            num_moves = {}
            for name in hidden:
                num_moves[name], blockers = self._moves_to_reveal(scene, name, move_sets)
                blocking.add_edges_from((("hidden", name), ("moved", other)) for other in blockers)
            if self._targets:
                lower_bound = min(num_moves.values())
            else:
                for component in nx.connected_components(blocking):
                    lower_bound += max(
                        num_moves[name] for role, name in component if role == "hidden"
                    )
        return _State(
            scene,
            observation,
            known,
            rng_state,
            lower_bound,
            frozenset(name for role, name in blocking if role == "moved"),
        )

    def _moved_with(self, scene: Scene) -> dict[str, frozenset[str]]:
        """Return, for each object, the objects that must be moved before it is out of the way.

        These are the object itself and all objects that have no other support.
        """
        supports = self._judge.find_supports(scene)
        if isinstance(supports, InconclusiveVerdict):
            return {name: frozenset({name}) for name in scene.names}
        move_sets = {}
        for name in scene.names:
            moved = {name}
            while more := {other for other, below in supports.items() if below <= moved} - moved:
                moved |= more
            move_sets[name] = frozenset(moved)
        return move_sets

    def _moves_to_reveal(
        self, scene: Scene, name: str, move_sets: Mapping[str, frozenset[str]]
    ) -> tuple[int, frozenset[str]]:
        """Return a lower bound on the moves that reveal an object, and the objects in its way.

        Args:
            scene: The scene.
            name: A hidden object.
            move_sets: See `_moved_with`.
        """
        num_rays: Counter[int] = Counter()  # by the number of moves that free them
        blockers: frozenset[str] = frozenset()
        for occluders, count in self._ray_caster.occluder_sets(scene, name).items():
            moved = frozenset[str]().union(*(move_sets[other] for other in occluders))
            num_rays[len(moved)] += count
            blockers |= moved
        num_free = 0
        for moves in sorted(num_rays):
            num_free += num_rays[moves]
            if num_free >= self._visibility_threshold * num_rays.total():
                return moves, blockers
        return 0, blockers  # Outside the image, see `find_unrevealable`.

    def find_unrevealable(
        self, scene: Scene, known: Collection[str], fixed: Collection[str]
    ) -> tuple[str, ...]:
        """Return the objects outside the image or hidden behind objects that cannot be moved.

        Args:
            scene: A scene at rest.
            known: Names of the objects that have been in view.
            fixed: Names of the objects that cannot be moved.

        Returns:
            Names of the objects.
        """
        unrevealable = []
        for name in scene.names:
            if name in known:
                continue
            remaining = [o for o in scene.objects if o.name == name or o.name in fixed]
            is_in_image = bool(self._ray_caster.occluder_sets(scene, name))
            if (
                not is_in_image
                or self._ray_caster.visible_fractions(remaining)[name] < self._visibility_threshold
            ):
                unrevealable.append(name)
        return tuple(unrevealable)

    def _depth_limited_search(
        self, start: _State, limit: int, *, only_blockers: bool
    ) -> list[Move] | None:
        """Return a plan of at most `limit` moves, or None.

        Sets `_limit_reached` to whether a longer plan may exist.

        Args:
            start: State in which the plan starts.
            limit: Maximum number of moves.
            only_blockers: Whether to move only objects in the way of hidden ones.
        """
        self._limit_reached = False
        self._visited_depths: dict[Any, int] = {}
        return self._search_below(start, 0, limit, only_blockers)

    def _search_below(
        self, state: _State, depth: int, limit: int, only_blockers: bool
    ) -> list[Move] | None:
        if not state.lower_bound:
            return []
        if self._visited_depths.get(state.key, limit + 1) <= depth:
            return None
        self._visited_depths[state.key] = depth
        # Without a spare move, only moves of blockers can lead to a plan within the limit.
        is_tight = depth + state.lower_bound == limit
        self._limit_reached |= is_tight
        for moves in self._move_batches(state, only_blockers or is_tight):
            children = []
            for move in moves:
                if depth == 0 and move in self._invalid_first_moves:
                    continue
                child = self._apply(state, move)
                if child is None:
                    continue
                if depth + 1 + child.lower_bound <= limit:
                    children.append((move, child))
                else:
                    self._limit_reached = True
            for move, child in sorted(children, key=lambda pair: pair[1].lower_bound):
                plan = self._search_below(child, depth + 1, limit, only_blockers)
                if plan is not None:
                    return [move, *plan]
        return None

    def _move_batches(self, state: _State, only_blockers: bool) -> Iterator[list[Move]]:
        """Yield batches of legal moves that leave no object unsupported, most promising first."""
        in_view = [detection.name for detection in state.observation.detections]
        unsupported = {
            name: self._judge.objects_losing_support(state.scene, name) for name in in_view
        }
        self._has_inconclusive_verdict |= any(
            isinstance(names, InconclusiveVerdict) for names in unsupported.values()
        )
        movable = [name for name, names in unsupported.items() if names == ()]
        for is_blocker in (True, False):
            if is_blocker or not only_blockers:
                picks = [name for name in movable if (name in state.blockers) == is_blocker]
                yield [Move(pick, TRAY) for pick in picks]
                for pick in picks:
                    yield [Move(pick, place) for place in in_view if place != pick]

    def _apply(self, state: _State, move: Move) -> _State | None:
        """Return the state after a move; None if it collapses or cannot be carried out."""
        if self._remaining_budget <= 0:
            raise _OutOfBudgetError
        self._remaining_budget -= 1
        self._on_evaluation()
        rng = np.random.default_rng()
        rng.bit_generator.state = dict(state.rng_state)
        command = resolve_placement(move, state.observation, self._config, rng)
        if command is None:
            return None
        outcome = self._executor.execute(state.scene, command, rng)
        self._has_inconclusive_verdict |= outcome.result is MoveResult.INCONCLUSIVE
        if not outcome.result.is_at_placement:
            return None
        return self._make_state(outcome.scene, state.known, rng.bit_generator.state)
