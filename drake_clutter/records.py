"""Files of JSON lines that a long run adds to: what is there is not made again."""

import fcntl
import json
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

from drake_clutter.files import InputError
from drake_clutter.resources import git_commit


def resume_jsonl(
    path: Path,
    header: Mapping[str, Any],
    make_records: Callable[[int], Iterable[Any]],
    upgrade_header: Callable[[Any], Any] = lambda head: head,
) -> Generator[Any, None, None]:
    """The head of a file, its records, and then those that it lacks, each added to it as soon as it is made.

    The head, the first line, says what was asked and at which `commit` the file was begun. A line that was cut off
    when a run was killed is made again.

    Args:
        path: the file; made, with its folders, if it is not there.
        header: all that decides what the records are.
        make_records: told how many records are there, makes those that follow.
        upgrade_header: Turns the head that an older version wrote into today's form.

    Raises:
        InputError: the file holds records of something else, or another run is adding to it.
    """
    header = json.loads(json.dumps(header))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"{path}: another run is adding to it; wait for it, or give another folder"
            ) from error
        file.seek(0)
        lines = file.readlines()
        if lines and not lines[-1].endswith("\n"):
            lines.pop()
            file.truncate(len("".join(lines).encode()))
        if not lines:
            lines = [json.dumps({**header, "commit": git_commit()}) + "\n"]
            file.write(lines[0])
            file.flush()
        written_header, *records = map(json.loads, lines)
        upgraded = upgrade_header(written_header)
        differing = ", ".join(key for key, value in header.items() if upgraded.get(key) != value)
        if differing:
            raise InputError(
                f"{path}: holds records of something else ({differing}); give the same options or another folder"
            )
        yield written_header
        yield from records
        for record in make_records(len(records)):
            file.write(json.dumps(record) + "\n")
            file.flush()
            yield record
