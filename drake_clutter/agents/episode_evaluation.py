"""Evaluation of exploration policies on many scenes, reproducible with any number of workers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.statistics import mean_interval, ratio_interval, wilson_interval
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason
from drake_clutter.tasks.search_target import require_target

_FAILED_MOVES = {reason.value for reason in TerminationReason if reason.is_failed_move}
"""How episodes end that count as collapsed: an object may have left the support."""


@dataclass(frozen=True)
class EpisodeSpec:
    """An episode to be run.

    Attributes:
        file: A file of a stable scene, or a scene dataset.
        scene_index: Index of the scene in the dataset; None for a scene file.
        agent: See `make_policy_factory`.
        index: Index of the episode, from which its random generator is seeded.
        target: Target of the search, see `find_target`; "" for all objects.
    """

    file: Path
    scene_index: int | None
    agent: str
    index: int
    target: str = ""

    @property
    def scene(self) -> str:
        """Name of the scene."""
        return (
            self.file.name if self.scene_index is None else f"{self.file.name} {self.scene_index}"
        )


@dataclass(frozen=True)
class EpisodeResult:
    """Result of an episode.

    Attributes:
        scene: Name of the scene.
        agent: Name of the agent.
        ended: Value of the `TerminationReason`.
        hidden: Number of objects that were hidden at the start.
        found: Number of those objects that were detected.
        moves: Number of moves, including those that could not be carried out.
        found_after: Number of objects found after each move. Shape (moves,).
        not_carried_out: Number of moves that could not be carried out.
    """

    scene: str
    agent: str
    ended: str
    hidden: int
    found: int
    moves: int
    found_after: tuple[int, ...]
    not_carried_out: int

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Return the result that a record, `asdict` as JSON, contains among other values."""
        values = {field.name: record[field.name] for field in fields(cls)}
        return cls(**values | {"found_after": tuple(record["found_after"])})


class EpisodeRunner:
    """Runs episodes at a fidelity; a worker for `map_ordered`."""

    def __init__(
        self,
        config: ClutterConfig,
        catalog_folder: Path | None,
        max_moves: int,
        seed: int,
        fidelity: str,
    ) -> None:
        """Create a runner.

        Args:
            config: Configuration of the simulated world.
            catalog_folder: Folder with additional object classes, or None.
            max_moves: Maximum number of moves of an episode.
            seed: Seed of the evaluation.
            fidelity: See `make_backend_factory`.
        """
        self._config = config
        self._max_moves = max_moves
        self._seed = seed
        # Loaded by each worker: object classes are compared by identity.
        self._catalog = load_catalog(catalog_folder)
        self._load_dataset = cache(partial(load_scene_dataset, catalog=self._catalog))
        self._make_backend = make_backend_factory(fidelity, config)
        self._make_policy_factory = cache(partial(make_policy_factory, config=config))

    def _load_scene(self, episode: EpisodeSpec) -> Scene:
        if episode.scene_index is None:
            return load_scene(episode.file, self._catalog).settled_scene
        dataset = self._load_dataset(episode.file)
        return dataset.settled_scene(episode.scene_index, dataset.grammar, self._config)

    def __call__(self, episode: EpisodeSpec) -> EpisodeResult:
        """Run an episode; the result depends only on it and the arguments of the constructor."""
        rng = item_rng(self._seed, episode.index)
        backend = self._make_backend(self._load_scene(episode), rng)
        target = None
        if episode.target:
            in_view = [d.name for d in backend.perception.observation.detections]
            target = require_target(episode.target, backend.scene, in_view, rng)
        make_policy = self._make_policy_factory(episode.agent, with_target=target is not None)
        policy = make_policy(backend, target=target)
        task = run_episode(backend, policy, max_moves=self._max_moves, target=target)
        transitions = task.transitions
        found_after = np.cumsum([len(t.newly_found) for t in transitions], dtype=int)
        return EpisodeResult(
            scene=episode.scene,
            agent=episode.agent,
            ended=(task.termination or TerminationReason.GAVE_UP).value,
            hidden=len(task.initially_hidden),
            found=len(task.found),
            moves=len(transitions),
            found_after=tuple(int(n) for n in found_after),
            not_carried_out=sum(not t.outcome.result.was_executed for t in transitions),
        )


def summarize_episodes(
    results: Sequence[EpisodeResult], move_limits: Sequence[int], max_objects: int
) -> dict[str, Any]:
    """Return the statistics of an agent's episodes.

    For each limit, `within_LIMIT` holds the success rate, the number and the fraction of hidden
    objects found, and the collapse rate, as if the episodes had ended after that number of moves.
    Keys that end in `ci95` hold 95 % confidence intervals: those of Wilson for rates, those of
    Gaffke for means and ratios (`drake_clutter.statistics`).

    Args:
        results: Results of one agent on scenes with hidden objects.
        move_limits: Numbers of moves; the largest is the episodes' maximum.
        max_objects: Largest number of objects of a scene, which bounds the number found.
    """
    num_hidden = [r.hidden for r in results]
    row: dict[str, Any] = {
        "episodes": len(results),
        "hidden": float(np.mean(num_hidden)),
    }
    for limit in move_limits:
        num_successes = sum(
            r.ended == TerminationReason.ALL_FOUND.value and r.moves <= limit for r in results
        )
        num_found = [r.found_after[:limit][-1] if r.found_after[:limit] else 0 for r in results]
        num_collapsed = sum(r.ended in _FAILED_MOVES and r.moves <= limit for r in results)
        row[f"within_{limit}"] = {
            "success": num_successes / len(results),
            "success_ci95": wilson_interval(num_successes, len(results)),
            "found": float(np.mean(num_found)),
            "found_ci95": mean_interval(num_found, 0, max_objects),
            "found_of_hidden": sum(num_found) / sum(num_hidden),
            # All objects may be hidden in a scene, and none or all of them found.
            "found_of_hidden_ci95": ratio_interval(
                num_found, num_hidden, (0, max_objects), (max_objects, max_objects)
            ),
            "collapsed": num_collapsed / len(results),
            "collapsed_ci95": wilson_interval(num_collapsed, len(results)),
        }
    success_moves = [r.moves for r in results if r.ended == TerminationReason.ALL_FOUND.value]
    num_moves = sum(r.moves for r in results)
    row["moves_of_successes"] = float(np.mean(success_moves)) if success_moves else None
    row["moves_of_successes_ci95"] = mean_interval(success_moves, 1, max(move_limits))
    row["not_carried_out"] = sum(r.not_carried_out for r in results) / max(1, num_moves)
    return row
