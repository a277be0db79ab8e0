r"""Generate a dataset of stable scenes for explorers: one JSON file.

    python training/generate_scene_dataset.py --seed 100 --work runs/train --out train.json
    python training/generate_scene_dataset.py --with-poses --count 300 --seed 9000 \
        --work runs/test --out test.json

Every scene is stable and hides at least one object, by Drake's verdict. No scene graph is repeated,
nor one of the sets given by `--exclude`, up to symmetry.

A training set (the default) holds graphs, which an environment lays out again in every episode. Its
scenes are also stable by the static model, and can be disassembled. A test set (`--with-poses`)
also holds the poses in which the objects came to rest.

The verdicts are kept in the folder `--work`. An interrupted run is resumed by the same command.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import typer
from pydantic import BaseModel, model_validator

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import Catalog, load_catalog
from drake_clutter.commands.generate_scenes import (
    PROGRESS_FILE,
    SCENES_FOLDER,
    generate_scenes,
    read_generation_progress,
)
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.grammar import canonical_form
from drake_clutter.records import resume_jsonl
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene_dataset import SceneRecord, load_scene_dataset, save_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.generation_task import GenerationTaskConfig
from drake_clutter.validation import CountOrZero, Flag, NonEmptyText, allowed_error
from drake_clutter.workers.parallel_map import map_ordered
from training.results_file import provenance
from training.script import CatalogOption, SeedOption, WorkersOption, progress, run_script

MAX_GENERATED_PER_SCENE = 20
"""Number of scenes that are generated at most for each scene of the dataset."""
OVERSAMPLING = 1.1
"""Factor by which more scenes are generated than are missing."""
VERDICTS_FILE = "judged.jsonl"
"""Record file of a training set's verdicts, in the folder `--work`."""


def read_stable_scenes(folder: Path, catalog: Catalog, count: int) -> Iterator[SceneRecord]:
    """Yield the stable scenes with hidden objects of a folder that `generate` wrote.

    Args:
        folder: The folder.
        catalog: Object classes.
        count: Number of scenes that are read; the folder may hold more, if a run was interrupted.
    """
    solvable = read_generation_progress(folder / PROGRESS_FILE).solvable[:count]
    for index, answer in enumerate(solvable):
        file = load_scene(folder / SCENES_FOLDER / f"{index:04d}.yaml", catalog)
        assert file.verdict is not None
        assert file.scene.graph is not None
        if file.verdict.stable and file.verdict.hidden:
            settled = tuple(file.verdict.settled[name] for name in file.scene.names)
            form = canonical_form(file.scene.graph, catalog.classes)
            solvability = "" if answer is None else answer.value
            num_hidden = len(file.verdict.hidden)
            yield SceneRecord(file.scene.derivation, form, num_hidden, solvability, settled)


class GraphVerdict(BaseModel):
    """Record of a scene graph; see `GraphJudge`."""

    fast: Flag
    fell: str | None = None
    rules: tuple[NonEmptyText, ...] = ()
    form: str = ""
    hidden: CountOrZero = 0

    @model_validator(mode="after")
    def _check_graph(self) -> Self:
        if self.hidden and not (self.rules and self.form):
            raise allowed_error("rules and form of the graph in which objects are hidden")
        return self


class GraphJudge:
    """Generates and judges the scenes of a training set; a worker for `map_ordered`."""

    def __init__(self, job: GenerationJob) -> None:
        """Create the generator and the judges.

        Args:
            job: What is generated.
        """
        self._job = job
        self._generator = SceneGenerator(job)
        self._static_judge = StaticStabilityJudge(
            job.config, margin=GenerationTaskConfig().contact_margin
        )
        self._drake_judge = DrakeJudge(job.config)
        self._classes = load_catalog(job.catalog_folder).classes

    def __call__(self, index: int) -> dict[str, Any]:
        """Return the record of the scene of an index.

        Returns:
            fast: Whether the static model calls the scene stable, and the scene can be
                disassembled and has hidden objects. If so:
            fell: Reason of the instability in Drake; None if the scene is stable. Then:
            rules: The rules that derive the scene graph.
            form: Canonical form of the scene graph.
            hidden: Number of hidden objects.
        """
        rng = item_rng(self._job.seed, index)
        scene, _ = self._generator.lay_out(rng)
        static_verdict = self._static_judge.judge(scene, rng)
        if (
            isinstance(static_verdict, InconclusiveVerdict)
            or not static_verdict.hidden
            or self._static_judge.is_disassemblable(scene) is not True
        ):
            return {"fast": False}
        drake_verdict = self._drake_judge.judge(scene, rng)
        if drake_verdict.instability is not None:
            return {"fast": True, "fell": drake_verdict.instability.reason.value}
        assert scene.graph is not None
        return {
            "fast": True,
            "fell": None,
            "rules": scene.derivation,
            "form": canonical_form(scene.graph, self._classes),
            "hidden": len(drake_verdict.hidden),
        }


