"""Collect Drake's verdicts on scenes and moves, the reference that `judge_agreement.py` uses.

    python benchmarks/collect_drake_verdicts.py FOLDER --workers 2

The scenes are those of the random generator. Every group of objects that may touch is settled, also
after an object of another group has become unstable, so that each group has a verdict. It takes
one to two hours on two cores. An interrupted run is resumed by the same command.
"""

from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from pydantic import BaseModel

from drake_clutter.agents.generators import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.scenes.interfaces import (
    Instability,
    Move,
    MoveExecutor,
    MoveResult,
    Observation,
    Outcome,
    PickPlaceCommand,
)
from drake_clutter.scenes.placement import resolve_placement
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.simulation.settle_executor import SettleExecutor
from drake_clutter.tasks.belief import legal_moves
from drake_clutter.validation import CountOrZero, Finite, to_plain
from training.results_file import collect_records
from training.script import WorkersOption, run_script

Record = dict[str, Any]
"""Verdicts on the groups of a scene, or the outcome of a move."""

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "other offsets": {},
    "1 ms steps": {"time_step": 0.001},
    "no early stop": {"early_stop_samples": 1_000_000},
}
"""Settings of the settling by variant: the defaults, and others with which verdicts should agree.

"other offsets" differs in the random offsets of the objects.
"""


@dataclass(frozen=True)
class SceneBatch:
    """Scenes of one size that are judged with the same settings.

    Attributes:
        objects: Name of the object set.
        nodes: Number of nodes of the scene graphs.
        seed: Seed of the scenes.
        variant: Key of `VARIANTS`.
    """

    objects: str
    nodes: int
    seed: int
    variant: str = "default"

    @property
    def name(self) -> str:
        """Name of the record file."""
        return f"{self.objects}_{self.nodes}_{self.seed}_{self.variant.replace(' ', '_')}"

    @property
    def config(self) -> ClutterConfig:
        """Configuration with the settings of the variant."""
        config = ClutterConfig()
        return replace(config, settle=replace(config.settle, **VARIANTS[self.variant]))

    def lay_out(self, index: int) -> tuple[Scene, np.random.Generator]:
        """Return a scene, and the random generator that a judge draws offsets from next."""
        rng = item_rng(self.seed, index)
        return _scene_generator(self.objects, self.nodes, self.seed).lay_out(rng)[0], rng


@lru_cache(maxsize=16)
def _scene_generator(objects: str, nodes: int, seed: int) -> SceneGenerator:
    return SceneGenerator(GenerationJob("random", objects, None, nodes, seed, ClutterConfig()))


SCENES_BY_BATCH = {
    SceneBatch("ycb7", 25, 0): 1000,
    SceneBatch("ycb7", 10, 0): 300,
    SceneBatch("ycb7", 15, 0): 300,
    SceneBatch("ycb7", 20, 0): 300,
    SceneBatch("pantry14", 25, 0): 300,
    SceneBatch("ycb7", 25, 0, "other offsets"): 100,
    SceneBatch("ycb7", 25, 0, "no early stop"): 100,
    SceneBatch("ycb7", 25, 0, "1 ms steps"): 100,
}
"""Number of scenes of each batch in the published results."""
NUM_MOVES = 1000
"""Number of random moves in the published results, in the stable scenes of the first batch."""


@dataclass(frozen=True)
class WorkerPool:
    """Options of the parallel computation.

    Attributes:
        workers: Number of processes.
        ray_address: Address of a Ray cluster; None for this machine.
    """

    workers: int = 1
    ray_address: str | None = None


InstabilityRecord = tuple[str, str, Finite, Finite]
"""Reason, object, displacement [m] and tilt [rad] of an instability."""
PoseRecord = tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite]
"""Translation [m] and quaternion."""


class GroupVerdict(BaseModel):
    """Objects that may touch, and how they are unstable."""

    objects: list[str]
    fall: InstabilityRecord | None


