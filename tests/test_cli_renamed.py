"""Earlier spellings of options and values are accepted with a warning."""

from typing import Any

import pytest
import typer.main
from typer.testing import CliRunner

from drake_clutter.cli import app, renamed
from drake_clutter.cli.renamed import RENAMED_OPTIONS, with_current_spellings

COMMANDS: dict[str, Any] = typer.main.get_command(app).commands  # type: ignore[attr-defined]


def options_of(command: str) -> set[str]:
    return {name for parameter in COMMANDS[command].params for name in parameter.opts}


def current(command: str, *args: str) -> list[str]:
    return list(with_current_spellings(options_of(command), args))


@pytest.mark.parametrize(
    ("command", "old", "new"),
    [
        ("generate", ["--catalogue", "folder"], ["--catalog", "folder"]),
        ("generate", ["--catalogue=folder"], ["--catalog=folder"]),
        ("view", ["scene.yaml", "--laid-out"], ["scene.yaml", "--initial-poses"]),
        ("evaluate", ["sg_star_10", "--count", "2"], ["sg_star_10", "--max-scenes", "2"]),
        ("feasibility", ["--arm", "cup.yaml"], ["--cell-override", "cup.yaml"]),
    ],
)
def test_an_earlier_option_is_replaced_with_a_warning(
    command: str, old: list[str], new: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert current(command, *old) == new
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "the old spelling is accepted until version 0.3" in captured.err


@pytest.mark.parametrize(
    ("command", "args"),
    [
        ("generate", ["--count", "2", "--set", "robot.base.z=0.4,5"]),
        ("explore", ["--count", "2"]),
        ("feasibility", ["scenes", "--base=-0.7,0,0.3,0"]),
    ],
)
def test_other_arguments_are_kept(
    command: str, args: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """`generate` has an option `--count` of its own; `explore` has neither spelling."""
    assert current(command, *args) == args
    assert capsys.readouterr().err == ""


def test_an_earlier_value_is_replaced_also_in_a_list(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(renamed, "RENAMED_VALUES", {"--agents": {"old": "new"}})
    assert current("evaluate", "--agents", "random,old", "old") == ["--agents", "random,new", "old"]
    assert current("evaluate", "--agents=old") == ["--agents=new"]
    assert capsys.readouterr().err.count("--agents old is now --agents new") == 2


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_the_help_shows_only_current_spellings(command: str) -> None:
    shown = CliRunner().invoke(app, [command, "--help"], terminal_width=200).output
    removed = RENAMED_OPTIONS.keys() - options_of(command)
    assert not [old for old in removed if f"{old} " in shown]


def test_a_command_runs_with_an_earlier_spelling() -> None:
    arguments = ["generate", "--catalogue", "no_such_folder", "--out", "unused"]
    result = CliRunner().invoke(app, arguments)
    assert "--catalogue is now --catalog" in result.stderr
    assert "no_such_folder" in str(result.exception)
