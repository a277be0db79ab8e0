"""The catalog of object classes: sizes, masses, labels and asset folders.

An *asset folder* holds `catalog.yaml` and one folder for each class, which `drake_clutter.assets`
builds from it. The shipped asset folder is `sdf_assets/`; a user's asset folder adds classes to it.

The origin of an object's frame O is the geometric center. A box's x, y and z axes are its sizes in
the order of the catalog, a cylinder's axis is z, and a mesh keeps its axes.
"""

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import Enum
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from drake_clutter.built_mesh import read_mesh_measures, read_surface
from drake_clutter.files import InputError, format_value, input_error, reading_file
from drake_clutter.resources import resource_path
from drake_clutter.validation import InRange, NonEmptyText, StrictModel, allowed_error, validate
from drake_clutter.yaml_io import read_yaml

if TYPE_CHECKING:
    import trimesh

CATALOG_FILE = "catalog.yaml"
_EARLIER_CATALOG_FILE = "catalogue.yaml"
"""Name of a catalog in asset folders that were made before version 0.2."""
_PRISM_SIDES = 32
"""Number of sides of the prism that represents a cylinder in `convex_pieces`."""
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_EMPTY_MAPPING: Any = Field(default_factory=dict)
_Size = Annotated[float, InRange(3, 1000)]
"""An extent of an object [mm]."""
_Coordinate = Annotated[float, InRange(-500, 500)]
"""A coordinate of a point in an object [mm]."""
_RESERVED_NAMES = frozenset({"tray", "object_slot", "open_slot", "end", "dummy"})
"""Names of the support and of nodes of the scene grammar."""


class Shape(Enum):
    """The collision shape of a class."""

    BOX = "box"
    CYLINDER = "cylinder"
    MESH = "mesh"


class RestOrientation(Enum):
    """Vertical axis of an object at rest, by the rank of the extent along the axis.

    A mesh keeps its own axes: x counts as the shortest and z as the longest.
    """

    FLAT = "flat"  # the shortest axis
    SIDE = "side"  # the middle axis
    UPRIGHT = "upright"  # the longest axis


class PairArrangement(Enum):
    """How the two objects of a pair ("meta" in Kumar et al. 2022) stand side by side."""

    LYING = "lying"
    STANDING = "standing"


class MeshUnit(Enum):
    """Unit of the coordinates in a mesh file."""

    METERS = "m"
    CENTIMETERS = "cm"
    MILLIMETERS = "mm"

    @property
    def scale(self) -> float:
        """The unit [m]."""
        return {"m": 1.0, "cm": 0.01, "mm": 0.001}[self.value]


class LabelDesign(StrictModel):
    """How the texture of a class is drawn. Colors are sRGB hex strings.

    Attributes:
        title: Words on the front, at most 24 characters; the class's name when empty.
        base: Color of the body.
        accent: Color of the band and the motif.
        motif: One of `drake_clutter.assets.MOTIFS`.
    """

    title: str = ""
    base: str = "#b0b7bf"
    accent: str = "#34495e"
    motif: str = "dots"


def _check_class_name(name: str) -> str:
    """Validate the name of a class."""
    if not _NAME.fullmatch(name) or name in _RESERVED_NAMES:
        words = ", ".join(sorted(_RESERVED_NAMES))
        raise allowed_error(f"a name of lower-case letters, digits and _, and none of {words}")
    return name


