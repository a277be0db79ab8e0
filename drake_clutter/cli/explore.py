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
    RetrieveOption,
    SceneArgument,
    SeedOption,
    SetOption,
    TargetOption,
    Until,
    UntilOption,
)
from drake_clutter.cli.output import print_episode, print_transition
from drake_clutter.files import InputError


def explore(
    scene: SceneArgument,
    out: OutOption,
    agent: ExplorerOption = "largest-clear",
    fidelity: FidelityOption = Fidelity.SETTLE,
    until: UntilOption = Until.ALL_FOUND,
    max_moves: MaxMovesOption = None,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    target: TargetOption = "",
    retrieve: RetrieveOption = False,
    as_json: JsonOption = False,
) -> None:
    """Search a scene for its hidden objects, or for a target.

    Writes `episode.json`, the final scene `after.yaml` and the web page `index.html`.
    """
    from drake_clutter.agents.explorers import PRETRAINED_EXPLORERS
    from drake_clutter.catalog import load_catalog
    from drake_clutter.commands.explore_scene import (
        EPISODE_FILE,
        explore_scene,
        settle_scene,
        write_episode,
    )
    from drake_clutter.commands.job_file import open_job_folder, read_result, scene_job
    from drake_clutter.learning.pretrained import checkpoint_sha256
    from drake_clutter.tasks.exploration_task import StopCriterion

    if target and until is Until.BELIEF:
        raise InputError("--until belief: ends searches for all objects; expected no --target")
    if retrieve and not target:
        raise InputError("--retrieve: nothing to retrieve; expected --target")
    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    if retrieve and config.cell.handover is None:
        raise InputError(
            "--retrieve: the cell has no handover; expected a pose in --cell, or as "
            "--set handover.translation=[X,Y,Z]"
        )
    limit = max_moves or config.exploration.max_moves
    weights = checkpoint_sha256(agent, PRETRAINED_EXPLORERS)
    options = {
        "agent": agent,
        "weights": weights,
        "fidelity": fidelity.value,
        "until": until.value,
        "max_moves": limit,
    }
    if target:
        options |= {"target": target, "retrieve": retrieve}
    job = scene_job("explore", scene, config, catalog, seed=seed, **options)
    with open_job_folder(out, job):
        episode = read_result(out / EPISODE_FILE)
        if episode is None:
            start = settle_scene(file.scene, config, seed)
            classes = load_catalog(catalog).smallest_set(
                [o.object_class.name for o in start.objects]
            )
            task = explore_scene(
                start,
                agent,
                fidelity.value,
                limit,
                seed,
                config,
                print_transition,
                target,
                retrieve=retrieve,
                until=StopCriterion(until.value),
                classes=classes,
            )
            title = f"{agent} explores {scene.name}" + (f" for {target}" if target else "")
            episode = write_episode(out, task, title, agent, fidelity.value, seed, config)
    print_episode(episode, as_json, out)
