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
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Search a scene for its hidden objects.

    Writes `episode.json`, the final scene `after.yaml` and the web page `index.html`.
    """
    from drake_clutter.commands.explore_scene import explore_scene, settle_scene, write_episode

    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    prepare_output_directory(out)
    task = explore_scene(
        settle_scene(file.scene, config, seed),
        agent,
        fidelity.value,
        max_moves or config.exploration.max_moves,
        seed,
        config,
        print_transition,
    )
    title = f"{agent} explores {scene.name}"
    episode = write_episode(out, task, title, agent, fidelity.value, seed, config)
    print_episode(episode, as_json, out)