class ClassEntry(StrictModel):
    """One class in `catalog.yaml`.

    Attributes:
        shape: Box, cylinder or mesh.
        size_mm: Extents [mm]; diameter, diameter, height of a cylinder. A mesh's are measured and
            must be left out. Shape (3,).
        mass_g: Mass [g].
        center_of_mass_mm: Center of mass in O [mm], as of a bottle that is half full; None for that
            of uniform density. Shape (3,).
        source: Source of size and mass.
        pairs: Arrangements in which two objects of the class stand as a pair.
        only_rest: Only orientation at rest (cans stand, a marker lies); None if it varies.
        mesh: Path of a closed mesh, relative to the catalog; for shape mesh only. glTF files are y
            up, all others z up. Its convex pieces have at most 128 corners; `assets build` prints
            how far they deviate from it.
        mesh_unit: Unit of the mesh's coordinates.
        label: How its texture is drawn.
    """

    shape: Shape
    size_mm: tuple[_Size, _Size, _Size] | None = None
    mass_g: Annotated[float, InRange(1e-6, 20_000)]
    center_of_mass_mm: tuple[_Coordinate, _Coordinate, _Coordinate] | None = None
    source: str = ""
    pairs: tuple[PairArrangement, ...] = ()
    only_rest: RestOrientation | None = None
    mesh: NonEmptyText | None = None
    mesh_unit: MeshUnit = MeshUnit.METERS
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
        if not is_mesh and "mesh_unit" in self.model_fields_set:
            raise allowed_error("`mesh_unit` of a mesh alone; `size_mm` is in millimeters")
        return self


class CatalogFile(StrictModel):
    """The schema of `catalog.yaml`.

    Attributes:
        classes: Classes by name (lower case, digits, underscores).
        object_sets: Lists of classes by name. A user's catalog may list shipped classes too.
    """

    classes: dict[Annotated[str, AfterValidator(_check_class_name)], ClassEntry] = _EMPTY_MAPPING
    object_sets: dict[str, tuple[str, ...]] = _EMPTY_MAPPING


