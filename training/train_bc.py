r"""Clone a policy that reaches for a pick from recorded moves, and play it back in the station.

    drake-clutter record --scenes training/scenes/train_sg_star.json --policy random \
        --episodes 420 --max-moves 5 --rate 30 --cameras overhead --channels depth,segmentation \
        --resolution 320x240 --workers 2 --out runs/train_sg_star_moves
    python training/record_sg_star_dataset.py --workers 2 --out runs/sg_star_25_moves
    python training/train_bc.py train --set observation=state --out runs/bc_state
    python training/train_bc.py train --set observation=depth --out runs/bc_depth
    python training/train_bc.py evaluate runs/bc_state runs/bc_depth \
        --data runs/sg_star_25_moves --first 150 --out runs/bc.json

The policy sees the joint angles and a target: the top of the picked object, and how far its
neighbors rise above it, from the state of the scene or from the overhead depth image with the mask
of the object. Its action is a waypoint: the change of the joint angles within `LOOKAHEAD`.
Demonstrations are the recorded commands between home and the grasp. States next to them are
sampled, too, and lead to the same waypoints, so that the policy returns to its way. The angle of
the last joint, about the cup's axis, is not changed.

Frames: T is the support, G is the tool, z out of it, O is the picked object.
"""

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from drake_clutter.files import InputError
from drake_clutter.learning.checkpoint import load_checkpoint
from drake_clutter.learning.training_run import TrainingRun
from drake_clutter.robots.robot_model import load_robot
from drake_clutter.statistics import wilson_interval
from drake_clutter.validation import load_config_as, to_plain
from training.reaching_demonstrations import (
    Demonstration,
    common_branch,
    read_demonstrations,
    split,
)
from training.reaching_learner import CloningConfig, CloningLearner, StateSampler, relative_error
from training.reaching_playback import (
    CONTROL_PERIOD,
    MAX_DISPLACEMENT,
    TIME_LIMIT,
    Playback,
    play,
)
from training.reaching_policy import CHECKPOINT_KIND, LOOKAHEAD, ReachingPolicy
from training.results_file import ResultsFile, Row, collect_records
from training.script import (
    ConfigOption,
    ResultsOption,
    SettingsOption,
    WorkersOption,
    print_table,
    run_script,
)
from training.training_loop import CheckpointSpec, Metrics, OutOption, train_to_end

CHECKPOINT = "policy.safetensors"
"""File name of the trained policy in the folder of a run."""
CONFIG = CloningConfig()
"""Default configuration."""


def train(
    out: OutOption,
    config: ConfigOption = None,
    settings: SettingsOption = None,
) -> None:
    """Clone a policy and write policy.safetensors."""
    training = load_config_as(CONFIG, config, settings or ())
    torch.manual_seed(training.seed)
    demonstrations = read_demonstrations(Path(training.data), training.tool)
    learned, validation = split(_usable(demonstrations, training), training.validation)
    learned = common_branch(learned)
    num_joints = learned[0].q.shape[1]
    network = ReachingPolicy(training.observation, num_joints)
    learner = CloningLearner(network, learned, training)
    scale = StateSampler(learned, perturb=False).action_scale
    network.action_scale.copy_(torch.from_numpy(scale))
    base = load_robot(learned[0].cell.robot).X_TB.translation()
    network.base.copy_(torch.from_numpy(base))
    run = TrainingRun(out, training, learner, training.steps, steps_field="steps")
    metadata = {
        "kind": CHECKPOINT_KIND,
        "observation": training.observation,
        "num_joints": num_joints,
        "moves": len(learned),
        "scenes": sorted({d.scene_name for d in (*learned, *validation)}),
    }
    shown = StateSampler(validation, perturb=False).all_states()
    images = [d.image for d in validation if d.image is not None]

    def evaluate() -> tuple[Metrics, Metrics]:
        with torch.inference_mode():
            target = shown.target
            if training.observation == "depth":
                target = network.find_target(torch.from_numpy(np.stack(images)))[shown.index]
            change = network(shown.q, shown.p_TG, shown.axis, target)
            error = relative_error(change, shown.change).mean()
            distance = (target[:, :3] - shown.end).norm(dim=1).median()
        return {"validation": float(error), "target_mm": 1000 * float(distance)}, learner.losses

    train_to_end(
        run,
        learner,
        training.steps,
        CheckpointSpec(CHECKPOINT, metadata, lambda metrics: -metrics["validation"]),
        train_iteration=learner.train_iteration,
        evaluate=evaluate,
        evaluate_every=training.evaluate_every,
        save_every=training.evaluate_every,
    )


