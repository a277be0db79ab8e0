"""`drake-clutter render`."""

from drake_clutter.cli.config_from_options import load_scene_and_config
from drake_clutter.cli.options import (
    CatalogOption,
    CellOption,
    ConfigOption,
    OutOption,
    SceneArgument,
    SetOption,
)
from drake_clutter.cli.output import print_result
from drake_clutter.files import prepare_output_directory


def render(
    scene: SceneArgument,
    out: OutOption,
    catalog: CatalogOption = None,
    config: ConfigOption = None,
    cell: CellOption = None,
    settings: SetOption = None,
) -> None:
    """Render what the cameras see: color.png, depth.png (16 bit, 0.1 mm), label.png, visible.json, picture.png."""
    from drake_clutter.commands.render_scene import render_scene

    file, world = load_scene_and_config(scene, catalog, config, cell, settings)
    prepare_output_directory(out)
    shares = render_scene(file.settled_scene, world, out)
    print_result({name: round(share, 3) for name, share in shares.items()}, False, "visible share")
