"""Measure the agreement of the static stability model with Drake on objects that are not convex.

    python benchmarks/mesh_agreement.py FOLDER --workers 2 --out mesh_judges.json

The object set holds the mug of `examples/custom_class`, a bottle, a bowl and a plate beside a box
and a can. The scenes are those of the random generator and of the hill climber, which
concentrates on the judge's errors. It takes about half an hour; an interrupted run is resumed by
the same command.
"""

# trimesh is typed in part only.
# mypy: allow-untyped-calls

import shutil
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
import typer

from benchmarks.collect_drake_verdicts import Record, SceneBatch, SceneSettler, SceneVerdict
from benchmarks.judge_agreement import BatchComparison, Confusion
from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.assets import build_assets
from drake_clutter.config import ClutterConfig
from drake_clutter.files import write_json
from drake_clutter.resources import resource_path
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.validation import to_plain
from training.evaluate_generators import verdict_name
from training.results_file import Row, collect_records, provenance
from training.script import ResultsOption, WorkersOption, print_table, run_script

OBJECT_SET = "crockery"
CLASSES = ("cracker_box", "tomato_soup_can", "mug", "bottle", "bowl", "plate")
"""Classes of the object set."""
PROFILES = {
    "bottle": (
        ((0, 0), (34, 0), (36, 4), (36, 130), (30, 155), (15, 175), (13, 200), (14, 210), (0, 210)),
        300,
    ),
    "bowl": (
        (
            *((0, 0), (30, 0), (45, 8), (65, 30), (75, 55)),
            *((71, 55), (62, 32), (43, 12), (28, 5), (0, 5)),
        ),
        250,
    ),
    "plate": (
        ((0, 0), (55, 0), (60, 4), (110, 18), (110, 21), (58, 7), (50, 4), (0, 4)),
        400,
    ),
}
"""Profiles (radius, height) of surfaces of revolution [mm], and masses [g]; assumed."""
_SECTIONS = 48
"""Number of corners of a surface of revolution around its axis."""


def build_crockery(folder: Path) -> None:
    """Write and build an asset folder with the object set, unless it is there."""
    if (folder / "package.xml").exists():
        return
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(resource_path("examples") / "custom_class/mug.stl", folder / "mug.stl")
    entry = "  {}: {{shape: mesh, mesh: {}.stl, mass_g: {}, pairs: [standing], only_rest: upright}}"
    entries = [entry.format("mug", "mug", 330)]
    for name, (profile, mass) in PROFILES.items():
        solid = trimesh.creation.revolve(np.array(profile) / 1000, sections=_SECTIONS)
        solid.export(folder / f"{name}.stl")
        entries.append(entry.format(name, name, mass))
    object_set = f"object_sets: {{{OBJECT_SET}: [{', '.join(CLASSES)}]}}"
    (folder / "catalog.yaml").write_text("\n".join(["classes:", *entries, object_set, ""]))
    build_assets(folder)


@dataclass(frozen=True)
class CrockeryBatch(SceneBatch):
    """Scenes of the object set.

    Attributes:
        agent: Agent that generates the scenes.
        folder: Asset folder.
    """

    agent: str = "random"
    folder: str = ""

    @property
    def name(self) -> str:
        """Name of the record file."""
        return f"{self.objects}_{self.agent}_{self.nodes}_{self.seed}"

    def lay_out(self, index: int) -> tuple[Scene, np.random.Generator]:
        """Return a scene, and the random generator that a judge draws offsets from next."""
        scene, state = _lay_out(self.agent, self.folder, self.nodes, self.seed, index)
        rng = item_rng(self.seed, index)
        rng.bit_generator.state = state
        return scene, rng


@lru_cache(maxsize=4)
def _scene_generator(agent: str, folder: str, nodes: int, seed: int) -> SceneGenerator:
    job = GenerationJob(agent, OBJECT_SET, Path(folder), nodes, seed, ClutterConfig())
    return SceneGenerator(job)


@lru_cache(maxsize=1024)  # as the hill climber takes seconds for a scene
def _lay_out(agent: str, folder: str, nodes: int, seed: int, index: int) -> tuple[Scene, Any]:
    """Return a scene, and the state of the random generator after it."""
    rng = item_rng(seed, index)
    scene, _ = _scene_generator(agent, folder, nodes, seed).lay_out(rng)
    return scene, rng.bit_generator.state


SCENES_BY_BATCH = {
    CrockeryBatch(OBJECT_SET, 12, 1, agent="random"): 100,
    CrockeryBatch(OBJECT_SET, 12, 1, agent="hill-climbing"): 20,
}
"""Number of scenes of each batch in the published results."""


def compare_by_class(batch: CrockeryBatch, records: Sequence[Record]) -> dict[str, Row]:
    """Return the agreement on the groups of touching objects that hold an object of a class."""
    judge = StaticStabilityJudge(batch.config)
    confusions = defaultdict[str, Confusion](Confusion)
    for record in records:
        scene, _ = batch.lay_out(record["index"])
        for group in record["groups"]:
            objects = tuple(scene[name] for name in group["objects"])
            static = verdict_name(judge.find_instability(replace(scene, objects=objects)))
            pair = static, "stable" if group["fall"] is None else "unstable"
            for name in {o.object_class.name for o in objects}:
                confusions[name].pairs[pair] += 1
    return {name: confusions[name].metrics() for name in CLASSES if name in confusions}


def count_classes(batch: CrockeryBatch, records: Sequence[Record]) -> dict[str, int]:
    """Return the number of objects of each class."""
    counts = Counter[str]()
    for record in records:
        counts.update(o.object_class.name for o in batch.lay_out(record["index"])[0].objects)
    return {name: counts[name] for name in CLASSES}


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for assets and records.")],
    workers: WorkersOption = 2,
    out: ResultsOption = None,
) -> None:
    """Collect the verdicts that are missing, compare them, and print and write the results."""
    assets = folder / OBJECT_SET
    build_crockery(assets)
    rows = list[Row]()
    for planned, count in SCENES_BY_BATCH.items():
        batch = replace(planned, folder=str(assets))
        key = {k: v for k, v in asdict(planned).items() if k not in ("folder", "variant")}
        header: dict[str, Any] = key | {"config": to_plain(batch.config)}
        path = folder / f"{batch.name}.jsonl.gz"
        settler = partial(SceneSettler, batch)
        records = collect_records(
            path, header, settler, range(count), schema=SceneVerdict, workers=workers
        )
        comparison = BatchComparison(batch)
        comparison.run(records)
        rows.append(
            key
            | comparison.row()
            | {
                "objects_by_class": count_classes(batch, records),
                "by_class_in_group": compare_by_class(batch, records),
                **comparison.details(),
            }
        )
    results: Row = {**provenance(), "config": to_plain(ClutterConfig()), "rows": rows}
    if out is not None:
        write_json(out, results)
    print_table(
        [
            {
                "agent": row["agent"],
                "scenes": row["count"],
                "agreement": f"{row['agreement']:.3f}",
                "false stable": f"{row['false_stable_rate']:.3f}",
                "inconclusive": f"{row['inconclusive_fraction']:.3f}",
                "hidden objects agree": row["hidden_agreement"],
            }
            for row in rows
        ],
        "Static model and Drake, objects that are not convex",
    )


if __name__ == "__main__":
    run_script(main)
