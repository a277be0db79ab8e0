r"""Draw a frozen set of targets in the scenes of a scene dataset: one JSON file.

    python training/generate_target_set.py --scenes training/scenes/sg_star_25.json \
        --seed 7000 --out training/targets/sg_star_25.json

In every scene, an object is drawn among those that are hidden from the camera of `settle` and from
the ray caster. The oracle search decides whether it can be revealed, and finds the fewest moves.
The pairs found are kept beside the file; an interrupted run is resumed by the same command.
"""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import BaseModel

from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.seeding import item_rng
from drake_clutter.stability.static_judge import StaticStabilityJudge
from drake_clutter.tasks.oracle_search import OracleSearch, Solvability
from drake_clutter.tasks.search_target import RANDOM_HIDDEN, find_target
from training.results_file import collect_records, provenance
from training.script import SeedOption, WorkersOption, run_script
from training.target_set import TargetPair, save_target_set

BUDGET = 5000
"""Maximum number of moves that the oracle search evaluates for a pair."""


class PairRecord(BaseModel):
    """Record of a scene."""

    pair: TargetPair
    commit: str


class PairFinder:
    """Draws the target of a scene and searches for its plan; a worker for `map_ordered`."""

    def __init__(self, scenes: Path, seed: int) -> None:
        """Create a finder.

        Args:
            scenes: File of the scene dataset.
            seed: Seed of the draws.
        """
        self._scenes = load_scene_dataset(scenes, load_catalog())
        self._config = ClutterConfig(cell=self._scenes.cell)
        self._judge = StaticStabilityJudge(self._config)
        self._search = OracleSearch(self._config, self._judge)
        self._detector = LabelDetector(self._config.cell.camera)
        self._seed = seed

    def __call__(self, index: int) -> dict[str, Any]:
        """Return the record of a scene, see `PairRecord`."""
        scene = self._scenes.settled_scene(index, self._scenes.grammar, self._config)
        observations = (
            self._judge.ray_caster.observe(scene)[0],
            self._detector.perceive(scene).observation,
        )
        in_view = {d.name for observation in observations for d in observation.detections}
        target = find_target(RANDOM_HIDDEN, scene, in_view, item_rng(self._seed, index))
        if target is None:
            raise InputError(
                f"{self._scenes.name}: scenes[{index}]: hides nothing; expected hidden objects"
            )
        (name,) = target.names
        result = self._search.solve(scene, seed=index, budget=BUDGET, targets=target.names)
        is_solvable = result.solvability is Solvability.SOLVABLE
        pair = TargetPair(
            scene=index,
            target=name,
            solvable=result.solvability.value,
            moves=len(result.plan) if is_solvable else None,
            is_optimal=result.is_optimal,
        )
        return {"pair": pair.model_dump()}


def main(
    scenes: Annotated[Path, typer.Option(metavar="FILE", help="Scene dataset with poses.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Target set to write (JSON).")],
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Draw a target in every scene of a dataset."""
    dataset = load_scene_dataset(scenes, load_catalog())
    out.parent.mkdir(parents=True, exist_ok=True)
    work = out.with_suffix(".jsonl.gz")
    header = {"scenes": dataset.name, "sha256": dataset.sha256, "seed": seed, "budget": BUDGET}
    records = collect_records(
        work,
        header,
        partial(PairFinder, scenes, seed),
        range(len(dataset.scenes)),
        schema=PairRecord,
        workers=workers,
    )
    pairs = [TargetPair(**record["pair"]) for record in records]
    commits = {"commits": list(dict.fromkeys(record["commit"] for record in records))}
    metadata = {"seed": seed, "budget": BUDGET, **provenance(), **commits}
    save_target_set(out, metadata, dataset, pairs)
    work.unlink()


if __name__ == "__main__":
    run_script(main)
