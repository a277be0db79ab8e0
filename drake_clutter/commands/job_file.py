"""`job.json`: the options of a job, which decide whether its output folder can be resumed."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig, upgrade_header_configs
from drake_clutter.files import (
    InputError,
    file_sha256,
    read_json,
    reading_file,
    write_json,
)
from drake_clutter.outputs import check_folder_is_empty, find_result, output_folder
from drake_clutter.validation import to_plain, validate

JOB_FILE = "job.json"
_MAX_NAMED_FIELDS = 3
"""Number of differing fields that a message names."""
_RENAMED_FIELDS = {
    "catalogue_folder": "catalog_folder",
    "dropped_share": "heap_fraction",
    "world": "config",
}
"""Current names of fields by those that version 0.1 wrote."""


@contextmanager
def open_job_folder(out: Path, job: Mapping[str, Any]) -> Iterator[None]:
    """Keep the output folder of a job open, alone; it is new, empty or of the same job.

    A folder in which a job has left no results is as good as empty.

    Args:
        out: Output folder.
        job: Everything that determines the results, as a document.

    Raises:
        InputError: The folder holds results of another job, or other files, or another run writes
            to it.
    """
    with output_folder(out):
        path = out / JOB_FILE
        if find_result(out, [JOB_FILE]) is None:
            write_json(path, job)
        elif not path.exists():
            check_folder_is_empty(out)
        else:
            _check_same_job(path, job)
        try:
            yield
        finally:
            if find_result(out, [JOB_FILE]) is None:
                path.unlink(missing_ok=True)


def scene_job(
    command: str,
    scene_file: Path,
    config: ClutterConfig,
    catalog_folder: Path | None,
    **options: Any,
) -> dict[str, Any]:
    """Return the job document of a command on a scene file.

    Args:
        command: Name of the command.
        scene_file: The scene file, which is identified by its content.
        config: Configuration.
        catalog_folder: Asset folder with the user's object classes, or None.
        options: Further options, as JSON values.
    """
    return {
        "command": command,
        "scene": scene_file.name,
        "scene_sha256": file_sha256(scene_file),
        "catalog_folder": str(catalog_folder.resolve()) if catalog_folder else None,
        **options,
        "config": to_plain(config),
    }


def read_result(path: Path) -> Any:
    """Return the document that a finished job has written last; None if it is not finished."""
    return read_json(path, "the results of a job") if path.exists() else None


def _check_same_job(path: Path, job: Mapping[str, Any]) -> None:
    """Raise an InputError if a job file is not that of a job."""
    out = path.parent
    try:
        earlier_job = _read_job(path)
    except InputError as error:
        raise InputError(
            f"--out {out}: cannot be resumed, because its {JOB_FILE} is not one of this version "
            f"({error}); give another folder"
        ) from error
    differing = ", ".join(islice(_differing_fields(job, earlier_job), _MAX_NAMED_FIELDS))
    if differing:
        raise InputError(
            f"--out {out}: holds results of other options, see {JOB_FILE} (differs in {differing});"
            " give the same options or another folder"
        )


def _differing_fields(job: Mapping[str, Any], other: Mapping[str, Any]) -> Iterator[str]:
    """Yield the names of the fields in which two documents differ, such as "config.layout"."""
    for key in dict.fromkeys([*job, *other]):
        value, other_value = job.get(key), other.get(key)
        if isinstance(value, dict) and isinstance(other_value, dict):
            # The order of cameras matters, too.
            if [*value] == [*other_value]:
                yield from (f"{key}.{name}" for name in _differing_fields(value, other_value))
            else:
                yield key
        elif key not in job or key not in other or json.dumps(value) != json.dumps(other_value):
            yield key


def _read_job(path: Path) -> dict[str, Any]:
    """Return a job document with the field names and defaults of this version."""
    source = str(path)
    content = "the options of a job, unmodified"
    with reading_file(path, content):
        written = validate(dict[str, Any], read_json(path, content), source)
        job = {_RENAMED_FIELDS.get(key, key): value for key, value in written.items()}
        if "heap_fraction" in job:
            # Version 0.1 rendered shipped objects alone, with VTK.
            job = {"catalog": None, "renderer": "vtk"} | job
        if "config" in job:
            config = upgrade_header_configs(job["config"])
            job["config"] = to_plain(validate(ClutterConfig, config, f"{source}: config"))
        if "setups" in job:
            cells = validate(dict[str, WorkCell], job["setups"], f"{source}: setups")
            job["setups"] = {name: to_plain(cell) for name, cell in cells.items()}
        return job
