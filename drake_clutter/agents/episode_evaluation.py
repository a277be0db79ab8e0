"""Playing explorers on many scenes, in parallel, the same for any number of workers."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from drake_clutter.agents.backend_factory import make_backend_factory
from drake_clutter.agents.explorers import PolicyFactory, make_policy_factory
from drake_clutter.catalog import load_catalog
from drake_clutter.config import ClutterConfig
from drake_clutter.scenes.scene import Scene
from drake_clutter.scenes.scene_dataset import load_scene_dataset
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.seeding import item_rng
from drake_clutter.statistics import bootstrap_ratio_interval, mean_interval, wilson_interval
from drake_clutter.tasks.episode import run_episode
from drake_clutter.tasks.exploration_task import TerminationReason


@dataclass(frozen=True)
class EpisodeSpec:
    """What is to be played: an agent on a scene at rest. `index` seeds its chances.

    Attributes:
        file: a scene file that a judge has called stable, or a frozen set.
        number: of the scene in the set; None for a scene file.
        agent: see `make_explorers`.
        index: of the episode.
    """

    file: Path
    number: int | None
    agent: str
    index: int

    @property
    def scene(self) -> str:
        """What the scene is called."""
        return self.file.name if self.number is None else f"{self.file.name} {self.number}"


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode went.

    Attributes:
        scene: what the scene is called.
        agent: the agent's name.
        ended: why it ended.
        hidden: objects hidden at the start.
        found: those of them that were found.
        moves: moves made.
        found_after: (moves,) how many were found after each move.
        not_carried_out: moves that could not be.
    """

    scene: str
    agent: str
    ended: str
    hidden: int
    found: int
    moves: int
    found_after: tuple[int, ...]
    not_carried_out: int


class EpisodeRunner:
    """Plays episodes at a fidelity; a worker for the runner."""

    def __init__(
        self,
        config: ClutterConfig,
        catalog_folder: Path | None,
        max_moves: int,
        seed: int,
        fidelity: str,
    ) -> None:
        self._config, self._max_moves, self._seed = config, max_moves, seed
        # In this process: an object class is known by its identity.
        self._catalog = load_catalog(catalog_folder)
        self._set = cache(partial(load_scene_dataset, catalog=self._catalog))
        self._start_backend = make_backend_factory(fidelity, config)
        self._explorers: dict[str, PolicyFactory] = {}

    def _scene(self, episode: EpisodeSpec) -> Scene:
        if episode.number is None:
            return load_scene(episode.file, self._catalog).settled_scene
        held = self._set(episode.file)
        return held.settled_scene(episode.number, held.grammar, self._config)

    def __call__(self, episode: EpisodeSpec) -> EpisodeResult:
        """Plays one episode; the result depends on nothing but the episode and what the player was made with."""
        if episode.agent not in self._explorers:
            self._explorers[episode.agent] = make_policy_factory(episode.agent, self._config)
        backend = self._start_backend(self._scene(episode), item_rng(self._seed, episode.index))
        policy = self._explorers[episode.agent](backend)
        task = run_episode(backend, policy, max_moves=self._max_moves)
        found_after = np.cumsum([len(step.newly_found) for step in task.transitions], dtype=int)
        return EpisodeResult(
            scene=episode.scene,
            agent=episode.agent,
            ended=(task.termination or TerminationReason.GAVE_UP).value,
            hidden=len(task.initially_hidden),
            found=len(task.found),
            moves=len(task.transitions),
            found_after=tuple(int(n) for n in found_after),
            not_carried_out=sum(not step.outcome.result.was_executed for step in task.transitions),
        )


def summarize_episodes(results: Sequence[EpisodeResult], limits: Sequence[int]) -> dict[str, Any]:
    """An agent's row: what it had found within so many moves, whether all, and collapses, with 95 % intervals.

    Args:
        results: of one agent, on scenes that hide something.
        limits: of moves, at most those that were allowed.
    """
    row: dict[str, Any] = {
        "episodes": len(results),
        "hidden": float(np.mean([r.hidden for r in results])),
    }
    for limit in limits:
        won = [r.ended == TerminationReason.ALL_FOUND.value and r.moves <= limit for r in results]
        found = [r.found_after[:limit][-1] if r.found_after[:limit] else 0 for r in results]
        fallen = [
            r.ended == TerminationReason.COLLAPSED.value and r.moves <= limit for r in results
        ]
        row[f"within_{limit}"] = {
            "success": sum(won) / len(won),
            "success_ci95": wilson_interval(sum(won), len(won)),
            "found": float(np.mean(found)),
            "found_ci95": mean_interval(found),
            "found_of_hidden": sum(found) / sum(r.hidden for r in results),
            "found_of_hidden_ci95": bootstrap_ratio_interval(found, [r.hidden for r in results]),
            "collapsed": sum(fallen) / len(results),
            "collapsed_ci95": wilson_interval(sum(fallen), len(results)),
        }
    won_moves = [r.moves for r in results if r.ended == TerminationReason.ALL_FOUND.value]
    row["moves_of_successes"] = float(np.mean(won_moves)) if won_moves else None
    row["moves_of_successes_ci95"] = mean_interval(won_moves)
    row["not_carried_out"] = sum(r.not_carried_out for r in results) / max(
        1, sum(r.moves for r in results)
    )
    return row
