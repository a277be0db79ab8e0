"""The full-knowledge search: how many moves someone needs who knows where everything is, but moves like an explorer.

It is the ceiling for explorers, and tells whether a scene that hides objects can be searched at all (SPEC section 6).
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
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
"""Objects in a scene, see `RayCaster.cover`."""
MAX_PLAN_LENGTH = 30
"""Moves; longer plans are not looked for."""


class Solvability(Enum):
    """What a search found."""

    SOLVABLE = "solvable"
    UNSOLVABLE = "proved unsolvable"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class SearchResult:
    """What a search found, under the fast judge.

    Attributes:
        solvability: solvable, proved unsolvable, or neither within the budget.
        plan: moves that reveal everything without a collapse; empty unless solvable.
        lower_bound: no plan has fewer moves.
        unrevealable: what no sequence of moves can reveal, if that is the proof.
        moves_evaluated: what the search cost.
    """

    solvability: Solvability
    plan: tuple[Move, ...]
    lower_bound: int
    unrevealable: tuple[str, ...]
    moves_evaluated: int

    @property
    def is_optimal(self) -> bool:
        """Whether the plan is proved to have the fewest moves."""
        return self.solvability is Solvability.SOLVABLE and len(self.plan) == self.lower_bound


@dataclass(frozen=True)
class _State:
    """A scene on the way.

    Attributes:
        scene: the objects.
        observation: what is in view.
        known: everything that has ever been in view.
        rng: state of the generator that decides between equal places, so that a plan comes out the same when carried out.
        at_least: moves that are still needed.
        blockers: what may have to be moved to find what has never been in view.
    """

    scene: Scene
    observation: Observation
    known: frozenset[str]
    rng: Mapping[str, Any]
    at_least: int
    blockers: frozenset[str]

    @property
    def key(self) -> tuple[frozenset[str], tuple[tuple[float, ...], ...]]:
        """Equal for states that differ by less than 1 mm."""
        return self.known, tuple(
            tuple(round(v, 3) for v in o.X_TO.translation) for o in self.scene.objects
        )


class _OutOfBudgetError(Exception):
    pass


class OracleSearch:
    """Searches for the fewest moves that reveal every object (iterative deepening A*, Korf 1985).

    First a plan is sought that moves only what is in the way; then shorter ones, exhaustively, from the lower bound on. The
    bound: a ray reaches a hidden object only when all that is before it, and all that stands on that, has been moved; so an
    object needs as many moves as free enough of its rays. Objects that need no move in common add up.
    """

    def __init__(self, config: ClutterConfig, judge: StaticStabilityJudge | None = None) -> None:
        """Makes a search; a judge that is shared remembers more stacks."""
        self._judge = judge or StaticStabilityJudge(config)
        self._rays = self._judge.ray_caster
        self._executor = StaticExecutor(config, self._judge)
        self._config = config.exploration
        self._hidden_below = config.cell.camera.visibility_threshold

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
    ) -> SearchResult:
        """The fewest moves for a scene at rest.

        Args:
            scene: as it settled.
            seed: of the places that are equally good; an episode of the same seed puts the objects where the plan does.
            budget: moves to try at most.
            optimal: whether to look for a shorter plan when there is one.
            known: what has been in view before.
            rng: in place of the seed: as it will be when the plan is carried out. It is left as it is.
            invalid_moves: moves that turned out impossible in this scene; no plan begins with one of them.

        Raises:
            InputError: the scene has more objects than the search takes.
        """
        if len(scene.objects) > MAX_OBJECTS:
            raise InputError(
                f"objects: {len(scene.objects)}; allowed are {MAX_OBJECTS} at most, for a full-knowledge search"
            )
        self._failed = invalid_moves
        self._left, self._doubts = budget, 0
        start = self._state(scene, frozenset(known), (rng or item_rng(seed)).bit_generator.state)
        fixed = self._judge.immovable_objects(scene)
        never = self.find_unrevealable(
            scene, start.known, fixed if isinstance(fixed, frozenset) else ()
        )
        if never:
            return SearchResult(Solvability.UNSOLVABLE, (), start.at_least, never, 0)
        plan, at_least, exhausted = None, start.at_least, False
        try:
            self._left = budget // 2
            plan = self._dive(start, MAX_PLAN_LENGTH, only_blockers=True)
        except _OutOfBudgetError:
            pass
        self._left += budget - budget // 2
        if plan is not None and not optimal:
            return SearchResult(
                Solvability.SOLVABLE, tuple(plan), at_least, (), budget - self._left
            )
        try:
            while not exhausted and at_least < (
                len(plan) if plan is not None else MAX_PLAN_LENGTH + 1
            ):
                self._doubts = 0
                shorter = self._dive(start, at_least, only_blockers=False)
                if shorter is not None:
                    plan = shorter
                    break
                if self._doubts:
                    break  # what was not tried might have been shorter
                exhausted = not self._cut and plan is None
                at_least += not exhausted
        except _OutOfBudgetError:
            pass
        if plan is not None:
            return SearchResult(
                Solvability.SOLVABLE, tuple(plan), at_least, (), budget - self._left
            )
        return SearchResult(
            Solvability.UNSOLVABLE if exhausted else Solvability.UNDECIDED,
            (),
            at_least,
            (),
            budget - self._left,
        )

    def _state(self, scene: Scene, known: frozenset[str], rng: Mapping[str, Any]) -> _State:
        observation, _ = self._rays.observe(scene)
        known |= {detection.name for detection in observation.detections}
        hidden = [name for name in scene.names if name not in known]
        at_least, moved_first = 0, nx.Graph()
        if hidden:
            carried = self._carried(scene)
            needed = {}
            for name in hidden:
                needed[name], involved = self._needed(scene, name, carried)
                # Tagged, as an object may be hidden itself and be before another.
                moved_first.add_edges_from(
                    (("hidden", name), ("moved", other)) for other in involved
                )
            for together in nx.connected_components(moved_first):
                at_least += max(needed[name] for role, name in together if role == "hidden")
        return _State(
            scene,
            observation,
            known,
            rng,
            at_least,
            frozenset(n for role, n in moved_first if role == "moved"),
        )

    def _carried(self, scene: Scene) -> dict[str, frozenset[str]]:
        """What must be moved before each object can be, itself included: everything that stands on nothing else, by name."""
        supports = self._judge.find_supports(scene)
        if isinstance(supports, InconclusiveVerdict):
            return {name: frozenset({name}) for name in scene.names}
        found = {}
        for name in scene.names:
            carried = {name}
            while (
                more := {other for other, below in supports.items() if below <= carried} - carried
            ):
                carried |= more
            found[name] = frozenset(carried)
        return found

    def _needed(
        self, scene: Scene, name: str, carried: Mapping[str, frozenset[str]]
    ) -> tuple[int, frozenset[str]]:
        """Moves without which a hidden object stays hidden, and what may have to be moved for it."""
        rays: Counter[int] = Counter()
        involved: frozenset[str] = frozenset()
        for before, count in self._rays.occluder_sets(scene, name).items():
            moved = frozenset[str]().union(*(carried[other] for other in before))
            rays[len(moved)] += count
            involved |= moved
        seen, total = 0, rays.total()
        for moves in sorted(rays):
            seen += rays[moves]
            if seen >= self._hidden_below * total:
                return moves, involved
        return 0, involved  # out of the frame, see `never_found`

    def find_unrevealable(
        self, scene: Scene, known: Collection[str], fixed: Collection[str]
    ) -> tuple[str, ...]:
        """What is out of the camera's frame, or stays hidden behind objects that can never be moved.

        Args:
            scene: at rest.
            known: names of what has been in view.
            fixed: names of what can never be moved.
        """
        found = []
        for name in scene.names:
            if name in known:
                continue
            left = [o for o in scene.objects if o.name == name or o.name in fixed]
            out_of_frame = not self._rays.occluder_sets(scene, name)
            if out_of_frame or self._rays.visible_fractions(left)[name] < self._hidden_below:
                found.append(name)
        return tuple(found)

    def _dive(self, start: _State, limit: int, *, only_blockers: bool) -> list[Move] | None:
        """Moves that reveal everything, `limit` at most, or None; `_cut` then says whether the limit is to blame."""
        self._cut = False
        self._reached: dict[Any, int] = {}
        return self._deeper(start, 0, limit, only_blockers)

    def _deeper(
        self, state: _State, depth: int, limit: int, only_blockers: bool
    ) -> list[Move] | None:
        if not state.at_least:
            return []
        if self._reached.get(state.key, limit + 1) <= depth:
            return None
        self._reached[state.key] = depth
        # With no move to spare, only those help that uncover something.
        tight = depth + state.at_least == limit
        self._cut |= tight
        for moves in self._moves(state, only_blockers or tight):
            children = []
            for move in moves:
                if depth == 0 and move in self._failed:
                    continue
                child = self._after(state, move)
                if child is not None and depth + 1 + child.at_least <= limit:
                    children.append((move, child))
                self._cut |= child is not None and depth + 1 + child.at_least > limit
            for move, child in sorted(children, key=lambda pair: pair[1].at_least):
                rest = self._deeper(child, depth + 1, limit, only_blockers)
                if rest is not None:
                    return [move, *rest]
        return None

    def _moves(self, state: _State, only_blockers: bool) -> Iterator[list[Move]]:
        """Legal moves that lose no support, in batches, the most promising first."""
        in_view = [detection.name for detection in state.observation.detections]
        losing = {name: self._judge.objects_losing_support(state.scene, name) for name in in_view}
        self._doubts += sum(isinstance(lost, InconclusiveVerdict) for lost in losing.values())
        free = [name for name, lost in losing.items() if lost == ()]
        for useful in (True, False):
            if useful or not only_blockers:
                picks = [name for name in free if (name in state.blockers) == useful]
                yield [Move(pick, TRAY) for pick in picks]
                for pick in picks:
                    yield [Move(pick, place) for place in in_view if place != pick]

    def _after(self, state: _State, move: Move) -> _State | None:
        """The state that a move leads to; None if it collapses or cannot be carried out."""
        if self._left <= 0:
            raise _OutOfBudgetError
        self._left -= 1
        rng = np.random.default_rng()
        rng.bit_generator.state = dict(state.rng)
        command = resolve_placement(move, state.observation, self._config, rng)
        if command is None:
            return None
        outcome = self._executor.execute(state.scene, command, rng)
        self._doubts += outcome.result is MoveResult.INCONCLUSIVE
        if outcome.result is not MoveResult.PLACED:
            return None
        return self._state(outcome.scene, state.known, rng.bit_generator.state)
