"""The catalogue of object classes: what they measure and weigh, and where their assets lie.

An *asset folder* holds `catalogue.yaml` and one folder per class that `drake_clutter.assets` builds from it. The shipped
one is `sdf_assets/`; a user's own adds classes to it. An object's frame O has its origin at the geometric centre: a box's
x, y, z are its sizes in the order of the catalogue, a cylinder's axis is z, a mesh keeps its axes.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_load_typed

from drake_clutter.files import InputError
from drake_clutter.resources import shipped_path

CATALOGUE_FILE = "catalogue.yaml"
_CYLINDER_SIDES = 32
_NAME = re.compile(r"[a-z][a-z0-9_]*")
_GRAMMAR_WORDS = frozenset({"tray", "object_slot", "open_slot", "end", "dummy"})


class Shape(Enum):
    """The collision shape of a class."""

    BOX = "box"
    CYLINDER = "cylinder"
    MESH = "mesh"


class Rest(Enum):
    """Which of an object's axes points up when it rests: by its extent, but a mesh's are taken to be x, y, z in this order."""

    FLAT = "flat"  # the shortest
    SIDE = "side"  # the middle one
    UPRIGHT = "upright"  # the longest


class PairArrangement(Enum):
    """How the two objects of a "meta" pair lie beside each other (SPEC section 2)."""

    LYING = "lying"
    STANDING = "standing"


@dataclass
class Label:
    """How the texture of a class is drawn. Colours are sRGB hex strings.

    Attributes:
        title: the words on the front, at most 24 characters; the class's name when empty.
        base: colour of the body.
        accent: colour of the band and the motif.
        motif: one of `drake_clutter.assets.MOTIFS`.
    """

    title: str = ""
    base: str = "#b0b7bf"
    accent: str = "#34495e"
    motif: str = "dots"


@dataclass
class ClassEntry:
    """One class as it stands in `catalogue.yaml`.

    Attributes:
        shape: box, cylinder or mesh.
        size_mm: (3,) mm; a cylinder's is (diameter, diameter, height); a mesh's is measured, and must be left out.
        mass_g: grams.
        source: where size and mass come from.
        pairs: the arrangements in which two of it stand as a pair: lying, standing.
        only_rest: flat, side or upright: how it rests in all orientations (cans stand, a marker lies); empty if it varies.
        mesh: a watertight mesh in metres, beside the catalogue; for shape mesh only.
        label: how its texture is drawn.
    """

    shape: str = ""
    size_mm: list[float] = field(default_factory=list)
    mass_g: float = math.nan
    source: str = ""
    pairs: list[str] = field(default_factory=list)
    only_rest: str = ""
    mesh: str = ""
    label: Label = field(default_factory=Label)


@dataclass
class CatalogueFile:
    """The schema of `catalogue.yaml`.

    Attributes:
        classes: by name (lower case, digits, underscores).
        object_sets: named lists of classes; a user's catalogue may name shipped classes too.
    """

    classes: dict[str, ClassEntry] = field(default_factory=dict)
    object_sets: dict[str, list[str]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class ObjectClass:
    """An object class, checked; compared by identity, as a catalogue holds one of each.

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
    only_rest: Rest | None
    mesh: Path | None
    label: Label
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
    def convex_pieces(self) -> tuple[NDArray[np.float64], ...]:
        """Corners of its convex pieces in O, each (V, 3) m; a cylinder is a prism of 32 sides inscribed in it."""
        half = np.asarray(self.size) / 2
        if self.shape is Shape.BOX:
            return (half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float),)
        if self.shape is Shape.CYLINDER:
            angle = np.arange(_CYLINDER_SIDES) * (2 * math.pi / _CYLINDER_SIDES)
            ring = half[0] * np.column_stack([np.cos(angle), np.sin(angle)])
            return (np.vstack([np.column_stack([ring, np.full(len(ring), z)]) for z in (-half[2], half[2])]),)
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
class Catalogue:
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
            raise InputError(f"object set {name!r} is unknown; known are {', '.join(self.object_sets)}")
        return tuple(self.classes[class_name] for class_name in self.object_sets[name])


def _mesh_size(path: Path, where: str) -> tuple[float, float, float]:
    if not path.is_file():
        raise InputError(f"{where}.mesh: no file {path}; give a mesh that lies beside the catalogue")
    try:
        mesh = trimesh.load_mesh(path)
    except Exception as error:  # trimesh's readers raise whatever their formats suggest
        raise InputError(f"{where}.mesh: {path} cannot be read as a mesh ({error})") from error
    if not isinstance(mesh, trimesh.Trimesh) or not mesh.is_watertight or mesh.volume <= 0:
        raise InputError(f"{where}.mesh: {path} is not watertight; give a closed surface with outward normals")
    x, y, z = (float(extent) for extent in mesh.extents)
    if not 0.003 <= min(x, y, z) <= max(x, y, z) <= 1.0:
        raise InputError(
            f"{where}.mesh: {path} measures {x:.4g} x {y:.4g} x {z:.4g} m; allowed are 0.003 to 1 m a side (units are metres)"
        )
    return x, y, z


