"""`drake-clutter view`."""

from drake_clutter.cli.options import CatalogOption, HtmlOption, InitialPosesOption, SceneArgument
from drake_clutter.cli.output import show_recording


def view(
    scene: SceneArgument,
    html: HtmlOption = None,
    initial_poses: InitialPosesOption = False,
    catalog: CatalogOption = None,
) -> None:
    """Show a scene in the browser (Meshcat), or write it to one HTML file."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.scenes.interfaces import MotionSample
    from drake_clutter.scenes.scene_file import load_scene

    file = load_scene(scene, load_catalog(catalog))
    shown = file.scene if initial_poses else file.settled_scene
    show_recording(scene, shown, [MotionSample(0.0, shown.poses)], file.cell, html)
