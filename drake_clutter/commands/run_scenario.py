"""Closed-loop exploration, from camera images to simulated arm motion."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS
from drake_clutter.agents.generators import (
    PRETRAINED_GENERATORS,
    GenerationJob,
    SceneGenerator,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.explore_scene import (
    EPISODE_FILE,
    TransitionCallback,
    settle_scene,
    write_episode,
)
from drake_clutter.commands.job_file import open_job_folder, read_result
from drake_clutter.files import InputError, file_sha256, reading_file, write_text
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.station.motion_recorder import DEFAULT_RATE
from drake_clutter.systems.closed_loop import ClosedLoop, Timing
from drake_clutter.systems.scenario import (
    PRETRAINED_DETECTORS,
    Scenario,
    class_names,
    make_perception,
    make_policy,
)
from drake_clutter.systems.station_camera import render_empty_depth
from drake_clutter.tasks.arm_reachability_bound import ArmReachabilityBound
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import ExplorationTask, StopCriterion
from drake_clutter.tasks.stopping import StoppingPolicy
from drake_clutter.validation import config_yaml, to_plain

MAX_DEMO_SCENES = 5
"""Maximum number of scenes that the demo explores; the arm may fail in one of them."""
MAX_GENERATED_SCENES = 50
"""Maximum number of scenes that are generated until one is stable and has hidden objects."""


def load_or_generate_scene(
    scenario: Scenario, first_index: int = 0, is_suitable: Callable[[Scene], bool] = lambda _: True
) -> tuple[Scene, int]:
    """Return the scene of a scenario at rest, and its index among the generated scenes.

    Args:
        scenario: The scenario.
        first_index: Index of the first scene to generate.
        is_suitable: Whether a generated scene may be returned.

    Raises:
        InputError: The scene file cannot be used, or no generated scene is stable, has hidden
            objects and is suitable.
    """
    catalog = Path(scenario.catalog) if scenario.catalog else None
    if scenario.scene:
        file = load_scene(Path(scenario.scene), load_catalog(catalog))
        if file.verdict is not None and file.verdict.stable:
            return file.settled_scene, 0
        return settle_scene(file.scene, scenario.world, scenario.seed), 0
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
        if not generated.verdict.hidden:
            continue
        scene = generated.scene.with_poses(generated.verdict.settled)
        if is_suitable(scene):
            return scene, index
    raise InputError(
        f"generator: none of {MAX_GENERATED_SCENES} scenes by {scenario.generator} is stable, has "
        "hidden objects and can be explored completely by the arm"
    )


def run_closed_loop(
    scenario: Scenario, scene: Scene, on_transition: TransitionCallback
) -> tuple[ExplorationTask, Timing]:
    """Run the episode of a scenario in closed loop.

    Args:
        scenario: The scenario.
        scene: Scene at rest.
        on_transition: Called after each move.

    Returns:
        The episode, and the times that it took.
    """
    policy = make_policy(scenario.agent, scenario.world, class_names(scene))
    until = StopCriterion(scenario.until)
    catalog = load_catalog(Path(scenario.catalog) if scenario.catalog else None)
    classes = catalog.smallest_set(class_names(scene))
    if until is StopCriterion.BELIEF:
        policy = StoppingPolicy(
            policy,
            classes,
            render_empty_depth(scenario.world.cell.with_support(scene.support)),
            scenario.world.exploration.belief,
        )
    perceive = make_perception(scenario, scene)
    closed_loop = ClosedLoop(
        scene,
        perceive=perceive,
        seed=scenario.seed,
        config=scenario.world,
        rate=DEFAULT_RATE,
        classes=() if perceive is None else classes,
    )
    task = run_episode(
        closed_loop,
        policy,
        max_moves=scenario.max_moves,
        on_transition=on_transition,
        until=until,
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
    """Write the files of a closed-loop episode.

    These are `scenario.yaml`, `scene.yaml`, `episode.json`, `trajectory.h5` and the web page.

    Args:
        out: Output folder.
        scenario: The scenario.
        task: The episode.
        timing: The times that it took.
        title: Title of the page.
        extra_fields: Additional fields of `episode.json`.

    Returns:
        The document of `episode.json`.
    """
    write_text(out / "scenario.yaml", config_yaml(scenario))
    save_scene(out / "scene.yaml", task.initial_scene, scenario.world.cell)
    return write_episode(
        out,
        task,
        title,
        scenario.agent,
        "arm",
        scenario.seed,
        scenario.world,
        extra_fields={"timing": asdict(timing), **extra_fields},
    )


def _scenario_job(command: str, scenario: Scenario) -> dict[str, Any]:
    """Return the job document of a command that runs a scenario."""
    weights = {
        "generator": checkpoint_sha256(scenario.generator, PRETRAINED_GENERATORS),
        "agent": checkpoint_sha256(scenario.agent, PRETRAINED_EXPLORERS),
        "perception": checkpoint_sha256(scenario.perception, PRETRAINED_DETECTORS),
    }
    scene_hash = ""
    if scenario.scene:
        with reading_file(scenario.scene, "a scene file"):
            scene_hash = file_sha256(Path(scenario.scene))
    return {
        "command": command,
        "scenario": to_plain(scenario),
        "scene_sha256": scene_hash,
        "weights": weights,
    }


def run_scenario(
    scenario: Scenario, out: Path, on_transition: TransitionCallback
) -> dict[str, Any]:
    """Run a scenario and write its results; see `write_scenario_results`.

    Results that the folder already holds are returned.
    """
    with open_job_folder(out, _scenario_job("run", scenario)):
        if (episode := read_result(out / EPISODE_FILE)) is not None:
            return dict(episode)
        scene, _ = load_or_generate_scene(scenario)
        task, timing = run_closed_loop(scenario, scene, on_transition)
        return write_scenario_results(
            out,
            scenario,
            task,
            timing,
            f"{scenario.agent} explores {Path(scenario.scene).name or 'a scene'} with the arm",
        )


def run_demo(scenario: Scenario, out: Path, on_transition: TransitionCallback) -> dict[str, Any]:
    """Explore generated scenes from depth images until all objects of one are found.

    Writes the results of the last scene; see `write_scenario_results`. Results that the folder
    already holds are returned. Scenes in which the arm cannot reveal every object are skipped.
    """
    with open_job_folder(out, _scenario_job("demo", scenario)):
        if (episode := read_result(out / EPISODE_FILE)) is not None:
            return dict(episode)
        arm_bound = ArmReachabilityBound(scenario.world)
        index = -1
        for num_scenes in range(1, MAX_DEMO_SCENES + 1):  # noqa: B007, used after the loop
            scene, index = load_or_generate_scene(
                scenario, index + 1, lambda scene: not arm_bound.find_unrevealable(scene)
            )
            task, timing = run_closed_loop(scenario, scene, on_transition)
            if task.is_success:
                break
        return write_scenario_results(
            out,
            scenario,
            task,
            timing,
            f"Closed-loop exploration of an SG* scene (seed {scenario.seed}, scene {index})",
            scenes_tried=num_scenes,
        )
