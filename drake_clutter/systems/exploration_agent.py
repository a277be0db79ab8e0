"""The exploring agent in the loop: it looks, chooses a move, waits for its end, looks again."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, State

from drake_clutter.config import ExplorationConfig
from drake_clutter.planning.plan import NoPlan, Plan
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation, PickPlaceCommand
from drake_clutter.scenes.placement import free_places, resolve_placement
from drake_clutter.scenes.scene import TRAY, SceneObject
from drake_clutter.scenes.unseen import under_nameless
from drake_clutter.seeding import item_rng
from drake_clutter.station.arm_executor import nearest
from drake_clutter.systems.move_planner import Answer
from drake_clutter.tasks.belief import (
    ActionFilter,
    Belief,
    Decision,
    Policy,
    Tracker,
    legal_moves,
    select_move,
    update_belief,
)

PERIOD = 0.05
"""s, between two looks at what the others are doing."""


def infeasible_moves(
    known: Sequence[SceneObject],
    observation: Observation,
    pickable: Collection[str],
    empty: NDArray[np.float32],
    config: ExplorationConfig,
) -> list[Move]:
    """Return the moves of what cannot be picked, and those for which there is no free place.

    Also those of what may carry something that was not recognised, as long as others are left.

    Args:
        known: K_t.
        observation: What is in view.
        pickable: Names of what is known to carry nothing, and can be held.
        empty: Depth of the empty cell [m], see `under_nameless`. Shape (height, width).
        config: Of the task.
    """
    legal = legal_moves(observation)
    can_be_picked = [move for move in legal if move.pick in pickable]
    free = [move for move in can_be_picked if free_places(observation, move, config) is not None]
    risky = under_nameless(known, observation, empty)
    worth_trying = {move for move in free if move.pick not in risky} or set(free)
    return [move for move in legal if move not in worth_trying]


def in_true_names(
    decision: Decision,
    belief: Belief,
    observation: Observation,
    objects: Sequence[SceneObject],
) -> Decision:
    """Return a decision in the names of what is really there.

    Args:
        decision: In the names of the belief; its move is not None.
        belief: When it was made; each object is the true one nearest to its place.
        observation: When it was made; it is kept in the decision.
        objects: The true ones.
    """
    assert decision.move is not None
    name = {TRAY: TRAY} | {o.name: nearest(objects, o.X_TO).name for o in belief.objects}
    return Decision(
        Move(name[decision.move.pick], name[decision.move.place]),
        {name[pick]: chance for pick, chance in decision.picks.items()},
        tuple(name[known] for known in decision.known),
        observation,
    )


class Phase(Enum):
    """What the agent is doing."""

    LOOKING = "waits for things to come to rest, then looks"
    WAITING = "waits for a plan, or for its end"
    DONE = "has no move left"


@dataclass(frozen=True)
class Request:
    """A move to be carried out.

    Attributes:
        number: 1 for the episode's first.
        decision: Of which the move is part.
        command: The move with its poses; None: no place is known to be free.
        observation: What was in view when it was decided.
        belief: What was known then.
    """

    number: int
    decision: Decision = field(repr=False)
    command: PickPlaceCommand | None
    observation: Observation = field(repr=False)
    belief: Belief = field(repr=False)

    def __deepcopy__(self, memo: object) -> "Request":
        """Itself: it never changes, and Drake copies abstract values again and again."""
        return self

    @property
    def move(self) -> Move:
        """What to do."""
        assert self.decision.move is not None
        return self.decision.move


@dataclass(frozen=True)
class AgentState:
    """What the agent is doing, and what it knows.

    Attributes:
        phase: What it is doing.
        look_at: When it looks next [s].
        belief: What it knows.
        request: The latest.
        carried_out: How many moves were carried out.
    """

    phase: Phase = Phase.LOOKING
    look_at: float = 0.0
    belief: Belief = field(default_factory=Belief)
    request: Request | None = None
    carried_out: int = 0

    def __deepcopy__(self, memo: object) -> "AgentState":
        """Itself, as of `Request`."""
        return self


class ExplorationAgent(LeafSystem):
    """Chooses moves until none is left.

    Input ports: observation, abstract, an `Observation`; answer, abstract, the planner's `Answer`; finished (2,), how many plans
        have been carried out, and how far below its place the latest has let go of its object, m.
    Output ports: request, abstract, the latest `Request` or None; state, abstract, the `AgentState`.
    """

    def __init__(
        self,
        *,
        config: ExplorationConfig,
        seed: int,
        policy: Policy | None = None,
        tracker: Tracker | None = None,
        action_filter: ActionFilter | None = None,
        rest: float = 0.5,
    ) -> None:
        """Begin an episode.

        Args:
            config: Of the task.
            seed: Of the policy's chances, and of those of the placement.
            policy: Chooses the moves; without one, `policy` is to be set before a simulation.
            tracker: Gives detections names that last; None: they have them.
            action_filter: Adds to the invalid moves; None: every legal move may be tried.
            rest: For which it lets things come to rest before it looks [s].
        """
        super().__init__()
        self.policy, self._config, self._seed, self._rest = policy, config, seed, rest
        self._tracker, self._action_filter = tracker, action_filter
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
        builder: DiagramBuilder,
        *,
        config: ExplorationConfig,
        seed: int,
        tracker: Tracker | None,
        action_filter: ActionFilter,
    ) -> "ExplorationAgent":
        """Add one."""
        system: ExplorationAgent = builder.AddSystem(
            ExplorationAgent(config=config, seed=seed, tracker=tracker, action_filter=action_filter)
        )
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
        if now.phase is not Phase.WAITING:
            return now
        assert now.request is not None
        move = now.request.move
        answer: Answer = self._answer.Eval(context)
        if answer.number < now.request.number:
            return now
        if isinstance(answer.plan, NoPlan):
            belief = now.belief.record(move, MoveResult.NOT_PLANNED)
            return replace(now, phase=Phase.LOOKING, look_at=time, belief=belief)
        finished, lowered = self._finished.Eval(context)
        if finished <= now.carried_out:
            return now
        assert isinstance(answer.plan, Plan)
        X_TO = answer.plan.X_TO_place.moved((0.0, 0.0, -lowered))
        return replace(
            now,
            phase=Phase.LOOKING,
            look_at=time + self._rest,
            belief=now.belief.record(move, MoveResult.PLACED, X_TO),
            carried_out=now.carried_out + 1,
        )

    def decided(self, now: AgentState, observation: Observation) -> AgentState:
        """Return the state after a look: with a request for a move, or done."""
        assert self.policy is not None, "the policy is set before a simulation"
        belief, observation = update_belief(now.belief, observation, self._tracker)
        number = len(belief.history) + 1
        rng = item_rng(self._seed, number)
        decision = select_move(self.policy, belief, observation, rng, self._action_filter)
        if decision.move is None:
            return replace(now, belief=belief, phase=Phase.DONE)
        rng = item_rng(self._seed, number)
        command = resolve_placement(decision.move, observation, self._config, rng)
        request = Request(number, decision, command, observation, belief)
        return replace(now, belief=belief, phase=Phase.WAITING, request=request)

    def _calc_request(self, context: Context, output: AbstractValue) -> None:
        state: AgentState = context.get_abstract_state(self._state).get_value()
        output.set_value(state.request)

    def _calc_state(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(self._state).get_value())
