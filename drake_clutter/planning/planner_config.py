"""How plans are searched."""

from typing import Annotated

from drake_clutter.validation import Flag, InRange, NonNegative, config_class, renamed_fields


@config_class
@renamed_fields(
    clearance="min_distance",
    rise="lift_height",
    grasps="max_grasps",
    yaws="num_yaws",
    attempts="max_attempts",
    least_acceleration="min_payload_acceleration",
    descent="max_guarded_descent",
    above="descent_start_offset",
    optimise="optimize",
)
class PlannerConfig:
    """How plans are searched.

    Attributes:
        min_distance: Kept from everything, but for what the held object is closer to at an end of its way [m].
        lift_height: By which the held object is lifted over what it must pass [m].
        lip_gap: Between lip and face when the vacuum is switched on [m].
        grasp_spacing: Between the points of a face that are tried [m].
        max_grasps: Points of a face that are tried at most.
        num_yaws: Of the cup, that are tried.
        max_attempts: Of grasp, yaw, branch and height, at most.
        min_payload_acceleration: That a grasp must bear [m/s^2].
        time_limit: So long that it decides nothing: the same question has the same answer on any machine [s].
        max_guarded_descent: By which an object is lowered at most, until it touches something [m]; 0: not at all.
        descent_start_offset: Over its place, where this descent begins [m]; 0 if there is no room to go down.
        optimize: Whether a plan is made quicker by trajectory optimization, see `planning/trajectory_optimization.py`.
    """

    min_distance: NonNegative = 0.005
    lift_height: NonNegative = 0.020
    lip_gap: NonNegative = 0.0005
    grasp_spacing: NonNegative = 0.012
    max_grasps: Annotated[int, InRange(0)] = 9
    num_yaws: Annotated[int, InRange(0)] = 12
    max_attempts: Annotated[int, InRange(0)] = 400
    min_payload_acceleration: NonNegative = 0.3
    time_limit: NonNegative = 600.0
    max_guarded_descent: NonNegative = 0.0
    descent_start_offset: NonNegative = 0.0
    optimize: Flag = True
