"""`drake-clutter assets`."""

from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.output import print_line

assets_app = typer.Typer(help="Build the models of object classes.", no_args_is_help=True)


@assets_app.callback()
def assets() -> None:
    """Build the models of object classes."""


@assets_app.command("build")
def build(
    folder: Annotated[Path, typer.Argument(help="Asset folder with a `catalog.yaml`.")],
    classes: Annotated[
        list[str] | None,
        typer.Option("--class", help="Build only this class. May be repeated."),
    ] = None,
) -> None:
    """Build the SDF models, collision geometry and textures of a catalog."""
    from drake_clutter.assets import build_assets

    for built in build_assets(folder, classes):
        print_line(f"Built {built}.")
