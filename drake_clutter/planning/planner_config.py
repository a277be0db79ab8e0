"""How plans are searched."""

from typing import Annotated

from drake_clutter.validation import Flag, InRange, NonNegative, config_class


@config_class
class PlannerConfig:
    """How plans are searched.

    Attributes:
        clearance: Kept from everything, but for what the held object is closer to at an end of its way [m].
        rise: By which the held object is lifted over what it must pass [m].
        lip_gap: Between lip and face when the vacuum is switched on [m].
        grasp_spacing: Between the points of a face that are tried [m].
        grasps: Points of a face that are tried at most.
        yaws: Of the cup, that are tried.
        attempts: Of grasp, yaw, branch and height, at most.
        least_acceleration: That a grasp must bear [m/s^2].
        time_limit: So long that it decides nothing: the same question has the same answer on any machine [s].
        descent: By which an object is lowered from its place at most, until it touches something [m]; 0: it is let go there.
        above: Over its place, where this descent begins [m]; where there is no room to go down, it is let go at its place.
        optimise: Whether a plan is made quicker by trajectory optimization, see `planning/shorten.py`.
    """

    clearance: NonNegative = 0.005
    rise: NonNegative = 0.020
    lip_gap: NonNegative = 0.0005
    grasp_spacing: NonNegative = 0.012
    grasps: Annotated[int, InRange(0)] = 9
    yaws: Annotated[int, InRange(0)] = 12
    attempts: Annotated[int, InRange(0)] = 400
    least_acceleration: NonNegative = 0.3
    time_limit: NonNegative = 600.0
    descent: NonNegative = 0.0
    above: NonNegative = 0.0
    optimise: Flag = True
