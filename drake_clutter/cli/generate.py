"""`drake-clutter generate`."""

from collections.abc import Iterable
from typing import Annotated

import typer

from drake_clutter.cli.config_from_options import load_config_from_options
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    JsonOption,
    NodesOption,
    ObjectsOption,
    OutOption,
    RayOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import Item, print_result, progress_bar
from drake_clutter.limits import MAX_COUNT


def generate(
    out: OutOption,
    agent: Annotated[
        str,
        typer.Option(
            help="Generation policy: random, hill-climbing; sg, sg-star or sg-14 (trained); or a "
            "checkpoint file."
        ),
    ] = "random",
    temperature: Annotated[
        float | None,
        typer.Option(
            help="Softmax temperature of a trained policy: lower gives higher rewards, higher "
            "gives more variety. Default: the one stored in its checkpoint."
        ),
    ] = None,
    objects: ObjectsOption = "ycb7",
    nodes: NodesOption = 25,
    count: Annotated[int, typer.Option(max=MAX_COUNT, help="Number of scenes.")] = 100,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Generate scenes and judge their stability and hidden objects in Drake.

    Writes one file per scene, `summary.json` and `contact_sheet.png`. An interrupted run resumes
    when the same command is given again; a larger `--count` extends it.
    """
    from drake_clutter.agents.generators import GenerationJob
    from drake_clutter.commands.generate_scenes import generate_scenes
    from drake_clutter.reports.terminal_text import describe_generation

    config = load_config_from_options(config_file, cell_file, settings)
    job = GenerationJob(agent, objects, catalog, nodes, seed, config, temperature)

    def progress(scenes: Iterable[Item], num_done: int, total: int) -> Iterable[Item]:
        return progress_bar("scenes", scenes, num_done, total)

    summary = generate_scenes(job, count, out, workers, progress, ray)
    print_result(summary, describe_generation(summary), as_json, f"{out}")
