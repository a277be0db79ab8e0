"""The command line. Drake is imported by the commands that need it, so that `doctor` runs where Drake is broken."""

import dataclasses
import json
from collections.abc import Iterable
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE
from rich.table import Table

from drake_clutter.cli_arm import feasibility, replay
from drake_clutter.cli_options import (
    CatalogueOption,
    ConfigOption,
    ExplorerOption,
    Fidelity,
    FidelityOption,
    HtmlOption,
    JsonOption,
    MaxMovesOption,
    NodesOption,
    ObjectsOption,
    OutOption,
    RayOption,
    SceneArgument,
    SeedOption,
    WorkersOption,
    err_console,
    load,
    out_console,
    plain,
    show,
    tracked,
    watch,
)
from drake_clutter.files import InputError, output_directory, told_in_one_line

if TYPE_CHECKING:
    from drake_clutter.tasks.exploration import Step

app = typer.Typer(
    help="Clutter that is generated, judged, looked at and searched, on Drake.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
assets_app = typer.Typer(help="Build the models of object classes.", no_args_is_help=True)
app.add_typer(assets_app, name="assets")
app.command()(replay)
app.command()(feasibility)


class Format(Enum):
    """Formats that a scene can be exported to."""

    DMD = "dmd"
    SDF = "sdf"
    MJCF = "mjcf"
    GLB = "glb"


def main() -> None:
    """The console script: a user's mistake is one line and exit code 2."""
    with told_in_one_line():
        app()


def _report(step: "Step") -> None:
    found = f", found {', '.join(step.newly_found)}" if step.newly_found else ""
    reasons = [str(reason) for reason in (step.outcome.instability, step.outcome.detail) if reason]
    why = f" ({'; '.join(reasons)})" if reasons else ""
    err_console.print(f"{step.move}: {step.outcome.result.value}{why}{found}", highlight=False)


@app.command()
def generate(
    out: OutOption,
    agent: Annotated[str, typer.Option(help="random, hill-climbing, or the file of a checkpoint that you trained.")] = "random",
    temperature: Annotated[
        float | None, typer.Option(help="Of a trained agent: low for the best scenes, high for all kinds.")
    ] = None,
    objects: ObjectsOption = "ycb7",
    nodes: NodesOption = 25,
    count: Annotated[int, typer.Option(help="Scenes to generate.")] = 100,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Generate scenes, settle them in Drake and say which are stable and what they hide. A run that was stopped goes on."""
    from drake_clutter.agents.generation import GenerationJob
    from drake_clutter.commands import generate as command
    from drake_clutter.config import load_config

    job = GenerationJob(agent, objects, catalogue, nodes, seed, load_config(config), temperature)

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return tracked("scenes", made, done, total)

    summary = command.generate(job, count, out, workers, progress, ray)
    shown = {key: value for key, value in summary.items() if key != "config"}
    show(summary if as_json else shown, as_json, f"{out}")


@app.command()
def explore(
    scene: SceneArgument,
    out: OutOption,
    agent: ExplorerOption = "largest-clear",
    fidelity: FidelityOption = Fidelity.SETTLE,
    max_moves: MaxMovesOption = None,
    seed: SeedOption = 0,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Search a scene for what it hides; writes episode.json and a page, index.html."""
    from drake_clutter.commands import explore as command
    from drake_clutter.config import load_config

    world, file = load_config(config), load(scene, catalogue)
    output_directory(out)
    limit = max_moves or world.exploration.max_moves
    task = command.explore(command.at_rest(file.scene, world, seed), agent, fidelity.value, limit, seed, world, _report)
    title = f"{agent} explores {scene.name}"
    fields = command.write_episode(out, task, title, agent, fidelity.value, seed, world)
    _print_episode(fields, as_json, out)


def _print_episode(fields: dict[str, Any], as_json: bool, out: Path) -> None:
    if as_json:
        show(fields, True, "")
        return
    shown = {key: fields[key] for key in ("success", "ended", "objects", "hidden_at_start", "found", "total_reward")}
    show(shown | {"moves": len(fields["moves"]), "page": str(out / "index.html")}, False, f"{out}")


@app.command()
def evaluate(
    place: Annotated[str | None, typer.Argument(metavar="SCENES", help="The same as --scenes.", show_default=False)] = None,
    scenes: Annotated[
        str | None, typer.Option(help="A frozen set (sg_star_25, ...) or its file, or a folder of scene files that were judged.")
    ] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option(
            "--agents",
            "--agent",
            metavar="NAME,...",
            help="As for `explore`, or full-knowledge; may be repeated.",
            show_default="those without learning",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON to write, with the rows and every episode.")] = None,
    max_moves: MaxMovesOption = None,
    fidelity: FidelityOption = Fidelity.SETTLE,
    count: Annotated[int | None, typer.Option(min=1, help="Play the first so many scenes only.")] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Compare explorers on scenes that hide something."""
    from drake_clutter.agents.evaluation import in_words
    from drake_clutter.agents.exploration import BASELINES
    from drake_clutter.commands import evaluate as command
    from drake_clutter.config import load_config

    named = scenes or place
    if named is None or None not in (scenes, place):
        raise InputError(
            "--scenes: give it once; allowed are a frozen set, its file, and a folder of scene files that were judged"
        )
    world = load_config(config)
    played = command.playable(named, catalogue)[:count]
    names = [name for some in agents or BASELINES for name in some.split(",")]
    limit = max_moves or world.exploration.max_moves

    def progress(results: Iterable[Any], total: int) -> Iterable[Any]:
        return tracked("episodes", results, 0, total)

    rows = command.evaluate(played, names, limit, fidelity.value, seed, world, catalogue, workers, out, progress, ray)
    if as_json:
        print(json.dumps(rows, indent=2))
        return
    shown = [{"agent": row["agent"]} | cells for row in rows for cells in in_words(row, command.limits(limit))]
    title = f"{named}: {rows[0]['episodes']} scenes, {rows[0]['hidden']:.1f} objects hidden"
    table = Table(
        *shown[0], title=title, box=SIMPLE, padding=(0, 1, 0, 0), caption="in: so many moves; moves: of those who found all"
    )
    for cells in shown:
        table.add_row(*cells.values())
    out_console.print(table)


@app.command()
def move(
    scene: SceneArgument,
    out: OutOption,
    pick: Annotated[str | None, typer.Option(help="Name of the object to pick.")] = None,
    place: Annotated[str | None, typer.Option(help="Name of the object to put it on, or tray.")] = None,
    moves: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML list of {pick: NAME, place: NAME or tray}.")] = None,
    fidelity: FidelityOption = Fidelity.SETTLE,
    plan_only: Annotated[
        bool, typer.Option("--plan-only", help="With --fidelity arm: write how the arm would move (plan.json), move nothing.")
    ] = False,
    seed: SeedOption = 0,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Carry out one chosen move, or a list of them; writes episode.json and a page, index.html."""
    from drake_clutter.commands import explore as command
    from drake_clutter.config import load_config
    from drake_clutter.scenes.interfaces import Move

    if (moves is None) == (pick is None) or (pick is None) != (place is None):
        raise InputError("move: allowed is either --pick NAME --place NAME, or --moves FILE")
    if plan_only and fidelity is not Fidelity.ARM:
        raise InputError(f"--plan-only with --fidelity {fidelity.value}; allowed is --fidelity arm")
    chosen = command.read_moves(moves) if moves else [Move(str(pick), str(place))]
    world, file = load_config(config), load(scene, catalogue)
    output_directory(out)
    if plan_only:
        plans = command.plan_only(command.at_rest(file.scene, world, seed), chosen, seed, world, out)
        show({"plans": plans} if as_json else command.plans_in_words(plans), as_json, f"{out}")
        return
    task = command.carry_out(command.at_rest(file.scene, world, seed), chosen, seed, world, _report, fidelity.value)
    fields = command.write_episode(out, task, f"Moves in {scene.name}", "chosen moves", fidelity.value, seed, world)
    _print_episode(fields, as_json, out)


@app.command()
def solve(
    scene: SceneArgument,
    out: OutOption,
    budget: Annotated[int, typer.Option(min=1, help="Moves that the search may try before it gives up.")] = 5000,
    seed: SeedOption = 0,
    catalogue: CatalogueOption = None,
    config: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the fewest moves that reveal everything, for someone who knows everything; Drake confirms the plan."""
    from drake_clutter.commands import explore, solve
    from drake_clutter.config import load_config

    world, file = load_config(config), load(scene, catalogue)
    output_directory(out)
    fields = solve.solve(explore.at_rest(file.scene, world, seed), scene.name, out, seed, budget, world, _report)
    show(fields, as_json, f"{out}")


@app.command()
def run(
    scenario: Annotated[Path | None, typer.Option(metavar="FILE", help="YAML with fields of Scenario.")] = None,
    settings: Annotated[list[str] | None, typer.Option("--set", metavar="FIELD=VALUE", help="A field over the file's.")] = None,
    out: OutOption = Path("out/run"),
    as_json: JsonOption = False,
) -> None:
    """Play the closed loop: camera images in, arm motion out, until nothing is hidden; writes episode.json and a page."""
    from drake_clutter.commands import run as command
    from drake_clutter.config import upgrade
    from drake_clutter.systems.scenario import Scenario
    from drake_clutter.validation import load_typed

    given = load_typed(Scenario(), scenario, settings or [], upgrade)
    output_directory(out)
    _print_episode(command.run(given, out, _report), as_json, out)


@app.command()
def demo(
    out: OutOption,
    seed: SeedOption = 0,
    nodes: NodesOption = 25,
    as_json: JsonOption = False,
) -> None:
    """SG* makes a scene, and the arm searches it until everything is found; write a page to watch."""
    from drake_clutter.commands import run as command

    output_directory(out)
    _print_episode(command.demo(seed, nodes, out, _report), as_json, out)


@app.command()
def view(
    scene: SceneArgument,
    html: HtmlOption = None,
    laid_out: Annotated[bool, typer.Option("--laid-out", help="Show the objects as laid out, not as settled.")] = False,
    catalogue: CatalogueOption = None,
) -> None:
    """Show a scene in the browser (Meshcat), or write it to one HTML file."""
    from drake_clutter.cell.work_cell import default_cell
    from drake_clutter.scenes.interfaces import Frame

    file = load(scene, catalogue)
    shown = file.scene if laid_out else file.settled_scene
    watch(scene, shown, [Frame(0.0, shown.poses)], default_cell(), html)


@app.command()
def render(scene: SceneArgument, out: OutOption, catalogue: CatalogueOption = None, config: ConfigOption = None) -> None:
    """Render what the overhead camera sees: color.png, depth.png (16 bit, 0.1 mm), label.png, visible.json, picture.png."""
    from drake_clutter.commands.render import render_scene
    from drake_clutter.config import load_config

    world, file = load_config(config), load(scene, catalogue)
    output_directory(out)
    shares = render_scene(file.settled_scene, world, out)
    show({name: round(share, 3) for name, share in shares.items()}, False, "visible share")


@app.command()
def export(
    scene: SceneArgument,
    out: OutOption,
    format: Annotated[Format, typer.Option(help="For Drake, PyBullet and other SDF readers, MuJoCo, any 3-D viewer.")],
    laid_out: Annotated[bool, typer.Option("--laid-out", help="Export the objects as laid out, not as settled.")] = False,
    catalogue: CatalogueOption = None,
) -> None:
    """Export a scene to a self-contained folder."""
    from drake_clutter.export import ExportFormat, export_scene

    file = load(scene, catalogue)
    output_directory(out)
    out_console.print(f"wrote {export_scene(file.scene if laid_out else file.settled_scene, ExportFormat(format.value), out)}")


@app.command()
def doctor(as_json: JsonOption = False) -> None:
    """Say what of Drake, EGL, solvers, torch and cores is there, and how to mend what is not."""
    from drake_clutter.doctor import checks

    found = checks()
    if as_json:
        print(json.dumps([dataclasses.asdict(check) for check in found], indent=2))
    else:
        table = Table("", "check", "found", "how to mend it")
        for check in found:
            remedy = "" if check.ok else plain(check.remedy)
            table.add_row("[green]ok" if check.ok else "[red]no", check.name, plain(check.detail), remedy)
        out_console.print(table)
    if not all(check.ok for check in found):
        raise typer.Exit(1)


@assets_app.command("build")
def build(
    folder: Annotated[Path, typer.Argument(help="An asset folder: it holds catalogue.yaml.")],
    only: Annotated[list[str] | None, typer.Option("--class", help="Build this class alone; may be repeated.")] = None,
) -> None:
    """Build SDF models, collision pieces and textures of a catalogue's classes."""
    from drake_clutter.assets import build_assets

    for built in build_assets(folder, only):
        out_console.print(f"built {built}")
