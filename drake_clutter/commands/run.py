"""`drake-clutter run` and `demo`: the closed loop, from images to the arm's motion, with a page to watch."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drake_clutter.agents.generation import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.explore import Report, at_rest, write_episode
from drake_clutter.files import InputError, write_text
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.systems.closed_loop import ClosedLoop, Timing
from drake_clutter.systems.scenario import Scenario, perception_of, policy_of
from drake_clutter.tasks.arm_ceiling import ArmCeiling
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration import EpisodeEnd, ExplorationTask
from drake_clutter.validation import config_yaml

DEMO_TRIES = 5
"""Scenes that the demo explores at most."""
SCENE_TRIES = 50
"""Scenes that a generator may make until one is stable and hides something."""


def scene_of(
    scenario: Scenario, first: int = 0, suits: Callable[[Scene], bool] = lambda _: True
) -> tuple[Scene, int]:
    """The scenario's scene at rest, and the index under which the generator made it; from `first` on, the first that suits.

    Raises:
        InputError: a scene file that cannot be used, or a generator that makes no such scene that is stable and hides something.
    """
    catalog = Path(scenario.catalog) if scenario.catalog else None
    if scenario.scene:
        file = load_scene(Path(scenario.scene), load_catalog(catalog))
        judged = file.verdict is not None and file.verdict.stable
        return (
            file.settled_scene if judged else at_rest(file.scene, scenario.world, scenario.seed)
        ), 0
    job = GenerationJob(
        scenario.generator,
        scenario.objects,
        catalog,
        scenario.nodes,
        scenario.seed,
        scenario.world,
    )
    generate = SceneGenerator(job)
    for index in range(first, first + SCENE_TRIES):
        made = generate(index)
        if made.verdict.hidden and suits(scene := made.scene.with_poses(made.verdict.settled)):
            return scene, index
    raise InputError(
        f"generator: none of {SCENE_TRIES} scenes by {scenario.generator} is stable, hides something and suits"
    )


def play(scenario: Scenario, scene: Scene, report: Report) -> tuple[ExplorationTask, Timing]:
    """Plays a scenario on a scene at rest."""
    policy = policy_of(scenario.agent, scenario.world)
    perceive = perception_of(scenario, scene.support)
    loop = ClosedLoop(
        scene,
        perceive=perceive,
        seed=scenario.seed,
        world=scenario.world,
        record=True,
    )
    task = run_episode(loop, policy, max_moves=scenario.max_moves, report=report)
    return task, loop.timing


def write(
    out: Path, scenario: Scenario, task: ExplorationTask, timing: Timing, title: str, **more: int
) -> dict[str, Any]:
    """Writes `scenario.yaml`, `scene.yaml`, `episode.json`, `trajectory.h5` and the page; returns what `episode.json` holds."""
    write_text(out / "scenario.yaml", config_yaml(scenario))
    save_scene(out / "scene.yaml", task.start, scenario.world.cell)
    told: dict[str, Any] = {"timing": asdict(timing), **more}
    return write_episode(
        out, task, title, scenario.agent, "arm", scenario.seed, scenario.world, more=told
    )


def run(scenario: Scenario, out: Path, report: Report) -> dict[str, Any]:
    """Plays a scenario; see `write`."""
    scene, _ = scene_of(scenario)
    task, timing = play(scenario, scene, report)
    return write(
        out,
        scenario,
        task,
        timing,
        f"{scenario.agent} and the arm search {Path(scenario.scene).name or 'a scene'}",
    )


def demo(scenario: Scenario, out: Path, report: Report) -> dict[str, Any]:
    """SG* makes scenes, and the arm searches them by depth images alone, until everything is found in one; see `write`.

    Scenes in which no arm finds everything are passed over.
    """
    ceiling, index = ArmCeiling(scenario.world), -1
    for tried in range(1, DEMO_TRIES + 1):  # noqa: B007, the last one is told
        scene, index = scene_of(scenario, index + 1, lambda scene: not ceiling.never_found(scene))
        task, timing = play(scenario, scene, report)
        if task.end is EpisodeEnd.ALL_FOUND:
            break
    return write(
        out,
        scenario,
        task,
        timing,
        f"SG* hides, the arm searches: seed {scenario.seed}, scene {index}",
        scenes_tried=tried,
    )
