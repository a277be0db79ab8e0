"""A robot's model file, SDF or URDF: where it is, whether it is whole, and its limits of torque."""

import math
import re
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_clutter.files import InputError
from drake_clutter.resources import resource_path
from drake_clutter.robots.stl_conversion import convert_stl_to_obj

PACKAGE = "drake_clutter_models"
"""Name of the package whose files ship as `models/`."""
_DRAKE = "drake.mit.edu"
"""Namespace of Drake's own elements and attributes."""


def resolve_model_path(model: str, field: str = "robot.model") -> Path:
    """Return the file of a model.

    Args:
        model: A path, or package://drake_clutter_models/ and a path in `models/`.
        field: Where it is named in the cell's file.

    Raises:
        InputError: There is no such file, or it is neither SDF nor URDF.
    """
    prefix = f"package://{PACKAGE}/"
    shipped, inside = model.startswith(prefix), model.removeprefix(prefix)
    path = resource_path("models") / inside if shipped else Path(model)
    if not path.is_file() or path.suffix not in (".sdf", ".urdf"):
        raise InputError(f"{field}: {model!r}; allowed is an SDF or URDF file, or {prefix}FILE")
    return path


def find_packages(path: Path) -> PackageMap:
    """Return the packages that a model file may name.

    Those of ROS_PACKAGE_PATH, that of the next folder above with a package.xml, and
    `drake_clutter_models`.
    """
    packages = PackageMap()
    packages.PopulateFromRosPackagePath()
    above = (folder / "package.xml" for folder in path.parents)
    found = next((package for package in above if package.is_file()), None)
    for package in (found, resource_path("models/package.xml")):
        if package is not None:
            packages.AddPackageXml(str(package))
    return packages


@lru_cache(maxsize=32)
def read_model_text(path: Path, *, visuals: bool) -> str:
    """Return a model that is not static, with absolute paths of its meshes, for Drake's parser.

    Drake parses a text in a few milliseconds, and the file that it came from in sixty.

    Args:
        path: SDF or URDF file.
        visuals: False to leave out what cameras see.

    Raises:
        InputError: The file is not XML, or a mesh that it names is missing.
    """
    root = _read_xml(path)
    for link in root.iter("link"):
        for visual in () if visuals else link.findall("visual"):
            link.remove(visual)
    for model in root.iter("model"):
        for static in model.findall("static"):
            model.remove(static)  # else it is fixed to the world's origin
    packages = find_packages(path)
    for mesh in root.iter("mesh"):
        if (uri := mesh.find("uri")) is not None:
            uri.text = _resolve_mesh(path, (uri.text or "").strip(), packages).as_uri()
        elif filename := mesh.get("filename"):
            mesh.set("filename", _resolve_mesh(path, filename, packages).as_uri())
    return ElementTree.tostring(root, encoding="unicode")


def _read_xml(path: Path) -> ElementTree.Element:
    ElementTree.register_namespace("drake", _DRAKE)  # else the prefix is renamed
    try:
        text = path.read_text(encoding="utf-8")
        if "drake:" in text and _DRAKE not in text:  # as in many a URDF, which Drake accepts
            text = re.sub(r"<(robot|sdf)\b", rf'<\1 xmlns:drake="{_DRAKE}"', text, count=1)
        return ElementTree.fromstring(text)
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise InputError(f"{path}: is not XML ({error}); allowed is an SDF or URDF") from error


def _resolve_mesh(path: Path, uri: str, packages: PackageMap) -> Path:
    scheme, _, rest = uri.partition("://")
    package, _, inside = rest.partition("/")
    if scheme in ("package", "model") and packages.Contains(package):
        file = Path(packages.GetPath(package)) / inside
    else:
        file = Path(rest) if scheme == "file" else path.parent / uri
    if not file.is_file():
        raise InputError(f"{path}: mesh: {uri!r} is missing; allowed is a file")
    file = file.resolve()
    return convert_stl_to_obj(file) if file.suffix.lower() == ".stl" else file


def parse_model(
    plant: MultibodyPlant,
    model: str,
    *,
    visuals: bool,
    field: str = "robot.model",
) -> ModelInstanceIndex:
    """Add a model to a plant that is not finalized; arguments as of `model_path`, `model_text`.

    Raises:
        InputError: The file is missing or damaged, or does not hold one model.
    """
    path = resolve_model_path(model, field)
    text = read_model_text(path, visuals=visuals)
    try:
        parser = Parser(plant)
        parser.SetAutoRenaming(True)  # of a second model of one name
        instances = parser.AddModelsFromString(text, path.suffix.removeprefix("."))
    except (RuntimeError, ValueError, SystemExit) as error:  # the last: Drake's assertions
        words = " ".join(str(error).split())
        raise InputError(f"{path}: {words}; allowed is a model that Drake reads") from error
    if len(instances) != 1:
        raise InputError(f"{path}: holds {len(instances)} models; allowed is one")
    return instances[0]


def find_mimic_joint(path: Path) -> str | None:
    """Return the name of a joint of a model file that follows another one; None: it has none."""
    joints = _read_xml(path).iter("joint")
    return next(
        (joint.get("name", "") for joint in joints if joint.find(".//mimic") is not None), None
    )


@lru_cache(maxsize=32)
def read_torque_limits(path: Path) -> dict[str, float]:
    """Return the largest torque [N m] or force [N] of the joints of a model file, by name.

    Drake reads them from a URDF only if it has transmissions, which many have not. A joint without
    a value, or with 0, is missing here.
    """
    found = {}
    for joint in _read_xml(path).iter("joint"):
        limit = joint.find("limit") if joint.find("limit") is not None else joint.find("axis/limit")
        text = None if limit is None else limit.get("effort") or limit.findtext("effort")
        if text is not None and 0 < float(text) < math.inf:
            found[joint.get("name", "")] = float(text)
    return found
