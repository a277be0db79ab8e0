"""What Drake says of RG scenes, group by group: the truth that `judges.py` holds the fast judge against.

Every group of objects that may touch is settled, also after one of them has fallen, so that each says something.

python benchmarks/drake_verdicts.py FOLDER --workers 2
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import typer
from calibrate import commit
from rich.console import Console
from rich.progress import track

from drake_clutter.agents.generation import GenerationJob, SceneGenerator
from drake_clutter.config import ClutterConfig, config_yaml
from drake_clutter.files import InputError, write_text
from drake_clutter.runner import item_rng, map_ordered
from drake_clutter.scenes.scene import Pose, Scene
from drake_clutter.simulation.judge import DrakeJudge

VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "other offsets": {},
    "1 ms steps": {"time_step": 0.001},
    "no early stop": {"calm_samples": 1_000_000},
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
    Batch("ycb7", 25, 0, "other offsets"): 300,
    Batch("ycb7", 25, 0, "no early stop"): 200,
    Batch("ycb7", 25, 0, "1 ms steps"): 200,
}
"""How many scenes of each batch the published experiment asks about."""


class DrakeVerdicts:
    """Generates a scene of a batch and settles it; a worker for the runner."""

    def __init__(self, batch: Batch) -> None:
        self._batch = batch
        self._judge = DrakeJudge(config_of(batch))
        self._generator = _generator(batch)

    def __call__(self, index: int) -> dict[str, Any]:
        """The record of a scene, as it stands in the file."""
        rng = item_rng(self._batch.seed, index)
        scene, _ = self._generator.lay_out(rng)
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
            shares = self._judge.look(scene.at(settled)).visible_share
            fields["settled"] = {name: [shares[name], *pose.translation, *pose.quaternion] for name, pose in settled.items()}
        return fields


def config_of(batch: Batch) -> ClutterConfig:
    """The world under a variant's settings."""
    config = ClutterConfig()
    return replace(config, settle=replace(config.settle, **VARIANTS[batch.variant]))


def _generator(batch: Batch) -> SceneGenerator:
    return SceneGenerator(GenerationJob("random", batch.objects, None, batch.nodes, batch.seed, ClutterConfig()))


def scenes(batch: Batch, count: int) -> Iterable[Scene]:
    """The first scenes of a batch, as laid out."""
    generator = _generator(batch)
    return (generator.lay_out(item_rng(batch.seed, index))[0] for index in range(count))


@dataclass(frozen=True)
class _Factory:
    batch: Batch

    def __call__(self) -> DrakeVerdicts:
        return DrakeVerdicts(self.batch)


def drake_verdicts(batch: Batch, count: int, folder: Path, workers: int) -> Iterator[dict[str, Any]]:
    """A head (what was asked, at which commit), then the records of the first `count` scenes of a batch.

    They are kept in a JSON Lines file; what it lacks is made and added.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{batch.objects}_{batch.nodes}_{batch.seed}_{batch.variant.replace(' ', '_')}.jsonl"
    head = asdict(batch) | {"config": config_yaml(config_of(batch))}
    if not path.exists():
        write_text(path, json.dumps(head | {"commit": commit()}) + "\n")
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    if {key: lines[0][key] for key in head} != head:
        raise InputError(f"{path}: holds verdicts under another config; give another folder")
    known = lines[1:]
    yield lines[0]
    yield from known[:count]
    with path.open("a") as file:
        for record in map_ordered(_Factory(batch), range(len(known), count), workers=workers):
            file.write(json.dumps(record) + "\n")
            file.flush()
            yield record


def settled_scene(scene: Scene, record: dict[str, Any]) -> Scene:
    """The scene as it came to rest; the record is a stable one's."""
    return scene.at({name: Pose(tuple(v[1:4]), tuple(v[4:])) for name, v in record["settled"].items()})


def hidden(record: dict[str, Any], hidden_below: float) -> tuple[str, ...]:
    """What a stable scene hides."""
    return tuple(name for name, v in record["settled"].items() if v[0] < hidden_below)


def main(folder: Path, workers: int = 2) -> None:
    """Collects what `judges.py` needs, about an hour on two cores; a run that was stopped goes on."""
    for batch, count in BATCHES.items():
        what = f"{batch.objects}, {batch.nodes} nodes, {batch.variant}"
        records = drake_verdicts(batch, count, folder, workers)
        for _ in track(records, what, total=count + 1, console=Console(stderr=True)):
            pass


if __name__ == "__main__":
    typer.run(main)
