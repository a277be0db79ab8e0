"""The exploring agent in the loop: it looks, chooses a move, waits until that is done or refused, and looks again."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, State

from drake_clutter.config import ExplorationConfig
from drake_clutter.planning.plan import NoPlan, Plan
from drake_clutter.scenes.interfaces import Move, Observation
from drake_clutter.scenes.placement import choose_placement
from drake_clutter.scenes.scene import TRAY, Pose, SceneObject
from drake_clutter.scenes.unseen import under_nameless
from drake_clutter.seeding import item_rng
from drake_clutter.station.arm_executor import nearest
from drake_clutter.systems.move_planner import Answer
from drake_clutter.systems.tracking import Tracked
from drake_clutter.tasks.exploration import Decision, legal_moves
from drake_clutter.tasks.exploration_graph import seen

STUCK_WITHIN = 0.01
"""m; an object that was to be moved and is seen so near to where it was has not been moved."""
PERIOD = 0.05
"""s, between two looks at what the others are doing."""

Track = Callable[[Sequence[SceneObject], Observation], Tracked]
"""From K_t and an image whose detections' names mean nothing, see `tracked`."""
Choose = Callable[[Sequence[SceneObject], Observation, Sequence[Move], np.random.Generator, Sequence[Move]], Decision]
"""From K_t, what is in view, the moves so far, chance, and the moves that failed since anything last changed."""


Hopeless = Callable[[Sequence[SceneObject], Observation], Sequence[Move]]
"""From K_t and what is in view, the moves that are not worth trying."""


def hopeless(
    known: Sequence[SceneObject],
    observation: Observation,
    pickable: Collection[str],
    empty: NDArray[np.float32],
    config: ExplorationConfig,
) -> list[Move]:
    """Moves of what cannot be picked, and those for which there is no free place.

    Also those of what may carry something that was not recognised, as long as others are left.

    Args:
        known: K_t; observation: what is in view.
        pickable: names of what is known to carry nothing, and can be held.
        empty: (height, width) m, see `under_nameless`.
        config: of the task.
    """
    some = np.random.default_rng(0)  # it decides where, not whether
    free = [
        move
        for move in legal_moves(observation)
        if move.pick in pickable and choose_placement(observation, move, config, some) is not None
    ]
    risky = under_nameless(known, observation, empty)
    worth_trying = {move for move in free if move.pick not in risky} or set(free)
    return [move for move in legal_moves(observation) if move not in worth_trying]


class Phase(Enum):
    """What the agent is doing."""

    LOOKING = "waits for things to come to rest, then looks"
    WAITING = "waits for a plan, or for its end"
    DONE = "has ended"


class Finish(Enum):
    """Why the agent ended by itself."""

    OUT_OF_MOVES = "out of moves"
    NOTHING_FEASIBLE = "nothing feasible"


@dataclass(frozen=True)
class Request:
    """A move to be carried out.

    Attributes:
        number: 1 for the episode's first.
        move: what to do.
        observation: what was in view when it was chosen; known: K_t then.
        decision: why.
    """

    number: int
    move: Move
    observation: Observation = field(repr=False)
    known: tuple[SceneObject, ...] = field(repr=False)
    decision: Decision = field(repr=False)

    def __deepcopy__(self, memo: object) -> "Request":
        """Itself: it never changes, and Drake copies abstract values again and again."""
        return self

    def truly(self, objects: Sequence[SceneObject]) -> tuple[Move, Decision]:
        """Move and decision in the names of what is really there, each known object being the nearest to its place."""
        name = {TRAY: TRAY} | {o.name: nearest(objects, o.X_TO).name for o in self.known}
        move = Move(name[self.move.pick], name[self.move.place])
        picks = {name[pick]: chance for pick, chance in self.decision.picks.items()}
        known = tuple(name[known] for known in self.decision.known)
        return move, replace(self.decision, move=move, picks=picks, known=known, observation=self.observation)


@dataclass(frozen=True)
class AgentState:
    """Everything that the agent remembers.

    Attributes:
        phase: what it is doing. look_at: s, when it is to look next.
        known: K_t, each object as it was last seen.
        lost: names of those of them that are not in view any more, and not where they were.
        tried: all moves; failed: those that could not be carried out since anything last changed.
        request: the latest; carried_out: how many moves were; acted: whether the latest was, and nobody has looked since.
        finish: why it ended.
    """

    phase: Phase = Phase.LOOKING
    look_at: float = 0.0
    known: tuple[SceneObject, ...] = ()
    lost: tuple[str, ...] = ()
    tried: tuple[Move, ...] = ()
    failed: tuple[Move, ...] = ()
    request: Request | None = None
    carried_out: int = 0
    acted: bool = False
    finish: Finish | None = None

    def __deepcopy__(self, memo: object) -> "AgentState":
        """Itself, as of `Request`."""
        return self

    @property
    def refused(self) -> "AgentState":
        """After a request that could not be carried out."""
        assert self.request is not None
        move = self.request.move
        return replace(self, phase=Phase.LOOKING, tried=(*self.tried, move), failed=(*self.failed, move))

    def placed(self, X_TO: Pose) -> "AgentState":
        """After a request that was carried out: until it is seen there, an object is taken to be where it was put."""
        assert self.request is not None
        move = self.request.move
        known = tuple(replace(o, X_TO=X_TO) if o.name == move.pick else o for o in self.known)
        over = replace(self, phase=Phase.LOOKING, tried=(*self.tried, move), known=known)
        return replace(over, carried_out=self.carried_out + 1, acted=True)

    @property
    def stuck(self) -> str | None:
        """The object that was to be moved, if it is seen where it was: the cup did not get it."""
        assert self.request is not None
        pick = self.request.move.pick
        before, now = (next((o for o in known if o.name == pick), None) for known in (self.request.known, self.known))
        if before is None or now is None or np.linalg.norm(before.X_TO.p - now.X_TO.p) > STUCK_WITHIN:
            return None
        return pick


