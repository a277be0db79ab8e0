"""Generation of scene datasets for explorers."""

from collections import Counter
from pathlib import Path
from shutil import copyfile
from typing import Any

import pytest
from conftest import CATALOG

from drake_clutter.agents.generators import GenerationJob
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import Instability, InstabilityReason, Verdict
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.simulation.drake_judge import DrakeJudge
from training import generate_scene_dataset as script

CHECKPOINTS = Path(__file__).parents[1] / "training/checkpoints"


@pytest.mark.parametrize("with_poses", [False, True])
def test_scenes_are_stable_distinct_and_hide_objects(with_poses: bool, tmp_path: Path) -> None:
    options: dict[str, Any] = {
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


def test_a_training_set_holds_no_graph_that_is_unstable_in_drake(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The static model calls the scene stable, and Drake does not."""
    judge = script.GraphJudge(GenerationJob("random", "ycb7", None, 10, 1, ClutterConfig()))
    index = next(k for k in range(20) if judge(k).get("hidden"))
    fall = Instability(InstabilityReason.TOPPLED, "sugar_box_1", 0.1, 1.0)
    monkeypatch.setattr(
        DrakeJudge, "judge", lambda self, scene, rng: Verdict(fall, scene.poses, {}, ())
    )
    record = judge(index)
    assert record == {"fast": True, "fell": "toppled"}
    instabilities = Counter[str]()
    assert list(script.select_graphs([record], instabilities)) == []
    assert instabilities == {"toppled": 1}


@pytest.mark.parametrize(
    ("with_poses", "message"),
    [(False, r"different header \(weights\)"), (True, "results of other options")],
)
def test_an_interrupted_run_is_not_resumed_with_other_weights(
    with_poses: bool, message: str, tmp_path: Path
) -> None:
    agent = tmp_path / "agent.safetensors"
    options: dict[str, Any] = {
        "agent": str(agent),
        "nodes": 10,
        "work": tmp_path / "work",
        "count": 1,
        "with_poses": with_poses,
    }

    def copy_checkpoint(name: str) -> None:
        for suffix in (".safetensors", ".json"):
            copyfile(CHECKPOINTS / f"{name}{suffix}", agent.with_suffix(suffix))

    copy_checkpoint("sg")
    script.main(tmp_path / "set.json", **options)
    copy_checkpoint("sg_star")
    with pytest.raises(InputError, match=message):
        script.main(tmp_path / "set.json", **options)


def test_a_dataset_that_cannot_be_generated_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--count 1: only 0 of 20 scenes are stable"):
        script.main(tmp_path / "set.json", tmp_path / "work", agent="random", nodes=3, count=1)
