"""`drake-clutter feasibility`."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli.config_from_options import (
    load_config_from_options,
    load_scene_and_config,
    reject_support_settings,
)
from drake_clutter.cli.options import (
    CatalogOption,
    ConfigOption,
    JsonOption,
    OutOption,
    SeedOption,
    SetOption,
    WorkersOption,
)
from drake_clutter.cli.output import print_result, progress_bar
from drake_clutter.files import InputError

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
    targets: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Suction cup poses to check: YAML list of `{name, translation, quaternion}`.",
        ),
    ] = None,
    seed: SeedOption = 0,
    workers: WorkersOption = 1,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    as_json: JsonOption = False,
) -> None:
    """Plan every legal move of scenes with one or several arms.

    Writes CSV tables, `summary.json` and the web page `report.html`. An interrupted study resumes
    when the same command is given again.
    """
    from drake_clutter.commands.feasibility_job import (
        REPORT_FILE,
        FeasibilityJob,
        check_unique_names,
        collect_scene_files,
        make_setups,
        read_targets,
        run_feasibility_study,
    )
    from drake_clutter.reports.terminal_text import describe_feasibility

    reject_support_settings(settings)
    files = collect_scene_files(scenes)
    _, config = load_scene_and_config(files[0], catalog, config_file, None, settings)
    check_unique_names("--cell, --cell-override", [*(cell_files or []), *(cell_override or [])])
    support = config.cell.support
    cells = {
        path.stem: load_config_from_options(config_file, path, settings).cell.with_support(support)
        for path in cell_files or []
    }
    setups = make_setups(
        [_parse_pose("--base", text) for text in base or []],
        [_parse_pose("--tray", text) for text in tray or []],
        cell_override or [],
        next(iter(cells.values()), config.cell),
    )
    if cells:
        setups = cells | {name: cell for name, cell in setups.items() if name != "default"}
    target_poses = read_targets(targets) if targets else ()
    job = FeasibilityJob(files, setups, target_poses, seed, config, catalog)

    def progress(parts: Iterable[Any], num_done: int, total: int) -> Iterable[Any]:
        return progress_bar("parts of the study", parts, num_done, total)

    summary = run_feasibility_study(job, out, workers, progress)
    rows = describe_feasibility(summary) | {"report": str(out / REPORT_FILE)}
    print_result(summary, rows, as_json, f"{out}")
