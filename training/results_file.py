"""Results files and record files of the scripts in `training/` and `benchmarks/`.

A results file is a JSON document: what its rows have in common (seed, configuration, ...), and
`rows`, one for each measured combination. A record file (`drake_clutter.records`) holds the
individual episodes or scenes that a row summarizes.
"""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import drake_clutter
from drake_clutter.config import ClutterConfig, upgrade_config, upgrade_header_configs
from drake_clutter.files import (
    InputError,
    format_value,
    input_error,
    read_json,
    reading_file,
    write_json,
)
from drake_clutter.records import resume_jsonl
from drake_clutter.resources import git_commit
from drake_clutter.tasks.episode import current_fidelity
from drake_clutter.validation import override_config, to_plain, validate
from drake_clutter.workers.parallel_map import map_ordered
from drake_clutter.yaml_io import parse_yaml
from training.script import progress

Row = dict[str, Any]
"""One row of a results file."""


def provenance() -> dict[str, str]:
    """Return the version and the commit of this software, for a results file."""
    return {"software_version": drake_clutter.__version__, "commit": git_commit()}


def upgrade_record_header(header: Any) -> Any:
    """Upgrade the header of a file of an earlier version to the current names of fields.

    A config that is written as YAML text is complete for its version. Fields that have been added
    to it since have their default values.
    """
    upgraded = upgrade_header_configs(header)
    if not isinstance(upgraded, dict):
        return upgraded
    if "fidelity" in upgraded:
        upgraded["fidelity"] = current_fidelity(upgraded["fidelity"])
    text = upgraded.get("config")
    if isinstance(text, str) and isinstance(config := parse_yaml(text, "config"), dict):
        given = upgrade_config(config)
        upgraded["config"] = to_plain(override_config(ClutterConfig(), given, "config"))
    return upgraded


@dataclass(frozen=True)
class ResultsFile:
    """A results file whose rows are measured one after the other, in one run or several.

    Attributes:
        path: The file.
        header: What all rows have in common. A file with another header is rejected.
        keys: Fields that identify a row.
    """

    path: Path
    header: Mapping[str, Any]
    keys: tuple[str, ...]

    def read(self) -> list[Row]:
        """Return the rows in the file; an empty list if there is no file.

        Raises:
            InputError: The file is not a results file, or has another header.
        """
        if not self.path.exists():
            return []
        source = f"--out {self.path}"
        content = "a results file, or a new file"
        with reading_file(source, content):
            document = upgrade_record_header(read_json(self.path, content))
            rows = validate(list[Row], document["rows"], f"{source}: rows")
            differing = [key for key, value in self.header.items() if document[key] != value]
        for key in self.keys:
            for row in rows:
                if not isinstance(row.get(key, ...), str | int | float | None):
                    raise input_error(
                        source, f"rows: {key}: {format_value(row.get(key))}; expected {content}"
                    )
        if differing:
            raise InputError(
                f"--out {self.path}: holds results of another {', '.join(differing)}; give the same"
                " options or another file"
            )
        return rows

    def find(self, row: Row) -> Row | None:
        """Return the row in the file with the same `keys` as a row; None if there is none."""
        return self._by_key().get(self._key(row))

    def add(self, *rows: Row) -> None:
        """Write rows into the file; rows in the file with the same `keys` are replaced."""
        merged = self._by_key() | {self._key(row): row for row in rows}
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, {**self.header, "rows": list(merged.values())})

    def keep(self, identifiers: Collection[tuple[Any, ...]]) -> int:
        """Remove all rows but some from the file.

        Args:
            identifiers: Values of the fields `keys` of the rows that are kept.

        Returns:
            Number of removed rows.
        """
        rows = self.read()
        kept = [row for row in rows if self._key(row) in identifiers]
        if len(kept) < len(rows):
            write_json(self.path, {**self.header, "rows": kept})
        return len(rows) - len(kept)

    def _by_key(self) -> dict[tuple[Any, ...], Row]:
        return {self._key(row): row for row in self.read()}

    def _key(self, row: Row) -> tuple[Any, ...]:
        return tuple(row[key] for key in self.keys)


def collect_records(
    path: Path,
    header: Mapping[str, Any],
    make_worker: Callable[[], Callable[[Any], Any]],
    items: Sequence[Any],
    *,
    schema: Any,
    workers: int,
    ray_address: str | None = None,
    max_items_per_process: int | None = None,
    upgrade: Callable[[Any], Any] = upgrade_record_header,
) -> list[Row]:
    """Return the records of items; records that the file lacks are computed and appended.

    Args:
        path: The record file. Its name is the label of the progress bar.
        header: All parameters that determine the records; see `resume_jsonl`.
        make_worker: See `map_ordered`. The worker returns an item's record, as a dictionary or a
            dataclass; `provenance` is added to it.
        items: All items, also those that are already in the file.
        schema: Type of a record; see `read_jsonl`.
        workers: See `map_ordered`.
        ray_address: See `map_ordered`.
        max_items_per_process: See `map_ordered`.
        upgrade: Converts the header of an earlier version to the current format.
    """
    software = provenance()

    def compute(done: int) -> Iterator[Row]:
        results = map_ordered(
            make_worker,
            items[done:],
            workers=workers,
            ray_address=ray_address,
            max_items_per_process=max_items_per_process,
        )
        for result in progress(results, path.name.partition(".")[0], len(items), done):
            record = result if isinstance(result, dict) else asdict(result)
            yield record | software

    with closing(resume_jsonl(path, header, compute, schema, upgrade)) as lines:
        return list(islice(lines, 1, 1 + len(items)))
