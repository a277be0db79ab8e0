"""Table I's script, on a few small scenes."""

import json
from pathlib import Path
from types import ModuleType

import pytest
from conftest import training_script

from drake_clutter.files import InputError


@pytest.fixture(scope="module")
def results() -> ModuleType:
    return training_script("evaluate_generators")


def test_a_table_of_one_row(
    results: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(results, "TABLE", [results.GeneratorEvaluation("random", 9, 5)])
    monkeypatch.setattr(results, "TEMPERATURES", [])
    out = tmp_path / "table.json"
    results.main(tmp_path / "scenes", seed=3, out=out, max_scenes=3)
    (row,) = json.loads(out.read_text())["rows"]
    assert row["count"] == row["row"]["count"] == 3
    results.main(tmp_path / "scenes", seed=3, out=out)
    (row,) = json.loads(out.read_text())["rows"]
    assert row["row"] == {
        "agent": "random",
        "nodes": 9,
        "count": 5,
        "objects": "ycb7",
        "temperature": None,
    }
    assert sum(row["fast_judge"].values()) == 5
    drake_stable = sum(
        number
        for verdicts, number in row["fast_judge"].items()
        if verdicts.endswith("drake stable")
    )
    assert drake_stable == round(5 * row["stability_rate"])
    assert sum(row["stack_heights_5cm"]) == round(5 * row["mean_stacks"])
    assert row["seed"] == 3
    before = out.stat().st_mtime_ns
    results.main(tmp_path / "scenes", seed=3, out=out)
    assert out.stat().st_mtime_ns == before, "what is there is not measured again"
    with pytest.raises(InputError, match="holds results of another seed"):
        results.main(tmp_path / "scenes", seed=4, out=out)


def test_the_picture_of_the_temperature(results: ModuleType, tmp_path: Path) -> None:
    figures = {
        "hidden_mean": 5.0,
        "hidden_ci95": (4.0, 6.0),
        "stability_rate": 0.9,
        "solvable_share": 0.8,
        "distinct_share": 1.0,
    }
    figures |= {"balanced_share": 0.5, "class_entropy": 2.0, "objects": "ycb7"}
    results.draw_temperature_effect(
        [{"temperature": 0.1} | figures, {"temperature": 0.4} | figures], tmp_path / "trade.png"
    )
    assert (tmp_path / "trade.png").stat().st_size > 10_000