def _checked_class(name: str, entry: ClassEntry, folder: Path, where: str) -> ObjectClass:
    if not _NAME.fullmatch(name) or name in _GRAMMAR_WORDS:
        raise InputError(
            f"{where}: bad class name; allowed are lower-case letters, digits and _, and none of "
            + ", ".join(sorted(_GRAMMAR_WORDS))
        )
    try:
        shape = Shape(entry.shape)
    except ValueError:
        raise InputError(f"{where}.shape: {entry.shape!r}; allowed are {', '.join(s.value for s in Shape)}") from None
    try:
        pairs = tuple(PairArrangement(pair) for pair in entry.pairs)
    except ValueError:
        raise InputError(f"{where}.pairs: {entry.pairs}; allowed are {', '.join(p.value for p in PairArrangement)}") from None
    if entry.only_rest and entry.only_rest not in {rest.value for rest in Rest}:
        raise InputError(f"{where}.only_rest: {entry.only_rest!r}; allowed are {', '.join(r.value for r in Rest)}, or none")
    only_rest = Rest(entry.only_rest) if entry.only_rest else None
    if len(set(pairs)) != len(pairs):
        raise InputError(f"{where}.pairs: {entry.pairs}; each arrangement may stand once")
    if not 0 < entry.mass_g < 20_000:
        raise InputError(f"{where}.mass_g: {entry.mass_g}; allowed is more than 0 and less than 20000")
    mesh = folder / entry.mesh if entry.mesh else None
    if (shape is Shape.MESH) != (mesh is not None) or (shape is Shape.MESH) == bool(entry.size_mm):
        raise InputError(f"{where}: a mesh class has `mesh` and no `size_mm`; a box or cylinder has `size_mm` and no `mesh`")
    if mesh is not None:
        size = _mesh_size(mesh, where)
    else:
        if len(entry.size_mm) != 3 or not all(3 <= s <= 1000 for s in entry.size_mm):
            raise InputError(f"{where}.size_mm: {entry.size_mm}; allowed are three numbers from 3 to 1000")
        x, y, z = (s / 1000 for s in entry.size_mm)
        size = (x, y, z)
        if shape is Shape.CYLINDER and x != y:
            raise InputError(f"{where}.size_mm: {entry.size_mm}; a cylinder's first two sizes are its diameter, twice")
    return ObjectClass(name, shape, size, entry.mass_g / 1000, entry.source, pairs, only_rest, mesh, entry.label, folder / name)


def _read(folder: Path) -> CatalogueFile:
    path = folder / CATALOGUE_FILE
    if not path.is_file():
        raise InputError(f"{path}: no such file; a catalogue is a folder that holds {CATALOGUE_FILE}")
    try:
        read: CatalogueFile = yaml_load_typed(schema=CatalogueFile, filename=str(path), defaults=CatalogueFile())
    except Exception as error:  # Drake's reader raises many kinds; every one means a broken file
        raise InputError(f"{path}: {error}") from error
    return read


@lru_cache
def load_catalogue(folder: Path | None = None) -> Catalogue:
    """The shipped catalogue, with the classes and sets of a user's asset folder added.

    Args:
        folder: a user's asset folder; None for the shipped one alone.

    Raises:
        InputError: the catalogue is missing or broken; the message names file, field and what is allowed.
    """
    shipped = shipped_path("sdf_assets")
    folders = (shipped,) if folder is None or folder.resolve() == shipped else (shipped, folder.resolve())
    classes: dict[str, ObjectClass] = {}
    object_sets: dict[str, tuple[str, ...]] = {}
    for asset_folder in folders:
        read = _read(asset_folder)
        path = asset_folder / CATALOGUE_FILE
        for name, entry in read.classes.items():
            if name in classes:
                raise InputError(f"{path}: classes.{name}: is shipped already; choose another name")
            classes[name] = _checked_class(name, entry, asset_folder, f"{path}: classes.{name}")
        for set_name, members in read.object_sets.items():
            unknown = [member for member in members if member not in classes]
            if unknown or not members or len(set(members)) != len(members):
                raise InputError(
                    f"{path}: object_sets.{set_name}: {unknown or members}; allowed is a list, without repeats, of "
                    + ", ".join(classes)
                )
            object_sets[set_name] = tuple(members)
    return Catalogue(classes, object_sets, folders)
