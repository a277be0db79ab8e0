"""Formats of a data set, and what they need.

Each is written from recorded episodes below the folder of the data set:

    hdf5       episodes/episode_000000.h5, the recorded episodes themselves
    lerobot    meta, data and videos: the folder is the root of a LeRobotDataset
    robomimic  robomimic.hdf5
    rerun      rerun/episode_000000.rrd
    mcap       mcap/episode_000000.mcap
"""

import importlib.util
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from pathlib import Path

from drake_clutter.files import InputError
from drake_clutter.recording.recorded_episode import RecordedEpisode


class DatasetFormat(Enum):
    """Formats of a data set."""

    HDF5 = "hdf5"
    LEROBOT = "lerobot"
    ROBOMIMIC = "robomimic"
    RERUN = "rerun"
    MCAP = "mcap"


_MODULES = {
    DatasetFormat.HDF5: {},
    DatasetFormat.LEROBOT: {"pyarrow": "pyarrow", "av": "av"},
    DatasetFormat.ROBOMIMIC: {},
    DatasetFormat.RERUN: {"rerun": "rerun-sdk"},
    DatasetFormat.MCAP: {
        "mcap": "mcap",
        "mcap_protobuf": "mcap-protobuf-support",
        "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    },
}
"""Package of each module that a format needs, by the module."""


def check_format(format: DatasetFormat) -> None:
    """Check that the packages of a format are installed.

    Raises:
        InputError: One is missing.
    """
    check_modules(f"--format {format.value}", _MODULES[format])


def check_modules(option: str, packages: Mapping[str, str]) -> None:
    """Check that modules of the extra `data` are installed.

    Args:
        option: Option that needs them, for the message.
        packages: Package of each module, by the module.

    Raises:
        InputError: One is missing.
    """
    missing = [
        package for module, package in packages.items() if importlib.util.find_spec(module) is None
    ]
    if missing:
        names = ", ".join(missing)
        raise InputError(f"{option}: needs {names}; install drake_clutter with [data]")


def convert_episodes(format: DatasetFormat, episodes: Iterable[RecordedEpisode], out: Path) -> None:
    """Write episodes in a format; the recorded episodes themselves are HDF5 already.

    Args:
        format: The format.
        episodes: Recorded episodes, which are read one after the other.
        out: Folder of the data set.

    Raises:
        InputError: A package is missing, or the episodes do not suit the format.
    """
    check_format(format)
    if format is DatasetFormat.LEROBOT:
        from drake_clutter.recording.formats.lerobot import write_lerobot

        write_lerobot(out, episodes)
    elif format is DatasetFormat.ROBOMIMIC:
        from drake_clutter.recording.formats.robomimic import write_robomimic

        write_robomimic(out / "robomimic.hdf5", episodes)
    elif format is DatasetFormat.RERUN:
        from drake_clutter.recording.formats.rerun import write_rerun

        _write_files(out / "rerun", ".rrd", episodes, write_rerun)
    elif format is DatasetFormat.MCAP:
        from drake_clutter.recording.formats.mcap import write_mcap

        _write_files(out / "mcap", ".mcap", episodes, write_mcap)


def _write_files(
    folder: Path,
    suffix: str,
    episodes: Iterable[RecordedEpisode],
    write: Callable[[Path, RecordedEpisode], None],
) -> None:
    """Write a file for each episode."""
    folder.mkdir(exist_ok=True)
    for episode in episodes:
        write(folder / f"episode_{episode.index:06d}{suffix}", episode)
