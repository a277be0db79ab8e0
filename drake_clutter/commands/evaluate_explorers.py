"""Evaluation of exploration policies on stable scenes with hidden objects."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from drake_clutter.agents.episode_evaluation import (
    EpisodeResult,
    EpisodeRunner,
    EpisodeSpec,
    summarize_episodes,
)
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, file_sha256, write_json
from drake_clutter.resources import git_commit, resource_path
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.validation import to_plain
from drake_clutter.workers.parallel_map import map_ordered

PAPER_MOVE_LIMIT = 10
"""Number of moves at which longer episodes are evaluated, too, as in Kumar et al. 2022."""


def move_limits(max_moves: int) -> list[int]:
    """Return the numbers of moves for which statistics are computed, ascending."""
    return sorted({min(PAPER_MOVE_LIMIT, max_moves), max_moves})


@dataclass(frozen=True)
class EvaluationScene:
    """Stable scene with hidden objects.

    Attributes:
        file: Scene file or scene dataset.
        index: Index of the scene in its set; None for a scene file.
        classes: Names of the classes that its objects may have.
        cell: Work cell that the scene was made with.
        num_objects: Number of its objects; 0 if the set has no settled poses.
    """

    file: Path
    index: int | None
    classes: frozenset[str]
    cell: WorkCell
    num_objects: int


def load_evaluation_scenes(source: str, catalog_folder: Path | None) -> list[EvaluationScene]:
    """Return the stable scenes with hidden objects of a folder or a scene dataset.

    Args:
        source: Folder of scene files, scene dataset file, or name of a shipped scene dataset.
        catalog_folder: Asset folder with the user's object classes, or None.

    Raises:
        InputError: There is no such source, a file cannot be used, or no scene is suitable.
    """
    catalog = load_catalog(catalog_folder)
    scenes = Path(source)
    if not scenes.exists():
        sets = {
            path.stem: path
            for path in resource_path("training/scenes").glob("*.json")
            if not path.stem.startswith("train_")
        }
        if source not in sets:
            allowed = f"a folder, a file, and {', '.join(sorted(sets))}"
            raise InputError(f"--scenes {source}: does not exist; expected {allowed}")
        scenes = sets[source]
    if scenes.is_file():
        dataset = load_scene_dataset(scenes, catalog)
        classes = frozenset(c.name for c in dataset.classes)
        return [
            EvaluationScene(scenes, number, classes, dataset.cell, len(scene.settled_poses or ()))
            for number, scene in enumerate(dataset.scenes)
        ]
    paths = sorted(scenes.glob("*.yaml"))
    if not paths:
        raise InputError(
            f"{scenes}: holds no scene files (*.yaml); give the `scenes` folder that `generate` "
            "wrote, or a scene dataset"
        )
    evaluation_scenes = []
    for path in paths:
        file = load_scene(path, catalog)
        if file.verdict is not None and file.verdict.hidden:
            names = frozenset(o.object_class.name for o in file.scene.objects)
            evaluation_scenes.append(
                EvaluationScene(path, None, names, file.cell, len(file.scene.objects))
            )
    if not evaluation_scenes:
        raise InputError(
            f"{scenes}: none of {len(paths)} scenes is stable and has hidden objects; expected "
            "scenes that `generate` judged so"
        )
    return evaluation_scenes


def common_cell(scenes: Sequence[EvaluationScene]) -> WorkCell:
    """Return the cell in which all scenes were made, with the support of the first.

    Raises:
        InputError: Two scenes were made in different cells.
    """
    first = scenes[0]
    for scene in scenes:
        if scene.cell.with_support(first.cell.support) != first.cell:
            found = f"{scene.file.name} was made in another cell than {first.file.name}"
            raise InputError(f"--scenes: {found}; expected scenes of one cell, or --cell")
    return first.cell


def evaluate_explorers(
    scenes: Sequence[EvaluationScene],
    agents: Sequence[str],
    max_moves: int,
    fidelity: str,
    seed: int,
    config: ClutterConfig,
    catalog_folder: Path | None,
    workers: int,
    out: Path | None,
    progress: Callable[[Iterable[Any], int], Iterable[EpisodeResult]],
    ray_address: str | None = None,
) -> list[dict[str, Any]]:
    """Run every policy on every scene and return statistics by policy.

    Statistics are over the scenes with objects that are hidden from the camera of `config`.

    Args:
        scenes: The scenes.
        agents: Names of the policies; repeated names are ignored.
        max_moves: Maximum number of moves per episode.
        fidelity: Fidelity at which moves are executed, one of `FIDELITIES`.
        seed: Seed of policies and simulation.
        config: Configuration.
        catalog_folder: Asset folder with the user's object classes, or None.
        workers: Number of worker processes.
        out: JSON file for statistics, episodes, commit and hashes of the scenes; or None.
        progress: Wraps the results, given the number of episodes.
        ray_address: Address of the Ray cluster that runs the workers; None runs them locally.

    Returns:
        Statistics of each policy; see `summarize_episodes`.

    Raises:
        InputError: A policy does not exist or was not trained with the classes of the scenes, `out`
            cannot be written, or no scene hides an object.
    """
    if out is not None and (out.is_dir() or not out.parent.is_dir()):
        raise InputError(
            f"--out {out}: is a folder, or its folder does not exist; expected a file in an"
            " existing folder"
        )
    agents = list(dict.fromkeys(agents))
    classes = frozenset[str]().union(*(scene.classes for scene in scenes))
    for agent in agents:
        make_policy_factory(agent, config, classes)  # raises before any episode is run
    episodes = [
        EpisodeSpec(scene.file, scene.index, agent, index)
        for agent in agents
        for index, scene in enumerate(scenes)
    ]
    make_worker = partial(EpisodeRunner, config, catalog_folder, max_moves, seed, fidelity)
    results_in_order = map_ordered(make_worker, episodes, workers=workers, ray_address=ray_address)
    results = [result for result in progress(results_in_order, len(episodes)) if result.hidden]
    if not results:
        raise InputError(
            f"--scenes: none of {len(scenes)} scenes has objects that are hidden from the "
            "configured camera; expected scenes with hidden objects"
        )
    max_objects = max(scene.num_objects for scene in scenes)
    rows = [
        {"agent": agent}
        | summarize_episodes(
            [result for result in results if result.agent == agent],
            move_limits(max_moves),
            max_objects,
        )
        for agent in agents
    ]
    if out is None:
        return rows
    scene_paths = sorted({scene.file for scene in scenes})
    fields = {
        "max_moves": max_moves,
        "seed": seed,
        "fidelity": fidelity,
        "config": to_plain(config),
        "rows": rows,
    }
    fields |= {
        "commit": git_commit(),
        "scenes": {str(file): file_sha256(file) for file in scene_paths},
    }
    write_json(out, fields | {"episodes": [asdict(result) for result in results]})
    return rows
