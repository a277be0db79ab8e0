"""`drake-clutter evaluate`: explorers on scenes at rest that hide something."""

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
"""Moves at which a longer search is read, too (SPEC section 6)."""


def move_limits(max_moves: int) -> list[int]:
    """Numbers of moves for which there are figures."""
    return sorted({min(PAPER_MOVE_LIMIT, max_moves), max_moves})


@dataclass(frozen=True)
class EvaluationScene:
    """A scene at rest that hides something.

    Attributes:
        file: a scene file, or a set.
        index: in the set; None for a scene file.
        classes: names of those that its objects may have.
        cell: that it was made with.
    """

    file: Path
    index: int | None
    classes: frozenset[str]
    cell: WorkCell


def load_evaluation_scenes(source: str, catalog_folder: Path | None) -> list[EvaluationScene]:
    """Scenes at rest that hide something: files of a folder that were judged stable, or a frozen set with each number.

    Args:
        source: a folder, a set's file, or the name of a set that is shipped.
        catalog_folder: with object classes of one's own.

    Raises:
        InputError: nothing of that name, no scene files, one that is broken, or none that can be played.
    """
    catalog, scenes = load_catalog(catalog_folder), Path(source)
    if not scenes.exists():
        sets = {
            path.stem: path
            for path in resource_path("training/scenes").glob("*.json")
            if not path.stem.startswith("train_")
        }
        if source not in sets:
            raise InputError(
                f"--scenes {source}: is not there; allowed are a folder, a file, and {', '.join(sorted(sets))}"
            )
        scenes = sets[source]
    if scenes.is_file():
        scene_set = load_scene_dataset(scenes, catalog)
        classes = frozenset(c.name for c in scene_set.classes)
        return [
            EvaluationScene(scenes, number, classes, scene_set.cell)
            for number in range(len(scene_set.scenes))
        ]
    paths = sorted(scenes.glob("*.yaml"))
    if not paths:
        raise InputError(
            f"{scenes}: holds no scene files (*.yaml); give the `scenes` folder that `generate` wrote, or a set of scenes"
        )
    evaluation_scenes = []
    for path in paths:
        file = load_scene(path, catalog)
        if file.verdict is not None and file.verdict.hidden:
            names = frozenset(o.object_class.name for o in file.scene.objects)
            evaluation_scenes.append(EvaluationScene(path, None, names, file.cell))
    if not evaluation_scenes:
        raise InputError(
            f"{scenes}: none of {len(paths)} scenes was judged stable and hides something; allowed are such scenes"
        )
    return evaluation_scenes


def common_cell(scenes: Sequence[EvaluationScene]) -> WorkCell:
    """Return the cell in which all of the scenes were made; its support is the first one's.

    Raises:
        InputError: Two were made in different cells.
    """
    first = scenes[0]
    for scene in scenes:
        if scene.cell.with_support(first.cell.support) != first.cell:
            found = f"{scene.file.name} was made in another cell than {first.file.name}"
            raise InputError(f"--scenes: {found}; allowed are scenes of one cell, or --cell")
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
    """Plays every agent on every scene; `out`: JSON with the rows, every episode, and commit and hashes of the scenes.

    Rows are of the scenes that hide something as the config's camera sees them.

    Raises:
        InputError: an agent that there is not or that does not know the objects, no place for `out`, or nothing is hidden.
    """
    if out is not None and (out.is_dir() or not out.parent.is_dir()):
        raise InputError(
            f"--out {out}: is a folder, or in none; allowed is a file in a folder that exists"
        )
    agents, classes = (
        list(dict.fromkeys(agents)),
        frozenset[str]().union(*(scene.classes for scene in scenes)),
    )
    for agent in agents:
        make_policy_factory(agent, config, classes)  # says what is wrong before anything is played
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
            f"--scenes: none of {len(scenes)} hides anything from the camera of --config; give scenes that do"
        )
    rows = [
        {"agent": agent}
        | summarize_episodes(
            [result for result in results if result.agent == agent], move_limits(max_moves)
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
