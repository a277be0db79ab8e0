"""Parsing of robot models: SDF or URDF files, their meshes and torque limits."""

import math
import re
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_clutter.cell.sdf_text import mesh_uri
from drake_clutter.files import InputError, read_text
from drake_clutter.resources import resource_path
from drake_clutter.robots.stl_conversion import convert_stl_to_obj
from drake_clutter.visual_mesh import check_visual_mesh

PACKAGE = "drake_clutter_models"
"""ROS package name of the shipped folder `models/`."""
_DRAKE = "drake.mit.edu"
"""XML namespace of Drake's extensions of SDF and URDF."""


def resolve_model_path(model: str, field: str = "robot.model") -> Path:
    """Return the path of a model file.

    Args:
        model: Path, or `package://drake_clutter_models/` followed by a path in `models/`.
        field: Field of the cell file that names the model, for error messages.

    Raises:
        InputError: The file does not exist, or is neither SDF nor URDF.
    """
    prefix = f"package://{PACKAGE}/"
    is_shipped = model.startswith(prefix)
    path = resource_path("models") / model.removeprefix(prefix) if is_shipped else Path(model)
    if not path.is_file() or path.suffix not in (".sdf", ".urdf"):
        raise InputError(f"{field}: {model!r}; expected an SDF or URDF file, or {prefix}FILE")
    return path


def find_packages(path: Path) -> PackageMap:
    """Return the ROS packages to which a model file may refer.

    These are the packages in ROS_PACKAGE_PATH, the package that contains the file, and
    `drake_clutter_models`.

    Args:
        path: Model file.
    """
    packages = PackageMap()
    packages.PopulateFromRosPackagePath()
    candidates = (folder / "package.xml" for folder in path.parents)
    own_package = next((package for package in candidates if package.is_file()), None)
    for package in (own_package, resource_path("models/package.xml")):
        if package is not None:
            packages.AddPackageXml(str(package))
    return packages


@lru_cache(maxsize=32)
def read_model_text(path: Path, *, visuals: bool) -> str:
    """Return the text of a model for Drake's parser.

    Mesh paths become absolute, and `static` elements are removed. Drake parses the text in a few
    milliseconds, and the file in 60 ms.

    Args:
        path: SDF or URDF file.
        visuals: Whether to keep visual geometry.

    Raises:
        InputError: The file is not XML, or a mesh is missing or, with visuals, damaged.
    """
    root = _read_xml(path)
    for link in root.iter("link"):
        for visual in () if visuals else link.findall("visual"):
            link.remove(visual)
    for model in root.iter("model"):
        for static in model.findall("static"):
            model.remove(static)  # Drake welds static models to the world at the origin.
    packages = find_packages(path)
    for mesh in root.iter("mesh"):
        if (uri := mesh.find("uri")) is not None:
            file = _resolve_mesh(path, (uri.text or "").strip(), packages)
            uri.text = mesh_uri(file)
        elif filename := mesh.get("filename"):
            file = _resolve_mesh(path, filename, packages)
            mesh.set("filename", mesh_uri(file))
        else:
            continue
        if visuals:
            check_visual_mesh(file)
    return ElementTree.tostring(root, encoding="unicode")


def _read_xml(path: Path) -> ElementTree.Element:
    """Return the root element of a model file, or raise an `InputError`."""
    # Without registration, ElementTree would rename the prefix, which Drake would not recognize.
    ElementTree.register_namespace("drake", _DRAKE)
    text = read_text(path, "an SDF or URDF")
    try:
        # Many URDF files use the prefix without declaring it, which Drake accepts.
        if "drake:" in text and _DRAKE not in text:
            text = re.sub(r"<(robot|sdf)\b", rf'<\1 xmlns:drake="{_DRAKE}"', text, count=1)
        return ElementTree.fromstring(text)
    except (ValueError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: is not XML ({error}); expected an SDF or URDF") from error


def _resolve_mesh(path: Path, uri: str, packages: PackageMap) -> Path:
    """Return the file of a mesh URI in a model file; STL meshes are converted to OBJ."""
    scheme, _, rest = uri.partition("://")
    package, _, inside = rest.partition("/")
    if scheme in ("package", "model") and packages.Contains(package):
        file = Path(packages.GetPath(package)) / inside
    else:
        file = Path(rest) if scheme == "file" else path.parent / uri
    if not file.is_file():
        raise InputError(f"{path}: mesh: {uri!r} is missing; expected a file")
    file = file.resolve()
    return convert_stl_to_obj(file) if file.suffix.lower() == ".stl" else file


def parse_model(
    plant: MultibodyPlant,
    model: str,
    *,
    visuals: bool,
    field: str = "robot.model",
) -> ModelInstanceIndex:
    """Add a model to a plant before it is finalized.

    Args:
        plant: Plant to which the model is added.
        model: Model file, see `resolve_model_path`.
        visuals: Whether to add visual geometry.
        field: Field of the cell file that names the model, for error messages.

    Raises:
        InputError: The file is missing or invalid, or does not contain exactly one model.
    """
    path = resolve_model_path(model, field)
    text = read_model_text(path, visuals=visuals)
    try:
        parser = Parser(plant)
        parser.SetAutoRenaming(True)  # Several models may have the same name.
        instances = parser.AddModelsFromString(text, path.suffix.removeprefix("."))
    except (RuntimeError, ValueError, SystemExit) as error:  # SystemExit: assertions of Drake
        words = " ".join(str(error).split())
        raise InputError(f"{path}: {words}; expected a model that Drake reads") from error
    if len(instances) != 1:
        raise InputError(f"{path}: holds {len(instances)} models; expected one")
    return instances[0]


def find_mimic_joint(path: Path) -> str | None:
    """Return the name of a joint that mimics another one, or None."""
    joints = _read_xml(path).iter("joint")
    return next(
        (joint.get("name", "") for joint in joints if joint.find(".//mimic") is not None), None
    )


@lru_cache(maxsize=32)
def read_torque_limits(path: Path) -> dict[str, float]:
    """Return the effort limits of the joints of a model file.

    Drake reads them from a URDF only if it has transmissions, which many URDFs lack.

    Args:
        path: SDF or URDF file.

    Returns:
        Largest torque [N m] or force [N] by joint name; joints without a positive limit are left
        out.
    """
    limits = {}
    for joint in _read_xml(path).iter("joint"):
        limit = joint.find("limit") if joint.find("limit") is not None else joint.find("axis/limit")
        text = None if limit is None else limit.get("effort") or limit.findtext("effort")
        if text is not None and 0 < float(text) < math.inf:
            limits[joint.get("name", "")] = float(text)
    return limits
