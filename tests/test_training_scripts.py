"""The scripts that make sets of scenes and the explorers' tables."""

import json
from collections import Counter
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
from conftest import CATALOG, training_script

from drake_clutter.agents.episode_evaluation import EpisodeResult
from drake_clutter.agents.generators import GenerationJob
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.validation import to_plain
from training.evaluate_explorers import PANTRY14_SETS, YCB7_SETS
from training.results_file import ResultsFile

ALL, COLLAPSED, OUT = "all found", "collapsed", "out of moves"


def result(
    ended: str, hidden: int, found_after: tuple[int, ...], not_carried_out: int = 0
) -> EpisodeResult:
    found = found_after[-1] if found_after else 0
    return EpisodeResult(
        "scene", "agent", ended, hidden, found, len(found_after), found_after, not_carried_out
    )


def test_a_row_of_the_table() -> None:
    """By hand: one within 10 moves, one within 20, a collapse after two, and one that finds nothing."""
    results = [
        result(ALL, 2, (1, 2)),
        result(ALL, 3, (0,) * 10 + (1, 3), not_carried_out=3),
        result(COLLAPSED, 4, (1, 1)),
        result(OUT, 1, (0,) * 20),
    ]
    ceiling = [
        result(ALL, 2, (2, 2)),
        result(ALL, 3, (0, 3)),
        result(ALL, 4, (4,)),
        result("gave up", 1, ()),
    ]
    row = training_script("evaluate_explorers").summarize(results, {"ceiling": ceiling})
    assert row["hidden"] == 2.5
    assert (row["within_10"]["success"], row["within_20"]["success"]) == (0.25, 0.5)
    assert (row["within_10"]["found"], row["within_20"]["found"]) == (3 / 4, 6 / 4)
    assert (row["within_10"]["found_of_hidden"], row["within_20"]["found_of_hidden"]) == (0.3, 0.6)
    assert row["within_10"]["collapsed"] == row["within_20"]["collapsed"] == 0.25
    assert row["moves_of_successes"] == 7
    assert row["not_carried_out"] == 3 / 36
    low, high = row["moves_to_ceiling_ci95"]
    assert (low, high) == (2 / 2, 12 / 2), (
        "two scenes, drawn again and again: either of them twice, or both"
    )
    assert (row["moves_to_ceiling"], row["both_with_ceiling"]) == (14 / 4, 2)


@pytest.mark.parametrize(("moves", "in_10", "in_20"), [(10, 0.5, 0.5), (11, 0, 0.5), (20, 0, 0.5)])
def test_the_last_move_counts(moves: int, in_10: float, in_20: float) -> None:
    results = [result(ended, 1, (0,) * (moves - 1) + (1,)) for ended in (ALL, COLLAPSED)]
    row = training_script("evaluate_explorers").summarize(results, {})
    told = {
        limit: [row[f"within_{limit}"][name] for name in ("success", "collapsed", "found")]
        for limit in (10, 20)
    }
    assert told == {10: [in_10, in_10, 2 * in_10], 20: [in_20, in_20, 2 * in_20]}


def test_episodes_are_run_once(tmp_path: Path) -> None:
    """Records of other options are not taken for these."""
    script = training_script("evaluate_explorers")
    scenes = load_scene_dataset(script.SCENES / "sg_star_25.json", CATALOG)
    path = tmp_path / "random.jsonl.gz"
    options = {"fidelity": "static", "seed": 0, "workers": 1}
    records = script.collect_episodes(path, scenes, "random", 1, **options)
    before = path.read_bytes()
    assert script.collect_episodes(path, scenes, "random", 1, **options) == records
    assert path.read_bytes() == before
    assert script.collect_episodes(path, scenes, "random", 2, **options)[:1] == records
    assert script.to_result(records[0]).hidden == scenes.scenes[0].num_hidden
    with pytest.raises(
        InputError, match=r"random\.jsonl\.gz: holds records of something else \(agent, seed\)"
    ):
        script.collect_episodes(path, scenes, "largest-clear", 1, **options | {"seed": 1})
    with pytest.raises(InputError, match="--out: is missing"):
        script.main(tmp_path, only="sg_star_25", agents=["random"])
    with pytest.raises(InputError, match="--out: is missing"):
        script.main(only="sg_star_10", count=1)
    with pytest.raises(InputError, match="--only none"):
        script.main(tmp_path, only="none", out=tmp_path / "table.json")


