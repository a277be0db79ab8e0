"""Vacuum of the suction cups of a gripper, as a LeafSystem."""

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from drake_clutter.cell.suction import SuctionGripper

VACUUM_UPDATE_PERIOD = 0.0125
"""Period at which the vacuum is updated [s]; the solution in between is exact."""


class VacuumSystem(LeafSystem):
    """Vacuum of each cup, see `SuctionGripper.next_vacuum`.

    .. pydrake_system::

        name: VacuumSystem
        input_ports:
        - hold
        output_ports:
        - vacuum

    Input ports:
        hold: 1 for a cup whose vacuum is commanded on, else 0. All are off if it is not connected.
            Shape (num_cups,).

    Output ports:
        vacuum: Pressure of each cup below the ambient pressure [Pa]. Shape (num_cups,).
    """

    def __init__(self, gripper: SuctionGripper) -> None:
        """Create a system without vacuum, with lips on nothing.

        Args:
            gripper: Gripper with the cups.
        """
        super().__init__()
        self._gripper = gripper
        num_cups = len(gripper.cups)
        self._hold = self.DeclareVectorInputPort("hold", num_cups)
        self._vacuum = self.DeclareDiscreteState(num_cups)
        self._leak_rates = self.DeclareNumericParameter(BasicVector(np.full(num_cups, np.inf)))
        self.DeclarePeriodicDiscreteUpdateEvent(
            VACUUM_UPDATE_PERIOD, VACUUM_UPDATE_PERIOD, self._update
        )
        self.DeclareStateOutputPort("vacuum", self._vacuum)

    def set_leak_rates(self, context: Context, rates: NDArray[np.float64]) -> None:
        """Set the rates at which the vacuum leaks through each lip [1/s]; infinite without seal.

        Args:
            context: Context of the system.
            rates: Rates, see `SuctionGripper.leak_rate`. Shape (num_cups,).
        """
        context.get_mutable_numeric_parameter(int(self._leak_rates)).SetFromVector(rates)

    def _update(self, context: Context, values: DiscreteValues) -> EventStatus:
        vacuum = context.get_discrete_state(self._vacuum).value()
        rates = context.get_numeric_parameter(int(self._leak_rates)).value()
        hold = self._hold.Eval(context) if self._hold.HasValue(context) else np.zeros(len(vacuum))
        values.set_value(
            self._vacuum,
            [
                self._gripper.next_vacuum(
                    float(vacuum[k]),
                    is_on=bool(hold[k] > 0.5),
                    leak_rate=float(rates[k]),
                    duration=VACUUM_UPDATE_PERIOD,
                )
                for k in range(len(vacuum))
            ],
        )
        return EventStatus.Succeeded()
