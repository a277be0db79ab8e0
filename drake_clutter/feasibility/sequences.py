"""Whole searches: which scenes an arm can search to the end, in how many minutes."""

from dataclasses import dataclass, fields, replace

import numpy as np

from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.interfaces import MoveExecutor, MoveResult, Outcome, PickPlaceCommand
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.hybrid import HybridExecutor
from drake_clutter.station.arm_executor import ArmExecutor
from drake_clutter.station.command_schedule import build_command_schedule
from drake_clutter.tasks.episode import SteppedBackend, run_episode
from drake_clutter.tasks.exploration_task import TerminationReason


@dataclass(frozen=True)
class SequenceRecord:
    """One search of a scene with one arm; a row of `sequences.csv`.

    Attributes:
        setup: Name of the work cell.
        scene: Name of the scene file.
        agent: Name of the exploration policy.
        simulated: Whether the motions were simulated; else they were planned alone.
        hidden: Number of objects that are hidden at the start.
        found: Number of these that were found.
        moves: Number of attempted moves.
        not_planned: Number of these without a plan.
        minutes: Duration of the motions with the dwells of the gripper [min].
        ended: How the search ended: a `TerminationReason`, or `gave up`.
    """

    setup: str
    scene: str
    agent: str
    simulated: bool
    hidden: int
    found: int
    moves: int
    not_planned: int
    minutes: float
    ended: str


SEQUENCE_RECORD_FIELDS = {field.name: field.type for field in fields(SequenceRecord)}
"""Columns of `sequences.csv`, with their types."""


class PlannedExecutor:
    """Executor that plans every move, and teleports the object if there is a plan.

    Attributes:
        robot_time: Duration of all motions so far, with the dwells of the gripper [s].
    """

    def __init__(self, config: ClutterConfig, planner_config: PlannerConfig) -> None:
        """Create an executor.

        Args:
            config: Configuration of the simulated world with the work cell.
            planner_config: Parameters of the planner.
        """
        self._planner = PickPlacePlanner(config.cell, planner_config)
        self._executor = HybridExecutor(config, simulate_collapse=False)
        self.robot_time = 0.0

    def execute(self, scene: Scene, command: PickPlaceCommand, rng: np.random.Generator) -> Outcome:
        """Plan and teleport, see `MoveExecutor.execute`."""
        plan = self._planner.plan(scene.objects, command.move.pick, command.X_TO_place)
        if isinstance(plan, PlanningFailure):
            return plan.outcome(scene)
        self.robot_time += build_command_schedule(plan, self._planner.cell).end_time
        return self._executor.execute(scene, command, rng)


def search_scene(
    setup: str,
    name: str,
    scene: Scene,
    config: ClutterConfig,
    agent: str,
    *,
    simulate: bool,
    seed: int,
) -> SequenceRecord:
    """Search a scene to the end with one arm.

    Args:
        setup: Name of the work cell in the record.
        name: Name of the scene in the record.
        scene: The scene, at rest.
        config: Configuration of the simulated world with the work cell.
        agent: Name of an exploration policy, see `make_policy_factory`.
        simulate: Whether the motions are simulated.
        seed: Seed of the policy, the placements and the outcomes.
    """
    config = replace(config, cell=config.cell.with_support(scene.support))
    planned = PlannedExecutor(config, PlannerConfig())
    executor: MoveExecutor = ArmExecutor(config) if simulate else planned
    detector = LabelDetector(config.cell.camera)
    backend = SteppedBackend(executor, detector, config.exploration, scene, item_rng(seed))
    policy = make_policy_factory(agent, config)(backend)
    task = run_episode(backend, policy, max_moves=config.exploration.max_moves)
    outcomes = [transition.outcome for transition in task.transitions]
    robot_time = planned.robot_time
    if simulate:
        samples = [outcome.samples for outcome in outcomes if outcome.samples is not None]
        robot_time = sum(float(motion.time[-1]) for motion in samples)
    return SequenceRecord(
        setup=setup,
        scene=name,
        agent=agent,
        simulated=simulate,
        hidden=len(task.initially_hidden),
        found=len(task.found),
        moves=len(outcomes),
        not_planned=sum(outcome.result is MoveResult.NOT_PLANNED for outcome in outcomes),
        minutes=round(robot_time / 60, 4),
        ended=(task.termination or TerminationReason.GAVE_UP).value,
    )
