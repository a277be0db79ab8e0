"""Evaluation of exploration policies: which episodes are run, and which input is refused."""

import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from conftest import cell_with, random_scene, world_with
from typer.testing import CliRunner

from drake_clutter.cli import app
from drake_clutter.commands.evaluate_explorers import (
    EvaluationScene,
    ExplorerEvaluation,
    common_cell,
    evaluate_explorers,
    load_evaluation_scenes,
)
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene_file import save_scene

CONFIG = ClutterConfig()


def run_evaluation(
    scenes: Sequence[EvaluationScene],
    *agents: str,
    config: ClutterConfig = CONFIG,
    out: Path | None = None,
    max_episodes: int = 100,
) -> list[dict[str, Any]]:
    """Return the statistics; there must be at most `max_episodes` episodes."""

    def progress(results: Iterable[Any], num_done: int, total: int) -> Iterable[Any]:
        assert total - num_done <= max_episodes
        return results

    evaluation = ExplorerEvaluation(scenes, agents, 3, "static", 0, config, None)
    return evaluate_explorers(evaluation, 1, out, progress)


def test_a_repeated_policy_is_run_once() -> None:
    scenes = load_evaluation_scenes("sg_star_10", None)[:2]
    assert run_evaluation(scenes, "random", "random", max_episodes=2) == run_evaluation(
        scenes, "random"
    )


def test_an_unknown_scene_dataset() -> None:
    with pytest.raises(
        InputError, match=r"--scenes sg_star_9: does not exist; expected .*sg_star_25"
    ):
        load_evaluation_scenes("sg_star_9", None)


def test_invalid_input_is_refused_before_any_episode(tmp_path: Path) -> None:
    scenes = load_evaluation_scenes("sg_14", None)[:1]
    for out in (tmp_path, tmp_path / "none" / "out.json"):
        with pytest.raises(InputError, match=r"--out .* expected a file in an existing folder"):
            run_evaluation(scenes, "random", out=out, max_episodes=0)
    with pytest.raises(InputError, match="was not trained with cereal_box_large"):
        run_evaluation(scenes, "random", "student", max_episodes=0)


def test_an_interrupted_evaluation_is_resumed_and_a_finished_one_read(tmp_path: Path) -> None:
    scenes = load_evaluation_scenes("sg_star_10", None)[:3]
    whole, out = tmp_path / "whole.json", tmp_path / "out.json"
    rows = run_evaluation(scenes, "random", out=whole)

    def interrupt(results: Iterable[Any], num_done: int, total: int) -> Iterator[Any]:
        yield from itertools.islice(results, 2)
        raise KeyboardInterrupt

    evaluation = ExplorerEvaluation(scenes, ["random"], 3, "static", 0, CONFIG, None)
    with pytest.raises(KeyboardInterrupt):
        evaluate_explorers(evaluation, 1, out, interrupt)
    partial = tmp_path / "out.json.partial.jsonl"
    assert len(partial.read_text().splitlines()) == 1 + 2
    assert run_evaluation(scenes, "random", out=out, max_episodes=1) == rows
    assert out.read_bytes() == whole.read_bytes()
    read = run_evaluation(scenes, "random", out=out, max_episodes=0)
    assert read == json.loads(json.dumps(rows))
    assert sorted(tmp_path.iterdir()) == [out, whole]
    with pytest.raises(InputError, match=r"holds other results \(agents\); give a new file, or"):
        run_evaluation(scenes, "largest-first", out=out, max_episodes=0)
    out.write_text("mine")
    with pytest.raises(InputError, match="is not JSON"):
        run_evaluation(scenes, "random", out=out, max_episodes=0)
    assert out.read_text() == "mine"


def test_scenes_without_objects_hidden_from_the_camera_are_excluded() -> None:
    """In the first scene of the set an object is fully hidden, in the second none is."""
    config = world_with("camera.visibility_threshold=1e-6".replace("1e-6", "0.000001"))
    scenes = load_evaluation_scenes("sg_star_10", None)[:2]
    (row,) = run_evaluation(scenes, "random", config=config)
    assert row["episodes"] == 1
    with pytest.raises(InputError, match="none of 1 scenes has objects that are hidden"):
        run_evaluation(scenes[1:], "random", config=config)


def test_scenes_are_evaluated_in_their_own_cell(tmp_path: Path) -> None:
    """One camera counts objects as hidden only if they are fully hidden."""
    scene = random_scene(22)
    cells = [
        cell_with(f"cameras.overhead.visibility_threshold={least}") for least in (0.3, 0.000001)
    ]
    for number, cell in enumerate(cells):
        folder = tmp_path / str(number)
        folder.mkdir()
        verdict = Verdict(None, scene.poses, dict.fromkeys(scene.names, 0.0), scene.names)
        save_scene(folder / f"{number}.yaml", scene, cell, verdict)
        (loaded,) = load_evaluation_scenes(str(folder), None)
        assert load_evaluation_scenes(str(folder / f"{number}.yaml"), None) == [loaded]
        assert common_cell([loaded]) == cell
        out = folder / "out.json"
        command = [
            "evaluate",
            str(folder),
            "--agents",
            "random",
            "--fidelity",
            "static_or_drake",
            "--max-moves",
            "1",
            "--out",
            str(out),
        ]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.output
        camera = json.loads(out.read_text())["config"]["cell"]["cameras"]["overhead"]
        assert camera["visibility_threshold"] == cell.camera.visibility_threshold
    mixed = [load_evaluation_scenes(str(tmp_path / str(number)), None)[0] for number in (0, 1)]
    with pytest.raises(
        InputError,
        match=r"1\.yaml was made in another cell than 0\.yaml; expected scenes of one cell",
    ):
        common_cell(mixed)
