"""`drake-clutter view`."""

from drake_clutter.cli.options import (
    CatalogOption,
    HtmlOption,
    InitialPosesOption,
    SceneArgument,
)
from drake_clutter.cli.output import locked_files, show_recording


def view(
    scene: SceneArgument,
    html_file: HtmlOption = None,
    initial_poses: InitialPosesOption = False,
    catalog: CatalogOption = None,
) -> None:
    """Show a scene in the browser (Meshcat)."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.scenes.interfaces import MotionSample
    from drake_clutter.scenes.scene_file import load_scene

    with locked_files({"--html": html_file}):
        file = load_scene(scene, load_catalog(catalog))
        viewed = file.scene if initial_poses else file.settled_scene
        show_recording(scene, viewed, [MotionSample(0.0, viewed.poses)], file.cell, html_file)
