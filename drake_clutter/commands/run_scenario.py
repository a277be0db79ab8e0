"""`drake-clutter run` and `demo`: the closed loop, from images to the arm's motion, with a page to watch."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.explore_scene import TransitionCallback, settle_scene, write_episode
from drake_clutter.files import InputError, write_text
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.systems.closed_loop import ClosedLoop, Timing
from drake_clutter.systems.scenario import Scenario, make_perception, make_policy
from drake_clutter.tasks.arm_reachability_bound import ArmReachabilityBound
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, TerminationReason
from drake_clutter.validation import config_yaml

MAX_DEMO_SCENES = 5
"""Scenes that the demo explores at most."""
MAX_GENERATED_SCENES = 50
"""Scenes that a generator may make until one is stable and hides something."""


def load_or_generate_scene(
    scenario: Scenario, first_index: int = 0, is_suitable: Callable[[Scene], bool] = lambda _: True
) -> tuple[Scene, int]:
    """The scenario's scene at rest, and the index under which the generator made it; from `first_index` on, the first that suits.

    Raises:
        InputError: a scene file that cannot be used, or a generator that makes no such scene that is stable and hides something.
    """
    catalog = Path(scenario.catalog) if scenario.catalog else None
    if scenario.scene:
        file = load_scene(Path(scenario.scene), load_catalog(catalog))
        judged = file.verdict is not None and file.verdict.stable
        return (
            file.settled_scene
            if judged
            else settle_scene(file.scene, scenario.world, scenario.seed)
        ), 0
    job = GenerationJob(
        scenario.generator,
        scenario.objects,
        catalog,
        scenario.nodes,
        scenario.seed,
        scenario.world,
    )
    generator = SceneGenerator(job)
    for index in range(first_index, first_index + MAX_GENERATED_SCENES):
        generated = generator(index)
        if generated.verdict.hidden and is_suitable(
            scene := generated.scene.with_poses(generated.verdict.settled)
        ):
            return scene, index
    raise InputError(
        f"generator: none of {MAX_GENERATED_SCENES} scenes by {scenario.generator} is stable, hides something and suits"
    )


def run_closed_loop(
    scenario: Scenario, scene: Scene, on_transition: TransitionCallback
) -> tuple[ExplorationTask, Timing]:
    """Plays a scenario on a scene at rest."""
    policy = make_policy(scenario.agent, scenario.world)
    perceive = make_perception(scenario, scene.support)
    closed_loop = ClosedLoop(
        scene,
        perceive=perceive,
        seed=scenario.seed,
        world=scenario.world,
        record_motion=True,
    )
    task = run_episode(
        closed_loop, policy, max_moves=scenario.max_moves, on_transition=on_transition
    )
    return task, closed_loop.timing


def write_scenario_results(
    out: Path,
    scenario: Scenario,
    task: ExplorationTask,
    timing: Timing,
    title: str,
    **extra_fields: int,
) -> dict[str, Any]:
    """Writes `scenario.yaml`, `scene.yaml`, `episode.json`, `trajectory.h5` and the page; returns what `episode.json` holds."""
    write_text(out / "scenario.yaml", config_yaml(scenario))
    save_scene(out / "scene.yaml", task.initial_scene, scenario.world.cell)
    told: dict[str, Any] = {"timing": asdict(timing), **extra_fields}
    return write_episode(
        out, task, title, scenario.agent, "arm", scenario.seed, scenario.world, extra_fields=told
    )


def run_scenario(
    scenario: Scenario, out: Path, on_transition: TransitionCallback
) -> dict[str, Any]:
    """Plays a scenario; see `write`."""
    scene, _ = load_or_generate_scene(scenario)
    task, timing = run_closed_loop(scenario, scene, on_transition)
    return write_scenario_results(
        out,
        scenario,
        task,
        timing,
        f"{scenario.agent} and the arm search {Path(scenario.scene).name or 'a scene'}",
    )


def run_demo(scenario: Scenario, out: Path, on_transition: TransitionCallback) -> dict[str, Any]:
    """SG* makes scenes, and the arm searches them by depth images alone, until everything is found in one; see `write`.

    Scenes in which no arm finds everything are passed over.
    """
    arm_bound, index = ArmReachabilityBound(scenario.world), -1
    for num_scenes in range(1, MAX_DEMO_SCENES + 1):  # noqa: B007, the last one is told
        scene, index = load_or_generate_scene(
            scenario, index + 1, lambda scene: not arm_bound.find_unrevealable(scene)
        )
        task, timing = run_closed_loop(scenario, scene, on_transition)
        if task.termination is TerminationReason.ALL_FOUND:
            break
    return write_scenario_results(
        out,
        scenario,
        task,
        timing,
        f"SG* hides, the arm searches: seed {scenario.seed}, scene {index}",
        scenes_tried=num_scenes,
    )
