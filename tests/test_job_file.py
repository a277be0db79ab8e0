"""Folders of resumable jobs: which ones are resumed, also those of version 0.1."""

import json
from pathlib import Path
from typing import Any

import pytest
from feasibility_jobs import feasibility_job

from drake_clutter.commands.job_file import JOB_FILE, open_job_folder
from drake_clutter.files import InputError


def job(seed: int = 0) -> dict[str, Any]:
    return feasibility_job(Path(__file__), seed).to_dict()


def test_the_same_job_is_resumed_and_another_refused(tmp_path: Path) -> None:
    out = tmp_path / "study"
    with open_job_folder(out, job()):
        (out / "result.csv").touch()
    with open_job_folder(out, job()):
        assert json.loads((out / JOB_FILE).read_text()) == job()
    with (
        pytest.raises(InputError, match=r"holds results of other options, see job\.json"),
        open_job_folder(out, job(seed=1)),
    ):
        pass


def test_a_job_without_results_leaves_its_folder_to_any_other(tmp_path: Path) -> None:
    (tmp_path / "scenes").mkdir()
    with pytest.raises(KeyboardInterrupt), open_job_folder(tmp_path, job()):
        raise KeyboardInterrupt
    assert [path.name for path in tmp_path.iterdir()] == ["scenes"]
    (tmp_path / JOB_FILE).write_text(json.dumps(job()))  # of a killed run
    with open_job_folder(tmp_path, job(seed=1)):
        assert json.loads((tmp_path / JOB_FILE).read_text()) == job(seed=1)


def test_temporary_files_of_a_killed_run_are_removed(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    names = ["images/.a.tmp-0123abcd.png", ".episode.tmp-01234567.json", ".export.tmp-00000000"]
    for name in names:
        (tmp_path / name).touch()
    (tmp_path / "images" / ".mine.png").touch()
    (tmp_path / ".export.tmp-11111111").mkdir()
    (tmp_path / JOB_FILE).write_text(json.dumps(job()))
    with open_job_folder(tmp_path, job()):
        assert not any((tmp_path / name).exists() for name in names)
        assert not (tmp_path / ".export.tmp-11111111").exists()
    assert (tmp_path / "images" / ".mine.png").exists()


def test_a_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="is not empty"), open_job_folder(tmp_path, job()):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_job_of_version_0_1_is_resumed(tmp_path: Path) -> None:
    earlier = {
        {"config": "world", "catalog_folder": "catalogue_folder"}.get(key, key): value
        for key, value in job().items()
    }
    (tmp_path / JOB_FILE).write_text(json.dumps(earlier))
    (tmp_path / "result.csv").touch()
    with open_job_folder(tmp_path, job()):
        assert json.loads((tmp_path / JOB_FILE).read_text()) == earlier


def test_a_study_of_version_0_1_is_refused(tmp_path: Path) -> None:
    """Its setups are arms, not work cells."""
    earlier = job() | {"setups": {"default": {"base": [-0.75, 0.0, 0.3], "payload": 10.0}}}
    (tmp_path / JOB_FILE).write_text(json.dumps(earlier))
    (tmp_path / "result.csv").touch()
    with (
        pytest.raises(InputError, match=r"cannot be resumed.*give another folder"),
        open_job_folder(tmp_path, job()),
    ):
        pass


def test_images_of_version_0_1_are_extended(tmp_path: Path) -> None:
    earlier = {"objects": "ycb7", "dropped_share": 0.3, "seed": 0, "agents": ["random"]}
    (tmp_path / JOB_FILE).write_text(json.dumps(earlier))
    (tmp_path / "camera.json").touch()
    images = {"objects": "ycb7", "catalog": None, "heap_fraction": 0.3, "seed": 0}
    images["renderer"] = "vtk"
    with open_job_folder(tmp_path, images | {"agents": ["random"]}):
        assert json.loads((tmp_path / JOB_FILE).read_text()) == earlier
