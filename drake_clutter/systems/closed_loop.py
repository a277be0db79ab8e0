"""Closed-loop exploration as one Drake Diagram.

The diagram contains the station, camera, perception, policy, planner and executor. Outcomes are
evaluated outside of it, from the true poses.
"""

import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from drake_clutter.catalog import ObjectClass
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.planning.carry_clearance import CarryClearance
from drake_clutter.planning.pick_place_plan import PickPlacePlan, PlanningFailure
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import ANY_OVERLAP, PlannerConfig
from drake_clutter.scenes.action_samples import ActionSamples
from drake_clutter.scenes.geometry import transport_pose
from drake_clutter.scenes.interfaces import Outcome
from drake_clutter.scenes.scene import Scene, SceneObject
from drake_clutter.station.arm_executor import evaluate_no_grasp, evaluate_outcome
from drake_clutter.station.body_sleep import nearest_object
from drake_clutter.station.clutter_station import ClutterStation
from drake_clutter.station.messages import PlanResponse
from drake_clutter.station.pick_place_executor import PickPlaceExecutor
from drake_clutter.station.station_simulation import StationSimulation, simulate_coarsely
from drake_clutter.systems.action_filter import InfeasibleMoveFilter
from drake_clutter.systems.perception_system import (
    LabelPerception,
    PerceptionFn,
    PerceptionSystem,
    with_image_tolerances,
)
from drake_clutter.systems.planner_system import PlannerSystem
from drake_clutter.systems.policy_system import PolicyPhase, PolicyState, PolicySystem
from drake_clutter.systems.station_camera import add_overhead_camera, render_empty_depth
from drake_clutter.systems.tracking import associate_detections, to_ground_truth_names
from drake_clutter.tasks.belief import Belief, Decision, Policy
from drake_clutter.tasks.exploration_task import MoveAttempt

OBSERVATION_TO_PLAN_LATENCY = 1.15
"""Simulated time from an observation to its plan [s]: 0.15 for perception, 1 for planning."""
GUARDED_PLANNER_CONFIG = PlannerConfig(
    max_overlap=ANY_OVERLAP,
    max_guarded_descent=0.08,
    descent_start_offset=0.007,
    carry_clearance=CarryClearance(position_uncertainty=0.0055, height_uncertainty=0.007),
)
"""Planner config for poses from images, with a guarded descent before the release.

Images show only the top of a box in a pile, so its height is wrong if its class is. The detected
height of the support is inaccurate, too. Detected objects may overlap. 95 % of the positions of the
shipped detector are within 5.5 mm.
"""


def default_planner_config(from_images: bool) -> PlannerConfig:
    """Return the planner config for poses from images, or for true poses."""
    return GUARDED_PLANNER_CONFIG if from_images else PlannerConfig()


@dataclass(frozen=True)
class Timing:
    """Duration of an episode.

    Attributes:
        simulated: Simulated time [s].
        wall: Wall-clock time [s].
        planning: Wall-clock time of all planning, part of `wall` [s].
    """

    simulated: float
    wall: float
    planning: float


