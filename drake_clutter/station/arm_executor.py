"""Moves by the arm: planned, simulated through the whole trajectory, and judged by what happened."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig, SettleConfig
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.geometry import group_touching_objects
from drake_clutter.scenes.interfaces import Instability, MoveResult, Outcome, PickPlaceCommand
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import find_instability, settle
from drake_clutter.station.station_simulation import StationSimulation

MIN_DISPLACEMENT = 1e-4
"""m; what moved less is not settled again."""


class ArmExecutor:
    """Carries out a move at fidelity `arm` (a `MoveExecutor`): planned, simulated through the whole trajectory, and judged.

    What the motion touched is settled afterwards as the judge settles. A scene has collapsed when any object but the picked one
    has moved or turned past the limits, or the picked one past them from where it was let go.
    """

    def __init__(
        self, config: ClutterConfig, *, planner_config: PlannerConfig | None = None
    ) -> None:
        """Makes an executor."""
        self._config = config
        self._planner_config = planner_config or PlannerConfig()
        self._planner: PickPlacePlanner | None = None

    def plan(self, scene: Scene, command: PickPlaceCommand) -> PickPlacePlan | PlanningFailure:
        """Return the plan for a command, or why there is none."""
        planner = self.planner_for(scene.support)
        return planner.plan(scene.objects, command.move.pick, command.X_TO_place)

    def planner_for(self, support: Support) -> PickPlacePlanner:
        """For a tray; kept."""
        if self._planner is None or self._planner.cell.support != support:
            self._planner = PickPlacePlanner(
                self._config.cell.with_support(support), self._planner_config
            )
        return self._planner

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """See `MoveExecutor.execute`."""
        plan = self.plan(scene, command)
        if isinstance(plan, PlanningFailure):
            return Outcome(MoveResult.NOT_PLANNED, scene, detail=str(plan))
        simulated = StationSimulation(self._config.cell, scene).execute(plan, record=True)
        X_TO_place = plan.X_TO_place.translated((0.0, 0.0, -simulated.lowered_distance))
        after, pick = scene.with_poses(simulated.poses), command.move.pick
        outcome = evaluate_outcome(
            scene, after, pick, X_TO_place, simulated.lost_object, self._config.settle
        )
        return replace(outcome, motion=simulated.motion, detail=str(simulated))


def evaluate_outcome(
    before: Scene,
    after: Scene,
    pick: str,
    X_TO_place: Pose,
    lost_object: bool,
    config: SettleConfig,
) -> Outcome:
    """What a motion of the arm has led to: what it touched is settled, and everything compared with where it should be.

    Args:
        before, after: the scene, at rest and after the motion.
        pick: what was picked; X_TO_place: where it was to be let go; lost_object: whether it came off the cup on the way.
        config: the limits.
    """
    put = before.with_poses({pick: X_TO_place})
    # What comes off the cup only as it touches down, and stays there, has been put down.
    dropped = lost_object and worst_instability([put[pick]], after, config) is not None
    others = [o for o in put.objects if o.name != pick or not dropped]
    instability = worst_instability(others, after, config)
    if instability is None and not dropped:
        moved = {
            o.name
            for o in before.objects
            if np.linalg.norm(after[o.name].X_TO.p - o.X_TO.p) > MIN_DISPLACEMENT
        } | {pick}
        for group in group_touching_objects(after.objects, TOUCHING_MARGIN):
            if not moved.isdisjoint(o.name for o in group):
                after = after.with_poses(settle(group, before.support, config).poses)
        instability = worst_instability(others, after, config)
    result = MoveResult.DROPPED if dropped else MoveResult.PLACED
    if instability is not None:
        result = MoveResult.COLLAPSED
    return Outcome(result, after, instability, X_TO_released=X_TO_place)


def worst_instability(
    expected: Sequence[SceneObject], after: Scene, config: SettleConfig
) -> Instability | None:
    """Of the objects that did not stay where they were, the one that went furthest."""
    found = [
        fall
        for o in expected
        if (fall := find_instability(o, after[o.name].X_TO, after.support, config))
    ]
    return max(found, key=lambda fall: fall.displacement, default=None)
