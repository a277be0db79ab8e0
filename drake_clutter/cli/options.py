"""Options that several commands share."""

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.limits import MAX_COUNT, MAX_SEED, MAX_WORKERS


class Fidelity(Enum):
    """Physical fidelity at which moves are executed."""

    STATIC_OR_DRAKE = "static_or_drake"
    SETTLE = "settle"
    ARM = "arm"


class Until(Enum):
    """When an episode ends, see `StopCriterion`."""

    ALL_FOUND = "all-found"
    BELIEF = "belief"


SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE.yaml", help="Scene file.")]
OutOption = Annotated[
    Path,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Output folder: new, empty, or of the same command, which is resumed.",
    ),
]
SeedOption = Annotated[
    int,
    typer.Option(
        "--seed",
        min=0,
        max=MAX_SEED,
        help="Random seed; the same seed gives the same result.",
    ),
]
HtmlOption = Annotated[
    Path | None,
    typer.Option("--html", metavar="FILE", help="Write an HTML file instead of a live view."),
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as JSON on standard output.")
]
CatalogOption = Annotated[
    Path | None,
    typer.Option("--catalog", metavar="DIR", help="Asset folder with your own object classes."),
]
ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config",
        metavar="FILE",
        help="YAML file with the configuration fields that differ from the defaults.",
    ),
]
CellOption = Annotated[
    Path | None,
    typer.Option(
        "--cell",
        metavar="FILE",
        help="Work cell file: robot, gripper, support, cameras, fixtures. "
        "Default: the cell stored with the scene, else the UR10 cell.",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="FIELD=VALUE",
        help="Set one field of the cell or the configuration, such as `robot.base.z=0.4` or "
        "`settle.max_time=3`. May be repeated.",
    ),
]
ObjectsOption = Annotated[
    str,
    typer.Option("--objects", help="Object set: ycb7, pantry14, or a set of your own catalog."),
]
MaxMovesOption = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=MAX_COUNT,
        help="Maximum number of moves per episode. Default: `exploration.max_moves`, which is 10.",
    ),
]
UntilOption = Annotated[
    Until,
    typer.Option(
        "--until",
        help="When an episode ends: all-found (every object has been in view, which the ground "
        "truth decides) or belief (the agent stops by itself).",
    ),
]
ExplorerOption = Annotated[
    str,
    typer.Option(
        "--agent",
        help="Exploration policy: random, largest-first or largest-clear (rules); student, "
        "student-dagger, student-14, student-rg or teacher (trained); area-reduction (with a "
        "target); full-knowledge (optimal plans from the true state); or a checkpoint file.",
    ),
]
TargetOption = Annotated[
    str,
    typer.Option(
        "--target",
        metavar="CLASS|NAME|random-hidden",
        help="Search for one object: any of a class, the one of a name, or one that is drawn among "
        "the hidden ones. The policy knows its class. Default: search for all objects.",
    ),
]
RetrieveOption = Annotated[
    bool,
    typer.Option(
        "--retrieve",
        help="When the target is seen, move it to the hand-over place of the cell.",
    ),
]
WorkersOption = Annotated[
    int,
    typer.Option(
        "--workers",
        min=1,
        max=MAX_WORKERS,
        help="Number of worker processes; the result does not depend on it.",
    ),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Address of a Ray cluster that runs the workers, such as auto. Default: run locally.",
    ),
]
FidelityOption = Annotated[
    Fidelity,
    typer.Option(
        help="How moves are executed. arm: the simulated arm carries the object. settle: the "
        "object is teleported, then Drake simulates the scene until it is at rest. "
        "static_or_drake: the object is teleported, then static equilibrium decides, or Drake "
        "where that is inconclusive."
    ),
]
NodesOption = Annotated[
    int,
    typer.Option(
        "--nodes", help="Number of nodes of the scene graph, counting all node types; at least 3."
    ),
]
InitialPosesOption = Annotated[
    bool, typer.Option("--initial-poses", help="Use initial poses instead of settled poses.")
]
