"""`drake-clutter export`."""

from enum import Enum
from typing import Annotated

import typer

from drake_clutter.cli.options import CatalogOption, InitialPosesOption, OutOption, SceneArgument
from drake_clutter.cli.output import print_line


class Format(Enum):
    """File formats for exported scenes."""

    DMD = "dmd"
    SDF = "sdf"
    MJCF = "mjcf"
    GLB = "glb"
    USD = "usd"


def export(
    scene: SceneArgument,
    out: OutOption,
    format: Annotated[
        Format,
        typer.Option(
            help="dmd: Drake model directives. sdf: PyBullet, Gazebo. mjcf: MuJoCo. glb: 3-D "
            "viewers. usd: Isaac Sim and other readers of UsdPhysics."
        ),
    ],
    with_cell: Annotated[
        bool,
        typer.Option(
            "--with-cell",
            help="Export arm, gripper, pedestal, cameras and fixtures, too (mjcf, usd).",
        ),
    ] = False,
    initial_poses: InitialPosesOption = False,
    catalog: CatalogOption = None,
) -> None:
    """Export a scene to a self-contained folder."""
    from drake_clutter.catalog import load_catalog
    from drake_clutter.commands.job_file import open_job_folder, scene_job
    from drake_clutter.config import ClutterConfig
    from drake_clutter.export import ExportFormat, export_scene
    from drake_clutter.scenes.scene_file import load_scene

    file = load_scene(scene, load_catalog(catalog))
    exported = file.scene if initial_poses else file.settled_scene
    config = ClutterConfig(cell=file.cell)
    options = {
        "format": format.value,
        "initial_poses": initial_poses,
        **({"with_cell": True} if with_cell else {}),
    }
    with open_job_folder(out, scene_job("export", scene, config, catalog, **options)):
        cell = file.cell if with_cell else None
        path = export_scene(exported, ExportFormat(format.value), out, cell=cell)
    print_line(f"Wrote {path}.")