def test_mistakes_are_told_before_anything_is_played(tmp_path: Path) -> None:
    script, out = training_script("evaluate_explorers"), tmp_path / "table.json"
    for agents, told in (
        (["random", "missing.safetensors"], r"missing\.safetensors: cannot be read"),
        (["random", "student"], "was not trained with cereal_box_large"),
    ):
        with pytest.raises(InputError, match=told):
            script.main(tmp_path / "episodes", only="sg_14", count=1, agents=agents, out=out)
    out.write_text('{"rows": []}')
    with pytest.raises(InputError, match=r"--out .*table\.json: is no results file \('seed'\)"):
        script.main(tmp_path / "episodes", only="sg_14", count=1, agents=["random"], out=out)
    assert list((tmp_path / "episodes").iterdir()) == []


def test_an_explorer_is_compared_with_the_records_of_a_baseline(tmp_path: Path) -> None:
    script, out = training_script("evaluate_explorers"), tmp_path / "table.json"
    options: dict[str, Any] = {"only": "sg_star_10", "fidelity": "static", "out": out}
    script.main(tmp_path, agents=["largest-clear"], count=1, **options)
    baseline = tmp_path / "sg_star_10_largest-clear.jsonl.gz"
    content = baseline.read_bytes()
    script.main(tmp_path, agents=["student"], count=2, **options)
    clear, student = json.loads(out.read_text())["rows"]
    assert (
        clear["moves_to_largest_clear"],
        clear["both_with_largest_clear"],
        clear["episodes"],
    ) == (1, 1, 1)
    assert (student["both_with_largest_clear"], student["episodes"]) == (1, 2)
    assert "moves_to_ceiling" not in student, "there are no records of the oracle"
    assert baseline.read_bytes() == content, "no episode of the baseline is run for a comparison"


def test_a_row_replaces_the_row_of_the_same_keys(tmp_path: Path) -> None:
    path = tmp_path / "table.json"
    results = ResultsFile(path, {"seed": 1}, ("set", "agent"))
    results.add(
        {"set": "b", "agent": "student", "episodes": 1},
        {"set": "b", "agent": "random", "episodes": 1},
    )
    results.add(
        {"set": "b", "agent": "random", "episodes": 2},
        {"set": "a", "agent": "random", "episodes": 2},
    )
    rows = json.loads(path.read_text())["rows"]
    assert [(row["set"], row["agent"], row["episodes"]) for row in rows] == [
        ("b", "student", 1),
        ("b", "random", 2),
        ("a", "random", 2),
    ]
    assert results.find({"set": "b", "agent": "random"}) == rows[1]
    assert results.find({"set": "c", "agent": "random"}) is None
    with pytest.raises(InputError, match=r"table\.json: holds results of another seed"):
        ResultsFile(path, {"seed": 2}, ("set", "agent")).read()


@pytest.mark.parametrize("with_poses", [False, True])
def test_a_set_of_scenes(with_poses: bool, tmp_path: Path) -> None:
    script = training_script("generate_scene_dataset")
    options = {
        "agent": "random",
        "nodes": 10,
        "seed": 1,
        "work": tmp_path / "work",
        "with_poses": with_poses,
    }
    script.main(tmp_path / "first.json", count=2, **options)
    first = load_scene_dataset(tmp_path / "first.json", CATALOG)
    assert first.metadata["judge"] == "drake"
    assert len({scene.canonical_form for scene in first.scenes}) == 2
    assert all(
        scene.num_hidden > 0 and (scene.settled_poses is not None) == with_poses
        for scene in first.scenes
    )
    again = tmp_path / "again.json"
    script.main(again, count=1, exclude=[tmp_path / "first.json"], **options)
    (other,) = load_scene_dataset(again, CATALOG).scenes
    assert other.canonical_form not in {scene.canonical_form for scene in first.scenes}