class SceneVerdict(BaseModel):
    """Record of a scene; see `SceneSettler`."""

    index: CountOrZero
    groups: list[GroupVerdict]
    settled: dict[str, tuple[Finite, Finite, Finite, Finite, Finite, Finite, Finite, Finite]] = {}


class MoveOutcome(BaseModel):
    """Record of a move; see `MoveRunner`."""

    index: CountOrZero
    draw: CountOrZero
    move: tuple[str, str]
    result: str
    fall: InstabilityRecord | None
    place: PoseRecord | None


class SceneSettler:
    """Settles the groups of a batch's scenes; a worker for `map_ordered`."""

    def __init__(self, batch: SceneBatch) -> None:
        """Create the judge.

        Args:
            batch: The batch.
        """
        self._batch = batch
        self._judge = DrakeJudge(batch.config)

    def __call__(self, index: int) -> Record:
        """Return the record of a scene.

        Returns:
            index: Index of the scene.
            groups: For each group its `objects` and `fall`: None, or the reason, object,
                displacement [m] and tilt [rad] of the instability.
            settled: Only of a stable scene: visible fraction, translation [m] and quaternion of
                each object at rest.
        """
        scene, rng = self._batch.lay_out(index)
        if self._batch.variant == "other offsets":
            rng = item_rng(self._batch.seed, index, 1)
        settled: dict[str, Pose] = dict(scene.poses)
        groups = []
        for group, result in self._judge.settle_groups(scene, rng):
            settled |= result.poses
            names = [o.name for o in group]
            groups.append({"objects": names, "fall": _instability_record(result.instability)})
        record: Record = {"index": index, "groups": groups}
        if all(group["fall"] is None for group in groups):
            fractions = self._judge.judge_at_rest(scene.with_poses(settled)).visible_fractions
            record["settled"] = {
                name: [fractions[name], *pose.translation, *pose.quaternion]
                for name, pose in settled.items()
            }
        return record


def _instability_record(instability: Instability | None) -> list[Any] | None:
    if instability is None:
        return None
    return [
        instability.reason.value,
        instability.object,
        instability.displacement,
        instability.tilt,
    ]


def collect_verdicts(batch: SceneBatch, count: int, folder: Path, pool: WorkerPool) -> list[Record]:
    """Return the records of a batch's first scenes; those that its file lacks are computed.

    Args:
        batch: The batch.
        count: Number of scenes.
        folder: Folder of the record file.
        pool: Options of the parallel computation.
    """
    return collect_records(
        folder / f"{batch.name}.jsonl.gz",
        asdict(batch) | {"config": to_plain(batch.config)},
        partial(SceneSettler, batch),
        range(count),
        schema=SceneVerdict,
        workers=pool.workers,
        ray_address=pool.ray_address,
    )


@dataclass(frozen=True)
class RandomMove:
    """A random move in a stable scene.

    Attributes:
        batch: Batch of the scene.
        index: Index of the scene.
        number: Number of the move among those in this scene.
        record: Record of the scene, see `SceneSettler`.
    """

    batch: SceneBatch
    index: int
    number: int
    record: Record

    def scene(self) -> Scene:
        """Return the scene at rest."""
        return at_rest(self.batch.lay_out(self.index)[0], self.record)

    def sample(self, observation: Observation) -> Move:
        """Return a legal move, drawn uniformly."""
        moves = legal_moves(observation)
        rng = item_rng(self.batch.seed, self.index, 2, self.number)
        return moves[rng.integers(len(moves))]

    def rng(self) -> np.random.Generator:
        """Return the random generator for the execution of the move."""
        return item_rng(self.batch.seed, self.index, 3, self.number)


