"""Comparing explorers: what is played, and what is refused before anything is."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
from conftest import cell_with, random_scene, world_with
from typer.testing import CliRunner

from drake_clutter.cli import app
from drake_clutter.commands.evaluate_explorers import (
    EvaluationScene,
    common_cell,
    evaluate_explorers,
    load_evaluation_scenes,
)
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.scenes.interfaces import Verdict
from drake_clutter.scenes.scene_file import save_scene

CONFIG = ClutterConfig()


def rows_of(
    scenes: Sequence[EvaluationScene],
    *agents: str,
    config: ClutterConfig = CONFIG,
    out: Path | None = None,
    most: int = 100,
) -> list[dict[str, Any]]:
    """The rows; `most`: episodes that are to be played."""

    def progress(results: Iterable[Any], total: int) -> Iterable[Any]:
        assert total <= most
        return results

    return evaluate_explorers(scenes, agents, 3, "static", 0, config, None, 1, out, progress)


def test_an_agent_that_is_named_twice_plays_once() -> None:
    scenes = load_evaluation_scenes("sg_star_10", None)[:2]
    assert rows_of(scenes, "random", "random", most=2) == rows_of(scenes, "random")


def test_a_set_that_there_is_not() -> None:
    with pytest.raises(
        InputError, match=r"--scenes sg_star_9: is not there; allowed are .*sg_star_25"
    ):
        load_evaluation_scenes("sg_star_9", None)


def test_mistakes_are_told_before_anything_is_played(tmp_path: Path) -> None:
    scenes = load_evaluation_scenes("sg_14", None)[:1]
    for out in (tmp_path, tmp_path / "none" / "out.json"):
        with pytest.raises(InputError, match=r"--out .* allowed is a file in a folder that exists"):
            rows_of(scenes, "random", out=out, most=0)
    with pytest.raises(InputError, match="was not trained with cereal_box_large"):
        rows_of(scenes, "random", "student", most=0)


def test_what_hides_nothing_from_the_config_s_camera_is_left_out() -> None:
    """In the first of the set some object is hidden altogether, in the second there is a glimpse of each."""
    config = world_with("camera.visibility_threshold=1e-6".replace("1e-6", "0.000001"))
    scenes = load_evaluation_scenes("sg_star_10", None)[:2]
    (row,) = rows_of(scenes, "random", config=config)
    assert row["episodes"] == 1
    with pytest.raises(InputError, match="none of 1 scenes has objects that are hidden"):
        rows_of(scenes[1:], "random", config=config)


def test_scenes_are_played_in_the_cell_that_they_were_made_with(tmp_path: Path) -> None:
    """A camera that calls nothing hidden but what it sees nothing of."""
    scene = random_scene(22)
    cells = [
        cell_with(f"cameras.overhead.visibility_threshold={least}") for least in (0.3, 0.000001)
    ]
    for number, cell in enumerate(cells):
        folder = tmp_path / str(number)
        folder.mkdir()
        verdict = Verdict(None, scene.poses, dict.fromkeys(scene.names, 0.0), scene.names)
        save_scene(folder / f"{number}.yaml", scene, cell, verdict)
        assert common_cell(load_evaluation_scenes(str(folder), None)) == cell
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
        told = CliRunner().invoke(app, command)
        assert told.exit_code == 0, told.output
        camera = json.loads(out.read_text())["config"]["cell"]["cameras"]["overhead"]
        assert camera["visibility_threshold"] == cell.camera.visibility_threshold
    mixed = [load_evaluation_scenes(str(tmp_path / str(number)), None)[0] for number in (0, 1)]
    with pytest.raises(
        InputError,
        match=r"1\.yaml was made in another cell than 0\.yaml; allowed are scenes of one cell",
    ):
        common_cell(mixed)
