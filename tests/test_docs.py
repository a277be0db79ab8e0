"""Pages of the documentation are true: every code block and every command on them is executed.

Each page runs in a folder of its own, its blocks in order: Python blocks in one namespace, YAML
blocks are loaded as what they are, commands run with fewer scenes, moves and training steps. A
comment before a block changes that:

- `<!-- file: NAME -->` saves a YAML block for the blocks after it;
- `<!-- not run: reason -->` keeps a block from being executed.

Scripts that a page includes, by a snippet in a block ```{ .python }, are executed by
`test_examples.py`.
"""

import gc
import re
import runpy
import shlex
import shutil
import sys
import textwrap
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from conftest import DEFAULT_CELL, training_script
from typer.testing import CliRunner

from drake_clutter.catalog import load_catalog
from drake_clutter.cell.work_cell import WorkCell
from drake_clutter.cli import app
from drake_clutter.commands import feasibility_parts
from drake_clutter.commands.explore_scene import read_moves
from drake_clutter.config import load_config
from drake_clutter.recording.randomization import RandomizationConfig, load_randomization
from drake_clutter.reports import feasibility_cases
from drake_clutter.scenes.scene_file import load_scene
from drake_clutter.systems.scenario import Scenario
from drake_clutter.validation import load_config_as, to_plain, validate
from drake_clutter.yaml_io import parse_yaml

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]
LINKING = [*PAGES, ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md"]
BLOCK = re.compile(
    r"(?:^ *<!-- (not run|file): ([^\n]+) -->\n)?^( *)```(\w*|{[^\n]+})\n(.*?)^\3```$",
    re.MULTILINE | re.DOTALL,
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
INLINE_COMMAND = re.compile(r"`(drake-clutter [^`]+)`")
FILE = re.compile(r"`([\w./-]*\w\.(?:py|yaml|json|sdf|md|html|safetensors))[`: ]")
WRITTEN = ("out/", "runs/")
"""Folders of files that commands on the pages write."""
SNIPPET = "--8<--"

LANGUAGES = {"console", "python", "sh", "yaml"}
"""Languages whose blocks are executed."""
OTHER_LANGUAGES = {"bibtex", "json", "text", "xml"}

SMALLER = {"--count": "1", "--episodes": "1", "--max-scenes": "1", "--workers": "1"}
"""Values that options of commands are given instead."""
ADDED = {
    "05_train_generator": ["--steps", "64", "--scenes", "1"],
    "evaluate": ["--max-moves", "1", "--max-scenes", "1"],
    "explore": ["--max-moves", "1"],
    "record": ["--max-moves", "1", "--resolution", "64x48"],
    "run": ["--set", "max_moves=1"],
    # The other renderer and the mask images are slow; test_images.py has both.
    "render_image_dataset": ["--renderer=raster", "--compact"],
    "train_detector": [
        "--set=learning.steps=1",
        "--set=learning.batch=2",
        "--set=held_out=1",
        "--set=evaluate_every=1",
    ],
    "train_explorer_dagger": [
        "--set=learning.iterations=1",
        "--set=learning.episodes_per_iteration=2",
        "--set=learning.updates_per_iteration=1",
        "--set=evaluation_episodes=1",
    ],
    "train_explorer_ppo": [
        "--set=learning.total_timesteps=8",
        "--set=learning.episodes_per_iteration=2",
        "--set=evaluation_episodes=1",
    ],
    "train_generator": [
        "--set=learning.total_timesteps=64",
        "--set=learning.learning_starts=32",
        "--set=learning.batch_size=32",
        "--set=evaluation_scenes=1",
    ],
}
"""Options that are added to a command of `drake-clutter` or a script, by its name."""

PARSED = {
    "base_study",
    "carry_clearance",
    "collect_drake_verdicts",
    "evaluate_closed_loop",
    "evaluate_detector",
    "evaluate_explorers",
    "evaluate_generators",
    "evaluate_target_search",
    "exported_stability",
    "inverse_reachability",
    "judge_agreement",
    "mujoco_motion",
    "mutation_testing",
    "random_generator_calibration",
    "train_bc",
}
"""Scripts without a case of a few seconds: only their options are looked up."""


@dataclass(frozen=True)
class Block:
    """A block of code.

    Attributes:
        language: Name after the fence; "" for none.
        text: Without the fences.
        line: Number of its first line.
        run: Whether it is to be executed.
        file: Name under which it is saved, or "".
    """

    language: str
    text: str
    line: int
    run: bool
    file: str


def blocks(page: Path) -> list[Block]:
    """Return the blocks of a page in order."""
    text = page.read_text(encoding="utf-8")
    return [
        Block(
            match[4],
            textwrap.dedent(match[5]),
            text[: match.start(5)].count("\n") + 1,
            match[1] != "not run",
            match[2] if match[1] == "file" else "",
        )
        for match in BLOCK.finditer(text)
    ]


def prose(page: Path) -> str:
    """Return a page without its blocks."""
    return BLOCK.sub("", page.read_text(encoding="utf-8"))


def page_id(page: Path) -> str:
    """Return the name of a page in the tests' names."""
    return str(page.relative_to(ROOT).with_suffix(""))


each_page = pytest.mark.parametrize("page", PAGES, ids=page_id)
executed_pages = pytest.mark.parametrize(
    "page", [p for p in PAGES if any(b.language in LANGUAGES for b in blocks(p))], ids=page_id
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with the files of the repository, and small feasibility studies."""
    for name in ("benchmarks", "docs", "drake_clutter", "models", "sdf_assets", "training"):
        (tmp_path / name).symlink_to(ROOT / name)
    for name in ("Makefile", "README.md", "pyproject.toml"):
        (tmp_path / name).symlink_to(ROOT / name)
    ignore = shutil.ignore_patterns("mug", "package.xml", "own_objects")
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=ignore)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(feasibility_parts, "MAP_SPACING", 0.3)
    monkeypatch.setattr(feasibility_parts, "MAP_HEIGHTS", (0.05, 0.3))
    monkeypatch.setattr(feasibility_cases, "MAX_CASES_PER_SETUP", 1)
    return tmp_path


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, ...], Path]:
    """Folders of `drake-clutter generate` by its options: the same scenes serve several pages."""
    return {}


def is_executed(block: Block) -> bool:
    """Return whether a block is executed here."""
    return block.run and block.language in LANGUAGES


@executed_pages
def test_page_runs(
    page: Path,
    folder: Path,
    generated: dict[tuple[str, ...], Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    namespace: dict[str, Any] = {"__name__": page.stem}
    for block in filter(is_executed, blocks(page)):
        if block.language == "python":
            code = "\n" * (block.line - 1) + block.text
            exec(compile(code, str(page), "exec"), namespace)
        elif block.language == "yaml":
            load_yaml(block, folder, str(page))
        else:
            for line in command_lines(block):
                run_command(line, generated, monkeypatch)


def load_yaml(block: Block, folder: Path, page: str) -> None:
    """Load a block as the kind of file that its fields tell."""
    path = folder / (block.file or "block.yaml")
    path.write_text(block.text, encoding="utf-8")
    document = parse_yaml(block.text, page, "YAML")
    fields = {*document} if isinstance(document, dict) else set()
    if isinstance(document, list):
        read_moves(path)
    elif "classes" in fields:
        path.replace(folder / "examples/custom_class/catalog.yaml")
        load_catalog(folder / "examples/custom_class")
    elif "objects" in fields and "version" in fields:
        load_scene(path, load_catalog())
    elif "agent" in fields:
        load_config_as(Scenario(), path)
    elif fields <= {*RandomizationConfig.model_fields}:
        load_randomization(str(path))
    elif fields <= {"layout", "settle", "exploration", "cell"}:
        load_config(path)
    else:
        cell = to_plain(DEFAULT_CELL)
        overlay = {
            name: cell[name] | part if isinstance(part, dict) and name != "cameras" else part
            for name, part in document.items()
        }
        validate(WorkCell, {**cell, **overlay}, page)


def command_lines(block: Block) -> Iterator[str]:
    """Yield the commands of a block; of a console those after a prompt."""
    for line in block.text.replace("\\\n", " ").splitlines():
        if block.language == "sh" and line.split("#")[0].strip():
            yield line
        elif line.startswith("$ "):
            yield line.removeprefix("$ ")


def run_command(
    line: str, generated: dict[tuple[str, ...], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Execute a command of ours on a small case; look up the names in other commands."""
    gc.collect()  # a renderer that is left for a thread of the next command can abort the process
    match shlex.split(line, comments=True):
        case ["drake-clutter", command, *options]:
            run_drake_clutter(command, smaller(command, options), generated)
        case ["python", script, *options] if (
            script.startswith("examples/") and Path(script).stem not in ADDED
        ):
            text = Path(script).read_text(encoding="utf-8")
            assert [o for o in options if o.startswith("--") and f'"{o}"' not in text] == []
        case ["python", script, *options]:
            name = Path(script).stem
            arguments = [*options, "--help"] if name in PARSED else smaller(name, options)
            monkeypatch.setattr(sys, "argv", [script, *arguments])
            try:
                runpy.run_path(script, run_name="__main__")
            except SystemExit as ended:
                if ended.code:
                    pytest.fail(f"{line}: exit code {ended.code}")
        case ["make", target]:
            assert f"\n{target}:" in Path("Makefile").read_text(encoding="utf-8")
        case ["pip", "install", requirement]:
            extras = re.fullmatch(r"\.(?:\[([\w,]+)\])?", requirement)
            assert extras is not None, line
            known = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]
            assert {*(extras[1] or "").split(",")} - {""} <= {*known["optional-dependencies"]}
        case ["source", ".venv/bin/activate"] | ["ray", "start", "--head"]:
            pass
        case ["mkdir", "-p", name]:
            Path(name).mkdir(exist_ok=True)
        case ["tensorboard", "--logdir", runs]:
            assert list(Path(runs).glob("*/tensorboard"))
        case _:
            pytest.fail(f"{line}: is not a command that is known here")


def smaller(command: str, options: list[str]) -> list[str]:
    """Return the options of a small case, on this machine instead of a cluster."""
    options = list(options)
    for k in range(len(options) - 1):
        options[k + 1] = SMALLER.get(options[k], options[k + 1])
    if "--ray" in options:
        k = options.index("--ray")
        del options[k : k + 2]
    return options + ADDED.get(command, [])


def run_drake_clutter(
    command: str, options: list[str], generated: dict[tuple[str, ...], Path]
) -> None:
    """Execute a command; scenes that were generated before are copied."""
    out = Path(options[options.index("--out") + 1]) if "--out" in options else Path()
    key = (command, *(o for o in options if o != str(out)))
    if command == "generate" and key in generated:
        shutil.copytree(generated[key], out)
        return
    result = CliRunner().invoke(app, [command, *options])
    assert result.exit_code == 0, f"{command} {options}: {result.output} {result.exception}"
    if command == "generate" and "--catalog" not in options and "--config" not in options:
        generated[key] = out.resolve()


def test_blocks_end_at_their_fences() -> None:
    """A comment and a title belong to one block, however many blocks follow."""
    text = (
        "<!-- file: a.yaml -->\n```yaml\na: 1\n```\n\n```sh\nb\n```\n\n"
        '<!-- not run: reason -->\n```sh\nc\n```\n\n```{ .python title="d" }\nd\n```\n\n'
        '```{ .python title="e" }\ne\n```\n'
    )
    found = [(match[1], match[2], match[5]) for match in BLOCK.finditer(text)]
    assert found == [
        ("file", "a.yaml", "a: 1\n"),
        (None, None, "b\n"),
        ("not run", "reason", "c\n"),
        (None, None, "d\n"),
        (None, None, "e\n"),
    ]


@each_page
def test_languages_are_known(page: Path) -> None:
    """A block in another language would go unnoticed."""
    other = {b.language for b in blocks(page) if not b.text.startswith(SNIPPET)}
    assert other <= LANGUAGES | OTHER_LANGUAGES


@cache
def cli() -> Any:
    """Return the command line as a click command."""
    return typer.main.get_command(app)


def check_options(command: Any, line: str, words: list[str]) -> None:
    """Fail unless a click command, or the command below it that words begin with, takes them."""
    words = [word for word in words if word != "..."]
    while hasattr(command, "commands") and words:
        command = command.commands[words.pop(0)]
    context = command.make_context(line, [], resilient_parsing=True)
    command.make_parser(context).parse_args(words)


@each_page
def test_inline_commands_have_known_options(page: Path) -> None:
    for line in INLINE_COMMAND.findall(prose(page)):
        check_options(cli(), line, shlex.split(line)[1:])


@each_page
def test_commands_that_are_not_run_have_known_options(page: Path) -> None:
    for block in blocks(page):
        for line in [] if block.run else command_lines(block):
            match shlex.split(line, comments=True):
                case ["drake-clutter", *words]:
                    check_options(cli(), line, words)
                case ["python", script, *words] if script.startswith("training/"):
                    app = typer.Typer()
                    app.command()(training_script(Path(script).stem).main)
                    check_options(typer.main.get_command(app), line, words)


@each_page
def test_links_lead_somewhere(page: Path) -> None:
    targets = [target.split("#")[0] for target in LINK.findall(prose(page)) if "://" not in target]
    assert [target for target in targets if target and not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", LINKING[len(PAGES) :], ids=page_id)
def test_links_of_other_pages_lead_somewhere(page: Path) -> None:
    test_links_lead_somewhere(page)


@cache
def module_names() -> frozenset[str]:
    """Return the names of all modules of the repository."""
    folders = ("drake_clutter", "training", "benchmarks", "tests", "models", "docs", "examples")
    return frozenset(path.name for folder in folders for path in (ROOT / folder).rglob("*.py"))


@each_page
def test_named_files_exist(page: Path) -> None:
    """Paths from the root of the repository or the package exist; so do modules anywhere."""
    missing = []
    for name in FILE.findall(prose(page)):
        if "/" not in name:
            missing += [name] if name.endswith(".py") and name not in module_names() else []
        elif not name.startswith(WRITTEN) and not any(
            (ROOT / base / name).exists() for base in ("", "drake_clutter")
        ):
            missing.append(name)
    assert missing == []


@each_page
def test_snippets_exist(page: Path) -> None:
    names = re.findall(rf'^{SNIPPET} "(.+)"$', page.read_text(encoding="utf-8"), re.MULTILINE)
    assert [name for name in names if not (ROOT / name).exists()] == []


def test_site_builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Strictly: no dangling link, no page that is missing in the navigation."""
    mkdocs = pytest.importorskip("mkdocs.commands.build")
    from mkdocs.config import load_config as load_site_config

    monkeypatch.chdir(ROOT)
    mkdocs.build(load_site_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path)))
    pages = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.html")}
    assert {"index.html", "tutorials/generate_scenes.html", "reference/cli.html"} <= pages
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert re.findall(r'(?:src|href)="(https?://[^"]+\.(?:js|css|woff2?))"', text) == []
