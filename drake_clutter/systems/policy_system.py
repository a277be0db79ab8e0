"""Drake system that observes the scene, chooses a move, and waits until it is carried out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_clutter.belief.class_belief import Touch, touch_likelihoods
from drake_clutter.catalog import ObjectClass
from drake_clutter.config import ExplorationConfig
from drake_clutter.planning.pick_place_plan import PickPlacePlan
from drake_clutter.scenes.interfaces import MovePart, MoveResult, Observation
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.seeding import item_rng
from drake_clutter.station.messages import (
    ExecutorStatus,
    PlanRequest,
    PlanResponse,
    empty_observation,
)
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
"""Period at which the state is updated [s]."""


class PolicyPhase(Enum):
    """Phase of a `PolicySystem`."""

    OBSERVING = "waits for objects to come to rest, then observes the scene"
    WAITING = "waits for a plan, or for its execution"
    DONE = "has no further move"


@dataclass(frozen=True)
class PolicyState:
    """State of a `PolicySystem`.

    Attributes:
        phase: Current phase.
        observation_time: Time of the next observation [s].
        belief: Current belief.
        request: Latest request.
        decision: Decision from which the request follows; once done, the one without a move.
    """

    phase: PolicyPhase = PolicyPhase.OBSERVING
    observation_time: float = 0.0
    belief: Belief = field(default_factory=Belief)
    request: PlanRequest = field(default_factory=PlanRequest)
    decision: Decision | None = None

    def __deepcopy__(self, memo: object) -> "PolicyState":
        """Return itself: it is immutable, and Drake copies abstract values at every update."""
        return self


class PolicySystem(LeafSystem):
    """Choose moves until the policy has no further one.

    .. pydrake_system::

        name: PolicySystem
        input_ports:
        - observation
        - response
        - finished
        - status
        output_ports:
        - request
        - state

    Input ports:
        observation: `Observation`, abstract; evaluated when the scene is observed.
        response: `PlanResponse`, abstract.
        finished: Number of the latest finished plan, and by how much the object was released below
            its planned pose [m]. Shape (2,).
        status: `ExecutorStatus`, abstract; without one, every motion counts as a move of the
            object. Where the gripper has missed it, another grasp is requested for the same move.

    Output ports:
        request: Latest `PlanRequest`, abstract.
        state: `PolicyState`, abstract.

    Attributes:
        policy: Policy that chooses the moves; set before the simulation.
    """

    def __init__(
        self,
        *,
        config: ExplorationConfig,
        seed: int,
        policy: Policy | None = None,
        tracker: Tracker | None = None,
        action_filter: ActionFilter | None = None,
        max_grips: int = 1,
        classes: Sequence[ObjectClass] = (),
        post_motion_wait: float = 0.5,
    ) -> None:
        """Create the system.

        Args:
            config: Config of the task.
            seed: Seed of the policy and of the placement.
            policy: Policy that chooses the moves; None: the attribute is set later.
            tracker: Associates detections with known objects; None: their names are persistent.
            action_filter: Returns infeasible moves; None: every legal move is feasible.
            max_grips: Largest number of grasps of a move, see `PlannerConfig`.
            classes: Classes of the objects, between which the gripper's touch decides; none if
                the detector is certain of them.
            post_motion_wait: Time for objects to come to rest after a move [s].
        """
        super().__init__()
        self.policy = policy
        self._config = config
        self._seed = seed
        self._post_motion_wait = post_motion_wait
        self._tracker = tracker
        self._action_filter = action_filter
        self._max_grips = max_grips
        self._classes = tuple(classes)
        self._observation = self.DeclareAbstractInputPort(
            "observation", AbstractValue.Make(empty_observation())
        )
        self._response = self.DeclareAbstractInputPort(
            "response", AbstractValue.Make(PlanResponse())
        )
        self._finished = self.DeclareVectorInputPort("finished", 2)
        self._status = self.DeclareAbstractInputPort("status", AbstractValue.Make(ExecutorStatus()))
        self._state = self.DeclareAbstractState(AbstractValue.Make(PolicyState()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(UPDATE_PERIOD, 0.0, self._update)
        state_only = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort(
            "request", lambda: AbstractValue.Make(PlanRequest()), self._calc_request, state_only
        )
        self.DeclareAbstractOutputPort(
            "state", lambda: AbstractValue.Make(PolicyState()), self._calc_state, state_only
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
        """Return the next state, or the given one if nothing has changed."""
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
            has_tried = bool(now.request.tried)
            result = MoveResult.NOT_GRASPED if has_tried else MoveResult.NOT_PLANNED
            assert response.plan is not None
            failed_part = response.plan.failed_part
            belief = self._record(context, now, result, failed_part=failed_part)
            return replace(now, phase=PolicyPhase.OBSERVING, observation_time=time, belief=belief)
        finished, lowered_distance = self._finished.Eval(context)
        if finished != now.request.number:
            return now
        if self._has_missed_grasp(context):
            tried = (*now.request.tried, response.plan.held)
            if len(tried) < self._max_grips:
                number = now.request.number + 1
                return replace(now, request=replace(now.request, number=number, tried=tried))
            belief = self._record(context, now, MoveResult.NOT_GRASPED)
            return replace(now, phase=PolicyPhase.OBSERVING, observation_time=time, belief=belief)
        belief = self._record(context, now, MoveResult.PLACED, lowered_distance)
        observation_time = time + self._post_motion_wait
        return replace(
            now, phase=PolicyPhase.OBSERVING, observation_time=observation_time, belief=belief
        )

    def _record(
        self,
        context: Context,
        now: PolicyState,
        result: MoveResult,
        lowered_distance: float = 0.0,
        failed_part: MovePart | None = None,
    ) -> Belief:
        """Return the belief after the requested move, with what the gripper felt.

        Args:
            context: Context of the system.
            now: State with the request.
            result: Result of the move.
            lowered_distance: By how much the object was released below its planned pose [m].
            failed_part: Part of the move for which no plan was found, see `PlanningFailure`.
        """
        move = now.request.move
        assert move is not None
        X_TO_place = None
        touch = Touch(has_sealed=result is not MoveResult.NOT_GRASPED)
        plan = self._response.Eval(context).plan
        if result is MoveResult.PLACED:
            X_TO_place = plan.X_TO_place.translated((0.0, 0.0, -lowered_distance))
            touch = self._touch(context, now, plan, lowered_distance)
        picked = next(o for o in now.belief.objects if o.name == move.pick)
        likelihoods = None
        if self._classes and touch.has_felt:
            likelihoods = touch_likelihoods(picked, touch, self._classes, self._config.belief.touch)
        return now.belief.record(move, result, X_TO_place, likelihoods, failed_part)

    def _touch(
        self, context: Context, now: PolicyState, plan: PickPlacePlan, lowered_distance: float
    ) -> Touch:
        """Return what the gripper felt when it put an object down.

        The object hung lower than planned by the extension of the bellows. It was planned to be
        released `release_height` above what is below, or higher where the descent starts higher.
        """
        if not self._status.HasValue(context):
            return Touch()
        status: ExecutorStatus = self._status.Eval(context)
        if math.isnan(status.felt_mass):
            return Touch()
        excess_height = math.nan
        if status.has_touched and now.request.command is not None:
            planned = plan.X_TO_place.translation[2] - now.request.command.X_TO_place.translation[2]
            gap = planned + self._config.release_height
            excess_height = gap - lowered_distance - status.bellows_extension
        return Touch(status.felt_mass, excess_height)

    def _has_missed_grasp(self, context: Context) -> bool:
        """Return whether the gripper has missed the object of the latest plan."""
        if not self._status.HasValue(context):
            return False
        status: ExecutorStatus = self._status.Eval(context)
        return status.missed_grasp

    def after_observation(self, now: PolicyState, observation: Observation) -> PolicyState:
        """Return the state after an observation: with a request, or done.

        Args:
            now: State before the observation.
            observation: Latest observation.
        """
        assert self.policy is not None, "set the policy before the simulation"
        belief, observation = update_belief(now.belief, observation, self._tracker)
        number = len(belief.history) + 1
        rng = item_rng(self._seed, number)
        decision = select_move(self.policy, belief, observation, rng, self._action_filter)
        if decision.move is None:
            return replace(now, belief=belief, phase=PolicyPhase.DONE, decision=decision)
        rng = item_rng(self._seed, number)
        command = resolve_placement(decision.move, observation, self._config, rng)
        number = now.request.number + 1
        request = PlanRequest(number, decision.move, command, observation, belief.objects)
        return PolicyState(PolicyPhase.WAITING, now.observation_time, belief, request, decision)

    def _calc_request(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.state(context).request)

    def _calc_state(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.state(context))
