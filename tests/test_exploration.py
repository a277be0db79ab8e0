"""The exploration episode's book-keeping, on scripted outcomes and on real ones; the agents that need no learning."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from conftest import CLASSES, DEFAULT_CELL, resting, rng, scene_of

from drake_clutter.agents.exploration import (
    BASELINES,
    Explorer,
    LargestClear,
    LargestFirst,
    RandomExplorer,
)
from drake_clutter.config import ClutterConfig, ExplorationConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import Detection, Instability, InstabilityReason, Move, MoveResult, Observation, Outcome
from drake_clutter.scenes.scene import TRAY, Pose, Scene
from drake_clutter.simulation.executor import SettleExecutor
from drake_clutter.tasks.exploration import EpisodeEnd, ExplorationTask, legal_moves

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
    """An executor that takes the picked cover aside, or ends as it was told to."""

    def __init__(self, *results: MoveResult) -> None:
        self._results = iter(results)

    def execute(self, scene: Scene, observation: Observation, move: Move, generator: np.random.Generator) -> Outcome:
        result = next(self._results)
        if result is MoveResult.NO_FREE_SPOT:
            return Outcome(result, scene)
        moved = scene.at({move.pick: resting("cracker_box", xy=ASIDE[move.pick]).X_TO})
        fallen = Instability(InstabilityReason.SLID, "g1", 0.02, 0.0) if result is MoveResult.COLLAPSED else None
        return Outcome(result, moved, fallen)


def episode(detector: LabelDetector, *results: MoveResult, max_moves: int = 10) -> ExplorationTask:
    return ExplorationTask(HIDING, Scripted(*results), detector, REWARDS, max_moves)


def test_an_episode_that_finds_all(detector: LabelDetector) -> None:
    task = episode(detector, MoveResult.PLACED, MoveResult.NO_FREE_SPOT, MoveResult.PLACED)
    at_first = task.known
    assert at_first == ("cover 1", "cover 2", "marker")
    assert task.hidden_at_start == ("g1", "g2", "p")
    assert (task.found, task.end) == ((), None)

    first = task.step(Move("cover 1"), rng())
    assert (first.newly_found, first.reward) == (("g1", "g2"), 4.0)
    assert task.known == (*at_first, "g1", "g2")
    assert (task.found, task.end) == (("g1", "g2"), None)

    look = task.look
    second = task.step(Move("cover 2"), rng())
    assert (second.newly_found, second.reward) == ((), 0.0)
    assert task.look is look
    assert task.end is None

    third = task.step(Move("cover 2"), rng())
    assert (third.newly_found, third.reward) == (("p",), 2.0)
    assert task.end is EpisodeEnd.ALL_FOUND
    assert task.found == task.hidden_at_start
    assert task.steps == [first, second, third]
    assert sum(step.reward for step in task.steps) == REWARDS.detection_reward * len(task.hidden_at_start)
    assert task.start is HIDING
    assert task.scene is third.outcome.scene


def test_what_a_collapse_uncovers_does_not_count(detector: LabelDetector) -> None:
    task = episode(detector, MoveResult.PLACED, MoveResult.COLLAPSED)
    task.step(Move("cover 2"), rng())
    known = task.known
    step = task.step(Move("cover 1"), rng())
    assert {"g1", "g2"} <= {d.name for d in step.look.observation.detections}
    assert (step.newly_found, step.reward) == ((), -5.0)
    assert task.known == known
    assert task.found == ("p",)
    assert task.end is EpisodeEnd.COLLAPSED
    with pytest.raises(ValueError, match="collapsed"):
        task.step(Move("marker"), rng())


def test_out_of_moves_counts_moves_that_could_not_be_carried_out(detector: LabelDetector) -> None:
    task = episode(detector, *[MoveResult.NO_FREE_SPOT] * 2, max_moves=2)
    for _ in range(2):
        assert task.end is None
        task.step(Move("cover 1"), rng())
    assert task.end is EpisodeEnd.OUT_OF_MOVES


def test_all_found_on_the_last_move_is_a_success(detector: LabelDetector) -> None:
    task = episode(detector, MoveResult.PLACED, MoveResult.PLACED, max_moves=2)
    task.step(Move("cover 1"), rng())
    task.step(Move("cover 2"), rng())
    assert task.end is EpisodeEnd.ALL_FOUND


def test_what_was_seen_once_stays_known(detector: LabelDetector) -> None:
    """The cover is put back over what it hid."""
    task = episode(detector, MoveResult.PLACED, MoveResult.PLACED)
    task.step(Move("cover 1"), rng())
    known = task.known
    back = ASIDE | {"cover 1": (-0.2, 0.0)}
    task.scene = HIDING.at({"cover 2": resting("cracker_box", xy=back["cover 2"]).X_TO})
    step = task.step(Move("cover 2"), rng())
    assert "g1" not in {d.name for d in step.look.observation.detections}
    assert task.known == (*known, "p")
    assert step.newly_found == ("p",)


def test_nothing_hidden_is_found_at_once(detector: LabelDetector) -> None:
    scene = scene_of(resting("large_marker", name="marker"))
    task = ExplorationTask(scene, Scripted(), detector, REWARDS, 10)
    assert (task.end, task.hidden_at_start, task.found) == (EpisodeEnd.ALL_FOUND, (), ())


def test_an_object_does_not_go_onto_itself(detector: LabelDetector) -> None:
    task = episode(detector)
    with pytest.raises(ValueError, match="allowed is to put an object on another one or on tray"):
        task.step(Move("marker", "marker"), rng())
    assert task.steps == []


def test_legal_moves_say_nothing_of_what_is_hidden(detector: LabelDetector) -> None:
    observation = detector.look(HIDING).observation
    moves = legal_moves(observation)
    names = {"cover 1", "cover 2", "marker"}
    assert len(moves) == len(set(moves)) == 9
    assert {move.pick for move in moves} == names
    assert {move.place for move in moves} == names | {TRAY}
    assert all(move.pick != move.place for move in moves)
    assert legal_moves(replace(observation, detections=())) == []


def test_a_real_episode(detector: LabelDetector, config: ClutterConfig) -> None:
    """Largest-clear takes both covers away, the one nearer to the camera first, and everything is found. Drake settles."""
    task = ExplorationTask(HIDING, SettleExecutor(config), detector, config.exploration, 4)
    agent = LargestClear()
    while task.end is None:
        move = agent.choose(task.look.observation, [step.move for step in task.steps], rng(1)).move
        assert move in legal_moves(task.look.observation)
        before = task.known
        task.step(move, rng(len(task.steps)))
        assert task.known[: len(before)] == before
    assert task.end is EpisodeEnd.ALL_FOUND
    assert [step.move.pick for step in task.steps] == ["cover 2", "cover 1"]
    assert sum(step.reward for step in task.steps) == 3.0


# --- Agents ---


def imagined(*detections: tuple[str, str, int]) -> Observation:
    """What a camera might show: (name, class, pixels), side by side, each with a clear top."""
    camera = DEFAULT_CELL.camera
    found = []
    for index, (name, class_name, pixels) in enumerate(detections):
        mask = np.zeros((camera.height, camera.width), bool)
        mask.ravel()[1000 * index : 1000 * index + pixels] = True
        found.append(Detection(name, CLASSES[class_name], Pose((0.1 * index - 0.3, 0.0, 0.1)), mask))
    depth = np.full((camera.height, camera.width), np.inf, np.float32)
    return Observation(depth, tuple(found), camera, DEFAULT_CELL.support)


def sweep(agent: Explorer, observation: Observation, count: int) -> list[str]:
    """The objects that an agent picks one after the other; all go to the tray."""
    tried: list[Move] = []
    for _ in range(count):
        move = agent.choose(observation, tried, rng()).move
        assert move is not None
        assert move.place == TRAY
        tried.append(move)
    return [move.pick for move in tried]


def test_largest_first_goes_by_volume_and_repeats_only_after_a_sweep() -> None:
    observation = imagined(
        ("m", "large_marker", 900),
        ("b", "sugar_box", 10),
        ("c", "cracker_box", 20),
        ("a", "sugar_box", 5),
        ("k", "master_chef_can", 1),
    )
    order = ["c", "k", "a", "b", "m"]  # 2.2, 1.1, 0.59, 0.59 and 0.03 litres; of two alike the first by name
    assert sweep(LargestFirst(), observation, 12) == [*order, *order, "c", "k"]


def test_what_comes_into_view_is_picked_before_a_repeat() -> None:
    observation = imagined(("c", "cracker_box", 20), ("k", "master_chef_can", 1), ("m", "large_marker", 900))
    tried = [Move("c"), Move("k", "c"), Move("gone")]
    assert LargestFirst().choose(observation, tried, rng()).move == Move("m")


def test_largest_clear_goes_by_pixels() -> None:
    observation = imagined(("m", "large_marker", 900), ("b", "sugar_box", 10), ("a", "gelatin_box", 10), ("c", "cracker_box", 20))
    order = ["m", "c", "a", "b"]
    assert sweep(LargestClear(), observation, 6) == [*order, "m", "c"]


def test_largest_clear_leaves_what_carries_something(detector: LabelDetector) -> None:
    scene = scene_of(
        *(resting("cracker_box", name="below"), resting("large_marker", floor=0.060, name="on it")),
        resting("pudding_box", xy=(0.2, 0.2), name="aside"),
    )
    observation = detector.look(scene).observation
    assert sweep(LargestFirst(), observation, 3) == ["below", "aside", "on it"]
    assert sweep(LargestClear(), observation, 3) == ["aside", "on it", "aside"]


def test_largest_clear_takes_any_if_no_top_is_clear(detector: LabelDetector) -> None:
    observation = detector.look(HIDING).observation
    covered = replace(observation, depth=np.full_like(observation.depth, 0.5))
    move = LargestClear().choose(covered, [], rng()).move
    assert move is not None
    pixels = {d.name: int(d.mask.sum()) for d in observation.detections}
    assert pixels[move.pick] == max(pixels.values())


def test_random_is_uniform_over_the_legal_moves() -> None:
    observation = imagined(("a", "sugar_box", 1), ("b", "sugar_box", 1), ("c", "sugar_box", 1))
    generator = rng(0)
    drawn = Counter(RandomExplorer().choose(observation, [], generator).move for _ in range(1800))
    moves = legal_moves(observation)
    assert set(drawn) == set(moves)
    expected = 1800 / len(moves)
    assert sum((count - expected) ** 2 / expected for count in drawn.values()) < 26.1  # chi-squared, 8 degrees of freedom, 0.1 %


@pytest.mark.parametrize("name", sorted(BASELINES))
def test_every_agent_chooses_legal_moves_repeatably(name: str, detector: LabelDetector) -> None:
    observation = detector.look(HIDING).observation

    def choices(seed: int) -> list[Move]:
        agent, generator = BASELINES[name](), rng(seed)
        tried: list[Move] = []
        for _ in range(8):
            move = agent.choose(observation, tried, generator).move
            assert move is not None
            assert move in legal_moves(observation)
            tried.append(move)
        return tried

    assert choices(3) == choices(3)
    nothing = replace(observation, detections=())
    assert BASELINES[name]().choose(nothing, [], rng()).move is None
