"""Export of a scene as Drake model directives, with the models that they name."""

import shutil
from pathlib import Path

from pydrake.common.schema import Transform
from pydrake.common.yaml import yaml_dump_typed
from pydrake.multibody.parsing import AddModel, AddWeld, ModelDirective, ModelDirectives

from drake_clutter.cell.support_sdf import support_sdf
from drake_clutter.export.model_parts import classes_in_scene
from drake_clutter.scenes.scene import TRAY, Scene
from drake_clutter.simulation.scene_plant import rigid_transform

PACKAGE = "drake_clutter_scene"
"""Name of the package that an exported folder forms."""

_PACKAGE_XML = f"""<?xml version="1.0"?>
<package format="2">
  <name>{PACKAGE}</name>
  <version>0.0.0</version>
  <description>A scene exported by drake_clutter.</description>
  <maintainer email="maintainers@example.com">drake_clutter authors</maintainer>
  <license>BSD-3-Clause</license>
</package>
"""


def write_dmd(scene: Scene, folder: Path) -> Path:
    """Write `scene.dmd.yaml`, `package.xml`, `tray.sdf` and a folder for each class.

    The models are those of the catalog. Returns the path of `scene.dmd.yaml`.
    """
    for object_class in classes_in_scene(scene):
        target = folder / object_class.name
        target.mkdir()
        for file in object_class.folder.iterdir():
            # copytree would copy the modes too, which may be read-only in an installed package.
            shutil.copyfile(file, target / file.name)
    (folder / "tray.sdf").write_text(support_sdf(scene.support, table=True), encoding="utf-8")
    (folder / "package.xml").write_text(_PACKAGE_XML, encoding="utf-8")
    directives = [
        ModelDirective(add_model=AddModel(name=TRAY, file=f"package://{PACKAGE}/tray.sdf")),
        ModelDirective(add_weld=AddWeld(parent="world", child=f"{TRAY}::tray")),
    ]
    for scene_object in scene.objects:
        model = AddModel(
            name=scene_object.name,
            file=f"package://{PACKAGE}/{scene_object.object_class.name}/model.sdf",
            default_free_body_pose={"body": Transform(rigid_transform(scene_object.X_TO))},
        )
        directives.append(ModelDirective(add_model=model))
    path = folder / "scene.dmd.yaml"
    yaml_dump_typed(ModelDirectives(directives=directives), filename=str(path))
    return path
