"""Backend without an arm, with a scripted detector, and evaluation of its episodes."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ONE_CUP, resting, scene_of, training_script, world_with

from drake_clutter.agents.explorers import largest_clear
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import MoveResult, Observation
from drake_clutter.scenes.scene import Scene
from drake_clutter.systems.image_backend import ImageBackend
from drake_clutter.systems.tracking import match_to_ground_truth
from drake_clutter.tasks.arm_reachability_bound import ArmReachabilityBound
from drake_clutter.tasks.belief import Belief, Decision
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason
from training import results_file

COVERED = scene_of(
    resting("gelatin_box", xy=(0.05, 0.0)), resting("cracker_box", xy=(0.05, 0.0), floor=0.028)
)


def shifted_observation(scene: Scene, config: ClutterConfig, shift: float) -> Observation:
    """Return the true detections, shifted along x [m], with arbitrary names."""
    observation = LabelDetector(config.cell.camera).perceive(scene).observation
    shifted = [
        replace(d, name=f"detection {k}", X_TO=d.X_TO.translated((shift, 0, 0)))
        for k, d in enumerate(observation.detections)
    ]
    return replace(observation, detections=tuple(shifted))


@pytest.mark.parametrize("shift", [0.0, 0.004])
def test_the_true_object_nearest_to_the_detection_is_picked(
    config: ClutterConfig, shift: float
) -> None:
    """The placement has the pose error of the detection."""
    observation, names = shifted_observation(COVERED, config, shift), list[str]()

    def policy(belief: Belief, observation: Observation, rng: np.random.Generator) -> Decision:
        names.extend(o.name for o in belief.objects)
        return largest_clear(belief, observation, rng)

    backend = ImageBackend(COVERED, lambda *_: observation, seed=0, config=config)
    task = run_episode(backend, policy, max_moves=3)
    known = backend.belief.objects
    (step,) = task.transitions
    assert names == ["cracker_box_1"], "the belief has names of its own"
    assert (step.move.pick, task.termination) == ("cracker_box", TerminationReason.ALL_FOUND)
    assert step.outcome.X_TO_released is not None
    off = task.scene["cracker_box"].X_TO.p - step.outcome.X_TO_released.p
    assert off[:2] == pytest.approx([-shift, 0.0], abs=1.5e-3)
    assert match_to_ground_truth(known, COVERED.objects) == ("cracker_box",), (
        "the scripted observation is the same after the move"
    )


def test_an_episode_ends_without_a_move(config: ClutterConfig) -> None:
    observation = shifted_observation(COVERED, config, 0.0)
    backend = ImageBackend(COVERED, lambda *_: observation, seed=0, config=config)
    task = run_episode(backend, lambda *_: Decision(None), max_moves=3)
    assert (task.transitions, task.termination) == ([], TerminationReason.GAVE_UP)


def test_summary_of_closed_loop_episodes() -> None:
    script = training_script("evaluate_closed_loop")
    episode = {
        "hidden": 2,
        "found": 2,
        "moves": 4,
        "robot": 60.0,
        "wall": 9.0,
        "not_planned": {},
        "results": {},
        "arm_can": True,
    }
    episode |= {"objects": 5, "known": 6, "recognised": 4, "commit": "abc"}
    episodes = [
        episode | {"ended": "all found"},
        episode | {"ended": "all found", "arm_can": False},
        episode | {"ended": "collapsed", "found": 1, "results": {MoveResult.DROPPED.value: 1}},
        episode | {"ended": "out of moves", "found": 0, "not_planned": {"no seal": 3}},
        episode | {"ended": "gave up", "found": 0, "arm_can": False},
        {"ended": "exception", "wall": 1.0, "arm_can": True, "commit": "def"},
    ]
    row = script.summarize(script.EVALUATIONS[0], episodes)
    assert (row["success"], row["arm_can"], row["success_of_arm_can"]) == (2 / 6, 4 / 6, 1 / 4)
    assert (row["found_of_hidden"], row["moves_of_successes"], row["robot_minutes"]) == (0.5, 4, 1)
    assert (row["list_recall"], row["list_precision"]) == (8 / 10, 8 / 12)
    assert (row["dropped"], row["not_planned"]) == (1, {"no seal": 3})
    held, refused = "remaining objects unreachable by suction", "most moves not plannable"
    assert row["failed_of"] == {"collapsed": 1, refused: 1, held: 1, "exception": 1}
    assert row["commits"] == ["abc", "def"]
    assert json.dumps(row)
    nothing = script.summarize(script.EVALUATIONS[0], episodes[-1:])
    assert (
        nothing["success"],
        nothing["found"],
        nothing["robot_minutes"],
        nothing["failed_of"],
    ) == (
        0,
        None,
        None,
        {"exception": 1},
    )
    assert script.table_row(nothing)["moves"] == "-"


def test_recorded_episodes_are_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Records of an episode with other networks are rejected."""
    script, path = training_script("evaluate_closed_loop"), tmp_path / "row.jsonl.gz"
    numbers = list[int]()

    def run(request: Any) -> dict[str, Any]:
        numbers.append(request.number)
        return {"number": request.number, "arm_can": True, "ended": script.EXCEPTION, "wall": 1.0}

    monkeypatch.setattr(results_file, "map_ordered", lambda _, items, **options: map(run, items))
    evaluation = script.EVALUATIONS[0]
    first = evaluation.first
    records = script.collect_episodes(evaluation, 2, 1, path)
    assert [record["number"] for record in records] == [first, first + 1]
    records = script.collect_episodes(evaluation, 3, 1, path)
    assert [record["number"] for record in records] == numbers == [first, first + 1, first + 2]
    with pytest.raises(
        InputError,
        match=r"row\.jsonl\.gz: holds records with a different header \(row, scenario, weights\)",
    ):
        script.collect_episodes(replace(evaluation, agent="student-dagger"), 3, 1, path)


def test_objects_below_an_ungraspable_one_are_unrevealable() -> None:
    """The large cup cannot hold the marker on the upper box, so the lower box stays hidden."""
    ceiling = ArmReachabilityBound(world_with(f"cell.{ONE_CUP}"))
    on_top = resting("large_marker", xy=(0.05, 0.0), floor=0.028 + 0.06)
    assert ceiling.find_unrevealable(COVERED) == ()
    above = replace(
        on_top,
        X_TO=on_top.X_TO.translated(
            (0.0, 0.0, COVERED["cracker_box"].top_height - on_top.bounds_T[0][2])
        ),
    )
    assert ceiling.find_unrevealable(replace(COVERED, objects=(*COVERED.objects, above))) == (
        "gelatin_box",
    )
    with_small_cup = ArmReachabilityBound(ClutterConfig())
    marked = replace(COVERED, objects=(*COVERED.objects, above))
    assert with_small_cup.find_unrevealable(marked) == ()
