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
    repair: Annotated[
        bool, typer.Option("--repair", help="Close small holes of meshes, and list them.")
    ] = False,
) -> None:
    """Build the SDF models, collision geometry and textures of a catalog."""
    from drake_clutter.assets import build_assets, describe_built_mesh
    from drake_clutter.catalog import load_catalog

    for built in build_assets(folder, classes, repair=repair):
        print_line(f"Built {built}.")
        for text in describe_built_mesh(load_catalog(folder.resolve()).classes[built.name]):
            print_line(f"  Mesh: {text}.")
