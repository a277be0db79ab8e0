"""Planning in the loop: from a move that is asked for to a plan, or to why there is none."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, LeafSystem, State

from drake_clutter.planning.plan import NoPlan, Plan
from drake_clutter.seeding import item_rng

PERIOD = 0.05
"""s, between two looks at what is asked for."""

Planner = Callable[[Any, np.random.Generator], Plan | NoPlan]
"""From a `Request` and chance, which decides between equally good places."""


@dataclass(frozen=True)
class Answer:
    """What the planner said.

    Attributes:
        number: of the request; 0: none yet.
        plan: or why there is none.
    """

    number: int = 0
    plan: Plan | NoPlan | None = field(default=None, repr=False)

    def __deepcopy__(self, memo: object) -> "Answer":
        """Itself: it never changes, and Drake copies abstract values again and again."""
        return self


class MovePlanner(LeafSystem):
    """Plans one request after the other.

    Input port: request, abstract, a `Request` or None.
    Output ports: answer, abstract, the latest `Answer`; plan, abstract, the latest `Plan` or None.
    """

    def __init__(self, *, plan: Planner, seed: int, latency: float) -> None:
        """With what plans.

        Args:
            plan: the function.
            seed: of its chances.
            latency: s, from a request to its answer, whatever the computer really takes.
        """
        super().__init__()
        self._plan, self._seed, self._latency = plan, seed, latency
        self._request = self.DeclareAbstractInputPort("request", AbstractValue.Make(None))
        self._answer = self.DeclareAbstractState(AbstractValue.Make(Answer()))
        self._latest = self.DeclareAbstractState(AbstractValue.Make(None))
        self._asked = self.DeclareDiscreteState([0.0, 0.0])  # number of the request, and when it came, s
        self.DeclarePeriodicUnrestrictedUpdateEvent(PERIOD, PERIOD / 2, self._update)
        of = {self.all_state_ticket()}
        self.DeclareAbstractOutputPort("answer", lambda: AbstractValue.Make(Answer()), self._calc_answer, of)
        self.DeclareAbstractOutputPort("plan", lambda: AbstractValue.Make(None), self._calc_plan, of)

    @staticmethod
    def AddToBuilder(builder: DiagramBuilder, *, plan: Planner, seed: int, latency: float) -> "MovePlanner":
        """Adds one."""
        system: MovePlanner = builder.AddSystem(MovePlanner(plan=plan, seed=seed, latency=latency))
        system.set_name("move_planner")
        return system

    def _update(self, context: Context, state: State) -> EventStatus:
        answer: Answer = context.get_abstract_state(self._answer).get_value()
        request, (number, since) = self._request.Eval(context), context.get_discrete_state(self._asked).value()
        if request is None or request.number == answer.number:
            return EventStatus.DidNothing()
        if request.number != number:
            since = context.get_time()
            state.get_mutable_discrete_state(self._asked).set_value([request.number, since])
        if context.get_time() >= since + self._latency - 1e-9:
            found = self._plan(request, item_rng(self._seed, request.number))
            if isinstance(found, Plan):
                state.get_mutable_abstract_state(int(self._latest)).set_value(found)
            state.get_mutable_abstract_state(int(self._answer)).set_value(Answer(request.number, found))
        return EventStatus.Succeeded()

    def _calc_answer(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(self._answer).get_value())

    def _calc_plan(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(self._latest).get_value())
