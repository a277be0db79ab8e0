"""Messages that systems exchange through abstract-valued ports.

A port always holds a message, because Drake does not accept None as an abstract value. Number 0
stands for no message. A receiver acts on a message once, when its number changes.
"""

import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from drake_clutter.cell.work_cell import default_cell
from drake_clutter.planning.motion_plan import HeldObject, Plan
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.scenes.interfaces import Move, Observation, PickPlaceCommand
from drake_clutter.scenes.scene import SceneObject
from drake_clutter.station.command_schedule import CommandSchedule


@dataclass(frozen=True)
class Message:
    """Base class of all messages.

    Attributes:
        number: Sequence number from 1; 0 for no message.
    """

    number: int = 0

    def __deepcopy__(self, memo: object) -> Self:
        """Return the message itself; it is immutable and often copied by Drake."""
        return self


@dataclass(frozen=True)
class PlanRequest(Message):
    """Request to plan a move.

    Attributes:
        move: Move; None if `number` is 0.
        command: Move with its pick and place poses; None if no free placement was found.
        observation: Observation on which the move is based.
        objects: Known objects (K_t) at that time.
        tried: Grasps of the move with which the gripper did not grasp the object.
    """

    move: Move | None = None
    command: PickPlaceCommand | None = None
    observation: Observation | None = field(default=None, repr=False)
    objects: tuple[SceneObject, ...] = field(default=(), repr=False)
    tried: tuple[HeldObject, ...] = ()


@dataclass(frozen=True)
class PlanResponse(Message):
    """Result of a plan request.

    Attributes:
        number: Number of the request.
        plan: Plan, or the reason why there is none; None if `number` is 0.
    """

    plan: PickPlacePlan | PlanningFailure | None = field(default=None, repr=False)


@dataclass(frozen=True)
class PlannedMove(Message):
    """Plan to execute.

    Attributes:
        number: Number of the request.
        plan: Plan; None if `number` is 0.
        schedule: Commands; None for those that follow from the plan.
    """

    plan: Plan | None = field(default=None, repr=False)
    schedule: CommandSchedule | None = field(default=None, repr=False)


@dataclass(frozen=True)
class ExecutorStatus(Message):
    """Status of the plan executor.

    Attributes:
        number: Number of the plan.
        stage: Stage of the plan, see `CommandSchedule.stage_at`; "idle" if none is executed.
        missed_grasp: Whether the gripper has not grasped the object: no vacuum has built up, or the
            jaws met nothing.
        bellows_extension: Extension of the bellows before the guarded descent [m]; NaN without one.
        felt_mass: Mass that stretched the bellows [kg]; NaN without a guarded descent, or if
            the cups hold nothing.
        has_touched: Whether the guarded descent has ended by contact.
    """

    stage: str = "idle"
    missed_grasp: bool = False
    bellows_extension: float = math.nan
    felt_mass: float = math.nan
    has_touched: bool = False


def empty_observation() -> Observation:
    """Return the model value of observation ports; Drake uses only its type."""
    cell = default_cell()
    return Observation(np.zeros((0, 0), np.float32), (), cell.camera, cell.support)
