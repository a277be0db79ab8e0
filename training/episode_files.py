"""Record files of exploration episodes on frozen sets of scenes, or of targets in scenes."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from pydantic import BaseModel

from drake_clutter.agents.backend_factory import FIDELITIES
from drake_clutter.agents.episode_evaluation import EpisodeRunner, EpisodeSpec
from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS
from drake_clutter.config import ClutterConfig
from drake_clutter.files import InputError
from drake_clutter.learning.pretrained import checkpoint_sha256
from drake_clutter.scenes.scene_dataset import SceneDataset
from drake_clutter.tasks.episode import current_fidelity
from drake_clutter.validation import Count, CountOrZero, NonEmptyText, to_plain
from training.results_file import Row, collect_records
from training.script import SCENES
from training.target_set import TargetSet

MAX_MOVES = 20
"""Maximum number of moves of an episode."""

FidelityOption = Annotated[
    str, typer.Option(help=f"Model of the moves: {', '.join(FIDELITIES)}. Published: settle.")
]
AgentsOption = Annotated[
    list[str] | None,
    typer.Option("--agent", help="A policy instead of those of the set. May be repeated."),
]
CountOption = Annotated[
    int | None, typer.Option(min=1, help="Only the first N episodes of each set.")
]
SetNameOption = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Only sets whose name contains this text.")
]
EpisodesSeedOption = Annotated[int, typer.Option(min=0, help="Seed of the episodes.")]


class EpisodeRecord(BaseModel):
    """Record of an episode; see `EpisodeResult`."""

    scene: NonEmptyText
    agent: NonEmptyText
    ended: NonEmptyText
    hidden: Count
    found: CountOrZero
    moves: CountOrZero
    found_after: list[CountOrZero]
    not_carried_out: CountOrZero
    commit: str


def episodes_path(folder: Path, set_name: str, agent: str) -> Path:
    """Return the record file of an agent's episodes on a set."""
    if agent.endswith(".safetensors"):
        agent = f"{Path(agent).stem}_{checkpoint_sha256(agent, PRETRAINED_EXPLORERS)[:8]}"
    return folder / f"{set_name}_{agent}.jsonl.gz"


def collect_episodes(
    path: Path,
    frozen_set: SceneDataset | TargetSet,
    agent: str,
    count: int,
    *,
    fidelity: str,
    seed: int,
    workers: int,
) -> list[Row]:
    """Return the records of an agent's episodes; those that the file lacks are run.

    Args:
        path: The record file.
        frozen_set: Scenes, or targets in scenes, of a dataset in `training/scenes`.
        agent: See `make_policy_factory`.
        count: Number of episodes, on the first scenes or targets of the set.
        fidelity: Model of the moves.
        seed: Seed of the episodes.
        workers: Number of processes.
    """
    config = ClutterConfig()
    header = {
        "set": frozen_set.name,
        "sha256": frozen_set.sha256,
        "agent": agent,
        "weights": checkpoint_sha256(agent, PRETRAINED_EXPLORERS),
        "seed": seed,
        "fidelity": fidelity,
        "moves": MAX_MOVES,
        "config": to_plain(config),
    }
    if isinstance(frozen_set, TargetSet):
        episodes = [
            EpisodeSpec(SCENES / frozen_set.scenes, pair.scene, agent, k, pair.target)
            for k, pair in enumerate(frozen_set.pairs[:count])
        ]
    else:
        episodes = [EpisodeSpec(SCENES / frozen_set.name, k, agent, k) for k in range(count)]
    runner = partial(EpisodeRunner, config, None, MAX_MOVES, seed, fidelity)
    return collect_records(path, header, runner, episodes, schema=EpisodeRecord, workers=workers)


def check_evaluation(
    fidelity: str, out: Path | None, is_published_folder: bool, is_part: bool
) -> str:
    """Return the current name of a fidelity if an evaluation leaves published results whole.

    Args:
        fidelity: Model of the moves.
        out: Results file; None for the published ones.
        is_published_folder: Whether the records are among the published ones.
        is_part: Whether only some policies or scenes are evaluated.

    Raises:
        InputError: A published file would get other results, or the fidelity is unknown.
    """
    fidelity = current_fidelity(fidelity)
    if fidelity not in FIDELITIES:
        raise InputError(f"--fidelity {fidelity}; expected {', '.join(FIDELITIES)}")
    if is_published_folder and fidelity != "settle":
        raise InputError("DIR: is for episodes under settle; give another folder")
    if out is None and (is_part or fidelity != "settle"):
        raise InputError(
            "--out: is missing; the published tables are all agents' on all scenes under settle:"
            " give a file for others"
        )
    return fidelity
