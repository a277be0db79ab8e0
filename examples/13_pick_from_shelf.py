"""Pick a box from below a shelf board: from above the arm collides, from the side it does not."""

from drake_clutter import (
    PickPlacePlan,
    PickPlacePlanner,
    PlannerConfig,
    PlanningFailure,
    Pose,
    Scene,
    SceneObject,
    StationSimulation,
    load_catalog,
    load_config,
)

BOARDS = (
    "{name: table, pose: {translation: [0.0, 0.0, -0.031]}, box: [2.4, 2.4, 0.04]}",
    "{name: board, pose: {translation: [0.0, 0.28, 0.26]}, box: [0.3, 0.2, 0.02]}",
    "{name: back, pose: {translation: [0.0, 0.39, 0.135]}, box: [0.3, 0.02, 0.27]}",
)


def main() -> None:
    cell = load_config(settings=[f"cell.fixtures=[{', '.join(BOARDS)}]"]).cell
    object_class = load_catalog().classes["sugar_box"]
    height = object_class.size[2] / 2
    turned = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    box = SceneObject("sugar_box", object_class, Pose((0.0, 0.25, height), turned))
    place = Pose((0.1, -0.15, height + 0.001), turned)
    planner = PickPlacePlanner(cell, PlannerConfig())

    # The grasps of one face; without `grasp`, a plan tries those from above, then all sides.
    from_above = planner.grasps(box, (0.0, 0.0, 1.0))
    if not isinstance(from_above, PlanningFailure):
        failure = planner.plan([box], box.name, place, grasp=from_above)
        print(f"from above: {failure}")
    plan = planner.plan([box], box.name, place)
    if not isinstance(plan, PickPlacePlan):
        raise SystemExit(f"no plan: {plan} {plan.quantity}")
    x, y, z = plan.X_TO_pick.rotation @ plan.X_OG.rotation().matrix()[:, 2]
    print(f"grasped along ({x:.2f}, {y:.2f}, {z:.2f}), {plan.duration:.1f} s")
    result = StationSimulation(cell, Scene((box,), cell.support)).execute(plan)
    print(f"simulated: {result}")


if __name__ == "__main__":
    main()
