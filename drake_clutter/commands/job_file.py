"""`job.json`: the options of a resumable job, which decide whether a folder can be resumed."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.config import ClutterConfig, upgrade_header_configs
from drake_clutter.files import (
    InputError,
    prepare_output_directory,
    read_json,
    reading_file,
    write_json,
)
from drake_clutter.validation import to_plain, validate

JOB_FILE = "job.json"
_RENAMED_FIELDS = {"catalogue_folder": "catalog_folder", "world": "config"}
"""Current names of fields by those that version 0.1 wrote."""


def open_job_folder(out: Path, job: Mapping[str, Any]) -> None:
    """Create the output folder of a job, or check that a folder belongs to the same job.

    Args:
        out: Output folder.
        job: Everything that determines the results, as a document.

    Raises:
        InputError: The folder holds results of another job, or other files.
    """
    path = out / JOB_FILE
    if not path.exists():
        prepare_output_directory(out)
        write_json(path, job)
        return
    try:
        earlier_job = _read_job(path)
    except InputError as error:
        raise InputError(
            f"--out {out}: cannot be resumed, because its {JOB_FILE} is not one of this version "
            f"({error}); give another folder"
        ) from error
    # Compared as text, because the order of cameras matters, too.
    if json.dumps(earlier_job) != json.dumps(job):
        raise InputError(
            f"--out {out}: holds results of other options, see {JOB_FILE}; give the same options "
            "or another folder"
        )


def _read_job(path: Path) -> dict[str, Any]:
    """Return a job document with the field names and defaults of this version."""
    source = str(path)
    content = "the options of a job, unmodified"
    with reading_file(path, content):
        written = validate(dict[str, Any], read_json(path, content), source)
        job = {_RENAMED_FIELDS.get(key, key): value for key, value in written.items()}
        if "config" in job:
            config = upgrade_header_configs(job["config"])
            job["config"] = to_plain(validate(ClutterConfig, config, f"{source}: config"))
        if "setups" in job:
            cells = validate(dict[str, WorkCell], job["setups"], f"{source}: setups")
            job["setups"] = {name: to_plain(cell) for name, cell in cells.items()}
        return job
