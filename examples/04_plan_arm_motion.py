"""Plan one pick-and-place motion, simulate it, and save the trajectory of the joints."""

from pathlib import Path

import numpy as np

from drake_clutter import (
    PickPlacePlanner,
    PlannerConfig,
    PlanningFailure,
    Pose,
    Scene,
    SceneObject,
    StationSimulation,
    default_cell,
    load_catalog,
)


def main(out: Path) -> None:
    cell = default_cell()
    sugar_box = load_catalog().classes["sugar_box"]
    height = sugar_box.size[2] / 2
    box = SceneObject("sugar_box", sugar_box, Pose((0.0, 0.0, height)))
    scene = Scene((box,), cell.support)

    planner = PickPlacePlanner(cell, PlannerConfig())
    plan = planner.plan(scene.objects, "sugar_box", Pose((0.2, -0.2, height + 0.001)))
    if isinstance(plan, PlanningFailure):
        raise SystemExit(f"no plan: {plan}")
    for segment in plan.segments:
        print(f"{segment.name}: {segment.duration:.2f} s")

    result = StationSimulation(cell, scene, rate=40.0).execute(plan)
    print(f"simulated: {result}; largest load {result.max_load_ratio:.0%} of what the cup bears")

    samples = result.samples
    assert samples is not None
    rows = [samples.time, samples.q, samples.v, samples.torque, samples.tool_commanded >= 0]
    out.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(out, np.column_stack(rows), "%.5f", delimiter=",")
    print(f"{out}: {len(samples)} samples of time, q, v, torque and vacuum")


if __name__ == "__main__":
    main(Path("out/tutorial/sugar_box.csv"))