@dataclass(frozen=True, eq=False)
class ObjectClass:
    """A validated object class.

    Classes compare by identity, as a catalog holds each once.

    Attributes:
        name: Name of the class.
        shape: Collision shape.
        size: Extents of the bounding box in O [m]; (diameter, diameter, height) of a cylinder.
            Shape (3,).
        mass: Mass [kg].
        stated_center_of_mass: Center of mass in O that the catalog states [m]; None for that of
            uniform density. Shape (3,).
        source: Source of size and mass.
        pairs: Pair arrangements for which the grammar has a rule.
        only_rest: Only orientation at rest; None if it varies.
        mesh: The user's mesh file, or None.
        mesh_unit: Unit of its coordinates.
        label: How its texture is drawn.
        folder: Folder of its built assets.
    """

    name: str
    shape: Shape
    size: tuple[float, float, float]
    mass: float
    stated_center_of_mass: tuple[float, float, float] | None
    source: str
    pairs: tuple[PairArrangement, ...]
    only_rest: RestOrientation | None
    mesh: Path | None
    mesh_unit: MeshUnit
    label: LabelDesign
    folder: Path

    @property
    def volume(self) -> float:
        """Volume [m^3]; of a mesh, the volume of its bounding box."""
        x, y, z = self.size
        return x * y * z * (math.pi / 4 if self.shape is Shape.CYLINDER else 1.0)

    @property
    def sdf_path(self) -> Path:
        """Path of the built SDF model."""
        return self.folder / "model.sdf"

    @cached_property
    def verified_sdf_path(self) -> Path:
        """Path of the built SDF model, after a check of its inertial against the catalog.

        Raises:
            InputError: The model is missing or damaged, or was built with another mass or center
                of mass.
        """
        self._read_center_of_mass()
        return self.sdf_path

    @cached_property
    def center_of_mass(self) -> NDArray[np.float64]:
        """Center of mass p_OCm [m]; of a mesh without a stated one, that of its built model.

        Shape (3,).

        Raises:
            InputError: The model of a mesh cannot be used, see `verified_sdf_path`.
        """
        if self.stated_center_of_mass is not None:
            return np.array(self.stated_center_of_mass)
        return self._read_center_of_mass() if self.shape is Shape.MESH else np.zeros(3)

    def _read_center_of_mass(self) -> NDArray[np.float64]:
        """Return the center of mass of the built model, after a check against the catalog."""
        remedy = f"run `drake-clutter assets build {self.folder.parent}`"
        if not self.sdf_path.is_file():
            raise InputError(f"{self.folder}: class {self.name} has no assets; {remedy}")
        try:
            model = ElementTree.parse(self.sdf_path)
            mass = float(model.findtext("model/link/inertial/mass", "nan"))
            pose = model.findtext("model/link/inertial/pose", "").split()
            x, y, z = (float(value) for value in pose[:3])
        except (ElementTree.ParseError, ValueError) as error:
            raise InputError(f"{self.sdf_path}: cannot be read ({error}); {remedy}") from error
        if not math.isclose(mass, self.mass, rel_tol=1e-5):
            raise InputError(
                f"{self.sdf_path}: mass: {mass}; expected the catalog's, {self.mass:g} kg; {remedy}"
            )
        expected = self.stated_center_of_mass or (
            (x, y, z) if self.shape is Shape.MESH else (0.0, 0.0, 0.0)
        )
        if not np.allclose((x, y, z), expected, rtol=0, atol=1e-6):
            raise InputError(
                f"{self.sdf_path}: center of mass: {x:g} {y:g} {z:g}; expected the catalog's, "
                f"{' '.join(f'{value:g}' for value in expected)} m; {remedy}"
            )
        return np.array([x, y, z])

    @cached_property
    def convex_pieces(self) -> tuple[NDArray[np.float64], ...]:
        """Corners of the convex pieces in O, each (V, 3) [m].

        A cylinder is represented by an inscribed prism of 32 sides.
        """
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
        remedy = f"run `drake-clutter assets build {self.folder.parent}`"
        files = sorted(self.folder.glob("convex_*.obj"))
        if not files:
            raise InputError(f"{self.folder}: class {self.name} has no assets; {remedy}")
        pieces = tuple(_read_piece(file, remedy) for file in files)
        if not np.allclose(np.ptp(np.vstack(pieces), axis=0), self.size, rtol=0.02, atol=1e-4):
            raise InputError(f"{self.folder}: was built from another mesh; {remedy}")
        return pieces

    @cached_property
    def surface_triangles(self) -> NDArray[np.float64]:
        """Corners of the triangles of a mesh's surface in O [m]. Shape (F, 3, 3)."""
        assert self.mesh is not None, f"class {self.name} is not a mesh"
        if read_mesh_measures(self.folder, self.mesh, self.mesh_unit.scale) is not None:
            surface = read_surface(self.folder)
            if surface is not None:
                return surface
        where = f"{catalog_path(self.folder.parent)}: classes.{self.name}.mesh"
        return np.asarray(_load_solid(self.mesh, where, self.mesh_unit).triangles, float)

    @cached_property
    def corners(self) -> NDArray[np.float64]:
        """Corners of all convex pieces in O [m]. Shape (V, 3)."""
        return np.vstack(self.convex_pieces)


@dataclass(frozen=True)
class Catalog:
    """Object classes and named sets of them.

    Attributes:
        classes: Classes by name.
        object_sets: Names of classes by the name of their set.
        folders: Asset folders from which the catalog was read.
    """

    classes: Mapping[str, ObjectClass]
    object_sets: Mapping[str, tuple[str, ...]]
    folders: tuple[Path, ...]

    def object_set(self, name: str) -> tuple[ObjectClass, ...]:
        """Return the classes of a named set.

        Raises:
            InputError: There is no such set.
        """
        if name not in self.object_sets:
            raise InputError(
                f"object set {name!r} is unknown; known are {', '.join(self.object_sets)}"
            )
        return tuple(self.classes[class_name] for class_name in self.object_sets[name])

    def smallest_set(self, class_names: Collection[str]) -> tuple[ObjectClass, ...]:
        """Return the classes of the smallest object set that has some classes.

        If no set has all of them, they are all classes of the catalog.

        Args:
            class_names: Names of the classes.
        """
        sets = [names for names in self.object_sets.values() if set(class_names) <= set(names)]
        names = min(sets, key=len, default=tuple(self.classes))
        return tuple(self.classes[name] for name in names)