def _usable(
    demonstrations: Sequence[Demonstration], training: CloningConfig
) -> list[Demonstration]:
    """Return the moves that have what a policy observes."""
    return [d for d in demonstrations if training.observation == "state" or d.image is not None]


def load_run(folder: Path) -> tuple[ReachingPolicy, CloningConfig, Mapping[str, Any]]:
    """Return policy, configuration and metadata of a finished run."""
    metadata = load_checkpoint(folder / CHECKPOINT).metadata
    settings = load_config_as(CONFIG, folder / "config.yaml")
    return ReachingPolicy.load(folder / CHECKPOINT), settings, metadata


def held_out_moves(
    data: Path, tool: str, first: int, count: int, seen: Collection[str]
) -> list[Demonstration]:
    """Return moves that policies are evaluated with, whatever they observe.

    Args:
        data: Folder of the data set.
        tool: Name of the tool.
        first: Number of the first episode.
        count: Number of moves.
        seen: Names of the scenes of training and validation.

    Raises:
        InputError: The data set does not have as many moves, or the scene of a move was seen.
    """
    moves = [d for d in read_demonstrations(data, tool, first) if d.image is not None]
    if len(moves) < count:
        found = f"--count {count}: {data} has {len(moves)} moves with images from episode {first}"
        raise InputError(f"{found} on; expected at least as many")
    if both := {move.scene_name for move in moves[:count]}.intersection(seen):
        raise InputError(f"--data {data}: scene {min(both)} was learned; expected other scenes")
    return moves[:count]


class Player:
    """Plays moves of which a policy has not learned; a worker for `map_ordered`."""

    def __init__(self, folder: Path, data: Path, first: int, count: int) -> None:
        """Load policy and moves.

        Args:
            folder: Folder of a run.
            data: See `held_out_moves`.
            first: See `held_out_moves`.
            count: See `held_out_moves`.
        """
        torch.set_num_threads(1)
        self._policy, config, metadata = load_run(folder)
        self._moves = held_out_moves(data, config.tool, first, count, metadata["scenes"])

    def __call__(self, number: int) -> Playback:
        """Return the record of a move."""
        return play(self._policy, self._moves[number])


def evaluate(
    runs: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of runs.")],
    data: Annotated[
        Path, typer.Option(metavar="DIR", help="Recorded data set of scenes of their own.")
    ],
    first: Annotated[
        int, typer.Option(min=0, help="Number of the first episode whose moves are played.")
    ] = 0,
    count: Annotated[int, typer.Option(min=1, help="Number of moves.")] = 100,
    out: ResultsOption = None,
    workers: WorkersOption = 1,
) -> None:
    """Play held-out moves in the station and write how many reach their pick."""
    rows = list[Row]()
    for folder in runs:
        _, config, metadata = load_run(folder)
        records = collect_records(
            folder / "playbacks.jsonl",
            {
                "policy": metadata["commits"],
                "steps": config.steps,
                "seed": config.seed,
                "data": str(data),
                "first": first,
            },
            partial(Player, folder, data, first, count),
            range(count),
            schema=Playback,
            workers=workers,
        )
        reached = sum(record["reached"] for record in records)
        rows.append(
            {
                "observation": config.observation,
                "training": to_plain(config),
                "seed": config.seed,
                "moves": metadata["moves"],
                "held_out": len(records),
                "reached": reached / len(records),
                "reached_ci95": wilson_interval(reached, len(records)),
                "duration_s": float(np.median([record["duration"] for record in records])),
                "playbacks": records,
                "software_version": records[-1]["software_version"],
                "commit": records[-1]["commit"],
            }
        )
    header = {
        "data": str(data),
        "first_episode": first,
        "lookahead_s": LOOKAHEAD,
        "control_period_s": CONTROL_PERIOD,
        "time_limit_s": TIME_LIMIT,
        "max_displacement_mm": 1000 * MAX_DISPLACEMENT,
    }
    if out:
        ResultsFile(out, header, ("observation", "seed")).add(*rows)
    print_table(
        [
            {
                "observation": row["observation"],
                "moves": row["moves"],
                "reached": f"{row['reached']:.2f} of {row['held_out']}",
                "median duration": f"{row['duration_s']:.1f} s",
            }
            for row in rows
        ]
    )


if __name__ == "__main__":
    run_script(train, evaluate)
