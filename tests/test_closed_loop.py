"""Policy and planner systems with scripted inputs, and closed-loop episodes in Drake."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, ONE_CUP, cell_with, resting, rng, scene_of
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_clutter.agents.explorers import largest_clear
from drake_clutter.belief.class_belief import Touch, touch_likelihoods
from drake_clutter.catalog import ObjectClass
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.commands.run_scenario import load_or_generate_scene as scenario_scene
from drake_clutter.commands.run_scenario import run_closed_loop, write_scenario_results
from drake_clutter.config import ClutterConfig, ExplorationConfig, TouchConfig, upgrade_config
from drake_clutter.files import InputError
from drake_clutter.planning.pick_place_plan import (
    PickPlacePlan,
    PlanningFailure,
    PlanningFailureReason,
)
from drake_clutter.planning.pick_place_planner import PickPlacePlanner
from drake_clutter.planning.planner_config import PlannerConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.stability.ray_caster import RayCaster
from drake_clutter.station import station_simulation
from drake_clutter.station.messages import ExecutorStatus, PlannedMove, PlanRequest, PlanResponse
from drake_clutter.station.station_simulation import StationSimulation
from drake_clutter.systems import closed_loop
from drake_clutter.systems.closed_loop import ClosedLoop
from drake_clutter.systems.planner_system import PlannerSystem
from drake_clutter.systems.policy_system import PolicyPhase, PolicyState, PolicySystem
from drake_clutter.systems.scenario import Scenario, make_policy
from drake_clutter.systems.station_camera import render_empty_depth
from drake_clutter.tasks.belief import Belief, Decision, legal_moves
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.validation import load_config_as

COVERED = scene_of(
    resting("gelatin_box", xy=(0.05, 0.0)),
    resting("cracker_box", xy=(0.05, 0.0), floor=0.028),
)
BEFORE = RayCaster(ClutterConfig().cell.camera).observe(COVERED)[0]
ASIDE = COVERED.with_poses({"cracker_box": resting("cracker_box", xy=(0.05, 0.25)).X_TO})
NO_SEAL = PlanningFailure(PlanningFailureReason.NO_SEAL, "it")
AFTER = RayCaster(ClutterConfig().cell.camera).observe(ASIDE)[0]


def first_valid_move(
    belief: Belief, observation: Observation, rng: np.random.Generator
) -> Decision:
    """Move the first visible object to the tray for which that is valid."""
    names = [d.name for d in observation.detections]
    moves = [Move(name) for name in names if Move(name) not in belief.invalid_moves]
    return Decision(moves[0] if moves else None)


class PolicyTestBench:
    """A policy system with scripted inputs."""

    def __init__(self, max_grips: int = 1, classes: Sequence[ObjectClass] = ()) -> None:
        self.system = PolicySystem(
            policy=first_valid_move,
            config=ExplorationConfig(),
            seed=0,
            max_grips=max_grips,
            classes=classes,
        )
        self.simulator = Simulator(self.system)
        self.time = 0.0
        self.set_inputs(BEFORE, PlanResponse(), 0)

    def set_inputs(
        self,
        observation: Observation,
        response: PlanResponse,
        finished: int,
        lowered_distance: float = 0.0,
        status: ExecutorStatus | None = None,
    ) -> None:
        context = self.simulator.get_mutable_context()
        self.system.GetInputPort("observation").FixValue(context, observation)
        self.system.GetInputPort("response").FixValue(context, response)
        self.system.GetInputPort("finished").FixValue(context, [finished, lowered_distance])
        if status is not None:
            self.system.GetInputPort("status").FixValue(context, status)

    def advance(self, seconds: float) -> PolicyState:
        self.time += seconds
        self.simulator.AdvanceTo(self.time)
        return self.state(self.simulator.get_context())

    def state(self, context: Context) -> PolicyState:
        state: PolicyState = self.system.GetOutputPort("state").Eval(context)
        return state


def make_plan() -> PickPlacePlan:
    made = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False)).plan(
        COVERED.objects,
        "cracker_box",
        Pose((0.05, 0.25, 0.031), COVERED["cracker_box"].X_TO.quaternion),
    )
    assert isinstance(made, PickPlacePlan)
    return made


def test_the_policy_weighs_what_the_gripper_felt() -> None:
    """A box of 514 g hangs 2.5 mm low and touches 65 mm lower than believed: no cracker box."""
    classes = [CLASSES["cracker_box"], CLASSES["sugar_box"]]
    bench, plan = PolicyTestBench(classes=classes), make_plan()
    state = bench.advance(0.1)
    command = state.request.command
    assert command is not None
    gap = plan.X_TO_place.p[2] - command.X_TO_place.p[2] + ExplorationConfig().release_height
    status = ExecutorStatus(1, felt_mass=0.514, bellows_extension=0.0025, has_touched=True)
    lowered_distance = gap - 0.0025 + 0.065
    bench.set_inputs(AFTER, PlanResponse(1, plan), 1, lowered_distance, status)
    belief = bench.advance(0.1).belief
    expected = touch_likelihoods(
        COVERED["cracker_box"], Touch(0.514, -0.065), classes, TouchConfig()
    )
    assert belief.touch["cracker_box"] == pytest.approx(expected)
    assert expected[classes[1]] > 10 * expected[classes[0]]


def test_the_policy_waits_for_the_move_before_it_observes_again() -> None:
    bench = PolicyTestBench()
    state = bench.advance(0.1)
    assert state.phase is PolicyPhase.WAITING
    assert (state.request.number, state.request.move) == (1, Move("cracker_box"))
    assert [o.name for o in state.belief.objects] == ["cracker_box"]
    bench.set_inputs(AFTER, PlanResponse(1, make_plan()), 0)
    assert bench.advance(5.0).phase is PolicyPhase.WAITING, "the plan is not finished"
    plan = make_plan()
    bench.set_inputs(AFTER, PlanResponse(1, plan), 1, lowered_distance=0.004)
    state = bench.advance(0.1)
    assert state.phase is PolicyPhase.OBSERVING
    assert state.belief.history == (Move("cracker_box"),)
    assert [o.name for o in state.belief.objects] == ["cracker_box"], (
        "there is no new observation yet"
    )
    (believed,) = state.belief.objects
    assert believed.X_TO.p == pytest.approx(plan.X_TO_place.p - [0.0, 0.0, 0.004])
    assert believed.X_TO.quaternion == plan.X_TO_place.quaternion
    state = bench.advance(0.6)
    assert state.request.number == 2
    assert {o.name: o.X_TO for o in state.belief.objects} == ASIDE.poses


def test_another_grasp_is_requested_for_the_same_move_while_none_seals() -> None:
    bench, plan = PolicyTestBench(max_grips=2), make_plan()
    first = bench.advance(0.1)
    bench.set_inputs(BEFORE, PlanResponse(1, plan), 1, status=ExecutorStatus(1, "idle", True))
    again = bench.advance(0.1)
    assert (again.phase, again.decision) == (PolicyPhase.WAITING, first.decision)
    assert again.request == replace(first.request, number=2, tried=(plan.held,))
    bench.set_inputs(BEFORE, PlanResponse(2, plan), 2, status=ExecutorStatus(2, "idle", True))
    assert bench.advance(0.2).belief.invalid_moves == (Move("cracker_box"),)


def test_failed_moves_are_not_repeated() -> None:
    bench = PolicyTestBench()
    bench.advance(0.1)
    bench.set_inputs(BEFORE, PlanResponse(1, NO_SEAL), 0)
    state = bench.advance(0.2)
    assert (state.phase, state.belief.invalid_moves) == (PolicyPhase.DONE, (Move("cracker_box"),))


def test_moves_of_an_object_that_was_not_picked_become_invalid() -> None:
    bench = PolicyTestBench()
    bench.advance(0.1)
    bench.set_inputs(BEFORE, PlanResponse(1, make_plan()), 1)
    state = bench.advance(0.8)
    assert state.belief.history == (Move("cracker_box"),)
    assert state.belief.invalid_moves == (Move("cracker_box"),), (
        "the object is observed at its previous pose"
    )
    assert state.phase is PolicyPhase.DONE


def test_lost_objects_are_removed_from_the_belief() -> None:
    """Their invalid moves are removed, too, because they get new names when detected again."""
    failed = MoveResult.NOT_PLANNED
    belief = Belief().update(AFTER).record(Move("gelatin_box"), failed)
    belief = belief.record(Move("cracker_box"), failed)
    agent = PolicySystem(
        policy=lambda *_: Decision(None),
        config=ExplorationConfig(),
        seed=0,
        tracker=lambda known, observation: (observation, ("gelatin_box",)),
    )
    after = agent.after_observation(PolicyState(belief=belief), BEFORE).belief
    assert [o.name for o in after.objects] == ["cracker_box"]
    assert after.invalid_moves == (Move("cracker_box"),)


def test_a_cloned_context_continues_identically() -> None:
    bench = PolicyTestBench()
    bench.advance(0.1)
    bench.set_inputs(AFTER, PlanResponse(1, NO_SEAL), 0)
    clone = Simulator(bench.system, bench.simulator.get_context().Clone())
    state = bench.advance(0.3)
    clone.AdvanceTo(bench.time)
    other = bench.state(clone.get_context())
    assert other.request.number == state.request.number == 2
    assert other.request.move == state.request.move
    assert (other.belief.history, other.phase) == (state.belief.history, state.phase)
    assert other.belief.invalid_moves == state.belief.invalid_moves


def test_occluded_objects_stay_in_the_belief() -> None:
    known = Belief().update(AFTER).update(BEFORE).objects
    assert {o.name: o.X_TO for o in known} == COVERED.poses, (
        "the occluded box is where it was observed"
    )


def test_each_request_is_planned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, calls, plan = PolicyTestBench(), list[int](), make_plan()
    request = bench.advance(0.1).request

    def plan_once(*_: object, **__: object) -> PickPlacePlan | PlanningFailure:
        calls.append(1)
        return plan if len(calls) == 1 else NO_SEAL

    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    monkeypatch.setattr(planner, "plan", plan_once)
    empty = render_empty_depth(DEFAULT_CELL)
    system = PlannerSystem(planner=planner, empty_depth=empty, latency=0.2)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    response, planned = system.GetOutputPort("response"), system.GetOutputPort("plan")
    system.GetInputPort("request").FixValue(context, PlanRequest())
    simulator.AdvanceTo(0.2)
    assert calls == []
    assert (response.Eval(context), planned.Eval(context)) == (PlanResponse(), PlannedMove())
    system.GetInputPort("request").FixValue(context, request)
    simulator.AdvanceTo(0.4)
    assert calls == []
    clone = Simulator(system, context.Clone())
    simulator.AdvanceTo(0.5)
    assert calls == [1]
    assert response.Eval(context) == PlanResponse(1, plan)
    assert planned.Eval(context) == PlannedMove(1, plan)
    system.GetInputPort("request").FixValue(context, replace(request, number=2))
    simulator.AdvanceTo(1.0)
    assert response.Eval(context) == PlanResponse(2, NO_SEAL)
    assert planned.Eval(context) == PlannedMove(), "there is no new plan"
    calls.clear()
    clone.AdvanceTo(0.5)
    assert planned.Eval(clone.get_context()) == PlannedMove(1, plan), (
        "a cloned context gives the same plan"
    )
    system.GetInputPort("request").FixValue(context, replace(request, number=3, command=None))
    simulator.AdvanceTo(1.5)
    found: PlanResponse = response.Eval(context)
    assert isinstance(found.plan, PlanningFailure)
    assert (found.number, found.plan.reason) == (3, PlanningFailureReason.NO_FREE_PLACEMENT)


def test_a_closed_loop_episode(config: ClutterConfig, tmp_path: Path) -> None:
    """A large cup holds no marker; moving the upper box reveals the lower one."""
    config = replace(config, cell=cell_with(ONE_CUP))
    scene = Scene((*COVERED.objects, resting("large_marker", xy=(-0.2, -0.2))), COVERED.support)
    names = list[str]()

    def marker_first(
        belief: Belief,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Decision:
        names.append(",".join(o.name for o in belief.objects))
        if not belief.history:
            return Decision(Move("large_marker"))
        return largest_clear(belief, observation, rng)

    loop = ClosedLoop(scene, seed=0, config=config, rate=40.0)
    task = run_episode(loop, marker_first, max_moves=4)
    timing = loop.timing
    results = [step.outcome.result for step in task.transitions]
    assert results == [MoveResult.NOT_PLANNED, MoveResult.PLACED]
    assert task.transitions[0].outcome.detail == "no seal: large_marker"
    placed = task.transitions[1]
    assert (placed.move, placed.newly_found) == (Move("cracker_box"), ("gelatin_box",))
    assert placed.outcome.samples is not None
    assert placed.outcome.samples.time[-1] > 2
    assert np.abs(placed.outcome.samples.v[[0, -1]]).max() < 1e-3, "at rest at both ends"
    assert task.termination is TerminationReason.ALL_FOUND
    assert names == ["cracker_box,large_marker"] * 2 + ["cracker_box,large_marker,gelatin_box"]
    assert 3 < timing.simulated < 15
    fields = write_scenario_results(
        tmp_path, Scenario(agent="largest-clear"), task, timing, "A test"
    )
    assert (fields["success"], fields["termination"]) == (True, "all found")
    assert json.loads((tmp_path / "episode.json").read_text()) == json.loads(json.dumps(fields))
    assert {path.name for path in tmp_path.iterdir()} >= {
        "index.html",
        "episode.json",
        "trajectory.h5",
        "scenario.yaml",
    }
    page = (tmp_path / "index.html").read_text()
    assert "The motion of the arm and of all objects is simulated." in page
    assert all(f"images/move_02_arm_{number}.png" in page for number in (1, 2, 3, 4))


@pytest.mark.parametrize(("robot", "joints"), [("ur5e", 6), ("ur10e", 6), ("iiwa14", 7)])
def test_a_closed_loop_episode_with_another_arm(
    robot: str, joints: int, config: ClutterConfig
) -> None:
    cell = load_cell(resource_path(f"models/cells/{robot}_epick_tray.yaml"))
    objects = (
        resting("gelatin_box", xy=(0.1, 0.0)),
        resting("cracker_box", xy=(0.1, 0.0), floor=0.028),
    )
    scene = Scene(objects, cell.support)  # Each arm reaches its own tray.
    loop = ClosedLoop(scene, seed=0, config=replace(config, cell=cell), rate=40.0)
    task = run_episode(loop, largest_clear, max_moves=1)
    (step,) = task.transitions
    assert (step.outcome.result, task.termination) == (
        MoveResult.PLACED,
        TerminationReason.ALL_FOUND,
    )
    samples = step.outcome.samples
    assert samples is not None
    assert samples.q.shape[1] == joints
    assert samples.q[0] == pytest.approx(cell.robot.home, abs=1e-6)


def test_a_motion_that_the_diagram_skips_ends_as_one_that_it_simulates(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scenario = Scenario(agent="largest-clear", max_moves=1)
    skipped, timing = run_closed_loop(scenario, COVERED, lambda _: None)
    monkeypatch.setattr(station_simulation, "MAX_COARSE_DISPLACEMENT", -1.0)
    monkeypatch.setattr(StationSimulation, "skip_until", lambda *_: None)
    simulated, other_timing = run_closed_loop(scenario, COVERED, lambda _: None)
    first, second = (task.transitions[0].outcome for task in (skipped, simulated))
    assert first.result is second.result is MoveResult.PLACED
    assert timing.simulated == pytest.approx(other_timing.simulated, abs=1e-9)
    for name, X_TO in first.scene.poses.items():
        assert X_TO.p == pytest.approx(second.scene.poses[name].p, abs=1e-3)
    assert first.samples is not None
    assert second.samples is not None
    assert (first.samples.time_step, second.samples.time_step) == (0.005, 0.0025)
    assert first.samples.q[-1] == pytest.approx(second.samples.q[-1], abs=1e-4)


def test_the_last_allowed_move_can_reveal_all_objects(config: ClutterConfig) -> None:
    task, _ = run_closed_loop(Scenario(agent="largest-clear", max_moves=1), COVERED, lambda _: None)
    assert task.termination is TerminationReason.ALL_FOUND


SCENARIO = """
generator: sg-star
agent: student
perception: labels
objects: ycb7
max_moves: 20
world: {cell: {gripper: {cup_diameter: 0.015}, cameras: {overhead: {depth_noise: false}}}}
"""


def test_scenario_files_and_invalid_scenarios(config: ClutterConfig, tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text(SCENARIO)
    scenario = load_config_as(
        Scenario(), tmp_path / "scenario.yaml", ["arm.payload=5"], upgrade_config
    )
    cell = scenario.world.cell
    assert (cell.robot.base.translation, cell.robot.payload, cell.gripper.description) == (
        (-0.65, 0.0, 0.3),
        5.0,
        "suction, 15 mm",
    )
    with pytest.raises(InputError, match="agent: full-knowledge uses the true state"):
        make_policy("full-knowledge", config)
    with pytest.raises(InputError, match=r"none\.yaml: cannot be read"):
        scenario_scene(Scenario(scene=str(tmp_path / "none.yaml")))
    move = make_policy("largest-clear", config)(Belief(), BEFORE, rng(0)).move
    assert move == Move("cracker_box")


def test_an_episode_of_the_random_explorer(config: ClutterConfig) -> None:
    task, timing = run_closed_loop(Scenario(agent="random", max_moves=1), COVERED, lambda _: None)
    assert len(task.transitions) == 1
    assert timing.simulated > 0


@pytest.mark.parametrize("descent", [0.08, 0.0])
def test_without_a_guarded_descent_objects_are_released_at_the_placement_pose(
    descent: float, config: ClutterConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        closed_loop,
        "GUARDED_PLANNER_CONFIG",
        PlannerConfig(max_guarded_descent=descent, descent_start_offset=0.007),
    )
    loop = ClosedLoop(COVERED, perceive=lambda *_: BEFORE, seed=0, config=config)
    loop.policy_system.policy = first_valid_move
    request = loop.policy_system.after_observation(PolicyState(), BEFORE).request
    assert request.command is not None
    plan = loop.planner_system._plan(request)
    assert isinstance(plan, PickPlacePlan)
    above = plan.X_TO_place.translation[2] - request.command.X_TO_place.translation[2]
    assert above == pytest.approx(0.007 if descent else 0.0)
    assert (plan.max_descent >= 0.007) == (descent > 0)


def test_infeasible_moves_are_invalid_for_the_policy(config: ClutterConfig) -> None:
    """A large cup holds no marker, the box supports it, and neither has room for the can."""
    config = replace(config, cell=cell_with(ONE_CUP))
    beliefs = list[Belief]()

    def policy(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        beliefs.append(belief)
        return Decision(None)

    box = resting("gelatin_box", xy=(-0.1, 0.0))
    marker, can = (
        resting("large_marker", xy=(-0.1, 0.0), floor=box.top_height),
        resting("tomato_soup_can", xy=(0.2, 0.2)),
    )
    loop = ClosedLoop(scene_of(box, marker, can), seed=0, config=config)
    loop.policy_system.policy = policy
    observation = loop.perception.observation
    assert (
        loop.policy_system.after_observation(PolicyState(), observation).phase is PolicyPhase.DONE
    )
    allowed = set(legal_moves(observation)) - set(beliefs[0].invalid_moves)
    assert allowed == {Move(can.name)}
