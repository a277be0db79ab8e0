"""Drake system that plans the moves that a policy requests."""

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
"""Period at which the system checks for a new request [s]."""


class PlannerSystem(LeafSystem):
    """Plan requested moves, one at a time.

    .. pydrake_system::

        name: PlannerSystem
        input_ports:
        - request
        output_ports:
        - response
        - plan

    Input ports:
        request: `PlanRequest`, abstract.

    Output ports:
        response: Latest `PlanResponse`, abstract.
        plan: `PlannedMove` of the latest response, abstract; its number is 0 if there is no plan.
    """

    def __init__(
        self, *, planner: PickPlacePlanner, empty_depth: NDArray[np.float32], latency: float
    ) -> None:
        """Create the system.

        Args:
            planner: Planner of pick-and-place moves.
            empty_depth: Depth image of the cell without objects, for the occluded space [m]. Shape
                (H, W).
            latency: Simulated time from a request to its response [s], independent of the
                computation time.
        """
        super().__init__()
        self._planner = planner
        self._empty_depth = empty_depth
        self._latency = latency
        self._request = self.DeclareAbstractInputPort("request", AbstractValue.Make(PlanRequest()))
        self._response = self.DeclareAbstractState(AbstractValue.Make(PlanResponse()))
        # Number of the latest request and its arrival time [s].
        self._received = self.DeclareDiscreteState([0.0, 0.0])
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            REQUEST_POLL_PERIOD, REQUEST_POLL_PERIOD / 2, self._update
        )
        state_only = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort(
            "response", lambda: AbstractValue.Make(PlanResponse()), self._calc_response, state_only
        )
        self.DeclareAbstractOutputPort(
            "plan", lambda: AbstractValue.Make(PlannedMove()), self._calc_plan, state_only
        )

    def response(self, context: Context) -> PlanResponse:
        """Return the latest response in the system's context."""
        response: PlanResponse = context.get_abstract_state(self._response).get_value()
        return response

    def response_time(self, context: Context) -> float:
        """Return the time of the response to the latest request that has arrived [s]."""
        _, arrival_time = context.get_discrete_state(self._received).value()
        return float(arrival_time) + self._latency

    def _update(self, context: Context, state: State) -> EventStatus:
        request: PlanRequest = self._request.Eval(context)
        if request.number in (0, self.response(context).number):
            return EventStatus.DidNothing()
        number, arrival_time = context.get_discrete_state(self._received).value()
        if request.number != number:
            arrival_time = context.get_time()
            received = state.get_mutable_discrete_state(self._received)
            received.set_value([request.number, arrival_time])
        if context.get_time() >= arrival_time + self._latency - 1e-9:
            response = PlanResponse(request.number, self._plan(request))
            state.get_mutable_abstract_state(int(self._response)).set_value(response)
        return EventStatus.Succeeded()

    def _plan(self, request: PlanRequest) -> PickPlacePlan | PlanningFailure:
        assert request.move is not None
        assert request.observation is not None
        if request.command is None:
            return PlanningFailure(PlanningFailureReason.NO_FREE_PLACEMENT, request.move.place)
        occluded = occluded_boxes(request.objects, request.observation, self._empty_depth)
        X_TO_place = request.command.X_TO_place
        return self._planner.plan(
            request.objects, request.move.pick, X_TO_place, occluded, exclude=request.tried
        )

    def _calc_response(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self.response(context))

    def _calc_plan(self, context: Context, output: AbstractValue) -> None:
        response = self.response(context)
        if isinstance(response.plan, PickPlacePlan):
            output.set_value(PlannedMove(response.number, response.plan))
        else:
            output.set_value(PlannedMove())
