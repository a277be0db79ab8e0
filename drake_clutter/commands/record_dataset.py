"""Recording of a data set of episodes with the arm, parallel and resumable.

Each episode is a file, which appears when it is complete. A data set is resumed by recording the
episodes whose files are missing, so nothing is lost or repeated, however a run ends. The content of
an episode depends only on the job and on its number, not on the number of workers.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import h5py
import numpy as np

from drake_clutter.catalog import load_catalog
from drake_clutter.commands.job_file import open_job_folder
from drake_clutter.commands.recording_job import RANDOM, RecordingJob
from drake_clutter.files import InputError, reading_file, write_json
from drake_clutter.recording.appearance import NUM_LIGHTS, colored_parts
from drake_clutter.recording.camera_recorder import CameraRecorder
from drake_clutter.recording.episode_recorder import record_episode
from drake_clutter.recording.formats.dataset_format import (
    DatasetFormat,
    check_format,
    convert_episodes,
)
from drake_clutter.recording.hdf5_file import load_episode, save_episode
from drake_clutter.recording.randomization import (
    Variation,
    draw_variation,
    varied_physics,
    vary_poses,
)
from drake_clutter.recording.recorded_episode import EpisodeHeader, RecordedEpisode
from drake_clutter.reports.dataset_card import CardText, write_card
from drake_clutter.scenes.interfaces import MoveResult
from drake_clutter.scenes.scene import Scene
from drake_clutter.seeding import item_rng
from drake_clutter.simulation.drake_judge import DrakeJudge
from drake_clutter.workers.parallel_map import map_ordered

Item = TypeVar("Item")

EPISODES_FOLDER = "episodes"
"""Folder of the recorded episodes in that of a data set."""
SUMMARY_FILE = "summary.json"
MAX_PHYSICS_ATTEMPTS = 10
"""Number of drawn masses and frictions with which a scene may be unstable, one after the other."""
_VARIATION, _POSES, _NOISE = range(1, 4)
"""Last elements of the paths of an episode's random generators, beside that of `record_episode`."""


@dataclass(frozen=True)
class EpisodeSummary:
    """Outcome of a recorded episode.

    Attributes:
        index: Number of the episode.
        scene: Name of the scene.
        termination: Why it ended.
        error: Message of the exception of the policy; "" for none.
        results: Values of the `MoveResult` of the attempted moves.
        duration: Duration of all motions [s].
    """

    index: int
    scene: str
    termination: str
    error: str
    results: tuple[str, ...]
    duration: float

    @property
    def num_executed(self) -> int:
        """Number of moves that were carried out."""
        return sum(MoveResult(result).was_executed for result in self.results)


def episode_path(out: Path, index: int) -> Path:
    """Return the file of an episode in the folder of a data set."""
    return out / EPISODES_FOLDER / f"episode_{index:06d}.h5"


def read_summary(path: Path) -> EpisodeSummary:
    """Return the outcome of a recorded episode without reading its samples.

    Raises:
        InputError: The file cannot be read.
    """
    with reading_file(path, "a recorded episode"), h5py.File(path) as file:
        actions = [file[name] for name in sorted(file)]
        times = [action["time"] for action in actions if "time" in action]
        return EpisodeSummary(
            index=int(file.attrs["index"]),
            scene=str(file.attrs["scene_name"]),
            termination=str(file.attrs["termination"]),
            error=str(file.attrs["error"]),
            results=tuple(MoveResult(action.attrs["result"]).value for action in actions),
            duration=float(sum(time[-1] for time in times)),
        )


class EpisodeWriter:
    """Records episodes by their numbers and writes their files; a worker for `map_ordered`."""

    def __init__(self, job: RecordingJob, out: Path) -> None:
        """Create a worker.

        Args:
            job: The data set.
            out: Its folder.
        """
        self._job = job
        self._out = out
        self._load_scene = job.scenes.make_loader(job.config)
        self._make_policy = job.make_policy_factory()
        self._cameras = job.cameras.find(job.config)

    def __call__(self, index: int) -> EpisodeSummary:
        """Record an episode, write its file, and return its outcome."""
        job = self._job
        nominal, name = self._load_scene(index)
        nominal = vary_poses(nominal, job.randomization, item_rng(job.seed, index, _POSES))
        for variation in self._draw_variations(nominal, index):
            with varied_physics(nominal, variation) as scene:
                if variation.mass or variation.friction:
                    verdict = DrakeJudge(job.config).judge(scene, item_rng(job.seed, index, 0))
                    if not verdict.stable:
                        continue
                    scene = scene.with_poses(verdict.settled)
                episode = record_episode(
                    scene,
                    self._make_policy,
                    job.config,
                    EpisodeHeader(job.policy_name, job.seed, index, name, job.rate),
                    max_moves=job.max_moves,
                    stop_when_all_found=isinstance(job.policy, str) and job.policy != RANDOM,
                )
            break
        episode = replace(
            episode,
            initial_scene=nominal.with_poses(episode.initial_scene.poses),
            variation=variation.to_dict(),
        )
        self._save(episode, variation)
        return read_summary(episode_path(self._out, index))

    def _draw_variations(self, scene: Scene, index: int) -> Iterator[Variation]:
        """Yield variations until one suits the scene; the last one has the nominal masses."""
        job = self._job
        rng = item_rng(job.seed, index, _VARIATION)
        for _ in range(MAX_PHYSICS_ATTEMPTS):
            variation = draw_variation(
                job.randomization,
                scene.objects,
                colored_parts(job.config.cell),
                [camera.name for camera in self._cameras],
                NUM_LIGHTS,
                rng,
            )
            yield variation
        yield replace(variation, mass={}, friction={})

    def _save(self, episode: RecordedEpisode, variation: Variation) -> None:
        """Write an episode with its images."""
        job = self._job
        path = episode_path(self._out, episode.index)
        if not self._cameras:
            save_episode(path, episode)
            return
        recorder = CameraRecorder(
            episode.cell,
            episode.initial_scene,
            self._cameras,
            job.cameras.channels,
            variation,
            item_rng(job.seed, episode.index, _NOISE),
        )
        record_images = partial(recorder.record, rate=job.cameras.rate)
        save_episode(path, episode, record_images=record_images)


