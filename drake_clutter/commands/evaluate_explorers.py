"""Evaluation of exploration policies on stable scenes with hidden objects."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
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
from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, file_sha256, read_json, reading_file, write_json
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.outputs import output_file
from drake_clutter.records import partial_records, resume_jsonl
from drake_clutter.resources import git_commit, resource_path
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.validation import to_plain, validate
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


def load_evaluation_scenes(
    source: str, catalog_folder: Path | None, *, with_hidden_objects: bool = True
) -> list[EvaluationScene]:
    """Return the scenes of a folder, a scene file, or a scene dataset.

    Args:
        source: Folder of scene files, scene file (.yaml), scene dataset file, or name of a shipped
            scene dataset.
        catalog_folder: Asset folder with the user's object classes, or None.
        with_hidden_objects: Whether scene files are left out that are not stable with hidden
            objects. Otherwise those are left out that a judge has found not to be stable.

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
    is_scene_file = scenes.is_file() and scenes.suffix in (".yaml", ".yml")
    if scenes.is_file() and not is_scene_file:
        dataset = load_scene_dataset(scenes, catalog)
        classes = frozenset(c.name for c in dataset.classes)
        return [
            EvaluationScene(scenes, number, classes, dataset.cell, len(scene.settled_poses or ()))
            for number, scene in enumerate(dataset.scenes)
        ]
    paths = [scenes] if is_scene_file else sorted(scenes.glob("*.yaml"))
    if not paths:
        raise InputError(
            f"{scenes}: holds no scene files (*.yaml); give the `scenes` folder that `generate` "
            "wrote, or a scene dataset"
        )
    evaluation_scenes = []
    for path in paths:
        file = load_scene(path, catalog)
        verdict = file.verdict
        is_suitable = (
            verdict is not None and bool(verdict.hidden)
            if with_hidden_objects
            else verdict is None or verdict.stable
        )
        if is_suitable:
            names = frozenset(o.object_class.name for o in file.scene.objects)
            evaluation_scenes.append(
                EvaluationScene(path, None, names, file.cell, len(file.scene.objects))
            )
    if not evaluation_scenes:
        wanted = "is stable and has hidden objects" if with_hidden_objects else "is stable"
        raise InputError(
            f"{scenes}: none of {len(paths)} scenes {wanted}; expected scenes that `generate` "
            "judged so"
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


@dataclass(frozen=True)
class ExplorerEvaluation:
    """Evaluation of exploration policies.

    Attributes:
        scenes: The scenes.
        agents: Names of the policies; repeated names are ignored.
        max_moves: Maximum number of moves per episode.
        fidelity: Fidelity at which moves are executed, one of `FIDELITIES`.
        seed: Seed of policies and simulation.
        config: Configuration.
        catalog_folder: Asset folder with the user's object classes, or None.
    """

    scenes: Sequence[EvaluationScene]
    agents: Sequence[str]
    max_moves: int
    fidelity: str
    seed: int
    config: ClutterConfig
    catalog_folder: Path | None

    @property
    def episodes(self) -> list[EpisodeSpec]:
        """The episodes: every policy on every scene."""
        return [
            EpisodeSpec(scene.file, scene.index, agent, index)
            for agent in dict.fromkeys(self.agents)
            for index, scene in enumerate(self.scenes)
        ]

    def check_agents(self) -> None:
        """Raise an InputError if there is no such policy, or it does not know the classes."""
        classes = frozenset[str]().union(*(scene.classes for scene in self.scenes))
        for agent in self.agents:
            make_policy_factory(agent, self.config, classes)

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the results, for JSON."""
        folder = str(self.catalog_folder.resolve()) if self.catalog_folder else None
        agents = dict.fromkeys(self.agents)
        hashes = {str(scene.file): file_sha256(scene.file) for scene in self.scenes}
        return {
            "max_moves": self.max_moves,
            "seed": self.seed,
            "fidelity": self.fidelity,
            "config": to_plain(self.config),
            "catalog_folder": folder,
            "agents": {name: checkpoint_sha256(name, PRETRAINED_EXPLORERS) for name in agents},
            "scenes": hashes,
            "num_scenes": len(self.scenes),
        }

    def summarize(self, results: Sequence[EpisodeResult]) -> list[dict[str, Any]]:
        """Return statistics of each policy; see `summarize_episodes`.

        Args:
            results: Results of all episodes.

        Raises:
            InputError: No scene has objects that are hidden from the camera of the configuration.
        """
        limits = move_limits(self.max_moves)
        max_objects = max(scene.num_objects for scene in self.scenes)
        rows = list[dict[str, Any]]()
        for agent in dict.fromkeys(self.agents):
            hidden = [result for result in results if result.hidden and result.agent == agent]
            if not hidden:
                raise InputError(
                    f"--scenes: none of {len(self.scenes)} scenes has objects that are hidden from "
                    "the configured camera; expected scenes with hidden objects"
                )
            rows.append({"agent": agent} | summarize_episodes(hidden, limits, max_objects))
        return rows


def evaluate_explorers(
    evaluation: ExplorerEvaluation,
    workers: int,
    out: Path | None,
    progress: Callable[[Iterable[EpisodeResult], int, int], Iterable[EpisodeResult]],
    ray_address: str | None = None,
) -> list[dict[str, Any]]:
    """Run every policy on every scene and return statistics by policy.

    Statistics are over the scenes with objects that are hidden from the camera of the
    configuration. With an output file, an interrupted evaluation is resumed, and the rows of a
    finished one are returned.

    Args:
        evaluation: What is evaluated.
        workers: Number of worker processes.
        out: JSON file for statistics, episodes, commit and hashes of the scenes; or None.
        progress: Wraps the new results, given the number of existing results and of all episodes.
        ray_address: Address of the Ray cluster that runs the workers; None runs them locally.

    Returns:
        Statistics of each policy; see `summarize_episodes`.

    Raises:
        InputError: A policy does not exist or was not trained with the classes of the scenes, `out`
            cannot be written or holds other results, or no scene hides an object.
    """
    if out is not None and (out.is_dir() or not out.parent.is_dir()):
        raise InputError(
            f"--out {out}: is a folder, or its folder does not exist; expected a file in an"
            " existing folder"
        )
    evaluation.check_agents()
    episodes = evaluation.episodes
    make_worker = partial(
        EpisodeRunner,
        evaluation.config,
        evaluation.catalog_folder,
        evaluation.max_moves,
        evaluation.seed,
        evaluation.fidelity,
    )

    def run_episodes(num_done: int) -> Iterator[EpisodeResult]:
        results = map_ordered(
            make_worker, episodes[num_done:], workers=workers, ray_address=ray_address
        )
        yield from progress(results, num_done, len(episodes))

    if out is None:
        return evaluation.summarize(list(run_episodes(0)))
    header = evaluation.to_dict()
    with output_file(out), partial_records(out) as path:
        if out.exists():
            return _read_rows(out, header)
        lines = resume_jsonl(
            path, header, lambda done: map(asdict, run_episodes(done)), EpisodeResult
        )
        with closing(lines):
            _, *records = lines
        rows = evaluation.summarize([EpisodeResult.from_record(record) for record in records])
        episodes_with_hidden = [record for record in records if record["hidden"]]
        fields = {"commit": git_commit(), "rows": rows, "episodes": episodes_with_hidden}
        write_json(out, header | fields)
    return rows


def _read_rows(out: Path, header: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the statistics in the file of a finished evaluation.

    Raises:
        InputError: The file cannot be read, or is of another evaluation.
    """
    expected = "a new file, or one of the same evaluation"
    with reading_file(f"--out {out}", expected):
        document = validate(dict[str, Any], read_json(out, expected), str(out))
        differing = [key for key, value in header.items() if document.get(key) != value]
        if not differing:
            return validate(list[dict[str, Any]], document["rows"], f"{out}: rows")
    raise InputError(
        f"--out {out}: exists and holds other results ({', '.join(differing)}); give {expected}"
    )
