"""The published agreement of the judges, from the published verdicts of Drake."""

import json
from pathlib import Path
from shutil import copyfile

import pytest

from benchmarks.collect_drake_verdicts import (
    NUM_MOVES,
    SCENES_BY_BATCH,
    SceneBatch,
    WorkerPool,
    collect_moves,
    collect_verdicts,
    moves_path,
)
from benchmarks.judge_agreement import BatchComparison
from drake_clutter.records import read_jsonl

RESULTS = Path(__file__).parents[1] / "benchmarks/results"
VERDICTS = RESULTS / "drake_verdicts"


@pytest.mark.parametrize("batch", SCENES_BY_BATCH, ids=lambda batch: batch.name)
def test_published_verdicts_are_complete(batch: SceneBatch, tmp_path: Path) -> None:
    name = f"{batch.name}.jsonl.gz"
    copyfile(VERDICTS / name, tmp_path / name)
    count = SCENES_BY_BATCH[batch]
    records = collect_verdicts(batch, count, tmp_path, WorkerPool())
    assert [record["index"] for record in records] == list(range(count))
    assert (tmp_path / name).read_bytes() == (VERDICTS / name).read_bytes()


def test_published_moves_are_complete(tmp_path: Path) -> None:
    (batch, num_scenes), *_ = SCENES_BY_BATCH.items()
    for path in (VERDICTS / f"{batch.name}.jsonl.gz", moves_path(batch, VERDICTS)):
        copyfile(path, tmp_path / path.name)
    moves = collect_moves(batch, num_scenes, NUM_MOVES, tmp_path, WorkerPool())
    assert len(moves) == NUM_MOVES


def test_a_published_row_is_reproduced() -> None:
    batch = SceneBatch("pantry14", 25, 0)
    comparison = BatchComparison(batch)
    comparison.run(read_jsonl(VERDICTS / f"{batch.name}.jsonl.gz")[1:])
    results = json.loads((RESULTS / "judges.json").read_text())
    (published,) = (row for row in results["scenes"] if row["objects"] == "pantry14")
    row = comparison.row()
    assert row["confusion"] == published["confusion"]
    assert row["stacks"]["confusion"] == published["stacks"]["confusion"]
    assert row["hidden_agreement"] == published["hidden_agreement"]
    assert comparison.details() == results["details"]["pantry14, 25 nodes"]
