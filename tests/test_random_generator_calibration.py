"""The comparison of the random generator with the paper, on a single scene."""

import json
from pathlib import Path

from benchmarks import random_generator_calibration as script


def test_a_size_without_a_stable_scene_has_no_hidden_objects_to_count(tmp_path: Path) -> None:
    out = tmp_path / "calibration.json"
    script.main(count=1, seed=6, nodes=[10], out=out)
    (row,) = json.loads(out.read_text())["rows"]
    assert row["stability_rate"] == 0
    assert row["hidden_mean"] is None
    assert set(row["hidden_by_threshold"].values()) == {None}
    cells = script.table_row(row)
    assert cells["hidden"] == cells["hidden below 0.3"] == "-"
