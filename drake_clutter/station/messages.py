"""Messages that systems exchange through abstract ports.

A port always carries an object, as newer Drakes let no None pass: a message with number 0 says that
there has been none. A receiver acts on a message once, when its number is new.
"""

from dataclasses import dataclass, field
from typing import Self

import numpy as np

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.scenes.interfaces import Move, Observation, PickPlaceCommand
from drake_clutter.scenes.scene import SceneObject


@dataclass(frozen=True)
class Message:
    """What all messages share.

    Attributes:
        number: Counts from 1; 0 if there has been none.
    """

    number: int = 0

    def __deepcopy__(self, memo: object) -> Self:
        """Return itself: it never changes, and Drake copies abstract values at every update."""
        return self


@dataclass(frozen=True)
class PlanRequest(Message):
    """A move to be planned.

    Attributes:
        move: None in the message with number 0 alone.
        command: The move with its poses; None: no place is known to be free.
        observation: In which the move was chosen.
        objects: K_t then.
    """

    move: Move | None = None
    command: PickPlaceCommand | None = None
    observation: Observation | None = field(default=None, repr=False)
    objects: tuple[SceneObject, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class PlanResponse(Message):
    """What became of a request.

    Attributes:
        number: Of the request.
        plan: Or why there is none; None in the message with number 0 alone.
    """

    plan: PickPlacePlan | PlanningFailure | None = field(default=None, repr=False)


@dataclass(frozen=True)
class PlannedMove(Message):
    """A plan to be carried out.

    Attributes:
        number: Of the request.
        plan: None in the message with number 0 alone.
    """

    plan: PickPlacePlan | None = field(default=None, repr=False)


@dataclass(frozen=True)
class ExecutorStatus(Message):
    """What the executor is doing.

    Attributes:
        number: Of the plan.
        stage: "idle", or what part of the plan is being carried out.
    """

    stage: str = "idle"


def empty_observation() -> Observation:
    """Return the model value of ports for observations, of which the type alone counts."""
    cell = default_cell()
    return Observation(np.zeros((0, 0), np.float32), (), cell.camera, cell.support)
