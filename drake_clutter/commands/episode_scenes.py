"""Scenes of the episodes of a data set: scene files, a scene dataset, or a generator."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

from drake_clutter.agents.generators import (
    PRETRAINED_GENERATORS,
    GenerationJob,
    SceneGenerator,
    make_generation_agent,
)
from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.commands.evaluate_explorers import (
    EvaluationScene,
    common_cell,
    load_evaluation_scenes,
)
from drake_clutter.commands.explore_scene import settle_scene
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, file_sha256
from drake_clutter.grammar import NodeBudget
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge

GENERATORS = ("random", "hill-climbing", *PRETRAINED_GENERATORS)
"""Names of the scene generators; a checkpoint file is one, too."""
MAX_UNSTABLE_SCENES = 100
"""Number of unstable scenes in a row after which a generator or a graph is of no use."""


class SceneSource(Protocol):
    """Scenes by the number of their episode; picklable."""

    @property
    def name(self) -> str:
        """Name of the source."""

    @property
    def classes(self) -> frozenset[str]:
        """Names of the classes that the objects may have."""

    @property
    def cell(self) -> WorkCell:
        """Work cell for which the scenes were made."""

    def to_dict(self) -> dict[str, Any]:
        """Return everything that determines the scenes, for JSON."""

    def make_loader(self, config: ClutterConfig) -> "SceneLoader":
        """Return the loader of a worker process.

        Args:
            config: Configuration of the simulated world.
        """


class SceneLoader(Protocol):
    """Loads scenes in a worker process."""

    def __call__(self, index: int, /) -> tuple[Scene, str]:
        """Return the scene of an episode, at rest, and its name."""


@dataclass(frozen=True)
class FileScenes:
    """Scenes of files; the episodes repeat them in their order.

    Attributes:
        scenes: The scenes.
        catalog_folder: Asset folder with the user's object classes, or None.
    """

    scenes: Sequence[EvaluationScene]
    catalog_folder: Path | None

    @property
    def name(self) -> str:
        """Name of the scene dataset, or of the folder of the scene files."""
        first = self.scenes[0]
        return first.file.parent.name if first.index is None else first.file.stem

    @property
    def classes(self) -> frozenset[str]:
        """Names of the classes that the objects may have."""
        return frozenset[str]().union(*(scene.classes for scene in self.scenes))

    @property
    def cell(self) -> WorkCell:
        """Work cell for which the scenes were made.

        Raises:
            InputError: Two scenes were made in different cells.
        """
        return common_cell(self.scenes)

    def to_dict(self) -> dict[str, Any]:
        """Return names, number and hashes of the scenes, for JSON."""
        files = dict.fromkeys(scene.file for scene in self.scenes)
        return {
            "files": {file.name: file_sha256(file) for file in files},
            "num_scenes": len(self.scenes),
        }

    def make_loader(self, config: ClutterConfig) -> SceneLoader:
        """Return the loader of a worker process."""
        # Loaded by each worker: object classes are compared by identity.
        catalog = load_catalog(self.catalog_folder)
        load_dataset = cache(partial(load_scene_dataset, catalog=catalog))

        def load(index: int) -> tuple[Scene, str]:
            scene = self.scenes[index % len(self.scenes)]
            if scene.index is None:
                file = load_scene(scene.file, catalog)
                at_rest = (
                    settle_scene(file.scene, config, index)
                    if file.verdict is None
                    else file.settled_scene
                )
                return at_rest, scene.file.stem
            dataset = load_dataset(scene.file)
            name = f"{scene.file.stem} {scene.index}"
            if dataset.scenes[scene.index].settled_poses is not None:
                return dataset.settled_scene(scene.index, dataset.grammar, config), name
            # A training set holds graphs, and each episode lays out one anew.
            judge = DrakeJudge(config)
            for attempt in range(MAX_UNSTABLE_SCENES):
                rng = item_rng(index, attempt)
                laid_out = dataset.laid_out_scene(scene.index, dataset.grammar, config, rng)
                verdict = judge.judge(laid_out, rng)
                if verdict.stable:
                    return laid_out.with_poses(verdict.settled), name
            raise InputError(
                f"{name}: {MAX_UNSTABLE_SCENES} layouts in a row are not stable; expected a scene "
                "dataset of this work cell"
            )

        return load


@dataclass(frozen=True)
class GeneratedScenes:
    """Stable scenes of a generator, another one for each episode.

    Attributes:
        job: The generator.
    """

    job: GenerationJob

    @property
    def name(self) -> str:
        """Name of the generator."""
        return Path(self.job.agent).stem

    @property
    def classes(self) -> frozenset[str]:
        """Names of the classes that the objects may have."""
        catalog = load_catalog(self.job.catalog_folder)
        return frozenset(c.name for c in catalog.object_set(self.job.objects))

    @property
    def cell(self) -> WorkCell:
        """Work cell for which the scenes are made."""
        return self.job.config.cell

    def to_dict(self) -> dict[str, Any]:
        """Return the generator for JSON; the configuration and the seed are those of the job."""
        document = self.job.to_dict()
        return {key: document[key] for key in document if key not in ("config", "seed")}

    def make_loader(self, config: ClutterConfig) -> SceneLoader:
        """Return the loader of a worker process."""
        generator = SceneGenerator(replace(self.job, config=config))

        def load(index: int) -> tuple[Scene, str]:
            for attempt in range(MAX_UNSTABLE_SCENES):
                number = index * MAX_UNSTABLE_SCENES + attempt
                scene, verdict, _ = generator.generate(number)
                if verdict.stable:
                    return scene.with_poses(verdict.settled), f"{self.job.agent} {number}"
            raise InputError(
                f"--scenes {self.job.agent}: {MAX_UNSTABLE_SCENES} scenes in a row are not stable; "
                "expected another generator, or fewer nodes"
            )

        return load


def find_scenes(
    source: str,
    config: ClutterConfig,
    *,
    catalog_folder: Path | None = None,
    objects: str = "ycb7",
    nodes: int = 25,
    seed: int = 0,
) -> FileScenes | GeneratedScenes:
    """Return the scenes of a source.

    Args:
        source: Folder of scene files; scene dataset file; name of a shipped scene dataset; one of
            `GENERATORS`; or the checkpoint file of a generator.
        config: Configuration of the simulated world.
        catalog_folder: Asset folder with the user's object classes, or None.
        objects: Name of the object set of a generator.
        nodes: Number of nodes of a generator's graphs.
        seed: Seed of a generator.

    Raises:
        InputError: There is no such source, or it has no suitable scene.
    """
    if source not in GENERATORS and not source.endswith(".safetensors"):
        scenes = load_evaluation_scenes(source, catalog_folder, with_hidden_objects=False)
        return FileScenes(tuple(scenes), catalog_folder)
    job = GenerationJob(source, objects, catalog_folder, nodes, seed, config)
    NodeBudget(nodes)
    generated = GeneratedScenes(job)
    make_generation_agent(source, config, classes=generated.classes)
    return generated