class ExplorationAgent(LeafSystem):
    """Chooses moves until nothing is left to do.

    Input ports: observation, abstract, an `Observation`; answer, abstract, the planner's `Answer`; finished (2,), how many plans
        have been carried out, and how far below its place the latest has let go of its object, m.
    Output ports: request, abstract, the latest `Request` or None; state, abstract, the `AgentState`.
    """

    def __init__(
        self,
        *,
        choose: Choose,
        track: Track | None,
        max_moves: int,
        seed: int,
        hopeless: Hopeless | None = None,
        rest: float = 0.5,
    ) -> None:
        """Begins an episode.

        Args:
            choose: the policy.
            track: what gives detections names that last; None: they have them.
            max_moves: after which it ends; a move that could not be carried out counts as one.
            seed: of its chances.
            hopeless: what is not worth trying; None: everything is.
            rest: s, that it waits for things to come to rest before it looks.
        """
        super().__init__()
        self._choose, self._track, self._max_moves, self._seed, self._rest = choose, track, max_moves, seed, rest
        self._hopeless = hopeless
        self._observation = self.DeclareAbstractInputPort("observation", AbstractValue.Make(None))
        self._answer = self.DeclareAbstractInputPort("answer", AbstractValue.Make(Answer()))
        self._finished = self.DeclareVectorInputPort("finished", 2)
        self._state = self.DeclareAbstractState(AbstractValue.Make(AgentState()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, 0.0, self._update)
        of = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort("request", lambda: AbstractValue.Make(None), self._calc_request, of)
        self.DeclareAbstractOutputPort("state", lambda: AbstractValue.Make(AgentState()), self._calc_state, of)

    @staticmethod
    def AddToBuilder(
        builder: DiagramBuilder, *, choose: Choose, track: Track | None, max_moves: int, seed: int, hopeless: Hopeless
    ) -> "ExplorationAgent":
        """Adds one."""
        options: dict[str, Any] = {"max_moves": max_moves, "seed": seed, "hopeless": hopeless}
        system: ExplorationAgent = builder.AddSystem(ExplorationAgent(choose=choose, track=track, **options))
        system.set_name("exploration_agent")
        return system

    def _update(self, context: Context, state: State) -> EventStatus:
        before: AgentState = context.get_abstract_state(self._state).get_value()
        after = self._next(context, before)
        if after is not before:
            state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _next(self, context: Context, now: AgentState) -> AgentState:
        time = context.get_time()
        if now.phase is Phase.LOOKING and time >= now.look_at:
            return self.decided(now, self._observation.Eval(context))
        if now.phase is Phase.WAITING:
            assert now.request is not None
            answer: Answer = self._answer.Eval(context)
            if answer.number < now.request.number:
                return now
            if isinstance(answer.plan, NoPlan):
                return replace(now.refused, look_at=time)
            finished, lowered = self._finished.Eval(context)
            if finished > now.carried_out:
                assert isinstance(answer.plan, Plan)
                return replace(now.placed(answer.plan.X_TO_place.moved((0.0, 0.0, -lowered))), look_at=time + self._rest)
        return now

    def looked(self, now: AgentState, observation: Observation) -> tuple[AgentState, Observation]:
        """After a look: what is known then, and what was seen in the names of what is known."""
        if self._track is not None:
            observation, lost = self._track(now.known, observation)
            # What is lost is no longer known: wherever it is, it will be found again as another.
            now = replace(now, known=tuple(o for o in now.known if o.name not in lost), lost=(*now.lost, *lost))
        return replace(now, known=seen(now.known, observation)), observation

    def decided(self, now: AgentState, observation: Observation) -> AgentState:
        """After a look: with a request for a move, or done."""
        now, observation = self.looked(now, observation)
        if now.acted:
            again = [move for move in legal_moves(observation) if move.pick == now.stuck]
            now = replace(now, acted=False, failed=(*now.failed, *again) if again else ())
        number = len(now.tried) + 1
        if number > self._max_moves:
            return replace(now, phase=Phase.DONE, finish=Finish.OUT_OF_MOVES)
        names = {TRAY, *(o.name for o in now.known)}  # of what is lost nothing more is said
        still_failed = (move for move in now.failed if {move.pick, move.place} <= names)
        failed = (*still_failed, *(self._hopeless(now.known, observation) if self._hopeless else ()))
        decision = self._choose(now.known, observation, now.tried, item_rng(self._seed, number), failed)
        if decision.move is None:
            return replace(now, phase=Phase.DONE, finish=Finish.NOTHING_FEASIBLE)
        return replace(now, phase=Phase.WAITING, request=Request(number, decision.move, observation, now.known, decision))

    def _calc_request(self, context: Context, output: AbstractValue) -> None:
        state: AgentState = context.get_abstract_state(self._state).get_value()
        output.set_value(state.request)

    def _calc_state(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(self._state).get_value())