def test_a_set_to_learn_from_holds_no_graph_that_falls_in_drake(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The static judge calls this one stable; Drake has the last word."""
    script = training_script("generate_scene_dataset")
    judge = script.GraphJudge(GenerationJob("random", "ycb7", None, 10, 1, ClutterConfig()))
    index = next(k for k in range(20) if judge(k).get("hidden"))
    fall = Instability(InstabilityReason.TOPPLED, "sugar_box_1", 0.1, 1.0)
    monkeypatch.setattr(
        DrakeJudge, "judge", lambda self, scene, rng: Verdict(fall, scene.poses, {}, ())
    )
    record = judge(index)
    assert record == {"fast": True, "fell": "toppled"}
    fell = Counter[str]()
    assert list(script.select_graphs([record], fell)) == []
    assert fell == {"toppled": 1}


@pytest.mark.parametrize(
    ("with_poses", "message"),
    [(False, r"something else \(weights\)"), (True, "results of other options")],
)
def test_a_set_goes_on_with_the_weights_that_it_began_with(
    with_poses: bool, message: str, tmp_path: Path
) -> None:
    script, agent = training_script("generate_scene_dataset"), tmp_path / "agent.safetensors"
    options = {
        "agent": str(agent),
        "nodes": 10,
        "work": tmp_path / "work",
        "count": 1,
        "with_poses": with_poses,
    }

    checkpoints = Path(__file__).parents[1] / "training" / "checkpoints"

    def take(shipped: str) -> None:
        for suffix in (".safetensors", ".json"):
            copyfile(checkpoints / f"{shipped}{suffix}", agent.with_suffix(suffix))

    take("sg")
    script.main(tmp_path / "set.json", **options)
    take("sg_star")
    with pytest.raises(InputError, match=message):
        script.main(tmp_path / "set.json", **options)


def test_a_set_that_cannot_be_made_ends(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--count 1: only 0 of 20 scenes are stable"):
        training_script("generate_scene_dataset").main(
            tmp_path / "set.json", tmp_path / "work", agent="random", nodes=3, count=1
        )


@pytest.mark.parametrize("name", [*YCB7_SETS, *PANTRY14_SETS])
def test_published_episodes_are_resumed(name: str, tmp_path: Path) -> None:
    """The header of a record file of an earlier version is that of today."""
    script = training_script("evaluate_explorers")
    scenes = load_scene_dataset(script.SCENES / f"{name}.json", CATALOG)
    for agent in script.TABLES[name][1]:
        path = script.episodes_path(script.EPISODES, name, agent)
        if path.exists():
            copy = Path(copyfile(path, tmp_path / path.name))
            options = {"fidelity": "settle", "seed": 2000, "workers": 1}
            records = script.collect_episodes(copy, scenes, agent, 3, **options)
            assert [record["scene"] for record in records] == [f"{name}.json {k}" for k in range(3)]


def test_published_closed_loop_episodes_are_resumed(tmp_path: Path) -> None:
    script = training_script("evaluate_closed_loop")
    for evaluation in script.EVALUATIONS:
        path = script.EPISODES / f"{evaluation.name}.jsonl.gz"
        if path.exists():
            copy = Path(copyfile(path, tmp_path / path.name))
            records = script.collect_episodes(evaluation, 3, 1, copy)
            assert [r["number"] for r in records] == [evaluation.first + k for k in range(3)]


def test_published_rows_are_read() -> None:
    script = training_script("evaluate_explorers")
    header = {"seed": 2000, "fidelity": "settle", "config": to_plain(ClutterConfig())}
    for name in ("table2.json", "table3.json"):
        assert ResultsFile(script.RESULTS / name, header, ("set", "agent")).read()
