"""`drake-clutter move`."""

import math
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from drake_clutter.cli.config_from_options import load_scene_and_config
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    Fidelity,
    FidelityOption,
    JsonOption,
    OutOption,
    SceneArgument,
    SeedOption,
    SetOption,
)
from drake_clutter.cli.output import print_result, print_transition
from drake_clutter.files import InputError


class PlanFormat(Enum):
    """File formats of exported plans."""

    CSV = "csv"
    URSCRIPT = "urscript"


def move(
    scene: SceneArgument,
    out: OutOption,
    pick: Annotated[str | None, typer.Option(help="Name of the object to pick.")] = None,
    place: Annotated[
        str | None,
        typer.Option(
            help="Name of the object to place it on, or tray; or a pose X,Y,Z,YAW: position of the "
            "object's origin [m] and turn about the vertical [deg]."
        ),
    ] = None,
    moves: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="YAML list of `{pick: NAME, place: PLACE}`; PLACE as of `--place`."
        ),
    ] = None,
    fidelity: FidelityOption = Fidelity.SETTLE,
    plan_only: Annotated[
        bool,
        typer.Option(
            "--plan-only",
            help="Plan the arm's motions without executing them; write `plan.json`. "
            "Needs `--fidelity arm`.",
        ),
    ] = False,
    export: Annotated[
        list[PlanFormat] | None,
        typer.Option(
            help="With `--plan-only`, write the plan for a controller too. csv: `plan.csv`, evenly "
            "sampled positions and velocities. urscript: `plan.script`, a program for UR arms. May "
            "be repeated.",
        ),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option(metavar="HZ", help="Rate of the exported samples. Default: 500."),
    ] = None,
    seed: SeedOption = 0,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Execute one move or a list of moves in a scene.

    Writes `episode.json`, the final scene `after.yaml` and the web page `index.html`. Exits with
    code 1 if a move has no plan or is not carried out.
    """
    from drake_clutter.commands.explore_scene import (
        DEFAULT_EXPORT_RATE,
        EPISODE_FILE,
        PLAN_FILE,
        execute_moves,
        plan_moves,
        read_moves,
        settle_scene,
        write_episode,
    )
    from drake_clutter.commands.job_file import open_job_folder, read_result, scene_job
    from drake_clutter.reports.terminal_text import (
        describe_episode,
        describe_outcomes,
        describe_plans,
    )
    from drake_clutter.scenes.interfaces import Move, MoveResult

    if (moves is None) == (pick is None) or (pick is None) != (place is None):
        raise InputError("move: expected either --pick NAME --place NAME, or --moves FILE")
    if plan_only and fidelity is not Fidelity.ARM:
        raise InputError(f"--plan-only with --fidelity {fidelity.value}; expected --fidelity arm")
    if export and not plan_only:
        raise InputError(f"--export {export[0].value} without --plan-only; expected --plan-only")
    if rate is not None and not export:
        raise InputError(f"--rate {rate:g} without --export; expected --export csv or urscript")
    formats = [choice.value for choice in dict.fromkeys(export or [])]
    export_rate = DEFAULT_EXPORT_RATE if rate is None else rate
    if not math.isfinite(export_rate):
        raise InputError(f"--rate {export_rate:g}; expected a finite number")
    requested = read_moves(moves) if moves else [Move(str(pick), str(place))]
    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    pairs = [[move.pick, move.place] for move in requested]
    options: dict[str, Any] = {"moves": pairs, "fidelity": fidelity.value, "plan_only": plan_only}
    if formats:
        options |= {"export": formats, "rate": export_rate}
    job = scene_job("move", scene, config, catalog, seed=seed, **options)
    with open_job_folder(out, job):
        result = read_result(out / (PLAN_FILE if plan_only else EPISODE_FILE))
        if result is None:
            start = settle_scene(file.scene, config, seed)
            if plan_only:
                result = {
                    "plans": plan_moves(start, requested, seed, config, out, formats, export_rate)
                }
            else:
                task = execute_moves(
                    start, requested, seed, config, print_transition, fidelity.value
                )
                title = f"Moves in {scene.name}"
                result = write_episode(
                    out, task, title, "given moves", fidelity.value, seed, config
                )
    if plan_only:
        plans = result["plans"]
        print_result({"plans": plans}, describe_plans(plans), as_json, f"{out}")
        num_done = sum(plan["planned"] for plan in plans)
    else:
        rows = describe_episode(result) | describe_outcomes(result)
        print_result(result, rows | {"page": str(out / "index.html")}, as_json, f"{out}")
        num_done = sum(MoveResult(step["outcome"]).is_at_placement for step in result["moves"])
    if num_done < len(requested):
        raise typer.Exit(1)
