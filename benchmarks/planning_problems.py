"""Frozen pick-and-place problems: random legal moves in stable scenes of the random generator.

    python benchmarks/planning_problems.py problems.jsonl.gz --count 1000 --seed 3500

An interrupted run is resumed by the same command, and a file with fewer problems is continued.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.pick_place import CONFIG, NODES, MoveSampler
from drake_clutter.records import read_jsonl
from drake_clutter.scenes.scene import Pose
from drake_clutter.validation import to_plain
from training.results_file import collect_records
from training.script import SeedOption, WorkersOption, run_script

ProblemsArgument = Annotated[
    Path, typer.Argument(metavar="PROBLEMS", help="File of problems (JSON lines, gzip).")
]


@dataclass(frozen=True)
class ObjectRecord:
    """Object of a problem.

    Attributes:
        name: Name.
        object_class: Name of its class.
        X_TO: Pose.
    """

    name: str
    object_class: str
    X_TO: Pose


@dataclass(frozen=True)
class ProblemRecord:
    """A pick-and-place problem.

    Attributes:
        objects: All objects; none if the move has no free placement.
        pick: Name of the picked object.
        X_TO_place: Pose at which it is released.
    """

    objects: tuple[ObjectRecord, ...]
    pick: str
    X_TO_place: Pose


class ProblemSampler:
    """Samples a problem; a worker for `map_ordered`."""

    def __init__(self, seed: int) -> None:
        """Create the sampler.

        Args:
            seed: Seed of the scenes and moves.
        """
        self._sample = MoveSampler(NODES, seed)

    def __call__(self, number: int) -> ProblemRecord:
        """Return the problem of a number."""
        sampled = self._sample(number)
        if sampled is None:
            return ProblemRecord((), "", Pose((0.0, 0.0, 0.0)))
        objects = tuple(
            ObjectRecord(o.name, o.object_class.name, o.X_TO) for o in sampled.scene.objects
        )
        return ProblemRecord(objects, sampled.command.move.pick, sampled.command.X_TO_place)


def load_problems(path: Path) -> list[dict[str, Any]]:
    """Return the problems of a file as documents, without moves that have no free placement."""
    _, *records = read_jsonl(path)
    return [record for record in records if record["objects"]]


def main(
    path: ProblemsArgument,
    count: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 1000,
    seed: SeedOption = 3500,
    workers: WorkersOption = 1,
) -> None:
    """Sample pick-and-place problems."""
    header = {"seed": seed, "nodes": NODES, "config": to_plain(CONFIG)}
    make_worker = partial(ProblemSampler, seed)
    collect_records(path, header, make_worker, range(count), schema=ProblemRecord, workers=workers)


if __name__ == "__main__":
    run_script(main)
