"""Makes a set of stable scenes for explorers, drawn by a generation agent and judged by Drake, in one small file.

    python training/generate_scene_dataset.py --seed 100 --work runs/train_sg_star --out train_sg_star.json
    python training/generate_scene_dataset.py --frozen --count 300 --seed 9000 --work runs/sg_star_25 --out sg_star_25.json

A set to learn from holds graphs, to be laid out anew. The fast judge chooses among the scenes, with the margin that generators
learn with, and Drake has the last word. A frozen set, of all scenes that Drake calls stable, also holds where the objects came to
rest. What has been judged stays in the --work folder, so that a run that was stopped goes on. No graph is taken twice, nor one of
the sets given as --not-in, up to symmetry.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import track

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.catalog import load_catalog
from drake_clutter.commands.generate_scenes import PROGRESS_FILE, SCENES_FOLDER, generate_scenes
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError, cli_error_handler
from drake_clutter.grammar import canonical_form
from drake_clutter.records import resume_jsonl
from drake_clutter.resources import git_commit
from drake_clutter.scenes.interfaces import InconclusiveVerdict
from drake_clutter.scenes.scene_dataset import SceneRecord, load_scene_dataset, save_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.judge import DrakeJudge
from drake_clutter.stability.judge import FastJudge
from drake_clutter.tasks.generation_task import GenerationTaskConfig
from drake_clutter.workers.parallel_map import map_ordered

MOST_DRAWS = 20
"""Scenes that are drawn at most, for each that is to be collected."""
MORE = 1.1
"""Times as many scenes are drawn as are still missing."""
JUDGED = "judged.jsonl"
"""In the --work folder: what was said of each scene."""


def judged_by_drake(folder: Path) -> Iterator[SceneRecord]:
    """The stable scenes of a folder that hide something."""
    catalog = load_catalog()
    solvable = json.loads((folder / PROGRESS_FILE).read_text())["solvable"]
    for index, answer in enumerate(solvable):
        file = load_scene(folder / SCENES_FOLDER / f"{index:04d}.yaml", catalog)
        assert file.verdict is not None
        assert file.scene.graph is not None
        if file.verdict.stable and file.verdict.hidden:
            settled = tuple(file.verdict.settled[name] for name in file.scene.names)
            form = canonical_form(file.scene.graph, catalog.classes)
            yield SceneRecord(
                file.scene.derivation, form, len(file.verdict.hidden), answer, settled
            )


class GraphJudge:
    """Draws scene after scene of a job; a worker for the runner."""

    def __init__(self, job: GenerationJob) -> None:
        self._job, self._generator = job, SceneGenerator(job)
        self._fast, self._drake = (
            FastJudge(job.config, margin=GenerationTaskConfig().contact_margin),
            DrakeJudge(job.config),
        )
        self._classes = load_catalog().classes

    def __call__(self, index: int) -> dict[str, Any]:
        """What is said of the scene of an index: `fast`, whether it stands, comes apart and hides something as the fast judge
        sees it; if so `fell`, how it fell in Drake; and if it stayed, its rules, form and how many it hides."""
        rng = item_rng(self._job.seed, index)
        scene, _ = self._generator.lay_out(rng)
        verdict = self._fast.judge(scene, rng)
        if (
            isinstance(verdict, InconclusiveVerdict)
            or not verdict.hidden
            or self._fast.comes_apart(scene) is not True
        ):
            return {"fast": False}
        drake = self._drake.judge(scene, rng)
        if drake.instability is not None:
            return {"fast": True, "fell": drake.instability.reason.value}
        assert scene.graph is not None
        form = canonical_form(scene.graph, self._classes)
        return {
            "fast": True,
            "fell": None,
            "rules": scene.derivation,
            "form": form,
            "hidden": len(drake.hidden),
        }


def graphs_of(records: Iterable[dict[str, Any]], fell: Counter[str]) -> Iterator[SceneRecord]:
    """The graphs of what `GraphJudge` said that are stable and hide something; counts in `fell` how others fell in Drake."""
    for record in records:
        if record.get("fell"):
            fell[record["fell"]] += 1
        if record.get("hidden"):
            yield SceneRecord(tuple(record["rules"]), record["form"], record["hidden"])


def without_repeats(scenes: Iterable[SceneRecord], taken: set[str]) -> Iterator[SceneRecord]:
    """Those whose form is not taken, each form once."""
    taken = set(taken)
    for scene in scenes:
        if scene.canonical_form not in taken:
            taken.add(scene.canonical_form)
            yield scene


def main(
    out: Annotated[Path, typer.Option(metavar="FILE", help="JSON to write.")],
    work: Annotated[Path, typer.Option(metavar="DIR", help="Where what has been judged is kept.")],
    agent: Annotated[str, typer.Option(help="As for `drake-clutter generate`.")] = "sg-star",
    nodes: Annotated[int, typer.Option(min=3)] = 25,
    objects: str = "ycb7",
    count: Annotated[int, typer.Option(min=1, help="Stable scenes to collect.")] = 3000,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    temperature: Annotated[float | None, typer.Option(help="Of a trained agent.")] = None,
    frozen: Annotated[
        bool, typer.Option("--frozen", help="Hold where the objects came to rest.")
    ] = False,
    not_in: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="A set to leave out; may be repeated.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1)] = 1,
) -> None:
    """Makes a set."""
    console = Console(stderr=True)
    taken = {
        scene.canonical_form
        for path in not_in or []
        for scene in load_scene_dataset(path, load_catalog()).scenes
    }
    job = GenerationJob(agent, objects, None, nodes, seed, ClutterConfig(), temperature)
    about: dict[str, Any] = {
        "objects": objects,
        "agent": agent,
        "nodes": nodes,
        "seed": seed,
        "temperature": temperature,
    }
    about |= {
        "judge": "drake",
        "without": [path.name for path in not_in or []],
        "commit": git_commit(),
    }
    found, drawn = list[SceneRecord](), 0
    if not frozen:
        judged = resume_jsonl(
            work / JUDGED,
            job.to_dict,
            lambda done: map_ordered(
                partial(GraphJudge, job), range(done, MOST_DRAWS * count), workers=workers
            ),
        )
        about["commit"] = next(judged)["commit"]  # at which they were judged
        fell = Counter[str]()
        fitting = itertools.islice(without_repeats(graphs_of(judged, fell), taken), count)
        found = list(track(fitting, out.stem, total=count, console=console))
        about["fell_in_drake"] = dict(fell)
        judged.close()
    while frozen and len(found) < count and drawn < MOST_DRAWS * count:
        drawn = max(drawn + 1, int(drawn + MORE * (count - len(found))))
        generate_scenes(
            job,
            drawn,
            work,
            workers,
            lambda scenes, done, total: track(scenes, out.stem, total, done, console=console),
        )
        found = list(without_repeats(judged_by_drake(work), taken))
    if len(found) < count:
        told = f"only {len(found)} of {MOST_DRAWS * count} scenes are stable, hide something, and are no repeats"
        raise InputError(f"--count {count}: {told}; allowed is what agent and nodes can make")
    out.parent.mkdir(parents=True, exist_ok=True)
    save_scene_dataset(out, about, found[:count], job.config.cell)


if __name__ == "__main__":
    with cli_error_handler():
        typer.run(main)
