"""Measure how many moves an hour `drake-clutter record` carries out, and where the time goes.

    python benchmarks/recording_throughput.py --out recording_throughput.json

The same episodes of `SCENES` are recorded without images, and with `CAMERA` at 10 Hz, by 1 to 4
worker processes of this machine. The shares of the work are those of the calls in one process.
The time for more workers is a model, not a measurement:

    T(n, w) = start + n * serial + n * work / w

with n moves and w workers that have a core each. `start` is the time until the workers record and
for the figures of the card, `work` the time of a worker for a move, and `serial` that of the
process that reads every episode for the card at the end. It converts further formats, too, which
is not part of the model.
"""

import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.measurement import Stopwatch, describe_machine
from drake_clutter.commands import record_dataset as recording
from drake_clutter.commands.episode_scenes import find_scenes
from drake_clutter.commands.record_dataset import (
    EpisodeSummary,
    EpisodeWriter,
    episode_path,
    record_dataset,
)
from drake_clutter.commands.recording_job import CameraOptions, RecordingJob
from drake_clutter.config import load_config
from drake_clutter.files import write_json
from drake_clutter.perception.label_detector import LabelDetector
from drake_clutter.recording.camera_recorder import CameraRecorder
from drake_clutter.recording.hdf5_file import save_episode
from drake_clutter.station import arm_executor
from drake_clutter.station.arm_executor import ArmExecutor, evaluate_outcome
from drake_clutter.station.station_simulation import simulate_plan
from training.results_file import provenance
from training.script import SeedOption, print_table, run_script

SCENES = "sg_star_25"
CAMERA = "overhead"
POLICY = "largest-clear"
MAX_MOVES = 5
PROFILED_EPISODES = 10
"""Number of episodes of which the shares of the work are measured."""
MODEL_WORKERS = (1, 2, 4, 10, 100, 1000)
"""Numbers of workers for which the model states a time."""
MODEL_MOVES = 100_000
"""Number of moves of the model."""
PARTS: dict[str, tuple[Any, Any]] = {
    "planning": (ArmExecutor, ArmExecutor.plan),
    "simulation": (arm_executor, simulate_plan),
    "settling": (arm_executor, evaluate_outcome),
    "perception": (LabelDetector, LabelDetector.perceive),
    "images": (CameraRecorder, CameraRecorder.record),
    "scene of the images": (CameraRecorder, CameraRecorder.__init__),
    "files and images": (recording, save_episode),
}
"""Owner and function of each part of the work."""


@dataclass(frozen=True)
class Timing:
    """Times of the recording of a data set.

    Attributes:
        moves: Number of moves that were carried out.
        start: Time until the first episode was complete, less that of an episode [s].
        recording: Time from the first to the last complete episode [s].
        counted: Number of moves in that time.
        finish: Time after the last episode: summary and card [s].
    """

    moves: int
    start: float
    recording: float
    counted: int
    finish: float


def time_dataset(job: RecordingJob, episodes: int, workers: int) -> Timing:
    """Record a data set and return its times."""
    moves = list[int]()

    def watch(label: str, items: Iterable[Any], num_done: int, total: int) -> Iterator[Any]:
        for item in items:
            if isinstance(item, EpisodeSummary):
                moves.append(item.num_executed)
            yield item

    begin = time.time()
    with tempfile.TemporaryDirectory() as folder:
        record_dataset(job, episodes, [], Path(folder), workers=workers, progress=watch)
        end = time.time()
        # Summaries arrive in the order of the episodes; the files tell when each was complete.
        files = [episode_path(Path(folder), k) for k in range(episodes)]
        complete = sorted((file.stat().st_mtime, n) for file, n in zip(files, moves, strict=True))
    # The first episode of each worker compiles and loads what the others find.
    first = min(workers, episodes - 1)
    return Timing(
        moves=sum(moves),
        start=complete[first - 1][0] - begin,
        recording=complete[-1][0] - complete[first - 1][0],
        counted=sum(n for _, n in complete[first:]),
        finish=end - complete[-1][0],
    )


