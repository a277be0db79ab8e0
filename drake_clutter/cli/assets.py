"""`drake-clutter assets`."""

from pathlib import Path
from typing import Annotated

import typer

from drake_clutter.cli.output import out_console

assets_app = typer.Typer(help="Build the models of object classes.", no_args_is_help=True)


@assets_app.callback()
def assets() -> None:
    """Build the models of object classes."""


@assets_app.command("build")
def build(
    folder: Annotated[Path, typer.Argument(help="An asset folder: it holds catalog.yaml.")],
    only: Annotated[
        list[str] | None, typer.Option("--class", help="Build this class alone; may be repeated.")
    ] = None,
) -> None:
    """Build SDF models, collision pieces and textures of a catalog's classes."""
    from drake_clutter.assets import build_assets

    for built in build_assets(folder, only):
        out_console.print(f"built {built}")
