"""Move executor with a simulated arm: planning, simulation of the motion, outcome."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from drake_clutter.cell.support import Support
from drake_clutter.config import ClutterConfig, SettleConfig
from drake_clutter.planning.motion_plan import HeldObject
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.geometry import find_piles
from drake_clutter.scenes.interfaces import (
    Instability,
    InstabilityReason,
    MoveResult,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.scene import Pose, Scene, SceneObject
from drake_clutter.simulation.drake_judge import TOUCHING_MARGIN
from drake_clutter.simulation.settle import find_instability, settle
from drake_clutter.station.motion_recorder import DEFAULT_RATE
from drake_clutter.station.station_simulation import simulate_plan

MIN_DISPLACEMENT = 1e-4
"""Smallest displacement during the motion after which an object is settled again [m].

Numerical drift is smaller.
"""


class ArmExecutor:
    """Execute moves at fidelity `arm` (a `MoveExecutor`).

    A move is planned, simulated along the whole trajectory, and evaluated. Objects that were
    disturbed are settled afterwards, as `DrakeJudge` settles a scene. The scene has collapsed
    if an object exceeds the limits of displacement or tilt: the picked object relative to its
    release pose, any other relative to its pose before the move. An object that leaves the support
    is a result of its own, also if the gripper dropped it.
    """

    def __init__(
        self,
        config: ClutterConfig,
        *,
        planner_config: PlannerConfig | None = None,
        rate: float = DEFAULT_RATE,
    ) -> None:
        """Create an executor.

        Args:
            config: Work cell and settle limits.
            planner_config: Parameters of the planner; None for the defaults.
            rate: Recorded samples per second [Hz].
        """
        self._config = config
        self._rate = rate
        self._planner_config = planner_config or PlannerConfig()
        self._planner: PickPlacePlanner | None = None

    def plan(
        self, scene: Scene, command: PickPlaceCommand, exclude: Sequence[HeldObject] = ()
    ) -> PickPlacePlan | PlanningFailure:
        """Return the plan for a command, or the reason why there is none.

        Args:
            scene: Objects at rest.
            command: Move with its poses.
            exclude: Grasps that are left out.
        """
        planner = self.planner_for(scene.support)
        pick, X_TO_place = command.move.pick, command.X_TO_place
        return planner.plan(scene.objects, pick, X_TO_place, exclude=exclude)

    def planner_for(self, support: Support) -> PickPlacePlanner:
        """Return the planner for a support; the planner of the last support is cached."""
        if self._planner is None or self._planner.cell.support != support:
            self._planner = PickPlacePlanner(
                self._config.cell.with_support(support), self._planner_config
            )
        return self._planner

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Plan and simulate a command, see `MoveExecutor.execute`."""
        plan = self.plan(scene, command)
        if isinstance(plan, PlanningFailure):
            return plan.outcome(scene)
        result = simulate_plan(
            self._config.cell,
            scene,
            plan,
            rate=self._rate,
            regrip=partial(self.plan, scene, command),
            max_grips=self._planner_config.max_grips,
        )
        if not result.has_ended:
            return Outcome(MoveResult.INCONCLUSIVE, scene, detail=str(result))
        assert isinstance(result.plan, PickPlacePlan)
        # The arm lowers the object beyond its planned pose until contact.
        X_TO_place = result.plan.X_TO_place.translated((0.0, 0.0, -result.lowered_distance))
        after = scene.with_poses(result.poses)
        pick, settle = command.move.pick, self._config.settle
        if result.missed_grasp:
            outcome = evaluate_no_grasp(scene, after, pick, settle)
        else:
            outcome = evaluate_outcome(
                scene,
                after,
                pick,
                X_TO_place,
                result.lost_object,
                settle,
                is_beside=command.is_beside(scene.support),
            )
        return replace(outcome, samples=result.samples, detail=str(result))


def evaluate_outcome(
    before: Scene,
    after: Scene,
    pick: str,
    X_TO_place: Pose,
    lost_object: bool,
    config: SettleConfig,
    *,
    is_beside: bool = False,
) -> Outcome:
    """Settle the disturbed objects after an arm motion and return the outcome.

    Args:
        before: Scene at rest before the motion.
        after: Scene after the motion.
        pick: Name of the picked object.
        X_TO_place: Pose at which the object was to be released.
        lost_object: Whether the object detached from the gripper before it was released.
        config: Limits of displacement and tilt.
        is_beside: Whether the object was to be placed beside the support.
    """
    beside = {pick} if is_beside else set[str]()
    expected = before.with_poses({pick: X_TO_place})
    # An object that detaches at touchdown and stays at its place pose came off, but is not dropped.
    dropped = lost_object and worst_instability([expected[pick]], after, config, beside) is not None
    support = before.support
    # Only the move at which an object leaves the support is blamed for it.
    on_support = {o.name for o in before.objects if support.carries(o.X_TO.translation)}
    is_picked_lost = dropped and (is_beside or support.carries(after[pick].X_TO.translation))
    checked = [
        o
        for o in expected.objects
        if (not is_picked_lost if o.name == pick else o.name in on_support)
    ]
    instability = worst_instability(checked, after, config, beside)
    if instability is None and not dropped:
        disturbed = {
            o.name
            for o in before.objects
            if np.linalg.norm(after[o.name].X_TO.p - o.X_TO.p) > MIN_DISPLACEMENT
        } | {pick}
        for pile in find_piles(after.objects, TOUCHING_MARGIN):
            if not disturbed.isdisjoint(o.name for o in pile):
                after = after.with_poses(settle(pile, support, config, beside=beside).poses)
        instability = worst_instability(checked, after, config, beside)
    result = MoveResult.PLACED
    if lost_object:
        result = MoveResult.DROPPED if dropped else MoveResult.CAME_OFF
    if instability is not None:
        result = MoveResult.of_instability(instability)
    return Outcome(result, after, instability, X_TO_released=X_TO_place)


def evaluate_no_grasp(before: Scene, after: Scene, pick: str, config: SettleConfig) -> Outcome:
    """Return the outcome of a motion that was to pick an object and went back without it.

    Args:
        before: Scene at rest before the motion.
        after: Scene after the motion.
        pick: Name of the object.
        config: Limits of displacement and tilt.
    """
    outcome = evaluate_outcome(before, after, pick, before[pick].X_TO, False, config)
    if outcome.result is not MoveResult.PLACED:
        return outcome
    return replace(outcome, result=MoveResult.NOT_GRASPED, X_TO_released=None)


def worst_instability(
    expected: Sequence[SceneObject],
    after: Scene,
    config: SettleConfig,
    beside: Collection[str] = (),
) -> Instability | None:
    """Return an object that left the support, or else the largest displacement, or None.

    Args:
        expected: Objects at their expected poses.
        after: Scene with the actual poses.
        config: Limits of displacement and tilt.
        beside: Names of objects that were to be placed beside the support.
    """
    instabilities = [
        instability
        for o in expected
        if (
            instability := find_instability(
                o, after[o.name].X_TO, after.support, config, is_beside=o.name in beside
            )
        )
    ]
    return max(
        instabilities,
        key=lambda found: (found.reason is InstabilityReason.LEFT_TRAY, found.displacement),
        default=None,
    )
