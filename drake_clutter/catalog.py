"""The catalog of object classes: what they measure and weigh, and where their assets lie.

An *asset folder* holds `catalog.yaml` and one folder per class that `drake_clutter.assets` builds from it. The shipped
one is `sdf_assets/`; a user's own adds classes to it. An object's frame O has its origin at the geometric centre: a box's
x, y, z are its sizes in the order of the catalog, a cylinder's axis is z, a mesh keeps its axes.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any, Self
from xml.etree import ElementTree

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from drake_clutter.files import InputError, format_value, input_error
from drake_clutter.resources import resource_path
from drake_clutter.validation import InRange, NonEmptyText, StrictModel, allowed_error, validate
from drake_clutter.yaml_io import read_yaml

CATALOG_FILE = "catalog.yaml"
_EARLIER_CATALOG_FILE = "catalogue.yaml"
"""Name of a catalog in asset folders that were made before version 0.2."""
_PRISM_SIDES = 32
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_EMPTY_MAPPING: Any = Field(default_factory=dict)
_Size = Annotated[float, InRange(3, 1000)]
_RESERVED_NAMES = frozenset({"tray", "object_slot", "open_slot", "end", "dummy"})


class Shape(Enum):
    """The collision shape of a class."""

    BOX = "box"
    CYLINDER = "cylinder"
    MESH = "mesh"


class RestOrientation(Enum):
    """Which of an object's axes points up when it rests: by its extent, but a mesh's are taken to be x, y, z in this order."""

    FLAT = "flat"  # the shortest
    SIDE = "side"  # the middle one
    UPRIGHT = "upright"  # the longest


class PairArrangement(Enum):
    """How the two objects of a "meta" pair lie beside each other (SPEC section 2)."""

    LYING = "lying"
    STANDING = "standing"


class LabelDesign(StrictModel):
    """How the texture of a class is drawn. Colors are sRGB hex strings.

    Attributes:
        title: The words on the front, at most 24 characters; the class's name when empty.
        base: Color of the body.
        accent: Color of the band and the motif.
        motif: One of `drake_clutter.assets.MOTIFS`.
    """

    title: str = ""
    base: str = "#b0b7bf"
    accent: str = "#34495e"
    motif: str = "dots"


def _check_class_name(name: str) -> str:
    if not _NAME.fullmatch(name) or name in _RESERVED_NAMES:
        words = ", ".join(sorted(_RESERVED_NAMES))
        raise allowed_error(f"a name of lower-case letters, digits and _, and none of {words}")
    return name


class ClassEntry(StrictModel):
    """One class as it stands in `catalog.yaml`.

    Attributes:
        shape: Box, cylinder or mesh.
        size_mm: Extents [mm]; a cylinder's are diameter, diameter, height; a mesh's is measured,
            and must be left out. Shape (3,).
        mass_g: Mass [g].
        source: Where size and mass come from.
        pairs: The arrangements in which two of it stand as a pair.
        only_rest: How it rests in all orientations (cans stand, a marker lies); None if it varies.
        mesh: A watertight mesh in meters, beside the catalog; for shape mesh only.
        label: How its texture is drawn.
    """

    shape: Shape
    size_mm: tuple[_Size, _Size, _Size] | None = None
    mass_g: Annotated[float, InRange(1e-6, 20_000)]
    source: str = ""
    pairs: tuple[PairArrangement, ...] = ()
    only_rest: RestOrientation | None = None
    mesh: NonEmptyText | None = None
    label: LabelDesign = LabelDesign()

    @field_validator("size_mm")
    @classmethod
    def _check_cylinder_size(cls, size: tuple[float, ...] | None, info: ValidationInfo) -> Any:
        if size and info.data.get("shape") is Shape.CYLINDER and size[0] != size[1]:
            raise allowed_error(
                "diameter, diameter, height: a cylinder's first two sizes are equal"
            )
        return size

    @field_validator("pairs")
    @classmethod
    def _check_pairs(cls, pairs: tuple[PairArrangement, ...]) -> tuple[PairArrangement, ...]:
        if len(set(pairs)) != len(pairs):
            raise allowed_error("each arrangement once")
        return pairs

    @model_validator(mode="after")
    def _check_size_or_mesh(self) -> Self:
        is_mesh = self.shape is Shape.MESH
        if is_mesh == (self.mesh is None) or is_mesh == (self.size_mm is not None):
            raise allowed_error(
                "`mesh` and no `size_mm` for a mesh, `size_mm` and no `mesh` for others"
            )
        return self


class CatalogFile(StrictModel):
    """The schema of `catalog.yaml`.

    Attributes:
        classes: By name (lower case, digits, underscores).
        object_sets: Named lists of classes; a user's catalog may name shipped classes too.
    """

    classes: dict[Annotated[str, AfterValidator(_check_class_name)], ClassEntry] = _EMPTY_MAPPING
    object_sets: dict[str, tuple[str, ...]] = _EMPTY_MAPPING


@dataclass(frozen=True, eq=False)
class ObjectClass:
    """An object class, checked; compared by identity, as a catalog holds one of each.

    Attributes:
        name: the class's name.
        shape: its collision shape.
        size: (3,) m, the extents of its bounding box in O; a cylinder's is (diameter, diameter, height).
        mass: kg.
        source: where size and mass come from.
        pairs: the pair arrangements that the grammar has a rule for.
        only_rest: how it rests in every orientation, or None if that may change.
        mesh: the user's mesh file, or None.
        label: how its texture is drawn.
        folder: where its built assets lie.
    """

    name: str
    shape: Shape
    size: tuple[float, float, float]
    mass: float
    source: str
    pairs: tuple[PairArrangement, ...]
    only_rest: RestOrientation | None
    mesh: Path | None
    label: LabelDesign
    folder: Path

    @property
    def volume(self) -> float:
        """Volume in m^3 (a mesh's: of its bounding box, which is what a camera can tell)."""
        x, y, z = self.size
        return x * y * z * (math.pi / 4 if self.shape is Shape.CYLINDER else 1.0)

    @property
    def sdf_path(self) -> Path:
        """The built SDF model."""
        return self.folder / "model.sdf"

    @cached_property
    def model_path(self) -> Path:
        """The built SDF model, with the mass of the catalog.

        Raises:
            InputError: It is missing, or was built with another mass.
        """
        remedy = f"run `drake-clutter assets build {self.folder.parent}`"
        if not self.sdf_path.is_file():
            raise InputError(f"{self.folder}: class {self.name} has no assets; {remedy}")
        mass = ElementTree.parse(self.sdf_path).findtext("model/link/inertial/mass", "nan")
        if not math.isclose(float(mass), self.mass, rel_tol=1e-5):
            raise InputError(
                f"{self.sdf_path}: mass: {mass}; allowed is the catalog's, {self.mass:g} kg; {remedy}"
            )
        return self.sdf_path

    @cached_property
    def convex_pieces(self) -> tuple[NDArray[np.float64], ...]:
        """Corners of its convex pieces in O, each (V, 3) m; a cylinder is a prism of 32 sides inscribed in it."""
        half = np.asarray(self.size) / 2
        if self.shape is Shape.BOX:
            return (
                half
                * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float),
            )
        if self.shape is Shape.CYLINDER:
            angle = np.arange(_PRISM_SIDES) * (2 * math.pi / _PRISM_SIDES)
            ring = half[0] * np.column_stack([np.cos(angle), np.sin(angle)])
            return (
                np.vstack(
                    [np.column_stack([ring, np.full(len(ring), z)]) for z in (-half[2], half[2])]
                ),
            )
        pieces = sorted(self.folder.glob("convex_*.obj"))
        if not pieces:
            raise InputError(
                f"{self.folder}: class {self.name} has no assets; run `drake-clutter assets build {self.folder.parent}`"
            )
        return tuple(np.asarray(trimesh.load_mesh(piece).vertices, float) for piece in pieces)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """All corners of its convex pieces, (V, 3) m in O."""
        return np.vstack(self.convex_pieces)


