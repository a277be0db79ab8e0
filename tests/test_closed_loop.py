"""The closed loop: the agent's decisions on scripted answers, and a whole episode in Drake."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import DEFAULT_CELL, resting, rng, scene_of
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from drake_clutter.agents.explorers import largest_clear
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.commands.run_scenario import load_or_generate_scene as scenario_scene
from drake_clutter.commands.run_scenario import run_closed_loop, write_scenario_results
from drake_clutter.config import ClutterConfig, ExplorationConfig, upgrade_config
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
from drake_clutter.station.messages import PlannedMove, PlanRequest, PlanResponse
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


def first_allowed(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """The first object in view to the tray, if that has not failed."""
    names = [d.name for d in observation.detections]
    moves = [Move(name) for name in names if Move(name) not in belief.invalid_moves]
    return Decision(moves[0] if moves else None)


class Bench:
    """An agent alone, its inputs given by hand."""

    def __init__(self) -> None:
        self.agent = PolicySystem(policy=first_allowed, config=ExplorationConfig(), seed=0)
        self.simulator = Simulator(self.agent)
        self.time = 0.0
        self.give(BEFORE, PlanResponse(), 0)

    def give(self, observation: Observation, response: PlanResponse, finished: int) -> None:
        context = self.simulator.get_mutable_context()
        self.agent.GetInputPort("observation").FixValue(context, observation)
        self.agent.GetInputPort("response").FixValue(context, response)
        self.agent.GetInputPort("finished").FixValue(context, [finished, 0.0])

    def after(self, seconds: float) -> PolicyState:
        self.time += seconds
        self.simulator.AdvanceTo(self.time)
        return self.state(self.simulator.get_context())

    def state(self, context: Context) -> PolicyState:
        state: PolicyState = self.agent.GetOutputPort("state").Eval(context)
        return state


def a_plan() -> PickPlacePlan:
    made = PickPlacePlanner(DEFAULT_CELL, PlannerConfig(optimize=False)).plan(
        COVERED.objects,
        "cracker_box",
        Pose((0.05, 0.25, 0.031), COVERED["cracker_box"].X_TO.quaternion),
    )
    assert isinstance(made, PickPlacePlan)
    return made


def test_it_looks_waits_rests_and_looks_again() -> None:
    bench = Bench()
    state = bench.after(0.1)
    assert state.phase is PolicyPhase.WAITING
    assert (state.request.number, state.request.move) == (1, Move("cracker_box"))
    assert [o.name for o in state.belief.objects] == ["cracker_box"]
    bench.give(AFTER, PlanResponse(1, a_plan()), 0)
    assert bench.after(5.0).phase is PolicyPhase.WAITING, "the arm has not come home"
    bench.give(AFTER, PlanResponse(1, a_plan()), 1)
    state = bench.after(0.1)
    assert state.phase is PolicyPhase.OBSERVING
    assert state.belief.history == (Move("cracker_box"),)
    assert [o.name for o in state.belief.objects] == ["cracker_box"], "it has not looked yet"
    state = bench.after(0.6)
    assert state.request.number == 2
    assert {o.name: o.X_TO for o in state.belief.objects} == ASIDE.poses


def test_what_fails_is_not_asked_for_again_and_nothing_left_is_an_end() -> None:
    bench = Bench()
    bench.after(0.1)
    bench.give(BEFORE, PlanResponse(1, NO_SEAL), 0)
    state = bench.after(0.2)
    assert (state.phase, state.belief.invalid_moves) == (PolicyPhase.DONE, (Move("cracker_box"),))


def test_what_the_cup_did_not_get_is_left_alone() -> None:
    bench = Bench()
    bench.after(0.1)
    bench.give(BEFORE, PlanResponse(1, a_plan()), 1)
    state = bench.after(0.8)
    assert state.belief.history == (Move("cracker_box"),)
    assert state.belief.invalid_moves == (Move("cracker_box"),), "it is seen where it was"
    assert state.phase is PolicyPhase.DONE


def test_what_is_lost_is_forgotten() -> None:
    """And with it what failed: where it is found again, it has another name."""
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


def test_a_cloned_agent_goes_on_the_same() -> None:
    bench = Bench()
    bench.after(0.1)
    bench.give(AFTER, PlanResponse(1, NO_SEAL), 0)
    clone = Simulator(bench.agent, bench.simulator.get_context().Clone())
    state = bench.after(0.3)
    clone.AdvanceTo(bench.time)
    other = bench.state(clone.get_context())
    assert other.request.number == state.request.number == 2
    assert other.request.move == state.request.move
    assert (other.belief.history, other.phase) == (state.belief.history, state.phase)
    assert other.belief.invalid_moves == state.belief.invalid_moves


def test_what_was_seen_stays_known() -> None:
    known = Belief().update(AFTER).update(BEFORE).objects
    assert {o.name: o.X_TO for o in known} == COVERED.poses, (
        "the box under the other one is where it was seen"
    )


def test_the_planner_answers_each_request_once(monkeypatch: pytest.MonkeyPatch) -> None:
    bench, asked, plan = Bench(), list[int](), a_plan()
    request = bench.after(0.1).request

    def answer(*_: object) -> PickPlacePlan | PlanningFailure:
        asked.append(1)
        return plan if len(asked) == 1 else NO_SEAL

    planner = PickPlacePlanner(DEFAULT_CELL, PlannerConfig())
    monkeypatch.setattr(planner, "plan", answer)
    empty = render_empty_depth(DEFAULT_CELL)
    system = PlannerSystem(planner=planner, empty_depth=empty, latency=0.2)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    response, planned = system.GetOutputPort("response"), system.GetOutputPort("plan")
    system.GetInputPort("request").FixValue(context, PlanRequest())
    simulator.AdvanceTo(0.2)
    assert asked == []
    assert (response.Eval(context), planned.Eval(context)) == (PlanResponse(), PlannedMove())
    system.GetInputPort("request").FixValue(context, request)
    simulator.AdvanceTo(0.4)
    assert asked == []
    clone = Simulator(system, context.Clone())
    simulator.AdvanceTo(0.5)
    assert asked == [1]
    assert response.Eval(context) == PlanResponse(1, plan)
    assert planned.Eval(context) == PlannedMove(1, plan)
    system.GetInputPort("request").FixValue(context, replace(request, number=2))
    simulator.AdvanceTo(1.0)
    assert response.Eval(context) == PlanResponse(2, NO_SEAL)
    assert planned.Eval(context) == PlannedMove(), "the arm has nothing new to do"
    asked.clear()
    clone.AdvanceTo(0.5)
    assert planned.Eval(clone.get_context()) == PlannedMove(1, plan), "the same from a clone"
    system.GetInputPort("request").FixValue(context, replace(request, number=3, command=None))
    simulator.AdvanceTo(1.5)
    found: PlanResponse = response.Eval(context)
    assert isinstance(found.plan, PlanningFailure)
    assert (found.number, found.plan.reason) == (3, PlanningFailureReason.NO_FREE_SPOT)


def test_an_episode(config: ClutterConfig, tmp_path: Path) -> None:
    """A marker, which no cup can hold, is refused; the cover goes aside, and the box below it is found."""
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

    loop = ClosedLoop(scene, seed=0, world=config, record_motion=True)
    task = run_episode(loop, marker_first, max_moves=4)
    timing = loop.timing
    results = [step.outcome.result for step in task.transitions]
    assert results == [MoveResult.NOT_PLANNED, MoveResult.PLACED]
    assert task.transitions[0].outcome.detail == "no seal: large_marker"
    placed = task.transitions[1]
    assert (placed.move, placed.newly_found) == (Move("cracker_box"), ("gelatin_box",))
    assert placed.outcome.motion[0].arm is not None
    assert max(frame.time for frame in placed.outcome.motion) > 2
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
def test_an_episode_of_another_arm(robot: str, joints: int, config: ClutterConfig) -> None:
    cell = load_cell(resource_path(f"models/cells/{robot}_epick_tray.yaml"))
    loop = ClosedLoop(COVERED, seed=0, world=replace(config, cell=cell), record_motion=True)
    task = run_episode(loop, largest_clear, max_moves=1)
    (step,) = task.transitions
    assert (step.outcome.result, task.termination) == (
        MoveResult.PLACED,
        TerminationReason.ALL_FOUND,
    )
    arm = step.outcome.motion[0].arm
    assert arm is not None
    assert len(arm.q) == joints
    assert arm.q == pytest.approx(cell.robot.home, abs=0.01)


def test_the_last_move_that_is_allowed_may_find_everything(config: ClutterConfig) -> None:
    task, _ = run_closed_loop(Scenario(agent="largest-clear", max_moves=1), COVERED, lambda _: None)
    assert task.termination is TerminationReason.ALL_FOUND


def test_scenarios(config: ClutterConfig, tmp_path: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "closed_loop.md").read_text()
    (tmp_path / "scenario.yaml").write_text(page.split("```yaml\n")[1].split("```")[0])
    told = load_config_as(Scenario(), tmp_path / "scenario.yaml", ["arm.payload=5"], upgrade_config)
    cell = told.world.cell
    assert (cell.robot.base.translation, cell.robot.payload, cell.gripper.cup_diameter) == (
        (-0.65, 0.0, 0.3),
        5.0,
        0.015,
    )
    with pytest.raises(InputError, match="agent: full-knowledge knows more than the camera shows"):
        make_policy("full-knowledge", config)
    with pytest.raises(InputError, match=r"none\.yaml: cannot be read"):
        scenario_scene(Scenario(scene=str(tmp_path / "none.yaml")))
    move = make_policy("largest-clear", config)(Belief(), BEFORE, rng(0)).move
    assert move == Move("cracker_box")


def test_a_random_explorer_plays(config: ClutterConfig) -> None:
    task, timing = run_closed_loop(Scenario(agent="random", max_moves=1), COVERED, lambda _: None)
    assert len(task.transitions) == 1
    assert timing.simulated > 0


@pytest.mark.parametrize("descent", [0.08, 0.0])
def test_without_room_to_go_down_it_is_let_go_at_its_place(
    descent: float, config: ClutterConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        closed_loop,
        "GUARDED_PLANNER_CONFIG",
        PlannerConfig(max_guarded_descent=descent, descent_start_offset=0.007),
    )
    loop = ClosedLoop(COVERED, perceive=lambda *_: BEFORE, seed=0, world=config)
    loop.policy_system.policy = first_allowed
    request = loop.policy_system.after_observation(PolicyState(), BEFORE).request
    assert request.command is not None
    plan = loop.planner_system._plan(request)
    assert isinstance(plan, PickPlacePlan)
    above = plan.X_TO_place.translation[2] - request.command.X_TO_place.translation[2]
    assert above == pytest.approx(0.007 if descent else 0.0)
    assert (plan.max_descent >= 0.007) == (descent > 0)


def test_what_is_not_worth_trying_is_said_to_the_policy(config: ClutterConfig) -> None:
    """No cup holds the marker, the gelatin box carries it, and on neither there is room for the can."""
    given = list[Belief]()

    def policy(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        given.append(belief)
        return Decision(None)

    box = resting("gelatin_box", xy=(-0.1, 0.0))
    marker, can = (
        resting("large_marker", xy=(-0.1, 0.0), floor=box.top_height),
        resting("tomato_soup_can", xy=(0.2, 0.2)),
    )
    loop = ClosedLoop(scene_of(box, marker, can), seed=0, world=config)
    loop.policy_system.policy = policy
    observation = loop.perception.observation
    assert (
        loop.policy_system.after_observation(PolicyState(), observation).phase is PolicyPhase.DONE
    )
    allowed = set(legal_moves(observation)) - set(given[0].invalid_moves)
    assert allowed == {Move(can.name)}
