"""Comparing explorers: what is played, and what is refused before anything is."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
from conftest import world_with

from drake_clutter.commands.evaluate import PlayableScene, evaluate, playable
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError

CONFIG = ClutterConfig()


def rows_of(
    scenes: Sequence[PlayableScene], *agents: str, config: ClutterConfig = CONFIG, out: Path | None = None, most: int = 100
) -> list[dict[str, Any]]:
    """The rows; `most`: episodes that are to be played."""

    def progress(results: Iterable[Any], total: int) -> Iterable[Any]:
        assert total <= most
        return results

    return evaluate(scenes, agents, 3, "equilibrium", 0, config, None, 1, out, progress)


def test_an_agent_that_is_named_twice_plays_once() -> None:
    scenes = playable("sg_star_10", None)[:2]
    assert rows_of(scenes, "random", "random", most=2) == rows_of(scenes, "random")


def test_a_set_that_there_is_not() -> None:
    with pytest.raises(InputError, match=r"--scenes sg_star_9: is not there; allowed are .*sg_star_25"):
        playable("sg_star_9", None)


def test_mistakes_are_told_before_anything_is_played(tmp_path: Path) -> None:
    scenes = playable("sg_14", None)[:1]
    for out in (tmp_path, tmp_path / "none" / "out.json"):
        with pytest.raises(InputError, match=r"--out .* allowed is a file in a folder that exists"):
            rows_of(scenes, "random", out=out, most=0)
    with pytest.raises(InputError, match="was not trained with cereal_box_large"):
        rows_of(scenes, "random", "student", most=0)


def test_what_hides_nothing_from_the_config_s_camera_is_left_out() -> None:
    """In the first of the set some object is hidden altogether, in the second there is a glimpse of each."""
    config = world_with("camera.visibility_threshold=1e-6".replace("1e-6", "0.000001"))
    scenes = playable("sg_star_10", None)[:2]
    (row,) = rows_of(scenes, "random", config=config)
    assert row["episodes"] == 1
    with pytest.raises(InputError, match="none of 1 hides anything"):
        rows_of(scenes[1:], "random", config=config)
