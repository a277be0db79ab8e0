"""`drake-clutter generate`."""

from collections.abc import Iterable
from typing import Annotated, Any

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
from drake_clutter.cli.output import print_result, progress_bar


def generate(
    out: OutOption,
    agent: Annotated[
        str,
        typer.Option(help="random, hill-climbing, or the file of a checkpoint that you trained."),
    ] = "random",
    temperature: Annotated[
        float | None,
        typer.Option(help="Of a trained agent: low for the best scenes, high for all kinds."),
    ] = None,
    objects: ObjectsOption = "ycb7",
    nodes: NodesOption = 25,
    count: Annotated[int, typer.Option(help="Scenes to generate.")] = 100,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Generate scenes, settle them in Drake and say which are stable and what they hide. A run that was stopped goes on."""
    from drake_clutter.agents.generators import GenerationJob
    from drake_clutter.commands import generate_scenes as command

    job = GenerationJob(
        agent,
        objects,
        catalog,
        nodes,
        seed,
        load_config_from_options(config, cell, settings),
        temperature,
    )

    def progress(made: Iterable[Any], done: int, total: int) -> Iterable[Any]:
        return progress_bar("scenes", made, done, total)

    summary = command.generate_scenes(job, count, out, workers, progress, ray)
    shown = {key: value for key, value in summary.items() if key != "config"}
    print_result(summary if as_json else shown, as_json, f"{out}")
