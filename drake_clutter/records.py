"""Record files: JSON lines that a long computation appends to and resumes.

The first line is a header, which holds everything that determines the records; each later line is
one record. A file whose name ends in `.gz` is compressed. While records are appended to it, they
are in an uncompressed file beside it, the journal, so that an interrupted run loses at most the
line that it was writing. The journal is compressed and removed when the computation ends.
"""

import gzip
import json
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any

from drake_clutter.files import (
    MAX_TEXT_SIZE,
    InputError,
    atomic_write,
    input_error,
    parse_json,
    reading_file,
)
from drake_clutter.outputs import output_file
from drake_clutter.resources import git_commit
from drake_clutter.validation import validate

_CONTENT = "a record file, unmodified"
"""What a file may contain, for messages."""


def read_jsonl(path: Path, schema: Any = Any) -> list[Any]:
    """Return the header and the records of a record file; an empty list if there is none.

    Args:
        path: The file. For a compressed file, the journal of an interrupted run is read if it
            holds more records.
        schema: Type of a record, such as a pydantic model.

    Raises:
        InputError: The file cannot be read, a line is not JSON, or a field of a record has a value
            that is not allowed.
    """
    journal = _journal_path(path)
    lines: list[str] = []
    if journal.exists():
        with reading_file(journal, _CONTENT):
            lines = _complete_lines(journal.read_text(encoding="utf-8"))
    compressed = _compressed_lines(path)
    return _parse_lines(lines if len(lines) > len(compressed) else compressed, path, schema)


def write_jsonl(path: Path, header: Any, records: Iterable[Any]) -> None:
    """Write a compressed record file, or replace an earlier one, atomically.

    Args:
        path: The file; its folder is created if it does not exist.
        header: The header.
        records: The records.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _write_compressed(path, [f"{json.dumps(line)}\n" for line in (header, *records)])


@contextmanager
def partial_records(out: Path) -> Iterator[Path]:
    """Keep the records of a computation whose output file is written in one piece at the end.

    Args:
        out: The output file.

    Yields:
        Path of a record file, from which the same computation resumes after an interruption. It is
        removed when the block ends without an error.
    """
    path = out.with_name(f"{out.name}.partial.jsonl")
    try:
        yield path
    except BaseException:
        if len(read_jsonl(path)) < 2:  # nothing but the header
            path.unlink(missing_ok=True)
        raise
    path.unlink(missing_ok=True)


def resume_jsonl(
    path: Path,
    header: Mapping[str, Any],
    make_records: Callable[[int], Iterable[Any]],
    schema: Any = Any,
    upgrade_header: Callable[[Any], Any] = lambda header: header,
) -> Generator[Any, None, None]:
    """Yield the header of a record file, its records, and the records that it lacks.

    Each new record is appended to the file as soon as it is computed. It is yielded after a JSON
    round trip, so new and resumed records are equal.

    Args:
        path: The file; created, with its folders, if it does not exist.
        header: All parameters that determine the records. The file's header also holds the `commit`
            at which the file was created.
        make_records: Receives the number of records in the file; yields those that follow.
        schema: Type of a record, as in `read_jsonl`.
        upgrade_header: Converts a header written by an earlier version to the current format.

    Raises:
        InputError: The file cannot be read, has another header or a record that is not allowed, or
            another process is appending to it.
    """
    header = json.loads(json.dumps(header))
    with _open_journal(path) as journal:
        with reading_file(str(path), _CONTENT):
            text = journal.readall().decode()
        lines, compressed = _complete_lines(text), _compressed_lines(path)
        if len(lines) < len(compressed) or not lines:
            lines = compressed or [json.dumps({**header, "commit": git_commit()}) + "\n"]
        written_header, *records = _parse_lines(lines, path, schema)
        with reading_file(str(path), _CONTENT):
            upgraded = upgrade_header(written_header)
        if text != "".join(lines):
            journal.truncate(0)
            _append(journal, "".join(lines))
        differing = ", ".join(key for key, value in header.items() if upgraded.get(key) != value)
        if differing:
            raise InputError(
                f"{path}: holds records with a different header ({differing}); use the same"
                " options or another folder"
            )
        yield written_header
        yield from records
        for record in make_records(len(records)):
            line = json.dumps(record)
            _append(journal, f"{line}\n")
            yield json.loads(line)


def _journal_path(path: Path) -> Path:
    """Return the file that records are appended to."""
    return path.with_suffix("") if path.suffix == ".gz" else path


def _complete_lines(text: str) -> list[str]:
    """Return the lines of a text without a last line that was cut off."""
    return [line for line in text.splitlines(keepends=True) if line.endswith("\n")]


def _compressed_lines(path: Path) -> list[str]:
    """Return the lines of a compressed file; an empty list for any other file."""
    if path.suffix != ".gz" or not path.exists():
        return []
    with reading_file(path, _CONTENT):
        with gzip.open(path) as file:
            content = file.read(MAX_TEXT_SIZE + 1)
        if len(content) > MAX_TEXT_SIZE:
            raise ValueError(f"holds more than {MAX_TEXT_SIZE / 2**20:g} MiB")
        return content.decode().splitlines(keepends=True)


def _parse_lines(lines: Iterable[str], path: Path, schema: Any) -> list[Any]:
    """Return the documents of the lines of a file: the header, a JSON object, and the records."""
    documents = []
    for number, line in enumerate(lines, start=1):
        source = f"{path}: line {number}"
        document = parse_json(line, source, _CONTENT, allow_nan=True)
        if number > 1:
            validate(schema, document, source)
        elif not isinstance(document, dict):
            raise input_error(source, f"{line}; expected the header, a JSON object")
        documents.append(document)
    return documents


def _write_compressed(path: Path, lines: Iterable[str]) -> None:
    """Write a compressed file without a time stamp, so that equal lines give equal bytes."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(gzip.compress("".join(lines).encode(), mtime=0))


@contextmanager
def _open_journal(path: Path) -> Iterator[FileIO]:
    """Open the journal of a record file; at the end, compress and remove it."""
    journal_path = _journal_path(path)
    # Without a buffer, no text remains to be written if the disk is full.
    with output_file(path), journal_path.open("ab+", buffering=0) as journal:
        journal.seek(0)
        try:
            yield journal
        finally:
            if journal_path != path:
                journal.seek(0)
                lines = _complete_lines(journal.readall().decode())
                if len(lines) > len(_compressed_lines(path)):
                    _write_compressed(path, lines)
                journal_path.unlink()


def _append(journal: FileIO, text: str) -> None:
    """Append a text to a journal."""
    data = memoryview(text.encode())
    while data:
        data = data[journal.write(data) :]
