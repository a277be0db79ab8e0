"""What Drake says of RG scenes, group by group: the truth that `judge_agreement.py` holds the fast judge against.

Every group of objects that may touch is settled, also after one of them has fallen, so that each says something.

python benchmarks/collect_drake_verdicts.py FOLDER --workers 2
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.records import resume_jsonl
from drake_clutter.scenes.interfaces import Move, MoveResult, Observation, Outcome
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import config_yaml
from drake_clutter.workers.parallel_map import map_ordered

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "other offsets": {},
    "1 ms steps": {"time_step": 0.001},
    "no early stop": {"early_stop_samples": 1_000_000},
}
"""How Drake is asked: as by default, and in ways that should not matter."""


@dataclass(frozen=True)
class Batch:
    """RG scenes of a size and how Drake is asked about them."""

    objects: str
    nodes: int
    seed: int
    variant: str = "default"


BATCHES = {
    Batch("ycb7", 25, 0): 1000,
    Batch("ycb7", 10, 0): 300,
    Batch("ycb7", 15, 0): 300,
    Batch("ycb7", 20, 0): 300,
    Batch("pantry14", 25, 0): 300,
    Batch("ycb7", 25, 0, "other offsets"): 100,
    Batch("ycb7", 25, 0, "no early stop"): 100,
    Batch("ycb7", 25, 0, "1 ms steps"): 100,
}
"""How many scenes of each batch the published experiment asks about."""
MOVES = 1000
"""Random moves, in the stable scenes of the first batch."""


@dataclass(frozen=True)
class Pool:
    """Who works: processes here, or on the Ray cluster at an address."""

    workers: int = 1
    ray: str | None = None


class DrakeVerdicts:
    """Generates a scene of a batch and settles it; a worker for the runner."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch
        self._judge = DrakeJudge(config_of(batch))

    def __call__(self, index: int) -> dict[str, Any]:
        """The record of a scene, as it stands in the file."""
        scene, rng = laid_out(self._batch, index)
        if self._batch.variant == "other offsets":
            rng = item_rng(self._batch.seed, index, 1)
        settled: dict[str, Pose] = dict(scene.poses)
        groups = []
        for group, result in self._judge.settle_groups(scene, rng):
            settled |= result.poses
            fall = result.instability
            record: dict[str, Any] = {"objects": [o.name for o in group], "fall": None}
            if fall is not None:
                record["fall"] = [fall.reason.value, fall.object, fall.displacement, fall.tilt]
            groups.append(record)
        fields: dict[str, Any] = {"index": index, "groups": groups}
        if all(group["fall"] is None for group in groups):
            shares = self._judge.judge_at_rest(scene.with_poses(settled)).visible_fractions
            fields["settled"] = {
                name: [shares[name], *pose.translation, *pose.quaternion]
                for name, pose in settled.items()
            }
        return fields


def config_of(batch: Batch) -> ClutterConfig:
    """The world under a variant's settings."""
    config = ClutterConfig()
    return replace(config, settle=replace(config.settle, **VARIANTS[batch.variant]))


@lru_cache(maxsize=16)
def _generator(objects: str, nodes: int, seed: int) -> SceneGenerator:
    return SceneGenerator(GenerationJob("random", objects, None, nodes, seed, ClutterConfig()))


def laid_out(batch: Batch, index: int) -> tuple[Scene, np.random.Generator]:
    """A scene of a batch, and the generator that the judge draws its offsets from next."""
    rng = item_rng(batch.seed, index)
    return _generator(batch.objects, batch.nodes, batch.seed).lay_out(rng)[0], rng


@dataclass(frozen=True)
class _Factory:
    batch: Batch

    def __call__(self) -> DrakeVerdicts:
        return DrakeVerdicts(self.batch)


def _records(
    path: Path,
    head: dict[str, Any],
    make_worker: Callable[[], Callable[[Any], Any]],
    items: Sequence[Any],
    pool: Pool,
) -> Iterator[dict[str, Any]]:
    """The head, then a record per item."""

    def make(done: int) -> Iterator[Any]:
        return map_ordered(make_worker, items[done:], workers=pool.workers, ray_address=pool.ray)

    return islice(resume_jsonl(path, head, make), 1 + len(items))


def drake_verdicts(batch: Batch, count: int, folder: Path, pool: Pool) -> Iterator[dict[str, Any]]:
    """A head (what was asked, at which commit), then the records of the first `count` scenes of a batch."""
    path = (
        folder
        / f"{batch.objects}_{batch.nodes}_{batch.seed}_{batch.variant.replace(' ', '_')}.jsonl.gz"
    )
    head = asdict(batch) | {"config": config_yaml(config_of(batch))}
    yield from _records(path, head, _Factory(batch), range(count), pool)