class MoveRunner:
    """Runs random moves with `SettleExecutor`; a worker for `map_ordered`."""

    def __init__(self) -> None:
        """Create the executor and the detector."""
        config = ClutterConfig()
        self._executor = SettleExecutor(config, simulate_collapse=False)
        self._detector = LabelDetector(config.cell.camera)

    def __call__(self, item: RandomMove) -> Record:
        """Return the record of a move.

        Returns:
            index: Index of the scene.
            draw: Number of the move in the scene.
            move: Object that is picked, and object or tray that it is placed on.
            result: Result of the move.
            fall: See `SceneSettler`.
            place: Translation [m] and quaternion of the placement; None if there was none.
        """
        scene, rng = item.scene(), item.rng()
        observation = self._detector.perceive(scene).observation
        move = item.sample(observation)
        command = resolve_placement(move, observation, ClutterConfig().exploration, rng)
        outcome = execute(self._executor, scene, command, rng)
        X_TO = command.X_TO_place if command else None
        return {
            "index": item.index,
            "draw": item.number,
            "move": [move.pick, move.place],
            "result": outcome.result.value,
            "fall": _instability_record(outcome.instability),
            "place": [*X_TO.translation, *X_TO.quaternion] if X_TO else None,
        }


def execute(
    executor: MoveExecutor, scene: Scene, command: PickPlaceCommand | None, rng: np.random.Generator
) -> Outcome:
    """Return the outcome of a command; without a command, there was no free placement."""
    if command is None:
        return Outcome(MoveResult.NO_FREE_PLACEMENT, scene)
    return executor.execute(scene, command, rng)


def moves_path(batch: SceneBatch, folder: Path) -> Path:
    """Return the record file of the random moves in a batch's scenes."""
    return folder / f"moves_{batch.objects}_{batch.nodes}_{batch.seed}.jsonl.gz"


def collect_moves(
    batch: SceneBatch, num_scenes: int, count: int, folder: Path, pool: WorkerPool
) -> list[Record]:
    """Return the records of random moves; those that the file lacks are computed.

    Args:
        batch: Batch of the scenes.
        num_scenes: Number of scenes; the moves are spread over those that are stable.
        count: Number of moves.
        folder: Folder of the record files.
        pool: Options of the parallel computation.
    """
    records = collect_verdicts(batch, num_scenes, folder, pool)
    stable = [record for record in records if "settled" in record]
    items = []
    for k in range(count):
        number, position = divmod(k, len(stable))
        record = stable[position]
        items.append(RandomMove(batch, record["index"], number, record))
    return collect_records(
        moves_path(batch, folder),
        asdict(batch) | {"config": to_plain(batch.config), "scenes": num_scenes},
        MoveRunner,
        items,
        schema=MoveOutcome,
        workers=pool.workers,
        ray_address=pool.ray_address,
    )


def at_rest(scene: Scene, record: Record) -> Scene:
    """Return a stable scene with its settled poses.

    Args:
        scene: The scene as laid out.
        record: Its record, see `SceneSettler`.
    """
    return scene.with_poses(
        {name: Pose(tuple(v[1:4]), tuple(v[4:])) for name, v in record["settled"].items()}
    )


def hidden_objects(record: Record, visibility_threshold: float) -> tuple[str, ...]:
    """Return the hidden objects of a stable scene.

    Args:
        record: Record of the scene, see `SceneSettler`.
        visibility_threshold: Visible fraction below which an object is hidden.
    """
    return tuple(name for name, v in record["settled"].items() if v[0] < visibility_threshold)


def main(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the record files.")],
    workers: WorkersOption = 2,
    ray: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Ray cluster to run on.")
    ] = None,
) -> None:
    """Collect the verdicts and moves that are missing."""
    pool = WorkerPool(workers, ray)
    (batch, num_scenes), *_ = SCENES_BY_BATCH.items()
    collect_moves(batch, num_scenes, NUM_MOVES, folder, pool)
    for batch, count in SCENES_BY_BATCH.items():
        collect_verdicts(batch, count, folder, pool)


if __name__ == "__main__":
    run_script(main)
