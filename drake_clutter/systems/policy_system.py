"""The exploring agent in the loop: it looks, chooses a move, waits for its end, looks again."""

from dataclasses import dataclass, field, replace
from enum import Enum

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_clutter.config import ExplorationConfig
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.scenes.interfaces import MoveResult, Observation
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.seeding import item_rng
from drake_clutter.station.messages import PlanRequest, PlanResponse, empty_observation
from drake_clutter.tasks.belief import (
    ActionFilter,
    Belief,
    Decision,
    Policy,
    Tracker,
    select_move,
    update_belief,
)

UPDATE_PERIOD = 0.05
"""Between two looks at the responses [s]."""


class PolicyPhase(Enum):
    """What the agent is doing."""

    OBSERVING = "waits for things to come to rest, then looks"
    WAITING = "waits for a plan, or for its end"
    DONE = "has no move left"


@dataclass(frozen=True)
class PolicyState:
    """What the agent is doing, and what it knows.

    Attributes:
        phase: What it is doing.
        observation_time: When it looks next [s].
        belief: What it knows.
        request: The latest.
        decision: Of which the request's move is part.
    """

    phase: PolicyPhase = PolicyPhase.OBSERVING
    observation_time: float = 0.0
    belief: Belief = field(default_factory=Belief)
    request: PlanRequest = field(default_factory=PlanRequest)
    decision: Decision | None = None

    def __deepcopy__(self, memo: object) -> "PolicyState":
        """Return itself: it never changes, and Drake copies abstract values at every update."""
        return self


class PolicySystem(LeafSystem):
    """Choose moves until none is left.

    .. pydrake_system::

        name: PolicySystem
        input_ports:
        - observation
        - response
        - finished
        output_ports:
        - request
        - state

    Input ports:
        observation: `Observation`.
        response: `PlanResponse`.
        finished: Number of the plan that has ended, and how far below its planned pose the object
            was let go [m]. Shape (2,).

    Output ports:
        request: The latest `PlanRequest`.
        state: `PolicyState`.

    Attributes:
        policy: Chooses the moves; set before a simulation.
    """

    def __init__(
        self,
        *,
        config: ExplorationConfig,
        seed: int,
        policy: Policy | None = None,
        tracker: Tracker | None = None,
        action_filter: ActionFilter | None = None,
        post_motion_wait: float = 0.5,
    ) -> None:
        """Begin an episode.

        Args:
            config: Of the task.
            seed: Of the policy's chances, and of those of the placement.
            policy: Chooses the moves; None: it is set later.
            tracker: Gives detections names that last; None: they have them.
            action_filter: Adds to the invalid moves; None: every legal move may be tried.
            post_motion_wait: For which it lets things come to rest before it looks [s].
        """
        super().__init__()
        self.policy, self._config, self._seed, self._rest = policy, config, seed, post_motion_wait
        self._tracker, self._action_filter = tracker, action_filter
        self._observation = self.DeclareAbstractInputPort(
            "observation", AbstractValue.Make(empty_observation())
        )
        self._response = self.DeclareAbstractInputPort(
            "response", AbstractValue.Make(PlanResponse())
        )
        self._finished = self.DeclareVectorInputPort("finished", 2)
        self._state = self.DeclareAbstractState(AbstractValue.Make(PolicyState()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(UPDATE_PERIOD, 0.0, self._update)
        of = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort(
            "request", lambda: AbstractValue.Make(PlanRequest()), self._calc_request, of
        )
        self.DeclareAbstractOutputPort(
            "state", lambda: AbstractValue.Make(PolicyState()), self._calc_state, of
        )

    def state(self, context: Context) -> PolicyState:
        """Return the state in the system's context."""
        state: PolicyState = context.get_abstract_state(self._state).get_value()
        return state

    def _update(self, context: Context, state: State) -> EventStatus:
        before = self.state(context)
        after = self._next_state(context, before)
        if after is not before:
            state.get_mutable_abstract_state(int(self._state)).set_value(after)
        return EventStatus.Succeeded()

    def _next_state(self, context: Context, now: PolicyState) -> PolicyState:
        time = context.get_time()
        if now.phase is PolicyPhase.OBSERVING and time >= now.observation_time:
            return self.after_observation(now, self._observation.Eval(context))
        if now.phase is not PolicyPhase.WAITING:
            return now
        move, response = now.request.move, self._response.Eval(context)
        assert move is not None
        if response.number != now.request.number:
            return now
        if not isinstance(response.plan, PickPlacePlan):
            belief = now.belief.record(move, MoveResult.NOT_PLANNED)
            return replace(now, phase=PolicyPhase.OBSERVING, observation_time=time, belief=belief)
        finished, lowered = self._finished.Eval(context)
        if finished != now.request.number:
            return now
        X_TO = response.plan.X_TO_place.translated((0.0, 0.0, -lowered))
        belief = now.belief.record(move, MoveResult.PLACED, X_TO)
        return replace(
            now, phase=PolicyPhase.OBSERVING, observation_time=time + self._rest, belief=belief
        )

    def after_observation(self, now: PolicyState, observation: Observation) -> PolicyState:
        """Return the state after a look: with a request for a move, or done."""
        assert self.policy is not None, "the policy is set before a simulation"
        belief, observation = update_belief(now.belief, observation, self._tracker)
        number = len(belief.history) + 1
        rng = item_rng(self._seed, number)
        decision = select_move(self.policy, belief, observation, rng, self._action_filter)
        if decision.move is None:
            return replace(now, belief=belief, phase=PolicyPhase.DONE)
        rng = item_rng(self._seed, number)
        command = resolve_placement(decision.move, observation, self._config, rng)
        request = PlanRequest(number, decision.move, command, observation, belief.objects)
        return PolicyState(PolicyPhase.WAITING, now.observation_time, belief, request, decision)

    def _calc_request(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.state(context).request)

    def _calc_state(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.state(context))
