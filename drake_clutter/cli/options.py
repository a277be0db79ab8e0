"""Options that several commands take."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer


class Fidelity(Enum):
    """How moves are carried out."""

    FAST = "fast"
    SETTLE = "settle"
    ARM = "arm"


SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.yaml", help="A scene file.")]
OutOption = Annotated[
    Path, typer.Option("--out", metavar="DIR", help="Folder for the results; new or empty.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Same seed, same result.")]
HtmlOption = Annotated[
    Path | None,
    typer.Option("--html", metavar="FILE", help="Write a page instead of showing it live."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON on standard output.")
]
CatalogOption = Annotated[
    Path | None,
    typer.Option(
        "--catalog",
        metavar="DIR",
        help="An asset folder with object classes of your own.",
    ),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="YAML with the config's fields that differ from the defaults.",
    ),
]
CellOption = Annotated[
    Path | None,
    typer.Option(
        "--cell",
        metavar="FILE",
        help="Work cell: robot, gripper, cameras, fixtures; without it the one that the scene was made with.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="FIELD=VALUE",
        help="A field of the cell or config, such as robot.base.z=0.4 or settle.max_time=3; may be repeated.",
    ),
]
ObjectsOption = Annotated[
    str, typer.Option("--objects", help="Object set: ycb7, pantry14, or one of your catalog's.")
]
MaxMovesOption = Annotated[
    int | None,
    typer.Option(min=1, help="Moves after which a search ends; the config's (10) if not given."),
]
ExplorerOption = Annotated[
    str,
    typer.Option(
        "--agent",
        help="Who chooses the moves: random, largest-first, largest-clear; student, student-dagger, student-14, student-rg, "
        "teacher (trained); or the file of a checkpoint that you trained.",
    ),
]
WorkersOption = Annotated[
    int, typer.Option("--workers", min=1, help="Processes; the result is the same for any number.")
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Put the workers on this Ray cluster, e.g. auto, instead of here.",
    ),
]
FidelityOption = Annotated[
    Fidelity,
    typer.Option(
        help="arm: the robot carries every move out. Else objects are teleported; settle: Drake settles what a move touched; "
        "fast: by equilibrium, Drake in doubt."
    ),
]
NodesOption = Annotated[
    int, typer.Option("--nodes", help="Size of the graph, all kinds of nodes counted; 3 or more.")
]
InitialPosesOption = Annotated[
    bool, typer.Option("--initial-poses", help="Use initial poses instead of settled poses.")
]