@dataclass(frozen=True)
class RandomMove:
    """The k-th random move in a stable scene of a batch.

    Attributes:
        batch: of the scene.
        index: the scene's.
        draw: k.
        record: the scene's, see `DrakeVerdicts`.
    """

    batch: Batch
    index: int
    draw: int
    record: dict[str, Any]


class DrakeMoves:
    """Carries out random moves as `SettleExecutor` does; a worker for the runner."""

    def __init__(self) -> None:
        config = ClutterConfig()
        self._executor, self._detector = (
            SettleExecutor(config, simulate_collapse=False),
            LabelDetector(config.cell.camera),
        )

    def __call__(self, item: RandomMove) -> dict[str, Any]:
        """The record of a move."""
        scene = settled_scene(laid_out(item.batch, item.index)[0], item.record)
        observation = self._detector.perceive(scene).observation
        move = random_move(observation, item)
        rng = move_rng(item)
        command = resolve_placement(move, observation, ClutterConfig().exploration, rng)
        outcome = (
            Outcome(MoveResult.NO_FREE_PLACEMENT, scene)
            if command is None
            else self._executor.execute(
                scene,
                command,
                rng,
            )
        )
        fall = outcome.instability
        place = command.X_TO_place if command else None
        return {
            "index": item.index,
            "draw": item.draw,
            "move": [move.pick, move.place],
            "result": outcome.result.value,
            "fall": [fall.reason.value, fall.object, fall.displacement, fall.tilt]
            if fall
            else None,
            "place": [*place.translation, *place.quaternion] if place else None,
        }


def random_move(observation: Observation, item: RandomMove) -> Move:
    """A legal move, drawn uniformly."""
    moves = legal_moves(observation)
    return moves[item_rng(item.batch.seed, item.index, 2, item.draw).integers(len(moves))]


def move_rng(item: RandomMove) -> np.random.Generator:
    """What decides the chances of carrying the move out."""
    return item_rng(item.batch.seed, item.index, 3, item.draw)


def drake_moves(
    batch: Batch, scenes: int, count: int, folder: Path, pool: Pool
) -> Iterator[dict[str, Any]]:
    """A head, then `count` random moves, spread over the batch's first `scenes` scenes that Drake calls stable."""
    stable = [r for r in list(drake_verdicts(batch, scenes, folder, pool))[1:] if "settled" in r]
    items = [
        RandomMove(
            batch, stable[k % len(stable)]["index"], k // len(stable), stable[k % len(stable)]
        )
        for k in range(count)
    ]
    head = asdict(batch) | {"config": config_yaml(config_of(batch)), "scenes": scenes}
    yield from _records(
        folder / f"moves_{batch.objects}_{batch.nodes}_{batch.seed}.jsonl.gz",
        head,
        DrakeMoves,
        items,
        pool,
    )


def settled_scene(scene: Scene, record: dict[str, Any]) -> Scene:
    """The scene as it came to rest; the record is a stable one's."""
    return scene.with_poses(
        {name: Pose(tuple(v[1:4]), tuple(v[4:])) for name, v in record["settled"].items()}
    )


def hidden(record: dict[str, Any], visibility_threshold: float) -> tuple[str, ...]:
    """What a stable scene hides."""
    return tuple(name for name, v in record["settled"].items() if v[0] < visibility_threshold)


def main(folder: Path, workers: int = 2, ray: str | None = None) -> None:
    """Collects what `judge_agreement.py` needs, about an hour on two cores; a run that was stopped goes on."""
    pool = Pool(workers, ray)
    for batch, count in BATCHES.items():
        if batch.variant == "default":
            show(
                drake_verdicts(batch, count, folder, pool),
                f"{batch.objects}, {batch.nodes} nodes",
                count,
            )
    (batch, scenes), *_ = BATCHES.items()
    show(drake_moves(batch, scenes, MOVES, folder, pool), "moves", MOVES)
    for batch, count in BATCHES.items():
        show(drake_verdicts(batch, count, folder, pool), batch.variant, count)


def show(records: Iterator[dict[str, Any]], what: str, count: int) -> None:
    """Takes the records, with a progress bar."""
    for _ in track(records, what, total=count + 1, console=Console(stderr=True)):
        pass


if __name__ == "__main__":
    typer.run(main)
