"""Evaluation of generators on a few small scenes."""

import json
from pathlib import Path

import pytest

from drake_clutter.files import InputError
from training import evaluate_generators as script


def test_a_table_of_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "TABLE", [script.GeneratorEvaluation("random", 9, 5)])
    monkeypatch.setattr(script, "TEMPERATURES", [])
    out = tmp_path / "table.json"
    script.main(tmp_path / "scenes", seed=3, out=out, max_scenes=3)
    (row,) = json.loads(out.read_text())["rows"]
    assert row["count"] == row["row"]["count"] == 3
    script.main(tmp_path / "scenes", seed=3, out=out)
    (row,) = json.loads(out.read_text())["rows"]
    assert row["row"] == {
        "agent": "random",
        "nodes": 9,
        "count": 5,
        "objects": "ycb7",
        "temperature": None,
    }
    assert sum(row["static_judge"].values()) == 5
    drake_stable = sum(
        number
        for verdicts, number in row["static_judge"].items()
        if verdicts.endswith("Drake stable")
    )
    assert drake_stable == round(5 * row["stability_rate"])
    assert sum(row["stack_heights_5cm"]) == round(5 * row["mean_stacks"])
    assert row["seed"] == 3
    before = out.stat().st_mtime_ns
    script.main(tmp_path / "scenes", seed=3, out=out)
    assert out.stat().st_mtime_ns == before, "a complete row is not measured again"
    with pytest.raises(InputError, match="holds results of another seed"):
        script.main(tmp_path / "scenes", seed=4, out=out)
