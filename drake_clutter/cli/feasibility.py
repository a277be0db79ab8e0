"""`drake-clutter feasibility`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli.config_from_options import (
    load_cell_from_options,
    load_scene_and_config,
    reject_support_settings,
)
from drake_clutter.cli.options import (
    CatalogOption,
    ConfigOption,
    JsonOption,
    OutOption,
    RayOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import print_result, progress_bar
from drake_clutter.files import InputError
from drake_clutter.limits import MAX_COUNT

POSE_METAVAR = "X,Y,Z,YAW"


def _parse_pose(option: str, text: str) -> list[float]:
    """Return x, y, z [m] and yaw [deg] from a comma-separated text."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 4 or not all(abs(value) <= 360 for value in values):
        raise InputError(f"{option} {text}; expected X,Y,Z,YAW in m, m, m and degrees")
    return values


def feasibility(
    scenes: Annotated[
        list[Path], typer.Argument(metavar="SCENES...", help="Scene files, or folders of them.")
    ],
    out: OutOption,
    cell_files: Annotated[
        list[Path] | None,
        typer.Option("--cell", metavar="FILE", help="Work cell to study. May be repeated."),
    ] = None,
    settings: SetOption = None,
    base: Annotated[
        list[str] | None,
        typer.Option(
            metavar=POSE_METAVAR,
            help="Pose of the arm's base in the tray frame [m, m, m, deg]. May be repeated.",
        ),
    ] = None,
    tray: Annotated[
        list[str] | None,
        typer.Option(
            metavar=POSE_METAVAR,
            help="Alternative to `--base`: pose of the tray in the base frame [m, m, m, deg]. May "
            "be repeated.",
        ),
    ] = None,
    cell_override: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="YAML file with the cell fields that differ from the first cell. May be repeated.",
        ),
    ] = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=FIRST:LAST:STEP",
            help="Study every value of a cell field, such as `robot.base.z=0:0.6:0.1` or "
            "`gripper.extension=0.1,0.2`. May be repeated: every combination is studied.",
        ),
    ] = None,
    search: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=FIRST:LAST:STEP",
            help="Search the best values of cell fields, such as `robot.base.x=-1:-0.4:0.05`, by "
            "an inverse reachability map, and study the best ones. May be repeated.",
        ),
    ] = None,
    targets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Tool poses to check: YAML list of `{name, translation, quaternion}`.",
        ),
    ] = None,
    maps: Annotated[
        bool, typer.Option(help="Draw maps of reachability for several tilts of the tool.")
    ] = True,
    noise: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            max=MAX_COUNT,
            help="Simulate N moves of each scene and setup, planned from poses, calibrations and "
            "masses with errors.",
        ),
    ] = 0,
    agent: Annotated[
        str | None,
        typer.Option(
            help="Search every scene to the end with an exploration policy, see `explore`."
        ),
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Simulate the motions of these searches.")
    ] = False,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    ray: RayOption = None,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find out which moves of scenes one or several arms can do, and where to put them.

    Writes tables, `summary.json` and the web page `report.html`. An interrupted study resumes
    when the same command is given again.
    """
    from drake_clutter.commands.feasibility_job import (
        FeasibilityJob,
        check_unique_names,
        collect_scene_files,
        make_setups,
        read_targets,
    )
    from drake_clutter.commands.feasibility_run import REPORT_FILE, run_feasibility_study
    from drake_clutter.feasibility.base_search import make_base_grids
    from drake_clutter.feasibility.setups import SetupRequest, parse_sweep, sweep_setups
    from drake_clutter.reports.terminal_text import describe_feasibility

    reject_support_settings(settings)
    files = collect_scene_files(scenes)
    _, config = load_scene_and_config(files[0], catalog, config_file, None, settings)
    check_unique_names("--cell, --cell-override", [*(cell_files or []), *(cell_override or [])])
    support = config.cell.support
    cells = {
        path.stem: load_cell_from_options(config_file, path, settings).with_support(support)
        for path in cell_files or []
    }
    setups = make_setups(
        [_parse_pose("--base", text) for text in base or []],
        [_parse_pose("--tray", text) for text in tray or []],
        cell_override or [],
        next(iter(cells.values()), config.cell),
    )
    if cells:
        given = {name: SetupRequest(cell, keep_home=True) for name, cell in cells.items()}
        setups = given | {name: setup for name, setup in setups.items() if name != "default"}
    setups = sweep_setups(setups, [parse_sweep("--sweep", text) for text in sweep or []])
    searches = tuple(parse_sweep("--search", text) for text in search or [])
    if searches:
        make_base_grids(next(iter(setups.values())).cell, searches)
    if agent is not None:
        from drake_clutter.agents.explorers import make_policy_factory

        make_policy_factory(agent, config)
    elif simulate:
        raise InputError("--simulate: is for searches; expected --agent, too")
    job = FeasibilityJob(
        scenes=files,
        setups=setups,
        searches=searches,
        targets=read_targets(targets) if targets else (),
        draws_maps=maps,
        noisy_moves=noise,
        agent=agent,
        simulate=simulate,
        seed=seed,
        config=config,
        catalog_folder=catalog,
    )

    def progress(parts: Iterable[Any], num_done: int, total: int) -> Iterable[Any]:
        return progress_bar("parts of the study", parts, num_done, total)

    summary = run_feasibility_study(job, out, workers=workers, ray_address=ray, progress=progress)
    rows = describe_feasibility(summary) | {"report": str(out / REPORT_FILE)}
    print_result(summary, rows, as_json, f"{out}")
