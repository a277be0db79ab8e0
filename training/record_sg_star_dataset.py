"""Record the data set of 1,000 moves over `sg_star_25` whose card is published.

    python training/record_sg_star_dataset.py --workers 2 --out FOLDER \
        --card training/datasets/sg_star_25_moves

Random legal moves of the arm, five in an episode, with color, depth and segmentation of the
overhead camera at 10 Hz. `train_bc.py evaluate` plays them. The card, `README.md` with its
pictures, and the options, `job.json`, are copied to the folder of `--card`, and `summary.json` with
the commit of this software; the data stays in FOLDER. An interrupted run is resumed by the same
command. The scenes are those of an evaluation: an explorer that is trained on them is not to be
evaluated on `sg_star_25`.
"""

import math
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.commands.episode_scenes import find_scenes
from drake_clutter.commands.job_file import JOB_FILE
from drake_clutter.commands.record_dataset import EPISODES_FOLDER, SUMMARY_FILE, record_dataset
from drake_clutter.commands.recording_job import CameraOptions, RecordingJob
from drake_clutter.config import load_config
from drake_clutter.files import write_json
from drake_clutter.recording.camera_recorder import CameraChannel
from drake_clutter.reports.dataset_card import CARD_FILE, CONTACT_SHEET_FILE, FIGURES_FILE
from training.results_file import provenance
from training.script import Item, SeedOption, WorkersOption, progress, run_script

SCENES = "sg_star_25"
POLICY = "random"
MAX_MOVES = 5
"""Largest number of moves of an episode: the first ones meet the scene as it was generated."""
RATE = 30.0
"""Samples per second [Hz]."""
CAMERAS = CameraOptions(
    ("overhead",),
    (CameraChannel.RGB, CameraChannel.DEPTH, CameraChannel.SEGMENTATION),
    resolution=(320, 240),
)
COMMAND = "python training/record_sg_star_dataset.py --workers 2 --out FOLDER"


def main(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the data set.")],
    card: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to which the card is copied.")
    ] = None,
    moves: Annotated[int, typer.Option(min=1, help="Number of moves that are carried out.")] = 1000,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
) -> None:
    """Record the data set."""
    config = load_config()
    job = RecordingJob(
        find_scenes(SCENES, config),
        POLICY,
        config,
        seed=seed,
        rate=RATE,
        max_moves=MAX_MOVES,
        cameras=CAMERAS,
    )

    def show(label: str, items: Iterable[Item], num_done: int, total: int) -> Iterable[Item]:
        return progress(items, label, total, num_done)

    num_recorded = len(list((out / EPISODES_FOLDER).glob("episode_*.h5")))
    episodes = max(math.ceil(moves / MAX_MOVES), num_recorded)
    while True:
        summary = record_dataset(
            job, episodes, [], out, command=COMMAND, workers=workers, progress=show
        )
        executed = summary["executed_moves"]
        if executed >= moves:
            break
        # Moves that are not carried out, and episodes that end early, are made up for.
        episodes = max(episodes + 1, math.ceil(episodes * moves / max(executed, 1)))
    if card is not None:
        card.mkdir(parents=True, exist_ok=True)
        for name in (CARD_FILE, CONTACT_SHEET_FILE, FIGURES_FILE, JOB_FILE):
            shutil.copyfile(out / name, card / name)
        write_json(card / SUMMARY_FILE, {**provenance(), **summary})
    print(f"{executed} of {summary['moves']} moves carried out in {episodes} episodes")


if __name__ == "__main__":
    run_script(main)