def profile(job: RecordingJob, episodes: int) -> dict[str, float]:
    """Return the shares of the parts of the work in one process."""
    stopwatch = Stopwatch()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / recording.EPISODES_FOLDER).mkdir()
        writer = EpisodeWriter(job, Path(folder))
        writer(0)
        start = time.perf_counter()
        with stopwatch.watch(PARTS):
            for index in range(1, episodes):
                writer(index)
        total = time.perf_counter() - start
    seconds = {name: stopwatch.total(name) for name in PARTS}
    # Images are rendered while the file is written.
    seconds["files"] = seconds.pop("files and images") - seconds["images"]
    shares = {name: value / total for name, value in seconds.items()}
    return shares | {"other": 1 - sum(shares.values())}


def model_row(rate: float, start: float, serial: float, workers: int) -> dict[str, float]:
    """Return the modeled time and cost of `MODEL_MOVES` moves.

    Args:
        rate: Moves of a single worker per hour.
        start: Time that does not depend on the number of moves [s].
        serial: Time of the distributing process for a move [s].
        workers: Number of workers, one per core.
    """
    seconds = start + MODEL_MOVES * (serial + 3600 / rate / workers)
    return {
        "workers": workers,
        "hours": seconds / 3600,
        "moves_per_hour": 3600 * MODEL_MOVES / seconds,
        "core_hours_per_1000_moves": workers * seconds / 3600 / (MODEL_MOVES / 1000),
    }


def main(
    out: Annotated[Path, typer.Option(metavar="FILE", help="Results file to write (JSON).")],
    episodes: Annotated[int, typer.Option(min=PROFILED_EPISODES, help="Number of episodes.")] = 40,
    max_workers: Annotated[int, typer.Option(min=2, help="Largest number of workers.")] = 4,
    seed: SeedOption = 0,
) -> None:
    """Measure the throughput of recording."""
    config = load_config()
    plain = RecordingJob(find_scenes(SCENES, config), POLICY, config, seed, max_moves=MAX_MOVES)
    jobs = {"none": plain, "RGB-D": replace(plain, cameras=CameraOptions((CAMERA,)))}
    rows = list[dict[str, Any]]()
    models = list[dict[str, Any]]()
    shares = dict[str, dict[str, float]]()
    for images, job in jobs.items():
        shares[images] = profile(job, PROFILED_EPISODES)
        time_dataset(job, 1, 1)  # compiles and loads what the card needs
        small = time_dataset(job, 2, 1)
        timings = [time_dataset(job, episodes, workers) for workers in range(1, max_workers + 1)]
        for workers, timing in enumerate(timings, start=1):
            rows.append(
                {
                    "images": images,
                    "workers": workers,
                    "moves": timing.moves,
                    "moves_per_hour": 3600 * timing.counted / timing.recording,
                    "start_s": timing.start,
                    "finish_s": timing.finish,
                }
            )
        sizes = [small, *timings]
        serial, rest = np.polyfit([t.moves for t in sizes], [t.finish for t in sizes], 1)
        start = timings[-1].start + rest
        rate = 3600 * timings[0].counted / timings[0].recording
        models += [
            {"images": images, "serial_s_per_move": float(serial)}
            | model_row(rate, float(start), float(serial), workers)
            for workers in MODEL_WORKERS
        ]
    print_table(rows, "Measured")
    print_table(models, "Model")
    write_json(
        out,
        {
            **provenance(),
            "machine": describe_machine("drake"),
            "cores": os.cpu_count(),
            "scenes": SCENES,
            "policy": POLICY,
            "max_moves": MAX_MOVES,
            "seed": seed,
            "episodes": episodes,
            "rate_hz": plain.rate,
            "recorded_camera": {"name": CAMERA, "width": 640, "height": 480, "rate_hz": 10},
            "model_moves": MODEL_MOVES,
            "shares": shares,
            "rows": rows,
            "model": models,
        },
    )


if __name__ == "__main__":
    run_script(main)
