"""Planning in the loop: from a move that is asked for to a plan, or to why there is none."""

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.scenes.occlusion import occluded_boxes
from drake_clutter.station.messages import PlannedMove, PlanRequest, PlanResponse

REQUEST_POLL_PERIOD = 0.05
"""Between two looks for a new request [s]."""


class PlannerSystem(LeafSystem):
    """Plan one request after the other.

    .. pydrake_system::

        name: PlannerSystem
        input_ports:
        - request
        output_ports:
        - response
        - plan

    Input ports:
        request: `PlanRequest`.

    Output ports:
        response: The latest `PlanResponse`.
        plan: `PlannedMove`, of the latest response; with number 0 if that has no plan.
    """

    def __init__(
        self, *, planner: PickPlacePlanner, empty_depth: NDArray[np.float32], latency: float
    ) -> None:
        """Make a system.

        Args:
            planner: Plans among objects, and clear of space that has not been seen.
            empty_depth: Depth of the cell without objects [m]. Shape (height, width).
            latency: From a request to its response [s], whatever the computer takes.
        """
        super().__init__()
        self._planner, self._empty_depth, self._latency = planner, empty_depth, latency
        self._request = self.DeclareAbstractInputPort("request", AbstractValue.Make(PlanRequest()))
        self._response = self.DeclareAbstractState(AbstractValue.Make(PlanResponse()))
        # Number of the latest request, and when it came [s].
        self._received = self.DeclareDiscreteState([0.0, 0.0])
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            REQUEST_POLL_PERIOD, REQUEST_POLL_PERIOD / 2, self._update
        )
        of = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort(
            "response", lambda: AbstractValue.Make(PlanResponse()), self._calc_response, of
        )
        self.DeclareAbstractOutputPort(
            "plan", lambda: AbstractValue.Make(PlannedMove()), self._calc_plan, of
        )

    def response(self, context: Context) -> PlanResponse:
        """Return the latest response, from the system's context."""
        response: PlanResponse = context.get_abstract_state(self._response).get_value()
        return response

    def _update(self, context: Context, state: State) -> EventStatus:
        request: PlanRequest = self._request.Eval(context)
        if request.number in (0, self.response(context).number):
            return EventStatus.DidNothing()
        number, since = context.get_discrete_state(self._received).value()
        if request.number != number:
            since = context.get_time()
            state.get_mutable_discrete_state(self._received).set_value([request.number, since])
        if context.get_time() >= since + self._latency - 1e-9:
            response = PlanResponse(request.number, self._plan(request))
            state.get_mutable_abstract_state(int(self._response)).set_value(response)
        return EventStatus.Succeeded()

    def _plan(self, request: PlanRequest) -> PickPlacePlan | PlanningFailure:
        assert request.move is not None
        assert request.observation is not None
        if request.command is None:
            return PlanningFailure(PlanningFailureReason.NO_FREE_SPOT, request.move.place)
        unseen = occluded_boxes(request.objects, request.observation, self._empty_depth)
        pick, X_TO_place = request.move.pick, request.command.X_TO_place
        return self._planner.plan(request.objects, pick, X_TO_place, unseen)

    def _calc_response(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.response(context))

    def _calc_plan(self, context: Context, output: AbstractValue) -> None:
        response, found = self.response(context), PlannedMove()
        if isinstance(response.plan, PickPlacePlan):
            found = PlannedMove(response.number, response.plan)
        output.set_value(found)