class Progress(Protocol):
    """Shows the progress of a part of the work."""

    def __call__(
        self, label: str, items: Iterable[Item], num_done: int, total: int, /
    ) -> Iterable[Item]:
        """Return the items of a part while they are counted.

        Args:
            label: What is counted.
            items: The items.
            num_done: Number of items that an earlier run has finished.
            total: Number of items, including those.
        """


def _show_nothing(label: str, items: Iterable[Item], num_done: int, total: int) -> Iterable[Item]:
    return items


def record_dataset(
    job: RecordingJob,
    num_episodes: int,
    formats: Sequence[DatasetFormat],
    out: Path,
    *,
    command: str = "",
    license: str = "",
    workers: int = 1,
    ray_address: str | None = None,
    progress: Progress = _show_nothing,
) -> dict[str, Any]:
    """Record a data set, or continue an interrupted or shorter one of the same job.

    An exception of the policy ends its episode, which is recorded with the message; the others go
    on.

    Args:
        job: The data set.
        num_episodes: Number of episodes at the end.
        formats: Formats of the data set; the recorded episodes are HDF5 files in any case.
        out: Folder of the data set.
        command: Command that makes the data set, for its card; "" names this function.
        license: SPDX identifier of the data's license, for its card; "" if none is chosen.
        workers: Number of worker processes.
        ray_address: Address of the Ray cluster that runs the workers; None runs them locally.
        progress: Shows the progress of recording, whose items are `EpisodeSummary`, of conversion
            and of the card.

    Returns:
        The summary, the content of `summary.json`.

    Raises:
        InputError: The policy or a camera does not exist, a package that a format needs is missing,
            or the folder holds another data set or more episodes.
    """
    job.check()
    for dataset_format in formats:
        check_format(dataset_format)
    with open_job_folder(out, job.to_dict()):
        (out / EPISODES_FOLDER).mkdir(exist_ok=True)
        num_files = len(list((out / EPISODES_FOLDER).glob("episode_*.h5")))
        if num_files > num_episodes:
            raise InputError(
                f"--episodes {num_episodes}: {out} holds {num_files}; expected at least as many"
            )
        paths = [episode_path(out, index) for index in range(num_episodes)]
        missing = [index for index, path in enumerate(paths) if not path.exists()]
        new_episodes = map_ordered(
            partial(EpisodeWriter, job, out), missing, workers=workers, ray_address=ray_address
        )
        num_done = num_episodes - len(missing)
        for _ in progress("episodes", new_episodes, num_done, num_episodes):
            pass
        catalog = load_catalog(job.catalog_folder)
        for dataset_format in formats:
            if dataset_format is not DatasetFormat.HDF5:
                label = f"episodes as {dataset_format.value}"
                shown_paths = progress(label, paths, 0, num_episodes)
                episodes = (load_episode(path, catalog) for path in shown_paths)
                convert_episodes(dataset_format, episodes, out)
        summary = summarize_dataset([read_summary(path) for path in paths])
        title = f"Moves of {job.policy_name} in {job.scenes.name}"
        text = CardText(title, command or "drake_clutter.record_dataset(...)", license)
        write_card(
            out,
            catalog,
            formats,
            text,
            progress=lambda files: progress("episodes in the card", files, 0, num_episodes),
        )
        write_json(out / SUMMARY_FILE, summary)
    return summary


def summarize_dataset(episodes: Sequence[EpisodeSummary]) -> dict[str, Any]:
    """Return counts of the episodes and moves of a data set.

    Args:
        episodes: Outcomes of all episodes.
    """
    results = Counter(result for episode in episodes for result in episode.results)
    executed = sum(episode.num_executed for episode in episodes)
    return {
        "episodes": len(episodes),
        "moves": sum(results.values()),
        "executed_moves": executed,
        "results": dict(results.most_common()),
        "terminations": dict(Counter(e.termination for e in episodes).most_common()),
        "recorded_seconds": float(np.sum([e.duration for e in episodes])),
        "errors": {e.index: e.error for e in episodes if e.error},
    }