class ClosedLoop:
    """Closed-loop simulation of the exploration of one scene (a `Backend`).

    Attributes:
        scene: True objects at the time of the policy's latest observation.
        perception: Ground-truth perception of that scene.
        simulation: Simulation of the diagram.
        policy_system: System that chooses the moves.
        planner_system: System that plans the moves.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        perceive: PerceptionFn | None = None,
        seed: int,
        config: ClutterConfig,
        planner_config: PlannerConfig | None = None,
        rate: float | None = None,
        classes: Sequence[ObjectClass] = (),
    ) -> None:
        """Build the diagram around a scene at rest.

        Args:
            scene: Objects at rest.
            perceive: Detector; None: ground truth.
            seed: Seed of all random numbers.
            config: Config of the cell, the simulation and the task.
            planner_config: Parameters of the planner; None: `default_planner_config`.
            rate: Recorded samples of motions per second [Hz]; None records nothing.
            classes: Classes of the objects, between which the gripper's touch decides; none if
                the detector is certain of them.
        """
        self.scene = scene
        self._perceive = perceive
        self._rate = rate
        config = replace(config, cell=config.cell.with_support(scene.support))
        self._config = config if perceive is None else with_image_tolerances(config)
        self._detector = LabelDetector(config.cell.camera)
        self.perception = self._detector.perceive(scene)
        if planner_config is None:
            planner_config = default_planner_config(perceive is not None)
        self._planner = PickPlacePlanner(config.cell, planner_config)
        empty_depth = render_empty_depth(config.cell)
        self.policy_system = PolicySystem(
            config=self.config,
            seed=seed,
            tracker=None if perceive is None else associate_detections,
            action_filter=InfeasibleMoveFilter(self._pickable, empty_depth, self.config),
            max_grips=planner_config.max_grips,
            classes=classes,
        )
        self.planner_system = PlannerSystem(
            planner=self._planner,
            empty_depth=empty_depth,
            latency=OBSERVATION_TO_PLAN_LATENCY,
        )
        self.simulation = StationSimulation(
            config.cell, scene, visuals=True, add_systems=self._add_systems, rate=rate
        )
        self.simulation.diagram.set_name("closed_loop")
        self._planning_time = 0.0
        self._start_time = time.perf_counter()

    def _pickable(self, known: Sequence[SceneObject]) -> set[str]:
        """Return the names of objects that the arm can pick; see `PickableFn`."""
        return {o.name for o in known if self._planner.can_pick(o, known)}

    def _add_systems(
        self, builder: DiagramBuilder, station: ClutterStation, executor: PickPlaceExecutor
    ) -> None:
        camera = add_overhead_camera(builder, station)
        perceive = self._perceive or LabelPerception(self.scene, station, self._config)
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
            (executor, "status", policy, "status"),
            (policy, "request", planner, "request"),
            (planner, "plan", executor, "plan"),
        ):
            builder.Connect(source.GetOutputPort(output), target.GetInputPort(input_))

    @property
    def config(self) -> ExplorationConfig:
        """Config of the task."""
        return self._config.exploration

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
        """Current belief of the policy."""
        return self._state.belief

    @property
    def timing(self) -> Timing:
        """Duration of the episode so far."""
        wall = time.perf_counter() - self._start_time
        return Timing(self.simulation.root.get_time(), wall, self._planning_time)

    def rollout(self, policy: Policy) -> Generator[MoveAttempt, None, Decision]:
        """Run a policy, and yield each attempt after the following observation."""
        self.policy_system.policy = policy
        self._start_time = time.perf_counter()
        samples: ActionSamples | None = None
        state, response = self._state, self._response
        while state.phase is not PolicyPhase.DONE:
            samples = self._advance() or samples
            previous, state = state, self._state
            if self._response.number != response.number:
                response = self._response
                self._planning_time += response.plan.planning_time if response.plan else 0.0
            is_done = state.phase is PolicyPhase.DONE
            # A request for another grasp follows from the same decision.
            has_observed = is_done or state.decision is not previous.decision
            if has_observed and previous.request.number:
                yield self._attempt(previous, samples)
                samples = None
        decision = state.decision
        assert decision is not None
        if self._perceive is not None:
            known = self.belief.objects
            decision = to_ground_truth_names(decision, known, None, self.scene.objects)
        return decision

    def _advance(self) -> ActionSamples | None:
        """Advance by a step or over a whole motion; return the samples of one that has ended.

        A motion is simulated coarsely at first, in a simulation of its own. If it is uneventful,
        the diagram continues at its end. Otherwise, the diagram simulates it.
        """
        simulation = self.simulation
        plan = simulation.executor_state.plan
        if isinstance(plan, PickPlacePlan) and simulation.has_just_started:
            motion = simulate_coarsely(simulation.cell, simulation.scene, plan, rate=self._rate)
            result = motion.execute_while_uneventful(
                plan, lambda: [self._expected_object(plan, motion)]
            )
            if not motion.is_asleep:
                result = None
            if result is not None:
                simulation.take_over(motion)
            motion.release()
            if result is not None:
                return result.samples
        if simulation.is_idle:
            simulation.skip_until(self._next_action_time())
        simulation.step()
        return self._take_samples()

    def _next_action_time(self) -> float:
        """Return a time before which policy and planner only wait [s]."""
        state = self._state
        if state.phase is PolicyPhase.OBSERVING:
            return state.observation_time
        context = self.planner_system.GetMyContextFromRoot(self.simulation.root)
        return self.planner_system.response_time(context)

    def _take_samples(self) -> ActionSamples | None:
        """Return the samples of a motion that has ended; None if none has, or without a rate."""
        recorder = self.simulation.recorder
        if recorder is None or not self.simulation.is_at_rest:
            return None
        samples = self.simulation.recorded_samples()
        recorder.clear()
        return samples

    def _attempt(self, state: PolicyState, samples: ActionSamples | None) -> MoveAttempt:
        """Return the attempt that ended before the policy's latest observation.

        Args:
            state: State of the policy before that observation.
            samples: Recorded motion of the attempt; None if there was none.
        """
        before = self.scene
        decision = state.decision
        plan = self._response.plan
        assert decision is not None
        assert plan is not None
        if self._perceive is not None:
            observation = state.request.observation
            assert observation is not None
            known = state.request.objects
            decision = to_ground_truth_names(decision, known, observation, before.objects)
        if isinstance(plan, PlanningFailure) and not state.request.tried:
            return MoveAttempt(decision, plan.outcome(before), self.perception)
        assert decision.move is not None
        if isinstance(plan, PlanningFailure) or self.simulation.executor_state.missed_grasp:
            picked = decision.move.pick
            outcome = evaluate_no_grasp(before, self.simulation.scene, picked, self._config.settle)
            outcome = replace(outcome, detail="the gripper did not hold it")
        else:
            picked, outcome = self._outcome(plan)
        decision = replace(decision, move=replace(decision.move, pick=picked))
        # The true poses of the simulation are the next move's initial ones.
        self.scene = self.simulation.scene
        self.perception = self._detector.perceive(self.scene)
        return MoveAttempt(
            decision, replace(outcome, scene=self.scene, samples=samples), self.perception
        )

    def _expected_object(self, plan: PickPlacePlan, simulation: StationSimulation) -> SceneObject:
        """Return the object that a simulation has picked, at the pose at which it should be.

        Args:
            plan: Plan that was executed.
            simulation: Simulation that has executed it from `scene`.
        """
        before = self.scene
        # The object on the cup may differ from the object that the policy meant to pick.
        last_held = simulation.gripper.status.last_held
        name = last_held or nearest_object(before.objects, plan.X_TO_pick).name
        # The detected pose may differ from the true one by an error or by a symmetry, and the
        # object is placed with the same difference.
        X_TO_place = transport_pose(plan.X_TO_pick, plan.X_TO_place, before[name].X_TO)
        lowered_distance = simulation.executor_state.lowered_distance
        return replace(before[name], X_TO=X_TO_place.translated((0.0, 0.0, -lowered_distance)))

    def _outcome(self, plan: PickPlacePlan) -> tuple[str, Outcome]:
        """Return the name of the object that was picked, and the outcome of its move."""
        before = self.scene
        after = self.simulation.scene
        grasp = self.simulation.gripper.status
        expected = self._expected_object(plan, self.simulation)
        picked, X_TO_place = expected.name, expected.X_TO
        lost_object = not grasp.has_held or grasp.lost_object
        outcome = evaluate_outcome(
            before, after, picked, X_TO_place, lost_object, self._config.settle
        )
        error = float(np.linalg.norm((after[picked].X_TO.p - X_TO_place.p)[:2]))
        result = "came off the gripper" if lost_object else "placed"
        detail = f"{result} with a horizontal error of {1000 * error:.1f} mm"
        return picked, replace(outcome, detail=detail)
