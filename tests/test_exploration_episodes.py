"""Exploration episodes with scripted and real outcomes, beliefs and baseline policies."""

from collections import Counter
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, resting, rng, scene_of

from drake_clutter.agents.explorers import (
    BASELINE_POLICIES,
    largest_clear,
    largest_first,
    random_explorer,
)
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import (
    Detection,
    Instability,
    InstabilityReason,
    Move,
    MoveExecutor,
    MovePart,
    MoveResult,
    Observation,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.tasks.belief import Belief, Decision, Policy, legal_moves, select_move
from drake_clutter.tasks.episode import SteppedBackend, make_teleport_backend_factory, run_episode
from drake_clutter.tasks.exploration_task import (
    ExplorationTask,
    MoveAttempt,
    StopCriterion,
    TerminationReason,
    Transition,
)

# Two covers, one with two objects below it, one with one; and a marker in the open.
HIDING = scene_of(
    resting("gelatin_box", xy=(-0.2, -0.050), name="g1"),
    resting("gelatin_box", xy=(-0.2, 0.050), name="g2"),
    resting("cracker_box", xy=(-0.2, 0.0), floor=0.028, name="cover 1"),
    resting("pudding_box", xy=(0.2, 0.0), name="p"),
    resting("cracker_box", xy=(0.2, 0.0), floor=0.035, name="cover 2"),
    resting("large_marker", xy=(0.0, 0.3), name="marker"),
)
ASIDE = {"cover 1": (-0.2, 0.25), "cover 2": (0.2, 0.25)}
REWARDS = ExplorationConfig(detection_reward=2.0, collapse_penalty=-5.0)


class Scripted:
    """Executor that moves the picked cover aside, or returns scripted results."""

    def __init__(self, *results: MoveResult) -> None:
        self._results = iter(results)

    def execute(
        self,
        scene: Scene,
        command: PickPlaceCommand,
        generator: np.random.Generator,
    ) -> Outcome:
        result = next(self._results)
        self.command = command
        if not result.was_executed:
            return Outcome(result, scene)
        pick = command.move.pick
        moved = scene.with_poses({pick: resting("cracker_box", xy=ASIDE[pick]).X_TO})
        fallen = (
            Instability(InstabilityReason.SLID, "g1", 0.02, 0.0) if result.ends_episode else None
        )
        return Outcome(result, moved, fallen)


class Episode:
    """An episode on a backend, stepped move by move."""

    def __init__(
        self,
        executor: MoveExecutor,
        detector: LabelDetector,
        max_moves: int = 10,
    ) -> None:
        self.backend = SteppedBackend(executor, detector, REWARDS, HIDING, rng())
        self.task = ExplorationTask(HIDING, self.backend.perception, REWARDS, max_moves)

    def step(self, move: Move) -> Transition:
        outcome = self.backend.step(move)
        self.backend.update_belief()
        return self.task.record(MoveAttempt(Decision(move), outcome, self.backend.perception))


def episode(detector: LabelDetector, *results: MoveResult, max_moves: int = 10) -> Episode:
    return Episode(Scripted(*results), detector, max_moves)


def test_rewards_and_record_of_a_successful_episode(detector: LabelDetector) -> None:
    game = episode(detector, MoveResult.PLACED, MoveResult.NO_FREE_PLACEMENT, MoveResult.PLACED)
    task = game.task
    at_first = task.detected
    assert at_first == ("cover 1", "cover 2", "marker")
    assert task.initially_hidden == ("g1", "g2", "p")
    assert (task.found, task.termination) == ((), None)

    first = game.step(Move("cover 1"))
    assert (first.newly_found, first.reward) == (("g1", "g2"), 4.0)
    assert task.detected == (*at_first, "g1", "g2")
    assert (task.found, task.termination) == (("g1", "g2"), None)

    look = task.perception
    second = game.step(Move("cover 2"))
    assert (second.newly_found, second.reward) == ((), 0.0)
    assert task.perception is look
    assert task.termination is None

    third = game.step(Move("cover 2"))
    assert (third.newly_found, third.reward) == (("p",), 2.0)
    assert task.termination is TerminationReason.ALL_FOUND
    assert task.found == task.initially_hidden
    assert task.transitions == [first, second, third]
    assert sum(step.reward for step in task.transitions) == REWARDS.detection_reward * len(
        task.initially_hidden
    )
    assert task.initial_scene is HIDING
    assert task.scene is third.outcome.scene


@pytest.mark.parametrize("result", [MoveResult.COLLAPSED, MoveResult.LEFT_TRAY])
def test_objects_uncovered_by_a_collapse_do_not_count(
    result: MoveResult, detector: LabelDetector
) -> None:
    game = episode(detector, MoveResult.PLACED, result)
    task = game.task
    game.step(Move("cover 2"))
    known = task.detected
    step = game.step(Move("cover 1"))
    assert {"g1", "g2"} <= {d.name for d in step.next_perception.observation.detections}
    assert (step.newly_found, step.reward) == ((), -5.0)
    assert task.detected == known
    assert task.found == ("p",)
    assert task.termination is TerminationReason(result.value)
    with pytest.raises(ValueError, match=result.value):
        task.record(MoveAttempt(Decision(Move("marker")), step.outcome, step.next_perception))


def test_moves_that_were_not_carried_out_count_as_moves(detector: LabelDetector) -> None:
    game = episode(detector, *[MoveResult.NO_FREE_PLACEMENT] * 2, max_moves=2)
    task = game.task
    for _ in range(2):
        assert task.termination is None
        game.step(Move("cover 1"))
    assert task.termination is TerminationReason.OUT_OF_MOVES


def test_finding_all_objects_with_the_last_move_is_a_success(detector: LabelDetector) -> None:
    game = episode(detector, MoveResult.PLACED, MoveResult.PLACED, max_moves=2)
    task = game.task
    game.step(Move("cover 1"))
    game.step(Move("cover 2"))
    assert task.termination is TerminationReason.ALL_FOUND


def test_detected_objects_stay_detected(detector: LabelDetector) -> None:
    """The cover is placed over the revealed objects again."""
    game = episode(detector, MoveResult.PLACED, MoveResult.PLACED)
    task = game.task
    game.step(Move("cover 1"))
    known = task.detected
    back = ASIDE | {"cover 1": (-0.2, 0.0)}
    game.backend.scene = HIDING.with_poses(
        {"cover 2": resting("cracker_box", xy=back["cover 2"]).X_TO}
    )
    step = game.step(Move("cover 2"))
    assert "g1" not in {d.name for d in step.next_perception.observation.detections}
    assert task.detected == (*known, "p")
    assert step.newly_found == ("p",)


def test_an_episode_without_hidden_objects_ends_at_once(detector: LabelDetector) -> None:
    scene = scene_of(resting("large_marker", name="marker"))
    task = ExplorationTask(scene, detector.perceive(scene), REWARDS, 10)
    assert (task.termination, task.initially_hidden, task.found) == (
        TerminationReason.ALL_FOUND,
        (),
        (),
    )


def test_no_legal_move_places_an_object_on_itself(detector: LabelDetector) -> None:
    game = episode(detector)
    with pytest.raises(ValueError, match="expected another object, or tray"):
        game.step(Move("marker", "marker"))
    assert game.task.transitions == []
    assert game.backend.belief.history == ()


def test_legal_moves_do_not_name_hidden_objects(detector: LabelDetector) -> None:
    observation = detector.perceive(HIDING).observation
    moves = legal_moves(observation)
    names = {"cover 1", "cover 2", "marker"}
    assert len(moves) == len(set(moves)) == 9
    assert {move.pick for move in moves} == names
    assert {move.place for move in moves} == names | {TRAY}
    assert all(move.pick != move.place for move in moves)
    assert legal_moves(replace(observation, detections=())) == []


def test_an_episode_with_rendering_and_settling(config: ClutterConfig) -> None:
    """Largest-clear moves both covers, first the one nearer to the camera; Drake settles them."""
    backend, seen = (
        make_teleport_backend_factory("settle", config)(HIDING, rng(1)),
        list[tuple[str, ...]](),
    )

    def policy(
        belief: Belief,
        observation: Observation,
        generator: np.random.Generator,
    ) -> Decision:
        seen.append(tuple(o.name for o in belief.objects))
        return largest_clear(belief, observation, generator)

    reported = list[Transition]()
    task = run_episode(backend, policy, max_moves=4, on_transition=reported.append)
    assert task.termination is TerminationReason.ALL_FOUND
    assert [step.move.pick for step in task.transitions] == ["cover 2", "cover 1"]
    assert sum(step.reward for step in task.transitions) == 3.0
    assert reported == task.transitions
    seen.append(tuple(o.name for o in backend.belief.objects))
    assert set(seen[-1]) == set(task.detected) == set(HIDING.names)
    assert all(after[: len(before)] == before for before, after in pairwise(seen))
    assert backend.belief.history == tuple(step.move for step in task.transitions)


def scripted(*moves: Move) -> Policy:
    """Return a policy that makes some moves and then has none."""
    return lambda belief, *_: Decision(dict(enumerate(moves)).get(len(belief.history)))


def test_an_episode_ends_when_the_policy_has_no_move(detector: LabelDetector) -> None:
    game = episode(detector, MoveResult.NOT_PLANNED)
    task = run_episode(game.backend, scripted(Move("cover 1")), max_moves=5)
    assert [step.move for step in task.transitions] == [Move("cover 1")]
    assert task.termination is TerminationReason.GAVE_UP
    assert game.backend.belief.invalid_moves == (Move("cover 1"),)


def test_an_episode_can_continue_after_all_objects_were_found_but_not_after_a_collapse(
    detector: LabelDetector,
) -> None:
    moves = [Move("cover 1"), Move("cover 2"), Move("cover 1"), Move("cover 2")]
    results = [MoveResult.PLACED] * 2 + [MoveResult.COLLAPSED]
    for until_all_found, made in ((True, 2), (False, 3)):
        game = episode(detector, *results)
        task = run_episode(
            game.backend,
            scripted(*moves),
            max_moves=4,
            until=StopCriterion.ALL_FOUND if until_all_found else StopCriterion.LAST_MOVE,
        )
        assert len(task.transitions) == made


def test_the_number_of_moves_also_limits_an_episode_that_continues_after_all_was_found(
    detector: LabelDetector,
) -> None:
    game = episode(detector, *[MoveResult.PLACED] * 5)
    moves = [Move(f"cover {1 + k % 2}") for k in range(5)]
    task = run_episode(game.backend, scripted(*moves), max_moves=3, until=StopCriterion.LAST_MOVE)
    assert [step.move for step in task.transitions] == moves[:3]
    assert task.has_found_all


# --- Belief ---


def test_invalid_moves_are_cleared_by_a_change(detector: LabelDetector) -> None:
    refused, placed = MoveResult.NOT_PLANNED, MoveResult.PLACED
    game = episode(detector, refused, refused, placed, refused, MoveResult.DROPPED)
    one, two = Move("cover 1"), Move("cover 2")
    invalid = list[tuple[Move, ...]]()
    for move in (one, two, one, two, two):
        game.step(move)
        invalid.append(game.backend.belief.invalid_moves)
    assert invalid == [(one,), (one, two), (), (two,), ()]
    assert game.backend.belief.history == (one, two, one, two, two)


PICK, CARRY, PLACE = MovePart.PICK, MovePart.CARRY, MovePart.PLACE


def first_valid(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
    """Choose the first move that is not invalid, by the order of the objects, then the tray."""
    names = sorted(d.name for d in observation.detections)
    moves = [Move(x, y) for x in names for y in (TRAY, *names) if y != x]
    return Decision(next((move for move in moves if move not in belief.invalid_moves), None))


@pytest.mark.parametrize(
    ("parts", "moves"),
    [
        ([PICK, PICK, PICK], ["cover 1", "cover 2", "marker"]),
        ([CARRY, CARRY, CARRY, CARRY], ["cover 1", "cover 1", "cover 2", "cover 2"]),
        ([CARRY, PICK, PLACE, PLACE], ["cover 1", "cover 1", "cover 2", "cover 2"]),
        ([PLACE, PLACE, PLACE, PICK], ["cover 1", "cover 1", "cover 1", "cover 2"]),
        ([None, None, None, PICK], ["cover 1", "cover 1", "cover 1", "cover 2"]),
    ],
)
def test_what_is_tried_after_a_move_without_a_plan(
    parts: list[MovePart | None], moves: list[str], detector: LabelDetector
) -> None:
    """Another object after a failed pick, one other place after a carry; no move twice."""
    observation = detector.perceive(HIDING).observation
    belief = Belief().update(observation)
    tried = list[Move]()
    for part in parts:
        move = select_move(first_valid, belief, observation, rng()).move
        assert move is not None
        tried.append(move)
        belief = belief.record(move, MoveResult.NOT_PLANNED, failed_part=part).update(observation)
    assert [move.pick for move in tried] == moves
    assert len(set(tried)) == len(tried)


def test_a_failed_pick_is_tried_again_when_nothing_else_is_left(detector: LabelDetector) -> None:
    observation = detector.perceive(HIDING).observation
    belief = Belief().update(observation)
    legal = legal_moves(observation)
    tried = list[Move]()
    while (move := select_move(first_valid, belief, observation, rng()).move) is not None:
        tried.append(move)
        belief = belief.record(move, MoveResult.NOT_PLANNED, failed_part=PICK).update(observation)
    assert [move.pick for move in tried[:4]] == ["cover 1", "cover 2", "marker", "cover 1"]
    assert sorted(map(str, tried)) == sorted(map(str, legal))


def test_a_failed_pick_counts_until_something_has_changed(detector: LabelDetector) -> None:
    observation = detector.perceive(HIDING).observation
    failed = Belief().update(observation)
    failed = failed.record(Move("cover 1"), MoveResult.NOT_PLANNED, failed_part=PICK)
    assert {m.pick for m in failed.update(observation).deferred_moves(observation)} == {"cover 1"}
    shifted = HIDING["cover 1"].X_TO.translated((0.02, 0.0, 0.0))
    other_belief = detector.perceive(HIDING.with_poses({"cover 1": shifted})).observation
    assert failed.update(other_belief).deferred_moves(other_belief) == []
    assert failed.record(Move("cover 2"), MoveResult.DROPPED).failures == ()
    aside = resting("cracker_box", xy=ASIDE["cover 2"]).X_TO
    moved = detector.perceive(HIDING.with_poses({"cover 2": aside})).observation
    assert failed.record(Move("cover 2"), MoveResult.PLACED, aside).update(moved).failures == ()
    stuck = failed.record(Move("cover 2"), MoveResult.PLACED, aside).update(observation)
    assert stuck.failures == failed.failures, "nothing has moved"


def test_a_policy_that_stops_is_not_asked_again(detector: LabelDetector) -> None:
    observation = detector.perceive(HIDING).observation
    belief = Belief().update(observation)
    belief = belief.record(Move("cover 1"), MoveResult.NOT_PLANNED, failed_part=PICK)
    asked = list[Belief]()

    def stop(known: Belief, *_: object) -> Decision:
        asked.append(known)
        return Decision(None, is_stop=True)

    assert select_move(stop, belief, observation, rng()).is_stop
    assert len(asked) == 1


def test_an_object_detected_at_its_old_pose_was_not_placed(detector: LabelDetector) -> None:
    """All its moves become invalid, and earlier invalid moves stay invalid."""
    before = detector.perceive(HIDING).observation
    belief = Belief().update(before).record(Move("marker"), MoveResult.NOT_PLANNED)
    place = Pose((-0.2, 0.25, 0.1), HIDING["cover 1"].X_TO.quaternion)
    placed = belief.record(Move("cover 1"), MoveResult.PLACED, place)
    assert {o.name: o.X_TO for o in placed.objects}["cover 1"] == place, "until it is seen"
    stuck = placed.update(before)
    its = tuple(move for move in legal_moves(before) if move.pick == "cover 1")
    assert stuck.invalid_moves == (Move("marker"), *its)
    assert stuck.update(before) == stuck
    aside = HIDING.with_poses({"cover 1": resting("cracker_box", xy=ASIDE["cover 1"]).X_TO})
    assert placed.update(detector.perceive(aside).observation).invalid_moves == ()
    unseen = replace(before, detections=())
    assert placed.update(unseen).invalid_moves == ()
    assert {o.name: o.X_TO for o in placed.update(unseen).objects}["cover 1"] == place


@pytest.mark.parametrize("result", [MoveResult.PLACED, MoveResult.DROPPED])
def test_a_placed_object_is_believed_where_it_was_put(
    result: MoveResult, detector: LabelDetector
) -> None:
    """Until the next observation. What was dropped is believed where it was."""
    executor = Scripted(result)
    backend = SteppedBackend(executor, detector, REWARDS, HIDING, rng())
    backend.step(Move("cover 1"))
    (believed,) = (o.X_TO for o in backend.belief.objects if o.name == "cover 1")
    put = executor.command.X_TO_place
    assert put.p[2] != HIDING["cover 1"].X_TO.p[2]
    assert believed == (put if result is MoveResult.PLACED else HIDING["cover 1"].X_TO)


def test_invalid_moves_of_a_lost_object_are_removed(detector: LabelDetector) -> None:
    belief = Belief().update(detector.perceive(HIDING).observation)
    for move in (Move("marker"), Move("cover 1", "marker"), Move("cover 1")):
        belief = belief.record(move, MoveResult.NOT_PLANNED)
    left = belief.remove(["marker"])
    assert {o.name for o in left.objects} == {"cover 1", "cover 2"}
    assert left.invalid_moves == (Move("cover 1"),)
    assert left.history == belief.history


# --- Agents ---


def imagined(*detections: tuple[str, str, int]) -> Observation:
    """Return an observation of objects (name, class, pixels) side by side with clear tops."""
    camera = DEFAULT_CELL.camera
    found = []
    for index, (name, class_name, pixels) in enumerate(detections):
        mask = np.zeros((camera.height, camera.width), bool)
        mask.ravel()[1000 * index : 1000 * index + pixels] = True
        found.append(
            Detection(name, CLASSES[class_name], Pose((0.1 * index - 0.3, 0.0, 0.1)), mask)
        )
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    return Observation(depth, tuple(found), camera, DEFAULT_CELL.support)


def sweep(policy: Policy, observation: Observation, count: int) -> list[str]:
    """Return the objects that a policy picks one after the other, all to the tray."""
    tried: tuple[Move, ...] = ()
    for _ in range(count):
        move = policy(Belief(history=tried), observation, rng()).move
        assert move is not None
        assert move.place == TRAY
        tried = (*tried, move)
    return [move.pick for move in tried]


def test_largest_first_orders_by_volume_and_picks_each_object_once_before_any_again() -> None:
    observation = imagined(
        ("m", "large_marker", 900),
        ("b", "sugar_box", 10),
        ("c", "cracker_box", 20),
        ("a", "sugar_box", 5),
        ("k", "master_chef_can", 1),
    )
    order = [
        "c",
        "k",
        "a",
        "b",
        "m",
    ]  # 2.2, 1.1, 0.59, 0.59 and 0.03 liters; of two alike the first by name
    assert sweep(largest_first, observation, 12) == [*order, *order, "c", "k"]


def test_newly_detected_objects_are_picked_before_any_is_picked_again() -> None:
    observation = imagined(
        ("c", "cracker_box", 20), ("k", "master_chef_can", 1), ("m", "large_marker", 900)
    )
    tried = (Move("c"), Move("k", "c"), Move("gone"))
    assert largest_first(Belief(history=tried), observation, rng()).move == Move("m")


def test_largest_clear_orders_by_pixels() -> None:
    observation = imagined(
        ("m", "large_marker", 900),
        ("b", "sugar_box", 10),
        ("a", "gelatin_box", 10),
        ("c", "cracker_box", 20),
    )
    order = ["m", "c", "a", "b"]
    assert sweep(largest_clear, observation, 6) == [*order, "m", "c"]


def test_largest_clear_does_not_pick_supporting_objects(detector: LabelDetector) -> None:
    scene = scene_of(
        *(resting("cracker_box", name="below"), resting("large_marker", floor=0.060, name="on it")),
        resting("pudding_box", xy=(0.2, 0.2), name="aside"),
    )
    observation = detector.perceive(scene).observation
    assert sweep(largest_first, observation, 3) == ["below", "aside", "on it"]
    assert sweep(largest_clear, observation, 3) == ["aside", "on it", "aside"]


def test_largest_clear_considers_all_objects_if_no_top_is_clear(detector: LabelDetector) -> None:
    observation = detector.perceive(HIDING).observation
    covered = replace(observation, depth=np.full_like(observation.depth, 0.5))
    move = largest_clear(Belief(), covered, rng()).move
    assert move is not None
    pixels = {d.name: int(d.mask.sum()) for d in observation.detections}
    assert pixels[move.pick] == max(pixels.values())


def test_random_is_uniform_over_the_legal_moves() -> None:
    observation = imagined(("a", "sugar_box", 1), ("b", "sugar_box", 1), ("c", "sugar_box", 1))
    generator = rng(0)
    drawn = Counter(random_explorer(Belief(), observation, generator).move for _ in range(1800))
    moves = legal_moves(observation)
    assert set(drawn) == set(moves)
    expected = 1800 / len(moves)
    assert (
        sum((count - expected) ** 2 / expected for count in drawn.values()) < 26.1
    )  # chi-squared, 8 degrees of freedom, 0.1 %


@pytest.mark.parametrize("name", sorted(BASELINE_POLICIES))
def test_every_baseline_chooses_legal_moves_reproducibly(
    name: str, detector: LabelDetector
) -> None:
    observation = detector.perceive(HIDING).observation

    def choices(seed: int) -> tuple[Move, ...]:
        policy, generator = BASELINE_POLICIES[name], rng(seed)
        tried: tuple[Move, ...] = ()
        for _ in range(8):
            move = policy(Belief(history=tried), observation, generator).move
            assert move is not None
            assert move in legal_moves(observation)
            tried = (*tried, move)
        return tried

    assert choices(3) == choices(3)
    nothing = replace(observation, detections=())
    assert BASELINE_POLICIES[name](Belief(), nothing, rng()).move is None
