"""Tables of the written reference pages name what the code reads and writes."""

import re
from pathlib import Path

import h5py
import numpy as np
from conftest import DEFAULT_CELL, resting, scene_of
from recorded_episodes import synthetic_episode
from test_floors import FLOORS

from drake_clutter import ClutterConfig, run_episode
from drake_clutter.agents.explorers import random_explorer
from drake_clutter.commands.explore_scene import episode_to_dict
from drake_clutter.commands.feasibility_run import BASE_COLUMNS, MAP_COLUMNS, TARGET_COLUMNS
from drake_clutter.feasibility.move_study import MOVE_RECORD_FIELDS
from drake_clutter.feasibility.pose_noise import NOISE_RECORD_FIELDS
from drake_clutter.feasibility.sequences import SEQUENCE_RECORD_FIELDS
from drake_clutter.planning.pick_place_plan import PlanningFailureReason
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.scenes.action_samples import CHANNELS, EXECUTED_COMMANDS
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene_file import scene_to_dict
from drake_clutter.tasks.episode import make_teleport_backend_factory
from drake_clutter.tasks.exploration_task import StopCriterion, TerminationReason

DOCS = Path(__file__).parents[1] / "docs"


def section(page: str, heading: str) -> str:
    """Return the text below a heading, up to the next heading."""
    text = (DOCS / page).read_text(encoding="utf-8")
    return re.split(r"^#+ ", text.partition(f"{heading}\n")[2], flags=re.MULTILINE)[0]


def first_column(page: str, heading: str) -> list[str]:
    """Return the names in the first column of the table below a heading."""
    lines = section(page, heading).splitlines()
    cells = [line.split("|")[1] for line in lines if line.startswith("| ")][1:]
    return [name for cell in cells for name in re.findall(r"`([^`]+)`", cell)]


def test_episode_file() -> None:
    scene = scene_of(resting("cracker_box"), resting("sugar_box", xy=(0.2, 0.2)))
    rng = np.random.default_rng(0)
    backend = make_teleport_backend_factory("static", ClutterConfig())(scene, rng)
    task = run_episode(backend, random_explorer, max_moves=1, until=StopCriterion.LAST_MOVE)
    written = episode_to_dict(task, "random", "static", 0)
    added = ["cell", "timing", "scenes_tried"]
    page = "reference/episode_file.md"
    assert first_column(page, "## Fields") == [*written, *added]
    assert first_column(page, "## Entries of `moves`") == [*written["moves"][0]]
    results = {result.value for result in MoveResult}
    reasons = {reason.value for reason in TerminationReason}
    text = (DOCS / page).read_text(encoding="utf-8")
    assert {value for value in results | reasons if f"`{value}`" not in text} == set()


def test_scene_file() -> None:
    scene = scene_of(resting("cracker_box"))
    written = scene_to_dict(scene, DEFAULT_CELL)
    named = first_column("reference/scene_file.md", "## Fields")
    assert {*written} <= {*named}
    assert {*written["objects"][0]} <= {"name", "class", "X_TO", "node"}


def test_trajectory_file(tmp_path: Path) -> None:
    page, path = "reference/trajectory_file.md", tmp_path / "episode.h5"
    save_episode(path, synthetic_episode(cameras={"overhead": 10}))
    assert first_column(page, "## Datasets of an action") == [c.name for c in CHANNELS]
    with h5py.File(path) as stored:
        assert {*first_column(page, "## Attributes of the file")} == {*stored.attrs}
        action = next(group for group in stored.values() if "images" in group)
        assert {*first_column(page, "## Attributes of an action")} == {*action.attrs}
        assert {*action} == {*(c.name for c in CHANNELS), "X_WG", "believed", "images"}
        documented = first_column(page, "## Executed commands")
        assert documented == [channel.name for channel in EXECUTED_COMMANDS]
        assert {*action["images/overhead"]} <= {*first_column(page, "## Images")}


def test_feasibility_study() -> None:
    page = "reference/feasibility_study.md"
    assert first_column(page, "### `moves.csv`") == [*MOVE_RECORD_FIELDS]
    assert first_column(page, "### `noise.csv`") == [*NOISE_RECORD_FIELDS]
    assert first_column(page, "### `sequences.csv`") == [*SEQUENCE_RECORD_FIELDS]
    assert first_column(page, "### `reach.csv`") == [*MAP_COLUMNS]
    assert first_column(page, "### `bases.csv`") == [*BASE_COLUMNS]
    assert first_column(page, "### `targets.csv`") == [*TARGET_COLUMNS]


def test_planning_failures() -> None:
    lines = section("explanation/motion_planning.md", "## Failure reasons").splitlines()
    reasons = [line.split("|")[1].strip() for line in lines if line.startswith("| ")][1:]
    assert reasons == [reason.value for reason in PlanningFailureReason]


def test_layers() -> None:
    rows = section("explanation/architecture.md", "# Architecture").splitlines()
    cells = [row.split("|")[1:3] for row in rows if re.match(r"\| \d", row)]
    layers = {int(number): {*re.findall(r"`(\w+)`", names)} for number, names in cells}
    assert layers == FLOORS
