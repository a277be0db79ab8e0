"""Parameters of the pick-and-place planner."""

from drake_clutter.planning.carry_clearance import CarryClearance
from drake_clutter.validation import (
    Count,
    CountOrZero,
    Flag,
    NonNegative,
    config_class,
    renamed_fields,
)

ANY_OVERLAP = 1.0
"""Value of `PlannerConfig.max_overlap` for estimated poses [m]: objects overlap by less, even if
the class of one is wrong."""


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
    """Parameters of the pick-and-place planner.

    Attributes:
        min_distance: Smallest allowed distance between collision geometries [m]. The attached
            object may be closer to what it touches at its pick and place poses.
        lift_height: Height of the attached object above the obstacles that it passes over [m].
        lip_gap: Gap between the lip of the suction cup and the object when the vacuum is switched
            on [m].
        grasp_spacing: Spacing of the sampled grasp points on the top of the object [m].
        max_grasps: Largest number of grasp points.
        num_yaws: Number of yaw angles of the gripper for each grasp point.
        max_attempts: Largest number of combinations of grasp, yaw, inverse kinematics solution and
            transfer height.
        min_payload_acceleration: A grasp must hold the object at this acceleration in any
            direction [m/s^2].
        time_limit: Time after which planning fails [s]. The default is never reached in practice,
            so that results do not depend on the speed of the machine.
        max_grips: Largest number of grasps that are tried one after the other while the vacuum of
            a cup does not build up.
        max_guarded_descent: Largest distance by which the object is lowered below its place pose
            until contact is detected [m]. 0 disables the guarded descent.
        descent_start_offset: Height above the place pose at which the guarded descent starts [m].
            If the arm cannot descend by this much, the object is released at the place pose.
        max_overlap: Largest depth to which known objects may overlap each other or what is fixed
            [m]. Objects that lean on an edge overlap by up to 1.2 mm at rest in Drake (13 scenes of
            `benchmarks/tilted_picks.py`). Estimated poses need more, see `ANY_OVERLAP`.
        carry_clearance: Errors for which a carried object keeps a larger distance.
        optimize: Whether trajectory optimization shortens the duration of a plan.
    """

    min_distance: NonNegative = 0.005
    lift_height: NonNegative = 0.020
    lip_gap: NonNegative = 0.0005
    grasp_spacing: NonNegative = 0.012
    max_grasps: CountOrZero = 9
    num_yaws: CountOrZero = 12
    max_attempts: CountOrZero = 400
    min_payload_acceleration: NonNegative = 0.3
    time_limit: NonNegative = 600.0
    max_grips: Count = 3
    max_guarded_descent: NonNegative = 0.0
    descent_start_offset: NonNegative = 0.0
    max_overlap: NonNegative = 0.002
    carry_clearance: CarryClearance = CarryClearance()
    optimize: Flag = True
