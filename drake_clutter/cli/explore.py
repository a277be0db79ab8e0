"""`drake-clutter explore`."""

from drake_clutter.cli.config_from_options import load_scene_and_config
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    ExplorerOption,
    Fidelity,
    FidelityOption,
    JsonOption,
    MaxMovesOption,
    OutOption,
    SceneArgument,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import print_episode, print_transition
from drake_clutter.files import prepare_output_directory


def explore(
    scene: SceneArgument,
    out: OutOption,
    agent: ExplorerOption = "largest-clear",
    fidelity: FidelityOption = Fidelity.SETTLE,
    max_moves: MaxMovesOption = None,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Search a scene for what it hides; writes episode.json and a page, index.html."""
    from drake_clutter.commands import explore_scene as command

    file, world = load_scene_and_config(scene, catalog, config, cell, settings)
    prepare_output_directory(out)
    limit = max_moves or world.exploration.max_moves
    task = command.explore_scene(
        command.settle_scene(file.scene, world, seed),
        agent,
        fidelity.value,
        limit,
        seed,
        world,
        print_transition,
    )
    title = f"{agent} explores {scene.name}"
    print_episode(
        command.write_episode(out, task, title, agent, fidelity.value, seed, world), as_json, out
    )
