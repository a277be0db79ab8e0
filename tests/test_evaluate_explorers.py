"""Evaluation of explorers: metrics, records and results files."""

import json
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
from conftest import CATALOG

from drake_clutter.agents.episode_evaluation import EpisodeResult
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.statistics import mean_interval, ratio_interval
from drake_clutter.validation import to_plain
from training import evaluate_explorers as script
from training.episode_files import collect_episodes, episodes_path
from training.results_file import ResultsFile
from training.script import RESULTS, SCENES

ALL_FOUND = "all found"
COLLAPSED = "collapsed"
OUT_OF_MOVES = "out of moves"


def result(
    ended: str, hidden: int, found_after: tuple[int, ...], not_carried_out: int = 0
) -> EpisodeResult:
    found = found_after[-1] if found_after else 0
    return EpisodeResult(
        "scene", "agent", ended, hidden, found, len(found_after), found_after, not_carried_out
    )


def test_metrics_of_an_explorer() -> None:
    """Four episodes: success within 10 moves, within 20 moves, a collapse, and nothing found."""
    results = [
        result(ALL_FOUND, 2, (1, 2)),
        result(ALL_FOUND, 3, (0,) * 10 + (1, 3), not_carried_out=3),
        result(COLLAPSED, 4, (1, 1)),
        result(OUT_OF_MOVES, 1, (0,) * 20),
    ]
    ceiling = [
        result(ALL_FOUND, 2, (2, 2)),
        result(ALL_FOUND, 3, (0, 3)),
        result(ALL_FOUND, 4, (4,)),
        result("gave up", 1, ()),
    ]
    row = script.summarize(results, {"ceiling": ceiling}, 5)
    assert row["hidden"] == 2.5
    assert (row["within_10"]["success"], row["within_20"]["success"]) == (0.25, 0.5)
    assert (row["within_10"]["found"], row["within_20"]["found"]) == (3 / 4, 6 / 4)
    assert (row["within_10"]["found_of_hidden"], row["within_20"]["found_of_hidden"]) == (0.3, 0.6)
    assert row["within_10"]["collapsed"] == row["within_20"]["collapsed"] == 0.25
    assert row["moves_of_successes"] == 7
    assert row["not_carried_out"] == 3 / 36
    assert row["within_10"]["found_ci95"] == mean_interval([2, 0, 1, 0], 0, 5)
    assert row["within_20"]["found_of_hidden_ci95"] == ratio_interval(
        [2, 3, 1, 0], [2, 3, 4, 1], (0, 5), (5, 5)
    )
    assert row["moves_of_successes_ci95"] == mean_interval([2, 12], 1, 20)
    assert row["moves_to_ceiling_ci95"] == ratio_interval([2, 12], [2, 2], (1, 20), (20, 1))
    assert (row["moves_to_ceiling"], row["both_with_ceiling"]) == (14 / 4, 2)


@pytest.mark.parametrize(("moves", "in_10", "in_20"), [(10, 0.5, 0.5), (11, 0, 0.5), (20, 0, 0.5)])
def test_the_last_move_counts(moves: int, in_10: float, in_20: float) -> None:
    results = [result(ended, 1, (0,) * (moves - 1) + (1,)) for ended in (ALL_FOUND, COLLAPSED)]
    row = script.summarize(results, {}, 5)
    metrics = {
        limit: [row[f"within_{limit}"][name] for name in ("success", "collapsed", "found")]
        for limit in (10, 20)
    }
    assert metrics == {10: [in_10, in_10, 2 * in_10], 20: [in_20, in_20, 2 * in_20]}


def test_episodes_are_run_once(tmp_path: Path) -> None:
    """Records of other options are rejected."""
    scenes = load_scene_dataset(SCENES / "sg_star_25.json", CATALOG)
    path = tmp_path / "random.jsonl.gz"
    options: dict[str, Any] = {"fidelity": "static", "seed": 0, "workers": 1}
    records = collect_episodes(path, scenes, "random", 1, **options)
    before = path.read_bytes()
    assert collect_episodes(path, scenes, "random", 1, **options) == records
    assert path.read_bytes() == before
    assert collect_episodes(path, scenes, "random", 2, **options)[:1] == records
    assert EpisodeResult.from_record(records[0]).hidden == scenes.scenes[0].num_hidden
    with pytest.raises(
        InputError,
        match=r"random\.jsonl\.gz: holds records with a different header \(agent, seed\)",
    ):
        collect_episodes(path, scenes, "largest-clear", 1, **options | {"seed": 1})
    with pytest.raises(InputError, match="--out: is missing"):
        script.main(tmp_path, only="sg_star_25", agents=["random"])
    with pytest.raises(InputError, match="--out: is missing"):
        script.main(only="sg_star_10", count=1)
    with pytest.raises(InputError, match="--only none"):
        script.main(tmp_path, only="none", out=tmp_path / "table.json")


def test_misuse_is_reported_before_any_episode_is_run(tmp_path: Path) -> None:
    out = tmp_path / "table.json"
    for agents, message in (
        (["random", "missing.safetensors"], r"missing\.safetensors: cannot be read"),
        (["random", "student"], "was not trained with cereal_box_large"),
    ):
        with pytest.raises(InputError, match=message):
            script.main(tmp_path / "episodes", only="sg_14", count=1, agents=agents, out=out)
    out.write_text('{"rows": []}')
    with pytest.raises(InputError, match=r"--out .*table\.json: cannot be read \(lacks 'seed'\)"):
        script.main(tmp_path / "episodes", only="sg_14", count=1, agents=["random"], out=out)
    assert list((tmp_path / "episodes").iterdir()) == []


def test_an_explorer_is_compared_with_the_records_of_a_baseline(tmp_path: Path) -> None:
    out = tmp_path / "table.json"
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


@pytest.mark.parametrize("name", [*script.YCB7_SETS, *script.PANTRY14_SETS])
def test_episodes_with_another_placement_rule_are_not_resumed(name: str, tmp_path: Path) -> None:
    """The configuration of the published episodes has no doubt about what carries an object."""
    scenes = load_scene_dataset(SCENES / f"{name}.json", CATALOG)
    for agent in script.TABLES[name][1]:
        path = episodes_path(script.EPISODES, name, agent)
        if path.exists():
            copy = Path(copyfile(path, tmp_path / path.name))
            options: dict[str, Any] = {"fidelity": "settle", "seed": 2000, "workers": 1}
            with pytest.raises(
                InputError, match=r"holds records with a different header \(config\)"
            ):
                collect_episodes(copy, scenes, agent, 3, **options)


@pytest.mark.parametrize("name", ["table2.json", "table3.json"])
def test_rows_are_not_added_to_those_of_another_placement_rule(name: str) -> None:
    header = {"seed": 2000, "fidelity": "settle", "config": to_plain(ClutterConfig())}
    with pytest.raises(InputError, match="holds results of another config"):
        ResultsFile(RESULTS / name, header, ("set", "agent")).read()
