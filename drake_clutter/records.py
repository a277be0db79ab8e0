"""Files of JSON lines that a long run adds to: what is there is not made again."""

import json
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any

from drake_clutter.files import InputError, write_text
from drake_clutter.resources import git_commit


def recorded(path: Path, asked: Mapping[str, Any], make: Callable[[int], Iterable[Any]]) -> Generator[Any, None, None]:
    """The head of a file, its records, and then those that it lacks, each added to it as soon as it is made.

    The head, the first line, says what was asked and at which `commit` the file was begun. A line that was cut off
    when a run was killed is made again.

    Args:
        path: the file; made, with its folders, if it is not there.
        asked: all that decides what the records are.
        make: told how many records are there, makes those that follow.

    Raises:
        InputError: the file holds records of something else.
    """
    asked = json.loads(json.dumps(asked))
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps({**asked, "commit": git_commit()}) + "\n")
    head, *lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    there = json.loads(head)
    differing = ", ".join(key for key, value in asked.items() if there.get(key) != value)
    if differing:
        raise InputError(f"{path}: holds records of something else ({differing}); give the same options or another folder")
    if lines and not lines[-1].endswith("\n"):
        write_text(path, head + "".join(lines[:-1]))
        lines.pop()
    yield there
    yield from map(json.loads, lines)
    with path.open("a", encoding="utf-8") as file:
        for record in make(len(lines)):
            file.write(json.dumps(record) + "\n")
            file.flush()
            yield record
