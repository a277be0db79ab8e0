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


def render(
    scene: SceneArgument,
    out: OutOption,
    catalog: CatalogOption = None,
    config_file: ConfigOption = None,
    cell_file: CellOption = None,
    settings: SetOption = None,
) -> None:
    """Render the images of the cell's cameras.

    Writes `color.png`, `depth.png` (16 bit, 0.1 mm per step), `label.png` (k for object k, 0 for
    anything else), `visible.json` (visible fraction of each object) and `picture.png`.
    """
    from drake_clutter.commands.job_file import open_job_folder, scene_job
    from drake_clutter.commands.render_scene import render_scene

    file, config = load_scene_and_config(scene, catalog, config_file, cell_file, settings)
    with open_job_folder(out, scene_job("render", scene, config, catalog)):
        fractions = render_scene(file.settled_scene, config, out)
    rows = {name: f"{fraction:.3f}" for name, fraction in fractions.items()}
    print_result(fractions, rows, False, "visible fraction")
