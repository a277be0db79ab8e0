"""Atomic writing of files."""

import json
from pathlib import Path

import pytest

from drake_clutter.files import (
    atomic_write,
    write_json,
    write_text,
)


def test_write_text_and_json(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "eins\nzwölf\n")
    assert (tmp_path / "a.txt").read_bytes() == "eins\nzwölf\n".encode()
    write_json(tmp_path / "a.json", {"b": [1, 0.1], "a": None})
    assert json.loads((tmp_path / "a.json").read_text()) == {"b": [1, 0.1], "a": None}
    assert (tmp_path / "a.json").read_text().endswith("}\n")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.json", "a.txt"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), {1j}, [object()]])
def test_a_value_that_json_cannot_represent_leaves_the_file_unchanged(
    value: object, tmp_path: Path
) -> None:
    path = tmp_path / "a.json"
    write_json(path, 1)
    with pytest.raises((ValueError, TypeError)):
        write_json(path, {"value": value})
    assert json.loads(path.read_text()) == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_write(tmp_path / "a.png") as temporary:
            assert temporary.parent == tmp_path
            assert temporary.suffix == ".png"
            temporary.write_text("incomplete")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_the_old_file_is_kept_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with atomic_write(path) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_two_writers_use_different_temporary_files(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    with atomic_write(path) as first, atomic_write(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the outer block ends last