@dataclass(frozen=True)
class Catalog:
    """Object classes and named sets of them.

    Attributes:
        classes: by name.
        object_sets: names of classes, by the set's name.
        folders: the asset folders that it was read from.
    """

    classes: Mapping[str, ObjectClass]
    object_sets: Mapping[str, tuple[str, ...]]
    folders: tuple[Path, ...]

    def object_set(self, name: str) -> tuple[ObjectClass, ...]:
        """The classes of a named set.

        Raises:
            InputError: no such set.
        """
        if name not in self.object_sets:
            raise InputError(
                f"object set {name!r} is unknown; known are {', '.join(self.object_sets)}"
            )
        return tuple(self.classes[class_name] for class_name in self.object_sets[name])


def _measure_mesh(path: Path, where: str) -> tuple[float, float, float]:
    if not path.is_file():
        raise InputError(f"{where}.mesh: no file {path}; give a mesh that lies beside the catalog")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh's readers raise whatever their formats suggest
        raise InputError(f"{where}.mesh: {path} cannot be read as a mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not mesh.is_watertight or mesh.volume <= 0:
        raise InputError(
            f"{where}.mesh: {path} is not watertight; give a closed surface with outward normals"
        )
    x, y, z = (float(extent) for extent in mesh.extents)
    if not 0.003 <= min(x, y, z) <= max(x, y, z) <= 1.0:
        raise InputError(
            f"{where}.mesh: {path} measures {x:.4g} x {y:.4g} x {z:.4g} m; allowed are 0.003 to 1 m a side (units are metres)"
        )
    return x, y, z


def _make_object_class(name: str, entry: ClassEntry, folder: Path, where: str) -> ObjectClass:
    mesh = folder / entry.mesh if entry.mesh else None
    if mesh is not None:
        size = _measure_mesh(mesh, where)
    else:
        assert entry.size_mm is not None
        x, y, z = (s / 1000 for s in entry.size_mm)
        size = (x, y, z)
    return ObjectClass(
        name,
        entry.shape,
        size,
        entry.mass_g / 1000,
        entry.source,
        entry.pairs,
        entry.only_rest,
        mesh,
        entry.label,
        folder / name,
    )


def catalog_path(folder: Path) -> Path:
    """Return the path of an asset folder's catalog."""
    path = folder / CATALOG_FILE
    earlier = folder / _EARLIER_CATALOG_FILE
    return earlier if earlier.is_file() and not path.is_file() else path


@lru_cache
def load_catalog(folder: Path | None = None) -> Catalog:
    """The shipped catalog, with the classes and sets of a user's asset folder added.

    Args:
        folder: a user's asset folder; None for the shipped one alone.

    Raises:
        InputError: the catalog is missing or broken; the message names file, field and what is allowed.
    """
    shipped = resource_path("sdf_assets")
    folders = (
        (shipped,) if folder is None or folder.resolve() == shipped else (shipped, folder.resolve())
    )
    classes: dict[str, ObjectClass] = {}
    object_sets: dict[str, tuple[str, ...]] = {}
    for asset_folder in folders:
        path = catalog_path(asset_folder)
        if not path.is_file():
            allowed_values = f"no such file; a catalog is a folder that holds {CATALOG_FILE}"
            raise input_error(str(path), allowed_values)
        catalog_file = validate(CatalogFile, read_yaml(path, "a catalog"), str(path))
        for name, entry in catalog_file.classes.items():
            if name in classes:
                raise InputError(f"{path}: classes.{name}: is shipped already; choose another name")
            classes[name] = _make_object_class(name, entry, asset_folder, f"{path}: classes.{name}")
        for set_name, members in catalog_file.object_sets.items():
            unknown = [member for member in members if member not in classes]
            if unknown or not members or len(set(members)) != len(members):
                allowed_values = f"a list, without repeats, of {', '.join(classes)}"
                problem = f"object_sets.{set_name}: {format_value(unknown or list(members))}"
                raise input_error(str(path), f"{problem}; allowed is {allowed_values}")
            object_sets[set_name] = members
    return Catalog(classes, object_sets, folders)
