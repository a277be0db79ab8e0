"""Move the arm along joint trajectories of your own, with the vacuum switched in between."""

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_clutter import (
    CellState,
    PlanStep,
    Pose,
    Scene,
    SceneObject,
    StationSimulation,
    default_cell,
    load_catalog,
    plan_from_steps,
    stay_at,
)


def main() -> None:
    cell = default_cell()
    can = load_catalog().classes["master_chef_can"]
    scene = Scene((SceneObject("can", can, Pose((0.0, 0.0, can.size[2] / 2))),), cell.support)

    # Any trajectory of Drake from rest to rest: the first joint turns by 0.5 rad, and back.
    home = np.array(cell.robot.home)
    turned = home + np.eye(len(home))[0] * 0.5
    rest = np.zeros_like(home)
    there, back = (
        PiecewisePolynomial.CubicWithContinuousSecondDerivatives(
            [0.0, 1.5], np.column_stack(ends), rest, rest
        )
        for ends in ((home, turned), (turned, home))
    )
    steps = (
        PlanStep("turn", there),
        PlanStep("suck", stay_at(turned, 0.5), tool="large"),
        PlanStep("turn back", back),
    )
    plan = plan_from_steps(CellState(tuple(home), scene.objects), steps)
    result = StationSimulation(cell, scene, rate=40.0).execute(plan)
    samples = result.samples
    assert samples is not None
    for k in range(0, len(samples), len(samples) // 8):
        cup = ["large", "small", "none"][samples.tool_commanded[k]]
        print(f"{samples.time[k]:.2f} s: joint 1 at {samples.q[k, 0]:.3f} rad, cup {cup}")
    print(f"largest tracking error {1000 * result.max_tracking_error:.1f} mrad")


if __name__ == "__main__":
    main()
