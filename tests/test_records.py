"""Record files: computed once, resumed, and compressed when the computation ends."""

import gzip
import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from drake_clutter.files import InputError
from drake_clutter.records import read_jsonl, resume_jsonl, write_jsonl
from drake_clutter.validation import CountOrZero

NAMES = pytest.mark.parametrize("name", ["records.jsonl", "records.jsonl.gz"])


class Maker:
    """Makes the records 0, 1 and 2, and keeps a list of those it made."""

    def __init__(self) -> None:
        self.made: list[int] = []

    def __call__(self, done: int) -> Iterator[int]:
        for k in range(done, 3):
            self.made.append(k)
            yield k


@NAMES
def test_records_are_made_once(name: str, tmp_path: Path) -> None:
    path, maker = tmp_path / "folder" / name, Maker()
    first = resume_jsonl(path, {"seed": 1}, maker)
    assert next(first)["seed"] == 1
    assert [next(first), next(first)] == [0, 1]
    with pytest.raises(InputError, match=f"{name}: is in use by process"):
        next(resume_jsonl(path, {"seed": 1}, maker))
    assert read_jsonl(path)[1:] == [0, 1]
    first.close()
    assert [file.name for file in path.parent.iterdir()] == [name]
    assert read_jsonl(path)[1:] == [0, 1]
    assert list(resume_jsonl(path, {"seed": 1}, maker))[1:] == [0, 1, 2]
    content = path.read_bytes()
    assert list(resume_jsonl(path, {"seed": 1}, maker))[1:] == [0, 1, 2]
    assert path.read_bytes() == content
    assert maker.made == [0, 1, 2]
    with pytest.raises(
        InputError, match=rf"{name}: holds records with a different header \(seed\)"
    ):
        next(resume_jsonl(path, {"seed": 2}, maker))
    assert path.read_bytes() == content


@NAMES
def test_a_line_that_was_cut_off_is_made_again(name: str, tmp_path: Path) -> None:
    path, journal, maker = tmp_path / name, tmp_path / "records.jsonl", Maker()
    journal.write_text('{"seed": 1, "commit": "x"}\n0\n1')
    assert read_jsonl(path)[1:] == [0]
    assert list(resume_jsonl(path, {"seed": 1}, maker))[1:] == [0, 1, 2]
    assert maker.made == [1, 2]
    assert [file.name for file in tmp_path.iterdir()] == [name]


def test_the_longer_of_journal_and_compressed_file_counts(tmp_path: Path) -> None:
    """A run may be killed while it copies the compressed lines into its journal."""
    path, maker = tmp_path / "records.jsonl.gz", Maker()
    lines = [json.dumps(value) + "\n" for value in ({"seed": 1}, 0, 1)]
    path.write_bytes(gzip.compress("".join(lines).encode()))
    path.with_suffix("").write_text(lines[0])
    assert read_jsonl(path) == [{"seed": 1}, 0, 1]
    assert list(resume_jsonl(path, {"seed": 1}, maker)) == [{"seed": 1}, 0, 1, 2]
    assert maker.made == [2]


def test_records_survive_an_error(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl.gz"

    def fail(done: int) -> Iterator[int]:
        yield 0
        raise RuntimeError

    with pytest.raises(RuntimeError):
        list(resume_jsonl(path, {}, fail))
    assert read_jsonl(path)[1:] == [0]


def test_no_file_holds_no_records(tmp_path: Path) -> None:
    assert read_jsonl(tmp_path / "records.jsonl.gz") == []


def test_written_records_are_read(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "records.jsonl.gz"
    write_jsonl(path, {"seed": 1}, [0, 1])
    content = path.read_bytes()
    assert read_jsonl(path) == [{"seed": 1}, 0, 1]
    write_jsonl(path, {"seed": 1}, [0, 1])
    assert path.read_bytes() == content


class Record(BaseModel):
    found: CountOrZero
    found_after: list[CountOrZero]


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ({"found": 2}, "found_after: is missing; needed are found, found_after"),
        (
            {"found": "2", "found_after": []},
            "found: '2'; expected a whole number from 0 to 1e\\+09",
        ),
        ({"found": 2, "found_after": [0, -1]}, r"found_after\[1\]: -1; expected a whole number"),
        ([2], r"\[2\]; expected a mapping with found, found_after"),
    ],
)
def test_a_record_with_a_wrong_field_is_refused(record: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl.gz"
    write_jsonl(path, {"seed": 1}, [{"found": 0, "found_after": [], "commit": "x"}, record])
    with pytest.raises(InputError, match=f"records.jsonl.gz: line 3: {message}"):
        read_jsonl(path, Record)
    with (
        closing(resume_jsonl(path, {"seed": 1}, lambda _: [], Record)) as lines,
        pytest.raises(InputError, match=f"records.jsonl.gz: line 3: {message}"),
    ):
        next(lines)
    assert len(read_jsonl(path)) == 3, "the file is unchanged"
