"""Closed-loop exploration: station, camera, perception, policy, planner, executor in one Diagram.

Outcomes are evaluated outside the diagram, from the true poses.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.scenes.geometry import transport_pose
from drake_clutter.scenes.interfaces import MotionSample, MoveResult, Outcome
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.station.arm_executor import evaluate_outcome
from drake_clutter.station.body_sleep import nearest_object
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.messages import PlanResponse
from drake_clutter.station.pick_place_executor import PickPlaceExecutor
from drake_clutter.station.station_simulation import StationSimulation
from drake_clutter.systems.action_filter import InfeasibleMoveFilter
from drake_clutter.systems.perception_system import (
    LabelPerception,
    PerceptionFn,
    PerceptionSystem,
    with_min_release_height,
)
from drake_clutter.systems.planner_system import PlannerSystem
from drake_clutter.systems.policy_system import PolicyPhase, PolicyState, PolicySystem
from drake_clutter.systems.station_camera import add_overhead_camera, render_empty_depth
from drake_clutter.systems.tracking import associate_detections, to_ground_truth_names
from drake_clutter.tasks.belief import Belief, Policy
from drake_clutter.tasks.exploration_task import MoveAttempt

OBSERVATION_TO_PLAN_LATENCY = 1.15
"""From an observation to the plan [s]: 0.15 for perception, 1 for planning."""
GUARDED_PLANNER_CONFIG = PlannerConfig(max_guarded_descent=0.08, descent_start_offset=0.007)
"""For objects known from images: of a box in a pile they show the top, and with a wrong class its
height is wrong; what it is to stand on may be a little higher, too."""


@dataclass(frozen=True)
class Timing:
    """How long an episode took.

    Attributes:
        simulated: Simulated [s].
        wall: On the computer [s].
        planning: Of `wall`, for all plans [s].
    """

    simulated: float
    wall: float
    planning: float


class ClosedLoop:
    """One scene and everything that searches it (a `Backend`).

    Attributes:
        scene: The true objects, as they were when the policy last looked.
        perception: What a perfect detector sees of them.
        simulation: Of the diagram.
        policy_system: Chooses the moves.
        planner_system: Plans them.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        perceive: PerceptionFn | None = None,
        seed: int,
        world: ClutterConfig,
        record_motion: bool = False,
    ) -> None:
        """Build the diagram around a scene at rest.

        Args:
            scene: The objects.
            perceive: The detector; None: the perfect one.
            seed: Of all chances.
            world: The config.
            record_motion: Whether outcomes have motions.
        """
        self.scene, self._record, self._perceive = scene, record_motion, perceive
        world = replace(world, cell=world.cell.with_support(scene.support))
        self._world = world if perceive is None else with_min_release_height(world)
        self._detector = LabelDetector(world.cell.camera)
        self.perception = self._detector.perceive(scene)
        ways = PlannerConfig() if perceive is None else GUARDED_PLANNER_CONFIG
        self._planner, empty = PickPlacePlanner(world.cell, ways), render_empty_depth(world.cell)
        self.policy_system = PolicySystem(
            config=self.config,
            seed=seed,
            tracker=None if perceive is None else associate_detections,
            action_filter=InfeasibleMoveFilter(self._pickable, empty, self.config),
        )
        self.planner_system = PlannerSystem(
            planner=self._planner, empty_depth=empty, latency=OBSERVATION_TO_PLAN_LATENCY
        )
        self.simulation = StationSimulation(
            world.cell, scene, visuals=True, add_systems=self._add_systems
        )
        self.simulation.diagram.set_name("closed_loop")
        self._planning, self._start_time = 0.0, time.perf_counter()

    def _pickable(self, known: Sequence[SceneObject]) -> set[str]:
        return {o.name for o in known if self._planner.can_pick(o, known)}

    def _add_systems(
        self, builder: DiagramBuilder, station: ClutterStation, executor: PickPlaceExecutor
    ) -> None:
        camera = add_overhead_camera(builder, station)
        perceive = self._perceive or LabelPerception(self.scene, station, self._world)
        perception = PerceptionSystem.AddToBuilder(
            builder, perceive=perceive, camera=station.cell.camera
        )
        policy = builder.AddNamedSystem("policy_system", self.policy_system)
        planner = builder.AddNamedSystem("planner_system", self.planner_system)
        for source, output, target, input_ in (
            (camera, "depth_image_32f", perception, "depth_image"),
            (camera, "color_image", perception, "color_image"),
            (station, "body_poses", perception, "body_poses"),
            (perception, "observation", policy, "observation"),
            (planner, "response", policy, "response"),
            (executor, "finished", policy, "finished"),
            (policy, "request", planner, "request"),
            (planner, "plan", executor, "plan"),
        ):
            builder.Connect(source.GetOutputPort(output), target.GetInputPort(input_))

    @property
    def config(self) -> ExplorationConfig:
        """The task's config."""
        return self._world.exploration

    @property
    def _state(self) -> PolicyState:
        context = self.policy_system.GetMyContextFromRoot(self.simulation.root)
        return self.policy_system.state(context)

    @property
    def _response(self) -> PlanResponse:
        context = self.planner_system.GetMyContextFromRoot(self.simulation.root)
        return self.planner_system.response(context)

    @property
    def belief(self) -> Belief:
        """What the policy knows now."""
        return self._state.belief

    @property
    def timing(self) -> Timing:
        """How long the episode has taken so far."""
        wall = time.perf_counter() - self._start_time
        return Timing(self.simulation.root.get_time(), wall, self._planning)

    def rollout(self, policy: Policy) -> Iterator[MoveAttempt]:
        """See `Backend.rollout`."""
        self.policy_system.policy = policy
        self._start_time = time.perf_counter()
        motion, state = list[MotionSample](), self._state
        while state.phase is not PolicyPhase.DONE:
            is_moving = self.simulation.is_executing
            self.simulation.step()
            if self._record and is_moving:
                motion.append(self.simulation.sample())
            before, state = state, self._state
            done = state.phase is PolicyPhase.DONE or state.request.number != before.request.number
            if done and before.request.number:
                yield self._attempt(before, tuple(motion))
                motion.clear()

    def _attempt(self, state: PolicyState, motion: tuple[MotionSample, ...]) -> MoveAttempt:
        """Return how a move went, once the policy has looked again.

        Args:
            state: Of the policy, before it looked.
            motion: Of the move.
        """
        before, decision, plan = self.scene, state.decision, self._response.plan
        assert decision is not None
        assert plan is not None
        self._planning += plan.planning_time
        if self._perceive is not None:
            observation = state.request.observation
            assert observation is not None
            known = state.request.objects
            decision = to_ground_truth_names(decision, known, observation, before.objects)
        if isinstance(plan, PlanningFailure):
            no_spot = plan.reason is PlanningFailureReason.NO_FREE_SPOT
            result = MoveResult.NO_FREE_PLACEMENT if no_spot else MoveResult.NOT_PLANNED
            outcome = Outcome(result, before, detail="" if no_spot else str(plan))
            return MoveAttempt(decision, outcome, self.perception)
        picked, outcome = self._outcome(plan)
        assert decision.move is not None
        decision = replace(decision, move=replace(decision.move, pick=picked))
        # The simulation goes on from where things are in it.
        self.scene = self.simulation.scene
        self.perception = self._detector.perceive(self.scene)
        return MoveAttempt(
            decision, replace(outcome, scene=self.scene, motion=motion), self.perception
        )

    def _outcome(self, plan: PickPlacePlan) -> tuple[str, Outcome]:
        """Return the name of what was picked, and what the move has led to."""
        before, after, grasp = self.scene, self.simulation.scene, self.simulation.gripper.status
        # What hung on the cup may not be what the policy took it for.
        picked = grasp.last_held or nearest_object(before.objects, plan.X_TO_pick).name
        # Seen a little off, or as what its symmetry makes alike, it is put down as far off.
        lowered = self.simulation.executor_state.lowered_distance
        X_TO_place = transport_pose(plan.X_TO_pick, plan.X_TO_place, before[picked].X_TO)
        X_TO_place = X_TO_place.translated((0.0, 0.0, -lowered))
        came_off = not grasp.has_held or grasp.lost_object
        outcome = evaluate_outcome(before, after, picked, X_TO_place, came_off, self._world.settle)
        error = float(np.linalg.norm((after[picked].X_TO.p - X_TO_place.p)[:2]))
        detail = "came off the cup" if came_off else "put down"
        detail += f", {1000 * error:.1f} mm from where it was to be"
        return picked, replace(outcome, detail=detail)
