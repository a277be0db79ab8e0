"""Pick a box, hold it up, put it down and go home: parts of a motion, each planned by itself."""

import numpy as np
from pydrake.math import RigidTransform

from drake_clutter import (
    MotionPlan,
    PickPlacePlanner,
    PlannerConfig,
    PlanningFailure,
    Pose,
    Scene,
    SceneObject,
    StationSimulation,
    concatenate_plans,
    default_cell,
    load_catalog,
)


def planned(plan: MotionPlan | PlanningFailure) -> MotionPlan:
    """Return a plan, or stop with the reason why there is none."""
    if isinstance(plan, PlanningFailure):
        raise SystemExit(f"no plan: {plan} {plan.quantity}")
    return plan


def main() -> None:
    cell = default_cell()
    sugar_box = load_catalog().classes["sugar_box"]
    height = sugar_box.size[2] / 2
    box = SceneObject("sugar_box", sugar_box, Pose((0.0, 0.0, height)))
    planner = PickPlacePlanner(cell, PlannerConfig())

    # Each part starts in the state in which the previous one ends.
    pick = planned(planner.plan_pick(planner.home_state([box]), "sugar_box", lift_height=0.05))
    X_TG = planner.tools["large"].pose(np.array(pick.end.q))
    X_TG[2, 3] += 0.1
    show = planned(planner.plan_move(pick.end, RigidTransform(X_TG)))
    hold = planner.plan_hold(show.end, 0.5)
    place = planned(planner.plan_place(hold.end, Pose((0.2, -0.2, height + 0.001))))
    home = planned(planner.plan_move(place.end, cell.robot.home))

    whole = concatenate_plans([pick, show, hold, place, home])
    for step in whole.steps:
        print(f"{step.name}: {step.duration:.2f} s{f', {step.tool} cup on' if step.tool else ''}")
    result = StationSimulation(cell, Scene((box,), cell.support)).execute(whole)
    print(f"simulated {result.simulated_time:.1f} s: {result}")


if __name__ == "__main__":
    main()
