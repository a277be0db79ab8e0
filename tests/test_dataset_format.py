"""Formats of data sets: files, their content, and missing packages."""

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import h5py
import pytest
from recorded_episodes import synthetic_episode

from drake_clutter.files import InputError
from drake_clutter.recording.formats.dataset_format import (
    DatasetFormat,
    check_format,
    convert_episodes,
)


@pytest.mark.parametrize(
    ("format", "files"),
    [
        (DatasetFormat.ROBOMIMIC, ["robomimic.hdf5"]),
        (DatasetFormat.RERUN, ["rerun/episode_000000.rrd", "rerun/episode_000003.rrd"]),
        (DatasetFormat.MCAP, ["mcap/episode_000000.mcap", "mcap/episode_000003.mcap"]),
    ],
)
def test_formats_have_their_files(format: DatasetFormat, files: list[str], tmp_path: Path) -> None:
    for _ in range(2):  # the second time, they are replaced
        convert_episodes(format, [synthetic_episode(index=k) for k in (0, 3)], tmp_path)
        found = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
        assert found == [Path(file) for file in files]
    if format is DatasetFormat.ROBOMIMIC:
        with h5py.File(tmp_path / files[0]) as file:
            assert len(file["data"]) == 4


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def find_spec(name: str) -> ModuleSpec | None:
        return None if name in ("av", "rerun") else ModuleSpec(name, None)

    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    with pytest.raises(
        InputError, match=r"--format lerobot: needs av; install drake_clutter with \[data\]"
    ):
        convert_episodes(DatasetFormat.LEROBOT, [], tmp_path)
    with pytest.raises(InputError, match="--format rerun: needs rerun-sdk; install"):
        check_format(DatasetFormat.RERUN)
    for format in (DatasetFormat.HDF5, DatasetFormat.ROBOMIMIC, DatasetFormat.MCAP):
        check_format(format)
    assert not list(tmp_path.iterdir())
