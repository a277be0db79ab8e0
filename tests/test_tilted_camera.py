"""A cell whose camera is tilted, from a generated scene to the closed loop."""

import pytest

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import largest_clear
from drake_clutter.cell.work_cell import load_cell
from drake_clutter.commands.run_scenario import load_or_generate_scene
from drake_clutter.commands.run_scenario import run_closed_loop as play_loop
from drake_clutter.config import ClutterConfig
from drake_clutter.resources import resource_path
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.systems.scenario import Scenario
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason

WORLD = ClutterConfig(cell=load_cell(resource_path("models/cells/ur10_tilted_camera.yaml")))
SCENARIO = Scenario(generator="random", nodes=8, agent="largest-clear", max_moves=4, world=WORLD)


@pytest.fixture(scope="module")
def generated() -> Scene:
    """A scene at rest in which the tilted camera does not see something."""
    return load_or_generate_scene(SCENARIO)[0]


@pytest.mark.parametrize("fidelity", ["static_or_drake", "settle", "arm"])
def test_scenes_are_explored(fidelity: str, generated: Scene) -> None:
    """The moves that are offered can be made, and what they uncover is found."""
    backend = make_backend_factory(fidelity, WORLD)(generated, item_rng(0))
    assert backend.perception.observation.camera == WORLD.cell.camera
    task = run_episode(backend, largest_clear, max_moves=4)
    assert task.transitions
    assert task.transitions[0].outcome.result is MoveResult.PLACED
    assert task.termination is TerminationReason.ALL_FOUND


def test_the_closed_loop(generated: Scene) -> None:
    task, _ = play_loop(SCENARIO, generated, lambda _: None)
    assert task.transitions
    assert task.termination is TerminationReason.ALL_FOUND
