"""`drake-clutter record`."""

import shlex
import time
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.config_from_options import load_config_from_options, reject_support_settings
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    JsonOption,
    MaxMovesOption,
    NodesOption,
    ObjectsOption,
    OutOption,
    RayOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import Item, err_console, print_result, progress_bar
from drake_clutter.files import InputError
from drake_clutter.limits import MAX_COUNT, MAX_IMAGE_SIDE, MAX_SAMPLE_RATE

_MIN_IMAGE_SIDE = 16
_OPTIONS_OF_A_RUN = ("out", "workers", "ray", "as_json")
"""Parameters that do not influence the data set."""


class DataFormat(Enum):
    """Formats of a data set."""

    HDF5 = "hdf5"
    LEROBOT = "lerobot"
    ROBOMIMIC = "robomimic"
    RERUN = "rerun"
    MCAP = "mcap"


class Channel(Enum):
    """Kinds of images."""

    RGB = "rgb"
    DEPTH = "depth"
    SEGMENTATION = "segmentation"


def record(
    context: typer.Context,
    scenes: Annotated[
        str,
        typer.Option(
            help="Scene file or folder of them; shipped scene dataset, such as sg_star_25; scene "
            "dataset file; or scene generator, as for `generate --agent`."
        ),
    ],
    out: OutOption,
    policy: Annotated[
        str,
        typer.Option(
            help="Exploration policy, as for `explore --agent`: random (legal moves), "
            "full-knowledge, ...; or YAML list of moves, as for `move --moves`."
        ),
    ] = "largest-clear",
    episodes: Annotated[
        int,
        typer.Option(
            min=1,
            max=MAX_COUNT,
            help="Number of episodes; they repeat the scenes in their order.",
        ),
    ] = 100,
    format: Annotated[
        list[DataFormat] | None,
        typer.Option(
            help="hdf5: a file per episode, which is always written. lerobot: LeRobotDataset 3.0. "
            "robomimic: HDF5. rerun, mcap: a file per episode for Rerun, Foxglove. May be "
            "repeated.",
            show_default="hdf5",
        ),
    ] = None,
    rate: Annotated[
        float,
        typer.Option(
            min=1, max=MAX_SAMPLE_RATE, help="Samples per second [Hz], such as 125, 30 or 10."
        ),
    ] = 125.0,
    cameras: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="Cameras whose images are recorded: cameras of the cell, such as overhead; wrist "
            "(on the flange); oblique (the whole cell). Default: none.",
        ),
    ] = "",
    channels: Annotated[
        str, typer.Option(metavar="NAME,...", help="Images: rgb, depth, segmentation.")
    ] = "rgb,depth",
    resolution: Annotated[
        str | None,
        typer.Option(
            metavar="WIDTHxHEIGHT",
            help="Size of the images [pixels]. Default: that of each camera, 640x480.",
        ),
    ] = None,
    image_rate: Annotated[
        float, typer.Option(min=0.1, max=MAX_SAMPLE_RATE, help="Images per second [Hz].")
    ] = 10.0,
    randomize: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help="What is varied from episode to episode: poses, mass, friction, lights, textures, "
            "camera, noise; or YAML file with the fields of `RandomizationConfig`. Default: "
            "nothing.",
        ),
    ] = "",
    license: Annotated[
        str,
        typer.Option(metavar="SPDX", help="License of the data, for its card, such as CC-BY-4.0."),
    ] = "",
    max_moves: MaxMovesOption = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    objects: ObjectsOption = "ycb7",
    nodes: NodesOption = 25,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Record episodes of a policy with the simulated arm as a data set.

    Writes a file per episode in `episodes`, further formats, `summary.json` and a card: README.md
    with pictures. An interrupted run resumes when the same command is given again; a larger
    `--episodes` extends it.
    """
    from drake_clutter.commands.episode_scenes import FileScenes, find_scenes
    from drake_clutter.commands.explore_scene import read_moves
    from drake_clutter.commands.record_dataset import EpisodeSummary, record_dataset
    from drake_clutter.commands.recording_job import CameraOptions, RecordingJob
    from drake_clutter.recording.camera_recorder import CameraChannel
    from drake_clutter.recording.formats.dataset_format import DatasetFormat
    from drake_clutter.recording.randomization import load_randomization
    from drake_clutter.reports.terminal_text import describe_dataset

    config = load_config_from_options(config_file, cell_file, settings)
    source = find_scenes(
        scenes, config, catalog_folder=catalog, objects=objects, nodes=nodes, seed=seed
    )
    if isinstance(source, FileScenes):
        reject_support_settings(settings)
        scene_cell = None if cell_file else source.cell
        config = load_config_from_options(config_file, cell_file, settings, scene_cell)
    moves = tuple(read_moves(Path(policy))) if policy.endswith((".yaml", ".yml")) else None
    job = RecordingJob(
        scenes=source,
        policy=policy if moves is None else moves,
        config=config,
        seed=seed,
        rate=rate,
        max_moves=len(moves) if moves else max_moves,
        cameras=CameraOptions(
            names=tuple(filter(None, cameras.split(","))),
            channels=tuple(CameraChannel(channel.value) for channel in _parse_channels(channels)),
            resolution=_parse_resolution(resolution),
            rate=min(image_rate, rate),
        ),
        randomization=load_randomization(randomize),
        catalog_folder=catalog,
    )
    start = time.monotonic()
    executed = 0

    def moves_per_hour(item: object) -> str:
        nonlocal executed
        if not isinstance(item, EpisodeSummary):
            return ""
        executed += item.num_executed
        return f"{3600 * executed / (time.monotonic() - start):,.0f} moves/h"

    def progress(label: str, items: Iterable[Item], num_done: int, total: int) -> Iterable[Item]:
        return progress_bar(label, items, num_done, total, moves_per_hour)

    formats = [DatasetFormat(name.value) for name in format or ()]
    summary = record_dataset(
        job,
        episodes,
        formats,
        out,
        command=_command(context),
        license=license,
        workers=workers,
        ray_address=ray,
        progress=progress,
    )
    print_result(summary, describe_dataset(summary), as_json, f"{out}")
    if errors := summary["errors"]:
        index, message = next(iter(errors.items()))
        err_console.print(
            f"warning the policy raised in {len(errors)} of {summary['episodes']} episodes, first "
            f"in episode {index}: {message}",
            markup=False,
            highlight=False,
            soft_wrap=True,
        )


def _command(context: typer.Context) -> str:
    """Return the command line with the options that determine the data set.

    It is the same wherever the data set is recorded, so `--out` has a placeholder.
    """
    words = ["drake-clutter", str(context.info_name)]
    for option in context.command.params:
        value = context.params[str(option.name)]
        if option.name in _OPTIONS_OF_A_RUN or value == option.get_default(context):
            continue
        values = value if isinstance(value, list | tuple) else [value]
        for item in values:
            text = item.value if isinstance(item, Enum) else item
            words += [option.opts[0], str(text)]
    return f"{shlex.join(words)} --out DIR"


def _parse_channels(text: str) -> list[Channel]:
    """Return the channels of an option.

    Raises:
        InputError: A name is unknown, or there is none.
    """
    allowed = [channel.value for channel in Channel]
    names = text.split(",")
    for name in names:
        if name not in allowed:
            raise InputError(f"--channels {name}: expected some of {', '.join(allowed)}")
    return [Channel(name) for name in dict.fromkeys(names)]


def _parse_resolution(text: str | None) -> tuple[int, int] | None:
    """Return width and height of an option [px].

    Raises:
        InputError: The text is not two numbers, or one is out of range.
    """
    if text is None:
        return None
    width, _, height = text.partition("x")
    sides = [int(side) if side.isdecimal() else 0 for side in (width, height)]
    if not all(_MIN_IMAGE_SIDE <= side <= MAX_IMAGE_SIDE for side in sides):
        raise InputError(
            f"--resolution {text}: expected WIDTHxHEIGHT, each from {_MIN_IMAGE_SIDE} to "
            f"{MAX_IMAGE_SIDE}"
        )
    return sides[0], sides[1]
