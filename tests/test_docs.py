"""Pages of the documentation are true: Python blocks run, YAML loads, commands parse, links lead somewhere.

A comment `<!-- not run: reason -->` before a Python block keeps it from being run.
"""

import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from conftest import DEFAULT_CELL, resting, scene_of, training_script

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.cli import app
from drake_clutter.config import load_config, upgrade_config
from drake_clutter.scenes.scene_file import load_scene, save_scene
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import load_config_as, to_plain, validate
from drake_clutter.yaml_io import parse_yaml

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINKING = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(r"(<!-- not run: .+ -->\n)?^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
COMMAND = re.compile(r"`(drake-clutter [^`]+)`")
FILE = re.compile(r"`([\w./-]*\w\.(?:py|yaml|json|sdf|md|html|safetensors))[`: ]")
TRAINING = "python training/"
MADE = ("out/", "runs/")
"""Folders of files that commands on the pages write."""


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        language: "" where the page names none.
        text: Without the fences.
        line: Number of its first line.
        run: Whether it is to be run.
    """

    language: str
    text: str
    line: int
    run: bool


def blocks(page: Path, *languages: str) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = [
        Block(match[2], match[3], text[: match.start(3)].count("\n") + 1, not match[1])
        for match in BLOCK.finditer(text)
    ]
    return [block for block in found if block.language in languages]


def prose(page: Path) -> str:
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def having(*languages: str) -> pytest.MarkDecorator:
    """Parametrize a test with the pages that have such blocks."""
    pages = [page for page in PAGES if blocks(page, *languages)]
    return pytest.mark.parametrize("page", pages, ids=lambda page: page.stem)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the repository's files and a generated scene that pages name."""
    for name in ("models", "sdf_assets", "training"):
        (tmp_path / name).symlink_to(ROOT / name)
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    scene = scene_of(
        resting("cracker_box", name="cracker_box_1"),
        resting("sugar_box", xy=(0.2, 0.2), name="sugar_box_3"),
    )
    for path in ("scene.yaml", "out/sg25/scenes/0000.yaml"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        save_scene(tmp_path / path, scene, DEFAULT_CELL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@having("python")
def test_python_runs(page: Path, folder: Path) -> None:
    """All blocks of a page in one namespace, in their order."""
    assert folder == Path.cwd()
    namespace: dict[str, Any] = {"__name__": page.stem}
    for block in blocks(page, "python"):
        code = compile("\n" * (block.line - 1) + block.text, str(page), "exec")
        if block.run:
            exec(code, namespace)


@having("yaml")
def test_yaml_loads(page: Path, folder: Path) -> None:
    for block in blocks(page, "yaml"):
        given = parse_yaml(block.text, str(page), "YAML")
        fields = set(given)
        path = folder / "given.yaml"
        path.write_text(block.text, encoding="utf-8")
        if "classes" in fields:
            path.replace(folder / "examples/custom_class/catalog.yaml")
            load_catalog(folder / "examples/custom_class")
        elif "objects" in fields and "version" in fields:
            load_scene(path, load_catalog())
        elif "agent" in fields:
            load_config_as(Scenario(), path)
        elif fields <= {"layout", "settle", "exploration", "cell"}:
            load_config(path)
        else:
            validate(WorkCell, {**to_plain(DEFAULT_CELL), **given}, str(page))


def lines(page: Path, start: str) -> Iterator[str]:
    """Yield the command lines that begin so."""
    for block in blocks(page, "sh", "console", ""):
        for line in block.text.replace("\\\n", " ").splitlines():
            if line.removeprefix("$ ").startswith(start):
                yield line.removeprefix("$ ")


@cache
def commands() -> Any:
    return typer.main.get_command(app)


def fault(line: str, *, complete: bool) -> str:
    """Return what is wrong with a command line; "" if nothing is.

    Args:
        line: What a user types.
        complete: Whether it has all that the command needs; else only its options are looked up.
    """
    words = shlex.split(line, comments=True)[1:]
    command = commands()
    try:
        while hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        context = command.make_context(
            line, list(words) if complete else [], resilient_parsing=not complete
        )
        if not complete:
            command.make_parser(context).parse_args(list(words))
    except Exception as error:  # typer has a click of its own, whose errors it does not export
        return f"{line}: {getattr(error, 'message', error)}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_parse(page: Path) -> None:
    for line in lines(page, "drake-clutter "):
        assert fault(line, complete=True) == ""
    for line in COMMAND.findall(prose(page)):
        assert fault(line, complete=False) == ""


SCRIPTS = [page for page in PAGES if any(lines(page, TRAINING))]


@pytest.mark.parametrize("page", SCRIPTS, ids=lambda page: page.stem)
def test_training_scripts_parse(page: Path) -> None:
    """Options exist, and so do the fields that are set."""
    for line in lines(page, TRAINING):
        words = shlex.split(line.removeprefix(TRAINING), comments=True)
        name = words.pop(0).removesuffix(".py")
        script = typer.Typer()
        module = training_script(name)
        script.command()(module.main)
        given = typer.main.get_command(script).make_context(name, words).params
        if "settings" in given:
            config = ROOT / given["config"] if given["config"] else None
            load_config_as(module.CONFIG, config, given["settings"] or [], upgrade_config)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_of_commands_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(
        r"(?<!--out )\b((?:benchmarks|examples|models|training)/[\w./-]+\.\w+)", text
    )
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", LINKING, ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    targets = [target.split("#")[0] for target in LINK.findall(prose(page)) if "://" not in target]
    assert [target for target in targets if target and not (page.parent / target).exists()] == []


@cache
def file_names() -> frozenset[str]:
    folders = ("drake_clutter", "training", "benchmarks", "tests", "models")
    return frozenset(path.name for folder in folders for path in (ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_files_that_are_named_exist(page: Path) -> None:
    """Paths from the repository's or the package's root; modules without a folder anywhere."""
    missing = []
    for name in FILE.findall(prose(page)):
        if "/" not in name:
            missing += [name] if name.endswith(".py") and name not in file_names() else []
        elif not name.startswith(MADE) and not any(
            (ROOT / at / name).exists() for at in ("", "drake_clutter")
        ):
            missing.append(name)
    assert missing == []