def select_graphs(
    records: Iterable[dict[str, Any]], instabilities: Counter[str]
) -> Iterator[SceneRecord]:
    """Yield the scene graphs that are stable and have hidden objects.

    Args:
        records: Records of `GraphJudge`.
        instabilities: Receives the number of scenes that are unstable in Drake, by reason.
    """
    for record in records:
        if record.get("fell"):
            instabilities[record["fell"]] += 1
        if record.get("hidden"):
            yield SceneRecord(tuple(record["rules"]), record["form"], record["hidden"])


def drop_duplicates(
    scenes: Iterable[SceneRecord], excluded_forms: Iterable[str]
) -> Iterator[SceneRecord]:
    """Yield one scene of each canonical form that is not excluded."""
    known_forms = set(excluded_forms)
    for scene in scenes:
        if scene.canonical_form not in known_forms:
            known_forms.add(scene.canonical_form)
            yield scene


def main(
    out: Annotated[Path, typer.Option(metavar="FILE", help="Scene dataset to write (JSON).")],
    work: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the verdicts.")],
    agent: Annotated[
        str, typer.Option(help="Scene generator, as of `drake-clutter generate`.")
    ] = "sg-star",
    nodes: Annotated[int, typer.Option(min=3, help="Number of nodes of the scene graphs.")] = 25,
    objects: Annotated[str, typer.Option(help="Name of the object set.")] = "ycb7",
    catalog: CatalogOption = None,
    count: Annotated[int, typer.Option(min=1, help="Number of scenes in the dataset.")] = 3000,
    seed: SeedOption = 0,
    temperature: Annotated[
        float | None, typer.Option(help="Temperature of a trained generator's policy.")
    ] = None,
    with_poses: Annotated[
        bool, typer.Option("--with-poses", help="Write the poses in which the objects rest.")
    ] = False,
    exclude: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Scene dataset whose graphs are excluded. Repeatable."),
    ] = None,
    workers: WorkersOption = 1,
) -> None:
    """Generate a dataset of stable scenes."""
    excluded_forms = {
        scene.canonical_form
        for path in exclude or []
        for scene in load_scene_dataset(path, load_catalog(catalog)).scenes
    }
    job = GenerationJob(agent, objects, catalog, nodes, seed, ClutterConfig(), temperature)
    metadata: dict[str, Any] = {
        "objects": objects,
        "agent": agent,
        "nodes": nodes,
        "seed": seed,
        "temperature": temperature,
        "judge": "drake",
        "without": [path.name for path in exclude or []],
        **provenance(),
    }
    max_generated = MAX_GENERATED_PER_SCENE * count
    scenes = list[SceneRecord]()
    if with_poses:
        num_generated = 0
        while len(scenes) < count and num_generated < max_generated:
            missing = count - len(scenes)
            num_generated = max(num_generated + 1, int(num_generated + OVERSAMPLING * missing))
            generate_scenes(
                job,
                num_generated,
                work,
                workers,
                lambda items, done, total: progress(items, out.stem, total, done),
            )
            stable = read_stable_scenes(work, load_catalog(catalog), num_generated)
            scenes = list(drop_duplicates(stable, excluded_forms))
    else:
        judge = partial(GraphJudge, job)
        records = resume_jsonl(
            work / VERDICTS_FILE,
            job.to_dict(),
            lambda done: map_ordered(judge, range(done, max_generated), workers=workers),
            GraphVerdict,
        )
        with closing(records):
            metadata["commit"] = next(records)["commit"]  # The commit of the verdicts.
            instabilities = Counter[str]()
            graphs = drop_duplicates(select_graphs(records, instabilities), excluded_forms)
            scenes = list(progress(itertools.islice(graphs, count), out.stem, count))
            metadata["fell_in_drake"] = dict(instabilities)
    if len(scenes) < count:
        raise InputError(
            f"--count {count}: only {len(scenes)} of {max_generated} scenes are stable, have hidden"
            " objects, and are no duplicates; expected what agent and nodes can generate"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    save_scene_dataset(out, metadata, scenes[:count], job.config.cell)


if __name__ == "__main__":
    run_script(main)
