"""Replay recorded moves of the arm exactly: joints and objects against the recording.

    python benchmarks/replay_exactness.py runs/replays --moves 200 --workers 2 \
        --out benchmarks/results/replay_exactness.json

Episodes are recorded in the scenes of a dataset, one after the other, written to a file and read
again. The executed commands of each move go through the station once more, from the recorded start.
FOLDER keeps one record per episode; an interrupted run is resumed by the same command.
"""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import typer
from pydantic import BaseModel

from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.limits import MAX_COUNT
from drake_clutter.recording.episode_recorder import record_episode
from drake_clutter.recording.exact_replay import (
    MAX_JOINT_ERROR,
    MAX_OBJECT_ERROR,
    compare_samples,
    replay_action,
)
from drake_clutter.recording.hdf5_file import load_episode, save_episode
from drake_clutter.recording.recorded_episode import EpisodeHeader
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.station.motion_recorder import DEFAULT_RATE
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import Count, CountOrZero, NonEmptyText, NonNegative, to_plain
from training.results_file import ResultsFile, Row, collect_records
from training.script import (
    SCENES,
    ResultsOption,
    SeedOption,
    WorkersOption,
    print_table,
    run_script,
)

EPISODES_PER_PROCESS = 10
"""Episodes after which a process is replaced: each keeps some hundred MB, see `map_ordered`."""
MOVES_PER_EPISODE = 6
"""Largest number of moves of an episode."""


class MoveReplay(BaseModel):
    """Replay of a move.

    Attributes:
        move: The move.
        result: Result of the recorded move.
        time_step: Time step of its simulation [s].
        samples: Number of samples.
        waits: Number of times that the executor waited for the vacuum.
        joint_error: Largest difference of a joint [rad].
        object_error: Largest distance of an object [m].
    """

    move: NonEmptyText
    result: NonEmptyText
    time_step: NonNegative
    samples: Count
    waits: CountOrZero
    joint_error: NonNegative
    object_error: NonNegative

    @property
    def is_exact(self) -> bool:
        """Whether both errors are within the limits."""
        return self.joint_error <= MAX_JOINT_ERROR and self.object_error <= MAX_OBJECT_ERROR


class EpisodeReplays(BaseModel):
    """Replays of the moves of an episode.

    Attributes:
        number: Number of the scene in its dataset, and of the episode.
        replays: Replays of the executed moves.
    """

    number: CountOrZero
    replays: tuple[MoveReplay, ...]


class EpisodeReplayer:
    """Records an episode and replays its moves; a worker for `map_ordered`."""

    def __init__(self, dataset: str, agent: str, rate: float, seed: int) -> None:
        """Load the scenes and the policy.

        Args:
            dataset: Name of the scene dataset.
            agent: Name of the policy.
            rate: Samples per second [Hz].
            seed: Seed of the episodes.
        """
        self._catalog = load_catalog()
        self._scenes = load_scene_dataset(SCENES / f"{dataset}.json", self._catalog)
        self._config = ClutterConfig()
        self._agent = agent
        self._make_policy = make_policy_factory(agent, self._config)
        self._rate = rate
        self._seed = seed

    def __call__(self, number: int) -> Row:
        """Return an `EpisodeReplays` as a dictionary.

        Args:
            number: Number of the scene.
        """
        scenes = self._scenes
        recorded = record_episode(
            scenes.settled_scene(number, scenes.grammar, self._config),
            self._make_policy,
            self._config,
            EpisodeHeader(self._agent, self._seed, number, rate=self._rate),
            max_moves=MOVES_PER_EPISODE,
        )
        with TemporaryDirectory() as folder:
            path = Path(folder) / "episode.h5"
            save_episode(path, recorded)
            episode = load_episode(path, self._catalog)
        replays = list[MoveReplay]()
        for action in episode.actions:
            samples = action.samples
            if samples is None or samples.executed is None:
                continue
            replayed = replay_action(episode.initial_scene, episode.cell, samples, self._rate)
            errors = compare_samples(samples, replayed)
            replays.append(
                MoveReplay(
                    move=str(action.move),
                    result=action.result.value,
                    time_step=samples.time_step,
                    samples=len(samples),
                    waits=len(samples.executed.wait_time),
                    joint_error=errors.joint,
                    object_error=errors.object,
                )
            )
        return EpisodeReplays(number=number, replays=tuple(replays)).model_dump(mode="json")


def main(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of the record file.")],
    moves: Annotated[int, typer.Option(min=1, max=MAX_COUNT, help="Number of moves.")] = 200,
    dataset: Annotated[str, typer.Option(metavar="NAME", help="Scene dataset.")] = "sg_star_25",
    agent: Annotated[str, typer.Option(metavar="NAME", help="Explorer.")] = "largest-clear",
    rate: Annotated[float, typer.Option(min=1.0, help="Samples per second [Hz].")] = DEFAULT_RATE,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    out: ResultsOption = None,
) -> None:
    """Record and replay until there are enough moves, and print the table."""
    scenes = load_scene_dataset(SCENES / f"{dataset}.json", load_catalog())
    header = {
        "dataset": dataset,
        "sha256": scenes.sha256,
        "agent": agent,
        "rate": rate,
        "seed": seed,
        "moves_per_episode": MOVES_PER_EPISODE,
        "config": to_plain(ClutterConfig()),
    }
    folder.mkdir(parents=True, exist_ok=True)
    replays = list[MoveReplay]()
    num_episodes = 0
    records = list[Row]()
    while len(replays) < moves and num_episodes < len(scenes.scenes):
        # An episode has about five executed moves.
        num_episodes += max(1, (moves - len(replays)) // 5)
        records = collect_records(
            folder / f"{dataset}_{agent}_{rate:g}_{seed}.jsonl",
            header,
            partial(EpisodeReplayer, dataset, agent, rate, seed),
            range(min(num_episodes, len(scenes.scenes))),
            schema=EpisodeReplays,
            workers=workers,
            max_items_per_process=EPISODES_PER_PROCESS,
        )
        replays = [r for record in records for r in EpisodeReplays.model_validate(record).replays]
    row = summarize(replays[:moves])
    row |= {
        "dataset": dataset,
        "agent": agent,
        "rate": rate,
        "seed": seed,
        "episodes": len(records),
        "commit": records[-1]["commit"],
        "software_version": records[-1]["software_version"],
    }
    if out:
        common = {"config": header["config"], "moves_per_episode": MOVES_PER_EPISODE}
        ResultsFile(out, common, ("dataset", "agent", "rate", "seed")).add(row)
    print_table([{name: str(row[name]) for name in ("moves", "exact", "results", "not_exact")}])


def summarize(replays: Sequence[MoveReplay]) -> Row:
    """Return the metrics of replayed moves."""
    num_exact = sum(replay.is_exact for replay in replays)
    joint = np.array([replay.joint_error for replay in replays])
    distance = np.array([replay.object_error for replay in replays])
    return {
        "moves": len(replays),
        "exact": num_exact,
        "exact_ci95": wilson_interval(num_exact, len(replays)),
        "max_joint_error": float(joint.max()),
        "max_object_error": float(distance.max()),
        "identical": int(((joint == 0) & (distance == 0)).sum()),
        "with_waits": sum(replay.waits > 0 for replay in replays),
        "results": dict(Counter(replay.result for replay in replays)),
        "not_exact": [
            f"{r.move}: {r.result}, {r.joint_error:.2e} rad, {r.object_error:.2e} m"
            for r in replays
            if not r.is_exact
        ],
    }


if __name__ == "__main__":
    run_script(main)
