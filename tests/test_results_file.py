"""Results files and record files of the scripts."""

import json
from pathlib import Path
from shutil import copyfile

import pytest

from drake_clutter.files import InputError
from drake_clutter.records import read_jsonl, write_jsonl
from training import evaluate_closed_loop
from training.evaluate_closed_loop import EpisodeRecord
from training.results_file import ResultsFile


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


def test_published_closed_loop_episodes_are_resumed(tmp_path: Path) -> None:
    for evaluation in evaluate_closed_loop.EVALUATIONS:
        path = evaluate_closed_loop.EPISODES / f"{evaluation.name}.jsonl.gz"
        if path.exists():
            copy = Path(copyfile(path, tmp_path / path.name))
            records = evaluate_closed_loop.collect_episodes(evaluation, 3, 1, copy)
            assert [r["number"] for r in records] == [evaluation.first + k for k in range(3)]


def test_an_incomplete_record_of_an_episode_is_refused(tmp_path: Path) -> None:
    """An episode that ended with an exception has no metrics; any other has all."""
    record = {"number": 60, "arm_can": True, "wall": 1.0, "commit": "x"}
    path = tmp_path / "records.jsonl.gz"
    write_jsonl(path, {}, [record | {"ended": "exception"}])
    assert len(read_jsonl(path, EpisodeRecord)) == 2
    write_jsonl(path, {}, [record | {"ended": "all found"}])
    with pytest.raises(InputError, match=r"line 2: found: is missing; expected the record of an"):
        read_jsonl(path, EpisodeRecord)
