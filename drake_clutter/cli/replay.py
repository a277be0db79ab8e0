"""`drake-clutter replay`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drake_clutter.cli.options import CatalogOption, HtmlOption
from drake_clutter.cli.output import (
    locked_files,
    out_console,
    print_line,
    progress_bar,
    show_recording,
    writing_file,
)
from drake_clutter.files import InputError

if TYPE_CHECKING:
    from drake_clutter.recording.recorded_episode import RecordedEpisode


def replay(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.h5",
            help="Recorded episode: `trajectory.h5` of `--fidelity arm`, or a file of a data set.",
        ),
    ],
    speed: Annotated[
        float, typer.Option(min=0.01, max=100.0, help="Times faster than recorded.")
    ] = 1.0,
    html_file: HtmlOption = None,
    rrd_file: Annotated[
        Path | None,
        typer.Option("--rrd", metavar="FILE", help="Write a recording for Rerun instead."),
    ] = None,
    mp4_file: Annotated[
        Path | None, typer.Option("--mp4", metavar="FILE", help="Write a video instead.")
    ] = None,
    catalog: CatalogOption = None,
) -> None:
    """Replay recorded arm motions in the browser (Meshcat), or write them for other viewers."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.recording.formats.dataset_format import check_modules
    from drake_clutter.recording.hdf5_file import load_episode
    from drake_clutter.reports.recording import replay_frames

    if rrd_file is not None:
        check_modules("--rrd", {"rerun": "rerun-sdk"})
    if mp4_file is not None:
        check_modules("--mp4", {"av": "av"})
    with locked_files({"--html": html_file, "--rrd": rrd_file, "--mp4": mp4_file}):
        episode = load_episode(file, load_catalog(catalog), images=rrd_file is not None)
        _print_actions(episode)
        if all(action.samples is None for action in episode.actions):
            raise InputError(f"{file}: holds no motion; expected a file with at least one move")
        if rrd_file is not None:
            from drake_clutter.recording.formats.rerun import write_rerun

            with writing_file(rrd_file, "--rrd"):
                write_rerun(rrd_file, episode)
            print_line(f"Wrote {rrd_file}.")
        if mp4_file is not None:
            from drake_clutter.reports.filmstrip import render_frames
            from drake_clutter.reports.video import VIDEO_RATE, VIDEO_SIDE, write_video

            frames = replay_frames(episode, speed, VIDEO_RATE)
            images = render_frames(episode.initial_scene, frames, episode.cell, VIDEO_SIDE)
            times = [frame.time for frame in frames]
            with writing_file(mp4_file, "--mp4"):
                write_video(mp4_file, progress_bar("pictures", images, 0, len(frames)), times)
            print_line(f"Wrote {mp4_file}.")
        if html_file is not None or (rrd_file is None and mp4_file is None):
            frames = replay_frames(episode, speed)
            show_recording(file, episode.initial_scene, frames, episode.cell, html_file)


def _print_actions(episode: "RecordedEpisode") -> None:
    """Print the result of each action of an episode."""
    for number, action in enumerate(episode.actions, start=1):
        text = f"{number}. {action.move}: {action.result.value}"
        if action.failure_reason:
            text += f" ({action.failure_reason})"
        if action.samples is not None:
            text += f", {action.samples.time[-1]:.1f} s"
        out_console.print(text, highlight=False)
