"""Atomic writing of files."""

import json
import os
from pathlib import Path

import pytest

from drake_clutter.cli.output import progress_bar
from drake_clutter.files import (
    INTERRUPTION,
    InputError,
    atomic_write,
    cli_error_handler,
    read_text,
    write_json,
    write_text,
)
from drake_clutter.yaml_io import parse_yaml


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


def test_only_files_of_bounded_size_are_read(tmp_path: Path) -> None:
    """A pipe would be waited for, and zeros of a sparse file would fill the memory."""
    pipe, huge, large = tmp_path / "pipe", tmp_path / "huge", tmp_path / "large"
    os.mkfifo(pipe)
    for path, size in ((huge, 10 * 2**30), (large, 2**28 + 1)):
        with path.open("wb") as file:
            file.truncate(size)
    problems = {
        pipe: "is not a regular file",
        huge: "has 10.0 GiB, more than 4 GiB",
        large: "is larger than 256 MiB",
        tmp_path: "Is a directory",
        tmp_path / "none": "No such file or directory",
    }
    for path, problem in problems.items():
        with pytest.raises(InputError) as refused:
            read_text(path, "a text")
        assert str(refused.value) == f"{path}: cannot be read ({problem}); expected a text"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * 10**5 + "]" * 10**5, "more than 100 mappings and lists are nested"),
        ("- " * 10**5 + "1", "more than 100 mappings and lists are nested"),
        ("{a: " * 10**5 + "1" + "}" * 10**5, "more than 100 mappings and lists are nested"),
        (
            "a0: &a0 [x]\n"
            + "".join(f"a{k + 1}: &a{k + 1} [{f'*a{k}, ' * 10}]\n" for k in range(9)),
            "more than 1e+07 values",
        ),
    ],
)
def test_deep_and_exponential_yaml_is_refused(text: str, problem: str) -> None:
    with pytest.raises(InputError) as refused:
        parse_yaml(text, "scene.yaml")
    assert str(refused.value) == f"scene.yaml: is not YAML ({problem}); expected YAML"


def test_nested_yaml_with_anchors_is_read() -> None:
    nested = "[" * 99 + "]" * 99
    assert str(parse_yaml(f"{{a: &x [1, 2], b: *x, c: {nested[1:-1]}}}", "f")["b"]) == "[1, 2]"


def test_an_interruption_is_the_last_line_after_that_of_a_progress_bar(
    capsys: pytest.CaptureFixture[str],
) -> None:
    def work() -> None:
        items = progress_bar("items", [1, 2], 0, 2)
        next(items)
        raise KeyboardInterrupt

    with pytest.raises(SystemExit), cli_error_handler():
        work()
    *_, bar, last = capsys.readouterr().err.splitlines()
    assert bar.startswith("items")
    assert last == INTERRUPTION