def _read_piece(path: Path, remedy: str) -> NDArray[np.float64]:
    """Return the corners of a convex piece of a built class [m]. Shape (V, 3)."""
    import trimesh  # imported late: it takes long, and boxes and cylinders need no meshes

    with reading_file(path, f"a convex piece; {remedy}"):
        corners = np.asarray(trimesh.load_mesh(path).vertices, float)
        if len(corners) < 4 or corners.shape[1] != 3 or not np.isfinite(corners).all():
            raise ValueError("it has no solid, or corners that are not finite")
        return corners


def _load_solid(mesh: Path, where: str, unit: MeshUnit) -> "trimesh.Trimesh":
    """Return the solid of a mesh file, see `load_object_mesh`."""
    # Imported late: it takes long, and boxes and cylinders need no meshes.
    from drake_clutter.mesh_file import load_object_mesh

    return load_object_mesh(mesh, where, unit.scale).solid


def _make_object_class(name: str, entry: ClassEntry, folder: Path, where: str) -> ObjectClass:
    """Return the class of an entry of a catalog."""
    mesh = folder / entry.mesh if entry.mesh else None
    if mesh is not None:
        measures = read_mesh_measures(folder / name, mesh, entry.mesh_unit.scale)
        if measures is not None:
            size = measures.extents
        else:
            extents = _load_solid(mesh, f"{where}.mesh", entry.mesh_unit).extents
            size = (float(extents[0]), float(extents[1]), float(extents[2]))
    else:
        assert entry.size_mm is not None
        x, y, z = (s / 1000 for s in entry.size_mm)
        size = (x, y, z)
    center_of_mass = None
    if entry.center_of_mass_mm is not None:
        center_x, center_y, center_z = (value / 1000 for value in entry.center_of_mass_mm)
        center_of_mass = (center_x, center_y, center_z)
        if (np.abs(center_of_mass) >= np.asarray(size) / 2).any():
            limits = " x ".join(f"{500 * extent:g}" for extent in size)
            raise InputError(
                f"{where}.center_of_mass_mm: {format_value(list(entry.center_of_mass_mm))}; "
                f"expected a point within {limits} mm of the center of the bounding box"
            )
    return ObjectClass(
        name,
        entry.shape,
        size,
        entry.mass_g / 1000,
        center_of_mass,
        entry.source,
        entry.pairs,
        entry.only_rest,
        mesh,
        entry.mesh_unit,
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
    """Return the shipped catalog, extended by a user's asset folder.

    Args:
        folder: A user's asset folder; None for the shipped catalog alone.

    Raises:
        InputError: A catalog is missing or invalid. The message names file, field and what is
            allowed.
    """
    shipped = resource_path("sdf_assets")
    folders: tuple[Path, ...] = (shipped,)
    if folder is not None:
        with reading_file(str(folder), "an asset folder"):
            own_folder = folder.resolve()
        folders = tuple(dict.fromkeys((shipped, own_folder)))
    classes: dict[str, ObjectClass] = {}
    object_sets: dict[str, tuple[str, ...]] = {}
    for asset_folder in folders:
        path = catalog_path(asset_folder)
        if not path.is_file():
            problem = f"no such file; an asset folder contains {CATALOG_FILE}"
            raise input_error(str(path), problem)
        catalog_file = validate(CatalogFile, read_yaml(path, "a catalog"), str(path))
        for name, entry in catalog_file.classes.items():
            if name in classes:
                raise InputError(f"{path}: classes.{name}: is shipped already; choose another name")
            classes[name] = _make_object_class(name, entry, asset_folder, f"{path}: classes.{name}")
        for set_name, members in catalog_file.object_sets.items():
            unknown = [member for member in members if member not in classes]
            if unknown or not members or len(set(members)) != len(members):
                expected = f"a list, without repeats, of {', '.join(classes)}"
                problem = f"object_sets.{set_name}: {format_value(unknown or list(members))}"
                raise input_error(str(path), f"{problem}; expected {expected}")
            object_sets[set_name] = members
    return Catalog(classes, object_sets, folders)
